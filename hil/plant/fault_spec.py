"""One fault, as a scenario's [[fault]] describes it. What it does is hil.faults' business."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_py.description.schema import quantity

THRUSTER_KINDS = ("thruster_dead", "thruster_weak", "thruster_reversed", "thruster_stuck", "thruster_fake_rpm")
FRAME_KINDS = ("frame_loss", "frame_delay", "frame_duplicate", "frame_corrupt", "babble")
OTHER_KINDS = (
    "estop", "foreign_sync", "imu_frozen", "tag_flip", "tag_jump", "tag_absent", "camera_bias", "battery_sag", "leak", "magnet", "jets",
    "process_killed", "push",
)  # fmt: skip
ALL = -1
"""Index of a fault that means every thruster, or every face."""
FACES = 6
DIRECTIONS = ("to_plant", "from_plant", "both")
NS = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault."""

    kind: str = quantity(choices=(*THRUSTER_KINDS, *FRAME_KINDS, *OTHER_KINDS), help="what breaks")
    at_s: float = quantity(0.0, unit="s", low=0, high=1e6, help="when it begins")
    until_s: float = quantity(1e6, unit="s", low=0, high=1e6, help="when it is over")
    module: int = quantity(0, low=0, high=29, help="number of the module; 0: all")
    index: int = quantity(ALL, low=-1, high=15, help="thruster, or face of a magnet; -1: all")
    value: float = quantity(
        0.0, low=-1e6, high=1e6,
        help="weak, fake_rpm: share of the force that is left; stuck: command; loss, duplicate, corrupt, flip: share; "
        "delay: ms; babble: frames a tick; jump, camera_bias: m; battery_sag: V less; magnet: -1, 0, 1; jets: strength; "
        "push: N, from a side of its own in each seed",
    )  # fmt: skip
    direction: str = quantity("both", choices=DIRECTIONS, help="frames: which way")

    def is_on(self, time_ns: int) -> bool:
        """Whether it is at work."""
        return round(self.at_s * NS) <= time_ns < round(self.until_s * NS)
