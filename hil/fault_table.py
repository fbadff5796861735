"""The faults of `modcube hil campaign faults` and what the robot promises in each mode: one row per fault.

The promises are those of the fail-safe table (docs/supervisor.md) with its default parameters, and limits of our own where it has none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from firmware_py.description.vehicle import FACE_NAMES
from hil.plant.fault_spec import Fault
from hil.task import MODES

AT_S = 8.0
"""Time of the fault."""
THRUSTER = 5
"""Index of the thruster that breaks; MOTOR_DETECT turns it after the fault."""
PILOTED = ("MANUAL", "STABILIZE", "ALT_HOLD")
PLACED = ("POSHOLD", "AUTO", "GUIDED")
"""Modes that hold a position or follow one."""
DOCK = "DOCK"
"""Mode of the active body of a dock, which becomes one with its target unless something stops it."""
DOCKED = "DOCKED"
"""Final state of a body that became one with its target."""
COLUMNS = (*MODES, DOCK)
POSITIONED = (*PLACED, DOCK)
"""Modes that need a position."""
FACE = FACE_NAMES.index("-x")
"""Index of the face whose magnet breaks: the one that docks."""
NAME = f"thruster {THRUSTER + 1} of module 1"
"""Its name in the firmware's texts; what breaks is in the first module."""


def _all_but(*modes: str) -> tuple[str, ...]:
    return tuple(mode for mode in COLUMNS if mode not in modes)


