"""The pairs of faces that the docking detector watches, as rows of one array, and the compiled pass over all of them.

Evaluates the two conditions of each pair and debounces them. Part of `docking_detector`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numba import njit

from firmware_py.core.rotations import multiply, to_matrix
from firmware_py.core.types import NEVER_NS

PICTURES = 32
"""Relative positions kept of each pair: their mean distinguishes a locked pair from one that jammed 4 mm short of locking."""
TURNED_TRACE = 1.0 + 2.0 * math.cos(math.radians(15.0))
"""Trace of a 15 degree rotation. If the measured relative attitude is farther off the docked one, a tag was read flipped."""
CURRENT, POSITION = 0, 1
"""The two conditions, as columns of a pair's row."""

CLOSED, LOOSE, APART = 0, 1, 2
"""State of a joint: nothing indicates that it is open; one condition does and the other does not; all fresh measurements do."""

PAIR = np.dtype(
    [
        ("module", np.int64, 2),  # fleet index of module a, of module b; sides a and b in `face` and the currents too
        ("face", np.int64, 2),
        ("offset_a", np.float64, 3),  # desired centre of b in the frame of a, m
        ("turn_a", np.float64, 9),  # desired attitude of b in the frame of a: rotation matrix, row by row
        ("holds", np.int64, 2),  # each condition, debounced
        ("candidate_ns", np.int64, 2),  # since when measurements contradict `holds`; NEVER_NS: they agree
        ("current_ma", np.float64, 2),
        ("current_ns", np.int64, 2),
        ("pictures", np.int64),  # relative positions since the last gap
        ("picture_ns", np.int64),
        ("near_ns", np.int64),  # time of the newest picture whose position error is at most `open_m`
        ("error_m", np.float64),
        ("spread_m", np.float64),
        ("open", np.int64),  # CLOSED, LOOSE or APART
    ],
    align=True,
)
"""One pair of faces in one tick; see PairStatus for the fields without a comment."""


class Limits(NamedTuple):
    """Limits of the two conditions, from the parameters."""

    threshold_ma: float
    current_hysteresis_ma: float
    near_m: float
    settled_m: float
    position_hysteresis_m: float
    open_m: float
    debounce_ns: int
    current_fresh_ns: int
    pose_fresh_ns: int


TABLE, FIRST, SEEN = numba.float64[:, ::1], numba.int64[::1], numba.int64[:, ::1]
ROW = numba.from_dtype(PAIR)
LIMITS = numba.typeof(Limits(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0))  # type: ignore[no-untyped-call]
"""Types of the compiled functions' arguments: `poses` of docking_detector.Sightings, its `first` and `seen`, one PAIR, and the limits."""


@njit(numba.void(ROW, numba.int64, numba.boolean, numba.int64, numba.int64), cache=True)
def _debounce(row, which, seen, time_ns, after_ns):  # type: ignore[no-untyped-def]
    """Debounces a condition: what a fresh measurement says of it (`seen`) holds once nothing else was seen for `after_ns`."""
    if seen == (row.holds[which] != 0):
        row.candidate_ns[which] = NEVER_NS
        return
    if row.candidate_ns[which] == NEVER_NS:
        row.candidate_ns[which] = time_ns
    if time_ns - row.candidate_ns[which] >= after_ns:
        row.holds[which], row.candidate_ns[which] = seen, NEVER_NS


@njit(numba.void(ROW, numba.int64), cache=True)
def _clear_condition(row, which):  # type: ignore[no-untyped-def]
    """Clears a condition that no fresh measurement supports any longer."""
    row.holds[which], row.candidate_ns[which] = 0, NEVER_NS


@njit(cache=True)
def _take_currents(row, heard_ma, time_ns, limits):  # type: ignore[no-untyped-def]
    """Updates condition 1 by the currents of this tick; returns whether the newest currents are fresh."""
    heard = False
    for side in range(2):
        value = heard_ma[row.module[side], row.face[side]]
        if not math.isnan(value):
            row.current_ma[side], row.current_ns[side], heard = value, time_ns, True
    if min(row.current_ns[0], row.current_ns[1]) == NEVER_NS:
        return False
    weaker = min(abs(row.current_ma[0]), abs(row.current_ma[1]))
    if heard:
        threshold = limits.threshold_ma - (limits.current_hysteresis_ma if row.holds[CURRENT] else 0.0)
        _debounce(row, CURRENT, weaker > threshold, time_ns, limits.debounce_ns)
    fresh = time_ns - min(row.current_ns[0], row.current_ns[1]) <= limits.current_fresh_ns
    if not fresh:
        _clear_condition(row, CURRENT)
    return fresh


@njit(cache=True)
def _same_picture(first, seen, a, b):  # type: ignore[no-untyped-def]
    """Indices of the sightings of modules a and b in the newest picture that shows both; -1, -1 without one."""
    for i in range(first[a + 1] - 1, first[a] - 1, -1):
        for j in range(first[b + 1] - 1, first[b] - 1, -1):
            if seen[i, 1] == seen[j, 1]:
                return i, j
    return -1, -1


