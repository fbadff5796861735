"""Lockstep: the bench owns time. One process, one thread, any bus; a run repeats byte for byte."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from firmware_py.app.firmware import BusFrame, Firmware
from firmware_py.bus.codec import Frame
from firmware_py.bus.port import Port
from firmware_py.core.types import Outputs, Request

Observer = Callable[[int, int, Sequence[BusFrame], Sequence[BusFrame], Sequence[Request], Outputs], None]
"""Called after each tick with tick, time_ns, received frames, sent frames, requests and outputs."""


class Lockstep:
    """The firmware's side of a lockstep run."""

    def __init__(self, firmware: Firmware, ports: Sequence[Port], observers: Sequence[Observer] = ()) -> None:
        self._firmware = firmware
        self._ports = ports
        self._observers = observers
        self._sync: list[BusFrame] = []

    def start_tick(self, tick: int, time_ns: int) -> int:
        """Sends SYNC on every bus; returns the number of frames sent."""
        self._sync = self._firmware.sync(tick, time_ns)
        self._send(self._sync)
        return len(self._sync)

    def finish_tick(self, tick: int, time_ns: int, requests: Sequence[Request], expected: int) -> Outputs:
        """Takes the `expected` frames that the other side sent, steps, and sends the commands."""
        received = self._receive(expected)
        outputs, frames = self._firmware.step(tick, time_ns, received, requests)
        self._send(frames)
        sent = self._sync + frames
        for observer in self._observers:
            observer(tick, time_ns, received, sent, requests, outputs)
        self.sent = len(frames)
        return outputs

    def _send(self, frames: Sequence[BusFrame]) -> None:
        for bus, frame in frames:
            self._ports[bus].send(frame)

    def _receive(self, expected: int) -> list[BusFrame]:
        """Drains every port until `expected` frames are through; nothing waits for a particular one."""
        received: list[BusFrame] = []
        for _ in range(DRAIN_ROUNDS):
            for bus, port in enumerate(self._ports):
                received += [(bus, frame) for frame in port.receive()]
            if len(received) >= expected:
                break
        return received


DRAIN_ROUNDS = 100_000
"""Looks at the sockets before frames count as lost by the kernel: about a second; not reached on a working bus."""

__all__ = ["BusFrame", "Frame", "Lockstep", "Observer"]
