"""Time that each body has left before it must brake to stop before another: a figure of the health (`collision_s`).

All bodies move and turn on as they do now; and each, besides, as its guidance wants to: one that waits before another would reach it as
soon as it goes on. A hull counts as the upright cylinder about its box as it is turned now, wider by how far the body may have drifted
since its last tag. Braking takes the longer way of the set-point, which changes speed through a filter, and of thrusters that are too weak
to follow it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numba import njit

from firmware_py.core.body import Body
from firmware_py.core.rotations import M, V, exp, multiply, turned
from firmware_py.core.setpoint import way_to_rest_s
from firmware_py.core.types import Estimate

CLOSING_M_S, OWN_M_S = 0.08, 0.04
"""Speed at which two modules must near each other to count, and the least part of it that must be a body's own, so that it can help. A hull
bears a slower bump (docks touch at up to 0.06), and a body may pass close by another slowly."""
DRIFT_M_S, MOST_DRIFT_M = 0.05, 1.0
"""Speed at which a body may have been carried off since its last tag, that of the plant's mean current (synthetic), and how far it may
be at most: a body that keeps out of sight for longer surfaces, and must not bar a whole tank."""
PIECES = 16
"""Straight pieces in which modules that a turn carries along are followed, for a whole turn of the body that turns fastest. The arc leaves
its piece by 2 % of its radius."""


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
    wanted: Mapping[int, np.ndarray],
    deceleration: Mapping[int, np.ndarray],
    bandwidth: float,
    pairs: Collection[tuple[int, int]] = (),
) -> dict[int, float]:
    """Time after which each body must brake to stop before another towards which it moves, or wants to move, s, by its number; NaN if there
    is none, 0 if it is too late.

    Args:
        estimates: by number of the body. A body whose place is unknown is left out.
        wanted: by number, (6,) velocity in the world, m/s, and turning rate in the body's frame, rad/s, that guidance wants.
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
    of_body = np.repeat(np.arange(len(placed)), [len(body.modules) for body in placed])
    r_bm, hull_m = np.concatenate([body.r_bm for body in placed]), np.concatenate([body.hull_m for body in placed])
    p_wb, q_wb, now = (np.array(parts) for parts in zip(*(estimates[number][:3] for number in numbers), strict=True))
    for motion, attitude in zip(now, q_wb, strict=True):
        motion[:3] = turned(attitude, *motion[:3])
    cylinder = cylinders(q_wb, of_body, hull_m)
    unseen_s = 1e-9 * np.array([estimates[number].tag_age_ns for number in numbers])
    cylinder[:, 0] += np.minimum(DRIFT_M_S * unseen_s, MOST_DRIFT_M)[of_body]
    slowing = np.array([deceleration[number] for number in numbers])
    left = []
    for own in (now, np.array([wanted[number] for number in numbers])):
        speeds = np.linalg.norm(own.reshape(len(own), 2, 3), axis=2)
        left.append(_soonest(p_wb, q_wb, own, now, of_body, r_bm, cylinder, ignored) - braking_s(speeds, slowing, bandwidth))
    return times | dict(zip(numbers, np.maximum(np.fmin(*left), 0.0).tolist(), strict=True))


@njit(f"{M}(float64,{M},{M},{M},int64[::1],{M})", cache=True)
def places(t_s, p_wb, q_wb, motion, of_body, r_bm):  # type: ignore[no-untyped-def]
    """(m, 3) places of all modules in the world, m, after `t_s` at `motion`: (b, 6) velocity, world, and turning rate, body, of each."""
    q_then, r_w = np.empty_like(q_wb), np.empty_like(r_bm)
    for b in range(len(q_wb)):
        q_then[b] = multiply(q_wb[b], exp(t_s * motion[b, 3:]))
    for m in range(of_body.size):
        b = of_body[m]
        arm = turned(q_then[b], r_bm[m, 0], r_bm[m, 1], r_bm[m, 2])
        for axis in range(3):
            r_w[m, axis] = p_wb[b, axis] + t_s * motion[b, axis] + arm[axis]
    return r_w


@njit(f"{M}({M},int64[::1],{M})", cache=True)
def cylinders(q_wb, of_body, hull_m):  # type: ignore[no-untyped-def]
    """(m, 2) radius and half the height of the upright cylinders about the hulls of all modules, m."""
    out = np.zeros((of_body.size, 2))
    for m in range(of_body.size):
        x, y, z = 0.5 * hull_m[m]
        for corner_b in ((x, y, z), (x, -y, z), (-x, y, z), (-x, -y, z)):  # the other four are opposite
            north, east, down = turned(q_wb[of_body[m]], *corner_b)
            out[m, 0], out[m, 1] = max(out[m, 0], math.hypot(north, east)), max(out[m, 1], abs(down))
    return out


