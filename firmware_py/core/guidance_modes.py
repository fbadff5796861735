"""Stage 5 of a tick: turns set-points, trajectories and sticks into the set-point of each mode, and mixes the controller's wrench with the
sticks.

Mode changes are free of jumps: the set-point continues from where it is, and the wrench is blended over within `blend_s`.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.collision import braking_s
from firmware_py.core.failsafes import FREE, Level
from firmware_py.core.health import Health
from firmware_py.core.rotations import difference, heading, rotate, rotate_back
from firmware_py.core.setpoint import REST, Glider, Trajectory, Wish, ahead_of, at_estimate, on_leash, rest_at, way_to_rest_s
from firmware_py.core.supervisor import TAKES_OVER, Decision
from firmware_py.core.transitions import Effect
from firmware_py.core.types import COMMAND_TIMEOUT_NS, Estimate, Mode, Setpoint, Sticks
from firmware_py.description.parameters import Parameters

ZERO, STILL, DOWN = np.zeros(3), np.zeros(6), np.array([0.0, 0.0, 1.0])
STILL_S = COMMAND_TIMEOUT_NS / 1e9
"""Longest gap between two ticks, and longest time in which all modules say that they obey nothing. After a longer one the microcontrollers
have stopped all thrust (can_dbc/README.md), and the set-point restarts at rest where the body is."""
NEAR_M, NEAR_RAD = 0.2, 0.35
"""Largest distance, in m and rad, between set-point and body at which the set-point continues from where it is; otherwise it restarts from
the body."""
LEAST_LIFT = 0.5
"""Share of `surface_n_per_kg` with which SURFACE lifts a body that believes to be at the surface: a depth sensor that reads too shallow
must not keep a robot down. The 1.55 N of a module are three times the buoyancy that it may lack on the bench, and lift its hull 3 mm
farther out of the water."""
SURFACE_MARGIN_M = 0.02
"""Depth below that of the surface at which the body counts as there."""
COME_M = 0.005
"""Distance from the meeting point within which the set-point of a body that moves to meet another counts as arrived."""


class Keep(IntEnum):
    """Part of the controller's force or moment that is used; the rest comes from the sticks."""

    NOTHING = 0
    VERTICAL = 1
    """The vertical force."""
    ALL = 2


class Controlled(NamedTuple):
    """Parts of force and moment that the controller commands in a mode; sticks command the rest."""

    force: Keep
    moment: Keep


CONTROLLED = {
    Mode.MANUAL: Controlled(Keep.NOTHING, Keep.NOTHING),
    Mode.STABILIZE: Controlled(Keep.NOTHING, Keep.ALL),
    Mode.ALT_HOLD: Controlled(Keep.VERTICAL, Keep.ALL),
    Mode.POSHOLD: Controlled(Keep.ALL, Keep.ALL),
    Mode.AUTO: Controlled(Keep.ALL, Keep.ALL),
    Mode.GUIDED: Controlled(Keep.ALL, Keep.ALL),
    Mode.DOCK: Controlled(Keep.ALL, Keep.ALL),
    Mode.SURFACE: Controlled(Keep.ALL, Keep.ALL),
    Mode.MOTOR_DETECT: Controlled(Keep.NOTHING, Keep.NOTHING),
}


