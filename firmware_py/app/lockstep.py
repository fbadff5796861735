"""Lockstep: the bench owns time. One process, one thread, any bus; a run repeats byte for byte."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from firmware_py.app.firmware import BusFrame, Firmware
from firmware_py.app.observers import Observer
from firmware_py.bus.port import Port
from firmware_py.core.types import Outputs, Request

PATIENCE_LOOKS = 20_000
"""Looks at the sockets before frames count as lost by the bus: about half a second; not reached on a working bus."""


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
        """Sends SYNC on every bus; returns what went out."""
        self._sync = self._firmware.sync(tick, time_ns)
        return send(self._ports, self._sync)

    def finish_tick(
        self, tick: int, time_ns: int, requests: Sequence[Request], expected: Sequence[BusFrame]
    ) -> tuple[Outputs, list[BusFrame]]:
        """Takes the `expected` frames that the other side sent, steps, sends; returns the commands that went out."""
        received = drain(self._ports, expected, self._patience_looks)
        inputs, outputs, frames = self._firmware.step(tick, time_ns, received, requests)
        sent = send(self._ports, frames)
        for observer in self._observers:
            observer(received, self._sync + frames, inputs, outputs)
        return outputs, sent


def send(ports: Sequence[Port], frames: Sequence[BusFrame]) -> list[BusFrame]:
    """Sends `frames`; returns those that the bus took, which the other side may wait for."""
    return [(bus, frame) for bus, frame in frames if ports[bus].send(frame)]


def drain(
    ports: Sequence[Port], expected: Sequence[BusFrame], patience_looks: int = PATIENCE_LOOKS
) -> list[BusFrame]:
    """Everything that is there, until every frame of `expected` is among it.

    Other senders' frames come as they come and stand for none of the expected ones. Nothing waits for ever: a frame
    that the bus lost is given up after `patience_looks` looks.
    """
    received: list[BusFrame] = []
    missing: Counter[BusFrame] | None = None
    for _ in range(patience_looks):
        fresh = [(bus, frame) for bus, port in enumerate(ports) for frame in port.receive()]
        received += fresh
        if missing is None:
            if received == expected:  # by far the most frequent case, and the cheapest to see
                break
            missing = Counter(expected)
        missing -= Counter(fresh)
        if not missing:
            break
    return received
