"""How the previous process ended, by the last commands in its can.log: frames from the codec itself, files torn at any place."""

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from firmware_py.app.firmware import compose
from firmware_py.app.last_flight import (
    DOCKED_SINCE,
    PARTED_SINCE,
    RECENT_NS,
    STOPPED,
    TAIL_BYTES,
    TESTED,
    LastFlight,
    last_flight,
    outdate,
    to_arm,
)
from firmware_py.description.fleet import Fleet
from firmware_py.description.parameters import Parameters, Supervision
from firmware_py.runtime.clock import unix_ns
from firmware_py.runtime.guarded_file import GuardedFile, QueuedFile
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG, Recorder
from tests.unit.can_logs import CODEC, FLEET, dock_line, docked, lines_of

BOOT = "a-start-of-the-machine"


WRITTEN_NS = 1_700_000_000_000_000_000
NOW_NS = WRITTEN_NS + 2_000_000_000
TAIL = TAIL_BYTES * len(FLEET.module)


def write(folder: Path, text: str, written_ns: int = WRITTEN_NS, **notes: Any) -> None:
    folder.mkdir(exist_ok=True)
    Recorder(folder, {"boot": BOOT, **notes}).close()
    (folder / CAN_LOG).write_text(text)
    os.utime(folder / CAN_LOG, ns=(written_ns, written_ns))


def found(out: Path, now_ns: int = NOW_NS) -> LastFlight:
    return last_flight(out, FLEET, CODEC, now_ns, BOOT)


def in_flight(out: Path, now_ns: int = NOW_NS) -> frozenset[int]:
    return found(out, now_ns).armed


def test_modules_that_were_told_armed_last_were_in_flight(tmp_path: Path) -> None:
    write(tmp_path, lines_of([False] * 3) + lines_of([True, False, True], 2))
    assert in_flight(tmp_path) == {0, 2}
    assert found(tmp_path) == LastFlight(frozenset({0, 2}))  # nothing was sent about magnets


def test_process_that_disarmed_before_it_ended_was_not(tmp_path: Path) -> None:
    write(tmp_path, lines_of([True] * 3) + lines_of([False] * 3, 2))
    assert in_flight(tmp_path) == set()


def test_commands_of_somebody_else_say_nothing(tmp_path: Path) -> None:
    write(tmp_path, lines_of([False] * 3) + lines_of([True] * 3, 2).replace(" T\n", " R\n"))
    assert in_flight(tmp_path) == set()


@pytest.mark.parametrize("cut", [1, 3, 20, 45])
def test_torn_last_line_is_left_out(tmp_path: Path, cut: int) -> None:
    text = lines_of([True] * 3)
    write(tmp_path, text[:-cut])
    assert in_flight(tmp_path) == {0, 1, 2}
    write(tmp_path, text + lines_of([False] * 3, 2)[:-cut])
    assert in_flight(tmp_path) == set()  # the other half of the command is intact


