"""Every fault in one mode, and the matrix's verdict on flights that broke their promise. All modes: `modcube hil campaign faults`."""

import dataclasses
import json
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest

import hil.fault_campaign
from firmware_py.description.parameters import Parameters
from hil.fault_campaign import Cell, fly_cell, run_fault_campaign
from hil.fault_matrix import print_faults
from hil.fault_table import COLUMNS, ROWS, Row
from hil.plant.fault_spec import TAKES

BY_NAME = {row.name: row for row in ROWS}
ELSEWHERE = {"jets"}
"""Faults that only the load cell shows, tested elsewhere."""


def test_table_breaks_everything_that_can_break() -> None:
    assert {row.fault.kind for row in ROWS if row.fault} == set(TAKES) - ELSEWHERE
    assert len({row.name for row in ROWS}) == len(ROWS)


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_robot_that_holds_its_place_keeps_its_promise(row: Row) -> None:
    assert fly_cell(row, "POSHOLD", 0).broken == ()


@pytest.mark.slow
@pytest.mark.parametrize("mode", [mode for mode in COLUMNS if mode != "POSHOLD"])
def test_leak_brings_the_robot_up_from_every_mode(mode: str) -> None:
    cell = fly_cell(BY_NAME["leak"], mode, 0)
    assert cell.broken == ()
    assert cell.happened.startswith("as before" if mode == "SURFACE" else "SURFACE 0.6")


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["frames 20 ms late", "tags absent", "magnet dead"])
def test_body_that_docks_keeps_its_promise(fault: str) -> None:
    assert fly_cell(BY_NAME[fault], "DOCK", 0).broken == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "mode"),
    [("IMU frozen", "MOTOR_DETECT"), ("ground station silent", "MOTOR_DETECT"), ("thruster stuck at half", "AUTO")],
)
def test_robot_that_tumbles_or_is_turned_over_comes_to_rest(fault: str, mode: str) -> None:
    """One thruster after another at 3 N turns a module upside down; one stuck at half its speed turns it by 20 deg until it is left out."""
    assert fly_cell(BY_NAME[fault], mode, 0).broken == ()


@pytest.mark.slow
def test_fail_safe_that_was_switched_off_breaks_the_promise() -> None:
    deaf = Parameters().replace("failsafes.leak_action", 0)
    assert fly_cell(BY_NAME["leak"], "POSHOLD", 0, deaf).broken == (
        "ended in POSHOLD, not SURFACE", "did not say 'water in a cabin'",
    )  # fmt: skip


@pytest.mark.slow
def test_promise_of_less_error_than_there_is_is_broken() -> None:
    strict = dataclasses.replace(BY_NAME["pilot silent"], error_m=1e-4)
    (words,) = fly_cell(strict, "POSHOLD", 0).broken
    assert words.endswith("mm off")


def test_campaign_writes_every_cell_with_its_promise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hil.fault_campaign, "fly_cell", lambda row, mode, seed: Cell(row.name, mode, "as before", (), row.promise))
    cells = run_fault_campaign(partial(ThreadPoolExecutor, 1), tmp_path)
    entries = json.loads((tmp_path / "faults.json").read_text())
    assert len(cells) == len(entries) == len(ROWS) * len(COLUMNS)
    assert entries[0] == {
        "fault": "thruster dead", "mode": "MANUAL", "happened": "as before", "broken": [], "promise": "left out; 60 mm, 15 deg",
        "passed": True,
    }  # fmt: skip


def test_matrix_names_what_was_broken(capsys: pytest.CaptureFixture[str]) -> None:
    kept = Cell("leak", "AUTO", "as before", (), "surfaces")
    print_faults([kept, Cell("leak", "POSHOLD", "AUTO 1.00 s", ("ended in AUTO, not SURFACE",), "surfaces")])
    said = capsys.readouterr().out
    assert "FAILED: leak, POSHOLD: ended in AUTO, not SURFACE" in said
    assert "1 of 2 cells kept their promise" in said
