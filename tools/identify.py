"""Fit a vehicle file to recorded flights of one module, with 95 % intervals; logs of the bench or of a real vehicle.

    .venv/bin/python tools/identify.py runs/shaken                                  # no reference: ratios only
    .venv/bin/python tools/identify.py runs/shaken --curve curve.toml --thruster 1 --accuracy 2
    .venv/bin/python tools/identify.py runs/shaken --weight 2.0:0.22:60:120 --hung-at 0 0 0.105
    .venv/bin/python tools/identify.py --excitation shake.toml                      # the flight to begin with

A log is a folder written by `modcube run --out` or `modcube hil run --out`; can.log and signals.mcap are read, truth.mcap is not.
Written to --out: identified.json; vehicle.toml with a reference and where no motion is missing; excite.toml where one is.
Exit status 0: everything within 10 %; 1: a motion is missing; 2: cannot run.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from command_line import Parser, refuse, run_tool

from argument_types import check_results, folder_for_results
from identify_excitation import MOTIONS, SPACE_M, check_space, excitation, is_seen_from_above, pace_of, why_no_roll
from identify_fit import Fit, Reference, fit
from identify_log import Recording, read_recording
from identify_model import Equations, Weight
from identify_motion import smooth
from identify_quantities import NO_SCALE, Finding, findings, fitted_vehicle, missing
from rich import box as box_style
from rich.console import Console
from rich.table import Table

from firmware_py.description.builder import build
from firmware_py.description.schema import DescriptionError, read_toml
from firmware_py.description.toml_text import to_toml
from firmware_py.description.vehicle import ThrusterCurve, Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle

FARTHEST_M = 10.0
"""Largest distance from the hull's middle, as the vehicle file permits for its parts."""
MOST_N, MOST_KG = 1e5, 1e4
"""Largest weight in water and mass in air of what hangs on the robot: twice the heaviest vehicle that a file may describe."""
RESULTS = ("identified.json", "vehicle.toml", "excite.toml")
"""Files that a run may leave in --out."""


def read_curve(path: Path) -> ThrusterCurve:
    """Reads a curve written by tools/fit_thruster.py. Raises DescriptionError."""
    table, source = read_toml(path)
    curve: ThrusterCurve = build(ThrusterCurve, table, source)
    return curve


def parse_weight(text: str, at_m: Sequence[float] | None = None) -> Weight:
    """Parses NEWTON:KG:FROM:UNTIL; `at_m` is where the weight hung. Raises DescriptionError."""
    try:
        newton, kg, from_s, until_s = (float(word) for word in text.split(":"))
    except ValueError:
        raise DescriptionError(
            f"--weight {text!r} is not NEWTON:KG:FROM:UNTIL, such as 2.0:0.22:60:120 (weight in water, mass in air, seconds of the log)"
        ) from None
    if not all(map(math.isfinite, (newton, kg, from_s, until_s))) or newton == 0.0 or kg < 0.0 or not 0.0 <= from_s < until_s:
        raise DescriptionError(f"--weight {text!r}: a weight other than 0, a mass of 0 or more, and a beginning before its end are needed")
    if abs(newton) > MOST_N or kg > MOST_KG:
        raise DescriptionError(f"--weight {text!r}: a weight of {MOST_N:g} N and a mass of {MOST_KG:g} kg at most are needed")
    if at_m is not None and not all(abs(m) <= FARTHEST_M for m in at_m):
        raise DescriptionError(f"--hung-at {' '.join(f'{m:g}' for m in at_m)}: three distances of {FARTHEST_M:g} m at most are needed")
    return Weight(newton, kg, from_s, until_s, None if at_m is None else (at_m[0], at_m[1], at_m[2]))


def check_hung(weight: Weight, flight: Equations) -> None:
    """Raises DescriptionError where the weight hung during all or none of the flight."""
    hung = (flight.time_s >= weight.from_s) & (flight.time_s < weight.until_s)
    if hung.all() or not hung.any():
        raise DescriptionError(
            f"--weight: it {'hung during all of' if hung.any() else 'did not hang during'} the log's armed time; it must hang for a part "
            "of it, for only the change tells a force"
        )


