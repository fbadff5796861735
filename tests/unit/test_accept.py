"""Figures that `make accept` reports were measured in its own run, or are missing."""

import json
import os
import subprocess
from pathlib import Path

import accept
import pytest
from accept_measures import LOGS, loop_margins, repeated
from argument_types import run_command


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


@pytest.mark.parametrize("text", ["{half", "{}", "[1]", '[{"name": "of bench.json"}]'])
def test_file_that_holds_no_figures_is_refused_before_anything_is_measured(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "accept.json"
    out.write_text(text)
    monkeypatch.setattr(accept, "GROUPS", ())
    monkeypatch.setattr("sys.argv", ["accept", "--out", str(out)])
    assert run_command(accept.app, "accept") == 2
    said = capsys.readouterr().err
    assert said.startswith(f"accept: {out}: no") and said.count("\n") == 1
    assert out.read_text() == text


def test_figures_of_earlier_runs_survive_a_disk_that_fills_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError("No space left on device")

    out = tmp_path / "accept.json"
    earlier = json.dumps([{"group": "hover"}])
    out.write_text(earlier)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        accept.write_outcomes(out, [], accept.GROUPS)
    assert out.read_text() == earlier
