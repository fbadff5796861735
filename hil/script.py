"""The operator's script of a trajectory task: arm, wait at the start, begin the task. It uses the firmware through requests alone."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from firmware_py.app.firmware import vehicles_of
from firmware_py.core import rotations
from firmware_py.core.setpoint import Trajectory, rest_at
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Outputs, Request, Setpoint
from firmware_py.description.fleet import Fleet
from firmware_py.description.schema import DescriptionError, frozen_array
from firmware_py.prepare import paths
from firmware_py.prepare.assembly import assemble_fleet, check_fleet
from firmware_py.prepare.minimum_snap import InfeasibleError
from firmware_py.prepare.waypoints import Mission, line_of, read_mission
from hil.orders import Orders, is_time_to_arm
from hil.scenario import Scenario
from hil.starts import hull_levers, in_wall
from hil.task import Task

MOEBIUS_RAMP_SHARE = 0.25
"""Share of the duration in which the speed rises, and likewise falls: 0.25 keeps the peak at 4/3 of the mean, so drag errors stay small."""
APART_M, APART_DEG = 0.01, 1.0
"""Tolerance between the first waypoint and the start: allows for rounding in a spreadsheet, but is no move of its own before the task."""
LOOKS = 500
"""Number of points of a path that are checked: every 3 cm of the longest path flown here."""
LONGER_S = 1e-6
"""Rounding tolerance of a path's duration against its task's."""


class Script(Orders):
    """The requests of one run. Raises DescriptionError for a path that leaves the tank or a waypoint file that cannot be flown."""

    def __init__(self, scenario: Scenario, fleet: Fleet) -> None:
        self._fleet = fleet
        self._task = scenario.task
        if scenario.task.kind == "waypoints":
            refuse_points_outside(scenario)
        start = scenario.module[0].start
        self.trajectory = TASKS[scenario.task.kind](scenario.task, rest_at(start.p_wm, start.q_wm), fleet)
        try:
            refuse_beyond_tank(self.trajectory, scenario)
        except DescriptionError as error:
            raise DescriptionError(f"{scenario.task.file or f'{scenario.name}: task'}: {error}") from None
        self.ticks = scenario.task.end_ns // fleet.period_ns
        self._armed = False
        self._begun = False

    def requests(self, time_ns: int, last: Outputs | None) -> Sequence[Request]:
        """The requests in the tick at `time_ns` since the start, given the outputs of the previous tick."""
        if time_ns >= self._task.begin_ns and not self._begun:
            self._begun = True
            return [Request(Action.TRACK, 0, self.trajectory)]
        if self._armed or last is None:
            return []
        if last.records[0].state == State.ARMED:
            self._armed = True
            return [Request(Action.HOLD, 0, self.trajectory.sample(0.0))]
        return [Request(Action.ARM)] if is_time_to_arm(time_ns, self._fleet) else []


def mistake_of_flight(scenario: Scenario, fleet: Fleet) -> tuple[tuple[str | int, ...], str] | None:
    """Path of keys to an entry of the scenario's file that no flight can follow, and the error message: docked modules that no face joins,
    and a path by the file's own numbers that leaves the tank. None where there is neither. A path from a file of its own is not planned.
    """
    vehicles = vehicles_of(fleet)
    for members in scenario.groups:
        try:
            check_fleet(dataclasses.replace(fleet, module=tuple(fleet.module[m] for m in members)), vehicles)
        except DescriptionError as error:
            return ("module", members[0]), str(error)
    if scenario.task.kind not in TASKS or scenario.task.kind == "waypoints":
        return None
    start = scenario.module[0].start
    path = TASKS[scenario.task.kind](scenario.task, rest_at(start.p_wm, start.q_wm), fleet)
    try:
        refuse_beyond_tank(path, scenario)
    except DescriptionError as error:
        return ("task",), str(error)
    return None


def refuse_points_outside(scenario: Scenario) -> None:
    """Raises DescriptionError for the first waypoint of the task's file that is outside the tank."""
    task = scenario.task
    for k, waypoint in enumerate(read_mission(task.file_text, task.file).waypoint):
        if not scenario.tank.holds(waypoint.position_m):
            where = f"{task.file}:{line_of(task.file_text, task.file, k)}: waypoint {k}, at {waypoint.position_m.tolist()} m"
            raise DescriptionError(f"{where}, is outside the tank, a {scenario.tank}; keep it inside")


def refuse_beyond_tank(path: Trajectory, scenario: Scenario) -> None:
    """Raises DescriptionError if the path takes the body's centre out of the tank, or one of its hulls into a wall."""
    refuse_outside(path, scenario)
    refuse_in_wall(path, scenario)


def refuse_outside(path: Trajectory, scenario: Scenario) -> None:
    """Raises DescriptionError if the path takes the body's centre out of the tank."""
    for time_s in np.linspace(0.0, path.duration_s, LOOKS).tolist():
        place = path.sample(time_s).p_wb
        if not scenario.tank.holds(place):
            where = f"after {time_s:.3g} s, at {place.round(3).tolist()} m"
            raise DescriptionError(f"the path leaves the tank, a {scenario.tank}, {where}; keep it inside")


