"""Fit the paper's fifth-order polynomials to a thruster's load-cell measurement, monotonic throughout as the vehicle file requires.

    .venv/bin/python tools/fit_thruster.py bench.csv --voltage 12 --out curve.toml

The CSV has a header: command (-1 to 1), force_n, and if measured voltage_v and power_w, above 0 wherever the thruster pushes. Both are
scaled to one voltage as those of a T200 go with it. Power measured at the command nearest zero, where nothing pushes, is that of the
electronics, which a vehicle file counts separately (idle_w), and is subtracted first. The output is the fields of a vehicle file's [curve],
for that file or for --curve of tools/identify.py; what was not measured (power, lag, speed) comes from --vehicle.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import tomllib
from pathlib import Path

from command_line import Parser, refuse, run_tool

import numpy as np
from argument_types import make_room
from scipy.optimize import nnls

from firmware_py.core.limiter import VOLTAGE_EXPONENT
from firmware_py.description.builder import build
from firmware_py.description.schema import DescriptionError, Source, describe, did_you_mean, frozen_array, limits_of, read_toml
from firmware_py.description.toml_text import to_toml
from firmware_py.description.vehicle import ThrusterCurve
from firmware_py.description.vehicle_file import load_vehicle

DEGREE = 5
LEAST_SLOPE = 1e-3
"""Least slope, as a share of the mean slope: no curve is flat anywhere."""
LEAST_POINTS = 6
"""Required on either side, beyond the deadband."""
LOST = 10.0
"""Force at a smaller command, as a multiple of --zero, above which a reading of zero is a lost one and no deadband: noise
of a load cell does not come near it (synthetic)."""
COLUMNS = ("command", "force_n")
OPTIONAL = ("voltage_v", "power_w")
MOST = 1e6
"""Largest magnitude of any number read; no thruster reaches it in W or N."""
VOLTAGE = limits_of(ThrusterCurve, "voltage_v")
POWER_EXPONENT = 2.1
"""Exponent of power over supply voltage at a fixed command: T200 at 16 V against 12 V from a third of full command up, median of 150 pairs
of the maker's table (t200_16v.csv, t200_12v.csv). A motor of no resistance, whose speed went with the voltage, would have 3."""


def rising_polynomial(x: np.ndarray, y: np.ndarray, end: float, least: float) -> np.ndarray:
    """(5,) coefficients c of c[0] x + ... + c[4] x^5: the least-squares fit to (k,) points whose slope is at least `least` / end on 0..end.

    The slope is a sum of Bernstein polynomials of degree 4 with positive coefficients, found by non-negative least squares (Lawson and
    Hanson 1974); a non-negative slope that would need a negative coefficient is approximated.
    """
    basis = np.zeros((DEGREE, DEGREE))
    for i in range(DEGREE):  # slope binom(4, i) t^i (1-t)^(4-i), t = x / end, integrated
        for k in range(DEGREE - i):
            basis[i, i + k] = math.comb(4, i) * math.comb(4 - i, k) * (-1.0) ** k / (i + k + 1)
    powers = (x[:, None] / end) ** np.arange(1, DEGREE + 1)
    shares, _ = nnls(powers @ basis.T, y - least * powers @ basis.sum(axis=0))
    return np.asarray((shares + least) @ basis / end ** np.arange(1, DEGREE + 1))


def read_points(path: Path) -> dict[str, np.ndarray]:
    """Reads the columns of the CSV. Raises DescriptionError and OSError."""
    rows = _rows(path)
    points = {}
    for name in (*COLUMNS, *OPTIONAL):
        if name in rows[0][1]:
            points[name] = np.array([_number(row[name], path, line) for line, row in rows])
    for name, low, high, permitted in (("command", -1.0, 1.0, "-1 to 1"), ("voltage_v", VOLTAGE.low, VOLTAGE.high, describe(VOLTAGE))):
        wrong = np.flatnonzero((points[name] < low) | (points[name] > high)) if name in points else np.array([])
        if wrong.size:
            raise DescriptionError(f"{path}:{rows[wrong[0]][0]}: {name} {points[name][wrong[0]]:g} is out of range; permitted: {permitted}")
    return points


