"""A process that was killed during a motor test: the vehicle may lie on a bench, so the next process does not fly it."""

import dataclasses
import errno
import os
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from firmware_py.app.firmware import compose
from firmware_py.app.last_flight import TESTED, last_flight, to_arm
from firmware_py.core.transitions import State
from firmware_py.core.types import Mode
from firmware_py.description.parameters import Parameters, Supervision
from firmware_py.description.signals import MCAP_MAGIC
from firmware_py.runtime.clock import boot_id, unix_ns
from firmware_py.runtime.guarded_file import GuardedFile
from firmware_py.runtime.log_end import BodyEnd, last_bodies
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG, Recorder
from tests.unit.can_logs import CODEC, FLEET, lines_of
from tests.unit.ground_world import Robot

REARM = Parameters(supervision=Supervision(rearm=1))
ARMED, DISARMED = int(State.ARMED), int(State.DISARMED)
Told = dict[int, tuple[int, Mode]]
"""State and mode of each body in one tick."""


def write_log(folder: Path, *ticks: Told, killed: bool = True) -> None:
    """Writes the log of a process with these records, which ended, or was killed, after thruster commands to armed modules."""
    folder.mkdir(exist_ok=True)
    recorder = Recorder(folder, {"boot": boot_id()})
    robot = Robot(3)
    for told in ticks:
        inputs, outputs = robot.step([])
        records = [record for record in outputs.records if record.body in told]
        records = [record._replace(state=told[record.body][0], mode=int(told[record.body][1])) for record in records]
        recorder.record(inputs, dataclasses.replace(outputs, records=records))
        recorder.flush()
    signals = (folder / SIGNAL_LOG).read_bytes()
    recorder.close()
    if killed:
        (folder / SIGNAL_LOG).write_bytes(signals)
    (folder / CAN_LOG).write_text(lines_of([True] * 3))


def rearmed(out: Path) -> tuple[set[int], list[str]]:
    """The modules that the next process arms, and what it says."""
    said: list[str] = []
    firmware = compose(FLEET, REARM)
    return to_arm(last_flight(out, FLEET, CODEC, unix_ns(), boot_id()), firmware, False, said.append), said


def test_body_in_a_motor_test_is_not_armed_again_and_the_others_are(tmp_path: Path) -> None:
    flies, tests = (ARMED, Mode.POSHOLD), (ARMED, Mode.MOTOR_DETECT)
    write_log(tmp_path, {0: flies, 1: (DISARMED, Mode.POSHOLD), 2: flies}, {0: flies, 1: tests, 2: flies})
    modules, said = rearmed(tmp_path)
    assert modules == {0, 2}
    assert said[0].startswith("warning: modules 2 (number 2 on ") and said[0].endswith(TESTED)
    assert said[1].startswith("the process before ended in flight")


def test_vehicle_whose_only_body_was_in_a_motor_test_waits_for_a_person(tmp_path: Path) -> None:
    write_log(tmp_path, *[{body: (ARMED, Mode.MOTOR_DETECT) for body in range(3)}] * 200)
    modules, said = rearmed(tmp_path)
    assert modules == set() and len(said) == 1


def test_body_that_flew_on_after_its_motor_test_is_armed_again(tmp_path: Path) -> None:
    everybody = range(3)
    write_log(tmp_path, dict.fromkeys(everybody, (ARMED, Mode.MOTOR_DETECT)), dict.fromkeys(everybody, (ARMED, Mode.POSHOLD)))
    assert rearmed(tmp_path)[0] == {0, 1, 2}


def test_log_whose_signals_end_before_the_body_was_armed_arms_nobody(tmp_path: Path) -> None:
    """The two files are not written at one moment: the signals may lack the motor test that armed it."""
    write_log(tmp_path, dict.fromkeys(range(3), (DISARMED, Mode.POSHOLD)))
    assert rearmed(tmp_path)[0] == set()


