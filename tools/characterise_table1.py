"""`--table1` of characterise.py: our figures beside the paper's, a verdict on each cell, rank correlation, thrust variance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import characterise_table as table
import numpy as np
from rich.console import Console
from rich.table import Table

from firmware_py.description.vehicle import AXES
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import PITCH_M
from firmware_py.prepare.capability.layout import FRAMES, NORMALISATIONS, UNITS
from firmware_py.prepare.capability.summary import Capability, Reach

_COLOURS = {table.AGREES: "green", table.DIFFERS: "yellow", table.INCONSISTENT: "red", table.NOTHING: "dim"}
_SPACES = {"power": "power space", "wrench": "wrench space"}


def build_rows(found: Mapping[str, Capability], robots: Mapping[str, Any], module_price: float) -> list[table.Row]:
    """Rows of table1.csv first, including price and depth, then size and our own rows."""
    rows = table.rows_of(found)
    paper_rows = 7 * len(FRAMES)
    everyone = (*robots["robot"], *robots["beside"])
    price: dict[str, table.Cell] = {}
    depth: dict[str, table.Cell] = {}
    size: dict[str, table.Cell] = {}
    for robot in everyone:
        name, vehicle = robot["column"], load_vehicle(robot["vehicle"])
        cells = robot.get("cells", [])
        price[name] = module_price * len(cells) if vehicle.name.startswith("modcube") and cells else "-"
        depth[name] = vehicle.depth_rating_m
        size[name] = _size_text(_size_cm(robot)) if cells else "-"
    own = [
        table.Row("-", "-", "price_usd", "lower", price),
        table.Row("-", "-", "depth_m", "higher", depth),
        table.Row("-", "-", "size_cm", "-", size),
    ]
    return [*rows[:paper_rows], *own, *rows[paper_rows:]]


def _size_cm(robot: Mapping[str, Any]) -> np.ndarray:
    """(3,) outer edges, largest first as in the paper."""
    cells = np.array(robot["cells"])
    edges = load_vehicle(robot["vehicle"]).hull.size_m + PITCH_M * (cells.max(axis=0) - cells.min(axis=0))
    return 100.0 * (np.sort(edges)[::-1] if len(cells) > 1 else edges)


def _size_text(edges: Sequence[float] | np.ndarray) -> str:
    return " x ".join(f"{edge:g}" for edge in np.round(edges, 1))


def show(
    console: Console,
    rows: Sequence[table.Row],
    paper: Mapping[tuple[str, str, str], Mapping[str, float]],
    robots: Mapping[str, Any],
    found: Mapping[str, Capability],
) -> None:
    """Prints everything that `--table1` shows."""
    columns = [robot["column"] for robot in robots["robot"]]
    shown = Table(title="Table I: ours / the paper's / a word", title_justify="left", show_lines=True)
    shown.add_column("row")
    for robot in robots["robot"]:
        shown.add_column(f"{robot['letter']}: {robot['title']}", justify="right")
    shown.add_column("Spearman (n)", justify="right")
    for row in rows:
        if row.key in paper:
            words = {name: table.verdict(row, name, paper[row.key], columns) for name in columns}
            cells = [_cell(table.text(row.cells[n]), f"{paper[row.key][n]:.4g}", words[n]) for n in columns]
            rho, count = table.spearman({n: row.cells[n] for n in columns}, paper[row.key])
            shown.add_row(_label(row), *cells, f"{rho:.2f} ({count})" if np.isfinite(rho) else "-")
        elif row.metric == "size_cm":
            shown.add_row(_label(row), *(_size_cell(robot) for robot in robots["robot"]), "-")
    console.print(shown)
    for (space, metric), why in table.WHY.items():
        console.print(
            f"{_SPACES.get(space, '')} {table.LABELS[metric][0]}: {why}".strip(), markup=False, highlight=False
        )
    console.print("D repeats the paper's Double ModCube; its layout here is an assumption.", highlight=False)
    _further(console, robots, found)
    _variance(console, found, paper)
    for robot in robots["robot"]:
        for note in dict.fromkeys(found[robot["column"]].notes):
            console.print(f"{robot['letter']}: {note}", markup=False, highlight=False)


def _label(row: table.Row) -> str:
    arrow = {"lower": " (less is better)", "higher": " (more is better)"}.get(row.better, "")
    space = f"{_SPACES[row.space]} {row.frame}\n" if row.space in _SPACES else ""
    return f"{space}{row.label}{arrow}"


def _cell(ours: str, theirs: str, word: str) -> str:
    return f"{ours}\n{theirs}\n[{_COLOURS[word]}]{word}[/]"


def _size_cell(robot: Mapping[str, Any]) -> str:
    ours = _size_cm(robot)
    return _cell(_size_text(ours), _size_text(robot["size_cm"]), table.size_word(ours, robot["size_cm"]))


def _further(console: Console, robots: Mapping[str, Any], found: Mapping[str, Capability]) -> None:
    """Prints our own figures, one robot per line: all normalisations, passive degrees of freedom declared, worst direction."""
    for frame, unit in UNITS.items():
        volume = f"ellipsoid\n({unit})^3" if " " in unit else f"ellipsoid\n{unit}^3"
        shown = Table(title=f"Ours, {frame} frame: volume of the inscribed ellipsoid, and energies", title_justify="left")
        shown.caption = "* scale-free Dirichlet energy"
        heads = (
            "robot",
            "n",
            "rank",
            "passive",
            f"{volume}\nphysical",
            "ellipsoid\nunit thrust",
            "ellipsoid\nequal total",
            "unit thrust\nno passive",
        )
        for k, head in enumerate((*heads, f"worst reach\n{unit}", "Dirichlet*\npower", "Dirichlet*\nwrench")):
            shown.add_column(head, justify="right" if k else "left")
        for robot in (*robots["robot"], *robots["beside"]):
            c = found[robot["column"]]
            cells = [
                robot["title"],
                str(c.layout.count),
                str(c.rank),
                " ".join(AXES[k] for k in c.layout.passive) or "-",
            ]
            cells += [_volume(c.reach[frame][how]) for how in NORMALISATIONS]
            cells.append(_volume(c.declared[frame][table.TABLE_NORMALISATION], frame) if c.declared else "-")
            shape = c.reach[frame][table.TABLE_NORMALISATION].shape
            cells += [f"{c.reach[frame]['physical'].worst:.4g}", f"{c.power_shape[frame].dirichlet_scale_free:.3g}"]
            shown.add_row(*cells, f"{shape.dirichlet_scale_free:.3g}" if shape else "-")
        console.print(shown)


def _volume(reach: Reach, frame: str = "") -> str:
    if reach.section is None:
        return "0 (degenerate)"
    area = " (N m)^2" if frame == "torque" and len(reach.section.components) == 2 else ""
    return f"{reach.volume:.4g}{area}"


def _variance(
    console: Console, found: Mapping[str, Capability], paper: Mapping[tuple[str, str, str], Mapping[str, float]]
) -> None:
    """Prints the thrust variance of one, two and four modules, as ratios to that of four."""
    for frame in FRAMES:
        theirs = paper["power", frame, "thrust_variance"]
        trios = {
            "paper": [theirs[f"{n}_modcube"] for n in ("single", "double", "triple")],
            "authors' files": [found[f"authors_{n}"].power[frame].variance for n in ("single", "double", "triple")],
            "A45 (the paper's text)": [found[f"{n}_a45"].power[frame].variance for n in ("single", "double", "triple")],
        }
        shown = "; ".join(f"{name} " + " : ".join(f"{v / trio[2]:.6g}" for v in trio) for name, trio in trios.items())
        console.print(f"thrust variance over 1, 2, 4 modules, {frame} frame: {shown}", markup=False, highlight=False)