class Guidance:
    """Stores what was requested, and makes the set-point of each tick from it."""

    def __init__(self, body: Body, parameters: Parameters) -> None:
        self._body = body
        self.deceleration = body.deceleration
        """(2,) that of the thrusters that are used, as Body.deceleration."""
        self._glider = Glider(0.0, 0.0, 0.0)
        self.retune(parameters)
        self._trajectory: Trajectory | None = None
        self._start_ns: int | None = None
        """AUTO's trajectory, and when it began; None while the body is on its way to its start."""
        self._goal: Wish | None = None
        """Pose that POSHOLD flies to, or to which ALT_HOLD turns; None: sticks alone move the set-point."""
        self._met: tuple[Wish, Wish | None] | None = None
        """Position held before the body moved to meet another, and the one that it was sent to."""
        self._is_unlocated = False
        """Whether the estimate is levelled by gravity alone, with heading and position unknown."""
        self._was_unplaced = self._was_rate_commanded = False
        self._point: tuple[int, Setpoint] | None = None
        """When GUIDED's newest set-point came, and it."""
        self._docking: Setpoint | Wish | None = None
        """What the docking sequence wants in this tick."""
        self._sticks, self._sticks_ns = Sticks(), 0
        self._time_ns: int | None = None
        self._wrench = np.zeros(6)
        """Wrench of the last tick, (6,), body frame."""
        self._blend = False
        """Whether the mode has changed since, so that a new blend begins at `_wrench`."""
        self._offset, self._offset_ns = np.zeros(6), 0
        """Wrench of the mode before less that of the new one, (6,), when the mode changed, and that time: it fades out from then on."""
        self.wanted = STILL
        """(6,) velocity, world, m/s, and turning rate, body, rad/s, at which this body would move if no other were in its way; zero in
        modes that stop before none."""
        self.mode = Mode.POSHOLD

    def retune(self, parameters: Parameters) -> None:
        """Applies new limits from this tick on; set-point and requests stay."""
        p = parameters.steering
        self._p, self._fence = p, parameters.fence
        self._lead_s = parameters.control.lead_s
        f = parameters.failsafes
        self._no_place_s, self._no_depth_s = f.tag_lost_limit, f.depth_unknown_limit
        self._most_push_m_s = f.pushed_limit if f.pushed_action > Level.WARN else math.inf
        self._least_s = f.collision_limit if f.collision_action >= Level.HOLD else 0.0
        self._full_stick = p.stick_share * self._body.thrusters.full_wrench
        self._lift_n = p.surface_n_per_kg * float(self._body.mass[2, 2])
        depth_m = self._body.r_bm[:, 2]
        at_surface_m = p.surface_depth_m + float(depth_m.mean() - depth_m.min())  # the highest module is to be at the surface
        self._surface_m = max(at_surface_m, float((0.5 * self._body.hull_m[:, 2] - depth_m).max()))  # with its hull in the water
        self._glider.retune(p.bandwidth, p.speed_m_s, p.rate_rad_s)

    def drop_stale_goals(self, estimate: Estimate, health: Health) -> None:
        """Drops goals when position and heading change their meaning; to be called before the decisions of a tick.

        That is when the estimate starts from gravity alone, and when tags then give position and heading.
        """
        before, self._is_unlocated = self._is_unlocated, health.ready and not health.placed
        if self._is_unlocated != before:
            self._glider.put(at_estimate(estimate))
            self._goal = self._point = None

    # ------------------------------------------------------------ requests

    def apply(self, decision: Decision, time_ns: int, estimate: Estimate) -> None:
        """Carries out a decision of the supervisor."""
        effect, argument = decision.effect, decision.argument
        if effect == Effect.TAKE_STICKS:
            self._sticks, self._sticks_ns = argument, time_ns
        elif effect == Effect.TAKE_POINT:
            self._point = (time_ns, argument)
        elif effect == Effect.STOP:
            self.rest(estimate)
        elif effect in (*TAKES_OVER, Effect.TEST_MOTOR):
            self._enter(decision.mode, time_ns, estimate)
            if effect == Effect.ENTER_LEVEL:
                self._level()
            elif effect == Effect.HOLD_AT and argument is not None:
                self._goal = Wish(ZERO, ZERO, self._inside(argument.p_wb), argument.q_wb)
            elif effect == Effect.FOLLOW:
                self._trajectory, self._start_ns = argument, None

    def _level(self) -> None:
        """Sets a goal to turn upright in place if the set-point is tilted more than a hold may keep."""
        at = self._glider.at
        if rotate(at.q_wb, DOWN)[2] < math.cos(self._p.hold_tilt_rad):
            self._goal = Wish(ZERO, ZERO, self._inside(at.p_wb), heading(at.q_wb), self._p.level_rad_s)

    def rest(self, estimate: Estimate) -> None:
        """Puts the set-point at rest at the estimated pose, for a body that is disarmed."""
        self._glider.put(rest_at(estimate.p_wb, estimate.q_wb))
        self._trajectory = self._goal = self._docking = None
        self._wrench, self._blend = np.zeros(6), True

    def take_over(
        self, mode: Mode, estimate: Estimate, wrench: np.ndarray, q_wb: np.ndarray, before: Guidance | None = None
    ) -> None:
        """Starts in `mode` at the pose of a new body, from the wrench (6,) that its thrusters give, and turns back to `q_wb`, the attitude
        that the previous body was to hold, if that is near: otherwise bodies that dock and part again and again would lean over. `before`,
        the guidance of the body that had its number, hands over its stick input, so that the pilot keeps control.
        """
        self._glider.put(at_estimate(estimate))
        self.mode, self._wrench, self._blend = mode, wrench, True
        if np.linalg.norm(difference(q_wb, estimate.q_wb)) <= NEAR_RAD:
            at = self._glider.at
            self._goal = Wish(ZERO, ZERO, at.p_wb + at.v_w * way_to_rest_s(self._p.bandwidth), q_wb)
        if before is not None:
            self._sticks, self._sticks_ns = before._sticks, before._sticks_ns

    def dock(self, where: Setpoint | Wish) -> None:
        """Sets where the docking sequence wants the body in this tick: at a set-point, or on its way to a goal."""
        self._docking = where

    def move_by(self, by_w: np.ndarray) -> None:
        """Shifts POSHOLD's position, or the one that it is on its way to, by (3,) in the world, m."""
        goal = self._held()
        self._goal = goal._replace(p_wb=self._inside(goal.p_wb + by_w))

    def meet(self, by_w: np.ndarray) -> None:
        """Shifts POSHOLD's position by (3,) in the world, m, to meet another body."""
        before = self._held()
        self.move_by(by_w)
        self._met = before, self._goal

    @property
    def is_coming(self) -> bool:
        """Whether the body is on its way to meet another: not yet at the meeting point, and not sent or steered elsewhere since."""
        if self._met is None or self._goal is not self._met[1]:
            return False
        return bool(np.linalg.norm(self._held().p_wb - self._glider.at.p_wb) > COME_M)

    def go_back(self) -> None:
        """Returns to the position held before meeting another body, unless the body has been sent or steered elsewhere since."""
        if self._met is not None and self._goal is self._met[1]:
            self._goal = self._met[0]

    @property
    def held_q_wb(self) -> np.ndarray:
        """(4,) attitude of the set-point, or the one that it is on its way to."""
        q_wb = self._held().q_wb
        return self._glider.at.q_wb if q_wb is None else q_wb

    def _held(self) -> Wish:
        """POSHOLD's position, or the one that it is on its way to."""
        at = self._glider.at
        return self._goal or Wish(ZERO, ZERO, at.p_wb, at.q_wb)

    def _enter(self, mode: Mode, time_ns: int, estimate: Estimate) -> None:
        """Changes the mode: drops what the last one flew to, and a streamed set-point that is too old."""
        if CONTROLLED[self.mode] != CONTROLLED[Mode.POSHOLD]:
            self._glider.put(at_estimate(estimate))
        self._go_on(estimate)
        self._trajectory = self._goal = self._docking = None
        if self._point is not None and time_ns - self._point[0] > self._p.guided_timeout_s * 1e9:
            self._point = None
        self.mode, self._blend = mode, True

    def _go_on(self, estimate: Estimate) -> None:
        """Keeps the set-point where it is near the body; otherwise restarts it from the body."""
        at = self._glider.at
        gap, turn = np.linalg.norm(at.p_wb - estimate.p_wb), np.linalg.norm(difference(at.q_wb, estimate.q_wb))
        if not (gap <= NEAR_M and turn <= NEAR_RAD):
            self._glider.put(at_estimate(estimate))

    # ------------------------------------------------------------ the set-point

    def step(self, time_ns: int, estimate: Estimate, health: Health) -> tuple[Setpoint, Setpoint]:
        """Returns the set-point at `time_ns`, and the one `lead_s` later, for the feed-forward."""
        self.wanted = STILL
        dt_s = 0.0 if self._time_ns is None else (time_ns - self._time_ns) * 1e-9
        self._time_ns = time_ns
        if max(dt_s, health.still_s) > STILL_S:
            self._glider.put(rest_at(estimate.p_wb, estimate.q_wb))
            self._start_ns = None if self._start_ns is None else self._start_ns + round(dt_s * 1e9)
            dt_s = 0.0
        if self.mode == Mode.AUTO and self._trajectory is not None and self._joined(self._trajectory, time_ns):
            sampled = self._sample(self._trajectory, time_ns)
            if sampled is not None:
                self.wanted = np.concatenate((sampled[0].v_w, sampled[0].w_b))
                return sampled
            self._trajectory = None  # it has a gap: the body stops before it
        if self.mode == Mode.DOCK and isinstance(self._docking, Setpoint):
            self._glider.put(self._docking)
            return self._docking, ahead_of(self._docking, self._lead_s)
        wish = self._stopped_before_others(self._wish(time_ns), health)
        was_rate_commanded = self._was_rate_commanded
        self._was_rate_commanded = self.mode == Mode.GUIDED or bool(wish.v_w.any() or wish.w_b.any())
        if self._was_rate_commanded:  # by requested speeds, while something may hold the body back
            self._glider.put(on_leash(self._glider.at, estimate))
        elif was_rate_commanded:
            self._go_on(estimate)
        now = self._glider.step(wish, dt_s)
        was_unplaced, self._was_unplaced = self._was_unplaced, not self._placed(health)  # when tags return, it follows for one more tick
        if CONTROLLED[self.mode].force != Keep.ALL or (self.mode == Mode.SURFACE and (was_unplaced or self._is_elsewhere(now, estimate))):
            now = self._follow_body(now, estimate)
        return now, ahead_of(now, self._lead_s)

    def _sample(self, trajectory: Trajectory, time_ns: int) -> tuple[Setpoint, Setpoint] | None:
        """Returns the trajectory's set-points, now and ahead; None where one of them is not finite."""
        assert self._start_ns is not None
        t = (time_ns - self._start_ns) * 1e-9
        now, ahead = trajectory.sample(t), trajectory.sample(t + self._lead_s)
        motion = np.concatenate((*now, *ahead))
        if not math.isfinite(motion.dot(motion)):
            return None
        self._glider.put(now)
        return now, ahead

    def _joined(self, trajectory: Trajectory, time_ns: int) -> bool:
        """Whether the trajectory runs; starts it when the set-point is near its start."""
        if self._start_ns is None:
            start, at = trajectory.sample(0.0), self._glider.at
            gap, turn = np.linalg.norm(start.p_wb - at.p_wb), np.linalg.norm(difference(start.q_wb, at.q_wb))
            if gap <= self._p.join_m and turn <= self._p.join_rad:
                self._start_ns = time_ns
        return self._start_ns is not None

    def _wish(self, time_ns: int) -> Wish:
        """Returns the glider's goal in this mode."""
        p, at = self._p, self._glider.at
        if self.mode == Mode.AUTO and self._trajectory is not None:
            start = self._trajectory.sample(0.0)
            return Wish(ZERO, ZERO, start.p_wb, start.q_wb)
        if self.mode == Mode.GUIDED:
            return self._guided(time_ns)
        if self.mode == Mode.SURFACE:
            if at.p_wb[2] > self._surface_m:
                return Wish(np.array([0.0, 0.0, -p.surface_speed_m_s]), ZERO, None, heading(at.q_wb))
            return Wish(ZERO, ZERO, np.array([math.nan, math.nan, self._surface_m]), heading(at.q_wb))
        if self.mode in (Mode.AUTO, Mode.DOCK):
            return self._docking if isinstance(self._docking, Wish) else REST
        sticks = self._read_sticks(time_ns)
        rate = p.rate_rad_s * np.array(sticks.moment)
        if any(sticks.force) or any(sticks.moment):
            self._goal = None
        if self.mode == Mode.ALT_HOLD:
            turn = self._goal or REST
            return turn._replace(v_w=np.array([0.0, 0.0, p.speed_m_s * sticks.force[2]]), w_b=rate, p_wb=None)
        if self._goal is not None:
            return self._goal
        v_w = np.asarray(rotate(at.q_wb, p.speed_m_s * np.array(sticks.force)))
        return Wish(self._velocity_in_fence(at.p_wb, v_w), rate)

    def _stopped_before_others(self, wish: Wish, health: Health) -> Wish:
        """Returns the wish, or rest where it leads to another body in too short a time; keeps the motion that was wanted."""
        if self.mode not in FREE or self._least_s == 0.0:
            return wish
        self.wanted = np.concatenate((wish.v_w, wish.w_b))
        if wish.p_wb is not None or wish.q_wb is not None:
            self.wanted += self._motion_to(wish)
        return REST if health.collision_s < self._least_s else wish

    def _motion_to(self, wish: Wish) -> np.ndarray:
        """Returns the mean velocity, world, m/s, and turning rate, body, rad/s, (6,), of the way to the pose of a wish."""
        at, p = self._glider.at, self._p
        way = ZERO if wish.p_wb is None else np.where(np.isnan(wish.p_wb), 0.0, wish.p_wb - at.p_wb)
        turn = ZERO if wish.q_wb is None else difference(wish.q_wb, at.q_wb)
        way_m, turn_rad = math.hypot(*way.tolist()), math.hypot(*turn.tolist())
        rate_rad_s = p.rate_rad_s if wish.rate_rad_s is None else wish.rate_rad_s
        fastest = np.array([min(p.speed_m_s, way_m / self._least_s), min(rate_rad_s, turn_rad / self._least_s)])
        # least time to a pose, so that the fail-safe `collision` permits one just before another body
        arrival_s = self._least_s + float(braking_s(fastest, self.deceleration, p.bandwidth))
        return np.concatenate((way / max(arrival_s, way_m / p.speed_m_s), turn / max(arrival_s, turn_rad / rate_rad_s)))

    def _guided(self, time_ns: int) -> Wish:
        """Returns the newest streamed set-point, extrapolated by its own speed; it stops after `guided_timeout_s` without a newer one."""
        if self._point is None:
            return REST
        came_ns, point = self._point
        age_s = (time_ns - came_ns) * 1e-9
        v_w, w_b = (np.where(np.isnan(value), 0.0, value) for value in (point.v_w, point.w_b))
        q_wb = None if np.isnan(point.q_wb).any() else point.q_wb
        moved = v_w * min(age_s, self._p.guided_timeout_s)
        if age_s > self._p.guided_timeout_s:
            v_w, w_b = ZERO, ZERO
        return Wish(self._velocity_in_fence(self._glider.at.p_wb, v_w), w_b, self._inside(point.p_wb + moved), q_wb)

    def _is_elsewhere(self, setpoint: Setpoint, estimate: Estimate) -> bool:
        """Whether a body that surfaces is not placed, or was carried away, or its camera was: it goes up from where it is."""
        return self._was_unplaced or bool(np.linalg.norm(setpoint.p_wb[:2] - estimate.p_wb[:2]) > NEAR_M)

    def _follow_body(self, setpoint: Setpoint, estimate: Estimate) -> Setpoint:
        """Moves the set-point along with the body where its pose is not held: horizontally, in position, or in attitude too."""
        force, moment = CONTROLLED[self.mode]
        p_wb = estimate.p_wb.copy()
        if force != Keep.NOTHING:
            p_wb[2] = setpoint.p_wb[2]
        moved = setpoint._replace(p_wb=p_wb, q_wb=estimate.q_wb if moment == Keep.NOTHING else setpoint.q_wb)
        self._glider.put(moved)
        return moved

    def _read_sticks(self, time_ns: int) -> Sticks:
        """Returns the sticks: all neutral when stale, and each axis neutral within its deadband."""
        if time_ns - self._sticks_ns > self._p.stick_timeout_s * 1e9:
            return Sticks()
        dead = self._p.stick_dead
        force, moment = ((0.0 if abs(v) <= dead else v for v in group) for group in self._sticks)
        return Sticks(tuple(force), tuple(moment))  # type: ignore[arg-type]

    def _inside(self, p_wb: np.ndarray) -> np.ndarray:
        """Returns the position, or the nearest one inside the fence."""
        f = self._fence
        low = np.array([-f.north_m, -f.east_m, f.top_m])
        return np.asarray(np.clip(p_wb, low, np.array([f.north_m, f.east_m, f.bottom_m])))

    def _velocity_in_fence(self, p_wb: np.ndarray, v_w: np.ndarray) -> np.ndarray:
        """Returns the velocity without the components that would lead out of the fence, or farther out, within a second."""
        soon = p_wb + v_w
        return np.where(np.abs(self._inside(soon) - soon) > np.abs(self._inside(p_wb) - p_wb), 0.0, v_w)

    def _placed(self, health: Health) -> bool:
        """Whether tags tell the position, or did lately and nothing pushes the body out of sight: the believed position would run away, and
        a body that surfaces swim after it (the fail-safe `pushed` lets go in other modes).
        """
        return health.ready and health.tag_age_s <= self._no_place_s and health.unseen_push_m_s <= self._most_push_m_s

    # ------------------------------------------------------------ the wrench

    def mix(self, wrench: np.ndarray, time_ns: int, estimate: Estimate, health: Health) -> np.ndarray:
        """Returns the wrench of the mode from that of the controller, (6,), body frame; blends over from the last mode within `blend_s`."""
        out = self._by_mode(wrench, time_ns, estimate, health)
        if self._blend:
            self._offset, self._offset_ns, self._blend = self._wrench - out, time_ns, False
        left = 1.0 - (time_ns - self._offset_ns) * 1e-9 / max(self._p.blend_s, 1e-9)
        if left > 0.0:
            out = out + left * self._offset
        self._wrench = out
        return np.asarray(out)

    def _by_mode(self, wrench: np.ndarray, time_ns: int, estimate: Estimate, health: Health) -> np.ndarray:
        """Returns the wrench (6,) of the mode: what the controller commands in it (CONTROLLED), and the sticks for the rest."""
        if self.mode == Mode.SURFACE:
            return self._surfacing(wrench, estimate, health)
        force, moment = CONTROLLED[self.mode]
        out = wrench.copy()
        if (force, moment) == (Keep.ALL, Keep.ALL):
            return out
        sticks = self._read_sticks(time_ns)
        wanted = self._full_stick * np.array([*sticks.force, *sticks.moment])
        if moment == Keep.NOTHING:
            out[3:] = wanted[3:]
        if force == Keep.NOTHING:
            out[:3] = wanted[:3]
        elif force == Keep.VERTICAL:
            level_w = np.asarray(rotate(heading(estimate.q_wb), np.r_[wanted[:2], 0.0]))
            out[:3] = rotate_back(estimate.q_wb, np.r_[level_w[:2], rotate(estimate.q_wb, wrench[:3].copy())[2]])
        return np.asarray(out)

    def _surfacing(self, wrench: np.ndarray, estimate: Estimate, health: Health) -> np.ndarray:
        """Wrench of SURFACE: upward by the controller, or by a constant force if depth is unknown; horizontal only if position is known.

        At the surface it lifts with at least LEAST_LIFT, and below it pushes down with no more: the believed depth may be wrong.
        """
        if not health.ready:
            return np.asarray(np.r_[0.0, 0.0, -self._lift_n, 0.0, 0.0, 0.0])
        out = wrench.copy()
        force_w = np.asarray(rotate(estimate.q_wb, wrench[:3].copy()))
        if not self._placed(health):
            force_w[:2] = 0.0
        is_up = estimate.p_wb[2] <= self._surface_m + SURFACE_MARGIN_M
        if health.depth_unknown_s > self._no_depth_s:
            force_w[2] = -self._lift_n
        else:
            force_w[2] = min(force_w[2], (-LEAST_LIFT if is_up else LEAST_LIFT) * self._lift_n)
        out[:3] = rotate_back(estimate.q_wb, force_w)
        return np.asarray(out)
