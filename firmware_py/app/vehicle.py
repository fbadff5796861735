"""The process on the vehicle: `modcube run`. It stays disarmed until it is told otherwise, and disarms before it ends."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from firmware_py.app.configuration import configuration_of
from firmware_py.app.deadlines import Summary, recording_times, summary_of
from firmware_py.app.firmware import BusFrame, Firmware, compose, vehicles_of
from firmware_py.app.live_view import LiveView
from firmware_py.app.lockstep import Observer
from firmware_py.app.realtime import open_loop
from firmware_py.app.service import reporting
from firmware_py.core.transitions import ARMED
from firmware_py.core.types import Action, Event, Inputs, Outputs, Request
from firmware_py.description.fleet import Fleet
from firmware_py.description.parameters import Parameters, load_parameters
from firmware_py.ground.config import GroundConfig
from firmware_py.runtime.notify import Notifier
from firmware_py.runtime.rate_keeper import RateKeeper
from firmware_py.runtime.realtime import (
    GROUND_PRIORITY,
    TICK_PRIORITY,
    beside_the_tick,
    quiet_garbage,
    real_time,
    release_compiler,
    use_priority,
)
from firmware_py.runtime.recorder import Recorder
from firmware_py.runtime.worker import ThreadWorker

if TYPE_CHECKING:
    from firmware_py.app.ground_station import GroundSide

FAREWELL_TICKS = 10
"""Ticks that go on saying `disarmed` after a stop was asked for."""
ARM_EVERY_S = 1.0
"""How often arming is tried again with `--hold`, once the pose is known."""
FLUSH_EVERY_S = 0.5


@dataclass(slots=True)
class Operator:
    """Stands in for a person: arms and holds when told to, and disarms when the process is asked to stop."""

    rate_hz: int
    hold: bool
    stopping: bool = False
    farewell: int = 0
    _ticks: int = 0
    _next_try: int = 0

    def requests(self, time_ns: int, last: Outputs | None) -> list[Request]:
        """The requests of this tick."""
        self._ticks += 1
        if self.stopping:
            self.farewell += 1
            bodies = [record.body for record in last.records] if last is not None else []
            return [Request(Action.DISARM, body) for body in bodies] if self.farewell == 1 else []
        if not self.hold or last is None or self._ticks < self._next_try:
            return []
        ready = [record.body for record in last.records if record.state not in ARMED and record.estimate.ready]
        if ready:
            self._next_try = self._ticks + round(ARM_EVERY_S * self.rate_hz)
        return [Request(Action.ARM, body) for body in ready]

    def is_done(self, tick: int, outputs: Outputs) -> bool:
        """Whether every module has been told for long enough."""
        return self.farewell >= FAREWELL_TICKS


def run_vehicle(
    fleet: Fleet,
    parameters: Parameters,
    hold: bool = False,
    out: Path | None = None,
    say: Callable[[str], None] = print,
    notifier: Notifier | None = None,
    ground: GroundConfig | None = None,
    live: LiveView | None = None,
) -> Summary:
    """Runs the firmware against the clock until SIGINT or SIGTERM. Raises DescriptionError and PortError before the first tick.

    Args:
        hold: arm as soon as the vehicle may, and hold the place.
        out: folder for the logs; None keeps none.
        say: told every event, one line each.
        notifier: of the service manager.
        live: serves the log's channels and a scene to viewers.
        ground: links to ground stations; parameters that they stored earlier take the place of `parameters`.
    """
    if ground is not None and ground.parameter_file is not None and ground.parameter_file.exists():
        parameters = load_parameters(ground.parameter_file)
    release_compiler()
    with ExitStack() as stack:
        move_to_own_processor = stack.enter_context(beside_the_tick())
        worker = ThreadWorker()
        stack.callback(worker.close)
        firmware = compose(fleet, parameters, worker=worker)
        operator = Operator(fleet.rate_hz, hold)
        observers: list[Observer] = []
        recorder = _open_recorder(stack, firmware, out, live)
        if recorder is not None:
            observers.append(recording(recorder, fleet.rate_hz))
        if live is not None:
            observers.append(live.drawing(fleet, vehicles_of(fleet), lambda: firmware.pipeline.bodies))
        observers.append(telling(say))  # after the recorder, which may have something to say
        requests: Callable[[int, Outputs | None], list[Request]] = operator.requests
        side: GroundSide | None = None
        if ground is not None:
            from firmware_py.app.ground_station import GroundSide  # a tenth of a second, and 6 MB of messages

            # Like the recorder's and the live view's, its threads start before this one takes its priority, which they would inherit.
            side = stack.enter_context(GroundSide(ground, firmware, priority=GROUND_PRIORITY))
            observers.append(side.observe)
            requests = with_ground(operator, side)
        for line in stack.enter_context(real_time()):
            say(f"warning: {line}")
        loop = open_loop(stack, firmware, requests)
        loop.observers = [*observers, *_watching(loop.rate_keeper, fleet.rate_hz, recorder, side, notifier)]
        use_priority(TICK_PRIORITY)
        move_to_own_processor()
        loop.listen()
        stack.enter_context(_stopping_by_signal(operator))
        stack.enter_context(quiet_garbage())
        say(f"running at {fleet.rate_hz} Hz on {', '.join(fleet.buses)}")
        loop.run(operator.is_done)
        if recorder is not None and loop.last is not None:
            recorder.record_times(loop.last.tick, loop.last.time_ns, loop.rate_keeper)
        return summary_of(loop)


def _open_recorder(stack: ExitStack, firmware: Firmware, out: Path | None, live: LiveView | None) -> Recorder | None:
    """The recorder for a folder, for viewers, or for both."""
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    elif live is None:
        return None
    configuration = configuration_of(firmware, rate_hz=firmware.fleet.rate_hz)
    recorder = Recorder(out, configuration, live.context if live is not None else None, queued=True)
    stack.callback(recorder.close)
    for body in firmware.pipeline.bodies:
        recorder.expect(body.index, body.thrusters.f_max.size)
    return recorder


def _watching(
    keeper: RateKeeper, rate_hz: int, recorder: Recorder | None, side: GroundSide | None, notifier: Notifier | None
) -> Iterator[Observer]:
    """How ticks keep their deadlines, for the log, ground stations and the service manager."""
    if side is not None:
        side.keeper = keeper
    if recorder is not None:
        yield recording_times(recorder, keeper, rate_hz)
    if notifier is not None and notifier.is_heard:
        yield reporting(notifier, keeper, rate_hz)


def with_ground(operator: Operator, side: GroundSide) -> Callable[[int, Outputs | None], list[Request]]:
    """The operator's requests and those of ground stations; a reboot that was asked for ends the process, the service starts it anew."""

    def requests(time_ns: int, last: Outputs | None) -> list[Request]:
        operator.stopping = operator.stopping or side.reboot_asked
        return [*operator.requests(time_ns, last), *side.requests()]

    return requests


