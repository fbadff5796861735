"""Time that each body has left before it must brake to stop before another: a figure of the health (`collision_s`).

All bodies move on as they do now; and each, besides, as its guidance wants to: one that waits before another would reach it as soon as it
goes on. A hull counts as the upright cylinder about its box as it is turned now. Braking takes the longer way of the set-point, which
changes speed through a filter, and of thrusters that are too weak to follow it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numba import njit

from firmware_py.core.body import Body
from firmware_py.core.rotations import M, V, cross, rotate
from firmware_py.core.setpoint import way_to_rest_s
from firmware_py.core.types import Estimate

CLOSING_M_S, OWN_M_S = 0.08, 0.04
"""Speed at which two modules must near each other to count, and the least part of it that must be a body's own, so that it can help. A hull
bears a slower bump (docks touch at up to 0.06), and a body may pass close by another slowly."""


def braking_s(speed: np.ndarray, deceleration: np.ndarray, bandwidth: float) -> np.ndarray:
    """(...) braking distance over the present speed, s: the time that is lost to a collision if a body begins to brake now.

    A set-point that comes to rest through the critically damped filter of core.setpoint covers 2 v / bandwidth, and a body that brakes with
    all its force v^2 / (2 a); the sum bounds what both cover together.

    Args:
        speed: (..., 2) speed, m/s, and turning rate, rad/s.
        deceleration: (..., 2) as Body.deceleration.
        bandwidth: of the filter, rad/s.
    """
    return np.asarray(way_to_rest_s(bandwidth) + 0.5 * np.max(speed / deceleration, axis=-1))


def times_to_brake(
    bodies: Sequence[Body],
    estimates: Mapping[int, Estimate],
    wanted_w: Mapping[int, np.ndarray],
    deceleration: Mapping[int, np.ndarray],
    bandwidth: float,
    pairs: Collection[tuple[int, int]] = (),
) -> dict[int, float]:
    """Time after which each body must brake to stop before another towards which it moves, or wants to move, s, by its number; NaN if there
    is none, 0 if it is too late.

    Args:
        estimates: by number of the body. A body whose place is unknown is left out.
        wanted_w: by number, the (3,) velocity in the world that guidance wants, m/s.
        deceleration: by number, (2,) that of the thrusters that are used, as Body.deceleration.
        bandwidth: with which the set-points come to rest, rad/s.
        pairs: numbers of two bodies each that are no obstacles to each other, because they dock or have just parted.
    """
    placed = [body for body in bodies if estimates[body.index].placed]
    times = dict.fromkeys((body.index for body in bodies), math.nan)
    if len(placed) < 2:
        return times
    numbers = [body.index for body in placed]
    ignored = np.eye(len(placed), dtype=np.bool_)
    for pair in pairs:
        if set(pair) <= set(numbers):
            a, b = map(numbers.index, pair)
            ignored[a, b] = ignored[b, a] = True
    modules = [in_world(*estimates[body.index][:3], body.r_bm, body.hull_m) for body in placed]
    of_body = np.repeat(np.arange(len(placed)), [len(body.modules) for body in placed])
    r_w, v_w, cylinder = map(np.concatenate, zip(*modules, strict=True))
    wanted = np.array([wanted_w[number] for number in numbers])
    nu = np.array([estimates[number].nu for number in numbers]).reshape(len(placed), 2, 3)
    slowing = np.array([deceleration[number] for number in numbers])
    own, asked = np.linalg.norm(nu, axis=2), np.zeros((len(placed), 2))
    asked[:, 0] = np.linalg.norm(wanted, axis=1)
    left = np.fmin(
        _soonest(r_w, v_w, v_w, cylinder, of_body, ignored) - braking_s(own, slowing, bandwidth),
        _soonest(r_w, wanted[of_body], v_w, cylinder, of_body, ignored) - braking_s(asked, slowing, bandwidth),
    )
    return times | dict(zip(numbers, np.maximum(left, 0.0).tolist(), strict=True))


@njit(f"Tuple(({M},{M},{M}))({V},{V},{V},{M},{M})", cache=True)
def in_world(p_wb, q_wb, nu, r_bm, hull_m):  # type: ignore[no-untyped-def]
    """(m, 3) places of a body's modules, m, (m, 3) their velocities, m/s, world, and (m, 2) radius and half the height of the upright
    cylinders about their hulls, m.
    """
    r_w, v_w, cylinder = np.empty_like(r_bm), np.empty_like(r_bm), np.zeros((r_bm.shape[0], 2))
    for m in range(r_bm.shape[0]):
        r_w[m] = p_wb + rotate(q_wb, r_bm[m])
        v_w[m] = rotate(q_wb, nu[:3] + cross(nu[3:], r_bm[m]))
        x, y, z = 0.5 * hull_m[m]
        for corner_b in ((x, y, z), (x, -y, z), (-x, y, z), (-x, -y, z)):  # the other four are opposite
            corner = rotate(q_wb, np.array(corner_b))
            cylinder[m, 0] = max(cylinder[m, 0], math.hypot(corner[0], corner[1]))
            cylinder[m, 1] = max(cylinder[m, 1], abs(corner[2]))
    return r_w, v_w, cylinder


@njit("UniTuple(float64,2)(float64,float64,float64)", cache=True)
def within(excess, rate, speed2):  # type: ignore[no-untyped-def]
    """Times from when to when excess + 2 rate t + speed2 t^2 is at most 0; infinity to minus infinity if it never is."""
    if speed2 < 1e-12:
        return (-math.inf, math.inf) if excess <= 0.0 else (math.inf, -math.inf)
    under_root = rate * rate - speed2 * excess
    if under_root < 0.0:
        return math.inf, -math.inf
    return (-rate - math.sqrt(under_root)) / speed2, (-rate + math.sqrt(under_root)) / speed2


@njit(f"{V}({M},{M},{M},{M},int64[::1],boolean[:,::1])", cache=True)
def _soonest(r_w, own_w, v_w, cylinder, of_body, ignored):  # type: ignore[no-untyped-def]
    """(b,) the least time to collision over all pairs of modules of two bodies, s; NaN where there is none. Each body moves at `own_w`,
    (m, 3), while the others move at `v_w`, (m, 3).
    """
    out = np.full(len(ignored), np.nan)
    for i in range(of_body.size):
        for j in range(of_body.size):
            if ignored[of_body[i], of_body[j]]:
                continue
            north, east, down = r_w[j, 0] - r_w[i, 0], r_w[j, 1] - r_w[i, 1], r_w[j, 2] - r_w[i, 2]
            v_n, v_e, v_d = v_w[j, 0] - own_w[i, 0], v_w[j, 1] - own_w[i, 1], v_w[j, 2] - own_w[i, 2]
            own = north * own_w[i, 0] + east * own_w[i, 1] + down * own_w[i, 2]
            level_rate, down_rate, level2, down2 = north * v_n + east * v_e, down * v_d, north**2 + east**2, down**2
            distance = math.sqrt(level2 + down2)
            if -level_rate - down_rate > CLOSING_M_S * distance and own > OWN_M_S * distance:  # not where it is NaN
                radius_m, height_m = cylinder[i, 0] + cylinder[j, 0], cylinder[i, 1] + cylinder[j, 1]
                beside = within(level2 - radius_m**2, level_rate, v_n**2 + v_e**2)
                above = within(down2 - height_m**2, down_rate, v_d**2)
                begins = max(beside[0], above[0], 0.0)
                if begins <= min(beside[1], above[1]):
                    out[of_body[i]] = np.fmin(out[of_body[i]], begins)
    return out
