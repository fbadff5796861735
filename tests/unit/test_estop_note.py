"""The note of a standing e-stop: on disk before the plug is pulled, even on a full disk, and read safely however damaged."""

import dataclasses
import errno
import os
import shutil
import threading
from pathlib import Path

import pytest

from firmware_py.app import estop_note
from firmware_py.app.estop_note import CLEAR, NOTE, STANDS, EstopNote, clear, estop_stands, noting_estop, write_note
from firmware_py.core.transitions import State
from firmware_py.core.types import Event, Inputs, Outputs
from firmware_py.description.schema import DescriptionError
from firmware_py.ground import files
from firmware_py.runtime.guarded_file import GuardedFile
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG, Recorder
from tests.unit.ground_world import Robot


class Flight:
    """Successive ticks, each in a given state, noted in a folder."""

    def __init__(self, folder: Path, recorder: Recorder | None = None, stands: bool = False) -> None:
        self.note = EstopNote(folder)
        self._observe = noting_estop(self.note, stands, recorder)
        self._recorder = recorder
        self._robot = Robot()

    def tick(self, state: State) -> Outputs:
        _, outputs = self._robot.step([])
        now = dataclasses.replace(outputs, records=[outputs.records[0]._replace(state=int(state))], events=[])
        if self._recorder is not None:
            self._recorder.sent(now.time_ns, 0, [(0x020, b"")])
        self._observe([], [], Inputs(now.tick, now.time_ns, []), now)
        return now

    def end(self) -> list[Event]:
        self.note.close()
        return self.note.failures()


