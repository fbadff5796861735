"""An e-stop outlives the vehicle's process, until a person clears it or arms."""

import dataclasses
import os
from pathlib import Path

import pytest

from firmware_py.app.estop_note import EstopNote, estop_stands, noting_estop, write_note
from firmware_py.app.firmware import compose
from firmware_py.app.last_flight import last_flight, to_arm
from firmware_py.app.observers import recording
from firmware_py.app.realtime import RealTimeLoop
from firmware_py.app.vehicle_process import FORGETFUL
from firmware_py.bus.codec import Codec, Frame
from firmware_py.cli import main
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Inputs, Request
from firmware_py.description.fleet import single
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.runtime.clock import boot_id
from firmware_py.runtime.log_folder import make_log_folder
from firmware_py.runtime.recorder import CAN_LOG, Recorder
from tests.unit.can_logs import FLEET
from tests.unit.ground_world import Robot
from tests.unit.vehicle_runs import LOGS, content, fly

ARMS_NOBODY = (
    "warning: the e-stop of the flight before was not cleared: nobody is armed without a person, "
    "who arms, sends CLEAR_ESTOP, or without a ground station types modcube clear-estop FOLDER (that of --out) before the next start"
)
OLD_NS = 1_000_000_000 * 86_400
Told = tuple[State, list[Request]]


def write_killed_log(folder: Path, *told: Told, before: bool = False) -> None:
    """Writes the log of a process that was then killed. `told`: its body's state and the requests, per tick; `before`: an e-stop stood."""
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
    write_killed_log(tmp_path, *told)
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
    write_killed_log(tmp_path, (State.ESTOP, []))
    write_killed_log(tmp_path, (State.DISARMED, []), told, (State.DISARMED, []), before=True)
    make_log_folder(tmp_path)  # of a process that ran no tick
    assert last_flight(tmp_path, FLEET, Codec.load(), 2 * OLD_NS, boot_id()).stopped == stands


def test_stop_is_known_however_spoilt_the_log_is_in_which_it_came(tmp_path: Path) -> None:
    write_killed_log(tmp_path, (State.ARMED, []), (State.ESTOP, []))
    for name in LOGS:
        (tmp_path / name).write_bytes(b"\xff" * 2000)
    assert last_flight(tmp_path, FLEET, Codec.load(), 2 * OLD_NS, boot_id()).stopped


@pytest.mark.slow
def test_person_without_a_ground_station_clears_a_stop_by_hand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_killed_log(tmp_path, (State.ESTOP, []))
    for said in ("the e-stop is cleared; modcube run arms by --hold and REARM from its next start on", "no e-stop stands; nothing to do"):
        monkeypatch.setattr("sys.argv", ["modcube", "clear-estop", str(tmp_path)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert (ended.value.code, capsys.readouterr().out) == (0, f"{tmp_path}: {said}\n")
        assert not last_flight(tmp_path, FLEET, Codec.load(), 2 * OLD_NS, boot_id()).stopped


@pytest.mark.slow
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
    write_killed_log(tmp_path / "log", (State.ESTOP, []))
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
