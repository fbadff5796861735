"""The capability figure: power and wrench surfaces in both frames, inscribed ellipsoids, and the forces of each thruster."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from characterise_surfaces import FLAT, SPACES, Picture, pictures
from matplotlib.colors import to_rgba
from matplotlib.patches import Rectangle
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from firmware_py.description.vehicle import AXES
from firmware_py.prepare.capability.layout import FRAMES, UNITS
from firmware_py.prepare.capability.summary import Capability

_SURFACE = {"power": "#d98324", "wrench": "#2f6f9f"}
_DECLARED, _ELLIPSOID = "#7a5195", "#2f9e44"
_CELL_INCHES = (2.9, 2.9)
_VIOLIN_INCHES = 1.9
_LINE_INCHES, _LETTERS_PER_INCH = 0.125, 19.0
_MOST_MARKED = 16
"""Largest number of thrusters for which every one is numbered on the axis."""


def draw(path: Path, found: Mapping[str, Capability], titles: Mapping[str, str]) -> None:
    """Draws one column per vehicle and one row per space, all panels of a row on one scale, to `path` (PNG)."""
    shown = {name: pictures(result) for name, result in found.items()}
    count = len(found)
    height = len(SPACES) * _CELL_INCHES[1] + 2 * _VIOLIN_INCHES + 1.0
    width = max(count * _CELL_INCHES[0], 8.0)
    notes = [f"* {titles[n]}: {c.layout.assumption}" for n, c in found.items() if c.layout.assumption]
    lines = [line for note in notes for line in textwrap.wrap(note, int(width * _LETTERS_PER_INCH))]
    height += len(lines) * _LINE_INCHES
    figure = plt.figure(figsize=(width, height), dpi=130)
    ratios = [_CELL_INCHES[1]] * len(SPACES) + [_VIOLIN_INCHES] * 2
    top, bottom = 1.0 - 1.1 / height, (0.6 + len(lines) * _LINE_INCHES) / height
    grid = figure.add_gridspec(
        len(ratios), count, height_ratios=ratios, top=top, bottom=bottom, left=0.75 / width, right=1.0 - 0.25 / width,
        hspace=0.28, wspace=0.2,
    )  # fmt: skip
    for row, (space, frame) in enumerate(SPACES):
        limit = max(p[space, frame].limit for p in shown.values())
        for column, (name, parts) in enumerate(shown.items()):
            axes: Any = figure.add_subplot(grid[row, column], projection="3d")
            _solid(axes, parts[space, frame], limit)
            if row == 0:
                head = titles[name] + ("*" if found[name].layout.assumption else "")
                axes.text2D(0.5, 1.17, head, transform=axes.transAxes, ha="center", weight="bold", fontsize=10)
        _row_title(figure, grid[row, 0], parts[space, frame].title, width)
    for row, frame in enumerate(UNITS, len(SPACES)):
        _violins(figure, grid, row, frame, found)
    _legend(figure, height, [picture for parts in shown.values() for picture in parts.values() if picture.limit > 0.0])
    figure.text(0.2 / width, 0.1 / height, "\n".join(lines), fontsize=7, va="bottom")
    figure.savefig(path)
    plt.close(figure)


def _row_title(figure: Any, cell: Any, text: str, width: float) -> None:
    box = cell.get_position(figure)
    figure.text(0.22 / width, 0.5 * (box.y0 + box.y1), text, rotation=90, ha="center", va="center", fontsize=9)


def _solid(axes: Any, picture: Picture, limit: float) -> None:
    axes.set_title(picture.caption, fontsize=8, pad=0)
    if picture.limit == 0.0:
        axes.set(xticks=[], yticks=[], zticks=[])
        axes.text2D(0.5, 0.5, "degenerate", transform=axes.transAxes, ha="center", va="center", fontsize=9)
        return
    colour = _DECLARED if picture.declared else _SURFACE[picture.space]
    edge = "#00000030" if picture.space == "power" else "#000000a0"
    for polygons, face, alpha, line in (
        (picture.ellipsoid, _ELLIPSOID, 0.8, 0.0),
        (picture.polygons, colour, 0.3, 0.4),
    ):
        if polygons:
            axes.add_collection3d(
                Poly3DCollection(polygons, facecolor=to_rgba(face, alpha), edgecolor=edge, linewidth=line)
            )
    axes.set(xlim=(-limit, limit), ylim=(limit, -limit), zlim=(limit, -limit))  # FRD: z down, so y is flipped too
    axes.set_box_aspect((1, 1, 1))
    for axis, component in zip((axes.xaxis, axes.yaxis, axes.zaxis), FRAMES[picture.frame], strict=True):
        axis.set_ticks([-_tick(limit), 0.0, _tick(limit)])
        axis.label.set_fontsize(8)
        axis.set_tick_params(labelsize=7, pad=-2)
        axis.labelpad = -6
        axis.set_label_text(f"{AXES[component]}, {picture.unit}")


def _tick(limit: float) -> float:
    """A round number of at most 0.9 times the limit."""
    power = 10.0 ** np.floor(np.log10(0.9 * limit))
    return float(power * max(step for step in (1, 2, 5) if step * power <= 0.9 * limit))


def _violins(figure: Any, grid: Any, row: int, frame: str, found: Mapping[str, Capability]) -> None:
    widest = {each: 1.05 * max(float(np.abs(c.power[each].forces).max()) for c in found.values()) for each in UNITS}
    is_flat = widest[frame] <= FLAT * max(widest.values())
    limit = 1.0 if is_flat else widest[frame]
    first: Any = None
    for column, result in enumerate(found.values()):
        power, count = result.power[frame], result.layout.count
        axes: Any = figure.add_subplot(grid[row, column], sharey=first)
        first = first or axes
        parts = axes.violinplot(list(power.forces.T), range(1, count + 1), widths=0.85, showextrema=False, points=80)
        for body in parts["bodies"]:
            body.set(facecolor="#456990", alpha=0.8, edgecolor="none")
        axes.set_ylim(-limit, limit)
        axes.set_xlim(0.3, count + 0.7)
        axes.set_xticks(range(1, count + 1, 1 if count <= _MOST_MARKED else 4))
        axes.tick_params(labelsize=7)
        axes.grid(axis="y", alpha=0.3)
        if is_flat:
            axes.set_yticks([])
            axes.text(0.5, 0.5, "degenerate", transform=axes.transAxes, ha="center", va="center", fontsize=9)
        axes.set_title(f"variance {power.variance:.3g} N$^2$", fontsize=8, pad=2)
        axes.set_xlabel("thruster", fontsize=8, labelpad=1)
        if column == 0:
            axes.set_ylabel(f"force at {power.size:g} {UNITS[frame]}\n({frame} frame), N", fontsize=8)


def _legend(figure: Any, height: float, drawn: Sequence[Picture]) -> None:
    """Legend of the colours in use."""
    entries = (
        (_SURFACE["power"], "power above idle", any(picture.space == "power" for picture in drawn)),
        (_SURFACE["wrench"], "reachable wrench, 8 N of thrust in all", any(p.space == "wrench" and not p.declared for p in drawn)),
        (_DECLARED, "reachable wrench, the passive degree of freedom declared", any(picture.declared for picture in drawn)),
        (_ELLIPSOID, "largest inscribed ellipsoid", any(picture.ellipsoid for picture in drawn)),
    )
    handles = [Rectangle((0, 0), 1, 1, color=colour, alpha=0.7, label=text) for colour, text, is_there in entries if is_there]
    figure.legend(handles=handles, loc="upper center", ncols=2, fontsize=8, frameon=False,
                  bbox_to_anchor=(0.5, 1.0 - 0.05 / height))  # fmt: skip
