"""One fault, as a scenario's [[fault]] describes it. What it does is hil.faults' business."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from firmware_py.description.schema import quantity
from firmware_py.description.vehicle import FACE_NAMES

THRUSTER_KINDS = ("thruster_dead", "thruster_weak", "thruster_reversed", "thruster_stuck", "thruster_fake_rpm")
FRAME_KINDS = ("frame_loss", "frame_delay", "frame_duplicate", "frame_corrupt", "babble")
OTHER_KINDS = (
    "estop", "foreign_sync", "imu_frozen", "tag_flip", "tag_jump", "tag_absent", "camera_bias", "battery_sag", "leak", "magnet", "jets",
    "process_killed", "push",
)  # fmt: skip
ALL = -1
"""Index of a fault that means every thruster, or every face."""
FACES = len(FACE_NAMES)
DIRECTIONS = ("to_plant", "from_plant", "both")
NS = 1_000_000_000
LARGEST = 1e6
"""Of any fault's value, in the unit of its kind."""


class Takes(NamedTuple):
    """What a kind of fault takes, beyond the ranges of all kinds."""

    low: float = -LARGEST
    high: float = LARGEST
    idle: float = math.nan
    """Value with which nothing would be wrong."""
    whole: bool = False
    """Whole numbers alone."""
    one_module: bool = True
    """It can be of one module alone, or else is always of the whole bus or of all the water."""
    directions: tuple[str, ...] = DIRECTIONS


SHARE, OFF, OF_ALL = Takes(0.0, 1.0, idle=0.0), Takes(idle=0.0), Takes(one_module=False)
TAKES: Mapping[str, Takes] = {
    "thruster_weak": Takes(0.0, 1.0, idle=1.0),
    "thruster_fake_rpm": Takes(0.0, 1.0, idle=1.0),
    "thruster_stuck": Takes(-1.0, 1.0),
    "frame_loss": SHARE,
    "frame_delay": Takes(0.0, idle=0.0),
    "frame_duplicate": SHARE,
    "frame_corrupt": SHARE,
    "babble": Takes(1.0, whole=True, one_module=False, directions=("both", "from_plant")),
    "estop": OF_ALL,
    "foreign_sync": OF_ALL,
    "tag_flip": SHARE,
    "tag_jump": OFF,
    "camera_bias": OFF,
    "battery_sag": OFF,
    "magnet": Takes(-1.0, 1.0, whole=True),
    "jets": Takes(0.0, 1.0, one_module=False),
    "process_killed": OF_ALL,
    "push": OFF,
}
"""By kind; a kind that is not here takes anything."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault."""

    kind: str = quantity(choices=(*THRUSTER_KINDS, *FRAME_KINDS, *OTHER_KINDS), help="what breaks")
    at_s: float = quantity(0.0, unit="s", low=0, high=1e6, help="when it begins")
    until_s: float = quantity(1e6, unit="s", low=0, high=1e6, help="when it is over")
    module: int = quantity(0, low=0, high=29, help="number of the module; frames: those with its number; 0: all")
    index: int = quantity(ALL, low=-1, high=15, help="thruster, or face of a magnet; -1: all")
    value: float = quantity(
        0.0, low=-LARGEST, high=LARGEST,
        help="weak, fake_rpm: share of the force that is left; stuck: command; loss, duplicate, corrupt, flip: share; "
        "delay: ms; babble: frames a tick; jump, camera_bias: m; battery_sag: V less; magnet: -1, 0, 1; jets: strength; "
        "push: N, from a side of its own in each seed",
    )  # fmt: skip
    direction: str = quantity("both", choices=DIRECTIONS, help="frames: which way")

    def mistakes(self, thrusters: Mapping[int, int]) -> Iterator[tuple[str, str]]:
        """Keys with which it would do nothing, or something else than it says, and what is wrong with each.

        Args:
            thrusters: number of each module's thrusters, by the module's number.
        """
        takes = TAKES.get(self.kind, Takes())
        if round(self.until_s * NS) <= round(self.at_s * NS):
            yield "until_s", f"{self.until_s:g} s is not after at_s, {self.at_s:g} s; the fault would never begin"
        is_odd = takes.whole and self.value % 1.0 != 0.0
        if is_odd or not takes.low <= self.value <= takes.high or self.value == takes.idle:
            wanted = f"{'whole numbers from ' if takes.whole else ''}{takes.low:g} to {takes.high:g}"
            but = "" if math.isnan(takes.idle) else f", except {takes.idle:g}"
            yield "value", f"{self.value:g} is not for {self.kind}, which takes {wanted}{but}"
        if self.module and not takes.one_module:
            yield "module", f"{self.kind} is not of one module, as of {self.module}; leave it out"
        if self.direction not in takes.directions:
            yield "direction", f"{self.kind} does not go {self.direction}; it goes {', '.join(takes.directions)}"
        most = max((count for number, count in thrusters.items() if self.module in (0, number)), default=0)
        parts = {**dict.fromkeys(THRUSTER_KINDS, most), "magnet": FACES}.get(self.kind, LARGEST)
        if self.index >= parts:
            yield "index", f"{self.index} is beyond what the module has for {self.kind}; it takes 0 to {parts - 1:g}, and -1 for all"

    def is_on(self, time_ns: int) -> bool:
        """Whether it is at work."""
        return round(self.at_s * NS) <= time_ns < round(self.until_s * NS)
