"""The vehicle's process on a bus where nobody answers: what it says, where it logs, how it starts and ends."""

import dataclasses
import errno
import os
import re
import signal
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.app import vehicle
from firmware_py.app.estop_note import NOTE, EstopNote, estop_stands, noting_estop, write_note
from firmware_py.app.firmware import compose
from firmware_py.app.last_flight import last_flight, to_arm
from firmware_py.app.observers import recording
from firmware_py.app.realtime import RealTimeLoop
from firmware_py.app.vehicle import FORGETFUL, Operator, run_vehicle
from firmware_py.bus.codec import Codec, Frame
from firmware_py.bus.port import PortError
from firmware_py.bus.port.links import VirtualLink
from firmware_py.cli import main
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Event, Inputs, ModuleCommand, Outputs, Request
from firmware_py.description.fleet import Fleet, Module, single
from firmware_py.description.parameters import Parameters, Supervision
from firmware_py.description.schema import DescriptionError
from firmware_py.runtime import teller
from firmware_py.runtime.clock import boot_id
from firmware_py.runtime.flight_log import FlightLog
from firmware_py.runtime.interrupts import endings_of_a_run, handled
from firmware_py.runtime.log_folder import make_log_folder
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG, Recorder
from tests.unit.ground_world import Robot
from tests.unit.test_last_flight import FLEET, dock_line, lines_of

REARM = Parameters(supervision=Supervision(rearm=1))
HOLDS = "the process before ended in flight: holding as soon as the vehicle may (REARM)"
LOGS = (CAN_LOG, SIGNAL_LOG)


def bus_of(path: Path) -> str:
    """A bus of this test's own."""
    return f"virtual:{path.name}"


def fly(
    tmp_path: Path, out: Path | None = None, then: Callable[[], None] = lambda: None, parameters: Parameters | None = None,
    fleet: Fleet | None = None, hold: bool = False, ending: signal.Signals = signal.SIGTERM,
) -> list[str]:  # fmt: skip
    """Starts, and asks for the end in the first tick. `then` is done by whoever says so. Returns what was said."""
    said: list[str] = []

    def say(line: str) -> None:
        said.append(line)
        if line.startswith("running at"):
            os.kill(os.getpid(), ending)
            then()

    run_vehicle(fleet or single(bus=bus_of(tmp_path)), parameters or Parameters(), hold=hold, out=out, say=say)
    return said


def test_second_signal_does_not_end_the_process_before_its_log_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fatal: list[int] = []
    close = Recorder.close

    def close_disturbed(recorder: Recorder) -> list[Event]:
        os.kill(os.getpid(), signal.SIGTERM)
        return close(recorder)

    monkeypatch.setattr(Recorder, "close", close_disturbed)
    with handled(lambda number, frame: fatal.append(number)):
        fly(tmp_path, tmp_path / "log")
    assert not fatal


