"""Whether two faces are docked: both conditions of the paper, on fresh measurements alone.

Condition 1: the current of both magnets is beyond +-70 mA. Condition 2: the relative position is one lattice pitch and settled. A pose
is taken from tags of both modules seen in one picture, never from a state that was carried on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from firmware_py.core.rotations import V, multiply, rotate, rotate_back
from firmware_py.core.types import ModuleInputs
from firmware_py.description.parameters import Docking

NEVER_NS = -(1 << 60)
PICTURES = 16
"""Relative positions kept of each pair."""


class FacePair(NamedTuple):
    """Two faces that may meet. Indices of modules in the fleet; `offset_a` where the centre of b should be in the frame of a, m."""

    module_a: int
    face_a: int
    module_b: int
    face_b: int
    offset_a: np.ndarray


class PairStatus(NamedTuple):
    """What is known of one pair in this tick."""

    current: bool
    """Condition 1 holds, debounced."""
    position: bool
    """Condition 2 holds, debounced."""
    current_since_ns: int
    """Since when condition 1 has been as it is."""
    position_since_ns: int
    current_margin_ma: float
    """How far the weaker of the two currents is beyond the threshold; NaN before the first."""
    position_error_m: float
    """Distance of the mean relative position from one pitch; NaN without fresh pictures."""
    spread_m: float
    """Largest distance of a kept relative position's half from the other half: what `settled` is judged by."""
    docked: bool
    """Both hold."""
    fresh: bool
    """Both conditions rest on measurements that are young enough."""


class _Condition:
    """A truth that changes only after it has been seen long enough, and since when it is what it is."""

    __slots__ = ("_candidate_ns", "holds", "since_ns")

    def __init__(self) -> None:
        self.holds = False
        self.since_ns = NEVER_NS
        self._candidate_ns: int | None = None

    def see(self, seen: bool, time_ns: int, after_ns: int) -> None:
        """`seen` by a fresh measurement at `time_ns`; believed once nothing else was seen for `after_ns`."""
        if seen == self.holds:
            self._candidate_ns = None
            return
        if self._candidate_ns is None:
            self._candidate_ns = time_ns
        if time_ns - self._candidate_ns >= after_ns:
            self.holds, self.since_ns, self._candidate_ns = seen, time_ns, None

    def lose(self, time_ns: int) -> None:
        """No fresh measurement supports it any longer."""
        if self.holds:
            self.holds, self.since_ns = False, time_ns
        self._candidate_ns = None


