"""tune_gains is killed, with its workers, between two trials: started again, it ends in the bytes of a run that was left alone."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.clients.bench_process import ROOT
from tests.closed_loop.short_hover import SCENARIO

TRIALS = 4
FILES = ("search.jsonl", "parameters.toml", "tuning.json")


def objective(folder: Path) -> Path:
    """One parameter, one hover of seconds."""
    scenario, path = folder / "short.toml", folder / "objective.toml"
    scenario.write_text(SCENARIO)
    path.write_text(
        f'help = "short"\nseeds = [0]\nunseen_seeds = [1]\nflight = [{{ scenario = "{scenario}" }}]\n'
        'search = [{ parameter = "control.position_bandwidth", low = 0.6, high = 4.0 }]\n'
        'term = [{ metric = "position_rmse_m", per = 0.001 }]\n'
    )
    return path


def tune(path: Path, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, str(ROOT / "tools/tune_gains.py"), str(path), "--trials", str(TRIALS), "--jobs", "1", "--no-plots"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen([*command, "--out", str(out)], stdout=subprocess.PIPE, env=environment, start_new_session=True)


@pytest.mark.slow
def test_tuning_that_was_killed_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    path, whole, torn = objective(tmp_path), tmp_path / "whole", tmp_path / "torn"
    with tune(path, whole) as process:
        process.communicate()
    assert process.returncode == 0
    with tune(path, torn) as process:
        assert process.stdout is not None and b"trial    1 of 4" in process.stdout.readline()
        os.killpg(process.pid, signal.SIGKILL)
    kept = (torn / "search.jsonl").read_bytes()
    assert kept.count(b'"totals"') in range(1, TRIALS)
    with tune(path, torn) as process:
        said, _ = process.communicate()
    assert process.returncode == 0 and b"trial    1 of 4" not in said
    assert (torn / "search.jsonl").read_bytes().startswith(kept)
    assert [(torn / name).read_bytes() for name in FILES] == [(whole / name).read_bytes() for name in FILES]