def test_process_that_is_refused_a_folder_leaves_the_log_of_who_has_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two that start at once, both before either has a log there."""
    monkeypatch.setattr(vehicle, "make_log_folder", lambda out: out)
    note = EstopNote(tmp_path)
    log = Recorder(tmp_path, {})
    log.flush()
    before = content(tmp_path)
    with pytest.raises(DescriptionError, match="another vehicle that runs logs into"):
        fly(tmp_path, tmp_path)
    assert content(tmp_path) == before
    log.close()
    note.close()


def test_vehicle_whose_terminal_is_gone_ends_as_it_does_by_a_signal(tmp_path: Path) -> None:
    fatal: list[int] = []

    def die(number: int, frame: object) -> None:
        fatal.append(number)
        os.kill(os.getpid(), signal.SIGTERM)

    with handled(die, [signal.SIGHUP]):
        fly(tmp_path, ending=signal.SIGHUP)
    assert not fatal


def test_vehicle_that_is_told_to_ignore_the_end_of_its_terminal_does() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert signal.SIGHUP not in endings_of_a_run()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_vehicle_says_that_a_bus_takes_no_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(link: VirtualLink, bus: Any, frame: Frame) -> None:
        raise OSError(errno.ENOBUFS, "No buffer space available")

    def say(line: str) -> None:
        said.append(line)
        if "full" in line or "bus silent" in line:
            os.kill(os.getpid(), signal.SIGTERM)

    said: list[str] = []
    monkeypatch.setattr(VirtualLink, "send", refuse)
    run_vehicle(single(bus=bus_of(tmp_path)), Parameters(), say=say)
    assert any(re.search(f"bus {bus_of(tmp_path)}: in the last second [0-9]+ full$", line) for line in said)


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.slow
def test_tick_is_not_held_up_by_who_reads_its_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(teller, "CLOSE_S", 0.01)
    let, over = threading.Event(), threading.Event()

    def stall() -> None:
        assert threading.current_thread() is not threading.main_thread()
        let.wait()
        over.set()

    fly(tmp_path, then=stall)
    let.set()
    assert over.wait(10)


@pytest.mark.slow
def test_flight_goes_on_when_nobody_reads_its_lines_any_more(tmp_path: Path) -> None:
    def hang_up() -> None:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    assert fly(tmp_path, tmp_path / "log", hang_up)[-1].startswith("running at")
    assert len(list(FlightLog(tmp_path / "log").ticks())) >= 10  # the farewell


@pytest.mark.slow
def test_lines_are_said_by_an_ordinary_thread(tmp_path: Path) -> None:
    policies: list[int] = []
    fly(tmp_path, then=lambda: policies.append(os.sched_getscheduler(0)))
    assert policies == [os.SCHED_OTHER]


@pytest.mark.slow
def test_libraries_are_read_when_all_is_composed_and_before_the_first_tick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []

    def listed(name: str) -> None:
        step = getattr(vehicle, name)
        monkeypatch.setattr(vehicle, name, lambda *a, **k: (steps.append(name), step(*a, **k))[1])

    for name in ("compose", "read_libraries", "open_loop"):
        listed(name)
    fly(tmp_path)
    assert steps == ["compose", "read_libraries", "open_loop"]


@pytest.mark.slow
def test_log_of_the_process_before_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "log"
    fly(tmp_path, out)
    first = content(out)
    assert sorted(first) == sorted([*LOGS, NOTE])
    fly(tmp_path, out)
    fly(tmp_path, out)
    kept = content(out)
    assert sorted(kept) == sorted([*first, *(f"{n}/{name}" for n in ("0002", "0003") for name in LOGS)])
    assert {name: kept[name] for name in first} == first
    assert all(list(FlightLog(out / number).ticks()) for number in ("0002", "0003"))


@pytest.mark.parametrize("left", [CAN_LOG, SIGNAL_LOG, "0007"])
def test_new_log_is_newer_than_all_that_are_there(tmp_path: Path, left: str) -> None:
    (tmp_path / left).touch()
    (tmp_path / "notes.txt").touch()
    (tmp_path / "calibration-2026").mkdir()
    assert make_log_folder(tmp_path) == tmp_path / ("0008" if left == "0007" else "0002")


def test_folder_without_a_log_takes_the_first(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    assert make_log_folder(tmp_path) == tmp_path
    assert make_log_folder(tmp_path / "made" / "anew").is_dir()


@pytest.mark.slow
def test_start_that_failed_leaves_no_log_behind(tmp_path: Path) -> None:
    """A service that waits for its bus would fill the disk, and the log of the crash would not be the newest."""
    fly(tmp_path, tmp_path / "log")
    before = content(tmp_path / "log")
    for out in (tmp_path / "log", tmp_path):
        with pytest.raises(PortError):
            run_vehicle(single(bus="socketcan:nocan7"), Parameters(), out=out, say=lambda line: None)
    assert content(tmp_path / "log") == before
    assert [path.name for path in tmp_path.iterdir()] == ["log"]
    assert not (tmp_path / "log" / "0002").exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_vehicle_flies_without_log_where_the_disk_takes_no_folder(
    tmp_path: Path, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(Path, "mkdir", refuse)
    said = fly(tmp_path, tmp_path / "log")
    assert f"warning: no log: {tmp_path / 'log'}: {os.strerror(number)}" in said
    assert any(line.startswith("running at") for line in said)


def test_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "taken").touch()
    for out in (tmp_path / "taken", tmp_path / "taken" / "log"):
        with pytest.raises(OSError, match="taken") as refused:
            fly(tmp_path, out)
        assert refused.value.filename is not None  # the command line makes one line and status 2 of it


def in_flight(tmp_path: Path, more: str = "", modules: tuple[Module, ...] = FLEET.module) -> Fleet:
    """Leaves the log of a process that was killed in flight just now."""
    tmp_path.joinpath("log").mkdir()
    Recorder(tmp_path / "log", {"boot": boot_id()}).close()
    tmp_path.joinpath("log", CAN_LOG).write_text(lines_of([True] * 3) + more)
    return Fleet(module=modules, buses=(bus_of(tmp_path), f"{bus_of(tmp_path)}-b"))


@pytest.mark.slow
def test_process_killed_in_flight_holds_again_where_a_parameter_says_so(tmp_path: Path) -> None:
    fleet = in_flight(tmp_path)
    assert HOLDS in fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=fleet)
    assert (tmp_path / "log" / "0002" / CAN_LOG).exists()
    assert HOLDS not in fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=fleet)  # 0002 ended disarmed


@pytest.mark.slow
def test_process_killed_in_flight_waits_to_be_armed_otherwise(tmp_path: Path) -> None:
    fleet = in_flight(tmp_path)
    assert HOLDS not in fly(tmp_path, None, parameters=REARM, fleet=fleet)
    assert HOLDS not in fly(tmp_path, tmp_path / "log", fleet=fleet)


PAIR = dock_line(0, (1, 0, 0, 0, 0, 0)) + dock_line(1, (0, 1, 0, 0, 0, 0))
"""Face A of the first module and face B of the second pull."""
APART = (
    "warning: modules 1 on {bus}, 2 on {bus} were docked, or about to be, and their magnets let go: "
    "the fleet file has to say so (body, cell) before they fly as one or REARM arms them"
)


def docked(first: int, second: int) -> tuple[Module, ...]:
    """The fleet's modules, of which two start docked."""
    modules = list(FLEET.module)
    for x, index in enumerate((first, second)):
        modules[index] = dataclasses.replace(modules[index], body=0, cell=np.array([x, 0, 0]))
    return tuple(modules)


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [REARM, Parameters()])
def test_modules_that_docked_in_flight_are_named_and_not_armed_again(tmp_path: Path, parameters: Parameters) -> None:
    said = fly(tmp_path, tmp_path / "log", parameters=parameters, fleet=in_flight(tmp_path, PAIR))
    assert said[0] == APART.format(bus=bus_of(tmp_path))
    assert HOLDS not in said
    assert any(line.startswith("running at") for line in said)  # the start refuses nothing


