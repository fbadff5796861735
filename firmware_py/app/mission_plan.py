"""Plans one minimum-snap trajectory, with rests, from the legs of a mission. Slow: runs beside the loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.rotations import from_euler
from firmware_py.core.types import Setpoint
from firmware_py.ground.mission_legs import GO_TO, Leg
from firmware_py.ground.plan_jobs import Plan, PlanJob
from firmware_py.prepare.minimum_snap import InfeasibleError, Limits, UnwantedError, Waypoint, distinct, fastest, plan
from firmware_py.prepare.piecewise import Piecewise
from firmware_py.prepare.snap_timing import MOVED_M

_SAME = 1e-3
"""Largest difference, in position (m) and in quaternion, at which neighbouring waypoints count as one."""
_ANGULAR_RATE, _ANGULAR_ACCELERATION = 0.5, 0.5
"""rad/s and rad/s^2. Turns on the way are gentle, so that the tag stays readable."""
_THRUSTER_SHARE = 0.6
"""Share of each thruster's range that a mission may use; the rest is reserved against the current."""


@dataclass(slots=True)
class Consecutive:
    """Trajectories one after the other, each from rest to rest."""

    parts: tuple[tuple[float, Piecewise], ...]
    """Start time, s, and trajectory of each part; the end of a part is held until the next begins."""
    duration_s: float

    def sample(self, t_s: float) -> Setpoint:
        """The set-point at `t_s`; the ends are held."""
        start, part = self.parts[0]
        for begin, candidate in self.parts[1:]:
            if t_s < begin:
                break
            start, part = begin, candidate
        return part.sample(t_s - start)


def plan_mission(job: PlanJob, body: Body | None, wanted: Callable[[], bool] = lambda: True) -> Plan:
    """The plan of `job`; for a job that is infeasible or no longer `wanted`, a plan without trajectory that states the reason."""
    parts: list[tuple[float, Piecewise]] = []
    arrivals: list[float] = []
    at_s, p_wb, q_wb = 0.0, job.p_wb, job.q_wb
    try:
        for section in _sections(job.legs):
            points, places = _waypoints(p_wb, q_wb, section)
            if len(points) > 1:
                path, passed_s = fastest(points, section[0].speed_m_s, _limits(job), body, wanted)
                parts.append((at_s, path))
                arrivals += [at_s + float(passed_s[place]) for place in places]
                at_s += path.duration_s
            else:
                arrivals += [at_s] * len(section)
            p_wb, q_wb = _end(points)
            at_s += section[-1].hold_s
    except InfeasibleError as error:
        leg = next((leg for leg, place in zip(section, places, strict=True) if place > error.place.waypoint), section[-1])
        target = "there" if leg.sequence == GO_TO else f"to item {leg.sequence}"
        return Plan(job.serial, None, (), error.worded(f"on the way {target}"))
    except ValueError as error:
        return Plan(job.serial, None, (), str(error))
    except UnwantedError:
        return Plan(job.serial, None, (), "nobody waits for it any more")
    if not parts:
        parts.append((0.0, plan([Waypoint(job.p_wb, job.q_wb), Waypoint(job.p_wb, job.q_wb)], 1.0)))
    return Plan(job.serial, Consecutive(tuple(parts), max(at_s, 1e-3)), tuple(arrivals))


def _sections(legs: Sequence[Leg]) -> Iterator[list[Leg]]:
    """Splits legs into runs without a stop: cuts after each leg with a hold, and where the speed changes."""
    section: list[Leg] = []
    for leg in legs:
        if section and (section[-1].hold_s > 0 or leg.speed_m_s != section[-1].speed_m_s):
            yield section
            section = []
        section.append(leg)
    if section:
        yield section


def _waypoints(p_wb: np.ndarray, q_wb: np.ndarray, section: Sequence[Leg]) -> tuple[list[Waypoint], list[int]]:
    """The waypoints from a pose through a section, and for each leg the index of its waypoint; equal neighbours are merged."""
    wanted = [Waypoint(p_wb, q_wb)]
    for leg in section:
        before = wanted[-1]
        place = before.p_wb if leg.p_wb is None else leg.p_wb
        wanted.append(Waypoint(place, before.q_wb if leg.yaw is None else from_euler(0.0, 0.0, leg.yaw)))
    points, places = distinct(wanted, _SAME)
    return points, places[1:]


def _end(points: Sequence[Waypoint]) -> tuple[np.ndarray, np.ndarray]:
    last = points[-1]
    assert last.q_wb is not None
    return last.p_wb, last.q_wb


def _limits(job: PlanJob) -> Limits:
    return Limits(
        acceleration=np.full(3, job.acceleration),
        corridor_m=job.corridor_m - MOVED_M,
        angular_rate=_ANGULAR_RATE,
        angular_acceleration=_ANGULAR_ACCELERATION,
        thruster_share=_THRUSTER_SHARE,
    )
