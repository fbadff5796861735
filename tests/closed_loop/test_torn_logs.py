"""Whatever happens to the process or its disk, the log is kept up to a second before, is readable up to the damage, and can be repaired."""

import errno
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import tracemalloc
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest

from firmware_py.app.firmware import BusFrame
from firmware_py.app.observers import recording
from firmware_py.app.replay import replay
from firmware_py.core.types import Inputs, Outputs
from firmware_py.description.parameters import Parameters
from firmware_py.description.signals import is_closed, read_signals
from firmware_py.runtime import guarded_file
from firmware_py.runtime.flight_log import FlightLog, LogError
from firmware_py.runtime.guarded_file import GuardedFile, QueuedFile
from firmware_py.runtime.log_recovery import _cut_frames, recover
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG, Recorder, candump_stamp
from hil.bench import open_bench
from hil.truth_log import TRUTH_LOG
from tests.closed_loop.flights import shortened

TICKS, TICKS_A_SECOND = 500, 100
KILLED_AT = 437
KILLED = f"""
import os, signal, sys
from contextlib import ExitStack
from pathlib import Path
from firmware_py.app.configuration import configuration_of
from firmware_py.app.observers import recording
from firmware_py.description.parameters import Parameters
from firmware_py.runtime.recorder import Recorder
from hil.bench import open_bench
from hil.scenario import load_scenario

def kill(received, sent, inputs, outputs):
    if outputs.tick == {KILLED_AT}:
        os.kill(os.getpid(), signal.SIGKILL)

with ExitStack() as stack:
    bench = open_bench(stack, load_scenario("hover"), 0, Parameters(), "virtual:killed")
    # written at once: in lockstep a second of flight passes before a writer of its own has had a turn
    recorder = Recorder(Path(sys.argv[1]), configuration_of(bench.firmware))
    bench.fly([recording(recorder, 100), kill])
"""


def ticks_of(folder: Path) -> list[int]:
    return [logged.tick for logged in FlightLog(folder).ticks()]


def tear(path: Path, share: float) -> None:
    """Cuts a file down to this share of its beginning."""
    data = path.read_bytes()
    path.write_bytes(data[: round(share * len(data))])


@pytest.mark.slow
def test_killed_process_leaves_a_log_that_lacks_a_second_at_the_most(tmp_path: Path) -> None:
    process = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], capture_output=True, text=True)
    assert process.returncode == -signal.SIGKILL, process.stderr
    outcome = replay(tmp_path)
    assert outcome.first is None
    assert outcome.torn == "signals.mcap was not closed"
    assert KILLED_AT - TICKS_A_SECOND <= outcome.ticks <= KILLED_AT
    assert recover(tmp_path).ticks == outcome.ticks
    mended = replay(tmp_path)
    assert (mended.first, mended.ticks, mended.torn) == (None, outcome.ticks, "")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_torn_log_is_read_up_to_the_tear_and_mended(log: Path, seed: int) -> None:
    shares = np.random.default_rng(seed).uniform(0.05, 1.0, 2)
    if seed < 4:
        tear(log / SIGNAL_LOG, shares[0])
    if seed > 1:
        tear(log / CAN_LOG, shares[1])
    torn = {name: (log / name).read_bytes() for name in (CAN_LOG, SIGNAL_LOG)}
    ticks = ticks_of(log)
    assert ticks == list(range(1, len(ticks) + 1))
    assert len(ticks) >= TICKS * min(shares[0] if seed < 4 else 1.0, shares[1] if seed > 1 else 1.0) - TICKS_A_SECOND
    assert replay(log).first is None
    recovery = recover(log)
    assert recovery.torn
    assert recovery.ticks == len(ticks)
    assert {name: (log / f"{name}.torn").read_bytes() for name in torn} == torn
    assert is_closed(log / SIGNAL_LOG)
    mended = replay(log)
    assert (mended.first, mended.ticks, mended.torn) == (None, len(ticks), "")
    assert recover(log) == (len(ticks), "")


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, 1.0])
def test_torn_log_of_the_bench_is_mended_with_that_of_the_vehicle(log: Path, share: float) -> None:
    """Regression: it stayed torn, and readers of MCAP other than our own refuse a file without an end."""
    shutil.copyfile(log / SIGNAL_LOG, log / TRUTH_LOG)
    tear(log / TRUTH_LOG, 0.8)
    tear(log / SIGNAL_LOG, share)
    torn = (log / TRUTH_LOG).read_bytes()
    last = max(ticks_of(log))
    assert recover(log).torn.endswith("truth.mcap was not closed")
    assert is_closed(log / TRUTH_LOG) and (log / f"{TRUTH_LOG}.torn").read_bytes() == torn
    mended = read_signals(log / TRUTH_LOG)["/firmware/ticks"]["tick"]
    assert list(mended) == list(range(1, len(mended) + 1)) and 0.7 * share * TICKS < len(mended) <= last
    assert (log / f"{SIGNAL_LOG}.torn").exists() == (share < 1.0)
    assert recover(log) == (last, "")


