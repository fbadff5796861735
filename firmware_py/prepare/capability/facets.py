"""Facets of the zonotope of all reachable wrenches, {J f : f_min <= f <= f_max}, in six dimensions. Compiled.

Every facet's normal is orthogonal to five independent columns of J (four where J has rank 5, and so on), so the exterior
products of five columns give all normals. Any y gives a valid inequality y . w <= h(y), where h is the support; a
superfluous normal therefore does no harm.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numba import njit

from firmware_py.description.schema import DescriptionError
from firmware_py.prepare.capability.layout import Layout

MOST_SUBSETS = 3_000_000
"""More subsets of columns than this are not enumerated (52 thrusters without a parallel pair)."""

_DEPENDENT = 1e-11
"""Volume of unit columns below which they count as dependent."""

_PARALLEL = 1e-9
"""Component of a wrench along a normal, as a share of the wrench's size, below which the facet does not bound it."""


def _wedge_table() -> tuple[np.ndarray, np.ndarray]:
    """Terms (n, 4) of blade ^ vector for grades 0..4 in six dimensions, and (6,) where each grade begins.

    A term is source, axis, target, sign. Components of a blade of grade k are numbered by the k-subsets of the axes in
    lexicographic order.
    """
    terms: list[tuple[int, int, int, int]] = []
    start = [0]
    for grade in range(5):
        number = {s: i for i, s in enumerate(itertools.combinations(range(6), grade + 1))}
        for source, subset in enumerate(itertools.combinations(range(6), grade)):
            for axis in range(6):
                if axis not in subset:
                    behind = sum(1 for a in subset if a > axis)
                    terms.append((source, axis, number[tuple(sorted((*subset, axis)))], (-1) ** behind))
        start.append(len(terms))
    return np.array(terms, dtype=np.int64), np.array(start, dtype=np.int64)


_TERMS, _START = _wedge_table()


@njit("void(int64[:,::1], int64[::1], int64, float64[::1], float64[::1], float64[::1])", cache=True)
def _wedge(terms, start, grade, blade, vector, out):  # type: ignore[no-untyped-def]
    """out = blade ^ vector; blade has `grade`, all three arrays have room for 20 components (vector six)."""
    out[:] = 0.0
    for t in range(start[grade], start[grade + 1]):
        out[terms[t, 2]] += terms[t, 3] * blade[terms[t, 0]] * vector[terms[t, 1]]


@njit("int64(int64[:,::1], int64[::1], float64[:,::1], float64[:,::1], float64, float64[:,::1])", cache=True)
def _normals(terms, start, forced, columns, smallest, out):  # type: ignore[no-untyped-def]
    """Unit normals of all hyperplanes through `forced` and 5 - len(forced) of `columns`; number written to `out`.

    Args:
        forced: (f, 6) orthonormal, in every hyperplane.
        columns: (n, 6) unit vectors.
        smallest: volume below which columns are dependent.
    """
    n, f = columns.shape[0], forced.shape[0]
    need = 5 - f
    blades = np.zeros((6, 20))
    blades[0, 0] = 1.0
    for k in range(f):
        _wedge(terms, start, k, blades[k], forced[k], blades[k + 1])
    chosen = np.zeros(6, dtype=np.int64)
    chosen[0] = -1
    depth, written = 0, 0
    if need == 0:
        for axis in range(6):
            out[0, axis] = (1.0 if axis % 2 == 0 else -1.0) * blades[5, 5 - axis]
        return 1
    while depth >= 0:
        chosen[depth] += 1
        if chosen[depth] > n - (need - depth):
            depth -= 1
            continue
        grade = f + depth
        _wedge(terms, start, grade, blades[grade], columns[chosen[depth]], blades[grade + 1])
        size = 0.0
        for i in range(20):
            size += blades[grade + 1, i] ** 2
        size = math.sqrt(size)
        if size < smallest:
            continue
        if depth < need - 1:
            chosen[depth + 1] = chosen[depth]
            depth += 1
            continue
        # Hodge dual: component number i of grade 5 lacks axis 5 - i.
        for axis in range(6):
            sign = 1.0 if axis % 2 == 0 else -1.0
            out[written, axis] = sign * blades[5, 5 - axis] / size
        written += 1
    return written


