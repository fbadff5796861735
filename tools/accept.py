"""`make accept`: measures every acceptance figure of the issues, including the slow ones; writes accept.json and prints it.

Each figure belongs to a group, and each group has a command that anybody can run. New figures go into GROUPS at the end of this file;
nothing else changes. `--only GROUP` measures the named groups and leaves the other entries of accept.json as they were.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from command_line import run_tool

import typer
from accept_figures import Figure, Group, reported_by_test
from accept_ground import GROUND
from accept_measures import (
    Values,
    campaign_of,
    characterised,
    identified_plants,
    loop_margins,
    near_miss_passes,
    repeated,
    said_by_tests,
    saved_by_least_power,
    timed,
)
from accept_safety import SAFETY
from accept_tuning import TUNING
from argument_types import make_room, run_command
from readme_tables import read_source
from rich import box
from rich.console import Console
from rich.table import Table

from firmware_py.description.schema import DescriptionError
from firmware_py.ground.files import write_atomically
from hil.checks import limit_text

OUT = Path("accept.json")
RUNS = Path("runs") / "accept"
MM, DEG = 1e3, 57.29577951308232
app = typer.Typer(add_completion=False)
ON_TIME = ("alone", "beside four busy loops", "200 Hz", "200 Hz beside four busy loops")


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
    """Checks a group's measured values against the limits of its figures; a figure that was not measured fails."""
    found = []
    for figure in group.figures:
        value = float(values.get(figure.key, float("nan"))) * figure.scale
        passed = figure.low <= value <= figure.high
        limit = limit_text(figure.low, figure.high)
        found.append(Outcome(figure.name, value, limit, passed, group.command, figure.unit, group.name, group.issue))
    return found


def read_outcomes(path: Path) -> list[dict[str, Any]]:
    """Entries of accept.json; an empty list when the file does not exist. Raises DescriptionError where it holds anything else."""
    try:
        entries = read_source(path) if path.exists() else []
    except ValueError as error:
        raise DescriptionError(str(error)) from None
    if any("group" not in entry for entry in entries):
        raise DescriptionError(f"{path}: not the figures of an earlier run; give another --out or delete it")
    return list(entries)


def write_outcomes(path: Path, measured: Sequence[Outcome], known: Sequence[Group]) -> list[dict[str, Any]]:
    """Replaces the entries of the measured groups in accept.json, in the order of `known`; drops those of unknown groups. Returns all."""
    again = {outcome.group for outcome in measured}
    entries = [entry for entry in read_outcomes(path) if entry["group"] not in again]
    entries += [asdict(outcome) for outcome in measured]
    order = {group.name: i for i, group in enumerate(known)}
    entries = sorted((e for e in entries if e["group"] in order), key=lambda e: order[e["group"]])
    write_atomically(path, (json.dumps(entries, indent=2) + "\n").encode())
    return entries


