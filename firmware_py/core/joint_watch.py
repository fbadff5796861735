"""All joints of the fleet, and what currents and pictures tell of each of them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from firmware_py.core.docking_detector import ModulePoses, PairBank
from firmware_py.core.joints import Joint, modules_of
from firmware_py.core.types import NEVER_NS, DockRequest, ModuleInputs
from firmware_py.description.parameters import Docking


class JointWatch:
    """Watches joints tick by tick. A request stands for the joint between its two modules, from whichever side it is told."""

    def __init__(self, parameters: Docking) -> None:
        self._p = parameters
        self._joints: Sequence[Joint] = ()
        self._bank = PairBank([], parameters)

    def __len__(self) -> int:
        """How many joints there are."""
        return len(self._joints)

    def retune(self, parameters: Docking) -> None:
        """Takes other parameters; what is known stays."""
        self._p = parameters
        self.watch(self._joints)

    def watch(self, joints: Sequence[Joint]) -> None:
        """These from now on; of those that were watched before all that is known stays."""
        self._joints = joints
        self._bank = PairBank([joint.pair for joint in joints], self._p, self._bank)

    def step(self, time_ns: int, modules: Sequence[ModuleInputs], poses: ModulePoses, resting: Collection[tuple[int, int]]) -> None:
        """One tick; of `resting` modules and faces the magnets are off whatever is wanted."""
        if self._joints:
            self._bank.step(time_ns, modules, poses, resting)

    @property
    def rows(self) -> np.ndarray:
        """(k,) of docking_pairs.PAIR: what is known of every joint in this tick; a copy."""
        return self._bank.rows.copy()

    def that_are_open(self, least: int) -> list[DockRequest]:
        """Those that are `least` LOOSE or APART though they should hold, as requests that name their faces."""
        return [self._joints[k].request for k in np.flatnonzero(self._bank.rows["open"] >= least).tolist()] if self._joints else []

    def left(self, requests: Sequence[DockRequest]) -> list[DockRequest]:
        """Those of the requests whose joints there still are."""
        there = [modules_of(joint.request) for joint in self._joints]
        return [request for request in requests if modules_of(request) in there]

    def newest_ns(self, request: DockRequest, what: str) -> int:
        """Time of its newest picture (`picture_ns`), of the newest that shows it closed (`near_ns`), or of the staler of its two currents
        (`current_ns`).
        """
        row = self._row(request)
        return NEVER_NS if row is None else int(np.min(row[what]))

    def strong_ma(self, request: DockRequest, after_ns: int = NEVER_NS) -> np.ndarray | None:
        """(2,) currents of its faces, mA, where both are on and came after that time."""
        row = self._row(request)
        if row is None or row["current_ns"].min() <= after_ns or not np.abs(row["current_ma"]).min() > self._p.current_threshold_ma:
            return None
        return np.array(row["current_ma"])

    def _row(self, request: DockRequest) -> np.void | None:
        found = (row for joint, row in zip(self._joints, self._bank.rows, strict=True) if modules_of(joint.request) == modules_of(request))
        return next(found, None)
