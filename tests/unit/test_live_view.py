"""A viewer on the WebSocket receives the log's channels and the scene; without one a tick draws nothing."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from firmware_py.app.firmware import Firmware, compose, vehicles_of
from firmware_py.app.live_view import LiveView, LiveViewError, towards
from firmware_py.app.observers import recording
from firmware_py.core import rotations
from firmware_py.core.types import Inputs, ModuleInputs, Outputs
from firmware_py.description.fleet import single
from firmware_py.description.parameters import Parameters
from firmware_py.description.signals import read_signals
from firmware_py.runtime.recorder import Recorder

FLEET = single()


class Viewer:
    """A hand-written Foxglove client: RFC 6455, protocol foxglove.sdk.v1."""

    def __init__(self, address: str) -> None:
        host, port = address.removeprefix("ws://").split(":")
        self._socket = socket.create_connection((host, int(port)), timeout=10)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = (
            "GET / HTTP/1.1",
            f"Host: {host}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}",
            "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Protocol: foxglove.sdk.v1",
        )
        self._socket.sendall("\r\n".join((*lines, "", "")).encode())
        self._rest = b""
        while b"\r\n\r\n" not in self._rest:
            self._rest += self._socket.recv(4096)
        head, self._rest = self._rest.split(b"\r\n\r\n", 1)
        assert b"101" in head.splitlines()[0]
        self.channels: dict[str, dict[str, Any]] = {}

    def read(self, size: int) -> bytes:
        while len(self._rest) < size:
            data = self._socket.recv(65536)
            assert data, "the server hung up"
            self._rest += data
        data, self._rest = self._rest[:size], self._rest[size:]
        return data

    def frame(self) -> tuple[int, bytes]:
        opcode, length = self.read(2)
        if length == 126:
            (length,) = struct.unpack(">H", self.read(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", self.read(8))
        return opcode & 15, self.read(length)

    def wait_for(self, *topics: str) -> None:
        while not set(topics) <= set(self.channels):
            opcode, data = self.frame()
            if opcode == 1:
                for channel in json.loads(data).get("channels", []):
                    self.channels[channel["topic"]] = channel

    def subscribe(self, *topics: str) -> None:
        wanted = [{"id": self.channels[topic]["id"], "channelId": self.channels[topic]["id"]} for topic in topics]
        text = json.dumps({"op": "subscribe", "subscriptions": wanted}).encode()
        mask = os.urandom(4)
        head = bytes((0x81, 0x80 | len(text))) if len(text) < 126 else struct.pack(">BBH", 0x81, 0x80 | 126, len(text))
        self._socket.sendall(head + mask + bytes(byte ^ mask[i % 4] for i, byte in enumerate(text)))

    def message(self) -> tuple[str, bytes]:
        """Returns the topic and payload of the next message."""
        while True:
            opcode, data = self.frame()
            if opcode == 2 and data[0] == 1:
                number = struct.unpack_from("<I", data, 1)[0]
                return next(t for t, c in self.channels.items() if c["id"] == number), data[13:]

    def decode(self, topic: str, payload: bytes) -> Any:
        files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(self.channels[topic]["schema"]))
        pool = descriptor_pool.DescriptorPool()
        for file in files.file:
            pool.Add(file)
        found = pool.FindMessageTypeByName(self.channels[topic]["schemaName"])
        return message_factory.GetMessageClass(found).FromString(payload)

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(scope="module")
def firmware() -> Firmware:
    return compose(FLEET, Parameters())


@pytest.fixture
def view() -> Iterator[LiveView]:
    with LiveView(port=0) as view:
        yield view


def step(firmware: Firmware, tick: int) -> tuple[Inputs, Outputs]:
    inputs = Inputs(tick, tick * FLEET.period_ns, [ModuleInputs()])
    return inputs, firmware.pipeline.step(inputs)


def test_viewer_sees_the_channels_of_the_log_and_the_scene(firmware: Firmware, view: LiveView, tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, context=view.context)
    record = recording(recorder, FLEET.rate_hz)
    draw = view.drawing(FLEET, vehicles_of(FLEET), lambda: firmware.pipeline.bodies)
    inputs, outputs = step(firmware, 1)
    record([], [], inputs, outputs)
    viewer = Viewer(view.address)
    try:
        viewer.wait_for("/scene", "/tf", "/firmware/ticks", "/firmware/body0")
        viewer.subscribe("/scene", "/tf", "/firmware/body0")
        seen: dict[str, Any] = {}
        tick = 1
        while set(seen) != {"/scene", "/tf", "/firmware/body0"}:
            tick += 1
            assert tick < 20_000
            inputs, outputs = step(firmware, tick)
            outputs.records[0] = outputs.records[0]._replace(commanded_n=np.linspace(-8.0, 8.0, 8))
            record([], [], inputs, outputs)
            draw([], [], inputs, outputs)
            if view.is_watched and tick % 5 == 0:
                topic, payload = viewer.message()
                seen[topic] = viewer.decode(topic, payload)
    finally:
        viewer.close()
        recorder.close()
    names = [entity.id for entity in seen["/scene"].entities]
    assert names == ["body0", "reference0"]
    assert len(seen["/scene"].entities[0].cubes) >= 1
    assert len(seen["/scene"].entities[0].arrows) == 8
    assert {t.child_frame_id for t in seen["/tf"].transforms} == {"world", "body0", "reference0"}
    assert seen["/firmware/body0"].tick > 0
    logged = read_signals(tmp_path / "signals.mcap")
    assert "/firmware/body0" in logged and not {"/scene", "/tf"} & set(logged)


def test_nothing_is_drawn_while_nobody_looks(firmware: Firmware, view: LiveView) -> None:
    def fail() -> list[Any]:
        raise AssertionError("drawn")

    draw = view.drawing(FLEET, vehicles_of(FLEET), fail)
    for tick in range(1, 20):
        draw([], [], *step(firmware, tick))
    assert not view.is_watched


def test_server_listens_on_loopback_alone_unless_told_otherwise(view: LiveView) -> None:
    assert view.address.startswith("ws://127.0.0.1:")


def test_port_that_is_taken_is_refused_in_one_line(view: LiveView) -> None:
    port = int(view.address.rpartition(":")[2])
    with pytest.raises(LiveViewError) as refused:
        LiveView(port=port)
    assert str(refused.value) == f"live view on 127.0.0.1:{port}: Address already in use"


@pytest.mark.parametrize("direction", [*np.eye(3), *-np.eye(3), np.array([0.6, -0.8, 0.0])])
def test_arrow_points_where_the_thruster_pushes(direction: np.ndarray) -> None:
    shown = rotations.rotate(towards(direction), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(shown, direction, atol=1e-12)