@njit("UniTuple(float64,2)(float64,float64,float64)", cache=True)
def within(excess, rate, speed2):  # type: ignore[no-untyped-def]
    """Times from when to when excess + 2 rate t + speed2 t^2 is at most 0; infinity to minus infinity if it never is."""
    if speed2 < 1e-12:
        return (-math.inf, math.inf) if excess <= 0.0 else (math.inf, -math.inf)
    under_root = rate * rate - speed2 * excess
    if under_root < 0.0:
        return math.inf, -math.inf
    return (-rate - math.sqrt(under_root)) / speed2, (-rate + math.sqrt(under_root)) / speed2


@njit(f"void({M},{M},{M},{M},{M},int64[::1],boolean[:,::1],float64,float64,{V})", cache=True)
def _meet(own_r, own_w, r_w, v_w, cylinder, of_body, ignored, begins_s, lasts_s, out):  # type: ignore[no-untyped-def]
    """Lowers `out`, (b,), to the least time to collision over all pairs of modules of two bodies, s, in a straight piece of their ways from
    `begins_s` for `lasts_s`. Each body moves from `own_r` at `own_w`, while the others move from `r_w` at `v_w`: (m, 3), of
    velocities the first three of more columns.
    """
    for i in range(of_body.size):
        for j in range(of_body.size):
            if ignored[of_body[i], of_body[j]]:
                continue
            north, east, down = r_w[j, 0] - own_r[i, 0], r_w[j, 1] - own_r[i, 1], r_w[j, 2] - own_r[i, 2]
            v_n, v_e, v_d = v_w[j, 0] - own_w[i, 0], v_w[j, 1] - own_w[i, 1], v_w[j, 2] - own_w[i, 2]
            own = north * own_w[i, 0] + east * own_w[i, 1] + down * own_w[i, 2]
            level_rate, down_rate, level2, down2 = north * v_n + east * v_e, down * v_d, north**2 + east**2, down**2
            distance = math.sqrt(level2 + down2)
            if -level_rate - down_rate > CLOSING_M_S * distance and own > OWN_M_S * distance:  # not where it is NaN
                radius_m, height_m = cylinder[i, 0] + cylinder[j, 0], cylinder[i, 1] + cylinder[j, 1]
                beside = within(level2 - radius_m**2, level_rate, v_n**2 + v_e**2)
                above = within(down2 - height_m**2, down_rate, v_d**2)
                meets_s = max(beside[0], above[0], 0.0)
                if meets_s <= min(beside[1], above[1], lasts_s):
                    out[of_body[i]] = np.fmin(out[of_body[i]], begins_s + meets_s)


@njit(f"{V}({M},{M},{M},{M},int64[::1],{M},{M},boolean[:,::1])", cache=True)
def _soonest(p_wb, q_wb, own, now, of_body, r_bm, cylinder, ignored):  # type: ignore[no-untyped-def]
    """(b,) the least time to collision, s; NaN where there is none. Each body moves at its motion in `own`, (b, 6) as in `places`, while
    the others move at theirs in `now`. All go straight on after a whole turn, or at once if no turn carries a module along fast enough.
    """
    fastest = 0.0
    for motion in (own, now):
        for m in range(of_body.size):
            rate = math.sqrt((motion[of_body[m], 3:] ** 2).sum())
            if rate * math.sqrt((r_bm[m] ** 2).sum()) > OWN_M_S:
                fastest = max(fastest, rate)
    out, begins_s = np.full(len(ignored), np.nan), 0.0
    own_r, r_w = places(0.0, p_wb, q_wb, own, of_body, r_bm), places(0.0, p_wb, q_wb, now, of_body, r_bm)
    if fastest > 0.0:
        piece_s = 2.0 * math.pi / PIECES / fastest
        for _ in range(PIECES):
            own_then = places(begins_s + piece_s, p_wb, q_wb, own, of_body, r_bm)
            then = places(begins_s + piece_s, p_wb, q_wb, now, of_body, r_bm)
            _meet(own_r, (own_then - own_r) / piece_s, r_w, (then - r_w) / piece_s, cylinder, of_body, ignored, begins_s, piece_s, out)
            own_r, r_w, begins_s = own_then, then, begins_s + piece_s
    _meet(own_r, own[of_body], r_w, now[of_body], cylinder, of_body, ignored, begins_s, math.inf, out)
    return out
