"""Detects whether two faces are docked: both conditions of the paper, on fresh measurements only.

Condition 1: the current of both magnets is beyond +-70 mA. Condition 2: the relative position is one lattice pitch and settled. The
relative pose comes from tags of both modules seen in the same picture, never from a propagated state.

All watched pairs are rows of one array, served by one compiled pass per tick.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.docking_pairs import KEPT, PAIR, PICTURES, Limits, keep_poses, watch
from firmware_py.core.rotations import conjugate, multiply, rotate_back, to_matrix
from firmware_py.core.types import FACES, NEVER_NS, ModuleInputs
from firmware_py.description.parameters import Docking


class FacePair(NamedTuple):
    """Two faces that may meet: fleet indices of their modules, and the pose that b should have in the frame of a."""

    module_a: int
    face_a: int
    module_b: int
    face_b: int
    offset_a: np.ndarray
    """(3,) centre of b in the frame of a, m."""
    q_ab: np.ndarray
    """(4,) frame of b to frame of a."""


class PairStatus(NamedTuple):
    """State of one pair in this tick."""

    current: bool
    """Condition 1 holds, debounced."""
    position: bool
    """Condition 2 holds, debounced."""
    position_error_m: float
    """Distance of the mean relative position from one pitch; NaN without fresh pictures."""
    spread_m: float
    """Distance between the means of the two newest quarters of the pictures; compared with `settled_m`."""

    @property
    def docked(self) -> bool:
        """Whether both hold."""
        return self.current and self.position


class PairBank:
    """Watches any number of pairs of faces. `rows`, (k,) of PAIR, is their state in this tick."""

    def __init__(self, pairs: Sequence[FacePair], parameters: Docking, before: PairBank | None = None) -> None:
        """`before`: the bank that this one replaces; pairs watched by both keep their state."""
        p = parameters
        self._limits = Limits(
            p.current_threshold_ma, p.current_hysteresis_ma, p.position_tolerance_m, p.settled_m, p.hysteresis_m, p.open_m,
            round(p.debounce_ms * 1e6), round(p.current_fresh_ms * 1e6), round(p.pose_fresh_ms * 1e6),
        )  # fmt: skip
        self.rows = np.zeros(len(pairs), PAIR)
        self._rings = np.zeros((len(pairs), PICTURES, 3))
        for row, pair in zip(self.rows, pairs, strict=True):
            row["module"], row["face"] = (pair.module_a, pair.module_b), (pair.face_a, pair.face_b)
            row["offset_a"], row["turn_a"] = pair.offset_a, to_matrix(pair.q_ab).ravel()
        for time in ("candidate_ns", "current_ns", "picture_ns", "near_ns"):
            self.rows[time] = NEVER_NS
        for figure in ("current_ma", "error_m", "spread_m"):
            self.rows[figure] = np.nan
        self._watched = np.unique(self.rows["module"]).tolist()
        """Fleet indices of the modules of all pairs."""
        self._heard_ma = np.full((max(self._watched, default=-1) + 1, FACES), np.nan)
        """Currents received in this tick, by fleet index and face; NaN: none, or of a magnet that rests. `watch` resets them."""
        if before is not None:
            self._go_on(before)

    def _go_on(self, before: PairBank) -> None:
        """Copies the rows of the pairs that `before` watched too."""
        known = {key: i for i, key in enumerate(_keys(before.rows))}
        for here, key in enumerate(_keys(self.rows)):
            if key in known:
                there = known[key]
                self.rows[here], self._rings[here] = before.rows[there], before._rings[there]

    def step(
        self, time_ns: int, modules: Sequence[ModuleInputs], poses: ModulePoses, resting: Collection[tuple[int, int]] = ()
    ) -> None:
        """Advances the rows to the tick at `time_ns`, by the inputs of that tick.

        Args:
            poses: of the same modules, with those of this tick.
            resting: modules and faces whose magnets the limiter has switched off: their currents carry no information.
        """
        for m in self._watched:
            for dock in modules[m].docks:
                self._heard_ma[m, dock.first : dock.first + 3] = dock.current_ma
        for m, face in resting:
            if m in self._watched:
                self._heard_ma[m, face] = np.nan
        watch(self.rows, self._rings, self._heard_ma, poses.taken_ns, poses.poses, time_ns, self._limits)

    def status(self, i: int) -> PairStatus:
        """Status of pair `i`."""
        row = self.rows[i]
        current, position = map(bool, row["holds"].tolist())
        return PairStatus(current, position, float(row["error_m"]), float(row["spread_m"]))


class PairDetector:
    """Watches one pair of faces."""

    def __init__(self, pair: FacePair, parameters: Docking) -> None:
        self.pair = pair
        self._bank = PairBank([pair], parameters)

    def step(self, time_ns: int, modules: Sequence[ModuleInputs], poses: ModulePoses) -> PairStatus:
        """Advances to the tick at `time_ns` and returns the pair's status."""
        self._bank.step(time_ns, modules, poses)
        return self._bank.status(0)

    @property
    def currents_ma(self) -> tuple[float, float]:
        """Newest current of each face; NaN before the first."""
        a, b = self._bank.rows[0]["current_ma"].tolist()
        return a, b


TagTable = dict[tuple[int, int], np.ndarray]
"""(module, tag id) -> (7,) tag centre in the module frame, m, and quaternion from module frame to tag frame."""


class ModulePoses:
    """Poses of single modules from the newest pictures. The tags of one picture may come in different ticks, as from buses that are not
    equally fast.

    Attributes:
        taken_ns: (m, KEPT) capture time of each picture that shows a module of the fleet; NEVER_NS: none yet.
        poses: (m, KEPT, 12) the module's centre in the world, m, and its rotation matrix, row by row.
    """

    def __init__(self, tags: TagTable, modules: int) -> None:
        """`modules`: their number in the fleet."""
        self._tags = tags
        self.taken_ns = np.full((modules, KEPT), NEVER_NS)
        self.poses = np.zeros((modules, KEPT, 12))

    def take(self, modules: Sequence[ModuleInputs]) -> None:
        """Takes the observations of this tick, of all tags that are in the table."""
        seen: list[int] = []
        parts: list[np.ndarray] = []
        for i, module in enumerate(modules):
            for tag in module.tags:
                known = self._tags.get((i, tag.tag_id))
                if known is not None:
                    seen += i, tag.capture_ns
                    parts += tag.p_wt, tag.q_wt, known
        if parts:
            keep_poses(np.concatenate(parts).reshape(-1, 14), np.array(seen, dtype=np.int64).reshape(-1, 2), self.taken_ns, self.poses)


def _keys(rows: np.ndarray) -> list[tuple[int, ...]]:
    """Returns the fleet indices of the two modules of each row: two modules have at most one pair of faces."""
    return [tuple(pair) for pair in rows["module"].tolist()]


def tag_table(bodies: Sequence[Body]) -> TagTable:
    """Poses of the tags of every module in its module frame."""
    table: TagTable = {}
    for body in bodies:
        for k, tag in enumerate(body.tag_ids):
            i = int(body.tag_module[k])
            q_bm = np.ascontiguousarray(body.q_bm[i])
            r_mt = rotate_back(q_bm, body.r_bt[k] - body.r_bm[i])
            q_tm = multiply(conjugate(np.ascontiguousarray(body.q_bt[k])), q_bm)
            table[body.modules[i], int(tag)] = np.concatenate([r_mt, q_tm])
    return table
