"""Last stage of a tick: limits force, slew rate and arm state per thruster, and supply and magnets per module; then makes the commands.

Every thruster force passes through this file, whatever asked for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from firmware_py.core.body import Body
from firmware_py.core.rotations import V
from firmware_py.core.thruster import commands, module_power, polynomial, total_power
from firmware_py.core.types import FACES, RELAY_OFF, RELAY_PULL, RELAY_PUSH, ThrustLimits
from firmware_py.description.parameters import Limiter as LimiterParameters

VOLTAGE_EXPONENT = 1.2
"""Exponent of force over supply voltage at a fixed command: T200 at 16 V against 12 V, 5.25 / 3.71 kgf (t200_16v.csv, t200_12v.csv)."""
VOLTAGE_RANGE = (0.6, 1.4)
"""Valid range of a voltage reading, as a share of the nominal voltage; a reading outside is replaced by the nominal voltage."""
POWER_HALVINGS = 12
"""Bisection steps for the share of the forces that meets the supply limit."""
EASED_N_PER_S, EASED_S = 80.0, 0.2
"""Slew limit, N/s, while thrusters pass from one body's allocation to another's, and how long it applies, s."""


class Limiter:
    """Limits the thrusters of one body. Keeps the last forces for the slew limit."""

    def __init__(self, body: Body, parameters: LimiterParameters, dt_s: float) -> None:
        t = body.thrusters
        self._t, self._dt_s = t, dt_s
        self._eased, self._eased_ticks = 0, round(EASED_S / dt_s)
        self._supply = [float(watts) for watts in body.supply_power_w]
        self._of_module = [np.flatnonzero(t.module == m) for m in range(len(body.modules))]
        self._power = [(np.ascontiguousarray(t.power_forward[i]), np.ascontiguousarray(t.power_reverse[i])) for i in self._of_module]
        self._curves = (t.forward, t.reverse, t.deadband_n)
        self._all = np.ones(t.f_max.size, dtype=bool)
        self._nominal_v = body.nominal_v
        self._scale, self._scaled_for = np.ones(t.f_max.size), b""
        self._thrust_limits: ThrustLimits | None = None
        self._thrust_limits_for: tuple[object, ...] = ()
        self.magnets = [MagnetLimiter(parameters, dt_s) for _ in body.modules]
        """One per module."""
        self.force_n = np.zeros(t.f_max.size)
        self.retune(parameters)

    def retune(self, parameters: LimiterParameters) -> None:
        """Applies new limits from this tick on; forces and the magnets' accounts stay."""
        t = self._t
        self._limits = (
            t.f_min * parameters.force_share, t.f_max * parameters.force_share,
            -np.array([polynomial(curve, 1.0) for curve in t.reverse]), np.array([polynomial(curve, 1.0) for curve in t.forward]),
        )  # fmt: skip
        self._step_n = parameters.slew_n_per_s * self._dt_s
        self._eased_step_n = min(self._step_n, EASED_N_PER_S * self._dt_s)
        self._thrust_limits = None
        for magnets in self.magnets:
            magnets.retune(parameters)

    def limits(self, voltage_v: np.ndarray) -> ThrustLimits:
        """Returns the limits at this supply voltage (m,), less the power of the active magnets; the same object until they change."""
        scale, magnets_w = self._voltage_scale(voltage_v), [magnets.power_w for magnets in self.magnets]
        if self._thrust_limits is None or self._thrust_limits_for != (self._scaled_for, magnets_w):
            low, high, full_low, full_high = self._limits
            supply_w = np.array(self._supply) - magnets_w
            self._thrust_limits = ThrustLimits(np.maximum(low, full_low * scale), np.minimum(high, full_high * scale), supply_w)
            self._thrust_limits_for = (self._scaled_for, magnets_w)
        return self._thrust_limits

    def continue_from(self, force_n: np.ndarray) -> None:
        """Continues from the forces (n,) that these thrusters had in the bodies before, with the lower slew limit at first."""
        self.force_n, self._eased = force_n, self._eased_ticks

    def step(
        self, wanted_n: np.ndarray, armed: bool, voltage_v: np.ndarray, alive: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns limited forces (n,) N and commands (n,) in -1..1.

        Args:
            wanted_n: (n,) N; a value that is not finite counts as zero.
            armed: if false, every command is zero in this very tick.
            voltage_v: (m,) measured supply voltage of each module.
            alive: (n,) bool, thrusters that may turn; the others stop in this very tick. None: all.
        """
        if not armed:
            self.force_n = np.zeros_like(self.force_n)
            return self.force_n, np.zeros_like(self.force_n)
        scale, wanted = self._voltage_scale(voltage_v), np.empty_like(self.force_n)
        step_n = self._eased_step_n if self._eased else self._step_n
        self._eased = max(0, self._eased - 1)
        limit_forces(wanted_n, self.force_n, self._all if alive is None else alive, scale, *self._limits, step_n, wanted)
        powers = module_power(wanted, self._t.power_forward, self._t.power_reverse, self._t.module, len(self.magnets)).tolist()
        for module, (power, supply_w, magnets) in enumerate(zip(powers, self._supply, self.magnets, strict=True)):
            if power > supply_w - magnets.power_w:
                self._limit_power(wanted, module, supply_w - magnets.power_w)
        self.force_n = wanted
        out = np.empty_like(wanted)
        commands(wanted, scale, *self._curves, out)
        return wanted, out

    def _limit_power(self, wanted: np.ndarray, module: int, supply: float) -> None:
        """Scales down the forces of one module until its supply can provide their power."""
        index = self._of_module[module]
        force = wanted[index]
        forward, reverse = self._power[module]
        kept, step = 0.0, 1.0
        for _ in range(POWER_HALVINGS):
            step *= 0.5
            if total_power(force * (kept + step), forward, reverse) <= supply:
                kept += step
        wanted[index] = force * kept

    def _voltage_scale(self, voltage_v: np.ndarray) -> np.ndarray:
        """Returns (n,) force at a full command over that at the nominal voltage; 1 where the reading is invalid."""
        reading = voltage_v.tobytes()
        if reading != self._scaled_for:  # readings come at 10 Hz
            ratio = voltage_v / self._nominal_v
            self._scale = np.asarray((np.where(is_believed(ratio), ratio, 1.0) ** VOLTAGE_EXPONENT)[self._t.module])
            self._scaled_for = reading
        return self._scale


@njit(f"void({V},{V},boolean[::1],{V},{V},{V},{V},{V},float64,{V})", cache=True)
def limit_forces(wanted, last, alive, scale, low, high, full_low, full_high, step, out):  # type: ignore[no-untyped-def]
    """Writes the limited force of each thruster, N; all but `step` are (n,).

    Args:
        wanted, last: wanted force, and force of the tick before. alive: may turn.
        scale: force at a full command over that at the nominal voltage.
        low, high: limits from the parameters. full_low, full_high: forces at full commands and nominal voltage.
        step: largest change in a tick, N.
    """
    for i in range(out.shape[0]):
        force = wanted[i] if math.isfinite(wanted[i]) else 0.0
        force = min(max(force, last[i] - step), last[i] + step)
        # capped at what a full command gives at this voltage, so that the believed force is no larger
        force = min(max(force, low[i], full_low[i] * scale[i]), high[i], full_high[i] * scale[i])
        out[i] = force if alive[i] else 0.0


def is_believed(ratio: np.ndarray) -> np.ndarray:
    """Whether supply voltage readings, given as shares of the nominal voltage, are valid. A NaN is not."""
    low, high = VOLTAGE_RANGE
    return np.asarray((ratio >= low) & (ratio <= high))


class MagnetLimiter:
    """Protects the docking magnets of one module from overheating: limits the time on at a stretch and the long-term duty cycle.

    Each magnet has an account, s, that falls by the time that the magnet is on and fills at the rate of its duty. A magnet whose account is
    empty is switched off until the account is half full.
    """

    def __init__(self, parameters: LimiterParameters, dt_s: float) -> None:
        self._dt_s = dt_s
        self._left_s = [parameters.relay_on_s] * FACES
        self._resting = [False] * FACES
        self.states = (RELAY_OFF,) * FACES
        """Relay states of the last tick."""
        self.power_w = 0.0
        """Power of the magnets that are on, W."""
        self.retune(parameters)

    @property
    def resting(self) -> list[int]:
        """Faces whose magnet is forced off until its account is half full."""
        return [face for face, rests in enumerate(self._resting) if rests] if True in self._resting else []

    def retune(self, parameters: LimiterParameters) -> None:
        """Applies new limits from this tick on; accounts stay."""
        self._p = parameters
        self._settled_for: tuple[int, ...] | None = None
        """Wanted states for which another tick changes nothing: full accounts stay full, also those of magnets that may be on for ever."""

    def step(self, wanted: Sequence[int]) -> tuple[int, ...]:
        """Returns the permitted relay states of this tick; an unknown state counts as off. To be called in every tick."""
        asked = tuple(wanted)
        if asked == self._settled_for:
            return self.states
        full, duty = self._p.relay_on_s, self._p.relay_duty
        on = [state in (RELAY_PULL, RELAY_PUSH) and not rests for state, rests in zip(asked, self._resting, strict=True)]
        left_s = [min(full, left + self._dt_s * (duty - lit)) for left, lit in zip(self._left_s, on, strict=True)]
        resting = [left < 0.5 * full if rests else left <= 0.0 for left, rests in zip(left_s, self._resting, strict=True)]
        self._settled_for = asked if (left_s, resting) == (self._left_s, self._resting) else None
        self._left_s, self._resting = left_s, resting
        self.power_w = sum(on) * self._p.relay_w
        self.states = tuple(state if lit else RELAY_OFF for state, lit in zip(asked, on, strict=True))
        return self.states
