"""Gain and phase margins of the loops broken at the plant's input, and how far they shrink where the plant differs from the model.

.venv/bin/python tools/margins.py                                     # the shipped gains, bodies of 1, 2 and 4 modules
.venv/bin/python tools/margins.py --controller runs/tune/parameters.toml --modules 1
.venv/bin/python tools/margins.py --vehicle bluerov2_heavy --modules 1 --out runs/margins

Status 1 where a margin is below its limit, or a controlled axis oscillates or never crosses 0 dB. An axis that the thrusters cannot push,
or that the vehicle leaves to buoyancy, is named and does not count. In DIR: margins.json and margins.png, the Bode plot.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from command_line import Parser, refuse, run_tool

import numpy as np
from argument_types import check_results, folder_for_results, whole
from loop_response import BODIES, NOMINAL, Margins, Response, Scale, corners, margins, measure, read_off
from rich import box
from rich.console import Console
from rich.table import Table

from firmware_py.description.parameters import CONTROLLERS, Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import AXES
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import PITCH_M
from firmware_py.prepare.joints import Placement, check_joints
from hil.cli import parameters_of
from hil.workers import processes

BARS = {"nominal": (8.0, 40.0), "worst": (6.0, 35.0)}
"""Least gain margin, dB, and phase margin, deg."""
SPREAD = 0.15
COLOURS = ("#d55e00", "#0072b2", "#009e73")
"""Colours of the three axes of a panel (Okabe and Ito's palette)."""

Found = dict[int, dict[Scale, list[Response]]]


def measured(modules: Sequence[int], parameters: Parameters, vehicle: str, jobs: int) -> Found:
    """Responses of every body in the nominal world and in the eight corners."""
    cases = [(n, scale) for n in modules for scale in (NOMINAL, *corners(SPREAD))]
    found: Found = {n: {} for n in modules}
    with processes(jobs)() as pool:
        futures = [pool.submit(measure, n, parameters, scale, vehicle) for n, scale in cases]
        for done, ((n, scale), future) in enumerate(zip(cases, futures, strict=True), 1):
            found[n][scale] = future.result()
            print(f"margins: {done} of {len(cases)}", file=sys.stderr, flush=True)
    return found


def check_bodies(modules: Sequence[int], vehicle: str) -> None:
    """Raises DescriptionError where one of the bodies cannot be docked from this vehicle, before minutes are spent on the others."""
    described = load_vehicle(vehicle)
    for count in modules:
        try:
            check_joints([Placement(described, cell, 0) for cell in BODIES[count]], range(1, count + 1), PITCH_M)
        except DescriptionError as error:
            raise DescriptionError(f"{count} of the vehicle {vehicle} cannot be docked: {error}; give --modules 1") from None


def rows(found: Found) -> list[dict[str, Any]]:
    """One row for each body, axis and limit: margins, and the corner of the worst phase margin."""
    result = []
    for modules, responses in found.items():
        for axis, name in enumerate(AXES):
            each = {scale: margins(r[axis]) for scale, r in responses.items()}
            for kind, worlds in (("nominal", [NOMINAL]), ("worst", list(each))):
                by_gain, by_phase = (min(worlds, key=lambda s, k=k: each[s][k]) for k in (0, 1))  # type: ignore[misc]
                found_margins = Margins(each[by_gain].gain_db, each[by_phase].phase_deg, each[by_phase].crossover_rad_s)
                passed = all(value >= bar for value, bar in zip(found_margins[:2], BARS[kind], strict=True))
                row = {"modules": modules, "axis": name, "kind": kind, "controlled": responses[NOMINAL][axis].controlled}
                result.append(row | found_margins._asdict() | {"passed": passed or not row["controlled"], "at": by_phase})
    return result


def print_table(table_rows: Sequence[dict[str, Any]]) -> None:
    """Prints one line for each body and axis."""
    table = Table(box=box.SIMPLE_HEAD, title=f"margins at the plant's input; worst over mass, inertia and lag +-{SPREAD:.0%}")
    for column in ("modules", "axis", "crossover", "gain", "phase", "gain, worst", "phase, worst", "phase worst at mass, inertia, lag", ""):
        table.add_column(column, justify="left" if column in ("axis", "") else "right")
    for nominal, worst in zip(table_rows[::2], table_rows[1::2], strict=True):
        if not nominal["controlled"]:
            table.add_row(str(nominal["modules"]), nominal["axis"], *["-"] * 6, "not controlled")
            continue
        verdict = "" if nominal["passed"] and worst["passed"] else "FAILED"
        if math.isnan(worst["crossover_rad_s"]):
            verdict += ": no crossover"
        table.add_row(
            str(nominal["modules"]), nominal["axis"], f"{nominal['crossover_rad_s']:.1f} rad/s".replace("nan rad/s", "none"),
            *(f"{row[key]:.1f} {unit}" for row in (nominal, worst) for key, unit in (("gain_db", "dB"), ("phase_deg", "deg"))),
            ", ".join(f"{v:g}" for v in worst["at"]), verdict,
        )  # fmt: skip
    bars = [f"{kind} >= {gain:g} dB and {phase:g} deg" for kind, (gain, phase) in BARS.items()]
    table.caption = "limits: " + "; ".join(bars)
    Console(width=None if sys.stdout.isatty() else 130).print(table)


def draw(path: Path, found: Found) -> None:
    """Draws the Bode plot: a column for each body and kind of axis, bands over all corners."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = [(n, first) for n in found for first in (0, 3)]
    figure, panels = plt.subplots(2, len(columns), figsize=(4.1 * len(columns), 6.4), sharex=True, sharey="row", squeeze=False)
    for (modules, first), (gain, phase) in zip(columns, panels.T, strict=True):
        for axis, colour in zip(range(first, first + 3), COLOURS, strict=True):
            if not found[modules][NOMINAL][axis].controlled:
                continue
            curves = [bode(r[axis]) for r in found[modules].values()]
            w = found[modules][NOMINAL][axis].frequency
            for panel, part in ((gain, 0), (phase, 1)):
                values = np.array([c[part] for c in curves])
                panel.fill_between(w, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.15, linewidth=0)
                panel.plot(w, values[0], color=colour, marker=".", markersize=3)
            mark(gain, phase, found[modules][NOMINAL][axis], AXES[axis], colour)
        gain.axhline(0.0, color="#30363d", linewidth=0.8)
        phase.axhline(-180.0, color="#30363d", linewidth=0.8)
        gain.set_title(f"{modules} module{'s' if modules > 1 else ''}, {'rotation' if first else 'translation'}")
        for panel, title in ((gain, "gain margin, where the phase is -180 deg"), (phase, "phase margin, at crossover")):
            if panel.get_legend_handles_labels()[0]:
                legend = panel.legend(frameon=True, loc="lower left", fontsize=8, title=title, title_fontsize=8, alignment="left")
                legend.get_frame().set(alpha=0.85, edgecolor="none")  # a curve may pass below it
        phase.set_xlabel("frequency, rad/s")
    panels[0, 0].set(xscale="log", ylabel="loop gain, dB", ylim=(-40, 45))
    panels[1, 0].set(ylabel="phase, deg", ylim=(-400, 100), yticks=range(-360, 91, 90))
    for panel in panels.flat:
        panel.grid(color="#d8dee4", linewidth=0.6)
    what = f"Loops broken at the plant's input, measured at the dots; bands: mass, inertia and thruster lag +-{SPREAD:.0%}"
    figure.suptitle(f"{what}\nmarks and bars: crossover and least margins of the nominal plant", fontsize=11)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def mark(gain: Any, phase: Any, response: Response, name: str, colour: str) -> None:
    """Marks where the least margins of a loop are read off, with a bar for each, and lists them in the legends."""
    if math.isnan(margins(response).crossover_rad_s):
        gain.plot([], [], color=colour, label=f"{name}, no margins")
        return
    gains, phases = read_off(response)
    crossover, margin_deg = min(phases, key=lambda at: at[1])
    label = f"{name}, {margin_deg:.0f} deg at {crossover:.1f} rad/s"
    phase_deg = np.interp(np.log(crossover), np.log(response.frequency), bode(response)[1])
    turn = -180.0 + 360.0 * round((phase_deg + 180.0) / 360.0)
    gain.plot(crossover, 0.0, "o", color=colour, markersize=5)
    phase.plot([crossover, crossover], [phase_deg, turn], "-o", color=colour, markersize=5, markevery=[0], linewidth=2.0, label=label)
    if gains:
        reached, gain_db = min(gains, key=lambda at: abs(at[1]))
        label = f"{name}, {abs(gain_db):.1f} dB at {reached:.1f} rad/s"
        gain.plot([reached, reached], [gain_db, 0.0], "-v", color=colour, markersize=5, markevery=[0], linewidth=2.0, label=label)


def bode(response: Response) -> tuple[np.ndarray, np.ndarray]:
    """Gain, dB, and phase, deg, shifted by whole turns to be nearest to -180 at crossover."""
    gain = 20.0 * np.log10(np.abs(response.loop))
    phase = np.degrees(np.unwrap(np.angle(response.loop)))
    return gain, phase - 360.0 * round((phase[int(np.argmin(np.abs(gain)))] + 180.0) / 360.0)


def write_and_report(out: Path, found: Found) -> int:
    """Prints the table and writes margins.json and margins.png; returns the exit status. Raises OSError."""
    table_rows = rows(found)
    print_table(table_rows)
    finite = [{k: v if not isinstance(v, float) or math.isfinite(v) else None for k, v in row.items()} for row in table_rows]
    (out / "margins.json").write_text(json.dumps(finite, indent=2) + "\n", encoding="utf-8")
    draw(out / "margins.png", found)
    print(out / "margins.png")
    return 0 if all(row["passed"] for row in table_rows) else 1


def main() -> int:
    """Runs the tool; returns its exit status."""
    parser = Parser(description=__doc__)
    parser.add_argument(
        "--modules", type=int, nargs="+", choices=list(BODIES), default=list(BODIES), help="numbers of modules of the bodies"
    )
    parser.add_argument("--controller", default="modcube", help=f"{', '.join(CONTROLLERS)}, or a parameter file")
    parser.add_argument("--vehicle", default="modcube", help="vehicle of every module")
    parser.add_argument("--jobs", type=whole(1), default=2, help="number of parallel processes")
    parser.add_argument("--out", type=Path, metavar="DIR", default=Path("runs/margins"), help="folder for margins.json and margins.png")
    given = parser.parse_args()
    try:
        check_bodies(given.modules, given.vehicle)
        chosen = parameters_of(given.controller)
        with folder_for_results(given.out):
            check_results(given.out, "crossover_rad_s", "margins.json", "margins.png")
            return write_and_report(given.out, measured(given.modules, chosen, given.vehicle, given.jobs))
    except (DescriptionError, OSError) as error:
        return refuse("margins", error)


if __name__ == "__main__":
    run_tool(main)
