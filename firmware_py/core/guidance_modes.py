"""Stage 5 of a tick: turns set-points, trajectories and sticks into the set-point of each mode, and mixes the controller's wrench with the
sticks.

Mode changes are free of jumps: the set-point continues from where it is, and the wrench is blended over within `blend_s`.
"""

from __future__ import annotations

import math

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.collision import braking_s
from firmware_py.core.failsafes import FREE, Level
from firmware_py.core.fence import nearest_inside, velocity_within
from firmware_py.core.health import Health
from firmware_py.core.mode_wrench import CONTROLLED, Blend, Keep, mode_wrench
from firmware_py.core.rotations import difference, heading, rotate
from firmware_py.core.setpoint import REST, Glider, Wish, ahead_of, at_estimate, on_leash, rest_at, way_to_rest_s
from firmware_py.core.supervisor import TAKES_OVER, Decision
from firmware_py.core.surfacing import Surfacing
from firmware_py.core.trajectory_tracking import Tracking
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
COME_M = 0.005
"""Distance from the meeting point within which the set-point of a body that moves to meet another counts as arrived."""


class Guidance:
    """Stores what was requested, and makes the set-point of each tick from it."""

    def __init__(self, body: Body, parameters: Parameters) -> None:
        self._body = body
        self.deceleration = body.deceleration
        """(2,) that of the thrusters that are used, as Body.deceleration."""
        self._glider = Glider(0.0, 0.0, 0.0)
        self._surfacing = Surfacing(body, parameters)
        self._blend = Blend()
        self.retune(parameters)
        self._tracking: Tracking | None = None
        """AUTO's trajectory."""
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
        self._least_s = f.collision_limit if f.collision_action >= Level.HOLD else 0.0
        self._full_stick = p.stick_share * self._body.thrusters.full_wrench
        self._surfacing.retune(parameters)
        self._blend.blend_s = p.blend_s
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
                self._goal = Wish(ZERO, ZERO, nearest_inside(argument.p_wb, self._fence), argument.q_wb)
            elif effect == Effect.FOLLOW:
                self._tracking = Tracking(argument)

    def _level(self) -> None:
        """Sets a goal to turn upright in place if the set-point is tilted more than a hold may keep."""
        at = self._glider.at
        if rotate(at.q_wb, DOWN)[2] < math.cos(self._p.hold_tilt_rad):
            self._goal = Wish(ZERO, ZERO, nearest_inside(at.p_wb, self._fence), heading(at.q_wb), self._p.level_rad_s)

    def rest(self, estimate: Estimate) -> None:
        """Puts the set-point at rest at the estimated pose, for a body that is disarmed."""
        self._glider.put(rest_at(estimate.p_wb, estimate.q_wb))
        self._tracking = self._goal = self._docking = None
        self._blend.begin(np.zeros(6))

    def take_over(
        self, mode: Mode, estimate: Estimate, wrench: np.ndarray, q_wb: np.ndarray, before: Guidance | None = None
    ) -> None:
        """Starts in `mode` at the pose of a new body, from the wrench (6,) that its thrusters give, and turns back to `q_wb`, the attitude
        that the previous body was to hold, if that is near: otherwise bodies that dock and part again and again would lean over. `before`,
        the guidance of the body that had its number, hands over its stick input, so that the pilot keeps control.
        """
        self._glider.put(at_estimate(estimate))
        self.mode = mode
        self._blend.begin(wrench)
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
        self._goal = goal._replace(p_wb=nearest_inside(goal.p_wb + by_w, self._fence))

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
        self._tracking = self._goal = self._docking = None
        if self._point is not None and time_ns - self._point[0] > self._p.guided_timeout_s * 1e9:
            self._point = None
        self.mode = mode
        self._blend.begin()

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
            if self._tracking is not None:
                self._tracking.delay(round(dt_s * 1e9))
            dt_s = 0.0
        tracking, at, p = self._tracking, self._glider.at, self._p
        if self.mode == Mode.AUTO and tracking is not None and tracking.runs(time_ns, at, p.join_m, p.join_rad):
            sampled = tracking.sample(time_ns, self._lead_s)
            if sampled is not None:
                self._glider.put(sampled[0])
                self.wanted = np.concatenate((sampled[0].v_w, sampled[0].w_b))
                return sampled
            self._tracking = None  # it has a gap: the body stops before it
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
        was_unplaced = self._was_unplaced  # when tags return, it follows for one more tick
        self._was_unplaced = not self._surfacing.is_placed(health)
        if CONTROLLED[self.mode].force != Keep.ALL or (self.mode == Mode.SURFACE and (was_unplaced or self._is_elsewhere(now, estimate))):
            now = self._follow_body(now, estimate)
        return now, ahead_of(now, self._lead_s)

    def _wish(self, time_ns: int) -> Wish:
        """Returns the glider's goal in this mode."""
        p, at = self._p, self._glider.at
        if self.mode == Mode.AUTO and self._tracking is not None:
            return self._tracking.wish
        if self.mode == Mode.GUIDED:
            return self._guided(time_ns)
        if self.mode == Mode.SURFACE:
            return self._surfacing.wish(at)
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
        return Wish(velocity_within(at.p_wb, v_w, self._fence), rate)

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
        return Wish(velocity_within(self._glider.at.p_wb, v_w, self._fence), w_b, nearest_inside(point.p_wb + moved, self._fence), q_wb)

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

    # ------------------------------------------------------------ the wrench

    def mix(self, wrench: np.ndarray, time_ns: int, estimate: Estimate, health: Health) -> np.ndarray:
        """Returns the wrench of the mode from that of the controller, (6,), body frame; blends over from the last mode within `blend_s`."""
        if self.mode == Mode.SURFACE:
            out = self._surfacing.wrench(wrench, estimate, health)
        elif CONTROLLED[self.mode] == CONTROLLED[Mode.POSHOLD]:
            out = wrench.copy()
        else:
            sticks = self._read_sticks(time_ns)
            of_sticks = self._full_stick * np.array([*sticks.force, *sticks.moment])
            out = mode_wrench(self.mode, wrench, of_sticks, estimate.q_wb)
        return self._blend.over(out, time_ns)
