"""Whether two faces are docked: both conditions of the paper, on fresh measurements alone.

Condition 1: the current of both magnets is beyond +-70 mA. Condition 2: the relative position is one lattice pitch and settled. A pose
is taken from tags of both modules seen in one picture, never from a state that was carried on.

All pairs that are watched are rows of one array, and one compiled pass a tick serves them all.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core.docking_pairs import PAIR, PICTURES, Limits, place_modules, watch
from firmware_py.core.rotations import to_matrix
from firmware_py.core.types import FACES, NEVER_NS, ModuleInputs
from firmware_py.description.parameters import Docking


class FacePair(NamedTuple):
    """Two faces that may meet. Indices of modules in the fleet; where the centre of b should be in the frame of a, m, and how turned."""

    module_a: int
    face_a: int
    module_b: int
    face_b: int
    offset_a: np.ndarray
    """(3,)"""
    q_ab: np.ndarray
    """(4,) frame of b to frame of a."""


class PairStatus(NamedTuple):
    """What is known of one pair in this tick."""

    current: bool
    """Condition 1 holds, debounced."""
    position: bool
    """Condition 2 holds, debounced."""
    position_error_m: float
    """Distance of the mean relative position from one pitch; NaN without fresh pictures."""
    spread_m: float
    """Distance between the means of the two newest quarters of the pictures: what `settled` is judged by."""
    docked: bool
    """Both hold."""


class PairBank:
    """Watches any number of pairs of faces. `rows`, (k,) of PAIR, is what is known of them in this tick."""

    def __init__(self, pairs: Sequence[FacePair], parameters: Docking, before: PairBank | None = None) -> None:
        """`before`: the bank that this one replaces; what it knows of a pair that both watch is kept."""
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
        self._heard_ma = np.full((max(self._watched, default=-1) + 1, FACES), np.nan)
        if before is not None:
            self._go_on(before)

    def _go_on(self, before: PairBank) -> None:
        known = {key: i for i, key in enumerate(_keys(before.rows))}
        for here, key in enumerate(_keys(self.rows)):
            if key in known:
                there = known[key]
                self.rows[here], self._rings[here] = before.rows[there], before._rings[there]

    def step(
        self, time_ns: int, modules: Sequence[ModuleInputs], poses: ModulePoses, resting: Collection[tuple[int, int]] = ()
    ) -> None:
        """Brings the rows to the tick at `time_ns`, from its inputs alone and what they were before.

        Args:
            resting: modules and faces whose magnets the limiter has switched off: their currents tell nothing.
        """
        for m in self._watched:
            for dock in modules[m].docks:
                self._heard_ma[m, dock.first : dock.first + 3] = dock.current_ma
        for m, face in resting:
            if m in self._watched:
                self._heard_ma[m, face] = np.nan
        watch(self.rows, self._rings, self._heard_ma, *poses.sightings, time_ns, self._limits)

    def status(self, i: int) -> PairStatus:
        """Of pair `i`."""
        row = self.rows[i]
        current, position = map(bool, row["holds"].tolist())
        return PairStatus(current, position, float(row["error_m"]), float(row["spread_m"]), current and position)


class PairDetector:
    """Watches one pair of faces."""

    def __init__(self, pair: FacePair, parameters: Docking) -> None:
        self.pair = pair
        self._bank = PairBank([pair], parameters)

    def step(self, time_ns: int, modules: Sequence[ModuleInputs], poses: ModulePoses) -> PairStatus:
        """The pair's status in the tick at `time_ns`."""
        self._bank.step(time_ns, modules, poses)
        return self._bank.status(0)

    @property
    def currents_ma(self) -> tuple[float, float]:
        """Newest current of both faces; NaN before the first."""
        a, b = self._bank.rows[0]["current_ma"].tolist()
        return a, b


TagTable = dict[tuple[int, int], np.ndarray]
"""(module, tag id) -> (7,) tag centre in the module frame, m, and module frame to tag frame."""


class Sightings(NamedTuple):
    """Single modules as the pictures of one tick show them, in the order of modules, then of arrival."""

    first: np.ndarray
    """(m + 1,) where the sightings of each module of the fleet begin."""
    seen: np.ndarray
    """(s, 2) module, and time of the picture, ns."""
    poses: np.ndarray
    """(s, 12) the module's centre in the world, and its rotation matrix row by row."""


class ModulePoses:
    """Poses of single modules by the pictures of this tick. Made anew each tick; costs something only once it is asked."""

    def __init__(self, modules: Sequence[ModuleInputs], tags: TagTable) -> None:
        self._modules = modules
        self._tags = tags
        self._sightings: Sightings | None = None

    @property
    def sightings(self) -> Sightings:
        """All tags that were seen and are known."""
        if self._sightings is None:
            self._sightings = self._gather()
        return self._sightings

    def _gather(self) -> Sightings:
        times: list[int] = []
        parts: list[np.ndarray] = []
        for i, module in enumerate(self._modules):
            for tag in module.tags:
                known = self._tags.get((i, tag.tag_id))
                if known is not None:
                    times += i, tag.capture_ns
                    parts += tag.p_wt, tag.q_wt, known
        if not parts:
            return Sightings(np.zeros(len(self._modules) + 1, dtype=np.int64), *NOTHING)
        seen = np.array(times, dtype=np.int64).reshape(-1, 2)
        found = Sightings(np.empty(len(self._modules) + 1, dtype=np.int64), seen, np.empty((len(seen), 12)))
        place_modules(np.concatenate(parts).reshape(-1, 14), *found)
        return found


NOTHING = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 12))


def _keys(rows: np.ndarray) -> list[tuple[int, ...]]:
    return [tuple(pair) for pair in rows["module"].tolist()]
