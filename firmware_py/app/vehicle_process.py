"""The process on the vehicle: `modcube run`. It stays disarmed until it is asked to arm, and disarms before it ends."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from firmware_py.app.configuration import configuration_of
from firmware_py.app.deadlines import Summary, recording_times, summary_of
from firmware_py.app.estop_note import EstopNote, estop_stands, noting_estop
from firmware_py.app.firmware import Firmware, compose, vehicles_of
from firmware_py.app.last_flight import RECENT_NS, LastFlight, last_flight, outdate, to_arm
from firmware_py.app.live_view import LiveView
from firmware_py.app.observers import Observer, recording, recording_buses, telling, watching_buses
from firmware_py.app.realtime import RealTimeLoop, open_loop
from firmware_py.app.service import reporting
from firmware_py.core.body import Body
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Outputs, Request
from firmware_py.description.fleet import Fleet
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.stored_parameters import stored_line, with_stored_values
from firmware_py.runtime.clock import boot_id, unix_ns
from firmware_py.runtime.interrupts import endings_of_a_run, handled
from firmware_py.runtime.log_folder import make_log_folder
from firmware_py.runtime.notify import Notifier
from firmware_py.runtime.realtime import (
    GROUND_PRIORITY,
    TICK_PRIORITY,
    beside_the_tick,
    quiet_garbage,
    read_libraries,
    real_time,
    release_compiler,
    use_priority,
)
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG, Recorder
from firmware_py.runtime.teller import Teller, write_line
from firmware_py.runtime.worker import ThreadWorker

if TYPE_CHECKING:
    from firmware_py.app.ground_station import GroundSide

FAREWELL_TICKS = 10
"""Ticks that still command `disarmed` after a stop was requested."""
ARM_EVERY_S = 1.0
"""Interval between attempts of the Operator to arm, once the pose is known."""
FORGETFUL = "warning: --hold without --out: an e-stop in this run will not be known at the next start"
UNTAGGED = "warning: module {} carries no [[tag]]: no camera places it, so --hold never arms it; a pilot has attitude and depth alone"
UNUSABLE_FOLDER_ERRORS = (FileExistsError, NotADirectoryError, PermissionError)
"""Errors of a log folder that is not a folder or not writable for us; these refuse the start. After other disk errors it flies unlogged."""
STOP_ACTIONS = frozenset({Action.DISARM, Action.ESTOP})
"""Requests of a person after which only a person arms any body."""
TAKEOVER_ACTIONS = frozenset({Action.SET_MODE, Action.ARM, Action.MOTOR_TEST})
"""Requests of a person after which only a person arms the body concerned."""
REARM_S = RECENT_NS / 1e9
"""How long REARM keeps trying. After that the previous flight no longer tells where the vehicle is, as with a log of that age."""


@dataclass(slots=True)
class Operator:
    """Stands in for a person: arms each body in `to_arm` once, to hold its place, and disarms all when the process is asked to stop."""

    rate_hz: int
    to_arm: set[int] = field(default_factory=set)
    """Fleet indices of modules that are still to be armed. A body is armed if its leader is among them; a module is removed as soon as it
    is armed, by whatever request."""
    limit_s: float = math.inf
    """Time, counted in ticks, after which `to_arm` expires."""
    say: Callable[[str], None] = write_line
    stopping: bool = False
    farewell: int = 0
    _ticks: int = 0
    _next_try: int = 0

    def requests(self, time_ns: int, last: Outputs | None) -> list[Request]:
        """The requests of this tick."""
        self._ticks += 1
        if self.stopping:
            self.farewell += 1  # every body is disarmed in each of these ticks, because a body may be new since the last
            return [Request(Action.DISARM, record.body) for record in last.records] if last is not None else []
        if not self.to_arm or last is None:
            return []
        self._strike_out(last)
        self._expire()
        placed = [record.body for record in last.records if record.body in self.to_arm and record.estimate.placed]
        if not placed or self._ticks < self._next_try:
            return []
        self._next_try = self._ticks + round(ARM_EVERY_S * self.rate_hz)
        return [Request(Action.ARM, body) for body in placed]

    def _strike_out(self, last: Outputs) -> None:
        """Removes modules that have been armed, and after an e-stop all: from then on only a person arms them."""
        self.to_arm.difference_update(index for index, command in enumerate(last.modules) if command.armed)
        if any(record.state == State.ESTOP for record in last.records):
            self.to_arm.clear()

    def _expire(self) -> None:
        """Gives up arming after `limit_s`: by then the vehicle may be in somebody's hands."""
        if self.to_arm and self._ticks >= self.limit_s * self.rate_hz:
            self.to_arm.clear()
            self.say(f"not armed again: the vehicle could not within {self.limit_s:g} s (REARM)")

    def stop(self, *_: object) -> None:
        """Signal handler: starts the farewell."""
        self.stopping = True

    def is_done(self, tick: int, outputs: Outputs) -> bool:
        """Whether the farewell has lasted FAREWELL_TICKS."""
        return self.farewell >= FAREWELL_TICKS


