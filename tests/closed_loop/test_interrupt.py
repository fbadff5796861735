"""`modcube hil run` that somebody stops with Ctrl-C, and again, as impatient people do: one line, and the log is whole."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from firmware_py.runtime.flight_log import FlightLog
from hil.signals import TRUTH_LOG
from tests.closed_loop.processes import DEADLINE_S, DIE_WITH_TEST, free_group

LONG = """
name = "long"
help = "a hover that nobody waits for"
module = [{ number = 1, position_m = [0.0, 0.0, 0.4] }]
camera = [{}]
tank = {}
check = [{ metric = "position_rmse_m", high = 0.1 }]
task = { kind = "hover", settle_s = 3.0, duration_s = 6000.0, centre_m = [0.0, 0.0, 0.4] }
"""
FROM_THE_START = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {DIE_WITH_TEST}"
COMMAND = [sys.executable, "-c", f"{FROM_THE_START}; from firmware_py.__main__ import main; print('begun', flush=True); main()"]


def start(folder: Path, *options: str) -> subprocess.Popen[str]:
    (folder / "long.toml").write_text(LONG)
    words = ["hil", "run", "long.toml", "--out", "run", *options]
    return subprocess.Popen(
        [*COMMAND, *words], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def press_twice(process: subprocess.Popen[str], between_s: float) -> str:
    """As a terminal does, which tells all its processes. Returns what is said on stderr."""
    for pause_s in (between_s, 0.0):
        os.killpg(process.pid, signal.SIGINT)
        time.sleep(pause_s)
    _, said = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 130, said
    return said


@pytest.mark.slow
@pytest.mark.parametrize("realtime", [False, True], ids=["lockstep", "realtime"])
@pytest.mark.parametrize("between_s", [0.0, 0.05])
def test_flight_that_is_interrupted_twice_says_where_its_log_is_and_keeps_it_whole(
    between_s: float, realtime: bool, tmp_path: Path
) -> None:
    process = start(tmp_path, *(["--realtime", "--bus", free_group()] if realtime else []))
    log = tmp_path / "run" / "can.log"
    while not (log.exists() and log.stat().st_size > 200_000):
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    assert press_twice(process, between_s) == "modcube: interrupted; the log up to then is in run\n"
    flown = FlightLog(tmp_path / "run")
    ticks = [logged.tick for logged in flown.ticks()]
    assert len(ticks) > 100 and flown.torn == ""
    assert (tmp_path / "run" / TRUTH_LOG).read_bytes().endswith(b"\x89MCAP0\r\n")
    assert not (tmp_path / "run" / "result.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("after_s", [0.0, 0.3, 1.0, 2.0])
def test_run_that_is_interrupted_before_it_flies_says_so_or_nothing_and_leaves_nothing(after_s: float, tmp_path: Path) -> None:
    process = start(tmp_path)
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    time.sleep(after_s)
    said = press_twice(process, 0.01)
    assert said in ("", "modcube: interrupted; nothing was flown\n", "modcube: interrupted; the log up to then is in run\n")
    assert "the log" in said or not (tmp_path / "run").exists()
