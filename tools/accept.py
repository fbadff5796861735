"""`make accept`: every acceptance figure of the issues, long ones too; writes accept.json and prints it.

A figure belongs to a group, and a group to a command that anybody can type. New figures go into GROUPS at the end of
this file, nothing else changes. `--only GROUP` measures some of them and leaves the others in accept.json as they were.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from firmware_py.description.parameters import CONTROLLERS
from hil.campaign import run_campaign
from hil.checks import UNBOUNDED, limit_text
from hil.console import campaign_progress
from hil.scenario import load_scenario

OUT = Path("accept.json")
RUNS = Path("runs") / "accept"
SEEDS = range(20)
FEWER = range(8)
JOBS = 2
LOGS = ("can.log", "signals.mcap", "truth.mcap")
MM, DEG = 1e3, 57.29577951308232

Values = Mapping[str, float]


@dataclass(frozen=True)
class Figure:
    """One number that must be within low..high, both in `unit`, after `scale` was applied to what was measured."""

    name: str
    key: str
    low: float = -UNBOUNDED
    high: float = UNBOUNDED
    unit: str = ""
    scale: float = 1.0


@dataclass(frozen=True)
class Group:
    """Figures that one measurement gives."""

    name: str
    issue: int
    command: str
    measure: Callable[[Path], Values]
    figures: tuple[Figure, ...]


@dataclass(frozen=True)
class Outcome:
    """One entry of accept.json."""

    name: str
    value: float
    limit: str
    passed: bool
    command: str
    unit: str
    group: str
    issue: int


def outcomes(group: Group, values: Values) -> list[Outcome]:
    """The group's figures held against their limits; one that was not measured fails."""
    found = []
    for figure in group.figures:
        value = values.get(figure.key, float("nan")) * figure.scale
        passed = figure.low <= value <= figure.high
        limit = limit_text(figure.low, figure.high)
        found.append(Outcome(figure.name, value, limit, passed, group.command, figure.unit, group.name, group.issue))
    return found


def flown(scenario: str, controller: str = "modcube") -> Callable[[Path], Values]:
    """Flies all seeds; keys are `metric.quantile`, and `passed` is the share that passed every check."""

    def measure(folder: Path) -> Values:
        chosen, parameters = load_scenario(scenario), CONTROLLERS[controller]
        with campaign_progress(f"{scenario}, {controller}", len(SEEDS)) as progress:
            summary = run_campaign(chosen, parameters, SEEDS, JOBS, folder, progress=progress)
        values = {f"{m}.{q}": v for m, each in summary["metrics"].items() for q, v in each.items() if v is not None}
        return values | {"passed": summary["succeeded"] / summary["trials"]}

    return measure


def saved_by_least_power(folder: Path) -> Values:
    """Flies the Moebius strip in both modes of allocation: share of the supply's power saved, ratio of the position errors."""
    found = {}
    for name in ("modcube", "least_power"):
        with campaign_progress(f"mobius-1, {name}", len(FEWER)) as progress:
            summary = run_campaign(load_scenario("mobius-1"), CONTROLLERS[name], FEWER, JOBS, folder / name, progress=progress)
        found[name] = summary["metrics"]
    both = ("supply_power_w", "position_rmse_m")
    power, error = (found["least_power"][m]["median"] / found["modcube"][m]["median"] for m in both)
    return {"saved": 1.0 - power, "error": error}


def repeated(folder: Path) -> Values:
    """Flies one seed twice and another once: logs of the twin that differ, logs of the other that are the same."""
    for name, seed in (("first", 0), ("second", 0), ("other", 1)):
        command = [Path(sys.executable).with_name("modcube"), "hil", "run", "spiral", "--no-plots"]
        subprocess.run([*command, "--seed", str(seed), "--out", folder / name], capture_output=True)
    logs = {run: [(folder / run / log).read_bytes() for log in LOGS] for run in ("first", "second", "other")}
    pairs = [zip(logs["first"], logs[run], strict=True) for run in ("second", "other")]
    different, same = (sum(a != b for a, b in pairs[0]), sum(a == b for a, b in pairs[1]))
    return {"different": different, "same": same}