@dataclass(frozen=True)
class Row:
    """One fault and its promise."""

    name: str
    promise: str
    """In words."""
    fault: Fault | None = None
    also: tuple[Fault, ...] = ()
    """Faults that occur together with `fault`."""
    ends: Mapping[str, str] = field(default_factory=dict)
    """Final state by initial mode: a mode, DISARMED or ESTOP. A mode that is not listed is kept; a dock ends in DOCKED."""
    within_s: float = math.inf
    """Latest time after the fault at which the final state is reached."""
    error_m: float = math.inf
    """Largest distance from the set-point in the modes in PLACED, while the position is known."""
    angle_deg: float = math.inf
    """Largest attitude error in the modes in PLACED."""
    says: str = ""
    """Text that an event must contain ..."""
    says_in: tuple[str, ...] = COLUMNS
    """... in these modes."""
    task: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the task: who falls silent, and when."""

    @property
    def leaves_out(self) -> bool:
        """Whether the broken thruster must be left out from then on."""
        return NAME in self.says


def _fault(kind: str, value: float = 0.0, **more: float | str) -> Fault:
    return Fault(kind=kind, at_s=AT_S, value=value, **more)  # type: ignore[arg-type]


def _to(mode: str, *modes: str) -> dict[str, str]:
    return dict.fromkeys(modes, mode)


ROWS = (
    Row(
        "thruster dead", "left out; 60 mm, 15 deg", _fault("thruster_dead", index=THRUSTER),
        error_m=0.060, angle_deg=15.0, says=f"{NAME} stands still",
    ),
    Row("thruster at half force", "flown with; 60 mm, 15 deg", _fault("thruster_weak", 0.5, index=THRUSTER), error_m=0.060, angle_deg=15.0),
    Row(
        "thruster reversed", "left out; 60 mm, 15 deg", _fault("thruster_reversed", index=THRUSTER),
        error_m=0.060, angle_deg=15.0, says=f"{NAME} does not",
    ),
    Row(
        "thruster stuck at half", "left out; 100 mm, 20 deg", _fault("thruster_stuck", 0.5, index=THRUSTER),
        error_m=0.100, angle_deg=20.0, says=f"{NAME} does not obey", says_in=_all_but("MANUAL"),
    ),
    Row(
        "thruster fakes its rpm", "left out; 60 mm, 15 deg", _fault("thruster_fake_rpm", 0.0, index=THRUSTER),
        error_m=0.060, angle_deg=15.0, says=f"{NAME} does not push as it says",
        says_in=_all_but("MANUAL", "MOTOR_DETECT", DOCK),  # a magnet that pulls at another body pushes as well
    ),
    Row("30 % of the frames lost", "as before; 30 mm", _fault("frame_loss", 0.3), error_m=0.030),
    Row("frames 20 ms late", "warns; 30 mm", _fault("frame_delay", 20.0), error_m=0.030, says="a module answers too late"),
    Row("30 % of the frames twice", "as before; 20 mm", _fault("frame_duplicate", 0.3), error_m=0.020),
    Row("10 % of the frames corrupt", "as before; 30 mm", _fault("frame_corrupt", 0.1), error_m=0.030),
    Row("node babbles", "as before; 20 mm", _fault("babble", 5.0), error_m=0.020),
    Row(
        "all frames lost", "MCU stops; disarms after 2 s", _fault("frame_loss", 1.0), ends=_to("DISARMED", *COLUMNS), within_s=2.2,
        says="bus silent for",
    ),
    Row(
        "another SYNC producer", "surfaces", _fault("foreign_sync"), ends=_to("SURFACE", *COLUMNS), within_s=0.1,
        says="somebody else sends SYNC",
    ),
    Row(
        "another commander of relays", "warns; 20 mm; no dock", _fault("foreign_command"), ends=_to(DOCK, DOCK), error_m=0.020,
        says="somebody else commands modules",
    ),
    Row("e-stop on the bus", "stops, latched", _fault("estop", until_s=AT_S + 1.0), ends=_to("ESTOP", *COLUMNS), within_s=0.02),
    Row(
        "e-stop box silent", "holds the place after 5 s", _fault("estop_box_silent"), ends=_to("POSHOLD", *_all_but("SURFACE")),
        within_s=5.2, error_m=0.030, says="e-stop box silent for",
    ),
    Row(
        "IMU frozen", "holds the place; 30 mm", _fault("imu_frozen"), ends=_to("POSHOLD", *_all_but("SURFACE")), within_s=1.0,
        error_m=0.030, says="no IMU for",
    ),
    Row("pressure jumps by 5 m", "is not used, warns; 20 mm", _fault("pressure_jump", 5.0), error_m=0.020, says="no pressure for"),
    Row("pressure jumps by 0.3 m", "learns the offset; 20 mm", _fault("pressure_jump", 0.3), error_m=0.020),
    Row("pressure drifts by 50 mm/s", "is not used, warns; 20 mm", _fault("pressure_drift", 0.05), error_m=0.020, says="no pressure for"),
    Row("pressure frozen", "is not used, warns; 20 mm", _fault("pressure_frozen"), error_m=0.020, says="no pressure for"),
    Row("pressure absent", "warns; 20 mm", _fault("pressure_absent"), error_m=0.020, says="no pressure for"),
    Row(
        "pressure jumps, tags absent", "depth unknown, surfaces after 5 s", _fault("pressure_jump", 5.0), also=(_fault("tag_absent"),),
        ends=_to("SURFACE", "ALT_HOLD", *POSITIONED), within_s=5.2, says="no pressure for",
    ),
    Row("half of the tags flipped", "as before; 20 mm", _fault("tag_flip", 0.5), error_m=0.020),
    Row(
        "tags jump by 100 mm", "follows the tags; 130 mm; gives a dock up", _fault("tag_jump", 0.1), ends=_to("POSHOLD", DOCK),
        error_m=0.130,
    ),
    Row(
        "tags absent", "holds after 1 s, depth after 8 s", _fault("tag_absent"), ends=_to("ALT_HOLD", *POSITIONED), within_s=8.1,
        says="no tag for", says_in=POSITIONED,
    ),
    Row(
        "pushed, tags absent", "lets go of the place", _fault("push", 40.0), also=(_fault("tag_absent"),),
        ends=_to("ALT_HOLD", *POSITIONED), within_s=3.0, says="pushed out of sight", says_in=POSITIONED,
    ),
    Row("camera off by 5 mm", "as before; 20 mm; no dock", _fault("camera_bias", 0.005), ends=_to(DOCK, DOCK), error_m=0.020),
    Row("magnet dead", "as before; 20 mm; no dock", _fault("magnet", index=FACE), ends=_to(DOCK, DOCK), error_m=0.020),
    Row("battery low", "warns; 30 mm", _fault("battery_sag", 1.8), error_m=0.030, says="battery low"),
    Row(
        "battery critical", "surfaces after 5 s", _fault("battery_sag", 3.0), ends=_to("SURFACE", *COLUMNS), within_s=6.5, error_m=0.100,
        says="battery critical",
    ),
    Row(
        "battery and cabin not told of", "warns; 20 mm", _fault("readings_absent"), error_m=0.020, says="no reading of a cabin for",
    ),
    Row(
        "leak", "surfaces after 0.5 s", _fault("leak"), ends=_to("SURFACE", *COLUMNS), within_s=0.8, error_m=0.100,
        says="water in a cabin",
    ),
    Row(
        "firmware killed for 0.5 s", "comes back disarmed", _fault("process_killed", until_s=AT_S + 0.5), ends=_to("DISARMED", *COLUMNS),
        within_s=0.52,
    ),
    Row(
        "pilot silent", "holds the place after 1 s", ends=_to("POSHOLD", *PILOTED), within_s=1.2, error_m=0.030,
        says="pilot silent", says_in=PILOTED, task={"pilot_until_s": AT_S},
    ),
    Row(
        "ground station silent", "holds the place after 5 s", ends=_to("POSHOLD", *_all_but("AUTO", "SURFACE")), within_s=5.2,
        error_m=0.030, says="ground station silent", says_in=_all_but("AUTO", "SURFACE"), task={"ground_until_s": AT_S},
    ),
)  # fmt: skip
SINGLE_FAULTS = tuple(row.fault for row in ROWS if row.fault is not None and not row.also)
"""Faults that occur alone, without a second one."""
