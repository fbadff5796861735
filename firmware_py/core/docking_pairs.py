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
KEPT = 16
"""Newest pictures of each module, kept until the other module of a pair is seen in them too: those of two cameras at 60 Hz for 130 ms."""
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


TAKEN, POSES = numba.int64[:, ::1], numba.float64[:, :, ::1]
ROW = numba.from_dtype(PAIR)
LIMITS = numba.typeof(Limits(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0))  # type: ignore[no-untyped-call]
"""Types of the compiled functions' arguments: `taken_ns` and `poses` of docking_detector.ModulePoses, one PAIR, and the limits."""


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
def _same_picture(taken_ns, a, b, after_ns):  # type: ignore[no-untyped-def]
    """Places, in `taken_ns`, of the newest picture after `after_ns` that shows both modules a and b; -1, -1 without one."""
    at_a, at_b = -1, -1
    for i in range(KEPT):
        if taken_ns[a, i] > after_ns:
            for j in range(KEPT):
                if taken_ns[b, j] == taken_ns[a, i]:
                    at_a, at_b, after_ns = i, j, taken_ns[a, i]
    return at_a, at_b


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
def _as_turned(row, pose_a, pose_b):  # type: ignore[no-untyped-def]
    """Whether two poses (12,) have the relative attitude that the modules have when docked.

    A tag that is seen from 45 degrees and read flipped is off by a quarter turn, which is a lattice rotation too.
    """
    trace = 0.0
    for a in range(3):
        for b in range(3):
            for k in range(3):
                trace += row.turn_a[3 * a + b] * pose_a[3 + 3 * k + a] * pose_b[3 + 3 * k + b]
    return trace > TURNED_TRACE


@njit(cache=True)
def _take_pose(row, ring, taken_ns, poses, time_ns, limits):  # type: ignore[no-untyped-def]
    """Updates condition 2 by the newest picture of both modules; returns whether the newest one that was used is fresh."""
    a, b = row.module
    i, j = _same_picture(taken_ns, a, b, max(row.picture_ns, time_ns - limits.pose_fresh_ns - 1))
    if i >= 0 and _as_turned(row, poses[a, i], poses[b, j]):
        here, off = ring[row.pictures % PICTURES], 0.0
        for axis in range(3):
            here[axis] = 0.0
            for k in range(3):
                here[axis] += poses[a, i, 3 + 3 * k + axis] * (poses[b, j, k] - poses[a, i, k])
            off += (here[axis] - row.offset_a[axis]) ** 2
        row.pictures += 1
        row.picture_ns = taken_ns[a, i]
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


@njit(numba.void(ROW[::1], numba.float64[:, :, ::1], numba.float64[:, ::1], TAKEN, POSES, numba.int64, LIMITS), cache=True)
def watch(rows, rings, heard_ma, taken_ns, poses, time_ns, limits):  # type: ignore[no-untyped-def]
    """Advances all pairs to this tick.

    Args:
        rows: (k,) PAIR; rings: (k, PICTURES, 3) relative positions, module b in the frame of a.
        heard_ma: (m, 6) currents received, per module and face, NaN where none came; reset to NaN afterwards.
        taken_ns, poses: of docking_detector.ModulePoses.
    """
    for k in range(rows.shape[0]):
        row = rows[k]
        fresh_current = _take_currents(row, heard_ma, time_ns, limits)
        fresh_pose = _take_pose(row, rings[k], taken_ns, poses, time_ns, limits)
        weak = fresh_current and row.holds[CURRENT] == 0 and row.candidate_ns[CURRENT] == NEVER_NS
        far = fresh_pose and row.error_m > limits.open_m
        row.open = CLOSED
        if weak or far:
            row.open = LOOSE if (fresh_current and not weak) or (fresh_pose and not far) else APART
    heard_ma[:] = math.nan


@njit(numba.void(numba.float64[:, ::1], TAKEN, TAKEN, POSES), cache=True)
def keep_poses(tags, seen, taken_ns, poses):  # type: ignore[no-untyped-def]
    """Writes the poses of modules into `taken_ns` and `poses` of docking_detector.ModulePoses, each in the place of the same picture, or
    else of the oldest.

    Args:
        tags: (s, 14) per observation the tag's position and attitude in the world, its position in its module, and the quaternion from
            module frame to tag frame.
        seen: (s, 2) module, and capture time of the picture, ns.
    """
    for k in range(tags.shape[0]):
        tag, m, at = tags[k], seen[k, 0], 0
        for i in range(KEPT):
            if taken_ns[m, i] == seen[k, 1]:
                at = i
                break
            if taken_ns[m, i] < taken_ns[m, at]:
                at = i
        taken_ns[m, at] = seen[k, 1]
        turn = to_matrix(multiply(tag[3:7], tag[10:14]))
        for axis in range(3):
            poses[m, at, axis] = tag[axis] - turn[axis, 0] * tag[7] - turn[axis, 1] * tag[8] - turn[axis, 2] * tag[9]
            poses[m, at, 3 + 3 * axis : 6 + 3 * axis] = turn[axis]
