"""Real time: ticks start at absolute deadlines; the inputs of a tick close when every module has answered, or at half the period."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

from firmware_py.app.firmware import BusFrame, Firmware
from firmware_py.app.observers import Observer
from firmware_py.bus.port import Port, PortError, open_port
from firmware_py.core.types import WARNING, Event, Inputs, Outputs, Request
from firmware_py.runtime.clock import MonotonicClock
from firmware_py.runtime.rate_keeper import RateKeeper, absolute_sleeper

LISTEN_NS = 200_000_000
"""How long the buses are monitored before the first SYNC. A foreign SYNC makes the start fail."""
OTHER_SYNC = "another SYNC producer is on the bus: stop it, or use another bus"


@dataclass(slots=True)
class RealTimeLoop:
    """Runs the firmware against the clock.

    Attributes:
        requests: returns the requests since the last tick, given the time of this tick and the outputs of the last.
        observers: an observer that raises is dropped, with a warning in the tick's events for those after it.
        unanswered: number of ticks that closed at half the period because a module had not answered.
        last: outputs of the last tick.
    """

    firmware: Firmware
    ports: Sequence[Port]
    clock: MonotonicClock
    rate_keeper: RateKeeper
    requests: Callable[[int, Outputs | None], Sequence[Request]]
    observers: Sequence[Observer] = ()
    unanswered: int = 0
    last: Outputs | None = None
    _received: list[BusFrame] = field(default_factory=list)
    _skipped: int = 0
    """Deadlines that were skipped before the last tick."""

    def listen(self) -> None:
        """Listens before the first SYNC and discards what it received. Raises PortError when another node sends SYNC."""
        end_ns = self.clock.now_ns() + LISTEN_NS
        collector = self.firmware.collector
        self.ports[0].wait(end_ns, lambda: self._take() and collector.faults["foreign_sync"] > 0)
        self._take()
        self._received.clear()
        if collector.faults["foreign_sync"]:
            raise PortError(OTHER_SYNC)
        self.firmware.discard_received()

    def run(self, stop: Callable[[int, Outputs], bool], first_tick: int = 1) -> None:
        """Ticks until `stop` returns true for a tick's number and outputs."""
        tick = first_tick
        while True:
            outputs = self.tick(tick, self.rate_keeper.wait())
            self.rate_keeper.finish()
            if stop(tick, outputs):
                return
            tick += 1

    def tick(self, tick: int, time_ns: int) -> Outputs:
        """One tick that starts at `time_ns` on the loop's clock."""
        sync = self.firmware.sync(tick, time_ns)
        self._send(sync)
        collector = self.firmware.collector
        close_ns = self._answers_from(time_ns) + self.firmware.fleet.period_ns // 2
        in_time = self.ports[0].wait(close_ns, lambda: self._take() and collector.all_answered(tick))
        self.unanswered += not in_time
        received, self._received = self._received, []
        inputs = collector.collect(tick, time_ns, list(self.requests(time_ns, self.last)))
        outputs = self.firmware.tick(inputs)
        frames = self.firmware.frames(outputs)
        self._send(frames)
        self._show(received, sync + frames, inputs, outputs)
        self.last = outputs
        return outputs

    def _answers_from(self, time_ns: int) -> int:
        """When the modules' time to answer begins: with the tick, or with its SYNC if the process was held up. Such a tick starts up to a
        period late, and would close without any answer, as if modules and sensors had been lost.
        """
        before, self._skipped = self._skipped, self.rate_keeper.skipped
        return time_ns if self._skipped == before else self.clock.now_ns()

    def _show(self, received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        """Calls every observer; drops one that raises, because the flight matters more."""
        for observer in self.observers:
            try:
                observer(received, sent, inputs, outputs)
            except Exception as error:
                self.observers = [other for other in self.observers if other is not observer]
                outputs.events.append(Event(WARNING, f"no more {_name_of(observer)}: {type(error).__name__}: {error}"))

    def _take(self) -> bool:
        """Hands every frame received so far to the collector; returns True."""
        for bus, port in enumerate(self.ports):
            frames = port.receive()
            self.firmware.collector.take(bus, frames)
            self._received += [(bus, frame) for frame in frames]
        return True

    def _send(self, frames: Sequence[BusFrame]) -> None:
        for bus, frame in frames:
            self.ports[bus].send(frame)


def _name_of(observer: Observer) -> str:
    """Name of the function that made the observer, or of its class."""
    return getattr(observer, "__qualname__", type(observer).__name__).partition(".")[0]


def open_loop(
    stack: ExitStack, firmware: Firmware, requests: Callable[[int, Outputs | None], Sequence[Request]]
) -> RealTimeLoop:
    """A loop on the fleet's buses; `stack` closes the ports. Raises PortError."""
    clock = MonotonicClock.started_now()
    arrival = threading.Event()
    ports = [
        stack.enter_context(open_port(bus, reader=True, now_ns=clock.now_ns, arrival=arrival)) for bus in firmware.fleet.buses
    ]
    sleep = absolute_sleeper(clock)
    keeper = RateKeeper(firmware.fleet.period_ns, clock, lambda deadline_ns: sleep(deadline_ns + clock.origin_ns))
    return RealTimeLoop(firmware, ports, clock, keeper, requests)
