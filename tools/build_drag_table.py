"""Build the drag tables of docked modules, draw their drag spaces and compare the ways to an outline.

.venv/bin/python tools/build_drag_table.py                              the paper's three shapes
.venv/bin/python tools/build_drag_table.py --cells "0,0,0 1,0,0 1,1,0"  any other; --compare adds the paper's sampling
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

from command_line import run_tool

import numpy as np
import typer
from argument_types import CELLS, cells_in, check_folder, make_room, run_command
from rich import box
from rich.console import Console
from rich.table import Table

from firmware_py.core import drag_lookup
from firmware_py.core.body import DragTable
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare import alpha, drag_table, shape_key
from firmware_py.prepare.assembly import PITCH_M, assemble
from firmware_py.prepare.capability.sphere import fibonacci
from firmware_py.prepare.drag_cache import DragCache, default_folder
from firmware_py.prepare.joints import Placement, check_joints
from firmware_py.prepare.projected_area import areas_and_centroids

Cell = tuple[int, int, int]

PAPER_SHAPES: dict[str, list[Cell]] = {
    "one module": [(0, 0, 0)],
    "line of two": [(0, 0, 0), (0, 1, 0)],
    "2x2": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)],
}

FLOWS = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1)]
"""The paper's seven flow directions."""

SPEED_M_S = 1.0
"""Speed of the paper's CFD runs."""

SMALLEST_MOMENT_NM = 5e-4
"""Moments below this are not printed."""

WIDTH = 100
"""Characters per line of a table that does not go to a terminal."""

RANDOM_SEED = 0
METHODS = {
    "exact": areas_and_centroids,
    "alpha": alpha.lattice_method,
    "random": alpha.random_method(RANDOM_SEED),
}
app = typer.Typer(add_completion=False)


def parse_cells(text: str) -> list[Cell]:
    """Parses cells such as "0,0,0 1,0,0". Raises DescriptionError."""
    try:
        return cells_in(text)
    except ValueError:
        what = f"write whole numbers x,y,z, each from {CELLS.low:g} to {CELLS.high:g}, with spaces between modules, as 0,0,0 1,0,0"
        raise DescriptionError(f"cells {text!r}: {what}") from None


def shapes_of(text: str) -> dict[str, list[Cell]]:
    """The requested shape, or the paper's shapes if `text` is empty. Raises DescriptionError."""
    if not text:
        return PAPER_SHAPES
    cells = parse_cells(text)
    return {f"{len(cells)} module{'s' if len(cells) > 1 else ''}": cells}


def check_docks(vehicle: Vehicle, shapes: dict[str, list[Cell]]) -> None:
    """Raises DescriptionError where the modules of a shape, all upright, cannot be docked."""
    for shape, cells in shapes.items():
        try:
            check_joints([Placement(vehicle, cell, 0) for cell in cells], range(1, len(cells) + 1), PITCH_M)
        except DescriptionError as error:
            raise DescriptionError(f"{shape} of the vehicle {vehicle.name} cannot be docked: {error}; give --cells 0,0,0") from None


def table_of(vehicle: Vehicle, cells: Sequence[Cell], mode: str, cache: DragCache | None) -> DragTable:
    """Drag table of upright modules, about their centre of mass."""
    body = assemble(cells, [0] * len(cells), [vehicle] * len(cells))
    placements = [Placement(vehicle, c, 0) for c in cells]
    centre = PITCH_M * np.array(cells[0]) - body.r_bm[0]
    return drag_table.build(placements, centre, PITCH_M, cache, mode, METHODS[mode])


def force_at(table: DragTable, flow: Sequence[float]) -> tuple[float, float]:
    """Magnitudes of force, N, and moment, N m, at SPEED_M_S along a flow direction."""
    unit = np.array(flow, dtype=float) / np.linalg.norm(flow)
    nu = np.concatenate([SPEED_M_S * unit, np.zeros(3)])
    wrench = drag_lookup.drag_wrench(table.nodes, table.rotational, table.linear, nu)
    return float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))


def print_forces(console: Console, tables: dict[str, dict[str, DragTable]]) -> None:
    """Prints force, and moment about the centre of mass, in the seven flow directions."""
    view = Table(title=f"drag at {SPEED_M_S:g} m/s", title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, padding=0)
    for heading in ("shape", "mode", "", *("(" + ",".join(map(str, flow)) + ")" for flow in FLOWS)):
        view.add_column(heading, justify="left" if len(view.columns) < 3 else "right", no_wrap=True)
    for shape, modes in tables.items():
        for mode, table in modes.items():
            forces, moments = zip(*(force_at(table, flow) for flow in FLOWS), strict=True)
            view.add_row(shape, mode, "N", *(f"{f:.2f}" for f in forces))
            if max(moments) > SMALLEST_MOMENT_NM:
                view.add_row("", "", "N m", *(f"{m:.3f}" for m in moments))
    console.print(view)


