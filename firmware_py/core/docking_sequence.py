"""Docking as a sequence of stages, a table: what each stage does, what ends it, and which stage follows.

The active body is steered relative to the target's estimated pose and so follows a target that drifts. The gap is the distance between
the two faces; lateral and angle error are those of the active module relative to its place before the target's face. The paper's
method, `approach = "straight"`, begins with the approach, on a line that is drawn once; its gap is the remaining length of that line.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.docking_detector import PairStatus
from firmware_py.core.docking_plan import DockPlan, module_in, pose_of
from firmware_py.core.rotations import conjugate, difference, exp, multiply, normalise, rotate, rotate_back
from firmware_py.core.setpoint import REST, Wish
from firmware_py.core.types import RELAY_OFF, RELAY_PULL, RELAY_PUSH, Estimate, Setpoint
from firmware_py.description.parameters import Docking

SLOWING_PER_S = 0.5
"""Approach speed per remaining gap, within contact_speed_m_s and speed_m_s: the approach slows down in proportion to the gap."""
TURN_RAD = 0.03
"""Angle by which the active module is turned about the docking axis after a jam, in alternating directions."""
RETREAT_M_S = 0.04
"""Rate at which the gap grows when backing off."""
SURE_NS = 1_000_000_000
"""How long a dock waits at its beginning for pictures that tell the places of both bodies well enough; an undock spoils them for 0.3 s."""
CONE = 1.5
"""The approach waits while the lateral or the angle error exceeds this multiple of its alignment limit."""


class Stage(IntEnum):
    """Stages: first those of a successful dock, in order, then the others."""

    PRE_APPROACH = 0
    ALIGN = 1
    APPROACH = 2
    PUSH = 3
    VERIFY = 4
    DOCKED = 5
    RELEASE = 6
    BACK_OFF = 7
    ABORTED = 8
    FAILED = 9


class Row(NamedTuple):
    """What a stage does."""

    relay: int
    """Relay state of the magnets of both faces."""
    limit_s: str = ""
    """Name of the field of `Docking` that holds the timeout; empty: none."""
    on_timeout: Stage = Stage.ABORTED
    """The stage that follows when the limit has passed."""
    on_done: Stage | None = None
    """The stage that follows on completion (`_is_done`); None: only a dock, the limit or an abort ends the stage."""


TABLE = {
    Stage.PRE_APPROACH: Row(RELAY_OFF, "timeout_s", on_done=Stage.ALIGN),
    Stage.ALIGN: Row(RELAY_OFF, "timeout_s", on_done=Stage.APPROACH),
    Stage.APPROACH: Row(RELAY_PULL, "timeout_s", Stage.RELEASE, on_done=Stage.PUSH),
    Stage.PUSH: Row(RELAY_PULL, "push_s", Stage.RELEASE, on_done=Stage.VERIFY),
    Stage.VERIFY: Row(RELAY_PULL, "push_s", Stage.RELEASE),
    Stage.DOCKED: Row(RELAY_PULL),
    Stage.RELEASE: Row(RELAY_PUSH, "release_s", Stage.BACK_OFF),
    Stage.BACK_OFF: Row(RELAY_OFF, "timeout_s", on_done=Stage.ALIGN),
    Stage.ABORTED: Row(RELAY_OFF),
    Stage.FAILED: Row(RELAY_OFF),
}
ENDED = frozenset({Stage.DOCKED, Stage.ABORTED, Stage.FAILED})
TURNED = frozenset({Stage.APPROACH, Stage.PUSH, Stage.VERIFY, Stage.ALIGN})
"""Stages that apply the small turn after a jam."""


class Errors(NamedTuple):
    """Pose errors of the active module relative to its docked place."""

    gap_m: float
    lateral_m: float
    angle_rad: float


class SequenceOutputs(NamedTuple):
    """Outputs of the sequence in one tick."""

    active: Setpoint | Wish
    """Set-point of the active body in this tick; while it is still far away, the wish that it glides by."""
    relay: int
    is_apart: bool
    """Whether the wanted gap is back at the stand-off, where a failed dock leaves the active body."""
    meets: np.ndarray | None
    """(3,) displacement of the target to meet the active body, world, m; given once, when the sequence sets off, else None."""


class DockingSequence:
    """One dock of one active body to one target body."""

    def __init__(self, plan: DockPlan, active: Body, target: Body, parameters: Docking, time_ns: int, target_approaches: bool) -> None:
        """`target_approaches`: the target is free to come half the way."""
        self.plan = plan
        self._target_approaches = target_approaches
        self._p = parameters
        self._r_a, self._q_a = module_in(active, plan.request.module)
        self._r_t, self._q_t = module_in(target, plan.request.target_module)
        self._line_t, self._farthest_m = plan.axis_t, parameters.standoff_m
        self._fixed: Estimate | None = None
        """Target estimate, at rest at the meeting place, for a straight approach, which does not look at the target again."""
        self._under_way = False
        self.meets_at_w: np.ndarray | None = None
        """(3,) place to which the target's centre of mass was told to come, world, m; None: it was not told to come."""
        self.makes_room = False
        """Whether the last tick's `waits` led to a place, to make room for other bodies."""
        self.stage = Stage.PRE_APPROACH
        self.tries = 1
        self.reason = ""
        self._entered_ns, self._waited_ns = time_ns, 0
        """Start of the stage, and time in it spent waiting for other bodies: this has a limit of its own, timeout_s, and is no jam."""
        self._good_since_ns: int | None = None
        self._gap_m = self._farthest_m
        self._last_ns = time_ns
        self._turn = 0.0

    def step(self, time_ns: int, active: Estimate, target: Estimate, status: PairStatus, waits: Wish | None = None) -> SequenceOutputs:
        """Advances the sequence by one tick. `waits`: given while another body blocks the way; the active body glides by it instead until
        it stands before the target's face. If it leads to a place, to make room, the body also retreats from before the face. At its
        beginning, the body rests while the places of both are not known well enough.
        """
        unsure = self.stage == Stage.PRE_APPROACH and self._sigma_m(active, target) > self._p.sigma_m
        delays = unsure or (waits is not None and self._p.approach == "straight")  # its line is drawn once, to where the target will be
        waits = REST if waits is None and unsure else waits
        meets = None if self._under_way or delays else self._set_off(active, target)
        errors = self.errors(active, target)
        passed_ns, self._last_ns = time_ns - self._last_ns, time_ns
        if waits is not None:
            self._waited_ns += passed_ns
        self._decide(time_ns, active, target, errors, status, waits is not None)
        self.makes_room = waits is not None and waits.p_wb is not None
        if self.makes_room and self.stage == Stage.APPROACH and self._p.approach == "staged":
            self._enter(Stage.PRE_APPROACH, time_ns)
        speed = self._speed(errors, waits is not None)
        self._gap_m = float(np.clip(self._gap_m + speed * (passed_ns * 1e-9), -self._p.push_m, self._farthest_m))
        setpoint = self._setpoint(self.target_to_meet(target), speed, waits)
        is_apart = self._gap_m >= self._p.standoff_m
        return SequenceOutputs(setpoint, TABLE[self.stage].relay, is_apart, None if self.stage in ENDED else meets)

    def abort(self, time_ns: int, reason: str) -> None:
        """Aborts the dock; both bodies hold apart."""
        self.reason = reason
        self._enter(Stage.ABORTED, time_ns)

    def target_to_meet(self, target: Estimate) -> Estimate:
        """The target estimate to steer for: the current one, or the fixed one of a straight approach."""
        return target if self._fixed is None else self._fixed

    def errors(self, active: Estimate, target: Estimate) -> Errors:
        """Errors computed from the two estimates."""
        _, q_a = pose_of(active, self._r_a, self._q_a)
        _, q_t = pose_of(target, self._r_t, self._q_t)
        off = self._offset(active, target)
        gap = float(off @ self.plan.axis_t)
        lateral = float(np.linalg.norm(off - gap * self.plan.axis_t))
        angle = difference(q_a, multiply(q_t, self._q_wanted()))
        return Errors(gap, lateral, float(np.linalg.norm(angle)))

    def _offset(self, active: Estimate, target: Estimate) -> np.ndarray:
        """(3,) offset of the active module from its docked place, target module frame, m."""
        p_a, _ = pose_of(active, self._r_a, self._q_a)
        p_t, q_t = pose_of(target, self._r_t, self._q_t)
        return np.asarray(rotate_back(q_t, p_a - p_t) - self.plan.place_t)

    def _set_off(self, active: Estimate, target: Estimate) -> np.ndarray | None:
        """Shares the way with the target if it comes, and draws the line of a straight approach. Returns the target's displacement."""
        self._under_way = True
        straight = self._p.approach == "straight"
        off, (_, q_t) = self._offset(active, target), pose_of(target, self._r_t, self._q_t)
        left = 0.0 if straight else self._p.standoff_m
        meets = np.asarray(0.5 * rotate(q_t, off - left * self.plan.axis_t)) if self._target_approaches else None
        self.meets_at_w = None if meets is None else target.p_wb + meets
        if straight:
            self._fixed = target._replace(p_wb=target.p_wb + (0.0 if meets is None else meets), nu=np.zeros(6))
            off = self._offset(active, self._fixed)
            self._gap_m = float(np.linalg.norm(off))
            self._line_t = off / self._gap_m if self._gap_m > 0.0 else self.plan.axis_t
            self._farthest_m = max(self._gap_m, self._p.standoff_m)
            self._enter(Stage.APPROACH, self._entered_ns + self._waited_ns)
        return meets

    # ------------------------------------------------------------ transitions

    def _decide(self, time_ns: int, active: Estimate, target: Estimate, errors: Errors, status: PairStatus, waits: bool) -> None:
        """Enters the stage that follows if the faces are docked, an estimate is too uncertain, a limit has passed, or the stage is done."""
        if self.stage in ENDED:
            return
        if status.docked and TABLE[self.stage].relay == RELAY_PULL:  # while the magnets push, faces that are still near are not docked
            self._enter(Stage.DOCKED, time_ns)
            return
        sigma, placed = self._sigma_m(active, target), active.placed and target.placed
        if sigma > self._p.sigma_m and self.stage not in (Stage.RELEASE, Stage.BACK_OFF):
            if self.stage != Stage.PRE_APPROACH or not placed or time_ns - self._entered_ns > SURE_NS:
                known = f"relative sigma {sigma * 1e3:.1f} mm, {self._p.sigma_m * 1e3:.1f} permitted"
                self.abort(time_ns, known if placed else "no tag has told yet where one of the two bodies is")
            return
        row = TABLE[self.stage]
        if self._waited_ns > self._p.timeout_s * 1e9:
            self.abort(time_ns, f"{self._too_long}, waiting for another body")
        elif row.limit_s and time_ns - self._entered_ns - self._waited_ns > getattr(self._p, row.limit_s) * 1e9:
            self._time_out(time_ns, status)
        elif row.on_done is not None and not waits and self._is_done(time_ns, errors, status):
            self._enter(row.on_done, time_ns)  # not while it waits: it is still on its way then, even where it passes the end

    def _sigma_m(self, active: Estimate, target: Estimate) -> float:
        """Standard deviation of the place of one body relative to the other, m, along the worst axis."""
        return float(np.sqrt(np.max(active.sigma_p**2 + target.sigma_p**2)))

    def _is_done(self, time_ns: int, errors: Errors, status: PairStatus) -> bool:
        """Whether the stage has reached its aim. That of VERIFY is a dock, which `_decide` sees first; RELEASE lasts for its time."""
        p = self._p
        if self.stage == Stage.PRE_APPROACH:
            placed = abs(errors.gap_m - p.standoff_m) < 5 * p.align_m and errors.lateral_m < 5 * p.align_m
            return placed and errors.angle_rad < 5 * p.align_rad
        if self.stage == Stage.ALIGN:
            return self._good_for(p.align_s, errors.lateral_m < p.align_m and errors.angle_rad < p.align_rad, time_ns)
        if self.stage == Stage.APPROACH:
            return self._gap_m <= 0.0
        if self.stage == Stage.PUSH:
            return status.current or status.position
        if self.stage == Stage.BACK_OFF:
            return errors.gap_m > p.standoff_m - 5 * p.align_m
        return False

    def _good_for(self, seconds: float, good: bool, time_ns: int) -> bool:
        if not good:
            self._good_since_ns = None
            return False
        if self._good_since_ns is None:
            self._good_since_ns = time_ns
        return time_ns - self._good_since_ns >= seconds * 1e9

    @property
    def _too_long(self) -> str:
        return f"{self.stage.name} took longer than {self._p.timeout_s:.0f} s"

    def _time_out(self, time_ns: int, status: PairStatus) -> None:
        """Enters the stage after the limit, and notes why: a jam, tried again as often as permitted, or a stage that took too long."""
        if TABLE[self.stage].on_timeout == Stage.RELEASE:
            only = "current alone" if status.current else "position alone" if status.position else "neither condition"
            unseen = f", pictures of both are too few or older than {self._p.pose_fresh_ms:.0f} ms (DOCK_POSE_AGE)"
            self.reason = f"jam: {only} after {self.stage.name}{unseen if math.isnan(status.position_error_m) else ''}"
            if self.tries >= self._p.tries:
                self.reason += f", {self.tries} {'try' if self.tries == 1 else 'tries'}"
                self._enter(Stage.FAILED, time_ns)
                return
        elif self.stage != Stage.RELEASE:
            self.reason = self._too_long
        self._enter(TABLE[self.stage].on_timeout, time_ns)

    def _enter(self, stage: Stage, time_ns: int) -> None:
        if stage == Stage.RELEASE:
            self.tries += 1
            self._turn = TURN_RAD if self.tries % 2 == 0 else -TURN_RAD
        self.stage = stage
        self._entered_ns, self._waited_ns = time_ns, 0
        self._good_since_ns = None

    # ------------------------------------------------------------ set-point

    def _speed(self, errors: Errors, waits: bool) -> float:
        """Rate of change of the wanted gap, m/s."""
        p = self._p
        if self.stage == Stage.APPROACH:
            if self.makes_room and self._gap_m < self._farthest_m:
                return RETREAT_M_S
            astray = errors.lateral_m > CONE * p.align_m or errors.angle_rad > CONE * p.align_rad
            if waits or (astray and p.approach == "staged"):
                return 0.0
            return -float(np.clip(SLOWING_PER_S * self._gap_m, p.contact_speed_m_s, p.speed_m_s))
        if self.stage in (Stage.PUSH, Stage.VERIFY):
            return -p.contact_speed_m_s if self._gap_m > -p.push_m else 0.0
        if TABLE[self.stage].relay == RELAY_OFF:
            return RETREAT_M_S if self._gap_m < p.standoff_m else 0.0
        return 0.0

    def _setpoint(self, target: Estimate, speed: float, waits: Wish | None) -> Setpoint | Wish:
        """Set-point of the active body that keeps its module at the wanted gap before the target's face, moving with the target."""
        p_t, q_t = pose_of(target, self._r_t, self._q_t)
        q_module = normalise(multiply(q_t, self._q_wanted()))
        q_wb = normalise(multiply(q_module, conjugate(self._q_a)))
        axis_w = rotate(q_t, self._line_t if self._gap_m > 0.0 else self.plan.axis_t)
        p_module = p_t + rotate(q_t, self.plan.place_t) + axis_w * self._gap_m
        v_w = rotate(target.q_wb, target.nu[:3].copy()) + axis_w * speed
        p_wb, zero = np.asarray(p_module - rotate(q_wb, self._r_a)), np.zeros(3)
        if self.stage == Stage.PRE_APPROACH:
            return waits or Wish(np.asarray(v_w), zero, p_wb, q_wb)
        return Setpoint(p_wb, q_wb, v_w, zero, zero, zero)

    def _q_wanted(self) -> np.ndarray:
        """(4,) active module frame to target module frame, turned slightly about the axis after a jam."""
        if self._turn == 0.0 or self.stage not in TURNED:
            return self.plan.q_ta
        return np.asarray(multiply(exp(self.plan.axis_t * self._turn), self.plan.q_ta))
