"""Description and validation of one fault, a [[fault]] of a scenario. hil.faults implements its effect."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from firmware_py.description.schema import quantity
from firmware_py.description.vehicle import FACE_NAMES

THRUSTER, FACE = "thruster", "face"
ALL = -1
"""Fault index that stands for every thruster, or every face."""
FACES = len(FACE_NAMES)
DIRECTIONS = ("to_plant", "from_plant", "both")
NS = 1_000_000_000
LARGEST = 1e6
"""Largest magnitude of a fault's value, in the unit of its kind."""


class Takes(NamedTuple):
    """Which keys and values a kind of fault accepts, narrower than the ranges in `Fault`."""

    low: float = 0.0
    high: float = 0.0
    """Range of the value, from low to high; both 0: the kind takes no value."""
    idle: float = math.nan
    """Value at which the fault has no effect, and which is therefore refused; nan: none."""
    whole: bool = False
    """Whether only whole numbers are accepted."""
    one_module: bool = True
    """Whether the fault can be restricted to one module; otherwise it always affects the whole bus or all the water."""
    part: str = ""
    """What the index counts, THRUSTER or FACE; empty: the kind takes no index."""
    directions: tuple[str, ...] = ("both",)


OF_ALL, ANY_SIZE = Takes(one_module=False), Takes(-LARGEST, LARGEST, idle=0.0)
FRAME_SHARE = Takes(0.0, 1.0, idle=0.0, directions=DIRECTIONS)
TAKES: Mapping[str, Takes] = {
    "thruster_dead": Takes(part=THRUSTER),
    "thruster_weak": Takes(0.0, 1.0, idle=1.0, part=THRUSTER),
    "thruster_reversed": Takes(part=THRUSTER),
    "thruster_stuck": Takes(-1.0, 1.0, part=THRUSTER),
    "thruster_fake_rpm": Takes(0.0, 1.0, idle=1.0, part=THRUSTER),
    "frame_loss": FRAME_SHARE,
    "frame_delay": Takes(0.0, LARGEST, idle=0.0, directions=DIRECTIONS),
    "frame_duplicate": FRAME_SHARE,
    "frame_corrupt": FRAME_SHARE,
    "babble": Takes(1.0, LARGEST, whole=True, one_module=False, directions=("both", "from_plant")),
    "estop": OF_ALL,
    "estop_box_silent": OF_ALL,
    "foreign_sync": OF_ALL,
    "foreign_command": OF_ALL,
    "imu_frozen": Takes(),
    "pressure_jump": ANY_SIZE,
    "pressure_drift": ANY_SIZE,
    "pressure_frozen": Takes(),
    "pressure_absent": Takes(),
    "tag_flip": Takes(0.0, 1.0, idle=0.0),
    "tag_jump": ANY_SIZE,
    "tag_absent": Takes(),
    "camera_bias": ANY_SIZE,
    "battery_sag": ANY_SIZE,
    "leak": Takes(),
    "readings_absent": Takes(),
    "magnet": Takes(-1.0, 1.0, whole=True, part=FACE),
    "jets": Takes(0.0, 1.0, one_module=False),
    "process_killed": OF_ALL,
    "push": ANY_SIZE,
}
"""What each kind of fault accepts."""
THRUSTER_KINDS = tuple(kind for kind, takes in TAKES.items() if takes.part == THRUSTER)
FRAME_KINDS = tuple(kind for kind, takes in TAKES.items() if takes.directions != ("both",))


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault, active from `at_s` until `until_s`."""

    kind: str = quantity(choices=tuple(TAKES), help="kind of fault")
    at_s: float = quantity(0.0, unit="s", low=0, high=1e6, help="time at which the fault begins")
    until_s: float = quantity(1e6, unit="s", low=0, high=1e6, help="time at which the fault ends")
    module: int = quantity(
        0, low=0, high=29, help="number of the affected module; frame faults: frames with that number in their id; 0: all"
    )
    index: int = quantity(ALL, low=-1, high=15, help="index of the thruster, or of the face of a magnet; -1: all")
    value: float = quantity(
        0.0, low=-LARGEST, high=LARGEST,
        help="weak, fake_rpm: share of the force that is left; stuck: command; loss, duplicate, corrupt, flip: share; "
        "delay: ms; babble: frames per tick; jump, camera_bias: m; pressure_drift: m/s of depth; battery_sag: voltage drop, V; "
        "magnet: -1, 0, 1; jets: strength; push: N, direction drawn per seed",
    )  # fmt: skip
    direction: str = quantity("both", choices=DIRECTIONS, help="frame faults: direction in which frames are affected")

    def mistakes(self, thrusters: Mapping[int, int], has_box: bool = False) -> Iterator[tuple[str, str]]:
        """Yields (key, message) for each value with which the fault would have no effect, or another than described.

        Args:
            thrusters: number of thrusters of each module, by module number.
            has_box: whether an e-stop box sends HEARTBEAT.
        """
        takes = TAKES[self.kind]
        if round(self.until_s * NS) <= round(self.at_s * NS):
            yield "until_s", f"{self.until_s:g} s is not after at_s, {self.at_s:g} s; the fault would never begin"
        is_odd = takes.whole and self.value % 1.0 != 0.0
        if is_odd or not takes.low <= self.value <= takes.high or self.value == takes.idle:
            but = "" if math.isnan(takes.idle) else f", except {takes.idle:g}"
            span = f"{'whole numbers from ' if takes.whole else ''}{takes.low:g} to {takes.high:g}{but}"
            wanted = span if takes.low < takes.high else "none"
            yield "value", f"{self.value:g} is not for {self.kind}, which takes {wanted}"
        if self.module and not takes.one_module:
            yield "module", f"{self.kind} is not of one module, as of {self.module}; leave it out"
        if self.direction not in takes.directions:
            yield "direction", f"{self.kind} does not go {self.direction}; it goes {', '.join(takes.directions)}"
        parts = {THRUSTER: max((n for number, n in thrusters.items() if self.module in (0, number)), default=0), FACE: FACES}
        if takes.part and self.index >= parts[takes.part]:
            last = parts[takes.part] - 1
            yield "index", f"{self.index} is beyond what the module has for {self.kind}; it takes 0 to {last}, and -1 for all"
        elif not takes.part and self.index != ALL:
            yield "index", f"{self.index} is not for {self.kind}, which is of no thruster and no face; leave it out"
        if self.kind == "estop_box_silent" and not has_box:
            yield "kind", "no e-stop box speaks here that could fall silent; give the scenario estop_box = true"

    def is_on(self, time_ns: int) -> bool:
        """Whether the fault is active at `time_ns`."""
        return round(self.at_s * NS) <= time_ns < round(self.until_s * NS)

    def meets_a_tick(self, period_ns: int) -> bool:
        """Whether the fault is active in any tick, from the first one, at `period_ns`, on."""
        return self.is_on(max(1, -(-round(self.at_s * NS) // period_ns)) * period_ns)
