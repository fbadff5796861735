"""Live view: a Foxglove WebSocket server with the channels of the log and a 3D scene. Listens on loopback by default.

The server runs in its own threads outside Python. The scene is drawn in the tick's thread, twenty times a second, and only while a client
subscribes to it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

import foxglove
import numpy as np
from foxglove.channels import FrameTransformsChannel, SceneUpdateChannel
from foxglove.messages import (
    ArrowPrimitive,
    Color,
    CubePrimitive,
    Duration,
    FrameTransform,
    FrameTransforms,
    Pose,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
    Timestamp,
    Vector3,
)
from foxglove.websocket import ChannelView, Client, ServerListener

from firmware_py.app.firmware import BusFrame
from firmware_py.app.observers import Observer
from firmware_py.core import rotations
from firmware_py.core.body import Body
from firmware_py.core.types import BodyRecord, Inputs, Outputs
from firmware_py.description.fleet import Fleet
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import Vehicle

LOOPBACK, PORT = "127.0.0.1", 8765
SCENE_HZ = 20
NS_PER_S = 1_000_000_000
SHOWN_N = 0.05
"""Least thrust that is drawn as an arrow."""
METRES_PER_NEWTON = 0.03
TAG_M, THICKNESS_M = 0.10, 0.004
"""Edge length and thickness of a tag as drawn."""
HULL, REFERENCE, TAG, THRUST = (Color(r=r, g=g, b=b, a=a) for r, g, b, a in (
    (0.95, 0.70, 0.10, 0.85), (0.20, 0.80, 0.30, 0.25), (0.05, 0.05, 0.05, 1.0), (0.15, 0.45, 0.95, 0.9),
))  # fmt: skip
UP = FrameTransform(
    parent_frame_id="up", child_frame_id="world", translation=Vector3(), rotation=Quaternion(x=1.0, y=0.0, z=0.0, w=0.0)
)
"""The world frame is NED; viewers draw z upwards."""


class LiveViewError(DescriptionError):
    """The server cannot be opened; the text is one line."""


class _Watchers(ServerListener):
    """Counts the subscriptions to the scene."""

    def __init__(self) -> None:
        self.scene = 0

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self.scene += channel.topic in ("/scene", "/tf")

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        self.scene -= channel.topic in ("/scene", "/tf")


class LiveView:
    """A server on which the channels of `context` can be watched; close it, or use it in a `with` statement.

    Attributes:
        context: pass it to the Recorder to serve its channels too.
        address: of the server, ws://HOST:PORT.
    """

    def __init__(self, host: str = LOOPBACK, port: int = PORT) -> None:
        """Opens the server; call it before any thread of this process raises its priority. Raises LiveViewError."""
        self.context = foxglove.Context()
        self._watchers = _Watchers()
        self._scene = SceneUpdateChannel("/scene", context=self.context)
        self._frames = FrameTransformsChannel("/tf", context=self.context)
        try:
            self._server = foxglove.start_server(
                name="modcube", host=host, port=port, context=self.context, server_listener=self._watchers
            )
        except RuntimeError as error:
            raise LiveViewError(f"live view on {host}:{port}: {_in_words(error)}") from None
        self.address = f"ws://{host}:{self._server.port}"

    @property
    def is_watched(self) -> bool:
        """Whether any client subscribes to the scene."""
        return self._watchers.scene > 0

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Stops the server."""
        self._server.stop()

    def drawing(self, fleet: Fleet, vehicles: Mapping[str, Vehicle], bodies: Callable[[], list[Body]]) -> Observer:
        """An observer that draws the scene at SCENE_HZ while it is watched; `bodies` returns the bodies as currently docked."""
        every = max(1, fleet.rate_hz // SCENE_HZ)
        of_module = [vehicles[module.vehicle] for module in fleet.module]
        drawn: set[int] = set()

        def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
            if outputs.tick % every or not self.is_watched:
                return
            records = {record.body: record for record in outputs.records}
            shown = [(body, records[body.index]) for body in bodies() if body.index in records]
            gone = drawn - {body.index for body, _ in shown}
            drawn.clear()
            drawn.update(body.index for body, _ in shown)
            time_ns = outputs.time_ns
            self._frames.log(FrameTransforms(transforms=[UP, *frames_of(shown, time_ns)]), log_time=time_ns)
            self._scene.log(scene_of(shown, gone, of_module, time_ns), log_time=time_ns)

        return observe


def _in_words(error: RuntimeError) -> str:
    """The system's error text alone, without its prefix and error number."""
    return re.sub(r" \(os error \d+\)$", "", str(error)).rpartition(": ")[2]


def stamp(time_ns: int) -> Timestamp:
    """The time of a tick as a message."""
    return Timestamp(sec=time_ns // NS_PER_S, nsec=time_ns % NS_PER_S)


def vector(values: np.ndarray) -> Vector3:
    """(3,) as a message."""
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def quaternion(q: np.ndarray) -> Quaternion:
    """(4,) scalar first as a message."""
    w, x, y, z = q.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def frames_of(shown: Sequence[tuple[Body, BodyRecord]], time_ns: int) -> list[FrameTransform]:
    """Frames body0, reference0 and so on, each relative to the world."""
    transforms = []
    for body, record in shown:
        for name, pose in (("body", record.estimate), ("reference", record.setpoint)):
            transforms.append(
                FrameTransform(
                    timestamp=stamp(time_ns),
                    parent_frame_id="world",
                    child_frame_id=f"{name}{body.index}",
                    translation=vector(pose.p_wb),
                    rotation=quaternion(pose.q_wb),
                )
            )
    return transforms


def scene_of(
    shown: Sequence[tuple[Body, BodyRecord]], gone: set[int], of_module: Sequence[Vehicle], time_ns: int
) -> SceneUpdate:
    """Hulls, tags and thrust arrows of each body in its own frame, and its hulls at its set-point."""
    entities = []
    for body, record in shown:
        hulls = [hull_of(body, i, of_module[module].hull.size_m, HULL) for i, module in enumerate(body.modules)]
        ghosts = [hull_of(body, i, of_module[module].hull.size_m, REFERENCE) for i, module in enumerate(body.modules)]
        entities.append(
            entity(f"body{body.index}", time_ns, [*hulls, *tags_of(body)], arrows_of(body, record, of_module))
        )
        entities.append(entity(f"reference{body.index}", time_ns, ghosts, []))
    deletions = [
        SceneEntityDeletion(timestamp=stamp(time_ns), type=SceneEntityDeletionType.MatchingId, id=f"{name}{index}")
        for index in sorted(gone)
        for name in ("body", "reference")
    ]
    return SceneUpdate(deletions=deletions, entities=entities)


def entity(name: str, time_ns: int, cubes: list[CubePrimitive], arrows: list[ArrowPrimitive]) -> SceneEntity:
    """A scene entity in the frame of the same name, valid until it is redrawn."""
    return SceneEntity(
        timestamp=stamp(time_ns), frame_id=name, id=name, lifetime=Duration(sec=0), frame_locked=True,
        cubes=cubes, arrows=arrows,
    )  # fmt: skip


def hull_of(body: Body, place: int, size_m: np.ndarray, color: Color) -> CubePrimitive:
    """The box of one module."""
    pose = Pose(position=vector(body.r_bm[place]), orientation=quaternion(body.q_bm[place]))
    return CubePrimitive(pose=pose, size=vector(size_m), color=color)


def tags_of(body: Body) -> list[CubePrimitive]:
    """Flat black squares."""
    size = Vector3(x=TAG_M, y=TAG_M, z=THICKNESS_M)
    return [
        CubePrimitive(pose=Pose(position=vector(r), orientation=quaternion(q)), size=size, color=TAG)
        for r, q in zip(body.r_bt, body.q_bt, strict=True)
    ]


def arrows_of(body: Body, record: BodyRecord, of_module: Sequence[Vehicle]) -> list[ArrowPrimitive]:
    """An arrow per thruster of at least SHOWN_N, in the direction of its force on the body, METRES_PER_NEWTON long."""
    arrows = []
    thrusters = body.thrusters
    for i, force_n in enumerate(record.commanded_n.tolist()):
        if abs(force_n) < SHOWN_N:
            continue
        place, channel = int(thrusters.module[i]), int(thrusters.channel[i])
        # Compiled functions take no read-only arrays, such as those of descriptions.
        position = of_module[body.modules[place]].thruster[channel].position_m.copy()
        tail = body.r_bm[place] + rotations.rotate(body.q_bm[place].copy(), position)
        direction = np.ascontiguousarray(thrusters.matrix[:3, i]) * np.sign(force_n)
        length = METRES_PER_NEWTON * abs(force_n)
        arrows.append(
            ArrowPrimitive(
                pose=Pose(position=vector(tail), orientation=quaternion(towards(direction))),
                shaft_length=0.7 * length, shaft_diameter=0.012, head_length=0.3 * length, head_diameter=0.024,
                color=THRUST,
            )
        )  # fmt: skip
    return arrows


def towards(direction: np.ndarray) -> np.ndarray:
    """(4,) quaternion of the shortest rotation from +x to a unit vector; about z where the vector is -x."""
    x, y, z = direction.tolist()
    if x < -0.999999:
        return np.array([0.0, 0.0, 0.0, 1.0])
    q = np.array([1.0 + x, 0.0, -z, y])
    return q / float(np.linalg.norm(q))