def run_vehicle(
    fleet: Fleet,
    parameters: Parameters,
    hold: bool = False,
    out: Path | None = None,
    say: Callable[[str], None] = write_line,
    notifier: Notifier | None = None,
    ground: GroundConfig | None = None,
    live: LiveView | None = None,
) -> Summary:
    """Runs the firmware against the clock until SIGINT, SIGTERM or SIGHUP. Raises DescriptionError and PortError before the first tick.

    Args:
        hold: arm as soon as the vehicle may, and hold the place.
        out: folder for the logs; None keeps none. Existing logs are kept.
        say: receives every event as one line, in its own thread; it may block and fail.
        notifier: of the service manager.
        live: serves the log's channels and a scene to viewers.
        ground: links to ground stations; parameters that they stored earlier are laid over `parameters`.
    """
    store = ground.parameter_file if ground is not None else None
    laid = with_stored_values(parameters, store)
    release_compiler()
    with ExitStack() as stack:
        teller = Teller(say)  # before this thread takes its priority, like every thread below that does not belong to the loop
        stack.callback(teller.close)
        move_to_own_processor = stack.enter_context(beside_the_tick())
        worker = ThreadWorker()
        stack.callback(worker.close)
        if line := stored_line(parameters, laid, store):
            teller.say(line)
        firmware = compose(fleet, laid, worker=worker)
        boot = boot_id()
        before = last_flight(out, fleet, firmware.codec, unix_ns(), boot) if out is not None else LastFlight()
        operator = Operator(fleet.rate_hz, to_arm(before, firmware, hold, teller.say), math.inf if hold else REARM_S, teller.say)
        if hold and out is None:
            teller.say(FORGETFUL)
        for body in firmware.pipeline.bodies:
            if not body.tag_ids.size:
                teller.say(UNTAGGED.format(" and ".join(map(fleet.label, body.modules))))
        stack.enter_context(handled(operator.stop, endings_of_a_run()))  # until the log and the e-stop note below are closed
        note = _open_note(stack, out) if out is not None else None  # before the log: of two processes started at once, one gets the folder
        notes = {"boot": boot, "apart": sorted(before.apart(firmware))}
        recorder = _open_recorder(stack, configuration_of(firmware, rate_hz=fleet.rate_hz, **notes), firmware, out, live, teller.say)
        observers = list(_recording_observers(firmware, recorder, note, live, before.stopped))
        told: list[Observer] = [telling(teller.say)]  # called after all other observers, which may add events
        requests: Callable[[int, Outputs | None], list[Request]] = operator.requests
        side: GroundSide | None = None
        if ground is not None:
            from firmware_py.app.ground_station import GroundSide  # costs a tenth of a second, and 6 MB of message classes

            # As with the recorder and the live view, its threads start before this thread takes its priority, which they would inherit.
            side = stack.enter_context(GroundSide(ground, firmware, priority=GROUND_PRIORITY, started=parameters))
            told.append(side.observe)
            requests = with_ground(operator, side, lambda: firmware.pipeline.bodies)
        read_libraries()
        for line in stack.enter_context(real_time()):
            teller.say(f"warning: {line}")
        loop = open_loop(stack, firmware, requests)
        buses = watching_buses(loop.ports, fleet.rate_hz)
        loop.observers = [*observers, *_timing_observers(loop, fleet.rate_hz, recorder, side, notifier), buses, *told]
        use_priority(TICK_PRIORITY)
        move_to_own_processor()
        loop.listen()
        if out is not None and estop_stands(out) and not before.stopped:
            raise DescriptionError(f"{out}: an e-stop was raised while this process started, by one that ran until then; start it again")
        if operator.stopping:  # asked before the first tick
            return summary_of(loop)
        stack.enter_context(quiet_garbage())
        teller.say(f"messages count modules from 0: {', '.join(f'{k} is number {fleet.label(k)}' for k in range(len(fleet.module)))}")
        teller.say(f"running at {fleet.rate_hz} Hz on {', '.join(fleet.buses)}")
        if notifier is not None:
            stack.callback(notifier.send, "STOPPING=1")  # the first of what ends: now TimeoutStopSec counts, and no longer the watchdog
        loop.run(operator.is_done)
        if recorder is not None and loop.last is not None:
            recorder.record_times(loop.last.tick, loop.last.time_ns, loop.rate_keeper)
        return summary_of(loop)