@njit(cache=True)
def _judge_ring(row, ring):  # type: ignore[no-untyped-def]
    """Sets `error_m`, distance of the mean from the desired position, and `spread_m`, distance of the means of the two newest quarters."""
    n, oldest, quarter = PICTURES, row.pictures, PICTURES // 4
    off, moved = 0.0, 0.0
    for axis in range(3):
        mean, older, newer = 0.0, 0.0, 0.0
        for i in range(n):
            mean += ring[i, axis] / n
        for i in range(quarter):
            older += ring[(oldest + n - 2 * quarter + i) % n, axis] / quarter
            newer += ring[(oldest + n - quarter + i) % n, axis] / quarter
        off += (mean - row.offset_a[axis]) ** 2
        moved += (newer - older) ** 2
    row.error_m, row.spread_m = math.sqrt(off), math.sqrt(moved)


@njit(cache=True)
def _as_turned(row, poses, i, j):  # type: ignore[no-untyped-def]
    """Whether two sightings have the relative attitude that the modules have when docked.

    A tag that is seen from 45 degrees and read flipped is off by a quarter turn, which is a lattice rotation too.
    """
    trace = 0.0
    for a in range(3):
        for b in range(3):
            for k in range(3):
                trace += row.turn_a[3 * a + b] * poses[i, 3 + 3 * k + a] * poses[j, 3 + 3 * k + b]
    return trace > TURNED_TRACE


@njit(cache=True)
def _take_pose(row, ring, first, seen, poses, time_ns, limits):  # type: ignore[no-untyped-def]
    """Updates condition 2 by the pictures of this tick; returns whether the newest picture is fresh."""
    i, j = _same_picture(first, seen, row.module[0], row.module[1])
    if i >= 0 and _as_turned(row, poses, i, j):
        here, off = ring[row.pictures % PICTURES], 0.0
        for axis in range(3):
            here[axis] = 0.0
            for k in range(3):
                here[axis] += poses[i, 3 + 3 * k + axis] * (poses[j, k] - poses[i, k])
            off += (here[axis] - row.offset_a[axis]) ** 2
        row.pictures += 1
        row.picture_ns = seen[i, 1]
        if math.sqrt(off) <= limits.open_m:
            row.near_ns = row.picture_ns
        if row.pictures >= PICTURES:
            _judge_ring(row, ring)
            slack = limits.position_hysteresis_m if row.holds[POSITION] else 0.0
            near = row.error_m < limits.near_m + slack and row.spread_m < limits.settled_m + slack
            _debounce(row, POSITION, near, time_ns, limits.debounce_ns)
    fresh = time_ns - row.picture_ns <= limits.pose_fresh_ns
    if not fresh:
        _clear_condition(row, POSITION)
        row.pictures, row.error_m, row.spread_m = 0, math.nan, math.nan
    return fresh


@njit(numba.void(ROW[::1], numba.float64[:, :, ::1], TABLE, FIRST, SEEN, TABLE, numba.int64, LIMITS), cache=True)
def watch(rows, rings, heard_ma, first, seen, poses, time_ns, limits):  # type: ignore[no-untyped-def]
    """Advances all pairs to this tick.

    Args:
        rows: (k,) PAIR; rings: (k, PICTURES, 3) relative positions, module b in the frame of a.
        heard_ma: (m, 6) currents received, per module and face, NaN where none came; reset to NaN afterwards.
        first, seen, poses: docking_detector.Sightings.
    """
    for k in range(rows.shape[0]):
        row = rows[k]
        fresh_current = _take_currents(row, heard_ma, time_ns, limits)
        fresh_pose = _take_pose(row, rings[k], first, seen, poses, time_ns, limits)
        weak = fresh_current and row.holds[CURRENT] == 0 and row.candidate_ns[CURRENT] == NEVER_NS
        far = fresh_pose and row.error_m > limits.open_m
        row.open = CLOSED
        if weak or far:
            row.open = LOOSE if (fresh_current and not weak) or (fresh_pose and not far) else APART
    heard_ma[:] = math.nan


@njit(numba.void(TABLE, FIRST, SEEN, TABLE), cache=True)
def place_modules(tags, first, seen, poses):  # type: ignore[no-untyped-def]
    """Writes `first` and `poses` of docking_detector.Sightings.

    Args:
        tags: (s, 14) per sighting the tag's position and attitude in the world, its position in its module, and the quaternion from
            module frame to tag frame.
    """
    i = 0
    for module in range(first.shape[0]):
        first[module] = i
        while i < seen.shape[0] and seen[i, 0] == module:
            tag = tags[i]
            turn = to_matrix(multiply(tag[3:7], tag[10:14]))
            for k in range(3):
                poses[i, k] = tag[k] - turn[k, 0] * tag[7] - turn[k, 1] * tag[8] - turn[k, 2] * tag[9]
                poses[i, 3 + 3 * k : 6 + 3 * k] = turn[k]
            i += 1