@pytest.mark.slow
def test_modules_that_the_fleet_file_has_docked_hold_again(tmp_path: Path) -> None:
    said = fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=in_flight(tmp_path, PAIR, docked(0, 1)))
    assert said[0] == HOLDS


@pytest.mark.slow
def test_dock_at_another_face_than_the_fleet_files_is_none_of_its_joints(tmp_path: Path) -> None:
    said = fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=in_flight(tmp_path, PAIR, docked(1, 0)))
    assert said[0] == APART.format(bus=bus_of(tmp_path))
    assert HOLDS not in said


UNDOCKED = dock_line(0, (0,) * 6) + dock_line(1, (0,) * 6)


@pytest.mark.slow
@pytest.mark.parametrize("hold", [True, False])
def test_modules_that_were_undocked_in_flight_are_named_and_not_armed_as_one(
    tmp_path: Path, hold: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    to_arm: list[set[int]] = []

    def operator(rate_hz: int, modules: set[int], *others: Any) -> Operator:
        to_arm.append(set(modules))
        return Operator(rate_hz, modules, *others)

    monkeypatch.setattr(vehicle, "Operator", operator)
    fleet = in_flight(tmp_path, PAIR + UNDOCKED, docked(0, 1))
    said = fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=fleet, hold=hold)
    bus = bus_of(tmp_path)
    assert said[0].startswith(f"warning: modules 1 on {bus}, 2 on {bus} were told to let go of joints that the fleet file has: ")
    assert to_arm == [set()]
    assert HOLDS not in said
    again = fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=fleet, hold=hold)
    assert again[0] == said[0], "it is as true at the second restart"
    assert to_arm == [set(), set()]


