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
    found = []
    for done, shape in enumerate(shapes, 1):
        found.append(_best_pose(task, shape, vehicle, cache))
        if progress:
            progress(done, len(shapes))
    return sorted(found, key=lambda choice: _order(task, choice.best))


def _best_pose(task: Task, shape: Cells, vehicle: Vehicle, cache: DragCache | None) -> Choice:
    """The pose of a shape that does the task best."""
    tried = []
    for cells in poses(shape):
        layout, wrenches = _posed(task, cells, vehicle, cache)
        tried.append((fitness(cells, layout, wrenches), layout, wrenches))
    best, layout, wrenches = min(tried, key=lambda each: _order(task, each[0]))
    return _choice(best, len(tried), layout, wrenches, task.dead)


def _posed(task: Task, cells: Cells, vehicle: Vehicle, cache: DragCache | None) -> tuple[Layout, np.ndarray]:
    """The layout of one pose, and the (k, 6) wrenches that the task asks of it."""
    rotation, vehicles = [0] * len(cells), [vehicle] * len(cells)
    if task.trajectory is None:
        return of_modules(cells, rotation, vehicles), task.wrench
    body = assemble(cells, rotation, vehicles, cache=cache)
    return of_thrusters(body.name, body.thrusters), wrenches_along(task.trajectory.path(), body, task.trajectory.samples)


def fitness(cells: Cells, layout: Layout, wrenches: np.ndarray) -> Fitness:
    """Performance of one layout on (k, 6) wrenches, N and N m."""
    forces = least_squares_forces(layout, wrenches)
    margin = float(reach_by_programs(layout, _asked(layout, wrenches)).min(initial=np.inf))
    return Fitness(cells, margin, float(electrical_power(layout, forces).mean()), float(forces.var()))


def _asked(layout: Layout, wrenches: np.ndarray) -> np.ndarray:
    """The (k, 6) wrenches without those that count as zero."""
    return np.asarray(wrenches[np.linalg.norm(wrenches / layout.levers, axis=1) > _STILL])


def _order(task: Task, part: Fitness) -> tuple[bool, float, float, Cells]:
    """Sorting key: feasible shapes first. Values are rounded, so that rounding errors do not order equal shapes; their cells do."""
    value = {"margin": -part.margin, "power": part.power_w, "variance": part.variance}[task.rank_by]
    second = part.power_w if task.rank_by == "margin" else -part.margin
    return part.margin < 1.0, _rounded(value), _rounded(second), part.cells


def _rounded(value: float) -> float:
    return float(f"{value:.9g}")


def _choice(best: Fitness, count: int, layout: Layout, wrenches: np.ndarray, dead: int) -> Choice:
    whole = WrenchSpace(layout)
    left = whole.with_dead(dead)
    margin = float(left.reach(_asked(layout, wrenches)).min(initial=np.inf))
    return Choice(best, count, margin, *(space.worst(frame) for space in (left, whole) for frame in ("force", "torque")))
