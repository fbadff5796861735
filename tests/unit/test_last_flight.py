"""How the process before ended, by what its can.log says was sent last: the frames are the codec's own, the file is torn as it comes."""

import os
from collections.abc import Sequence
from pathlib import Path

import pytest

from firmware_py.app.last_flight import RECENT_NS, TAIL_BYTES, modules_in_flight
from firmware_py.bus.codec import Codec
from firmware_py.description.fleet import Fleet, Module
from firmware_py.runtime.recorder import CAN_LOG, candump_lines

CODEC = Codec.load()
FLEET = Fleet(module=(Module(number=1), Module(number=2), Module(number=1, bus=1)), buses=("virtual:a", "virtual:b"))
PERIOD_NS = 10_000_000
WRITTEN_NS = 1_700_000_000_000_000_000
NOW_NS = WRITTEN_NS + 2_000_000_000


def lines_of(armed: Sequence[bool], tick: int = 1) -> str:
    """What one tick writes: SYNC, an answer of each module, its commands."""
    text = ""
    for on, module in zip(armed, FLEET.module, strict=True):
        names = ("THRUSTER_CMD_A", "THRUSTER_CMD_B")
        commands = [CODEC.message(name).encode(module.number, (0.1, 0.2, 0.3, 0.4, int(on)), tick) for name in names]
        answer = CODEC.message("GYRO").encode(module.number, (0.0, 0.0, 0.0, 0), tick)
        sync = CODEC.message("SYNC").encode(0, (tick,))
        text += candump_lines(tick * PERIOD_NS, module.bus, "T", [sync])
        text += candump_lines(tick * PERIOD_NS, module.bus, "R", [answer])
        text += candump_lines(tick * PERIOD_NS, module.bus, "T", commands)
    return text


def write(folder: Path, text: str, written_ns: int = WRITTEN_NS) -> None:
    folder.mkdir(exist_ok=True)
    (folder / CAN_LOG).write_text(text)
    os.utime(folder / CAN_LOG, ns=(written_ns, written_ns))


def in_flight(out: Path, now_ns: int = NOW_NS) -> set[int]:
    return modules_in_flight(out, FLEET, CODEC, now_ns)


def test_modules_that_were_told_armed_last_were_in_flight(tmp_path: Path) -> None:
    write(tmp_path, lines_of([False] * 3) + lines_of([True, False, True], 2))
    assert in_flight(tmp_path) == {0, 2}


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
    assert in_flight(tmp_path) == set()  # the other half of the command had been written


def test_only_the_end_of_a_long_log_is_read_and_lines_that_hold_no_frame_are_passed_over(tmp_path: Path) -> None:
    filler = "(0000000000.010000) can0 zzz#zz T\n\xff\n".encode("latin-1")
    write(tmp_path, lines_of([False] * 3))
    with (tmp_path / CAN_LOG).open("ab") as file:
        file.write(filler * (TAIL_BYTES // len(filler)) + lines_of([True] * 3, 2).encode())
    os.utime(tmp_path / CAN_LOG, ns=(WRITTEN_NS, WRITTEN_NS))
    assert in_flight(tmp_path) == {0, 1, 2}
    write(tmp_path, lines_of([True] * 3) + "x" * TAIL_BYTES)
    assert in_flight(tmp_path) == set()


@pytest.mark.parametrize(("age_ns", "found"), [(0, 3), (RECENT_NS - 1, 3), (RECENT_NS, 0), (-1, 0)])
def test_log_that_is_old_or_of_another_clock_says_nothing(tmp_path: Path, age_ns: int, found: int) -> None:
    write(tmp_path, lines_of([True] * 3))
    assert len(in_flight(tmp_path, WRITTEN_NS + age_ns)) == found


def test_newest_log_counts(tmp_path: Path) -> None:
    write(tmp_path, lines_of([True] * 3))
    write(tmp_path / "0002", lines_of([False] * 3))
    assert in_flight(tmp_path) == set()
    write(tmp_path / "0010", lines_of([True] * 3))
    assert in_flight(tmp_path) == {0, 1, 2}
    (tmp_path / "0011").mkdir()
    assert in_flight(tmp_path) == set()


def test_missing_or_unreadable_log_says_nothing(tmp_path: Path) -> None:
    assert in_flight(tmp_path / "missing") == set()
    assert in_flight(tmp_path) == set()
    (tmp_path / CAN_LOG).mkdir()
    assert in_flight(tmp_path) == set()
    assert in_flight(Path(__file__)) == set()
