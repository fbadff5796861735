"""Which thrusters are dead or lie: by what their ESCs report, and by the motion that is missing. Between estimate and supervisor.

What is found stays out until the body is armed anew.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.missing_thrust import MissingThrust
from firmware_py.core.thruster import polynomial
from firmware_py.core.types import EscFeedback, Estimate, Measured, ModuleInputs
from firmware_py.description.failsafe_parameters import Faults

ESC_DOWN = (1, 3)
"""EscStatus FAULT and SILENT."""
RANK_TOLERANCE = 1e-6
"""Singular values below this share of the largest count as zero."""
FAST_SHARE = 2.0
"""A propeller that turns at more than this share of the believed speed does not obey."""
FAST_MARGIN = 0.25
"""Share of full speed that it must be off besides: below, deadband and lag explain it."""


class ThrusterFaults(NamedTuple):
    """What is known of a body's thrusters."""

    alive: np.ndarray
    """(n,) bool: may be used."""
    dead: tuple[int, ...]
    """Those that may not."""
    lost_axes: int
    """Rank that is missing because of them."""
    keep: np.ndarray
    """(6, 6) takes from a wrench what the thrusters left cannot make."""


def _keep(made: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """(6, 6) gives up moment for what cannot be made, so that the force stays; only then force.

    Args:
        made, lost: (6, r) and (6, 6 - r) orthonormal bases of the wrenches that can be made, and of the rest.
    """
    give_up = np.eye(6)
    give_up[3:] -= np.linalg.pinv(lost[3:].T) @ lost.T
    return np.asarray(made @ made.T @ give_up)


class FaultDetector:
    """Watches the thrusters of one body."""

    def __init__(self, body: Body, parameters: Faults, period_ns: int) -> None:
        t = body.thrusters
        self._p, self._t = parameters, t
        self._index = {(int(m), int(c)): i for i, (m, c) in enumerate(zip(t.module, t.channel, strict=True))}
        self._modules = body.modules
        full = [(polynomial(f, 1.0), polynomial(r, 1.0)) for f, r in zip(t.forward, t.reverse, strict=True)]
        self._full = np.array(full)
        self._motion = MissingThrust(body, parameters, period_ns)
        n = t.f_max.size
        self._rank = int(np.linalg.matrix_rank(t.matrix, tol=RANK_TOLERANCE * np.linalg.norm(t.matrix, 2)))
        self._stands, self._disobeys, self._down = (np.zeros(n, dtype=np.int64) for _ in range(3))
        self.words: list[str] = []
        """What was found in this tick, for people."""
        self.changed = False
        """Whether `now` changed in this tick."""
        self.now = self._judge(np.ones(n, dtype=bool))

    def reset(self) -> None:
        """All thrusters are trusted again."""
        for count in (self._stands, self._disobeys, self._down):
            count[:] = 0
        self._motion.reset()
        self.changed = not self.now.alive.all()
        self.now = self._judge(np.ones(self.now.alive.size, dtype=bool))

    def step(
        self, modules: list[ModuleInputs], measured: Measured, estimate: Estimate, force_n: np.ndarray, mean_n: np.ndarray, armed: bool
    ) -> ThrusterFaults:
        """What is known after this tick.

        Args:
            modules: inputs of the whole fleet, by fleet index.
            measured, estimate: of this tick.
            force_n, mean_n: (n,) forces that the thrusters are believed to give now, and on the mean since the last tick, N.
            armed: nothing is looked for while disarmed.
        """
        self.words, self.changed = [], False
        found = self._motion.step(measured, estimate, mean_n, self.now.alive, armed)
        if found is not None:
            self._lose(found, "does not push as it says")
        if armed:
            for index, module in enumerate(self._modules):
                for esc in modules[module].esc:
                    self._hear(index, esc, force_n)
        return self.now

    def _hear(self, module: int, esc: EscFeedback, force_n: np.ndarray) -> None:
        for offset in (0, 1):
            i = self._index.get((module, esc.first + offset))
            if i is not None and self.now.alive[i]:
                self._compare(i, esc.rpm[offset], esc.status[offset], float(force_n[i]))

    def _compare(self, i: int, rpm: float, status: int, force_n: float) -> None:
        """One ESC's feedback against what its thruster is believed to give."""
        believed = self.believed_rpm(i, force_n)
        self._down[i] = self._down[i] + 1 if status in ESC_DOWN else 0
        if self._down[i] >= self._p.dead_count:
            self._lose(i, "has an ESC that failed")
            return
        if abs(force_n) >= self._p.force_n:
            stands = abs(rpm) < self._p.dead_share * abs(believed)
            self._stands[i] = self._stands[i] + 1 if stands else 0
        margin = FAST_MARGIN * float(self._t.rpm_at_full[i])
        wrong_way = rpm * believed < 0.0
        fast = abs(rpm) > FAST_SHARE * abs(believed) + margin or (wrong_way and abs(rpm - believed) > margin)
        self._disobeys[i] = self._disobeys[i] + 1 if fast else 0
        if self._stands[i] >= self._p.dead_count:
            self._lose(i, "stands still")
        elif self._disobeys[i] >= self._p.dead_count:
            self._lose(i, "does not obey")

    def believed_rpm(self, i: int, force_n: float) -> float:
        """Speed of thruster `i` at a force, 1/min: thrust goes with the square of the speed."""
        full = float(self._full[i, 0 if force_n > 0.0 else 1])
        return math.copysign(float(self._t.rpm_at_full[i]) * math.sqrt(abs(force_n) / full), force_n)

    def _lose(self, i: int, why: str) -> None:
        alive = self.now.alive.copy()
        alive[i] = False
        self.now, self.changed = self._judge(alive), True
        self._motion.forget()
        self.words.append(f"thruster {i + 1} {why}: left out")

    def _judge(self, alive: np.ndarray) -> ThrusterFaults:
        u, values, _ = np.linalg.svd(self._t.matrix * alive, full_matrices=False)
        rank = int(np.sum(values > RANK_TOLERANCE * max(float(values[0]), 1e-12)))
        dead = tuple(int(i) for i in np.flatnonzero(~alive))
        return ThrusterFaults(alive, dead, self._rank - rank, _keep(u[:, :rank], u[:, rank:]))
