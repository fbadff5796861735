"""Real time: ticks start at absolute deadlines; the inputs of a tick close when every module has answered, or at half the tick."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from firmware_py.app.firmware import BusFrame, Firmware
from firmware_py.app.lockstep import Observer
from firmware_py.bus.port import Port
from firmware_py.core.types import Outputs, Request
from firmware_py.runtime.clock import Clock
from firmware_py.runtime.rate_keeper import RateKeeper

LISTEN_NS = 200_000_000
"""How long a bus is listened to before the first SYNC: a foreign SYNC refuses the start."""


class ForeignSyncError(RuntimeError):
    """Somebody else sends SYNC on this bus."""


@dataclass(slots=True)
class RealTimeLoop:
    """Runs the firmware against the clock. `requests` hands over what people asked for since the last tick."""

    firmware: Firmware
    ports: Sequence[Port]
    clock: Clock
    rate_keeper: RateKeeper
    requests: Callable[[], Sequence[Request]]
    observers: Sequence[Observer] = ()
    unanswered: int = 0
    """Ticks that closed at half time because a module had not answered."""
    _received: list[BusFrame] = field(default_factory=list)

    def listen(self) -> None:
        """Listens before the first SYNC. Raises ForeignSyncError."""
        end = self.clock.now_ns() + LISTEN_NS
        while self.clock.now_ns() < end:
            for bus, port in enumerate(self.ports):
                port.wait(end)
                for frame in port.receive():
                    self.firmware.collector.take(bus, frame)
        if self.firmware.collector.faults["foreign_sync"]:
            raise ForeignSyncError("another SYNC producer is on the bus: stop it, or use another bus")

    def run(self, stop: Callable[[Outputs], bool], first_tick: int = 0) -> None:
        """Ticks until `stop` says so of a tick's outputs."""
        tick = first_tick
        while True:
            time_ns = self.rate_keeper.wait()
            outputs = self.tick(tick, time_ns)
            if stop(outputs):
                return
            tick += 1

    def tick(self, tick: int, time_ns: int) -> Outputs:
        """One tick that starts at the absolute time `time_ns`."""
        collector = self.firmware.collector
        sync = self.firmware.sync(tick, time_ns)
        for bus, frame in sync:
            self.ports[bus].send(frame)
        self._gather(tick, time_ns + self.firmware.fleet.period_ns // 2)
        self.unanswered += not collector.all_answered(tick)
        received, self._received = self._received, []
        inputs = collector.collect(tick, time_ns, self.requests())
        outputs = self.firmware.pipeline.step(inputs)
        frames = self.firmware.encoder.frames(outputs)
        for bus, frame in frames:
            self.ports[bus].send(frame)
        for observer in self.observers:
            observer(received, sync + frames, inputs, outputs)
        return outputs

    def _gather(self, tick: int, close_ns: int) -> None:
        """Takes frames until every module has answered this tick, or until `close_ns`."""
        collector = self.firmware.collector
        while True:
            for bus, port in enumerate(self.ports):
                for frame in port.receive():
                    collector.take(bus, frame)
                    self._received.append((bus, frame))
            if collector.all_answered(tick) or self.clock.now_ns() >= close_ns:
                return
            self._wait(close_ns)

    def _wait(self, close_ns: int) -> None:
        """Blocks until something comes, or until `close_ns`; with several buses it looks at each in turn."""
        if len(self.ports) == 1:
            self.ports[0].wait(close_ns)
        else:
            for port in self.ports:
                port.wait(min(close_ns, self.clock.now_ns() + SEVERAL_BUSES_NS))


SEVERAL_BUSES_NS = 200_000
"""How long one of several buses is waited for before the next is looked at."""