@pytest.mark.slow
def test_relays_of_single_modules_are_no_undock(tmp_path: Path) -> None:
    assert fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=in_flight(tmp_path, UNDOCKED))[0] == HOLDS


ARMS_NOBODY = (
    "warning: the e-stop of the flight before was not cleared: nobody is armed without a person, "
    "who arms, sends CLEAR_ESTOP, or without a ground station types modcube clear-estop FOLDER (that of --out) before the next start"
)
OLD_NS = 1_000_000_000 * 86_400
Told = tuple[State, list[Request]]


def stopped(folder: Path, *told: Told, before: bool = False) -> None:
    """The log of a process whose one body was in such states, each in a tick in which so much was asked for, and which then was killed."""
    log = make_log_folder(folder)
    recorder = Recorder(log, {})
    note = EstopNote(folder)
    observers = [recording(recorder, 1), noting_estop(note, before, recorder)]
    sync = [(0, Frame(0x020, b"")), (0, Frame(0x020, b""))]
    for tick, (state, requests) in enumerate(told, 1):
        _, outputs = Robot().step([])
        (record,) = outputs.records
        command = outputs.modules[0]._replace(armed=state == State.ARMED)
        now = dataclasses.replace(outputs, tick=tick, modules=[command], records=[record._replace(state=int(state))])
        for observe in observers:
            observe([], sync, Inputs(tick, now.time_ns, [], requests), now)
    note.close()
    left = content(log)
    recorder.close()
    for name in LOGS:
        (log / name).write_bytes(left[name])
    os.utime(log / CAN_LOG, ns=(OLD_NS, OLD_NS))


CLEAR = [Request(Action.CLEAR_ESTOP)]


@pytest.mark.parametrize(
    ("told", "arms"),
    [
        ([(State.DISARMED, []), (State.ARMED, []), (State.DISARMED, [])], True),
        ([(State.ARMED, []), (State.ESTOP, [])], False),
        ([(State.ESTOP, []), (State.ESTOP, CLEAR)], False),
        ([(State.ESTOP, []), (State.DISARMED, CLEAR)], True),
        ([(State.ESTOP, []), (State.DISARMED, CLEAR), (State.ESTOP, [])], False),
    ],
    ids=["disarmed", "stopped", "clearing-refused", "cleared", "stopped-again"],
)
def test_order_to_hold_arms_nobody_after_a_stop_that_was_not_cleared(tmp_path: Path, told: list[Told], arms: bool) -> None:
    stopped(tmp_path, *told)
    said: list[str] = []
    firmware = compose(single(), Parameters())
    before = last_flight(tmp_path, firmware.fleet, firmware.codec, 2 * OLD_NS, boot_id())
    assert to_arm(before, firmware, True, said.append) == ({0} if arms else set())
    assert said == ([] if arms else [ARMS_NOBODY])