def telling(say: Callable[[str], None]) -> Observer:
    """An observer that says every event."""

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        for event in outputs.events:
            say(event_line(outputs.time_ns, event))

    return observe


def event_line(time_ns: int, event: Event) -> str:
    """One event as a line."""
    return f"{time_ns * 1e-9:9.3f} s  {event.text}"


def recording(recorder: Recorder, rate_hz: int) -> Observer:
    """An observer that writes every tick to `recorder`, in the order in which frames went over the bus."""
    flush_every = max(1, round(FLUSH_EVERY_S * rate_hz))

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        buses = sorted({bus for bus, _ in sent})
        syncs = len(buses)
        for bus in buses:
            recorder.sent(outputs.time_ns, bus, [f for b, f in sent[:syncs] if b == bus])
            recorder.received(outputs.time_ns, bus, [f for b, f in received if b == bus])
            recorder.sent(outputs.time_ns, bus, [f for b, f in sent[syncs:] if b == bus])
        recorder.record(inputs, outputs)
        if outputs.tick % flush_every == 0:
            outputs.events += recorder.flush()

    return observe


@contextmanager
def _stopping_by_signal(operator: Operator) -> Iterator[None]:
    """SIGINT and SIGTERM ask for a stop instead of killing the process."""

    def stop(number: int, frame: object) -> None:
        operator.stopping = True

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
