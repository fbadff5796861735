"""All joints of the fleet, and their states by magnet currents and pictures."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from firmware_py.core.docking_detector import ModulePoses, PairBank
from firmware_py.core.docking_pairs import CLOSED, CURRENT
from firmware_py.core.joints import Joint, modules_of
from firmware_py.core.types import NEVER_NS, DockRequest, ModuleInputs
from firmware_py.description.parameters import Docking


class JointWatch:
    """Watches joints tick by tick. A request identifies the joint between its two modules, from either side."""

    def __init__(self, parameters: Docking) -> None:
        self._p = parameters
        self._joints: Sequence[Joint] = ()
        self._bank = PairBank([], parameters)

    def __len__(self) -> int:
        """Number of joints."""
        return len(self._joints)

    def retune(self, parameters: Docking) -> None:
        """Changes the parameters; the joints' states are kept."""
        self._p = parameters
        self.watch(self._joints)

    def watch(self, joints: Sequence[Joint], closed: Collection[frozenset[int]] = ()) -> None:
        """Watches `joints` from now on; joints that were watched before keep their state. The currents of those that a dock has `closed`,
        given by their modules, count as strong already: with the hysteresis of a joint that holds.
        """
        self._joints = joints
        self._bank = PairBank([joint.pair for joint in joints], self._p, self._bank)
        for row, joint in zip(self._bank.rows, joints, strict=True):
            row["holds"][CURRENT] |= modules_of(joint.request) in closed

    def step(self, time_ns: int, modules: Sequence[ModuleInputs], poses: ModulePoses, resting: Collection[tuple[int, int]]) -> None:
        """Runs one tick. `resting`: modules and faces whose magnets are forced off."""
        if self._joints:
            self._bank.step(time_ns, modules, poses, resting)

    @property
    def rows(self) -> np.ndarray:
        """(k,) of docking_pairs.PAIR: state of every joint in this tick; a copy."""
        return self._bank.rows.copy()

    def open_joints(self, least: int) -> list[DockRequest]:
        """Joints that should hold but are at least `least` (any for CLOSED), as requests that name their faces."""
        return [self._joints[k].request for k in np.flatnonzero(self._bank.rows["open"] >= least).tolist()] if self._joints else []

    def existing(self, requests: Sequence[DockRequest], least: int = CLOSED) -> list[DockRequest]:
        """The requests whose joints still exist and are at least `least` (CLOSED, LOOSE or APART)."""
        there = list(map(modules_of, self.open_joints(least)))
        return [request for request in requests if modules_of(request) in there]

    def newest_ns(self, request: DockRequest, what: str) -> int:
        """Time of a joint's newest picture (`picture_ns`), of the newest that shows it closed (`near_ns`), or of the older of its two
        currents (`current_ns`); NEVER_NS for an unknown joint.
        """
        row = self._row(request)
        return NEVER_NS if row is None else int(np.min(row[what]))

    def strong_ma(self, request: DockRequest, after_ns: int = NEVER_NS) -> np.ndarray | None:
        """(2,) currents of a joint's faces, mA, if both are above the threshold and newer than `after_ns`; else None."""
        row = self._row(request)
        if row is None or row["current_ns"].min() <= after_ns or not np.abs(row["current_ma"]).min() > self._p.current_threshold_ma:
            return None
        return np.array(row["current_ma"])

    def _row(self, request: DockRequest) -> np.void | None:
        found = (row for joint, row in zip(self._joints, self._bank.rows, strict=True) if modules_of(joint.request) == modules_of(request))
        return next(found, None)
