"""Chooses a shape for a task: ranks all distinct polycubes by margin, power or variance, with guarantees for k dead thrusters.

The modules stay parallel to each other (so every probe meets a drogue); each shape is tried in every pose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from firmware_py.description.vehicle import Vehicle
from firmware_py.prepare.assembly import assemble
from firmware_py.prepare.capability.layout import Layout, of_modules, of_thrusters
from firmware_py.prepare.capability.polycubes import Cells, polycubes, poses
from firmware_py.prepare.capability.power import electrical_power, least_squares_forces
from firmware_py.prepare.capability.programs import reach_by_programs
from firmware_py.prepare.capability.task import Task, wrenches_along
from firmware_py.prepare.capability.wrench import WrenchSpace
from firmware_py.prepare.drag_cache import DragCache

_STILL = 1e-6
"""N; a wrench smaller than this (torque over the lever arm) counts as zero."""


@dataclass(frozen=True, slots=True, eq=False)
class Fitness:
    """Performance of one pose of one shape in the task.

    Attributes:
        cells: lattice cells.
        margin: largest factor by which all of the task's wrenches can be multiplied; below 1 the shape cannot do the task.
        power_w: mean electrical power above idle, of the least-squares allocation within limits.
        variance: of a thruster's force over all thrusters and wrenches, N^2.
    """

    cells: Cells
    margin: float
    power_w: float
    variance: float


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The best pose of one shape.

    Attributes:
        best: performance in that pose.
        poses: number of distinct poses.
        guaranteed_margin: margin whichever `dead` thrusters fail.
        guaranteed_n, guaranteed_nm: force and moment in the worst direction, whichever `dead` thrusters fail.
        whole_n, whole_nm: the same with all thrusters alive.
    """

    best: Fitness
    poses: int
    guaranteed_margin: float
    guaranteed_n: float
    guaranteed_nm: float
    whole_n: float
    whole_nm: float


def rank(
    task: Task,
    count: int,
    vehicle: Vehicle,
    cache: DragCache | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Choice]:
    """Every distinct polycube of `count` modules, best first.

    Args:
        cache: cache of drag outlines, for trajectories.
        progress: called with the number of shapes done and the total.

    Raises:
        DescriptionError: a count without a list of shapes, or a vehicle that cannot be docked to its own kind.
    """
    shapes = polycubes(count)
    path = task.trajectory.path() if task.trajectory else None
    found = []
    for done, shape in enumerate(shapes):
        tried: list[tuple[Fitness, Layout, np.ndarray]] = []
        for cells in poses(shape):
            if path is None or task.trajectory is None:
                layout, wrenches = of_modules(cells, [0] * count, [vehicle] * count), task.wrench
            else:
                body = assemble(cells, [0] * count, [vehicle] * count, cache=cache)
                layout, wrenches = (
                    of_thrusters(body.name, body.thrusters),
                    wrenches_along(path, body, task.trajectory.samples),
                )
            tried.append((fitness(cells, layout, wrenches), layout, wrenches))
        best, layout, wrenches = min(tried, key=lambda entry: (_order(task, entry[0]), entry[0].cells))
        found.append(_choice(best, len(tried), layout, wrenches, task.dead))
        if progress:
            progress(done + 1, len(shapes))
    return sorted(found, key=lambda choice: (_order(task, choice.best), choice.best.cells))


def fitness(cells: Cells, layout: Layout, wrenches: np.ndarray) -> Fitness:
    """Performance of one layout on (k, 6) wrenches, N and N m."""
    forces = least_squares_forces(layout, wrenches)
    margin = float(reach_by_programs(layout, _asked(layout, wrenches)).min(initial=np.inf))
    return Fitness(cells, margin, float(electrical_power(layout, forces).mean()), float(forces.var()))


def _asked(layout: Layout, wrenches: np.ndarray) -> np.ndarray:
    """The (k, 6) wrenches without those that count as zero."""
    return np.asarray(wrenches[np.linalg.norm(wrenches / layout.levers, axis=1) > _STILL])


def _order(task: Task, part: Fitness) -> tuple[bool, float, float]:
    """Sorting key: feasible shapes first. Values are rounded, so that rounding errors do not order equal shapes."""
    value = {"margin": -part.margin, "power": part.power_w, "variance": part.variance}[task.rank_by]
    second = part.power_w if task.rank_by == "margin" else -part.margin
    return part.margin < 1.0, _rounded(value), _rounded(second)


def _rounded(value: float) -> float:
    return float(f"{value:.9g}")


def _choice(best: Fitness, count: int, layout: Layout, wrenches: np.ndarray, dead: int) -> Choice:
    whole = WrenchSpace(layout)
    left = whole.with_dead(dead)
    margin = float(left.reach(_asked(layout, wrenches)).min(initial=np.inf))
    return Choice(best, count, margin, *(space.worst(frame) for space in (left, whole) for frame in ("force", "torque")))
