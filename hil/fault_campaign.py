"""`modcube hil campaign faults`: every fault in every mode, what happened against what is promised."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from firmware_py.core.transitions import State
from firmware_py.core.types import Mode
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from hil.bench import fly_scenario
from hil.fault_table import AT_S, COLUMNS, DOCK, DOCKED, NAME, PLACED, ROWS, Row
from hil.flight import LOGS, flight_of
from hil.metrics import errors
from hil.plant.fault_spec import TAKES, Fault
from hil.replaceable import check_replaceable, created_folder, is_json_with
from hil.scenario import Scenario, load_scenario
from hil.signals import Flight
from hil.workers import Pool

SCENARIO, DOCK_SCENARIO = "faults", "faults-dock"
RESULT_FILE = "faults.json"
LEAD_S = 0.015
"""Includes the tick before the fault, so that an immediate change is seen as a change."""
BLAMED = re.compile(r"thruster \d+ of module \d+")
"""Thruster named in an event, as it is when one is left out."""
SETTLE_TICKS = 300
"""Time for the body to come to rest after a mode outside PLACED."""
KNOWN_NS = 1_000_000_000
"""Age of the last tag up to which the position counts as known."""


class Cell(NamedTuple):
    """One fault in one mode."""

    fault: str
    mode: str
    happened: str
    """In words."""
    broken: tuple[str, ...]
    """Promises that were not kept; empty if all were."""
    promise: str
    """What the robot promises about the fault, in words."""


def scenario_of(row: Row, mode: str) -> Scenario:
    """The scenario of one cell. In a dock, the active module alone is faulty, which is the first, unless the fault is one of the bus."""
    base = load_scenario(DOCK_SCENARIO if mode == DOCK else SCENARIO)
    task = dataclasses.replace(base.task, **(row.task if mode == DOCK else {"mode": mode, **row.task}))
    faults = (row.fault, *row.also) if row.fault is not None else ()
    if mode == DOCK:
        faults = tuple(_limited(fault, base.module[0].number) for fault in faults)
    return dataclasses.replace(base, task=task, fault=faults)


def _limited(fault: Fault, module: int) -> Fault:
    """The fault in the module with this number alone, if its kind can be restricted to one."""
    return dataclasses.replace(fault, module=module) if TAKES[fault.kind].one_module else fault


def fly_cell(row: Row, mode: str, seed: int, parameters: Parameters | None = None) -> Cell:
    """Flies one cell and judges it from its logs."""
    scenario = scenario_of(row, mode)
    with tempfile.TemporaryDirectory() as folder:
        fly_scenario(scenario, seed, parameters or Parameters(), Path(folder), f"virtual:{row.name}-{mode}-{seed}")
        flight = flight_of(scenario, Path(folder))
    return judge(row, mode, flight, load_vehicle(scenario.module[0].vehicle))


def judge(row: Row, mode: str, flight: Flight, vehicle: Vehicle) -> Cell:
    """What happened after the fault, and which promises it broke."""
    after = flight.between(round((AT_S - LEAD_S) * 1e9), 1 << 62)
    time_s = after.firmware["time_ns"] * 1e-9 - AT_S
    names = [_name(int(state), int(now)) for state, now in zip(after.firmware["state"], after.firmware["mode"], strict=True)]
    is_docked = after.firmware["tick"][-1] < after.ticks["tick"][-1]  # the active body is no more
    end, wanted = DOCKED if is_docked else names[-1], row.ends.get(mode, DOCKED if mode == DOCK else mode)
    changes = [i for i in range(1, len(names)) if names[i] != names[i - 1]]
    changes += [len(names) - 1] if is_docked else []
    reached_s = float(time_s[changes[-1]]) if changes else 0.0
    told = _told(flight)
    said_s = [at_s for text, at_s in told if row.says and row.says in text]
    error_m, angle_deg = worst_errors(after, names)
    blamed = {found[0] for text, _ in told for found in BLAMED.finditer(text)} - ({NAME} if row.leaves_out else set())
    broken = {
        f"was in {names[0]} when it began": names[0] != mode,
        f"left {mode} for {next((name for name in names if name != mode), end)}": wanted == mode and bool(changes),
        f"ended in {end}, not {wanted}": end != wanted,
        f"took {reached_s:.2f} s": mode in row.ends and reached_s > row.within_s,
        f"{error_m * 1e3:.0f} mm off": error_m > row.error_m,
        f"{angle_deg:.0f} deg off": angle_deg > row.angle_deg,
        f"did not say {row.says!r}": bool(row.says) and mode in row.says_in and not said_s,
        f"blamed {', '.join(sorted(blamed))}": bool(blamed) or (not row.leaves_out and any("left out" in text for text, _ in told)),
        **_wrong_commands(after.firmware["commanded_n"], names, vehicle),
    }
    happened = f"{end} {reached_s:.2f} s" if changes else "as before"
    happened += f", said {said_s[0]:.1f} s" if said_s and not changes else ""
    happened += f", {error_m * 1e3:.0f} mm" if np.isfinite(error_m) else ""
    return Cell(row.name, mode, happened, tuple(words for words, is_so in broken.items() if is_so), row.promise)


def _told(flight: Flight) -> list[tuple[str, float]]:
    """Texts of the firmware's events from the fault on, each with its time after the fault, s."""
    events = zip(flight.events["text"], flight.events["log_time"] * 1e-9 - AT_S, strict=True)
    return [(str(text), float(at_s)) for text, at_s in events if at_s >= 0.0]