def _open_note(stack: ExitStack, out: Path) -> EstopNote:
    """The e-stop note in the folder for logs, which it locks. Raises DescriptionError where another process holds the lock."""
    with suppress(OSError):  # reported when the log is opened there
        out.mkdir(parents=True, exist_ok=True)
    note = EstopNote(out)
    stack.callback(note.close)
    return note


def _recording_observers(
    firmware: Firmware, recorder: Recorder | None, note: EstopNote | None, live: LiveView | None, stopped: bool
) -> Iterator[Observer]:
    """Observers for the log, the e-stop note (`stopped`: an e-stop stands from before) and the live view."""
    fleet = firmware.fleet
    if recorder is not None:
        yield recording(recorder, fleet.rate_hz)
    if note is not None:
        yield noting_estop(note, stopped, recorder)
    if live is not None:
        yield live.drawing(fleet, vehicles_of(fleet), lambda: firmware.pipeline.bodies)


def _open_recorder(
    stack: ExitStack, configuration: Mapping[str, Any], firmware: Firmware, out: Path | None, live: LiveView | None,
    say: Callable[[str], None],
) -> Recorder | None:  # fmt: skip
    """The recorder for a folder, for viewers, or for both."""
    folder = _log_folder(out, say) if out is not None else None
    if folder is None and live is None:
        return None
    recorder = Recorder(folder, configuration, live.context if live is not None else None, queued=True)
    if folder is not None and out is not None:
        stack.callback(_forget_failed_start, recorder, folder, out)
        try:
            recorder.check()
        except OSError:
            outdate(out, unix_ns())
    stack.callback(recorder.close)
    for body in firmware.pipeline.bodies:
        recorder.expect(body.index, body.thrusters.f_max.size)
    return recorder


def _log_folder(out: Path, say: Callable[[str], None]) -> Path | None:
    """A folder for a new log; None where a disk error prevents it. Raises one of UNUSABLE_FOLDER_ERRORS where `out` is no usable folder."""
    try:
        return make_log_folder(out)
    except UNUSABLE_FOLDER_ERRORS:
        raise
    except OSError as error:
        say(f"warning: no log: {error.filename or out}: {error.strerror}")
        outdate(out, unix_ns())
        return None


def _forget_failed_start(recorder: Recorder, folder: Path, out: Path) -> None:
    """Deletes the log of a start that reached no tick: a service that waits for its bus restarts again and again."""
    if recorder.ticks:
        return
    with suppress(OSError):
        for name in (CAN_LOG, SIGNAL_LOG):
            (folder / name).unlink(missing_ok=True)
        if folder != out:
            folder.rmdir()


def _timing_observers(
    loop: RealTimeLoop, rate_hz: int, recorder: Recorder | None, side: GroundSide | None, notifier: Notifier | None
) -> Iterator[Observer]:
    """Observers that report tick timing to the log, ground stations and the service manager, and port fault counters to the log."""
    keeper = loop.rate_keeper
    if side is not None:
        side.keeper = keeper
    if recorder is not None:
        yield recording_times(recorder, keeper, rate_hz)
        yield recording_buses(recorder, loop.ports, rate_hz)
    if notifier is not None and notifier.is_heard:
        yield reporting(notifier, keeper, rate_hz)


def with_ground(
    operator: Operator, side: GroundSide, bodies: Callable[[], Sequence[Body]]
) -> Callable[[int, Outputs | None], list[Request]]:
    """The requests of the operator and of ground stations. A requested reboot ends the process, which the service then restarts.

    After a ground station disarms or stops the vehicle, the operator arms nothing any more; a body that a ground station arms, motor-tests
    or gives a mode is left to it. During the farewell only disarm and e-stop requests are accepted.
    """

    def requests(time_ns: int, last: Outputs | None) -> list[Request]:
        operator.stopping = operator.stopping or side.reboot_asked
        asked = [request for request in side.requests() if request.action in STOP_ACTIONS or not operator.stopping]
        if any(request.action in STOP_ACTIONS for request in asked):
            operator.to_arm.clear()
        taken = {request.body for request in asked if request.action in TAKEOVER_ACTIONS}
        operator.to_arm.difference_update(taken, *(body.modules for body in bodies() if body.index in taken))
        return [*operator.requests(time_ns, last), *asked]

    return requests
