"""Straight ways of bodies that dock or part: whether a way leads too near another body, or two docks lead to the same place."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from firmware_py.core.body import Body
from firmware_py.core.docking_plan import DockPlan, UndockPlan, module_in, pose_of
from firmware_py.core.names import name_module
from firmware_py.core.rotations import V, conjugate, difference, exp, multiply, normalise, rotate, to_matrix
from firmware_py.core.types import Estimate
from firmware_py.description.parameters import Docking

WAY_SAMPLES = 65
"""Samples on the part of a way where the bodies are near each other."""
WAY_SLACK = 0.25
"""Share of the stand-off by which a way may come nearer to another body than its ends, as long as level cubes still clear each other."""
WAY_NOISE_M = 0.005
"""Noise of the estimates: coming nearer by less than this does not count."""
SQUARE_DIAGONAL, CUBE_DIAGONAL = 2.0**0.5, 3.0**0.5
"""Distance of the centres beyond which two cubes of edge 1 cannot touch: level cubes side by side; cubes at any attitude."""
BOTH_ENDS, BEGINNING = (0, -1), (0,)
"""Ends of a way whose nearness to another body is accepted. A body that docks begins wherever it is, and must end close to its target;
nearness to a third body is accepted at the beginning only."""


class Way(NamedTuple):
    """Straight way of one body, which turns at a constant rate along it."""

    body: Body
    p_begin: np.ndarray
    """(3,) start of its centre of mass, world, m; `p_end` and `q_end` likewise."""
    q_begin: np.ndarray
    """(4,) body to world."""
    p_end: np.ndarray
    q_end: np.ndarray
    pitch_m: float
    """Edge of a lattice cell."""

    def at(self, shares: Sequence[float]) -> np.ndarray:
        """(k, m, 3) centres of its modules, world, m, at each of k shares (0 to 1) of the way."""
        turn = difference(self.q_end, self.q_begin)
        turned = _turned(self.q_begin, turn, np.array(shares))
        centres = self.p_begin + np.outer(shares, self.p_end - self.p_begin)
        return np.asarray(centres[:, None] + self.body.r_bm @ turned.transpose(0, 2, 1))


@njit(f"float64[:,:,::1]({V},{V},{V})", cache=True)
def _turned(q, turn, shares):  # type: ignore[no-untyped-def]
    """(k, 3, 3) body to world, for an attitude (4,) turned by each of k shares of a rotation vector (3,)."""
    out = np.empty((shares.size, 3, 3))
    for i in range(shares.size):
        out[i] = to_matrix(multiply(q, exp(shares[i] * turn)))
    return out


def way_of_active(plan: DockPlan, active: Body, at: Estimate, target: Body, target_at: Estimate, gap_m: float) -> Way:
    """The active body's way from where it is to a gap before the target's face."""
    r_a, q_a = module_in(active, plan.request.module)
    p_t, q_t = pose_of(target_at, *module_in(target, plan.request.target_module))
    q_end = normalise(multiply(multiply(q_t, plan.q_ta), conjugate(q_a)))
    p_end = p_t + rotate(q_t, plan.place_t + plan.axis_t * gap_m) - rotate(q_end, r_a)
    return Way(active, at.p_wb, at.q_wb, p_end, q_end, plan.pitch_m)


def way_of_target(plan: DockPlan, active: Way, target: Body, target_at: Estimate) -> Way:
    """The way of a target that comes half the way to meet the active body."""
    module = active.body.modules.index(plan.request.module)
    begin, end = active.at((0.0, 1.0))[:, module]
    met_w = 0.5 * (begin - end)
    return Way(target, target_at.p_wb, target_at.q_wb, target_at.p_wb + met_w, target_at.q_wb, active.pitch_m)


def way_of_piece(plan: UndockPlan, piece: Body, whole: Body, at: Estimate, by_w: np.ndarray) -> Way:
    """The way of a piece that is undocked from a body: by `by_w` (3,), world, m, from where the body holds it."""
    module, opens = piece.modules[0], plan.opens[0]
    pitch_m = float(np.linalg.norm(module_in(whole, opens.module)[0] - module_in(whole, opens.target_module)[0]))
    p_w, q_w = pose_of(at, *module_in(whole, module))
    r_b, q_b = module_in(piece, module)
    q_wb = normalise(multiply(q_w, conjugate(q_b)))
    p_wb = p_w - rotate(q_wb, r_b)
    return Way(piece, p_wb, q_wb, p_wb + by_w, q_wb, pitch_m)


def nearest_pass(way: Way, other: Body, other_at: Estimate, slack_m: float, near: Sequence[int] = BOTH_ENDS) -> int | None:
    """Nearest module of the other body among those that a way comes too near to; None if there is none.

    Too near means nearer than at the ends `near` and, besides, either so near that even level cubes may touch; or so near that turned
    cubes may touch, and nearer than at those ends by more than `slack_m`.
    """
    apart_m = CUBE_DIAGONAL * way.pitch_m + sum(float(np.linalg.norm(body.r_bm, axis=1).max()) for body in (way.body, other))
    shares = _near_part(way.p_begin - other_at.p_wb, way.p_end - way.p_begin, apart_m)
    if not shares:
        return None
    others = other_at.p_wb + other.r_bm @ to_matrix(other_at.q_wb).T
    gaps = np.linalg.norm(way.at(shares)[:, :, None] - others, axis=-1)
    least, ends = gaps.min(axis=0), gaps[list(near)].min(axis=0)
    limit = np.minimum(CUBE_DIAGONAL * way.pitch_m, np.maximum(ends - slack_m, SQUARE_DIAGONAL * way.pitch_m))
    touching = (least < ends - WAY_NOISE_M) & (least < limit)
    return other.modules[int(np.where(touching, least, np.inf).min(axis=0).argmin())] if touching.any() else None


def first_blocking_module(way: Way, thirds: Sequence[tuple[Body, Estimate]], p: Docking, slack: float = WAY_SLACK) -> int | None:
    """A module of a third body that a way comes too near to; None if there is none. Bodies whose place is unknown are left out.

    Args:
        slack: share of the stand-off, see WAY_SLACK.
    """
    passes = (nearest_pass(way, body, at, slack * p.standoff_m, BEGINNING) for body, at in thirds if at.placed)
    return next((module for module in passes if module is not None), None)


def obstacle(
    plan: DockPlan,
    active: tuple[Body, Estimate],
    target: tuple[Body, Estimate],
    thirds: Sequence[tuple[Body, Estimate]],
    target_approaches: bool,
    p: Docking,
) -> str:
    """Reason why a straight way of the two bodies is blocked. Empty if both ways are free, or the place of either body is unknown, which
    the sequence judges.

    The target itself is no obstacle to the paper's straight approach, which leads through it from wherever it begins.

    Args:
        target_approaches: the target comes to meet the active body.
    """
    if not (active[1].placed and target[1].placed):
        return ""
    staged = p.approach == "staged"
    way = way_of_active(plan, *active, *target, p.standoff_m if staged else 0.0)
    blocker = nearest_pass(way, *target, WAY_SLACK * p.standoff_m) if staged else None
    blocker = first_blocking_module(way, thirds, p) if blocker is None else blocker
    if blocker is not None:
        return f"on its way it would come too near to {name_module(blocker)}: bring it before that face first"
    blocker = first_blocking_module(way_of_target(plan, way, *target), thirds, p) if target_approaches else None
    if blocker is None:
        return ""
    return f"{name_module(plan.request.target_module)}, which is to meet it, would come too near to {name_module(blocker)}"


def plans_conflict(plan: DockPlan, other: DockPlan) -> bool:
    """Whether both docks would bring a module to the same place, relative to a body that both include."""
    common = set(plan.merged.modules).intersection(other.merged.modules)
    if not common:
        return False
    mine, others = (_beside(each.merged, common) for each in (plan, other))
    apart_m = np.linalg.norm(mine[:, None] - others, axis=-1)
    return bool(apart_m.min() < 0.5 * plan.pitch_m)


def _beside(body: Body, common: Collection[int]) -> np.ndarray:
    """(n, 3) positions of the body's modules that are not in `common`, in the frame of the lowest-numbered one that is, m."""
    first = body.modules.index(min(common))
    places = (body.r_bm - body.r_bm[first]) @ to_matrix(np.ascontiguousarray(body.q_bm[first]))
    return np.asarray(places[[module not in common for module in body.modules]])


def _near_part(begin: np.ndarray, way: np.ndarray, apart_m: float) -> list[float]:
    """Shares to sample on a way (3,) that starts at `begin` (3,) relative to a place: both ends, and WAY_SAMPLES over the part nearer than
    `apart_m` to the place; empty if there is no such part.
    """
    length2 = max(float(way @ way), 1e-12)
    middle = -float(begin @ way) / length2
    half = math.sqrt(max(0.0, apart_m**2 - float(begin @ begin) + middle**2 * length2) / length2)
    first, last = (min(max(share, 0.0), 1.0) for share in (middle - half, middle + half))
    return [0.0, *np.linspace(first, last, WAY_SAMPLES).tolist(), 1.0] if last > first else []