def timed(folder: Path) -> Values:
    """Lockstep's speed on one core, out of `make bench`'s own measurement."""
    code = "from bench_flight import measure_flight; print(*(measure_flight(0).speed for _ in range(5)))"
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    core = min(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    pinned = f"import os; os.sched_setaffinity(0, {{{core}}}); " if core is not None else ""
    done = subprocess.run(
        [sys.executable, "-c", pinned + code], check=True, capture_output=True, text=True, env=environment,
        cwd=Path(__file__).parent,
    )  # fmt: skip
    return {"speed": median(float(word) for word in done.stdout.split())}


def read_outcomes(path: Path) -> list[dict[str, Any]]:
    """What accept.json holds; nothing where there is none."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else []


def write_outcomes(path: Path, measured: Sequence[Outcome], known: Sequence[Group]) -> list[dict[str, Any]]:
    """Puts what was measured in place of the same groups' old entries, in the order of the groups; returns all."""
    again = {outcome.group for outcome in measured}
    entries = [entry for entry in read_outcomes(path) if entry["group"] not in again]
    entries += [asdict(outcome) for outcome in measured]
    order = {group.name: i for i, group in enumerate(known)}
    entries = sorted((e for e in entries if e["group"] in order), key=lambda e: order[e["group"]])
    path.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")
    return entries


def print_outcomes(entries: Sequence[Mapping[str, Any]]) -> None:
    """The table."""
    table = Table(title="acceptance figures", title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("issue", "figure", "value", "limit", ""):
        table.add_column(column, justify="right" if column in ("value", "limit") else "left")
    for e in entries:
        verdict = "passed" if e["passed"] else "FAILED"
        table.add_row(str(e["issue"]), e["name"], f"{e['value']:.4g} {e['unit']}", e["limit"], verdict)
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def main(
    only: Annotated[list[str] | None, typer.Option(help="group to measure; may be given again")] = None,
    out: Annotated[Path, typer.Option(help="where the entries go")] = OUT,
) -> None:
    """Measure the acceptance figures; status 1 when one of those measured fails."""
    names = [group.name for group in GROUPS]
    if unknown := set(only or ()) - set(names):
        raise typer.BadParameter(f"{', '.join(sorted(unknown))}: unknown; there are {', '.join(names)}")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # for the processes that fly
    measured: list[Outcome] = []
    for group in GROUPS:
        if only and group.name not in only:
            continue
        print(f"accept: {group.name} ({group.command})", file=sys.stderr, flush=True)
        folder = RUNS / group.name
        folder.mkdir(parents=True, exist_ok=True)
        measured += outcomes(group, group.measure(folder))
        write_outcomes(out, measured, GROUPS)
    print_outcomes(write_outcomes(out, measured, GROUPS))
    raise typer.Exit(0 if all(outcome.passed for outcome in measured) else 1)


GROUPS: tuple[Group, ...] = (
    Group(
        "hover", 2, "modcube hil campaign hover --trials 20 --jobs 2", flown("hover"),
        (
            Figure("hover, 20 seeds: position RMSE, worst", "position_rmse_m.max", high=5.0, unit="mm", scale=MM),
            Figure("hover, 20 seeds: share that passed its checks", "passed", low=1.0),
        ),
    ),
    Group(
        "spiral", 2, "modcube hil campaign spiral --trials 20 --jobs 2", flown("spiral"),
        (
            Figure("spiral, 20 seeds: position RMSE, median", "position_rmse_m.median", high=5.0, unit="mm", scale=MM),
            Figure("spiral, 20 seeds: position RMSE, worst", "position_rmse_m.max", high=8.0, unit="mm", scale=MM),
            Figure("spiral, 20 seeds: attitude RMSE, worst", "attitude_rmse_rad.max", high=1.5, unit="deg", scale=DEG),
        ),
    ),
    Group(
        "paper", 2, "modcube hil campaign spiral --trials 20 --jobs 2 --controller paper", flown("spiral", "paper"),
        (
            Figure(
                "paper's controller, same 20 seeds: position RMSE, median (paper's tank: 20.92 mm)",
                "position_rmse_m.median", low=8.0, high=40.0, unit="mm", scale=MM,
            ),
        ),
    ),
    Group(
        "determinism", 2, "modcube hil run spiral --seed 0, twice; then --seed 1", repeated,
        (
            Figure("same seed twice: logs that differ, of three", "different", high=0.0),
            Figure("another seed: logs that are the same, of three", "same", high=0.0),
        ),
    ),
    Group(
        "speed", 2, "make bench", timed,
        (Figure("spiral in lockstep with recorder and real frames, one core", "speed", low=25.0, unit="x real time"),),
    ),
    Group(
        "least-power", 10, "modcube hil campaign mobius-1 --trials 8 --jobs 2 --controller least_power, and without it",
        saved_by_least_power,
        (
            Figure("Moebius strip: electrical power that least_power saves, median", "saved", low=5.0, unit="%", scale=100.0),
            Figure("Moebius strip: its position RMSE over that of least squares, medians", "error", high=1.05),
        ),
    ),
    # Figures of later issues go here.
)  # fmt: skip


if __name__ == "__main__":
    typer.run(main)