def test_log_of_which_only_the_signals_ended_before_the_flight_arms_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are the larger file: on a memory stick (FAT) it ends at 4 GB, and can.log goes on. The motor test came after."""
    append = GuardedFile._append

    def append_until_too_large(file: GuardedFile, data: bytes) -> None:
        if file.path.name == SIGNAL_LOG and file.seek(0) > 20_000:
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
        append(file, data)

    monkeypatch.setattr(GuardedFile, "_append", append_until_too_large)
    flies, tests = (dict.fromkeys(range(3), (ARMED, mode)) for mode in (Mode.POSHOLD, Mode.MOTOR_DETECT))
    write_log(tmp_path, *[flies] * 50, *[tests] * 50, killed=False)
    assert rearmed(tmp_path)[0] == set()


def test_bodies_of_the_last_tick_alone_count(tmp_path: Path) -> None:
    """Body 1 has docked to body 0 since its motor test; a channel that begins late is found too."""
    write_log(tmp_path, {1: (ARMED, Mode.MOTOR_DETECT)}, *[{0: (ARMED, Mode.AUTO), 2: (ARMED, Mode.SURFACE)}] * 50)
    assert last_bodies(tmp_path / SIGNAL_LOG) == {0: BodyEnd(ARMED, int(Mode.AUTO)), 2: BodyEnd(ARMED, int(Mode.SURFACE))}


RECORD = struct.Struct("<BQ")
"""Opcode and length of a record (MCAP specification)."""


def chunks_in(log: bytes) -> Iterator[int]:
    """Byte at which each chunk of a log begins."""
    at = len(MCAP_MAGIC)
    while at + RECORD.size <= len(log):
        opcode, length = RECORD.unpack_from(log, at)
        if opcode == Opcode.CHUNK:
            yield at
        at += RECORD.size + length


def test_chunks_between_the_ends_of_a_log_are_not_read(tmp_path: Path) -> None:
    """A vehicle that restarts in flight waited a second for each hour of its log. Here 8 GB are a hole in the file."""
    write_log(tmp_path, {0: (ARMED, Mode.AUTO)}, {0: (ARMED, Mode.MOTOR_DETECT)})
    whole, hole = (tmp_path / SIGNAL_LOG).read_bytes(), 8 << 30
    _, second, *_ = chunks_in(whole)
    with (tmp_path / SIGNAL_LOG).open("wb") as file:
        file.write(whole[:second] + RECORD.pack(Opcode.CHUNK, hole))
        file.seek(hole, os.SEEK_CUR)
        file.write(whole[second:])
    assert last_bodies(tmp_path / SIGNAL_LOG) == {0: BodyEnd(ARMED, int(Mode.MOTOR_DETECT))}


@pytest.mark.parametrize("cut", [1, 40, 300, 1000])
def test_torn_end_of_the_signals_leaves_the_ticks_before_it(tmp_path: Path, cut: int) -> None:
    write_log(tmp_path, *[{0: (ARMED, Mode.MOTOR_DETECT)}] * 5)
    whole = (tmp_path / SIGNAL_LOG).read_bytes()
    (tmp_path / SIGNAL_LOG).write_bytes(whole[:-cut])
    assert last_bodies(tmp_path / SIGNAL_LOG) == {0: BodyEnd(ARMED, int(Mode.MOTOR_DETECT))}


@pytest.mark.slow
@pytest.mark.parametrize("value", [0x00, 0x7F, 0xFF])
def test_signals_may_be_spoilt_anywhere(tmp_path: Path, value: int) -> None:
    """A process that crashed on a wrong bit would crash at every start."""
    write_log(tmp_path, {0: (ARMED, Mode.MOTOR_DETECT)})
    whole = (tmp_path / SIGNAL_LOG).read_bytes()
    for at in range(0, len(whole), 3):
        spoilt = bytearray(whole)
        spoilt[at] = value
        (tmp_path / SIGNAL_LOG).write_bytes(spoilt)
        assert set(last_bodies(tmp_path / SIGNAL_LOG)) <= {0}
