"""Thrusters and their supply: command -> force, through deadband, lag, voltage, gain error and the supply's limit.

The static force at the curve's voltage follows a first-order lag; what acts is that times gain and (V/V0)^2, since at a given
duty the propeller's speed is proportional to the voltage. Jets push the modules in their way.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit, types

from hil.plant.vectors import F1, F2, F3, F8, I1



class Thrusters(NamedTuple):
    """Arrays over t thrusters, module by module; and over m modules."""

    module: np.ndarray
    """(t,) index of the module."""
    body: np.ndarray
    """(t,) index of the body."""
    column: np.ndarray
    """(t, 6) wrench of unit force about O of that body, body frame."""
    force_curve: np.ndarray
    """(t, 2, 5) forward and reverse polynomial of |command|, N."""
    power_curve: np.ndarray
    """(t, 2, 5) polynomial of |force|, W."""
    constants: np.ndarray
    """(t, 4) gain, deadband N, lag s, speed at full command 1/min."""
    level: np.ndarray
    """(t, 2) where the force tends and where it is, N, at the curve's voltage."""
    force: np.ndarray
    """(t,) force that acts now, N."""
    supply: np.ndarray
    """(m, 5) curve voltage, open-circuit voltage, resistance, largest current (infinity: none), power of the electronics."""
    power: np.ndarray
    """(m, 2) voltage and current of each module now."""


THRUSTERS = types.NamedTuple((I1, I1, F2, F3, F3, F2, F2, F1, F2, F2), Thrusters)


@njit(F8(F1, F8), cache=True)
def polynomial(c, x):
    """sum c[i] x^(i+1)."""
    return x * (c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * c[4]))))


@njit(types.void(THRUSTERS, types.int64, F8), cache=True)
def command(thrusters, t, u):
    """Gives thruster t the command u, -1 to 1; a force within the deadband is none."""
    side = 0 if u > 0.0 else 1
    force = polynomial(thrusters.force_curve[t, side], min(1.0, abs(u)))
    if force < thrusters.constants[t, 1]:
        force = 0.0
    thrusters.level[t, 0] = force if u > 0.0 else -force


@njit(F8(F8, F8, F8, F8, F8), cache=True)
def voltage_of(open_v, resistance, limit_a, idle_a, conductance):
    """Voltage at which supply and load agree.

    At a given duty the power of a thruster goes with V^3, so its current with V^2: I(V) = idle + conductance V^2. The supply
    gives V = open - R I, and never more than its limit.
    """
    v = open_v - resistance * idle_a
    if resistance * conductance > 1e-12:
        rc = resistance * conductance
        v = (math.sqrt(1.0 + 4.0 * rc * v) - 1.0) / (2.0 * rc)
    if conductance * v * v + idle_a > limit_a:
        v = math.sqrt(max(0.0, limit_a - idle_a) / conductance)
    return v


@njit(types.void(THRUSTERS), cache=True)
def load_supplies(thrusters):
    """Finds voltage and current of every module from what its propellers do."""
    supply, power = thrusters.supply, thrusters.power
    for m in range(supply.shape[0]):
        power[m, 1] = 0.0
    for t in range(thrusters.module.shape[0]):
        f = thrusters.level[t, 1]
        power[thrusters.module[t], 1] += polynomial(thrusters.power_curve[t, 0 if f > 0.0 else 1], abs(f))
    for m in range(supply.shape[0]):
        v0 = supply[m, 0]
        idle_a = supply[m, 4] / supply[m, 1]
        conductance = power[m, 1] / v0**3
        v = voltage_of(supply[m, 1], supply[m, 2], supply[m, 3], idle_a, conductance)
        power[m, 0], power[m, 1] = v, idle_a + conductance * v * v


@njit(types.void(THRUSTERS, F8), cache=True)
def forces_after(thrusters, elapsed_s):
    """Sets the force of every thruster to that `elapsed_s` from now, at the voltages found by `load_supplies`."""
    for t in range(thrusters.force.shape[0]):
        lag, target, now = thrusters.constants[t, 2], thrusters.level[t, 0], thrusters.level[t, 1]
        left = math.exp(-elapsed_s / lag) if lag > 0.0 else 0.0
        m = thrusters.module[t]
        scale = thrusters.power[m, 0] / thrusters.supply[m, 0]
        thrusters.force[t] = thrusters.constants[t, 0] * scale * scale * (target + (now - target) * left)


@njit(types.void(THRUSTERS, F8), cache=True)
def settle(thrusters, elapsed_s):
    """Moves the lagged forces on by `elapsed_s`."""
    for t in range(thrusters.module.shape[0]):
        lag = thrusters.constants[t, 2]
        left = math.exp(-elapsed_s / lag) if lag > 0.0 else 0.0
        thrusters.level[t, 1] = thrusters.level[t, 0] + (thrusters.level[t, 1] - thrusters.level[t, 0]) * left


@njit(types.void(THRUSTERS, types.int64, F1), cache=True)
def feedback(thrusters, t, out):
    """Writes rpm (1/min) and current (A) of thruster t into out (2,).

    Thrust goes with the square of the speed; the gain error is the propeller's, so the speed does not show it.
    """
    f = thrusters.level[t, 1]
    side = 0 if f > 0.0 else 1
    m = thrusters.module[t]
    scale = thrusters.power[m, 0] / thrusters.supply[m, 0]
    full = polynomial(thrusters.force_curve[t, side], 1.0)
    rpm = thrusters.constants[t, 3] * scale * math.sqrt(abs(f) / full)
    out[0] = rpm if f > 0.0 else -rpm
    out[1] = polynomial(thrusters.power_curve[t, side], abs(f)) / thrusters.supply[m, 0] * scale * scale
