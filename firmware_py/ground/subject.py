"""The body of which a system tells: its record and modules in the picture of the last tick, identity, origin and mission progress."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from firmware_py.core.rotations import rotate
from firmware_py.core.types import BodyRecord
from firmware_py.ground.geodesy import Origin
from firmware_py.ground.identity import Identity
from firmware_py.ground.picture import ModulePicture, Picture

NO_MISSION, READY, ACTIVE, PAUSED, DONE = 1, 2, 3, 4, 5
"""MISSION_STATE."""


@dataclass(slots=True)
class Progress:
    """Progress of a mission, as MISSION_CURRENT reports it."""

    current: int = 0
    total: int = 0
    state: int = NO_MISSION


@dataclass(slots=True)
class Subject:
    """The body whose telemetry is sent, with all that the messages are built from."""

    body: int
    picture: Picture
    identity: Identity
    origin: Origin
    progress: Progress = field(default_factory=Progress)
    mode_number: int | None = None
    """Custom-mode number by which a client chose the present mode, where several numbers stand for it."""
    neutral: bool = True
    """Whether no pilot deflects a stick."""

    @property
    def record(self) -> BodyRecord:
        """The body's record of the last tick."""
        return self.picture.records[self.body]

    @property
    def modules(self) -> Sequence[ModulePicture]:
        """The body's modules, in order."""
        return [self.picture.modules[m] for m in self.picture.members(self.body)]

    @property
    def leader(self) -> int:
        """Number of the body that contains the module of this body's number: its own, except while docked into another body."""
        return self.picture.leader(self.body)

    @property
    def time_ms(self) -> int:
        """Time since start in 32 bits; wraps around after 49.7 days."""
        return self.picture.time_ns // 1_000_000 & 0xFFFFFFFF

    @property
    def time_us(self) -> int:
        """Time since start."""
        return self.picture.time_ns // 1_000

    @property
    def v_w(self) -> np.ndarray:
        """(3,) velocity of the centre of mass, world, m/s."""
        e = self.record.estimate
        return np.asarray(rotate(e.q_wb, np.ascontiguousarray(e.nu[:3])))

    @property
    def armed(self) -> bool:
        """Whether thrusters may turn."""
        return self.picture.is_armed(self.body)

    @property
    def custom_mode(self) -> int:
        """Number of the present mode in the identity's encoding."""
        mode = self.picture.mode(self.body)
        if self.mode_number in self.identity.numbers[mode]:
            return int(self.mode_number)
        return self.identity.custom_mode(mode)
