"""The task for which a shape is chosen: wrenches to hold, or a trajectory to fly, read from a task file.

A task file is TOML: `wrench = [[Fx, Fy, Fz, Mx, My, Mz], ...]` or a [trajectory] table, and the ranking criterion.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.setpoint import Trajectory
from firmware_py.description.builder import build
from firmware_py.description.schema import DescriptionError, quantity, read_toml
from firmware_py.prepare import paths
from firmware_py.prepare.snap_thrust import wrenches

RANKINGS = ("margin", "power", "variance")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrajectoryTable:
    """[trajectory]: one of the closed-form paths of prepare.paths about the origin, rest to rest."""

    kind: str = quantity(choices=("spiral", "circle", "moebius", "lissajous"), help="form of the path")
    duration_s: float = quantity(60.0, unit="s", low=0.1, high=1e5, help="duration of the path, from rest to rest")
    radius_m: float = quantity(0.5, unit="m", low=0.0, high=1e3, help="spiral, circle, moebius: radius")
    climb_m: float = quantity(0.4, unit="m", low=-1e3, high=1e3, help="spiral: height gained from start to end")
    half_width_m: float = quantity(0.3, unit="m", low=0.0, high=1e3, help="moebius: half-width of the strip")
    turns: float = quantity(2.0, low=0.01, high=1e3, help="number of turns, laps or cycles")
    amplitude_m: np.ndarray = quantity([0.5, 0.5, 0.2], unit="m", low=0, high=1e3, shape=(3,), help="lissajous: amplitude along each axis")
    frequency: np.ndarray = quantity(
        [1.0, 2.0, 3.0], low=0, high=100, shape=(3,), help="lissajous: cycles per turn along each axis"
    )
    samples: int = quantity(100, low=2, high=10000, help="number of points of the path at which the wrench is evaluated")

    def path(self) -> Trajectory:
        """The trajectory, world NED."""
        origin = np.zeros(3)
        if self.kind == "spiral":
            return paths.spiral(origin, self.radius_m, self.climb_m, self.turns, self.duration_s)
        if self.kind == "circle":
            return paths.circle(origin, self.radius_m, self.turns, self.duration_s)
        if self.kind == "moebius":
            return paths.moebius(origin, self.duration_s, self.radius_m, self.half_width_m, self.turns)
        return paths.lissajous(origin, self.amplitude_m, self.frequency, self.duration_s, turns=self.turns)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Task:
    """One task file. The task uses the modules' axes; the pose of the shape in them is free."""

    name: str = quantity(help="name for display")
    vehicle: str = quantity("modcube", help="vehicle name or file, the same for every module")
    rank_by: str = quantity("margin", choices=RANKINGS, help="figure by which shapes are ranked")
    dead: int = quantity(1, low=0, high=4, help="number of dead thrusters that the guaranteed figures allow for")
    wrench: np.ndarray = quantity([], unit="N, N m", low=-1e5, high=1e5, shape=(-1, 6), help="wrenches to hold, body FRD")
    trajectory: TrajectoryTable | None = quantity(None, help="trajectory to fly, in place of wrenches to hold")

    def __post_init__(self) -> None:
        if (self.wrench.size > 0) == (self.trajectory is not None):
            raise DescriptionError("needs either `wrench` rows or a [trajectory] table, not both")
        if self.wrench.size and not np.all(np.any(self.wrench != 0.0, axis=1)):
            raise DescriptionError(f"wrench row {int(np.argmin(np.any(self.wrench != 0.0, axis=1)))} is zero", "wrench")


def load_task(path: Path) -> Task:
    """The task in `path`. Raises DescriptionError, one line."""
    table, source = read_toml(path)
    task: Task = build(Task, table, source)
    return task


def wrenches_along(path: Trajectory, body: Body, samples: int) -> np.ndarray:
    """(samples, 6) wrench that a body needs at evenly spaced times along a trajectory, N and N m, body frame, in still water."""
    times = np.linspace(0.0, path.duration_s, samples)
    return wrenches(body, np.array([np.concatenate(path.sample(float(t))) for t in times]))