@njit("void(float64[:,::1], float64[:,::1], float64[::1], float64[::1], int64, float64[:,::1])", cache=True)
def _supports(normals, columns, f_min, f_max, dead, out):  # type: ignore[no-untyped-def]
    """Supports along +y and -y, out (m, 2), minus the `dead` largest contributions of single thrusters."""
    n = columns.shape[0]
    largest = np.zeros((2, dead + 1))
    for m in range(normals.shape[0]):
        for side in range(2):
            out[m, side] = 0.0
            largest[side, :] = 0.0
        for i in range(n):
            along = 0.0
            for axis in range(6):
                along += normals[m, axis] * columns[i, axis]
            for side in range(2):
                value = max(f_max[i] * along, f_min[i] * along)
                out[m, side] += value
                k = dead - 1
                while k >= 0 and value > largest[side, k]:
                    largest[side, k + 1] = largest[side, k]
                    largest[side, k] = value
                    k -= 1
                along = -along
        for side in range(2):
            for k in range(dead):
                out[m, side] -= largest[side, k]
            out[m, side] = max(out[m, side], 0.0)


@njit("void(float64[:,::1], float64[:,::1], float64[:,::1], float64, float64[::1])", cache=True)
def _reach(normals, supports, wrenches, tiny, out):  # type: ignore[no-untyped-def]
    """Largest factor of each wrench (k, 6) that stays inside, (k,)."""
    for k in range(wrenches.shape[0]):
        best = math.inf
        for m in range(normals.shape[0]):
            along = 0.0
            for axis in range(6):
                along += normals[m, axis] * wrenches[k, axis]
            if along > tiny:
                best = min(best, supports[m, 0] / along)
            elif along < -tiny:
                best = min(best, -supports[m, 1] / along)
        out[k] = best


def subsets(layout: Layout) -> int:
    """Number of subsets of columns to enumerate for the facets of a layout."""
    forced = 6 - layout.rank
    return math.comb(len(_distinct(layout)), 5 - forced) if forced <= 5 else 0


def normals_of(layout: Layout) -> np.ndarray:
    """(m, 6) normals of all facets, one of each antipodal pair, some more than once; force per N, torque per N m.

    Their torque part is scaled so that normals . wrench is in N.

    Raises:
        DescriptionError: more than MOST_SUBSETS subsets.
    """
    if subsets(layout) > MOST_SUBSETS:
        raise DescriptionError(f"{layout.name}: {layout.count} thrusters are too many for facets")
    columns = _distinct(layout)
    left = np.linalg.svd(layout.scaled)[0][:, layout.rank :]
    out = np.zeros((max(subsets(layout), 1), 6))
    count = _normals(_TERMS, _START, np.ascontiguousarray(left.T), columns, _DEPENDENT, out)
    found = out[:count]
    found /= layout.levers
    return np.ascontiguousarray(found)


def supports_of(layout: Layout, normals: np.ndarray, dead: int = 0) -> np.ndarray:
    """(m, 2) support along each normal and against it, N, without the `dead` thrusters that contribute most there."""
    out = np.zeros((len(normals), 2))
    columns = np.ascontiguousarray(layout.matrix.T)
    _supports(normals, columns, layout.f_min, layout.f_max, min(dead, layout.count), out)
    return out


def reach(layout: Layout, normals: np.ndarray, supports: np.ndarray, wrenches: np.ndarray) -> np.ndarray:
    """(k,) largest factor of each of (k, 6) wrenches, which must lie in the layout's span."""
    out = np.zeros(len(wrenches))
    lever = layout.lever_m
    for k, wrench in enumerate(np.ascontiguousarray(wrenches, dtype=float)):
        size = float(np.linalg.norm(wrench[:3]) + np.linalg.norm(wrench[3:]) / lever)
        _reach(normals, supports, wrench[None], _PARALLEL * size, out[k : k + 1])
    return out


def _distinct(layout: Layout) -> np.ndarray:
    """(n, 6) unit columns, torque scaled by the lever arm, without parallel duplicates and thrusters that give no force."""
    columns = layout.scaled.T[(layout.f_max > 0.0) | (layout.f_min < 0.0)]
    sizes = np.linalg.norm(columns, axis=1, keepdims=True)
    unit = columns[sizes[:, 0] > 0.0] / sizes[sizes[:, 0] > 0.0]
    leading = np.argmax(np.abs(unit) > 1e-6, axis=1)
    unit = unit * np.sign(unit[np.arange(len(unit)), leading])[:, None]
    _, where = np.unique(np.round(unit, 9), axis=0, return_index=True)
    return np.ascontiguousarray(unit[np.sort(where)])