def reference_of(recording: Recording, thruster: int | None, accuracy_percent: float | None) -> Reference:
    """The load-cell curve as a reference, by default of the first thruster and accurate to 2 %. Raises DescriptionError."""
    thruster = 1 if thruster is None else thruster
    accuracy_percent = 2.0 if accuracy_percent is None else accuracy_percent
    count = len(recording.vehicle.thruster)
    if not 1 <= thruster <= count:
        raise DescriptionError(f"--thruster {thruster}: the vehicle has thrusters 1 to {count}")
    if not 0.0 < accuracy_percent <= 50.0:
        raise DescriptionError(f"--accuracy {accuracy_percent:g}: a percentage above 0 and up to 50 is needed")
    return Reference(thruster - 1, 0.01 * accuracy_percent)


def check_fitted(vehicle: Vehicle) -> None:
    """Raises DescriptionError for a vehicle whose flights cannot be fitted, so that none is flown in vain."""
    if vehicle.drag.quadratic.size:
        what = "its drag is published damping, and only cd_face and cd_edge can be fitted; give a file without drag.quadratic"
        raise DescriptionError(f"vehicle {vehicle.name}: {what}")
    if not vehicle.tag:
        raise DescriptionError(f"vehicle {vehicle.name}: it carries no tag; without poses nothing can be identified")


def check_excitation(path: Path) -> None:
    """Raises DescriptionError where `path` does not name a .toml file, or exists already."""
    if path.suffix != ".toml":
        raise DescriptionError(f"--excitation {path}: a scenario's file is a .toml file; give {path}.toml")
    if path.exists():
        raise DescriptionError(f"--excitation {path}: there already, and nothing is written over; give another name or delete it")


def write_excitation(path: Path, motions: Sequence[str], vehicle: Vehicle, name: str, space_m: Sequence[float]) -> None:
    """Writes a scenario that makes the `motions`, and prints how to fly it. Raises DescriptionError and OSError.

    Args:
        name: of the vehicle, or its file.
    """
    no_roll = why_no_roll(vehicle) if "turning" in motions else ""
    pace = pace_of(assemble_vehicle(vehicle))
    path.write_text(excitation(motions, name, space_m, no_roll=no_roll, curve=vehicle.curve, pace=pace), encoding="utf-8")
    if pace < 1.0:
        print(f"at {pace:.0%} of the usual pace, because {vehicle.name} is heavy for its thrusters")
    if not is_seen_from_above(vehicle):
        print(f"its camera looks down, and {vehicle.name} has no tag on top: put yours in its place, and leave out turns that hide the tag")
    if no_roll:
        print(f"left out: roll, because {no_roll}")
    print(f"fly it: .venv/bin/modcube hil run {shlex.quote(str(path))}")


def print_findings(found: Sequence[Finding]) -> None:
    """Prints the table of findings."""
    table = Table(box=box_style.SIMPLE_HEAD)
    for column in ("what", "value", "95 % interval", "", "unit"):
        table.add_column(column, justify="left" if column in ("what", "unit") else "right")
    for each in found:
        table.add_row(each.name, f"{each.value:.4g}", f"+-{each.half_width:.2g}", f"{min(each.share, 9.99):.1%}", each.unit)
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def write_results(out: Path, texts: Mapping[str, str]) -> None:
    """Writes the RESULTS in `texts` and deletes the others, so that all files there are of one run; prints what it deletes."""
    for name in RESULTS:
        if name in texts:
            (out / name).write_text(texts[name], encoding="utf-8")
        elif (out / name).exists():
            (out / name).unlink()
            print(f"deleted: {out / name}, of an earlier run")