def _wrong_commands(commanded: np.ndarray, names: Sequence[str], vehicle: Vehicle) -> dict[str, bool]:
    """Violations that no fault may cause, and whether each occurred. `commanded`: (k, t) N, in the states `names`."""
    still = np.array([name in ("DISARMED", "ESTOP") for name in names])
    return {
        "a command was no number": not np.isfinite(commanded).all(),
        "a command was beyond its limits": bool((commanded > vehicle.force_max_n).any() or (commanded < vehicle.force_min_n).any()),
        "a thruster turned while stopped": bool(commanded[still].any()),
    }


def worst_errors(flight: Flight, names: Sequence[str]) -> tuple[float, float]:
    """Largest distance from the set-point, m, and angle, deg, in the modes in PLACED; NaN without such ticks, infinite if an error is NaN.

    Leaves out the SETTLE_TICKS after any other mode, in which the body comes to rest, and ticks without recent tags, whose position is
    unknown.
    """
    placed, ticks = np.array([name in PLACED for name in names]), np.arange(len(names))
    lost = np.maximum.accumulate(np.where(placed, -SETTLE_TICKS, ticks))
    held = (ticks - lost >= SETTLE_TICKS) & (flight.firmware["tag_age_ns"] < KNOWN_NS)
    if not held.any():
        return float("nan"), float("nan")
    worst_m, worst_rad = (float(np.nan_to_num(each[held], nan=np.inf).max()) for each in errors(flight))
    return worst_m, math.degrees(worst_rad)


def _name(state: int, mode: int) -> str:
    return Mode(mode).name if state == State.ARMED else State(state).name


def run_fault_campaign(pool: Pool, out: Path, seed: int = 0, progress: Callable[[int, int], None] | None = None) -> list[Cell]:
    """Flies every cell and writes faults.json into `out`; returns the cells, row by row.

    Raises DescriptionError if `out` holds a flight, or a faults.json that no campaign of faults wrote.
    """
    with created_folder(out):
        check_replaceable(out, (RESULT_FILE, *LOGS), is_json_with(out / RESULT_FILE, "promise"), "campaign of faults")
        cells: list[Cell] = []
        with pool() as executor:
            futures = [executor.submit(fly_cell, row, mode, seed) for row in ROWS for mode in COLUMNS]
            for future in futures:
                cells.append(future.result())
                if progress is not None:
                    progress(len(cells), len(futures))
        entries = [{**cell._asdict(), "passed": not cell.broken} for cell in cells]
        (out / RESULT_FILE).write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")
    return cells