def print_outcomes(entries: Sequence[Mapping[str, Any]]) -> None:
    """Prints the entries as a table."""
    table = Table(title="acceptance figures", title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("issue", "figure", "value", "limit", ""):
        table.add_column(column, justify="right" if column in ("value", "limit") else "left")
    for e in entries:
        verdict = "passed" if e["passed"] else "FAILED"
        table.add_row(str(e["issue"]), e["name"], f"{e['value']:.4g} {e['unit']}", e["limit"], verdict)
    Console(width=None if sys.stdout.isatty() else 120).print(table)


@app.command()
def main(
    only: Annotated[list[str] | None, typer.Option(help="group to measure; may be given more than once")] = None,
    out: Annotated[Path, typer.Option(help="file for the measured entries")] = OUT,
) -> None:
    """Measure the acceptance figures; status 1 when one of those measured fails."""
    names = [group.name for group in GROUPS]
    if unknown := set(only or ()) - set(names):
        raise typer.BadParameter(f"{', '.join(sorted(unknown))}: unknown; there are {', '.join(names)}")
    make_room(out)
    read_outcomes(out)  # before the hours of work start
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


def strip(modules: int, sensors: str) -> Group:
    """The Moebius strip, ten seeds. With ideal sensors the limits test the control alone, and the median has one too."""
    ideal = sensors == "ideal"
    title = f"Moebius strip, {modules} module{'s' if modules > 1 else ''}, {sensors} sensors, 10 seeds"
    median = Figure(f"{title}: position RMSE, median", "position_rmse_m.median", high=4.4, unit="mm", scale=MM)
    figures = (
        *([median] if ideal else []),
        Figure(f"{title}: position RMSE, worst", "position_rmse_m.max", high=5.5 if ideal else 7.0, unit="mm", scale=MM),
        Figure(f"{title}: attitude RMSE, worst", "attitude_rmse_rad.max", high=2.5, unit="deg", scale=DEG),
    )
    scenario = f"mobius-{modules}"
    command = f"modcube hil campaign {scenario} --trials 10 --jobs 2{' --sensors ideal' if ideal else ''}"
    return Group(f"{scenario}-ideal" if ideal else scenario, 4, command, campaign_of(scenario, trials=10, sensors=sensors), figures)


GROUPS: tuple[Group, ...] = (
    Group(
        "hover", 2, "modcube hil campaign hover --trials 20 --jobs 2", campaign_of("hover"),
        (
            Figure("hover, 20 seeds: position RMSE, worst", "position_rmse_m.max", high=5.0, unit="mm", scale=MM),
            Figure("hover, 20 seeds: share that passed its checks", "passed", low=1.0),
        ),
    ),
    Group(
        "spiral", 2, "modcube hil campaign spiral --trials 20 --jobs 2", campaign_of("spiral"),
        (
            Figure("spiral, 20 seeds: position RMSE, median", "position_rmse_m.median", high=5.0, unit="mm", scale=MM),
            Figure("spiral, 20 seeds: position RMSE, worst", "position_rmse_m.max", high=8.0, unit="mm", scale=MM),
            Figure("spiral, 20 seeds: attitude RMSE, worst", "attitude_rmse_rad.max", high=1.5, unit="deg", scale=DEG),
            Figure("spiral, 20 seeds: tags' NIS over its expectation, least", "nis_mean.min", low=0.7),
            Figure("spiral, 20 seeds: tags' NIS over its expectation, largest", "nis_mean.max", high=1.4),
            Figure("spiral, 20 seeds: truth inside 3 sigma, worst seed and axis", "sigma3_share.min", low=97.0, unit="%", scale=100.0),
        ),
    ),
    Group(
        "paper", 2, "modcube hil campaign spiral --trials 20 --jobs 2 --controller paper", campaign_of("spiral", "paper"),
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
        (
            Figure("spiral in lockstep with recorder and real frames, one core", "speed", low=25.0, unit="x real time"),
            Figure("the same core at that time: ten million additions in plain Python", "additions", unit="s"),
            Figure("the same core at that time: one of a chain of dependent loads from 8 MB", "load", unit="ns"),
        ),
    ),
    Group(
        "least-power", 10, "modcube hil campaign mobius-1 --trials 8 --jobs 2 --controller least_power, and without it",
        saved_by_least_power,
        (
            Figure("Moebius strip: electrical power that least_power saves, median", "saved", low=5.0, unit="%", scale=100.0),
            Figure("Moebius strip: its position RMSE over that of least squares, medians", "error", high=1.05),
        ),
    ),
    *(strip(modules, sensors) for modules in (1, 2, 4) for sensors in ("ideal", "real")),
    Group(
        "polycube", 4, "modcube hil campaign polycube --trials 20 --jobs 2", campaign_of("polycube"),
        (
            Figure(
                "random polycubes of 2 to 8 modules, 20: position RMSE, worst", "position_rmse_m.max", high=15.0, unit="mm", scale=MM
            ),
        ),
    ),
    Group(
        "dock", 5, "modcube hil campaign dock --trials 1000 --jobs 2", campaign_of("dock", trials=1000),
        (
            Figure("dock, 1000 trials: lower 95 % bound of success", "passed.low", low=98.0, unit="%", scale=100.0),
            Figure("dock: step of a thruster's command when bodies join, worst", "join_jump_n.max", high=1.0, unit="N"),
        ),
    ),
    Group(
        "dock-paper", 5, "modcube hil campaign dock --trials 200 --jobs 2 --controller paper_sequence",
        campaign_of("dock", "paper_sequence", 200),
        (
            Figure("dock, the paper's sequence, 200 trials: docked", "passed", low=60.0, high=97.0, unit="%", scale=100.0),
            Figure("the same: of the failures, jams", "failed.jammed", low=50.0, unit="%", scale=100.0),
        ),
    ),
    Group(
        "dock-paper-whole", 5, "modcube hil campaign dock --trials 200 --jobs 2 --controller paper", campaign_of("dock", "paper", 200),
        (
            Figure("dock, the paper's sequence, controller and filter, 200 trials: docked", "passed", low=0.0, unit="%", scale=100.0),
            Figure("the same: of the failures, jams", "failed.jammed", low=50.0, unit="%", scale=100.0),
        ),
    ),
    Group(
        "dock-near-miss", 5, "modcube hil campaign dock-near-miss --trials 300 --jobs 2", campaign_of("dock-near-miss", trials=300),
        (Figure("near miss, 300 flown: docks declared falsely", "false_declarations.max", high=0.0),),
    ),
    Group(
        "near-miss-passes", 5, "make accept ONLY=near-miss-passes", near_miss_passes,
        (
            Figure("near miss, 10,000 passes through real frames: docks declared", "declared", high=0.0),
            Figure("the same, by the current alone", "current", low=1.0),
            Figure("the same, by the position alone", "position", low=1.0),
        ),
    ),
    Group(
        "dock-third", 5, "modcube hil campaign dock-third --trials 100 --jobs 2", campaign_of("dock-third", trials=100),
        (Figure("a third module joins a pair, 100 trials: docked", "passed", low=95.0, unit="%", scale=100.0),),
    ),
    Group(
        "dock-vertical", 5, "modcube hil campaign dock-vertical --trials 100 --jobs 2", campaign_of("dock-vertical", trials=100),
        (Figure("one above the other, second tag source, 100 trials: docked", "passed", low=95.0, unit="%", scale=100.0),),
    ),
    Group(
        "dock-vertical-blind", 5, "modcube hil campaign dock-vertical-blind --trials 100 --jobs 2",
        campaign_of("dock-vertical-blind", trials=100),
        (Figure("the same without the second tag source, 100 trials: refused, nothing touched", "passed", low=1.0),),
    ),
    Group(
        "dock-mobius", 5, "modcube hil campaign dock-mobius --trials 10 --jobs 2", campaign_of("dock-mobius", trials=10),
        (
            Figure("dock, Moebius strip as one, undock, 10 trials: passed", "passed", low=1.0),
            Figure("joined pair on the strip: position RMSE, worst", "docked_rmse_m.max", high=7.0, unit="mm", scale=MM),
        ),
    ),
    Group(
        "margins", 9, "python tools/margins.py", loop_margins,
        (
            Figure("loop broken at the plant's input, least gain margin of 18", "nominal.gain_db", low=8.0, unit="dB"),
            Figure("loop broken at the plant's input, least phase margin of 18", "nominal.phase_deg", low=40.0, unit="deg"),
            Figure("the same, worst over mass, inertia and lag +-15 %: gain", "worst.gain_db", low=6.0, unit="dB"),
            Figure("the same, worst over mass, inertia and lag +-15 %: phase", "worst.phase_deg", low=35.0, unit="deg"),
        ),
    ),
    Group(
        "identify", 9, "python tools/identify_plants.py --plants 10 --jobs 2", identified_plants,
        (
            Figure(
                "10 plants identified from 3-minute logs, load cell +-2 %: total mass, worst error",
                "mass", high=10.0, unit="%", scale=100.0,
            ),
            Figure("the same: drag coefficients, worst error", "drag", high=10.0, unit="%", scale=100.0),
            Figure("the same: relative thruster gains, worst error", "gain", high=10.0, unit="%", scale=100.0),
            Figure("the same: 95 % intervals that hold the truth", "covered", low=85.0, unit="%", scale=100.0),
            Figure("the same logs without the load cell: masses stated", "stated", high=0.0),
        ),
    ),
    Group(
        "vcan", 3, "MODCUBE_FULL=1 pytest -s tests/vcan/test_in_guest.py", said_by_tests("tests/vcan/test_in_guest.py"),
        (
            reported_by_test("spiral in lockstep over vcan0: lines of can.log that differ from virtual", high=0.0),
            reported_by_test("log played back by canplayer: frames that decode to the same messages", low=50_000.0),
            reported_by_test("lockstep over vcan, link events, sum", low=1000.0),
            reported_by_test("lockstep over vcan, link events: resumed within", high=0.5, unit="s"),
            Figure("tests on vcan0 in lockstep that failed", "failed", high=0.0),
        ),
    ),
    Group(
        "vcan-real-time", 3, "MODCUBE_FULL=1 pytest -s tests/vcan/test_realtime_in_guest.py",
        said_by_tests("tests/vcan/test_realtime_in_guest.py"),
        (
            *(reported_by_test(f"real time on vcan0, {name}: p99 lateness", high=100.0, unit="us") for name in ON_TIME),
            *(reported_by_test(f"real time on vcan0, {name}: overruns", high=0.0) for name in ON_TIME),
            reported_by_test("real time on vcan0, in a flood of cangen: position RMSE", high=8.0, unit="mm"),
            reported_by_test("real time on vcan0, link events, sum", low=1000.0),
            reported_by_test("real time on vcan0, link events: resumed within", high=0.5, unit="s"),
            reported_by_test("real time on vcan0, C node: position RMSE", high=8.0, unit="mm"),
            Figure("tests on vcan0 in real time that failed", "failed", high=0.0),
        ),
    ),
    Group(
        "capability", 10, "python tools/characterise.py modcube, and --table1 --out DIR", characterised,
        (
            Figure("capability of one module: the whole command, median of 3", "module", high=2.0, unit="s"),
            Figure("Table I, seven vehicles: the whole command with figure and report, median of 3", "table1", high=60.0, unit="s"),
        ),
    ),
    *GROUND,
    *SAFETY,
    Group(
        "vehicle-process", 8, "MODCUBE_FULL=1 pytest -s tests/closed_loop/test_vehicle_process.py",
        said_by_tests("tests/closed_loop/test_vehicle_process.py"),
        (
            reported_by_test("vehicle's process, warm cache: armed and holding after", high=3.0, unit="s"),
            reported_by_test("vehicle's process, killed: armed and holding again after", high=4.0, unit="s"),
            reported_by_test("vehicle's process: peak of memory", high=250.0, unit="MB"),
            Figure("tests on the vehicle's process that failed", "failed", high=0.0),
        ),
    ),
    Group(
        "flash", 8, "make test-flash", said_by_tests("tests/jetson"),
        (
            reported_by_test("flashed Debian machine: modules that answer its service", low=1.0, high=1.0),
            reported_by_test("flashed Debian machine: releases rolled back by itself", low=1.0, high=1.0),
            reported_by_test("flashed Debian machine: power cuts survived", low=1.0, high=1.0),
            Figure("tests on a flashed Debian machine that failed", "failed", high=0.0),
        ),
    ),
    *TUNING,
    # Figures of later issues go here.
)  # fmt: skip


if __name__ == "__main__":
    run_tool(partial(run_command, app, "accept"))