def test_only_the_end_of_a_long_log_is_read_and_lines_that_hold_no_frame_are_passed_over(tmp_path: Path) -> None:
    filler = "(0000000000.010000) can0 zzz#zz T\n\xff\n".encode("latin-1")
    write(tmp_path, lines_of([False] * 3))
    with (tmp_path / CAN_LOG).open("ab") as file:
        file.write(filler * (TAIL // len(filler)) + lines_of([True] * 3, 2).encode())
    os.utime(tmp_path / CAN_LOG, ns=(WRITTEN_NS, WRITTEN_NS))
    assert in_flight(tmp_path) == {0, 1, 2}
    write(tmp_path, lines_of([True] * 3) + "x" * TAIL)
    assert in_flight(tmp_path) == set()


@pytest.mark.parametrize(("age_ns", "found"), [(0, 3), (RECENT_NS - 1, 3), (RECENT_NS, 0), (-1, 0)])
def test_log_that_is_old_or_of_another_clock_says_nothing(tmp_path: Path, age_ns: int, found: int) -> None:
    write(tmp_path, lines_of([True] * 3))
    assert len(in_flight(tmp_path, WRITTEN_NS + age_ns)) == found


def test_log_that_a_failed_disk_ended_says_nothing_by_a_clock_that_starts_in_1970(tmp_path: Path) -> None:
    """A Jetson without a battery for its clock: half a minute after its start, such a log's date is half a minute ago."""
    write(tmp_path, lines_of([True] * 3), 0)
    assert in_flight(tmp_path, 30_000_000_000) == set()
    write(tmp_path, lines_of([True] * 3), 1_000_000_000)
    assert in_flight(tmp_path, 30_000_000_000) == {0, 1, 2}


def test_newest_log_counts(tmp_path: Path) -> None:
    write(tmp_path, lines_of([True] * 3))
    write(tmp_path / "0002", lines_of([False] * 3))
    assert in_flight(tmp_path) == set()
    write(tmp_path / "0010", lines_of([True] * 3))
    assert in_flight(tmp_path) == {0, 1, 2}


def test_log_of_a_process_that_sent_nothing_says_nothing_and_the_one_before_counts(tmp_path: Path) -> None:
    """For example one that was stopped during its start."""
    write(tmp_path, lines_of([True] * 3))
    (tmp_path / "0002").mkdir()
    write(tmp_path / "0003", "")
    write(tmp_path / "0004", lines_of([False] * 3).replace(" T\n", " R\n"))
    assert in_flight(tmp_path) == {0, 1, 2}


@pytest.mark.parametrize("queued", [True, False])
def test_log_that_a_full_disk_ended_before_its_flight_says_nothing_nor_do_those_before_it(
    tmp_path: Path, queued: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The missing end may hold a DISARM."""
    write(tmp_path, lines_of([True] * 3), unix_ns())
    (tmp_path / "0002").mkdir()
    append = GuardedFile._append

    def append_until_full(file: GuardedFile, data: bytes) -> None:
        if b"0.020000" in data:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(file, data)

    monkeypatch.setattr(GuardedFile, "_append", append_until_full)
    file = (QueuedFile if queued else GuardedFile)(tmp_path / "0002" / CAN_LOG)
    for tick, armed in ((1, True), (2, False)):
        file.write(lines_of([armed] * 3, tick).encode())
    file.close()
    assert file.error is not None and (tmp_path / "0002" / CAN_LOG).read_text() == lines_of([True] * 3)
    assert in_flight(tmp_path, unix_ns()) == set()


def test_flight_that_left_no_log_makes_those_before_it_old(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "0002"):
        write(folder, lines_of([True] * 3))
    outdate(tmp_path, WRITTEN_NS + RECENT_NS)
    assert in_flight(tmp_path) == {0, 1, 2}, "an old one keeps its date"
    outdate(tmp_path, NOW_NS)
    assert in_flight(tmp_path) == set()


@pytest.mark.parametrize("boot", ["another-start", ""])
def test_flight_before_the_machine_was_started_anew_arms_nobody(tmp_path: Path, boot: str) -> None:
    """A clock without a battery indicates that only seconds have passed, and the vehicle may be on a bench by now."""
    write(tmp_path, lines_of([True] * 3) + dock_line(0, (1, 0, 0, 0, 0, 0)), boot=boot)
    for now in (BOOT, boot):
        then = last_flight(tmp_path, FLEET, CODEC, NOW_NS, now)
        assert then.armed == (frozenset({0, 1, 2}) if now == boot and boot else frozenset())
        assert then.pulling == {(0, 0)}


def test_joint_that_was_open_at_the_start_is_open_until_somebody_flew_it(tmp_path: Path) -> None:
    write(tmp_path, lines_of([False] * 3) + dock_line(0, (1, 0, 0, 0, 0, 0)), apart=[[0, 0], [1, 1]])
    assert {(0, 0), (1, 1)} <= found(tmp_path).let_go
    write(tmp_path, lines_of([True] * 3) + dock_line(0, (1, 0, 0, 0, 0, 0)), apart=[[0, 0], [1, 1]])
    assert not {(0, 0), (1, 1)} & found(tmp_path).let_go
    write(tmp_path, lines_of([False, False, True]) + dock_line(0, (1, 0, 0, 0, 0, 0)), apart=[[0, 0], [1, 1]])
    assert {(0, 0), (1, 1)} <= found(tmp_path).let_go, "it was another body that flew"


@pytest.mark.parametrize(("duty", "let_go"), [(1.0, 6), (0.5, 0)])
def test_magnet_that_rests_between_its_turns_was_not_told_to_let_go(tmp_path: Path, duty: float, let_go: int) -> None:
    write(tmp_path, lines_of([True] * 3) + dock_line(0, (0,) * 6), parameters={"limiter": {"relay_duty": duty}})
    assert len(found(tmp_path).let_go) == let_go


def test_log_whose_signals_are_torn_arms_nobody(tmp_path: Path) -> None:
    write(tmp_path, lines_of([True] * 3) + dock_line(0, (1, 0, 0, 0, 0, 0)))
    (tmp_path / SIGNAL_LOG).write_bytes((tmp_path / SIGNAL_LOG).read_bytes()[:20])
    assert found(tmp_path).armed == frozenset() and found(tmp_path).pulling == {(0, 0)}


def test_missing_or_unreadable_log_says_nothing(tmp_path: Path) -> None:
    assert in_flight(tmp_path / "missing") == set()
    assert in_flight(tmp_path) == set()
    (tmp_path / CAN_LOG).mkdir()
    assert in_flight(tmp_path) == set()
    assert in_flight(Path(__file__)) == set()


@pytest.mark.slow
@pytest.mark.parametrize("value", [0x00, 0x7F, 0xFF])
def test_start_of_a_log_may_be_spoilt_anywhere(tmp_path: Path, value: int) -> None:
    """A wrong bit in a length makes it astronomical; a process that crashed on it would crash at every start."""
    write(tmp_path, lines_of([True] * 3))
    whole = (tmp_path / SIGNAL_LOG).read_bytes()
    for at in range(len(whole)):
        spoilt = bytearray(whole)
        spoilt[at] = value
        (tmp_path / SIGNAL_LOG).write_bytes(spoilt)
        assert found(tmp_path).armed <= {0, 1, 2}


def test_magnets_that_were_told_to_pull_last_pulled(tmp_path: Path) -> None:
    text = dock_line(0, (1, 2, 0, 0, 0, 1)) + dock_line(1, (0, 1, 0, 0, 0, 0)) + dock_line(2, (0, 0, 0, 1, 0, 0))
    write(tmp_path, text + lines_of([True] * 3) + dock_line(1, (0, 2, 0, 0, 0, 0), 2) + dock_line(0, (0,) * 6, 2, "R"))
    assert found(tmp_path).pulling == {(0, 0), (0, 5), (2, 3)}
    assert found(tmp_path).let_go == {(module, face) for module in range(3) for face in range(6)} - found(tmp_path).pulling
    write(tmp_path, text + dock_line(0, (0,) * 6, 2)[:-1])
    assert found(tmp_path).pulling == {(0, 0), (0, 5), (1, 1), (2, 3)}  # the torn line is left out


def test_log_that_is_old_says_nothing_of_magnets(tmp_path: Path) -> None:
    write(tmp_path, dock_line(0, (1,) * 6))
    assert len(found(tmp_path, WRITTEN_NS + RECENT_NS - 1).pulling) == 6
    assert found(tmp_path, WRITTEN_NS + RECENT_NS) == LastFlight()


@pytest.mark.parametrize("rate_hz", [100, 400])
def test_end_of_the_log_holds_a_dock_cmd_of_every_module(tmp_path: Path, rate_hz: int) -> None:
    """DOCK_CMD is sent ten times a second; the busiest tick of a module is 14 frames of 45 bytes."""
    every = rate_hz // 10
    tick = lines_of([True] * 3) + "(0000000000.010000) can0 0C1#0011223344556677 R\n" * 14
    write(tmp_path, "".join(dock_line(i, (1,) * 6) for i in range(3)) + tick * every)
    assert len(found(tmp_path).pulling) == 18


# ---------------------------------------------------------------- who is armed without a person

FLOWN = LastFlight(frozenset({0, 2}))
PAIR = Fleet(module=docked(0, 1), buses=FLEET.buses)
JOINT = frozenset({(0, 0), (1, 1)})
"""Face A of the first module and face B of the second."""
HOLDS, ALL = "the process before ended in flight", {0, 1, 2}


@pytest.mark.slow
@pytest.mark.parametrize(("before", "fleet", "hold", "rearm", "armed", "told"), [
    (FLOWN, FLEET, False, False, set(), []),
    (FLOWN, FLEET, False, True, {0, 2}, [HOLDS]),
    (FLOWN, FLEET, True, False, ALL, []),
    (FLOWN, FLEET, True, True, ALL, []),
    (LastFlight(), FLEET, False, True, set(), []),
    (FLOWN._replace(stopped=True), FLEET, False, False, set(), []),
    (FLOWN._replace(stopped=True), FLEET, False, True, set(), [STOPPED]),
    (FLOWN._replace(stopped=True), FLEET, True, False, set(), [STOPPED]),
    (FLOWN._replace(pulling=JOINT), FLEET, False, True, set(), [DOCKED_SINCE]),
    (FLOWN._replace(pulling=JOINT), FLEET, True, False, ALL, [DOCKED_SINCE]),
    (FLOWN._replace(pulling=JOINT), PAIR, False, True, {0, 2}, [HOLDS]),
    (FLOWN._replace(let_go=JOINT), FLEET, False, True, {0, 2}, [HOLDS]),
    (FLOWN._replace(let_go=JOINT), PAIR, False, True, set(), [PARTED_SINCE]),
    (FLOWN._replace(let_go=JOINT), PAIR, True, False, set(), [PARTED_SINCE]),
    (FLOWN._replace(grounded=frozenset({2})), FLEET, False, True, {0}, [TESTED, HOLDS]),
    (FLOWN._replace(grounded=frozenset({1})), FLEET, False, True, {0, 2}, [HOLDS]),
    (FLOWN._replace(grounded=frozenset({0, 2})), FLEET, False, True, set(), [TESTED]),
    (LastFlight(frozenset({0, 1, 2}), grounded=frozenset({0})), PAIR, False, True, {2}, [TESTED, HOLDS]),
])  # fmt: skip
def test_nobody_is_armed_without_a_person_unless_it_is_sure(
    before: LastFlight, fleet: Fleet, hold: bool, rearm: bool, armed: set[int], told: list[str]
) -> None:
    said: list[str] = []
    firmware = compose(fleet, Parameters(supervision=Supervision(rearm=int(rearm))))
    assert to_arm(before, firmware, hold, said.append) == armed
    assert [words in line for words, line in zip(told, said, strict=True)] == [True] * len(told)