@pytest.mark.slow
def test_log_on_a_disk_without_links_is_mended_too(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(source: Path, target: Path) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    tear(log / CAN_LOG, 0.9)
    torn = (log / CAN_LOG).read_bytes()
    monkeypatch.setattr(os, "link", refused)
    assert recover(log).torn and not replay(log).torn
    assert (log / f"{CAN_LOG}.torn").read_bytes() == torn


def test_log_that_is_torn_again_keeps_what_the_first_mend_set_aside(log: Path) -> None:
    aside = {}
    for share, behind in ((0.9, ".torn"), (0.8, ".torn2"), (0.7, ".torn3")):
        tear(log / CAN_LOG, share)
        aside |= {f"{name}{behind}": (log / name).read_bytes() for name in (CAN_LOG, SIGNAL_LOG)}
        assert recover(log).torn
    assert {path.name: path.read_bytes() for path in log.glob("*.torn*")} == aside


@pytest.mark.slow
@pytest.mark.parametrize("renames", range(2))
@pytest.mark.parametrize("torn", [(CAN_LOG,), (SIGNAL_LOG,), (CAN_LOG, SIGNAL_LOG)], ids="+".join)
def test_mend_that_is_killed_between_two_renames_loses_nothing(
    torn: tuple[str, ...], renames: int, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in torn:
        tear(log / name, 0.9)
    ticks, before = ticks_of(log), {(log / name).read_bytes() for name in (CAN_LOG, SIGNAL_LOG)}
    replace, left = os.replace, iter(range(renames))

    def killed(source: Path, target: Path) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patched, suppress(KeyboardInterrupt):
        patched.setattr(os, "replace", killed)
        recover(log)
    recover(log)
    mended = replay(log)
    assert (mended.first, mended.ticks, mended.torn) == (None, len(ticks), "")
    assert before <= {path.read_bytes() for path in log.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("fill", [b"\0", b"\xff", b"\n", b"\r", b"7"])
@pytest.mark.parametrize("begin", [100_000, 100_017])
def test_can_log_with_a_spoilt_block_is_read_up_to_it_and_mended(log: Path, fill: bytes, begin: int) -> None:
    """As left by a disk that lost power, or by a worn-out card."""
    path = log / CAN_LOG
    data = path.read_bytes()
    path.write_bytes(data[:begin] + 4096 * fill + data[begin + 4096 :])
    outcome = replay(log)
    assert outcome.first is None
    place = re.match(r"can\.log is damaged from tick (\d+) on, time (\(\d+\.\d+\)), byte (\d+) \(can\.log:\d+: ", outcome.torn)
    assert place is not None, outcome.torn
    tick, stamp, at = int(place[1]), place[2], int(place[3])
    assert begin - 2000 < at <= begin and outcome.ticks == tick - 1
    assert stamp == candump_stamp(tick * 1_000_000_000 // TICKS_A_SECOND)
    assert recover(log) == (outcome.ticks, outcome.torn)
    assert (log / f"{CAN_LOG}.torn").read_bytes() != data and data.startswith(path.read_bytes())
    mended = replay(log)
    assert (mended.first, mended.ticks, mended.torn) == (None, outcome.ticks, "")


@pytest.mark.slow
def test_block_that_can_log_holds_twice_is_not_kept_by_its_mending(log: Path) -> None:
    """The repeated block contains the ticks before the damage a second time."""
    path, begin = log / CAN_LOG, 100_017
    data = path.read_bytes()
    path.write_bytes(data[:begin] + data[begin - 8192 :])
    ticks = recover(log).ticks
    assert data.startswith(path.read_bytes())
    mended = replay(log)
    assert (mended.first, mended.ticks, mended.torn) == (None, ticks, "")


@pytest.mark.slow
def test_damage_is_told_of_a_log_that_was_not_closed_too(log: Path) -> None:
    """A lost supply causes both; the missing end is the lesser loss."""
    path = log / CAN_LOG
    path.write_bytes(path.read_bytes()[:100_000] + 4096 * b"\0" + path.read_bytes()[104_096:])
    tear(log / SIGNAL_LOG, 0.9)
    assert replay(log).torn.startswith(f"{SIGNAL_LOG} was not closed; {CAN_LOG} is damaged from tick ")


def test_mended_log_is_as_old_as_its_flight_so_that_nobody_is_armed_for_it(log: Path) -> None:
    tear(log / SIGNAL_LOG, 0.9)
    for name in (CAN_LOG, SIGNAL_LOG):
        os.utime(log / name, ns=(0, 0))
    recover(log)
    assert [(log / name).stat().st_mtime_ns for name in (CAN_LOG, SIGNAL_LOG)] == [0, 0]


def test_log_of_a_flight_that_goes_on_is_not_mended(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path)
    recorder.flush()
    with pytest.raises(LogError, match="is still being written; mend it when its run has ended"):
        recover(tmp_path)
    recorder.close()
    assert recover(tmp_path) == (0, "")


@pytest.mark.slow
def test_long_can_log_is_cut_without_being_held_in_memory(log: Path) -> None:
    path, last = log / CAN_LOG, max(ticks_of(log))
    stamp = candump_stamp(last * 1_000_000_000 // TICKS_A_SECOND)
    before, end = path.read_bytes().split(stamp.encode(), 1)
    (log / "long.log").write_bytes(20 * before + stamp.encode() + end)
    tracemalloc.start()
    _cut_frames(log / "long.log", log / "cut.log", stamp)
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (log / "cut.log").read_bytes() == (log / "long.log").read_bytes()
    assert held < (log / "long.log").stat().st_size / 2


@pytest.mark.slow
def test_half_a_line_of_can_log_is_left_out(log: Path) -> None:
    tear(log / SIGNAL_LOG, 0.9)
    (log / CAN_LOG).write_bytes((log / CAN_LOG).read_bytes()[:-20])
    assert replay(log).first is None


def test_whole_log_is_left_as_it_is(log: Path) -> None:
    before = {path.name: path.read_bytes() for path in log.iterdir()}
    assert recover(log) == (TICKS, "")
    assert {path.name: path.read_bytes() for path in log.iterdir()} == before


def test_log_of_which_nothing_is_whole_is_refused_and_left(log: Path) -> None:
    tear(log / SIGNAL_LOG, 0.001)
    with pytest.raises(LogError, match="no tick of the log is whole"):
        recover(log)
    assert not list(log.glob("*.torn")) + list(log.glob("*.mended"))


# ---------------------------------------------------------------- the disk


def fly_recorded(folder: Path, queued: bool = False) -> tuple[list[BusFrame], list[str]]:
    """Flies five seconds; returns the frames that the firmware sent and the events about the log."""
    sent_all: list[BusFrame] = []
    said: list[str] = []

    def observe(received: list[BusFrame], sent: list[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        sent_all.extend(sent)
        said.extend(event.text for event in outputs.events if "log" in event.text)

    with ExitStack() as stack:
        bench = open_bench(stack, shortened("spiral", 2.0, 3.0), 0, Parameters(), f"virtual:{folder.name}")
        recorder = Recorder(folder, queued=queued)
        stack.callback(recorder.close)
        bench.fly([recording(recorder, TICKS_A_SECOND), observe])
        said += [event.text for event in recorder.close()]  # lockstep may be faster than the disk
    return sent_all, said


@pytest.mark.slow
def test_full_disk_ends_the_log_and_changes_no_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, said = fly_recorded(tmp_path)
    assert said == []
    append = GuardedFile._append

    def append_to_full_disk(self: GuardedFile, data: bytes) -> None:
        if self._position + len(data) > 100_000:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(self, data)

    monkeypatch.setattr(GuardedFile, "_append", append_to_full_disk)
    full, said = fly_recorded(tmp_path)
    assert full == whole
    assert said == ["no more log: signals.mcap: No space left on device"]
    assert 0 < len(ticks_of(tmp_path)) < TICKS


@pytest.mark.slow
def test_file_that_may_not_grow_ends_the_log_with_one_warning(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        _, said = fly_recorded(tmp_path, queued=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert len(said) == 1
    assert said[0].endswith("File too large")
    assert (tmp_path / SIGNAL_LOG).stat().st_size <= 100_000
    assert 0 < len(ticks_of(tmp_path)) < TICKS


@pytest.mark.slow
def test_disk_that_stalls_holds_up_no_tick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, _ = fly_recorded(tmp_path)
    monkeypatch.setattr(guarded_file, "MOST_WAITING_BYTES", 50_000)
    stalled = threading.Event()
    append = GuardedFile._append

    def append_when_it_goes_on(self: GuardedFile, data: bytes) -> None:
        stalled.wait()
        append(self, data)

    monkeypatch.setattr(GuardedFile, "_append", append_when_it_goes_on)
    monkeypatch.setattr(guarded_file, "CLOSE_S", 0.0)
    give_up = threading.Timer(60.0, stalled.set)  # if a tick waits for the disk after all, the test fails instead of hanging
    give_up.start()
    flown, said = fly_recorded(tmp_path, queued=True)
    give_up.cancel()
    assert not stalled.is_set()
    stalled.set()
    for thread in threading.enumerate():
        if thread.name.startswith("log "):
            thread.join()
    assert flown == whole
    assert said == ["no more log: signals.mcap: the disk does not keep up"]


def test_what_waits_is_written_at_the_end(tmp_path: Path) -> None:
    file = QueuedFile(tmp_path / "log")
    for i in range(1000):
        file.write(bytes([i % 256]))
    file.close()
    file.close()
    assert (tmp_path / "log").read_bytes() == bytes(i % 256 for i in range(1000))