def print_comparison(console: Console, vehicle: Vehicle, shapes: dict[str, list[Cell]], count: int) -> None:
    """Prints the projected areas of every mode against the exact ones over `count` directions, and the time each takes."""
    view = Table(title=f"projected area over {count} directions against the exact outline")
    for heading in ("shape", "mode", "mean m^2", "bias %", "rms %", "max %", "time s"):
        view.add_column(heading, justify="left" if heading in ("shape", "mode") else "right")
    directions = fibonacci(count)
    for shape, cells in shapes.items():
        solids = shape_key.solids([shape_key.part(vehicle, c, 0) for c in cells], PITCH_M)
        exact = None
        for mode, method in METHODS.items():
            start = time.perf_counter()
            areas = method(solids, directions)[0]
            taken = time.perf_counter() - start
            exact = areas if exact is None else exact
            error = 100.0 * (areas / exact - 1.0)
            figures = (areas.mean(), error.mean(), math.sqrt(np.mean(error**2)), np.abs(error).max(), taken)
            view.add_row(shape, mode, *(f"{x:.4g}" if abs(x) >= 1e-9 else "0" for x in figures))
    console.print(view)


def check_format(path: Path) -> None:
    """Raises DescriptionError where the file ending is not a picture format; called before the minutes of work start."""
    from matplotlib.backend_bases import FigureCanvasBase

    known = sorted(FigureCanvasBase.get_supported_filetypes())
    if path.suffix and path.suffix[1:].lower() not in known:
        raise DescriptionError(f"--out {path}: no picture ends in {path.suffix}; there are {', '.join(known)}")


def draw(path: Path, tables: dict[str, DragTable]) -> None:
    """Draws the drag spaces: in each direction of motion, a point at the magnitude of the force. Raises DescriptionError."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    azimuth, polar = np.meshgrid(np.linspace(-math.pi, math.pi, 145), np.linspace(0.0, math.pi, 73))
    d = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=-1)
    figure = plt.figure(figsize=(5.0 * len(tables), 5.2), layout="constrained")
    for k, (name, table) in enumerate(tables.items(), 1):
        flat = np.ascontiguousarray(d.reshape(-1, 3))
        force = np.array([drag_lookup.look_up(table.nodes, x)[0] for x in flat]).reshape(d.shape[:2]) * SPEED_M_S**2
        axes = figure.add_subplot(1, len(tables), k, projection="3d")
        colours = matplotlib.colormaps["viridis"]((force - force.min()) / max(float(np.ptp(force)), 1e-12))
        surface = np.moveaxis(force[..., None] * d, -1, 0)
        axes.plot_surface(*surface, facecolors=colours, rstride=1, cstride=1, shade=False)
        limit = float(force.max())
        axes.set(xlim=(-limit, limit), ylim=(limit, -limit), zlim=(limit, -limit))  # FRD: z down, so y is flipped too
        axes.set(xlabel="x, N", ylabel="y, N", zlabel="z, N")
        axes.set_box_aspect((1, 1, 1), zoom=0.92)  # room for the label of z
        axes.set_title(f"{name}: {force.min():.1f} to {force.max():.1f} N at {SPEED_M_S:g} m/s", y=1.0)  # the default position is cut off
    try:
        figure.savefig(path, dpi=110, format=path.suffix[1:] or "png")
    except (OSError, ValueError) as error:  # ValueError: no such format
        raise DescriptionError(f"--out {path}: cannot be written: {getattr(error, 'strerror', None) or error}") from None
    plt.close(figure)


@app.command()
def main(
    vehicle: Annotated[str, typer.Option(help="vehicle name or file")] = "modcube",
    cells: Annotated[str, typer.Option(help="cells, such as '0,0,0 1,0,0'; without them the paper's three shapes")] = "",
    mode: Annotated[str, typer.Option(help="method for the outline: exact, alpha or random")] = "exact",
    compare: Annotated[bool, typer.Option(help="compare the three methods (takes minutes)")] = False,
    directions: Annotated[int, typer.Option(min=10, max=100000, help="number of directions in the comparison")] = 1000,
    out: Annotated[Path, typer.Option(help="picture file for the drag spaces")] = Path("runs") / "drag_spaces.png",
    cache: Annotated[Path | None, typer.Option(help="folder for cached outlines; the user's cache by default")] = None,
) -> None:
    """Build drag tables, print the force in the paper's seven flow directions, draw the drag spaces."""
    console = Console(highlight=False)
    console = console if console.is_terminal else Console(highlight=False, width=WIDTH)
    store = DragCache(cache or default_folder(os.environ, Path.home()))
    if mode not in METHODS:
        raise DescriptionError(f"mode {mode!r} is unknown; there are {', '.join(METHODS)}")
    description = load_vehicle(vehicle)
    shapes = shapes_of(cells)
    check_docks(description, shapes)
    check_format(out)
    make_room(out)
    if cache is not None:
        check_folder("--cache", cache)
    modes = list(METHODS) if compare else [mode]
    tables = {shape: {m: table_of(description, placed, m, store) for m in modes} for shape, placed in shapes.items()}
    if description.assumption:
        console.print(f"assumption: {description.assumption}")
    print_forces(console, tables)
    if compare:
        print_comparison(console, description, shapes, directions)
    draw(out, {shape: by_mode[modes[0]] for shape, by_mode in tables.items()})
    console.print(f"drag spaces: {out}; outlines kept in {store.folder}", soft_wrap=True)


if __name__ == "__main__":
    run_tool(partial(run_command, app, "build_drag_table"))