def identify(given: argparse.Namespace) -> int:
    """Fits, prints and writes; returns the exit status. Raises DescriptionError and OSError."""
    check_space(given.space)
    if given.excitation is not None:
        check_excitation(given.excitation)
    if not given.logs:
        if given.excitation is None:
            raise DescriptionError("no LOG was given; give the folder of a flight, or --excitation FILE for the flight to begin with")
        vehicle = load_vehicle(given.vehicle)
        check_fitted(vehicle)
        write_excitation(given.excitation, list(MOTIONS), vehicle, given.vehicle, given.space)
        return 0
    if given.hung_at and not given.weight:
        raise DescriptionError("--hung-at says where a weight hung; give --weight with it")
    if given.curve is None and (given.thruster is not None or given.accuracy is not None):
        raise DescriptionError("--thruster and --accuracy tell of a measured curve; give --curve with them")
    weight = parse_weight(given.weight, given.hung_at) if given.weight else None
    if weight is not None and len(given.logs) > 1:
        raise DescriptionError("--weight says when the weight hung in one log; give one LOG with it")
    recordings = [read_recording(Path(log)) for log in given.logs]
    if len({to_toml(r.vehicle) for r in recordings}) > 1:
        raise DescriptionError(f"{given.logs[0]} and the others were flown by different vehicles; give logs of one")
    vehicle = recordings[0].vehicle
    check_fitted(vehicle)
    curve = read_curve(given.curve) if given.curve else vehicle.curve
    reference = reference_of(recordings[0], given.thruster, given.accuracy) if given.curve else None
    with folder_for_results(given.out):
        check_results(given.out, "has_reference", *RESULTS)
        flights = [Equations(recording, smooth(recording), curve, weight) for recording in recordings]
        if weight is not None:
            check_hung(weight, flights[0])
        return write_and_report(given, fit(flights, reference, weight is not None), recordings[0], curve)


def write_and_report(given: argparse.Namespace, result: Fit, recording: Recording, curve: ThrusterCurve) -> int:
    """Prints and writes the result of the fit with `curve`; returns the exit status. Raises OSError."""
    vehicle = recording.vehicle
    found, logs = findings(result, vehicle), ", ".join(given.logs)
    print_findings(found)
    wanted = missing(found)
    report = {"logs": given.logs, "has_reference": result.has_scale, "residual": result.residual.tolist(), "missing": wanted}
    report["gust_m_s"] = result.gust_m_s
    report["found"] = [each._asdict() for each in found]
    texts = {"identified.json": json.dumps(report, indent=2) + "\n"}
    if result.has_scale and not wanted:
        texts["vehicle.toml"] = to_toml(fitted_vehicle(result, vehicle, curve, logs))
    write_results(given.out, texts)
    if not result.has_scale:
        print(f"refused: {NO_SCALE}")
    if "vehicle.toml" in texts:
        print(given.out / "vehicle.toml")
    for motion, needing in wanted.items():
        print(f"missing excitation: {motion}, for {', '.join(needing)}")
    if wanted:
        write_excitation(given.excitation or given.out / "excite.toml", list(wanted), vehicle, recording.vehicle_name, given.space)
    return 1 if wanted else 0


def main() -> int:
    """Runs the tool; returns its exit status."""
    parser = Parser(description=__doc__)
    parser.add_argument("logs", nargs="*", metavar="LOG", help="folders of flights of one vehicle, a single module")
    parser.add_argument("--curve", type=Path, metavar="FILE", help="measured curve of one thruster, from tools/fit_thruster.py")
    parser.add_argument("--thruster", type=int, help="number of the measured thruster; the first one is 1 (default)")
    parser.add_argument("--accuracy", type=float, metavar="PERCENT", help="error bound of the scale of the load cell, 2 by default")
    parser.add_argument(
        "--weight", metavar="NEWTON:KG:FROM:UNTIL", default="", help="known weight that hung on the robot, between two times of the log"
    )
    parser.add_argument(
        "--hung-at", type=float, nargs=3, metavar="M",
        help="point at which the weight hung, x y z of the body; default: middle of the bottom"
    )
    parser.add_argument("--excitation", type=Path, metavar="FILE", help="scenario file to write, with the motions that are missing")
    parser.add_argument("--space", type=float, nargs=3, metavar="M", default=list(SPACE_M), help="free space to either side, world x y z")
    parser.add_argument("--vehicle", default="modcube", help="vehicle of the excitation flight when no log is given")
    parser.add_argument("--out", type=Path, metavar="DIR", default=Path("runs/identify"), help="folder for the results")
    try:
        return identify(parser.parse_args())
    except (DescriptionError, OSError) as error:
        return refuse("identify", error)


if __name__ == "__main__":
    run_tool(main)
