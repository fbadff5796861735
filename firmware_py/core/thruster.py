"""Thruster curves: the paper's fifth-order polynomials force(command) and power(force), supply voltage, and the lag.

The controller's model: it converts wanted forces into commands (limiter), and commands into believed forces (estimator).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from firmware_py.core.body import ThrusterSet
from firmware_py.core.rotations import M, V

RESOLUTION = 2.0**-40
"""Tolerance of a command found by `inverse`: far below the bus's 1/2048."""
MOST_STEPS = 60
"""Limit of the iterations of `inverse`; six are usual."""


@njit(f"float64({V},float64)", cache=True)
def polynomial(c, x):  # type: ignore[no-untyped-def]
    """c[0] x + c[1] x^2 + ... without a constant term, so that a zero command gives zero force."""
    value = 0.0
    for i in range(c.shape[0] - 1, -1, -1):
        value = (value + c[i]) * x
    return value


@njit(f"float64({V},float64)", cache=True)
def inverse(c, value):  # type: ignore[no-untyped-def]
    """The x in 0..1 with polynomial(c, x) = value; 0 below and 1 above the range. c must rise over 0..1.

    Newton steps, starting from the solution of a square law; a step that would leave the bracket is replaced by a bisection.
    """
    full = polynomial(c, 1.0)
    if value <= 0.0:
        return 0.0
    if value >= full:
        return 1.0
    low, high, x = 0.0, 1.0, math.sqrt(value / full)
    for _ in range(MOST_STEPS):
        here, slope = 0.0, 0.0
        for i in range(c.shape[0] - 1, -1, -1):
            slope = slope * x + here + c[i]
            here = (here + c[i]) * x
        if here < value:
            low = x
        else:
            high = x
        before, x = x, 0.5 * (low + high)
        if slope > 0.0 and low <= before + (value - here) / slope <= high:
            x = before + (value - here) / slope
        if abs(x - before) <= RESOLUTION:
            break
    return x


@njit(f"void({V},{V},{M},{M},{V},{V})", cache=True)
def commands(force, scale, forward, reverse, deadband, out):  # type: ignore[no-untyped-def]
    """Writes the command of each thruster for its wanted force.

    Args:
        force: (n,) N. scale: (n,) force at this voltage over force at the curve's voltage.
        forward, reverse: (n, 5) polynomials. deadband: (n,) N. out: (n,) commands, written.
    """
    for i in range(force.shape[0]):
        f = force[i] / scale[i]
        if abs(f) < 0.5 * deadband[i]:
            out[i] = 0.0
        elif f > 0.0:
            out[i] = inverse(forward[i], f)
        else:
            out[i] = -inverse(reverse[i], -f)


@njit(f"float64({V},{M},{M})", cache=True)
def total_power(force, power_forward, power_reverse):  # type: ignore[no-untyped-def]
    """Electrical power of all thrusters, W."""
    total = 0.0
    for i in range(force.shape[0]):
        total += polynomial(power_forward[i] if force[i] > 0.0 else power_reverse[i], abs(force[i]))
    return total


@njit(f"{V}({V},{M},{M},int64[::1],int64)", cache=True)
def module_power(force, power_forward, power_reverse, module, count):  # type: ignore[no-untyped-def]
    """(count,) electrical power of the thrusters of each module, W; `module` (n,): module of each thruster."""
    out = np.zeros(count)
    for i in range(force.shape[0]):
        out[module[i]] += polynomial(power_forward[i] if force[i] > 0.0 else power_reverse[i], abs(force[i]))
    return out


@njit(f"void({V},{V},{V},{V},{V})", cache=True)
def lagged(acting, decay, lag_over_dt, force, mean):  # type: ignore[no-untyped-def]
    """Advances `force` (n,), N, by a tick towards `acting` (n,), N; writes its mean over that tick, N, to `mean` (n,).

    Args:
        decay: (n,) share of a difference that remains after a tick. lag_over_dt: (n,) lag over the length of a tick.
    """
    for i in range(force.shape[0]):
        end = acting[i] + (force[i] - acting[i]) * decay[i]
        mean[i] = acting[i] + (force[i] - end) * lag_over_dt[i]
        force[i] = end


class ThrusterLag:
    """Believed present forces of the thrusters: commanded forces through a first-order lag.

    The command of tick k leaves in tick k and acts from SYNC k+1 on, so one command waits in `_pending`.
    """

    def __init__(self, thrusters: ThrusterSet, dt_s: float) -> None:
        n = thrusters.lag_s.size
        self._decay = np.array([math.exp(-dt_s / lag) if lag > 0 else 0.0 for lag in thrusters.lag_s])
        self._lag_over_dt = thrusters.lag_s / dt_s
        self.force_n = np.zeros(n)
        self._acting = np.zeros(n)
        self._pending = np.zeros(n)

    def step(self) -> np.ndarray:
        """Advances the lag by one tick. Returns the (n,) mean force of each thruster over the tick that ends now, N."""
        mean = np.empty_like(self.force_n)
        self.force_n = self.force_n.copy()
        lagged(self._acting, self._decay, self._lag_over_dt, self.force_n, mean)
        self._acting = self._pending
        return mean

    @property
    def forces(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Believed force, force it approaches now, and force it approaches next, (n,) each, N: the whole state."""
        return self.force_n, self._acting, self._pending

    def restart(self, force_n: np.ndarray, acting_n: np.ndarray, pending_n: np.ndarray) -> None:
        """Restores a state that `forces` gave."""
        self.force_n, self._acting, self._pending = force_n, acting_n, pending_n

    def command(self, force_n: np.ndarray) -> None:
        """Takes the forces commanded in this tick, (n,), N."""
        self._pending = force_n
