"""Lockstep: the bench controls time. One process, one thread, any bus; runs are reproducible byte for byte."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from firmware_py.app.firmware import BusFrame, Firmware
from firmware_py.app.observers import Observer
from firmware_py.bus.port import Port
from firmware_py.core.types import Outputs, Request

PATIENCE_LOOKS = 20_000
"""Polls of the sockets before missing frames count as lost by the bus: about half a second; not reached on a working bus."""


class Lockstep:
    """The firmware's side of a lockstep run."""

    def __init__(
        self,
        firmware: Firmware,
        ports: Sequence[Port],
        observers: Sequence[Observer] = (),
        patience_looks: int = PATIENCE_LOOKS,
    ) -> None:
        self._firmware = firmware
        self._ports = ports
        self._observers = observers
        self._patience_looks = patience_looks
        self._sync: list[BusFrame] = []

    def start_tick(self, tick: int, time_ns: int) -> list[BusFrame]:
        """Sends SYNC on every bus; returns the frames that went out."""
        self._sync = self._firmware.sync(tick, time_ns)
        return send(self._ports, self._sync)

    def finish_tick(
        self, tick: int, time_ns: int, requests: Sequence[Request], expected: Sequence[BusFrame]
    ) -> tuple[Outputs, list[BusFrame]]:
        """Receives the `expected` frames of the other side, steps the firmware and sends; returns outputs and frames that went out."""
        received = drain(self._ports, expected, self._patience_looks)
        inputs, outputs, frames = self._firmware.step(tick, time_ns, received, requests)
        sent = send(self._ports, frames)
        for observer in self._observers:
            observer(received, self._sync + frames, inputs, outputs)
        return outputs, sent


def send(ports: Sequence[Port], frames: Sequence[BusFrame]) -> list[BusFrame]:
    """Sends `frames`; returns those that the bus accepted, which the other side may wait for."""
    return [(bus, frame) for bus, frame in frames if ports[bus].send(frame)]


def drain(
    ports: Sequence[Port], expected: Sequence[BusFrame], patience_looks: int = PATIENCE_LOOKS
) -> list[BusFrame]:
    """Receives frames until every frame of `expected` has come; returns all that came.

    Frames of other senders are returned too and do not count as expected ones. A frame that the bus lost is given up after
    `patience_looks` polls.
    """
    received: list[BusFrame] = []
    missing: Counter[BusFrame] | None = None
    for _ in range(patience_looks):
        fresh = [(bus, frame) for bus, port in enumerate(ports) for frame in port.receive()]
        received += fresh
        if missing is None:
            if received == expected:  # by far the most frequent case, and the cheapest check
                break
            missing = Counter(expected)
        missing -= Counter(fresh)
        if not missing:
            break
    return received
