"""Tables of characterise.py: the rows of the paper's Table I, a verdict on each cell, CSV and JSON."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_py.description.vehicle import AXES
from firmware_py.prepare.capability.layout import FRAMES, NORMALISATIONS, UNITS
from firmware_py.prepare.capability.summary import Capability, Reach, to_plain

DEGENERATE = "degenerate"
AGREES, DIFFERS, INCONSISTENT, NOTHING = "agrees", "differs by definition", "inconsistent in the paper", "none of ours"

CLOSE = 0.10
"""Relative difference up to which a cell agrees: the paper states its own layouts to about 5 %."""

TABLE_NORMALISATION = "unit_thrust"
"""Normalisation of the rows compared with the paper's: the paper says that power is normalised, but not how."""

Cell = float | str

WHY = {
    (
        "power",
        "dirichlet_energy",
    ): "paper: idle power and an unstated wrench; ours: measured power above idle, 1 N or 1 N m",
    ("power", "willmore_energy"): "1e11 and more comes from degenerate meshes; ours on the fitted surface",
    (
        "power",
        "total_power_w",
    ): "paper: 31.4 kW a thruster, so idle power summed over directions; ours: mean above idle",
    (
        "power",
        "thrust_variance",
    ): "compared as ratio to column A: the paper's wrench is not stated; ours is 1 N or 1 N m",
    ("wrench", "dirichlet_energy"): "the paper's figures follow no scaling of thrust or size",
    ("wrench", "willmore_energy"): "1e9 to 1e17 comes from degenerate meshes; ours on the fitted surface",
    ("wrench", "max_inscribed_ellipsoid_volume"): "unit thrust; torque: the paper exceeds what these arms allow",
    ("-", "price_usd"): "800 a module; the paper's Triple has four modules; its last two columns look swapped",
    ("-", "size_cm"): "vehicle files; the paper's last two columns look swapped",
    ("-", "depth_m"): "vehicle files",
}


_VOLUME = "volume of the inscribed ellipsoid"
LABELS = {
    "dirichlet_energy": ("Dirichlet energy", "{}^2"),
    "dirichlet_energy[scale_free]": ("Dirichlet energy, scale-free", ""),
    "willmore_energy": ("Willmore energy", ""),
    "total_power_w": ("power above idle, mean", "W"),
    "thrust_variance": ("variance of a thruster's force", "N^2"),
    "residual": ("part of the wrench out of reach, largest", "N and N m"),
    "share_over_limits": ("directions beyond a thruster's limit, share", ""),
    "max_inscribed_ellipsoid_volume": (f"{_VOLUME}, unit thrust", "{}^3"),
    "max_inscribed_ellipsoid_volume[physical]": (_VOLUME, "{}^3"),
    "max_inscribed_ellipsoid_volume[unit_thrust]": (f"{_VOLUME}, unit thrust", "{}^3"),
    "max_inscribed_ellipsoid_volume[equal_total_thrust]": (f"{_VOLUME}, equal total thrust", "{}^3"),
    "max_inscribed_ellipsoid_volume[unit_thrust, passive declared]": (f"{_VOLUME}, unit thrust, without passive axes", "{0}^3 or {0}^2"),
    "worst_direction[physical]": ("reach in the worst direction", "{}"),
    "thrusters": ("thrusters", ""),
    "rank": ("rank of the actuation matrix", ""),
    "passive": ("passive axes", ""),
    "assumption": ("assumption", ""),
    "program_facet_difference": ("self-check: largest relative difference of two methods", ""),
    "price_usd": ("price", "USD"),
    "depth_m": ("depth rating", "m"),
    "size_cm": ("size", "cm"),
}
"""Label and unit of each metric; {} stands for W in power spaces, otherwise for the unit of the frame."""


@dataclass(frozen=True, slots=True)
class Row:
    """One metric over all columns."""

    space: str
    frame: str
    metric: str
    better: str
    cells: dict[str, Cell]

    @property
    def key(self) -> tuple[str, str, str]:
        """Key of the row in table1.csv."""
        return self.space, self.frame, self.metric

    @property
    def label(self) -> str:
        """Label of the metric, with its unit."""
        words, unit = LABELS[self.metric]
        if self.space == "wrench" and "energy" in self.metric:
            words = f"{words}, unit thrust"
        own = "W" if self.space == "power" else UNITS.get(self.frame, "")
        unit = unit.format(f"({own})" if " " in own and "^" in unit else own)
        return f"{words}, {unit}" if unit else words