def refuse_in_wall(path: Trajectory, scenario: Scenario) -> None:
    """Raises DescriptionError if the path takes a hull of the first body into a wall."""
    members = scenario.groups[0]
    hulls = np.concatenate([levers for m, (_, levers) in hull_levers(scenario).items() if m in members])
    for time_s in np.linspace(0.0, path.duration_s, LOOKS).tolist():
        wanted = path.sample(time_s)
        if where := in_wall(scenario.tank, wanted.p_wb + hulls @ rotations.to_matrix(wanted.q_wb).T):
            raise DescriptionError(f"after {time_s:.3g} s, at {wanted.p_wb.round(3).tolist()} m, a hull is {where}; keep it inside")


def _hover(task: Task, start: Setpoint, fleet: Fleet) -> Trajectory:
    return paths.Hold(rest_at(np.array(task.centre_m), start.q_wb), task.duration_s)


def _spiral(task: Task, start: Setpoint, fleet: Fleet) -> Trajectory:
    return paths.spiral(task.centre_m, task.radius_m, task.climb_m, task.turns, task.duration_s, attitude=start.q_wb)


def _moebius(task: Task, start: Setpoint, fleet: Fleet) -> Trajectory:
    return paths.moebius(
        task.centre_m, task.duration_s, task.radius_m, task.half_width_m, task.turns, ramp_share=MOEBIUS_RAMP_SHARE
    )


def _lissajous(task: Task, start: Setpoint, fleet: Fleet) -> Trajectory:
    turning = (task.yaw_turns, task.roll_turns)
    return paths.lissajous(
        task.centre_m,
        task.amplitude_m,
        task.frequency,
        task.duration_s,
        turns=task.turns,
        attitude=start.q_wb,
        turning=turning,
    )


def _waypoints(task: Task, start: Setpoint, fleet: Fleet) -> Trajectory:
    """The path of the file, unchanged. One that does not fit its limits, the thrusters, its task or the start is refused, not stretched."""
    mission = _from_start(read_mission(task.file_text, task.file), start)
    _refuse_unbounded(mission, task.file)
    try:
        mission.check_bounded()
        path = mission.plan(assemble_fleet(fleet, vehicles_of(fleet))[0], stretch=False)
    except ValueError as error:
        raise _infeasible(error, task) from None
    first = path.sample(0.0)
    apart_m = float(np.linalg.norm(first.p_wb - start.p_wb))
    apart_deg = math.degrees(float(np.linalg.norm(rotations.difference(start.q_wb, first.q_wb))))
    if apart_m > APART_M or apart_deg > APART_DEG:
        where = f"{apart_m:.3g} m and {apart_deg:.3g} deg away from the robot's start at {start.p_wb.tolist()} m"
        raise DescriptionError(f"{task.file}: the path begins {where}; the two must be one pose")
    if path.duration_s > task.duration_s + LONGER_S:
        raise DescriptionError(f"{task.file}: the path takes {path.duration_s:.7g} s, longer than task.duration_s, {task.duration_s:g} s")
    return path


def _infeasible(error: ValueError, task: Task) -> DescriptionError:
    """The error for a file whose path cannot be flown: with the line of the waypoint that cannot be held, or behind the hurried piece."""
    if not isinstance(error, InfeasibleError):
        return DescriptionError(f"{task.file}: {error}")
    if error.place.time_s is None:
        return DescriptionError(f"{task.file}:{line_of(task.file_text, task.file, error.place.waypoint)}: {error}")
    slow, where = error.place.waypoint, ""
    if error.hurried is not None:
        slow, where = error.hurried, f" between waypoints {error.hurried} and {error.hurried + 1}"
    return DescriptionError(f"{task.file}:{line_of(task.file_text, task.file, slow + 1)}: {error}; allow more time{where}")


def _refuse_unbounded(mission: Mission, file: str) -> None:
    """Raises DescriptionError for a file that does not determine how long its path takes."""
    limits = mission.limits.limits()
    bounds = (limits.velocity, limits.acceleration, limits.angular_rate, limits.angular_acceleration)
    if mission.duration_s > 0.0 or mission.waypoint[-1].duration_s > 0.0 or any(bound is not None for bound in bounds):
        return
    if file.lower().endswith(".csv"):
        raise DescriptionError(f"{file}: has no durations; add the column duration_s, or write a .toml with [limits]")
    raise DescriptionError(f"{file}: has no durations; add duration_s, or [limits] with velocity_m_s or acceleration_m_s2")


def _from_start(mission: Mission, start: Setpoint) -> Mission:
    """The mission, with the attitude of the start if its first waypoint has none."""
    first, *others = mission.waypoint
    if len(first.quaternion):
        return mission
    first = dataclasses.replace(first, quaternion=frozen_array(start.q_wb))
    return dataclasses.replace(mission, waypoint=(first, *others))


TASKS: dict[str, Callable[[Task, Setpoint, Fleet], Trajectory]] = {
    "hover": _hover,
    "lissajous": _lissajous,
    "moebius": _moebius,
    "spiral": _spiral,
    "waypoints": _waypoints,
}
"""Trajectory of each kind of task."""
