"""tune_gains is killed, with its workers, between two trials; started again, it ends with the same bytes as an undisturbed run."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import tune_gains

from tests.clients.bench_process import ROOT
from tests.closed_loop.short_hover import SCENARIO
from tests.unit.campaigns import Inline

TRIALS = 4
FILES = ("search.jsonl", "parameters.toml", "tuning.json")


def objective(folder: Path) -> Path:
    """Writes an objective with one parameter and one hover of a few seconds; returns its path."""
    scenario, path = folder / "short.toml", folder / "objective.toml"
    scenario.write_text(SCENARIO)
    path.write_text(
        f'help = "short"\nseeds = [0]\nunseen_seeds = [1]\nflight = [{{ scenario = "{scenario}" }}]\n'
        'search = [{ parameter = "control.position_bandwidth", low = 0.6, high = 4.0 }]\n'
        'term = [{ metric = "position_rmse_m", per = 0.001 }]\n'
    )
    return path


def words(path: Path, out: Path) -> list[str]:
    """The command line of tune_gains."""
    return [str(ROOT / "tools/tune_gains.py"), str(path), "--trials", str(TRIALS), "--jobs", "1", "--no-plots", "--out", str(out)]


@pytest.mark.slow
def test_tuning_that_was_killed_goes_on_to_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The runs that are not killed tune in this process."""
    path, whole, torn = objective(tmp_path), tmp_path / "whole", tmp_path / "torn"
    monkeypatch.setattr(tune_gains, "processes", lambda jobs: Inline)

    def tuned(out: Path) -> str:
        monkeypatch.setattr("sys.argv", words(path, out))
        assert tune_gains.main() == 0
        return capsys.readouterr().out

    assert "trial    1 of 4" in tuned(whole)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *words(path, torn)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, start_new_session=True) as process:
        assert process.stdout is not None and b"trial    1 of 4" in process.stdout.readline()
        os.killpg(process.pid, signal.SIGKILL)
    kept = (torn / "search.jsonl").read_bytes()
    assert kept.count(b'"totals"') in range(1, TRIALS)
    assert "trial    1 of 4" not in tuned(torn)
    assert (torn / "search.jsonl").read_bytes().startswith(kept)
    assert [(torn / name).read_bytes() for name in FILES] == [(whole / name).read_bytes() for name in FILES]
