"""Stage 7 of a tick: from a wrench to the force of each thruster (paper, Eq. 5), within limits.

The pseudo-inverse (plus the preload) is the answer where it stays within limits. Otherwise a box-constrained least-squares problem
(box_program) keeps the directions of force and moment and reduces their size: first the force beyond what holds a position, then the
holding force and the moment, whichever costs less. A body whose supplies cannot feed the answer gives way in the same order. A robot that
lacks moment therefore leans into its righting moment and stays where it is, instead of keeping level and drifting away.
Mode `least_power` then moves an answer that is within limits to where the thrusters draw the least power.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from firmware_py.core.body import Body
from firmware_py.core.box_program import nearest
from firmware_py.core.least_power import LeastPower
from firmware_py.core.preload import preload
from firmware_py.core.rotations import M, V
from firmware_py.core.thruster import module_power
from firmware_py.core.types import Thrust, ThrustLimits
from firmware_py.description.parameters import Allocation

HOLDING_SHARE = 0.05
"""Holding force, which has the same priority as the moment, as a share of what all thrusters together could push. For a module it is 4 N,
enough against buoyancy, current and the drag of a slow path."""
PRIORITIES = np.array([1e2, 1e2, 1.0])
"""Relative cost of a lost share of the holding force, of the moment and of the rest of the force."""
SHARE_WEIGHT = 1e3
"""Cost of losing the rest of the force, against all thrusters at their limits: high enough that feasible force is not given away."""
BEYOND = 2.0
"""A wrench above this many times what all thrusters together could give is scaled down first, so that the problem stays well scaled."""
HALVINGS = 8
"""Bisection steps for the share that the supplies can feed; they find it to 0.4 % of the wrench, or of BEYOND times what all
thrusters together could give where that is less."""
TINY = 1e-9
"""Force or moment, N and N m, below which it counts as zero."""
MAX_RESIDUAL = 1e-3
"""Largest accepted residual of the directions of force and moment, N and N m; a hundred thousand times the usual one."""


@njit(f"float64({V},{V},{V})", cache=True)
def busiest(force, f_min, f_max):  # type: ignore[no-untyped-def]
    """Returns the share of its range that the busiest thruster uses."""
    most = 0.0
    for i in range(force.shape[0]):
        most = max(most, force[i] / (f_max[i] if force[i] > 0.0 else f_min[i]))
    return most


@njit(f"boolean({V},{V},{V})", cache=True)
def are_within(force, f_min, f_max):  # type: ignore[no-untyped-def]
    """Whether every force is within its limits; a NaN is not."""
    return bool(np.all((force >= f_min) & (force <= f_max)))


@njit(f"boolean({V},{M},{M},int64[::1],{V})", cache=True)
def are_fed(force, power_forward, power_reverse, module, supply):  # type: ignore[no-untyped-def]
    """Whether the (m,) supplies, W, are enough for the forces; a power that is NaN counts as fed."""
    return not np.any(module_power(force, power_forward, power_reverse, module, supply.size) > supply)


def _sizes(wrench: np.ndarray) -> np.ndarray:
    """(2,) magnitudes of force and moment."""
    return np.asarray(np.linalg.norm(wrench.reshape(2, 3), axis=1))


def _kept(made: np.ndarray, wanted: np.ndarray) -> tuple[float, float]:
    """Returns the shares of force and moment that are kept; 1 for one that was not asked for."""
    force, moment = (float(m / w) if w > TINY else 1.0 for m, w in zip(_sizes(made), _sizes(wanted), strict=True))
    return force, moment


class Allocator:
    """Allocates for one body, within its thrusters' nominal limits until `confine` sets others."""

    def __init__(self, body: Body, parameters: Allocation) -> None:
        self.parameters = parameters
        self._clip_only = parameters.mode == "pseudo_inverse"
        self._thrusters = body.thrusters
        n = body.thrusters.f_max.size
        reach = np.maximum(body.thrusters.f_max, -body.thrusters.f_min)
        self._weights = np.r_[np.ones(n), SHARE_WEIGHT * float(np.sum(reach**2)) * PRIORITIES]
        self._most = np.array([np.linalg.norm(body.thrusters.matrix[rows], axis=0) @ reach for rows in (slice(0, 3), slice(3, 6))])
        self._smallest_n = 0.0 if self._clip_only else parameters.preload_n
        self._preloaded: tuple[np.ndarray, np.ndarray] | None = None
        """Usable thrusters (n,) and preload (n,), N, of the last call of `preload`, which computes only what has changed since."""
        self._limits = ThrustLimits(body.thrusters.f_min, body.thrusters.f_max, np.full(len(body.modules), np.inf))
        self._set(np.ones(n, dtype=bool), body.thrusters.pinv)

    def set_alive(self, alive: np.ndarray) -> None:
        """Sets the thrusters that may be used from now on, (n,) bool."""
        self._set(alive, np.linalg.pinv(self._thrusters.matrix * alive) * alive[:, None])  # exact zeros for unusable thrusters

    def confine(self, limits: ThrustLimits) -> None:
        """Limits the forces to `limits` from now on."""
        if limits is not self._limits:
            self._limits = limits
            self._set_limits()

    def _set(self, alive: np.ndarray, pinv: np.ndarray) -> None:
        t = self._thrusters
        self._matrix = np.ascontiguousarray(t.matrix * alive)
        self._pinv = np.ascontiguousarray(pinv)
        self._alive = alive
        self._preload = preload(t, alive, self._smallest_n, self._preloaded)
        self._preloaded = (alive.copy(), self._preload)
        self._rows = np.vstack([self._matrix.T, np.zeros((3, 6))])
        self._goal = np.r_[self._preload, np.ones(3)]
        self._least_power = LeastPower(t, alive) if self.parameters.mode == "least_power" else None
        self._set_limits()

    def _set_limits(self) -> None:
        self._f_min, self._f_max = self._limits.low_n * self._alive, self._limits.high_n * self._alive
        self._low, self._high = np.concatenate((self._f_min, np.zeros(3))), np.concatenate((self._f_max, np.ones(3)))
        if self._least_power:
            self._least_power.confine(self._f_min, self._f_max)

    def step(self, wrench: np.ndarray) -> Thrust:
        """Returns the thruster forces for a wanted (6,) wrench, body frame."""
        thrust = self._within(wrench)
        if self._least_power and thrust.scale == (1.0, 1.0):
            thrust = self._thrust(self._least_power.step(thrust.force_n), thrust.scale)
        return thrust if self._clip_only or self._is_fed(thrust) else self._fed(wrench, thrust)

    def _fed(self, wrench: np.ndarray, unfed: Thrust) -> Thrust:
        """Returns the forces that the supplies can feed. Where they cannot feed even the preload, returns `unfed`, which the limiter then
        scales down module by module.
        """
        holding, moment, rest = self._parts(wrench)
        for part, beside in ((rest, holding + moment), (holding + moment, np.zeros(6))):
            if not part.any():
                continue
            asked, thrust = self._largest_share(part, beside)
            if self._is_fed(thrust):
                return thrust._replace(scale=_kept(asked * np.repeat(thrust.scale, 3), wrench))
        return unfed

    def _parts(self, wrench: np.ndarray) -> np.ndarray:
        """Splits `wrench` into (3, 6): holding force, moment, rest of the force."""
        held = min(1.0, HOLDING_SHARE * self._most[0] / max(_sizes(wrench)[0], TINY))
        parts = np.zeros((3, 6))
        parts[0, :3], parts[1, 3:], parts[2, :3] = held * wrench[:3], wrench[3:], (1.0 - held) * wrench[:3]
        return parts

    def _is_fed(self, thrust: Thrust) -> bool:
        """Whether every module's supply is enough. Forces that are NaN pass; the limiter handles them."""
        t = self._thrusters
        return bool(are_fed(thrust.force_n, t.power_forward, t.power_reverse, t.module, self._limits.supply_w))

    def _largest_share(self, wrench: np.ndarray, beside: np.ndarray) -> tuple[np.ndarray, Thrust]:
        """Finds the largest share of `wrench` that the supplies can feed together with all of `beside`. The search begins at one that is
        not far too large: of the 4000 N that a body wants far off its place, even the smallest step would be more than they can feed.

        Returns that sum of the two and its forces; `beside` alone where no share can be fed.
        """
        share, step, found = 0.0, self._prescale(wrench), self._within(beside)
        for _ in range(HALVINGS):
            step *= 0.5
            thrust = self._within(beside + (share + step) * wrench)
            if self._is_fed(thrust):
                share, found = share + step, thrust
        return beside + share * wrench, found

    def _within(self, wrench: np.ndarray) -> Thrust:
        """Returns forces within the thrusters' limits."""
        force = self._preload + self._pinv.dot(wrench)
        if are_within(force, self._f_min, self._f_max):
            return self._thrust(force, (1.0, 1.0))
        if self._clip_only:
            return self._thrust(np.clip(force, self._f_min, self._f_max), (1.0, 1.0))
        return self._saturated(wrench)

    def _thrust(self, force: np.ndarray, kept: tuple[float, float]) -> Thrust:
        return Thrust(force, self._matrix.dot(force), kept, 1.0 - busiest(force, self._limits.low_n, self._limits.high_n))

    def _saturated(self, wrench: np.ndarray) -> Thrust:
        """Solves min |f - f_preload|^2 + sum_i w_i (1 - s_i)^2 subject to J f = sum_i s_i W_i, f within limits, 0 <= s_i <= 1.

        W_i are the `_parts` of the wrench, each scaled down first if it is far too large (`_prescale`).
        """
        parts = self._parts(wrench)
        prescale = np.array([self._prescale(part) for part in parts])
        self._rows[-3:] = -parts * prescale[:, None]
        x = np.empty_like(self._goal)
        if not nearest(self._rows, self._weights, self._goal, self._low, self._high, x) <= MAX_RESIDUAL:
            share = self._common_share(wrench)
            return self._thrust(self._pinv @ wrench * share, (share, share))
        return self._thrust(x[:-3].copy(), _kept((x[-3:] * prescale) @ parts, wrench))

    def _prescale(self, wrench: np.ndarray) -> float:
        """Factor, at most 1, that scales down a wrench above BEYOND times what the thrusters could give."""
        return float(np.min(BEYOND * self._most / np.maximum(_sizes(wrench), TINY), initial=1.0))

    def _common_share(self, wrench: np.ndarray) -> float:
        """Returns the largest share of the pseudo-inverse's answer that is within limits."""
        force = self._pinv @ wrench
        limit = np.where(force > 0, self._f_max, -self._f_min)
        return float(1.0 / max(1.0, np.max(np.abs(force) / np.maximum(limit, 1e-9))))
