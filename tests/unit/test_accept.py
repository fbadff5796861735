"""Figures that `make accept` reports were measured in its own run, or are missing."""

import json
import subprocess
from pathlib import Path

import pytest
from accept_measures import LOGS, loop_margins, repeated


@pytest.mark.parametrize("measure", [loop_margins, repeated])
def test_figures_of_an_earlier_run_are_not_those_of_one_that_fails(measure, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    row = {"gain_db": 9.0, "phase_deg": 45.0}
    (tmp_path / "margins.json").write_text(json.dumps([row | {"kind": kind} for kind in ("nominal", "worst")]))
    for run in ("first", "second", "other"):
        (tmp_path / run).mkdir()
        for log in LOGS:
            (tmp_path / run / log).write_text(run)
    monkeypatch.setattr(subprocess, "run", lambda command, **how: subprocess.CompletedProcess(command, 2))
    with pytest.raises(FileNotFoundError):
        measure(tmp_path)