def rows_of(found: Mapping[str, Capability]) -> list[Row]:
    """Rows of table1.csv in its order, then rows of our own: normalisations, passive degrees of freedom declared, quality."""
    rows: list[Row] = []
    for frame in FRAMES:
        power = {name: (c.power[frame], c.power_shape[frame]) for name, c in found.items()}
        rows += [
            Row("power", frame, "dirichlet_energy", "lower", {n: s.dirichlet for n, (_, s) in power.items()}),
            Row("power", frame, "willmore_energy", "lower", {n: s.willmore for n, (_, s) in power.items()}),
            Row("power", frame, "total_power_w", "lower", {n: float(p.power_w.mean()) for n, (p, _) in power.items()}),
            Row("power", frame, "thrust_variance", "lower", {n: p.variance for n, (p, _) in power.items()}),
        ]
        reach = {name: c.reach[frame][TABLE_NORMALISATION] for name, c in found.items()}
        rows += [
            Row("wrench", frame, "dirichlet_energy", "lower", {n: _energy(r, "dirichlet") for n, r in reach.items()}),
            Row("wrench", frame, "willmore_energy", "lower", {n: _energy(r, "willmore") for n, r in reach.items()}),
            Row("wrench", frame, "max_inscribed_ellipsoid_volume", "higher", {n: _volume(r) for n, r in reach.items()}),
        ]
    return rows + _further_rows(found)


def _further_rows(found: Mapping[str, Capability]) -> list[Row]:
    rows: list[Row] = []
    for frame in FRAMES:
        scale_free = {n: c.power_shape[frame].dirichlet_scale_free for n, c in found.items()}
        rows.append(Row("power", frame, "dirichlet_energy[scale_free]", "lower", dict(scale_free)))
        rows.append(
            Row("power", frame, "residual", "lower", {n: _clean(c.power[frame].residual) for n, c in found.items()})
        )
        over = {n: c.power[frame].over_limit for n, c in found.items()}
        rows.append(Row("power", frame, "share_over_limits", "lower", dict(over)))
        for how in NORMALISATIONS:
            parts = {n: c.reach[frame][how] for n, c in found.items()}
            name = f"max_inscribed_ellipsoid_volume[{how}]"
            rows.append(Row("wrench", frame, name, "higher", {n: _volume(r) for n, r in parts.items()}))
        parts = {n: c.reach[frame]["physical"] for n, c in found.items()}
        rows.append(
            Row("wrench", frame, "worst_direction[physical]", "higher", {n: _worst(r) for n, r in parts.items()})
        )
        free = {n: _energy(c.reach[frame][TABLE_NORMALISATION], "dirichlet_scale_free") for n, c in found.items()}
        rows.append(Row("wrench", frame, "dirichlet_energy[scale_free]", "lower", dict(free)))
        declared = {n: _declared(c, frame) for n, c in found.items()}
        name = f"max_inscribed_ellipsoid_volume[{TABLE_NORMALISATION}, passive declared]"
        rows.append(Row("wrench", frame, name, "higher", declared))
    rows.append(Row("-", "-", "thrusters", "-", {n: float(c.layout.count) for n, c in found.items()}))
    rows.append(Row("-", "-", "rank", "higher", {n: float(c.rank) for n, c in found.items()}))
    held: dict[str, Cell] = {n: " ".join(AXES[k] for k in c.layout.passive) or "-" for n, c in found.items()}
    rows.append(Row("-", "-", "passive", "-", held))
    assumed: dict[str, Cell] = {n: c.layout.assumption or "-" for n, c in found.items()}
    rows.append(Row("-", "-", "assumption", "-", assumed))
    rows.append(Row("-", "-", "program_facet_difference", "lower", {n: c.programs_differ for n, c in found.items()}))
    return rows


def _energy(reach: Reach, name: str) -> Cell:
    return DEGENERATE if reach.shape is None else float(getattr(reach.shape, name))


def _volume(reach: Reach) -> Cell:
    return DEGENERATE if reach.degenerate else reach.volume


def _worst(reach: Reach) -> Cell:
    return DEGENERATE if reach.degenerate else reach.worst


