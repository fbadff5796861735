"""The process on the vehicle: `modcube run`. It stays disarmed until it is asked to arm, and disarms before it ends."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from firmware_py.app.configuration import configuration_of
from firmware_py.app.deadlines import Summary, recording_times, summary_of
from firmware_py.app.estop_note import EstopNote, estop_stands, noting_estop
from firmware_py.app.firmware import Firmware, compose, vehicles_of
from firmware_py.app.last_flight import LastFlight, last_flight, outdate, to_arm
from firmware_py.app.live_view import LiveView
from firmware_py.app.observers import Observer, recording, recording_buses, telling, watching_bus, watching_frames
from firmware_py.app.operator import REARM_S, Operator, with_ground
from firmware_py.app.realtime import RealTimeLoop, open_loop
from firmware_py.app.service import reporting
from firmware_py.description.fleet import Fleet, module_number
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

FORGETFUL = "warning: --hold without --out: an e-stop in this run will not be known at the next start"
PITCH = (
    "warning: pitch_m of the fleet is {:g} m, but hulls measure {} m between their docking faces: modules dock one pitch_m apart, "
    "and give up as jams what is nearer or farther"
)
UNTAGGED = "warning: module {} carries no [[tag]]: no camera places it, so --hold never arms it; a pilot has attitude and depth alone"
UNUSABLE_FOLDER_ERRORS = (FileExistsError, NotADirectoryError, PermissionError)
"""Errors of a log folder that is not a folder or not writable for us; these refuse the start. After other disk errors it flies unlogged."""


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
        # Threads that do not belong to the loop start before this thread takes its priority, which they would inherit.
        teller = Teller(say)
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
        _warn_of_untagged(firmware, teller.say)
        _warn_of_pitch(firmware, teller.say)
        stack.enter_context(handled(operator.stop, endings_of_a_run()))  # until the log and the e-stop note are closed
        logs = _open_logs(stack, firmware, before, boot, out, live, teller.say)
        side = _open_ground(stack, ground, firmware, parameters) if ground is not None else None
        loop = _prepare_loop(stack, firmware, operator, side, teller.say)
        loop.observers = _observers(loop, logs, side, notifier, teller.say)
        use_priority(TICK_PRIORITY)
        move_to_own_processor()
        loop.listen()
        if out is not None and estop_stands(out) and not before.stopped:
            raise DescriptionError(f"{out}: an e-stop was raised while this process started, by one that ran until then; start it again")
        if not operator.stopping:  # else asked before the first tick
            _run_loop(stack, loop, operator, logs.recorder, notifier, teller.say)
        return summary_of(loop)


class _Logs(NamedTuple):
    """What a run leaves behind."""

    recorder: Recorder | None
    observers: list[Observer]
    """They write the log and the e-stop note, and serve the live view."""


def _warn_of_untagged(firmware: Firmware, say: Callable[[str], None]) -> None:
    for body in firmware.pipeline.bodies:
        if not body.tag_ids.size:
            say(UNTAGGED.format(" and ".join(map(firmware.fleet.label, body.modules))))


def _warn_of_pitch(firmware: Firmware, say: Callable[[str], None]) -> None:
    """Hulls of docked modules touch, unless something sticks out of them."""
    pitch_m, tolerance_m = firmware.fleet.pitch_m, firmware.parameters.docking.position_tolerance_m
    dockers = [vehicle.docking_edges_m for vehicle in firmware.vehicles if vehicle.docking_edges_m]
    odd = sorted(edge for edge in set[float]().union(*dockers) if abs(edge - pitch_m) > tolerance_m)
    if len(dockers) > 1 and odd:
        say(PITCH.format(pitch_m, " and ".join(f"{edge:g}" for edge in odd)))


def _open_logs(
    stack: ExitStack, firmware: Firmware, before: LastFlight, boot: str, out: Path | None, live: LiveView | None,
    say: Callable[[str], None],
) -> _Logs:  # fmt: skip
    """The e-stop note and the recorder, which `stack` closes. Raises DescriptionError where another process writes into `out`."""
    note = _open_note(stack, out) if out is not None else None  # before the log: of two processes started at once, one gets the folder
    configuration = configuration_of(firmware, rate_hz=firmware.fleet.rate_hz, boot=boot, apart=sorted(before.apart(firmware)))
    recorder = _open_recorder(stack, configuration, firmware, out, live, say)
    return _Logs(recorder, list(_recording_observers(firmware, recorder, note, live, before.stopped)))


def _open_ground(stack: ExitStack, ground: GroundConfig, firmware: Firmware, started: Parameters) -> GroundSide:
    """The links to ground stations, which `stack` closes; `started`: the parameters without those that ground stations stored."""
    from firmware_py.app.ground_station import GroundSide  # costs a tenth of a second, and 6 MB of message classes

    return stack.enter_context(GroundSide(ground, firmware, priority=GROUND_PRIORITY, started=started))


def _prepare_loop(
    stack: ExitStack, firmware: Firmware, operator: Operator, side: GroundSide | None, say: Callable[[str], None]
) -> RealTimeLoop:
    """The loop, in a process set up for real time until `stack` ends. Raises PortError."""
    requests = operator.requests if side is None else with_ground(operator, side, lambda: firmware.pipeline.bodies)
    read_libraries()
    for line in stack.enter_context(real_time()):
        say(f"warning: {line}")
    return open_loop(stack, firmware, requests)


def _observers(
    loop: RealTimeLoop, logs: _Logs, side: GroundSide | None, notifier: Notifier | None, say: Callable[[str], None]
) -> list[Observer]:
    """All observers of the loop. Those that pass events on come last, because the others may add some."""
    rate_hz = loop.firmware.fleet.rate_hz
    watching = *(watching_bus(port, rate_hz) for port in loop.ports), watching_frames(loop.firmware.collector, rate_hz)
    told = [telling(say)] if side is None else [telling(say), side.observe]
    return [*logs.observers, *_timing_observers(loop, logs.recorder, side, notifier), *watching, *told]


def _run_loop(
    stack: ExitStack, loop: RealTimeLoop, operator: Operator, recorder: Recorder | None, notifier: Notifier | None,
    say: Callable[[str], None],
) -> None:  # fmt: skip
    """Runs the loop until the operator has said farewell."""
    fleet = loop.firmware.fleet
    stack.enter_context(quiet_garbage())
    renumbered = [label for k in range(len(fleet.module)) if (label := fleet.label(k)) != f"{module_number(k)}"]
    if renumbered:
        say(f"texts and commands count modules in the order of the fleet file: {', '.join(renumbered)}")
    say(f"running at {fleet.rate_hz} Hz on {', '.join(fleet.buses)}")
    if notifier is not None:
        stack.callback(notifier.send, "STOPPING=1")  # the first of what ends: now TimeoutStopSec counts, and no longer the watchdog
    loop.run(operator.is_done)
    if recorder is not None and loop.last is not None:
        recorder.record_times(loop.last.tick, loop.last.time_ns, loop.rate_keeper)


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
    loop: RealTimeLoop, recorder: Recorder | None, side: GroundSide | None, notifier: Notifier | None
) -> Iterator[Observer]:
    """Observers that report tick timing to the log, ground stations and the service manager, and port fault counters to the log."""
    keeper, rate_hz = loop.rate_keeper, loop.firmware.fleet.rate_hz
    if side is not None:
        side.keeper = keeper
    if recorder is not None:
        yield recording_times(recorder, keeper, rate_hz)
        yield recording_buses(recorder, loop.ports, rate_hz)
    if notifier is not None and notifier.is_heard:
        yield reporting(notifier, keeper, rate_hz)