def _rows(path: Path) -> list[tuple[int, dict[str, str | None]]]:
    """Reads the rows, each with its line in the file: at least one, each with COLUMNS."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            header = list(reader.fieldnames or [])
            lacking = [name for name in COLUMNS if name not in header]
            if lacking:
                raise DescriptionError(
                    f"{path}:1: no column {', '.join(lacking)}; the header needs command,force_n (and voltage_v, power_w)"
                )
            for name in header:
                if name not in (*COLUMNS, *OPTIONAL) and (hint := did_you_mean(name, [n for n in OPTIONAL if n not in header])):
                    raise DescriptionError(f"{path}:1: column '{name}' is unknown; {hint}else give it another name or leave it out")
            rows = [(reader.line_num, _whole(row, path, reader.line_num)) for row in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise DescriptionError(f"{path}: is no CSV in UTF-8: {error}") from None
    if not rows:
        raise DescriptionError(f"{path}: no measurement follows the header")
    return rows


def _whole(row: dict[str, str | None], path: Path, line: int) -> dict[str, str | None]:
    """Returns a row that has no more columns than the header. Raises DescriptionError."""
    if None in row:
        raise DescriptionError(f"{path}:{line}: has more columns than the header; decimals need a point")
    return row


def fit_curve(points: dict[str, np.ndarray], like: ThrusterCurve, voltage_v: float, zero_n: float) -> tuple[ThrusterCurve, float]:
    """The curve, and the RMS residual of the forces beyond the deadband, N. Raises DescriptionError.

    Args:
        points: columns of `read_points`. like: source of what was not measured. voltage_v: to which force and power are scaled.
        zero_n: magnitude up to which a force counts as zero.
    """
    if not VOLTAGE.low <= voltage_v <= VOLTAGE.high:
        raise DescriptionError(f"--voltage {voltage_v:g} is out of range; permitted: {describe(VOLTAGE)}")
    if not 0.0 <= zero_n < math.inf:
        raise DescriptionError(f"--zero {zero_n:g}: a force of 0 N or more is needed")
    u, force = points["command"], points["force_n"].copy()
    if "voltage_v" in points:
        force *= (voltage_v / points["voltage_v"]) ** VOLTAGE_EXPONENT
    changed: dict[str, np.ndarray] = {}
    edges, left = [], []
    for side, sign in (("forward", 1.0), ("reverse", -1.0)):
        works = (sign * u > 0.0) & (np.abs(force) > zero_n)
        if works.sum() < LEAST_POINTS or np.any(sign * force[works] < 0.0):
            raise DescriptionError(
                f"{side}: {works.sum()} points with a force of the command's sign beyond {zero_n:g} N; at least {LEAST_POINTS} are "
                "needed, and none against it"
            )
        x, y = np.abs(u[works]), np.abs(force[works])
        changed[side] = rising_polynomial(x, y, 1.0, LEAST_SLOPE * float(y.max()))
        powers = np.arange(1, DEGREE + 1)
        left.append(x[:, None] ** powers @ changed[side] - y)
        idle = np.abs(u[(sign * u >= 0.0) & ~works])
        if idle.size and np.any(y[x < idle.max()] > LOST * zero_n):
            raise DescriptionError(f"{side}: no force at command {sign * idle.max():g}, though smaller ones push; measure that one again")
        between = 0.5 * (float(x.min()) + float(idle.max())) if idle.size else 0.0
        edges.append(float(between**powers @ changed[side]) if idle.size else 0.0)
        if "power_w" in points:
            power = _propeller_power(points, works, voltage_v, idle_power(points, zero_n) or 0.0, side)
            changed[f"power_{side}"] = rising_polynomial(y, power, float(np.sum(changed[side])), LEAST_SLOPE * float(power.max()))
    curve = dataclasses.replace(
        like, voltage_v=voltage_v, deadband_n=float(np.mean(edges)), **{name: frozen_array(c) for name, c in changed.items()}
    )
    return curve, float(np.sqrt(np.mean(np.square(np.concatenate(left)))))


def idle_power(points: dict[str, np.ndarray], zero_n: float) -> float | None:
    """Power of the electronics: at the command nearest zero, W; None where it was not measured or the thruster pushes there."""
    size = np.abs(points["command"])
    nearest = size == size.min()
    if "power_w" not in points or np.any(np.abs(points["force_n"][nearest]) > zero_n):
        return None
    return float(np.mean(points["power_w"][nearest]))


def _propeller_power(points: dict[str, np.ndarray], works: np.ndarray, voltage_v: float, idle_w: float, side: str) -> np.ndarray:
    """Power above idle at the points that push, scaled to `voltage_v`, W. Raises DescriptionError."""
    power = points["power_w"][works]
    if np.any(power <= 0.0):
        raise DescriptionError(f"{side}: power_w {power.min():g} with a force; it must be above 0 wherever the thruster pushes")
    if power.max() <= idle_w:
        raise DescriptionError(f"{side}: power_w {power.max():g} at the most is not above the {idle_w:g} at zero command")
    return np.asarray((power - idle_w) * ((voltage_v / points["voltage_v"][works]) ** POWER_EXPONENT if "voltage_v" in points else 1.0))


def _number(text: str | None, path: Path, line: int) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not abs(value) <= MOST:
        raise DescriptionError(f"{path}:{line}: {text!r} is not a number of at most {MOST:g}")
    return value


def checked_toml(curve: ThrusterCurve, out: Path) -> str:
    """TOML text of the curve, checked against the rules of a vehicle file; `out` is named in errors. Raises DescriptionError."""
    text = to_toml(curve)
    build(ThrusterCurve, tomllib.loads(text), Source(f"{out} (not written)", text))
    return text


def check_out(path: Path) -> None:
    """Raises DescriptionError where no file can be written at `path`, or where it holds something other than a curve."""
    make_room(path)
    if path.exists() and path.stat().st_size:
        try:
            table, source = read_toml(path)
            build(ThrusterCurve, table, source)
        except DescriptionError:
            raise DescriptionError(f"--out {path}: there already, and no curve; give another name or delete it") from None


def main() -> int:
    """Runs the tool; returns its exit status."""
    parser = Parser(description=__doc__)
    parser.add_argument("csv", type=Path, help="CSV file of the measurement")
    parser.add_argument("--voltage", type=float, help="supply voltage of the curve, V; the vehicle's by default")
    parser.add_argument("--zero", type=float, default=0.05, metavar="N", help="magnitude up to which a force counts as zero")
    parser.add_argument("--vehicle", default="modcube", help="vehicle whose curve provides what was not measured")
    parser.add_argument("--out", type=Path, default=Path("curve.toml"), help="file to write the curve to")
    given = parser.parse_args()
    try:
        like = load_vehicle(given.vehicle).curve
        voltage_v = like.voltage_v if given.voltage is None else given.voltage
        points = read_points(given.csv)
        curve, left_n = fit_curve(points, like, voltage_v, given.zero)
        text = checked_toml(curve, given.out)
        check_out(given.out)
        given.out.write_text(text, encoding="utf-8")
    except (DescriptionError, OSError) as error:
        return refuse("fit_thruster", error)
    print(f"{given.out}: {np.sum(curve.forward):.3g} N forward, {np.sum(curve.reverse):.3g} N reverse at {curve.voltage_v:g} V;", end=" ")
    print(f"deadband {curve.deadband_n:.2g} N; residual {left_n:.2g} N RMS")
    if "power_w" in points:
        idle_w = idle_power(points, given.zero)
        taken = "none was measured at zero command: nothing taken off" if idle_w is None else f"{idle_w:.3g} W at zero command taken off"
        print(f"power: {taken} for the electronics, which the vehicle file's idle_w counts")
    power = "" if "power_w" in points else "power, "
    print(f"not measured, those of {given.vehicle}: {power}lag_s {curve.lag_s:g} s, rpm_at_full {curve.rpm_at_full:g} 1/min")
    return 0


if __name__ == "__main__":
    run_tool(main)