@pytest.mark.parametrize(
    ("told", "stands"),
    [((State.DISARMED, []), True), ((State.DISARMED, CLEAR), False), ((State.ARMED, []), False)], ids=["nothing", "cleared", "armed"],
)  # fmt: skip
def test_stop_outlives_every_restart_until_a_person_clears_it_or_arms(tmp_path: Path, told: Told, stands: bool) -> None:
    stopped(tmp_path, (State.ESTOP, []))
    stopped(tmp_path, (State.DISARMED, []), told, (State.DISARMED, []), before=True)
    make_log_folder(tmp_path)  # of a process that came to no tick
    assert last_flight(tmp_path, FLEET, Codec.load(), 2 * OLD_NS, boot_id()).stopped == stands


def test_stop_is_known_however_spoilt_the_log_is_in_which_it_came(tmp_path: Path) -> None:
    stopped(tmp_path, (State.ARMED, []), (State.ESTOP, []))
    for name in LOGS:
        (tmp_path / name).write_bytes(b"\xff" * 2000)
    assert last_flight(tmp_path, FLEET, Codec.load(), 2 * OLD_NS, boot_id()).stopped


def test_person_without_a_ground_station_clears_a_stop_by_hand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stopped(tmp_path, (State.ESTOP, []))
    for said in ("the e-stop is cleared; modcube run arms by --hold and REARM from its next start on", "no e-stop stands; nothing to do"):
        monkeypatch.setattr("sys.argv", ["modcube", "clear-estop", str(tmp_path)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert (ended.value.code, capsys.readouterr().out) == (0, f"{tmp_path}: {said}\n")
        assert not last_flight(tmp_path, FLEET, Codec.load(), 2 * OLD_NS, boot_id()).stopped


@pytest.mark.parametrize("folder", ["", "missing"])
def test_folder_in_which_no_vehicle_logged_has_no_stop_to_clear(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["modcube", "clear-estop", str(tmp_path / folder)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert capsys.readouterr().err == (
        f"modcube: {tmp_path / folder} holds no estop.txt: no vehicle has logged there; give the folder of modcube run --out\n"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_process_started_anew_after_a_stop_holds_nothing_and_says_so(tmp_path: Path) -> None:
    stopped(tmp_path / "log", (State.ESTOP, []))
    for _ in range(2):
        assert ARMS_NOBODY in fly(tmp_path, tmp_path / "log", hold=True)


@pytest.mark.slow
def test_stop_that_another_process_notes_while_this_one_starts_keeps_it_from_starting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "log"
    monkeypatch.setattr(RealTimeLoop, "listen", lambda loop: write_note(out, True))
    with pytest.raises(DescriptionError, match="an e-stop was raised while this process started"):
        fly(tmp_path, out, hold=True)
    assert estop_stands(out)


@pytest.mark.slow
@pytest.mark.parametrize(("hold", "told"), [(True, True), (False, False)])
def test_who_holds_without_a_folder_for_logs_is_told_that_no_stop_is_remembered(hold: bool, told: bool, tmp_path: Path) -> None:
    assert (FORGETFUL in fly(tmp_path, hold=hold)) == told


class Tape(Recorder):
    """A recorder that only counts when it hands over what it has."""

    def __init__(self) -> None:
        self.flushed: list[int] = []

    def sent(self, *_: object) -> None: ...

    def received(self, *_: object) -> None: ...

    def record(self, inputs: Inputs, outputs: Outputs) -> None:
        self.tick = outputs.tick

    def flush(self) -> list[Event]:
        self.flushed.append(self.tick)
        return []


def test_log_says_at_once_who_is_armed() -> None:
    """A process that is killed just after a DISARM must not take it for a flight."""
    tape = Tape()
    observe = recording(tape, 100)
    armed: Sequence[bool] = [20 < tick <= 33 for tick in range(120)]
    for tick in range(1, 120):
        commands = [ModuleCommand(armed[tick], np.zeros(8), None)]
        observe([], [], Inputs(tick, 0, []), Outputs(tick, 0, commands, False, [], []))
    assert tape.flushed == [1, 21, 34, 50, 100]