def _declared(found: Capability, frame: str) -> Cell:
    """Volume with the passive degree of freedom declared; an area in (N m)^2 where two components are left."""
    if not found.declared:
        return "-"
    return found.declared[frame][TABLE_NORMALISATION].volume


def _clean(value: float) -> float:
    return 0.0 if value < 1e-9 else value


def read_paper(path: Path) -> dict[tuple[str, str, str], dict[str, float]]:
    """Reads the paper's figures, by row key and column."""
    with path.open(newline="", encoding="utf-8") as file:
        return {
            (line["space"], line["frame"], line["metric"]): {
                name: float(value) for name, value in line.items() if name not in ("space", "frame", "metric", "better")
            }
            for line in csv.DictReader(file)
        }


def verdict(row: Row, column: str, paper: Mapping[str, float], columns: Sequence[str]) -> str:
    """Verdict on one cell beside the paper's."""
    ours, theirs = row.cells[column], paper[column]
    metric = row.metric
    if metric == "price_usd" and column == "bluerov2" and paper[column] > paper["bluerov2_heavy"]:
        return INCONSISTENT  # costs more than the heavy variant, which has two more thrusters
    if metric in ("price_usd", "depth_m"):
        if not isinstance(ours, float):
            return NOTHING
        return AGREES if _near(ours, theirs) else INCONSISTENT
    if metric == "willmore_energy" or (row.space, metric) == ("wrench", "dirichlet_energy") or column == "chasing_m2":
        return INCONSISTENT
    if metric == "max_inscribed_ellipsoid_volume":
        if row.frame == "torque":
            return INCONSISTENT
        return AGREES if isinstance(ours, float) and _near(ours, theirs) else DIFFERS
    if metric == "thrust_variance" and column != columns[0] and isinstance(ours, float):
        first = row.cells[columns[0]]
        return AGREES if isinstance(first, float) and _near(ours / first, theirs / paper[columns[0]]) else DIFFERS
    return DIFFERS


def _near(ours: float, theirs: float) -> bool:
    return abs(ours - theirs) <= CLOSE * abs(theirs)


def size_word(ours: Sequence[float], theirs: Sequence[float]) -> str:
    """Verdict on a size, cm."""
    return AGREES if np.allclose(ours, theirs, rtol=CLOSE) else INCONSISTENT


def spearman(ours: Mapping[str, Cell], paper: Mapping[str, float]) -> tuple[float, int]:
    """Rank correlation of our cells with the paper's, and the number of columns compared, without degenerate and refused cells."""
    pairs = [(v, paper[n]) for n, v in ours.items() if n in paper and isinstance(v, float) and math.isfinite(v)]
    if len(pairs) < 3:
        return math.nan, len(pairs)
    a, b = (_ranks(np.array(side)) for side in zip(*pairs, strict=True))
    if a.std() == 0.0 or b.std() == 0.0:
        return math.nan, len(pairs)
    return float(np.corrcoef(a, b)[0, 1]), len(pairs)


def _ranks(values: np.ndarray) -> np.ndarray:
    """(n,) ranks; ties share their mean, and values equal to nine digits are ties."""
    rounded = np.array([float(f"{v:.9g}") for v in values])
    return np.array([np.mean(np.flatnonzero(np.sort(rounded) == v)) for v in rounded])


def text(cell: Cell) -> str:
    """Text of a cell for people."""
    if isinstance(cell, str):
        return cell
    if not math.isfinite(cell):
        return "refused"
    return f"{cell:g}" if cell == round(cell) and abs(cell) < 1e6 else f"{cell:.4g}"


def write_csv(path: Path, rows: Sequence[Row], columns: Sequence[str]) -> None:
    """Writes the columns of table1.csv: space, frame, metric, better, one per vehicle; degenerate or refused cells are written as such."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["space", "frame", "metric", "better", *columns])
        for row in rows:
            cells = [row.cells.get(name, "-") for name in columns]
            shown = [f"{c:.6e}" if isinstance(c, float) and math.isfinite(c) else text(c) for c in cells]
            writer.writerow([*row.key, row.better, *shown])


def write_json(path: Path, found: Mapping[str, Capability]) -> None:
    """Writes all figures, with units in their names."""
    content = {"vehicles": {name: to_plain(c) for name, c in found.items()}}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
