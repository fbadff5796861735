"""Thrusters and their supply: command -> force, through deadband, lag, voltage, gain error and the supply's limit.

The static force at the curve's voltage passes through a first-order lag; the acting force is the lagged force times gain and
(V/V0)^2, since the propeller's speed at a given duty is proportional to the voltage. (Jets: jets.py.)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from hil.plant.vectors import F1, F2, F3, I1, I8, compiled, inlined


class Thrusters(NamedTuple):
    """Arrays over t thrusters, sorted by module, and over m modules."""

    module: np.ndarray
    """(t,) index of the module."""
    body: np.ndarray
    """(t,) index of the body."""
    column: np.ndarray
    """(t, 6) allocation column: wrench of unit force about O of that body, body frame."""
    position: np.ndarray
    """(t, 3) in the body frame."""
    force_curve: np.ndarray
    """(t, 2, 5) forward and reverse polynomial of |command|, N."""
    power_curve: np.ndarray
    """(t, 2, 5) polynomial of |force|, W."""
    constants: np.ndarray
    """(t, 3) gain, deadband N, speed at full command 1/min."""
    decay: np.ndarray
    """(t, 3) fraction of a difference that the lag leaves after zero, half and one whole sub-step."""
    level: np.ndarray
    """(t, 2) target force and lagged force, N, at the curve's voltage."""
    force: np.ndarray
    """(t,) force acting now, N."""
    supply: np.ndarray
    """(m, 5) curve voltage, open-circuit voltage, resistance, largest current or infinity, power of the electronics."""
    power: np.ndarray
    """(m, 2) voltage and current of each module now."""


THRUSTERS = types.NamedTuple((I1, I1, F2, F2, F3, F3, F2, F2, F2, F1, F2, F2), Thrusters)


@inlined
def polynomial(curves, t, side, x):
    """sum c[i] x^(i+1) of one curve (side 0 forward, 1 reverse) of thruster t."""
    total = 0.0
    for i in range(5):
        total = x * (curves[t, side, 4 - i] + total)
    return total


@compiled(types.void(F3, F2, F2, I8, F1))
def command(force_curve, constants, level, first, u):
    """Commands the thrusters from index `first` on to u, -1 to 1; forces within the deadband become zero. Arrays as in Thrusters."""
    for i in range(u.shape[0]):
        t, side = first + i, 0 if u[i] > 0.0 else 1
        force = polynomial(force_curve, t, side, min(1.0, abs(u[i])))
        if force < constants[t, 1]:
            force = 0.0
        level[t, 0] = force if u[i] > 0.0 else -force


@inlined
def idle_of(open_v, resistance, limit_a, electronics_w):
    """Current of the electronics, at most the supply's limit and its short-circuit current."""
    return min(limit_a, open_v / resistance, electronics_w / open_v) if open_v > 0.0 else 0.0


@inlined
def voltage_of(open_v, resistance, limit_a, idle_a, conductance):
    """Voltage at which supply and load are in equilibrium.

    At a given duty the power of a thruster is proportional to V^3 and its current to V^2: I(V) = idle + conductance V^2. The supply
    gives V = open - R I, with I at most its limit; V is zero where the idle current alone reaches the limit.
    """
    v = max(0.0, open_v - resistance * idle_a) if idle_a < limit_a else 0.0
    if resistance * conductance > 1e-12:
        rc = resistance * conductance
        v = (math.sqrt(1.0 + 4.0 * rc * v) - 1.0) / (2.0 * rc)
    if conductance * v * v + idle_a > limit_a:
        v = math.sqrt(max(0.0, limit_a - idle_a) / conductance)
    return v


@inlined
def load_supplies(thrusters, halves):
    """Computes voltage and current of every module from the load of its propellers `halves` half sub-steps ahead."""
    supply, power = thrusters.supply, thrusters.power
    for m in range(supply.shape[0]):
        power[m, 1] = 0.0
    for t in range(thrusters.module.shape[0]):
        target = thrusters.level[t, 0]
        f = target + (thrusters.level[t, 1] - target) * thrusters.decay[t, halves]
        power[thrusters.module[t], 1] += polynomial(thrusters.power_curve, t, 0 if f > 0.0 else 1, abs(f))
    for m in range(supply.shape[0]):
        v0 = supply[m, 0]
        idle_a = idle_of(supply[m, 1], supply[m, 2], supply[m, 3], supply[m, 4])
        conductance = power[m, 1] / v0**3
        v = voltage_of(supply[m, 1], supply[m, 2], supply[m, 3], idle_a, conductance)
        power[m, 0], power[m, 1] = v, idle_a + conductance * v * v


@inlined
def forces_after(thrusters, halves):
    """Sets every thruster's force to its value `halves` half sub-steps ahead, at the voltages of `load_supplies`."""
    for t in range(thrusters.force.shape[0]):
        target, now = thrusters.level[t, 0], thrusters.level[t, 1]
        m = thrusters.module[t]
        scale = thrusters.power[m, 0] / thrusters.supply[m, 0]
        thrusters.force[t] = (
            thrusters.constants[t, 0] * scale * scale * (target + (now - target) * thrusters.decay[t, halves])
        )


@inlined
def settle(thrusters):
    """Advances the lagged forces by one sub-step."""
    level = thrusters.level
    for t in range(level.shape[0]):
        level[t, 1] = level[t, 0] + (level[t, 1] - level[t, 0]) * thrusters.decay[t, 2]


@compiled(types.void(THRUSTERS, I8, F2))
def feedback(thrusters, first, out):
    """Writes rpm (1/min) and current (A) of the n thrusters from index `first` on into out (n, 2).

    Thrust is proportional to the square of the speed; the gain error is one of the propeller and does not show in the speed.
    """
    for i in range(out.shape[0]):
        t = first + i
        f, m = thrusters.level[t, 1], thrusters.module[t]
        side = 0 if f > 0.0 else 1
        scale = thrusters.power[m, 0] / thrusters.supply[m, 0]
        full = polynomial(thrusters.force_curve, t, side, 1.0)
        rpm = thrusters.constants[t, 2] * scale * math.sqrt(abs(f) / full)
        out[i, 0] = rpm if f > 0.0 else -rpm
        out[i, 1] = polynomial(thrusters.power_curve, t, side, abs(f)) / thrusters.supply[m, 0] * scale * scale