def refuse_room(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("queued", [True, False])
def test_stop_and_what_led_to_it_are_on_the_disk_for_who_pulls_the_plug_next(
    tmp_path: Path, queued: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_disk: dict[str, bytes] = {}

    def sync(number: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{number}"))
        on_disk[path.name.removesuffix(".new")] = path.read_bytes() if path.is_file() else b""  # .new: replaces the file whole

    monkeypatch.setattr(os, "fsync", sync)
    recorder = Recorder(tmp_path, {}, queued=queued)
    flight = Flight(tmp_path, recorder)
    flight.tick(State.ARMED)
    assert CAN_LOG not in on_disk, "a disk is not troubled otherwise"
    flight.tick(State.ESTOP)
    assert flight.end() == []
    recorder.close()
    assert on_disk[NOTE] == STANDS and on_disk[CAN_LOG] and SIGNAL_LOG in on_disk


def test_stop_is_noted_on_a_disk_that_was_full_before_it_came(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Recorder(tmp_path, {})
    flight = Flight(tmp_path, recorder)
    flight.tick(State.ARMED)
    flight.note.close()
    flight.note = EstopNote(tmp_path)
    monkeypatch.setattr(GuardedFile, "_append", refuse_room)  # no log takes another byte,
    monkeypatch.setattr(estop_note, "write_atomically", refuse_room)  # and no file can be made
    flight._observe = noting_estop(flight.note, False, recorder)
    events = [event.text for event in flight.tick(State.ESTOP).events]
    recorder.close()
    assert flight.end() == [] and events == ["no more log: can.log: No space left on device"]
    assert estop_stands(tmp_path)


def test_note_never_changes_its_length(tmp_path: Path) -> None:
    """Otherwise a full disk would have no room for it."""
    assert len(STANDS) == len(CLEAR)
    for stands in (False, True, False):
        write_note(tmp_path, stands)
        assert estop_stands(tmp_path) == stands
        assert [path.name for path in tmp_path.iterdir()] == [NOTE]


def test_note_that_cannot_be_made_is_said_once_and_the_flight_goes_on(tmp_path: Path) -> None:
    (tmp_path / "taken").touch()
    flight = Flight(tmp_path / "taken")
    flight.tick(State.ARMED)
    flight.note.close()
    assert [event.text for event in flight.tick(State.ARMED).events] == [
        "the next start will not know of an e-stop: estop.txt: File exists"
    ]
    assert flight.tick(State.ARMED).events == []


def test_stop_that_a_full_disk_did_not_take_is_noted_as_soon_as_there_is_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "RETRY_S", 0.01)
    tried, room, made = threading.Event(), threading.Event(), threading.Event()
    make = estop_note.write_atomically

    def make_where_there_is_room(path: Path, data: bytes) -> None:
        tried.set()
        if not room.is_set():
            refuse_room()
        make(path, data)
        made.set()

    monkeypatch.setattr(estop_note, "write_atomically", make_where_there_is_room)
    flight = Flight(tmp_path)
    flight.tick(State.ESTOP)
    assert tried.wait(10)
    room.set()
    assert made.wait(10)
    assert [event.text for event in flight.end()] == ["the next start will not know of an e-stop: estop.txt: No space left on device"]
    assert estop_stands(tmp_path)


def test_last_chance_of_a_note_is_the_end_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = estop_note.write_atomically
    refused = threading.Event()

    def refuse(*_: object) -> None:
        refused.set()
        refuse_room()

    monkeypatch.setattr(estop_note, "write_atomically", refuse)
    flight = Flight(tmp_path)
    flight.tick(State.ESTOP)
    assert refused.wait(10)
    monkeypatch.setattr(estop_note, "write_atomically", make)
    flight.end()
    assert estop_stands(tmp_path)


def test_stop_is_noted_in_a_folder_that_was_removed_in_flight(tmp_path: Path) -> None:
    flight = Flight(tmp_path / "log")
    flight.tick(State.ARMED)
    flight.note.close()
    shutil.rmtree(tmp_path / "log")
    write_note(tmp_path / "log", True)
    assert estop_stands(tmp_path / "log")


def test_note_of_somebody_else_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For example a note of root's, who once ran the vehicle."""
    write_note(tmp_path, False)
    opened = Path.open

    def refuse(path: Path, mode: str = "r", *others: object, **more: object) -> object:
        if path.name == NOTE and mode == "r+b":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return opened(path, mode, *others, **more)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", refuse)
    write_note(tmp_path, True)
    assert estop_stands(tmp_path)


def test_each_stop_is_noted_for_a_person_may_have_cleared_the_one_before_by_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process ran on meanwhile, and still remembers that stop."""
    written: list[bool] = []
    monkeypatch.setattr(EstopNote, "write", lambda note, stands: written.append(stands))
    flight = Flight(tmp_path, stands=True)
    for state in (State.DISARMED, State.DISARMED, State.ESTOP, State.ESTOP, State.DISARMED, State.ESTOP):
        flight.tick(state)
    assert written == [True, True, True]


def test_note_is_taken_where_folders_have_no_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on some network file systems: this is no failure to report to an operator."""

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(estop_note.fcntl, "flock", refuse)
    flight = Flight(tmp_path)
    flight.tick(State.ESTOP)
    assert flight.end() == [] and estop_stands(tmp_path)


@pytest.mark.parametrize("is_there", [True, False])
def test_folder_is_one_vehicle_s_while_that_runs(tmp_path: Path, is_there: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody else can clear that vehicle's e-stop, also where the vehicle itself had to make the folder."""
    folder, held, hold = tmp_path / "log", threading.Event(), estop_note.lock_folder

    def hold_and_tell(path: Path) -> int | None:
        handle = hold(path)
        held.set()
        return handle

    monkeypatch.setattr(estop_note, "lock_folder", hold_and_tell)
    if is_there:
        write_note(folder, True)
    first = EstopNote(folder)
    first.write(True)
    assert held.wait(10)
    with pytest.raises(DescriptionError, match="end it first, or send it CLEAR_ESTOP"):
        clear(folder)
    with pytest.raises(DescriptionError, match=r"another vehicle that runs logs into .*: end it first, or give this one another --out"):
        EstopNote(folder)
    for _ in range(2):
        first.close()  # a second time does nothing
    assert not first._writer._thread.is_alive()
    assert clear(folder) and not estop_stands(folder)
    EstopNote(folder).close()


@pytest.mark.parametrize(
    ("text", "stands"), [(STANDS, True), (CLEAR, False), (b"", True), (b"\x00" * 7, True), (b"clear", True), (b"clear \nand more", True)]
)
def test_note_that_says_neither_counts_as_a_stop(tmp_path: Path, text: bytes, stands: bool) -> None:
    (tmp_path / NOTE).write_bytes(text)
    assert estop_stands(tmp_path) == stands
    write_note(tmp_path, False)
    assert not estop_stands(tmp_path)


def test_folder_without_a_note_knows_of_no_stop_and_one_that_cannot_be_read_may_hold_one(tmp_path: Path) -> None:
    assert not estop_stands(tmp_path) and not estop_stands(tmp_path / "missing") and not estop_stands(Path(__file__))
    (tmp_path / NOTE).mkdir()
    assert estop_stands(tmp_path)
