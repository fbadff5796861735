"""Minimum snap through waypoints in position and attitude: in closed form, with OSQP under limits, with time stretched to fit.

Paper, "Trajectory Planning for RS-ModCubes" (Mellinger and Kumar 2011), with continuity to the fourth derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from firmware_py.core import rotations
from firmware_py.core.body import Body
from firmware_py.prepare.piecewise import Piecewise
from firmware_py.prepare.snap_check import check, check_standing, check_turns
from firmware_py.prepare.snap_limits import InfeasibleError, Limits, planes, worst
from firmware_py.prepare.snap_osqp import solve_limited
from firmware_py.prepare.snap_spline import Knots, System, divide_time, solve
from firmware_py.prepare.snap_stretch import least_stretched
from firmware_py.prepare.snap_timing import Timed, hastened, stretch_within

__all__ = ["InfeasibleError", "Limits", "UnwantedError", "Waypoint", "distinct", "fastest", "plan"]

ATTITUDE_LEVER_M = 0.5
"""One radian counts as this many metres when time is divided among the pieces."""

FIRST_SPEED = 0.1
"""Speed for the initial guess of free durations, m/s; the result does not depend on it."""

_SAME = 1e-6
"""Largest difference, in position (m) and in quaternion, at which waypoints count as equal."""


class UnwantedError(Exception):
    """The trajectory is no longer wanted."""


def _always() -> bool:
    return True


@dataclass(frozen=True, eq=False)
class Waypoint:
    """A pose to pass through.

    Attributes:
        p_wb: (3,) m, world.
        q_wb: (4,) attitude; None keeps that of the previous waypoint.
        velocity_w: (3,) velocity at the waypoint, m/s; None leaves it free. The first and the last waypoint are at rest.
        stop: whether to come to rest there.
    """

    p_wb: np.ndarray
    q_wb: np.ndarray | None = None
    velocity_w: np.ndarray | None = None
    stop: bool = False


def plan(
    waypoints: Sequence[Waypoint],
    durations_s: Sequence[float] | float | None = None,
    limits: Limits | None = None,
    body: Body | None = None,
    stretch: bool = True,
) -> Piecewise:
    """The trajectory of least snap through the waypoints, rest to rest.

    Equal neighbours are merged and count once in `breaks`, unless a duration is given for each piece.

    Args:
        waypoints: two or more.
        durations_s: of each piece; or their sum, divided for least snap; or None: as short as limits and body allow.
        limits: of the path.
        body: must be able to fly the path with its thrusters, in still water, with the axes that they do not span left to buoyancy.
        stretch: whether to lengthen the durations until all limits hold; False takes them as they are.

    Raises:
        InfeasibleError: states which limit cannot be kept, and where.
        ValueError: too few waypoints, a velocity where the path rests, durations that do not match, or free durations that
            nothing bounds.
    """
    limits = limits or Limits()
    _check(waypoints)
    if isinstance(durations_s, Sequence | np.ndarray):
        return _plan(waypoints, durations_s, limits, body, stretch)
    merged, own = distinct(waypoints)
    try:
        return _plan(merged, durations_s, limits, body, stretch)
    except InfeasibleError as error:
        raise error.renumbered(len(own) - 1 - own[::-1].index(min(error.place.waypoint, own[-1]))) from None


def _plan(
    waypoints: Sequence[Waypoint],
    durations_s: Sequence[float] | float | None,
    limits: Limits,
    body: Body | None,
    stretch: bool,
) -> Piecewise:
    """The trajectory through waypoints that are merged where they may be; see `plan`."""
    request = _Request.of(waypoints if len(waypoints) > 1 else [*waypoints, *waypoints], limits, body)
    base = request.durations(durations_s)
    if durations_s is not None and not stretch:
        try:
            return request.attempt(base)
        except InfeasibleError as error:
            request.check_standing()  # where that is the reason, more time would not help
            if isinstance(durations_s, Sequence | np.ndarray):
                error.hurried = int(np.argmin(base / request.durations(float(base.sum()))))
            raise
    request.check_standing()
    free = durations_s is None
    if free:
        check_bounded(waypoints, limits, body)
    both_ways = free and request.passes_at_speed()
    return least_stretched(lambda factor: replace(request.attempt(base * factor), stretch=factor), free, both_ways)


def fastest(
    waypoints: Sequence[Waypoint],
    speed_m_s: float,
    limits: Limits,
    body: Body | None = None,
    wanted: Callable[[], bool] = _always,
) -> Timed:
    """The path of least snap within the corridor, rest to rest, at each place as fast as the speed and the other limits permit there.

    Of paths that differ only in pace, all or none are within a corridor: one solution is enough, where `plan` seeks the durations with a
    dozen. Where no such path is found, or its attitude turns too far, it leads straight from stop to stop.

    Args:
        waypoints: two or more, no two neighbours equal (see `distinct`), without given velocities.
        speed_m_s: largest speed, in any direction.
        limits: acceleration, angular_rate and angular_acceleration bound the pace; velocity is not looked at.
        body: must be able to fly the path, as for `plan`.
        wanted: called before each round of OSQP and each check of a path; with hundreds of waypoints each round takes seconds.

    Raises:
        InfeasibleError: states what the body cannot fly, and where.
        UnwantedError: the trajectory is no longer `wanted`.
    """
    request = _Request.of(waypoints, replace(limits, velocity=None, acceleration=None), body, wanted)
    request.check_standing()
    path = request.path_in_corridor()
    path = path.slowed(stretch_within(path, speed_m_s, limits))

    def is_flyable(found: Piecewise) -> bool:
        try:
            request.checked(found)
        except InfeasibleError:
            return False
        return True

    return hastened(least_stretched(lambda factor: request.checked(path.slowed(factor)), free=False), speed_m_s, limits, is_flyable)


def check_bounded(waypoints: Sequence[Waypoint], limits: Limits, body: Body | None = None) -> None:
    """Raises ValueError where neither a limit nor the body keeps the duration of the path from vanishing."""
    if not _Request.of(waypoints, limits, body).bounds_speed():
        raise ValueError(
            "free durations need a limit that this path meets, on velocity or acceleration where it moves, "
            "on angular rate or acceleration where it turns"
        )


def distinct(waypoints: Sequence[Waypoint], same: float = _SAME) -> tuple[list[Waypoint], list[int]]:
    """Merges equal neighbours; returns the merged waypoints, and for each of `waypoints` the index of its merged one.

    Neighbours with different given velocities are not equal, and nor are a velocity and a rest: a loop leads from one to the other.

    Args:
        same: largest difference, in position (m) and in quaternion, at which neighbours count as equal.
    """
    attitudes = _continuous(waypoints)
    first, passed = 0, _velocity(waypoints, 0)
    kept, own = [waypoints[0]], [0]
    for k, waypoint in enumerate(waypoints[1:], 1):
        velocity = _velocity(waypoints, k)
        is_near = np.linalg.norm(waypoint.p_wb - kept[-1].p_wb) <= same and np.linalg.norm(attitudes[k] - attitudes[first]) <= same
        if is_near and (velocity is None or passed is None or np.array_equal(velocity, passed)):
            passed = velocity if passed is None else passed
            kept[-1] = replace(kept[-1], velocity_w=passed, stop=kept[-1].stop or waypoint.stop)
        else:
            first, passed = k, velocity
            kept.append(waypoint)
        own.append(len(kept) - 1)
    return kept, own


@dataclass(frozen=True, eq=False)
class _Request:
    """Waypoints, limits and body in the form that the solver takes."""

    position: Knots
    attitude: Knots
    limits: Limits
    body: Body | None
    wanted: Callable[[], bool]

    @staticmethod
    def of(waypoints: Sequence[Waypoint], limits: Limits, body: Body | None, wanted: Callable[[], bool] = _always) -> _Request:
        value = np.array([w.p_wb for w in waypoints], dtype=float)
        position = Knots.at_rest(value)
        attitude = Knots.at_rest(_continuous(waypoints))
        for k, waypoint in enumerate(waypoints):
            if waypoint.stop:
                position.fixed[k], attitude.fixed[k] = True, True
            elif waypoint.velocity_w is not None:
                position.fixed[k, 0] = True
                position.derivative[k, 0] = waypoint.velocity_w
        return _Request(position, attitude, limits, body, wanted)

    def bounds_speed(self) -> bool:
        """Whether some limit, or the body, keeps the duration of this path from vanishing."""
        limits, knots = self.limits, self.position
        moves = np.ptp(knots.value, axis=0) > _SAME
        pushed = moves | np.any(knots.derivative[:, 0] != 0.0, axis=0)
        turns = np.any(np.ptp(self.attitude.value, axis=0) > _SAME)
        if self.body is not None:
            return bool(np.any(pushed) or turns)
        bounds = (
            (limits.velocity, moves),
            (limits.acceleration, pushed),
            (limits.angular_rate, turns),
            (limits.angular_acceleration, turns),
        )
        return any(bound is not None and bool(np.any(np.isfinite(bound) & where)) for bound, where in bounds)

    def passes_at_speed(self) -> bool:
        """Whether a velocity is given somewhere. It is reached and lost again on the way, so that long durations may be infeasible."""
        return bool(np.any(self.position.derivative[:, 0]))

    def durations(self, asked: Sequence[float] | float | None) -> np.ndarray:
        """(n - 1,) durations to start from, s."""
        count = len(self.position.value) - 1
        if isinstance(asked, Sequence | np.ndarray):
            given = np.array(asked, dtype=float)
            if given.shape != (count,) or not np.all(given > 0.0):
                raise ValueError(f"{count + 1} waypoints need {count} durations above zero, not {given.tolist()}")
            return given
        value = np.hstack([self.position.value, 2.0 * ATTITUDE_LEVER_M * self.attitude.value])
        distance = float(np.linalg.norm(np.diff(value, axis=0), axis=1).sum())
        total = max(distance / FIRST_SPEED, 1.0) if asked is None else float(asked)
        if not total > 0.0:
            raise ValueError(f"a duration is above zero, not {total}")
        knots = Knots.at_rest(value)
        knots.fixed[:] |= self.position.fixed
        knots.derivative[:, :, :3] = self.position.derivative
        return divide_time(knots, total)

    def attempt(self, durations: np.ndarray) -> Piecewise:
        """The trajectory in exactly these durations. Raises InfeasibleError and UnwantedError."""
        return self.checked(self._path(durations))

    def path_in_corridor(self) -> Piecewise:
        """The path of `fastest`, in durations of its own: neither its pace nor what the body can fly is checked."""
        durations = self.durations(None)
        try:
            found = self._path(durations)
            check_turns(found)
        except InfeasibleError:
            position, attitude = (replace(knots, fixed=np.ones_like(knots.fixed)) for knots in (self.position, self.attitude))
            return replace(self, position=position, attitude=attitude)._path(durations)
        return found

    def _path(self, durations: np.ndarray) -> Piecewise:
        """The trajectory in exactly these durations, not checked.

        Raises:
            InfeasibleError: it would break a limit of the position.
            UnwantedError: the trajectory is no longer `wanted`.
        """
        system = System.of(durations)
        unknown = solve(system, self.position)
        bounds = planes(self.position.value, self.limits)
        method = "closed form"
        if worst(bounds, system.coefficients(self.position.value, unknown), durations)[0] > 1.0:
            unknown, method = solve_limited(system, self.position, bounds, unknown, self._check_wanted), "osqp"
        turning = system.coefficients(self.attitude.value, solve(system, self.attitude))
        both = np.concatenate([system.coefficients(self.position.value, unknown), turning], axis=2)
        breaks = np.concatenate([[0.0], np.cumsum(durations)])
        cost = system.cost(self.position.value, unknown)
        return Piecewise(np.ascontiguousarray(both), breaks, method, 1.0, cost)

    def checked(self, found: Piecewise) -> Piecewise:
        """The same trajectory, if `check` does not refuse it. Raises InfeasibleError and UnwantedError."""
        self._check_wanted()
        check(found, self.limits, self.body)
        return found

    def check_standing(self) -> None:
        """Refuses attitudes that the body cannot hold even at rest. Raises InfeasibleError."""
        if self.body is not None:
            check_standing(self.attitude.value, self.limits, self.body)

    def _check_wanted(self) -> None:
        """Raises UnwantedError where the trajectory is no longer wanted."""
        if not self.wanted():
            raise UnwantedError


def _check(waypoints: Sequence[Waypoint]) -> None:
    """Refuses too few waypoints, and a velocity where the path rests. Raises ValueError."""
    if len(waypoints) < 2:
        raise ValueError(f"a trajectory needs two waypoints, not {len(waypoints)}")
    for k, waypoint in enumerate(waypoints):
        if _rests(waypoints, k) and waypoint.velocity_w is not None and np.any(waypoint.velocity_w):
            raise ValueError(f"waypoint {k} has a velocity, but the path rests there")


def _rests(waypoints: Sequence[Waypoint], k: int) -> bool:
    return waypoints[k].stop or k in (0, len(waypoints) - 1)


def _velocity(waypoints: Sequence[Waypoint], k: int) -> np.ndarray | None:
    """(3,) velocity at waypoint k, m/s; None where it is free."""
    return np.zeros(3) if _rests(waypoints, k) else waypoints[k].velocity_w


def _continuous(waypoints: Sequence[Waypoint]) -> np.ndarray:
    """(n, 4) unit quaternions, each with the sign nearer to its predecessor."""
    found = [np.array([1.0, 0.0, 0.0, 0.0])]
    for waypoint in waypoints:
        q = found[-1] if waypoint.q_wb is None else rotations.normalise(np.array(waypoint.q_wb, dtype=float))
        found.append(q if q @ found[-1] >= 0.0 else -q)
    return np.array(found[1:])
