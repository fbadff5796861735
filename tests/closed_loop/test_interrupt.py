"""`modcube hil run` stopped by Ctrl-C twice in a row, as by impatient users, or by SIGTERM: prints one line, and the log is complete."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from firmware_py.runtime.flight_log import FlightLog
from hil.truth_log import TRUTH_LOG
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
PRESSED_TICK = 200
PROCESS = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
{die}
def press_twice():
    for _ in range(2):
        os.killpg(0, signal.{ending})  # as a terminal does, which tells all its processes
{how}
from firmware_py.__main__ import main
main()
"""
IN_FLIGHT = f"""
from firmware_py.runtime.recorder import Recorder
record = Recorder.record
def recorded(recorder, inputs, outputs):
    record(recorder, inputs, outputs)
    if outputs.tick == {PRESSED_TICK}:
        press_twice()
Recorder.record = recorded
"""
AT_START = """
from hil import bench
opened = bench.open_bench
def interrupted(*arguments):
    press_twice()
    return opened(*arguments)
bench.open_bench = interrupted
"""
AT_IMPORT = """
class Presser:
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            press_twice()
sys.meta_path.insert(0, Presser())
"""
AT_LOADING = """
from numba.core.codegen import CPUCodeLibrary
load, calls = CPUCodeLibrary._object_getbuffer_hook.__func__, []
def loaded(library, module):
    calls.append(module)
    if len(calls) == {call}:
        press_twice()
    return load(library, module)
CPUCodeLibrary._object_getbuffer_hook = classmethod(loaded)
"""


def run(folder: Path, how: str, *options: str, ending: str = "SIGINT", status: int = 128 + signal.SIGINT) -> str:
    """The stderr of a run that gets the signal twice, up to where the last of its processes has closed it."""
    (folder / "long.toml").write_text(LONG)
    program = PROCESS.format(ending=ending, die=DIE_WITH_TEST, how=how)
    words = [sys.executable, "-c", program, "hil", "run", "long.toml", "--out", "run", *options]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, start_new_session=True, timeout=DEADLINE_S)
    assert done.returncode == status, done.stderr
    return done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("realtime", [False, True], ids=["lockstep", "realtime"])
def test_flight_that_is_interrupted_twice_says_where_its_log_is_and_keeps_it_whole(realtime: bool, ending: str, tmp_path: Path) -> None:
    said = run(tmp_path, IN_FLIGHT, *(["--realtime", "--bus", free_group()] if realtime else []), ending=ending)
    assert said == "modcube: interrupted; the log up to then is in run\n"
    flown = FlightLog(tmp_path / "run")
    assert [logged.tick for logged in flown.ticks()][-1] == PRESSED_TICK and flown.torn == ""
    assert (tmp_path / "run" / TRUTH_LOG).read_bytes().endswith(b"\x89MCAP0\r\n")
    assert not (tmp_path / "run" / "result.json").exists()


@pytest.mark.slow
def test_plant_of_a_flight_that_is_killed_ends_with_it(tmp_path: Path) -> None:
    killed = IN_FLIGHT.replace("press_twice()", "os.kill(os.getpid(), signal.SIGKILL)")
    run(tmp_path, killed, "--realtime", "--bus", free_group(), status=-signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.parametrize("module", ["firmware_py.cli", "hil.bench"])
def test_run_that_is_interrupted_while_it_is_imported_leaves_nothing(module: str, tmp_path: Path) -> None:
    assert run(tmp_path, AT_IMPORT.format(module=module)) == ""
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.parametrize("call", [3, 40])
def test_run_that_is_interrupted_while_its_compiled_code_is_loaded_does_not_crash(call: int, tmp_path: Path) -> None:
    assert run(tmp_path, AT_LOADING.format(call=call)) == ""


@pytest.mark.slow
def test_run_that_is_interrupted_before_it_flies_says_so_and_leaves_nothing(tmp_path: Path) -> None:
    assert run(tmp_path, AT_START) == "modcube: interrupted; nothing was flown\n"
    assert not (tmp_path / "run").exists()
