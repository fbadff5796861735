"""Lockstep: the bench owns time. One process, one thread, any bus; a run repeats byte for byte."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from firmware_py.app.firmware import BusFrame, Firmware
from firmware_py.bus.port import Port
from firmware_py.core.types import Inputs, Outputs, Request

Observer = Callable[[Sequence[BusFrame], Sequence[BusFrame], Inputs, Outputs], None]
"""Called after each tick with the frames received and sent, the inputs and the outputs."""
DRAIN_ROUNDS = 100_000
"""Looks at the sockets before frames count as lost by the kernel: about a second; not reached on a working bus."""


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
        return self._send(self._sync)

    def finish_tick(self, tick: int, time_ns: int, requests: Sequence[Request], expected: int) -> tuple[Outputs, int]:
        """Takes the `expected` frames that the other side sent, steps, sends the commands; returns how many."""
        received = drain(self._ports, expected)
        inputs, outputs, frames = self._firmware.step(tick, time_ns, received, requests)
        sent = self._send(frames)
        for observer in self._observers:
            observer(received, self._sync + frames, inputs, outputs)
        return outputs, sent

    def _send(self, frames: Sequence[BusFrame]) -> int:
        for bus, frame in frames:
            self._ports[bus].send(frame)
        return len(frames)


def drain(ports: Sequence[Port], expected: int) -> list[BusFrame]:
    """Everything that is there, until `expected` frames are through; nothing waits for a particular one."""
    received: list[BusFrame] = []
    for _ in range(DRAIN_ROUNDS):
        for bus, port in enumerate(ports):
            received += [(bus, frame) for frame in port.receive()]
        if len(received) >= expected:
            break
    return received