class PairDetector:
    """Watches one pair of faces."""

    def __init__(self, pair: FacePair, parameters: Docking) -> None:
        self.pair = pair
        self._p = parameters
        self._current = _Condition()
        self._position = _Condition()
        self._ma = [math.nan, math.nan]
        self._ma_ns = [NEVER_NS, NEVER_NS]
        self._pictures = np.zeros((PICTURES, 3))
        self._count = 0
        self._picture_ns = NEVER_NS
        self._error_m = math.nan
        self._spread_m = math.nan

    def step(self, time_ns: int, modules: Sequence[ModuleInputs], poses: ModulePoses) -> PairStatus:
        """The pair's status in the tick at `time_ns`, from this tick's inputs alone and what they were before."""
        self._take_currents(time_ns, modules)
        self._take_pose(time_ns, poses)
        p = self._p
        fresh_current = time_ns - min(self._ma_ns) <= p.current_fresh_ms * 1e6
        fresh_pose = time_ns - self._picture_ns <= p.pose_fresh_ms * 1e6
        if not fresh_current:
            self._current.lose(time_ns)
        if not fresh_pose:
            self._position.lose(time_ns)
            self._count = 0
        weaker = min(abs(self._ma[0]), abs(self._ma[1]))
        return PairStatus(
            self._current.holds, self._position.holds, self._current.since_ns, self._position.since_ns,
            weaker - p.current_threshold_ma, self._error_m, self._spread_m,
            self._current.holds and self._position.holds, fresh_current and fresh_pose,
        )  # fmt: skip

    @property
    def currents_ma(self) -> tuple[float, float]:
        """Newest current of both faces; NaN before the first."""
        return self._ma[0], self._ma[1]

    def _take_currents(self, time_ns: int, modules: Sequence[ModuleInputs]) -> None:
        pair = self.pair
        fresh = False
        for side, (module, face) in enumerate(((pair.module_a, pair.face_a), (pair.module_b, pair.face_b))):
            value = modules[module].dock_current_ma[face]
            if value is not None:
                self._ma[side], self._ma_ns[side] = value, time_ns
                fresh = True
        if fresh:
            p = self._p
            threshold = p.current_threshold_ma - (p.current_hysteresis_ma if self._current.holds else 0.0)
            beyond = abs(self._ma[0]) > threshold and abs(self._ma[1]) > threshold  # False for NaN
            self._current.see(beyond, time_ns, round(p.debounce_ms * 1e6))

    def _take_pose(self, time_ns: int, poses: ModulePoses) -> None:
        relative = poses.relative(self.pair.module_a, self.pair.module_b)
        if relative is None:
            return
        capture_ns, position = relative
        self._pictures[self._count % PICTURES] = position
        self._count += 1
        self._picture_ns = capture_ns
        if self._count < PICTURES:
            return
        self._error_m, self._spread_m = _statistics(self._pictures, self._count % PICTURES, self.pair.offset_a)
        p = self._p
        slack = p.hysteresis_m if self._position.holds else 0.0
        near = self._error_m < p.position_tolerance_m + slack and self._spread_m < p.settled_m + slack
        self._position.see(near, time_ns, round(p.debounce_ms * 1e6))


@njit(f"UniTuple(float64,2)(float64[:,::1],int64,{V})", cache=True)
def _statistics(ring, oldest, wanted):  # type: ignore[no-untyped-def]
    """Distance of the mean from `wanted` (3,), and distance between the means of the older and the newer half."""
    n = ring.shape[0]
    older, newer = np.zeros(3), np.zeros(3)
    for i in range(n):
        row = ring[(oldest + i) % n]
        if i < n // 2:
            older += row
        else:
            newer += row
    older /= n // 2
    newer /= n - n // 2
    return np.linalg.norm(0.5 * (older + newer) - wanted), np.linalg.norm(newer - older)


class ModulePoses:
    """Poses of single modules by the pictures of this tick. Made anew each tick; only pairs that ask cost anything."""

    def __init__(self, modules: Sequence[ModuleInputs], tags: TagTable) -> None:
        self._modules = modules
        self._tags = tags

    def relative(self, a: int, b: int) -> tuple[int, np.ndarray] | None:
        """Newest picture that shows both modules: its time, and the centre of b in the frame of a (3,), m."""
        seen_a, seen_b = self._modules[a].tags, self._modules[b].tags
        if not seen_a or not seen_b:
            return None
        for first in reversed(seen_a):
            for second in reversed(seen_b):
                if first.capture_ns == second.capture_ns:
                    tag_a, tag_b = self._tags.get((a, first.tag_id)), self._tags.get((b, second.tag_id))
                    if tag_a is None or tag_b is None:
                        continue
                    return first.capture_ns, _relative(first.p_wt, first.q_wt, *tag_a, second.p_wt, second.q_wt, *tag_b)
        return None


TagTable = dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]
"""(module, tag id) -> tag centre (3,) in the module frame, and module frame to tag frame (4,)."""


@njit(f"{V}({V},{V},{V},{V},{V},{V},{V},{V})", cache=True)
def _relative(p_a, q_a, r_a, turn_a, p_b, q_b, r_b, turn_b):  # type: ignore[no-untyped-def]
    """(3,) centre of module b in the frame of module a, from one tag of each: pose in the world, place in its module, module to tag."""
    q_wa, q_wb = multiply(q_a, turn_a), multiply(q_b, turn_b)
    return r_a + rotate_back(q_wa, p_b - p_a - rotate(q_wb, r_b))
