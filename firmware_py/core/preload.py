"""Preload: thrusters of one module pushing against each other, with no net wrench, so that small forces stay clear of the
deadband.

Computed when a body is made or a thruster is lost; the allocator adds it to every result.
"""

from __future__ import annotations

import numpy as np

from firmware_py.core.body import RANK_TOLERANCE, ThrusterSet, rank_by

DIRECTIONS = 720
"""Directions tried in the null space; half a degree apart where it is a plane."""
TIE = 1e-9
"""Relative tolerance within which directions count as equally good: rounding."""
UNEVEN = 5.0
"""Limit of a module's largest preload force, as a multiple of `smallest_n`."""


def preload(
    thrusters: ThrusterSet, alive: np.ndarray, smallest_n: float, before: tuple[np.ndarray, np.ndarray] | None = None
) -> np.ndarray:
    """(n,) forces with no net wrench, N: each thruster that can be is at least `smallest_n` from zero, as far as UNEVEN permits, and no
    force is larger than needed.

    Args:
        alive: (n,) bool, thrusters that may be used.
        smallest_n: wanted distance from zero; 0 gives no preload.
        before: `alive` and result of an earlier call; modules with the same thrusters as then keep their forces.
    """
    forces = np.zeros(thrusters.f_max.size)
    changed = np.unique(thrusters.module)
    if before is not None:
        forces, changed = before[1].copy(), np.unique(thrusters.module[alive != before[0]])
    if smallest_n > 0.0:
        for module in changed:
            mine = thrusters.module == module
            forces[mine] = 0.0
            index = np.flatnonzero(mine & alive)
            forces[index] = _of_module(thrusters.matrix[:, index], smallest_n)
    return forces


def _of_module(matrix: np.ndarray, smallest_n: float) -> np.ndarray:
    """(k,) forces of the k thrusters whose wrenches are the columns of `matrix` (6, k)."""
    _, values, rows = np.linalg.svd(matrix)
    rank = rank_by(values)
    if rank == matrix.shape[1]:
        return np.zeros(rank)
    null = _settled(rows[rank:].T)
    reachable = np.linalg.norm(null, axis=1) > RANK_TOLERANCE
    candidates = null @ _directions(null.shape[1])
    sizes = np.abs(candidates[reachable])
    evenness = sizes.min(axis=0) / sizes.max(axis=0)
    best = int(np.argmax(evenness >= (1.0 - TIE) * evenness.max()))  # the first of equally good ones
    scale = min(smallest_n / max(sizes[:, best].min(), 1e-12), UNEVEN * smallest_n / sizes[:, best].max())
    return np.asarray(candidates[:, best] * scale)


def _settled(basis: np.ndarray) -> np.ndarray:
    """(k, d) orthonormal basis of the same space, independent of how the processor's LAPACK turned `basis`: Gram-Schmidt on the projections
    of the thrusters' own axes pushing backwards, each time the first that is longer than half the longest.
    """
    left, found = -basis @ basis.T, []
    for _ in range(basis.shape[1]):
        lengths = np.linalg.norm(left, axis=0)
        column = left[:, np.argmax(lengths > 0.5 * lengths.max())]
        found.append(column / np.linalg.norm(column))
        left = left - np.outer(found[-1], found[-1] @ left)
    return np.array(found).reshape(-1, basis.shape[0]).T


def _directions(dimension: int) -> np.ndarray:
    """(dimension, DIRECTIONS) unit vectors: half a turn in a plane, a seeded random draw in more dimensions, one vector on a line."""
    if dimension == 1:
        return np.ones((1, 1))
    if dimension == 2:
        angle = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        return np.stack([np.cos(angle), np.sin(angle)])
    draw = np.random.default_rng(0).normal(size=(dimension, DIRECTIONS))
    return np.asarray(draw / np.linalg.norm(draw, axis=0))
