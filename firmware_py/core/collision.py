"""Time to collision of each body with the others, if all moved on as they do now: a figure of the health (`collision_s`).

A hull counts as a sphere whose radius is half the diagonal of the hull seen from above: level hulls cannot touch before these do.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numba import njit

from firmware_py.core.body import Body
from firmware_py.core.rotations import V, to_matrix
from firmware_py.core.types import Estimate

CLOSING_M_S = 0.08
"""Speed at which a module must itself move towards another to count as closing in. A hull bears a slower bump (docks touch at up to
0.06), and a body may pass close by another slowly."""


def times_to_collision(
    bodies: Sequence[Body], estimates: Mapping[int, Estimate], docking: Collection[tuple[int, int]] = ()
) -> dict[int, float]:
    """Time in which each body reaches another that it moves towards, s, by its number; NaN if there is none, 0 if it is there already.

    Args:
        estimates: by number of the body. A body whose place is unknown is left out.
        docking: numbers of the bodies of each dock under way: these are to touch.
    """
    placed = [body for body in bodies if estimates[body.index].placed]
    times = dict.fromkeys((body.index for body in bodies), math.nan)
    if len(placed) < 2:
        return times
    numbers = [body.index for body in placed]
    ignored = np.eye(len(placed), dtype=np.bool_)
    for pair in docking:
        if set(pair) <= set(numbers):
            a, b = map(numbers.index, pair)
            ignored[a, b] = ignored[b, a] = True
    motions = [_motion(*estimates[body.index][:3], body.r_bm) for body in placed]
    r_w, v_w = (np.concatenate(arrays) for arrays in zip(*motions, strict=True))
    radius_m = np.concatenate([body.radius_m for body in placed])
    of_body = np.repeat(np.arange(len(placed)), [len(body.modules) for body in placed])
    return times | dict(zip(numbers, _soonest(r_w, v_w, radius_m, of_body, ignored).tolist(), strict=True))


@njit(f"Tuple((float64[:,::1],float64[:,::1]))({V},{V},{V},float64[:,::1])", cache=True)
def _motion(p_wb, q_wb, nu, r_bm):  # type: ignore[no-untyped-def]
    """(m, 3) places of a body's modules, m, and (m, 3) their velocities, m/s, world."""
    r_wb = to_matrix(q_wb)
    r_w, v_w = np.empty_like(r_bm), np.empty_like(r_bm)
    for m in range(r_bm.shape[0]):
        x, y, z = r_bm[m]
        vx, vy, vz = nu[0] + nu[4] * z - nu[5] * y, nu[1] + nu[5] * x - nu[3] * z, nu[2] + nu[3] * y - nu[4] * x
        for k in range(3):
            r_w[m, k] = p_wb[k] + r_wb[k, 0] * x + r_wb[k, 1] * y + r_wb[k, 2] * z
            v_w[m, k] = r_wb[k, 0] * vx + r_wb[k, 1] * vy + r_wb[k, 2] * vz
    return r_w, v_w


@njit(f"float64[:](float64[:,::1],float64[:,::1],{V},int64[::1],boolean[:,::1])", cache=True)
def _soonest(r_w, v_w, radius_m, of_body, ignored):  # type: ignore[no-untyped-def]
    """(b,) the least time to collision over all pairs of modules of two bodies: the first root of |d + w t| = the sum of the radii."""
    out = np.full(ignored.shape[0], np.nan)
    for i in range(of_body.size):
        for j in range(of_body.size):
            if ignored[of_body[i], of_body[j]]:
                continue
            square = speed2 = closing = own = 0.0
            for k in range(3):
                d, w = r_w[j, k] - r_w[i, k], v_w[j, k] - v_w[i, k]
                square, speed2, closing, own = square + d * d, speed2 + w * w, closing - d * w, own + d * v_w[i, k]
            excess = square - (radius_m[i] + radius_m[j]) ** 2
            under_root = closing * closing - speed2 * excess
            if not (closing > 0.0 and own > CLOSING_M_S * math.sqrt(square) and (excess <= 0.0 or under_root >= 0.0)):
                continue  # they part, or pass each other, or only the other one moves
            time_s = 0.0 if excess <= 0.0 else excess / (closing + math.sqrt(under_root))
            if not time_s >= out[of_body[i]]:
                out[of_body[i]] = time_s
    return out
