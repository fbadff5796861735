"""Autopilot that the robot presents itself as. It decides which encoding of modes clients use; the two overlap, so none is guessed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from firmware_py.core.transitions import MODE_TABLE
from firmware_py.core.types import Mode

AUTOPILOT_GENERIC, AUTOPILOT_ARDUPILOT = 0, 3
TYPE_SUBMARINE = 12
COMPONENT_AUTOPILOT = 1
"""Clients find no autopilot under another component id."""
CUSTOM_MODE_ENABLED, _AUTO, _GUIDED, _STABILIZE, _MANUAL_INPUT, ARMED = 1, 4, 8, 16, 64, 128
"""MAV_MODE_FLAG."""
_FLAGS: Mapping[Mode, int] = {
    Mode.MANUAL: _MANUAL_INPUT,
    Mode.STABILIZE: _MANUAL_INPUT | _STABILIZE,
    Mode.ALT_HOLD: _MANUAL_INPUT | _STABILIZE,
    Mode.POSHOLD: _MANUAL_INPUT | _STABILIZE | _GUIDED,
    Mode.GUIDED: _STABILIZE | _GUIDED,
    Mode.AUTO: _STABILIZE | _GUIDED | _AUTO,
    Mode.SURFACE: _STABILIZE | _GUIDED | _AUTO,
    Mode.DOCK: _STABILIZE | _GUIDED | _AUTO,
    Mode.MOTOR_DETECT: _MANUAL_INPUT,
}
"""Flags of each mode in HEARTBEAT."""


@dataclass(frozen=True, slots=True)
class Identity:
    """One encoding of modes, with the conventions that clients expect along with it.

    Attributes:
        autopilot: MAV_AUTOPILOT.
        numbers: custom modes that stand for each mode; the first is reported.
        pairs: the second and third parameter of DO_SET_MODE are a main and a sub mode, as in PX4.
        first_item: number of the first mission item that is flown. Item 0 is the home position in ArduPilot.
        waypoints_turn: a place in a mission, or to go to, may have a heading. ArduSub ignores it; its clients write 0, which is north.
        first_log: number of the oldest log. QGroundControl counts from 1 for ArduPilot alone.
        first_motor: number of the first motor in a motor test. ArduSub and its test clients count from 0.
        rest_percent: throttle of a motor test at which the motor stands still. ArduSub's throttle ranges from 0, full reverse, to 100 %.
    """

    name: str
    autopilot: int
    numbers: Mapping[Mode, tuple[int, ...]]
    pairs: bool
    first_item: int
    waypoints_turn: bool
    first_log: int
    first_motor: int
    rest_percent: float

    def custom_mode(self, mode: Mode) -> int:
        """The custom mode that HEARTBEAT carries."""
        return self.numbers[mode][0]

    def mode(self, custom: int) -> Mode | None:
        """The mode that a custom mode stands for, or None."""
        return next((mode for mode, numbers in self.numbers.items() if custom in numbers), None)

    def mode_of_command(self, main: float, sub: float) -> Mode | None:
        """The mode of DO_SET_MODE's parameters 2 and 3, which may be NaN."""
        if main != main or not 0 <= main < 2**16:
            return None
        second = int(sub) if 0 <= sub < 256 else 0  # NaN fails the comparison
        return self.mode(px4(int(main), second) if self.pairs else int(main))


def px4(main: int, sub: int = 0) -> int:
    """PX4's custom mode: main mode in bits 16 to 23, sub mode above."""
    return (main & 0xFF) << 16 | (sub & 0xFF) << 24


def base_mode(mode: Mode, armed: bool) -> int:
    """MAV_MODE_FLAG bits of HEARTBEAT."""
    return CUSTOM_MODE_ENABLED | _FLAGS[mode] | (ARMED if armed else 0)


GENERIC = Identity(
    name="generic",
    autopilot=AUTOPILOT_GENERIC,
    numbers={
        Mode.MANUAL: (px4(1),),
        Mode.ALT_HOLD: (px4(2),),
        Mode.POSHOLD: (px4(4, 3), px4(3)),  # hold, position
        Mode.AUTO: (px4(4, 4),),  # mission
        Mode.GUIDED: (px4(6),),  # offboard
        Mode.STABILIZE: (px4(7),),
        Mode.SURFACE: (px4(4, 6), px4(4, 5)),  # land, return
        Mode.DOCK: (px4(4, 9),),  # precision land
        Mode.MOTOR_DETECT: (px4(4, 1),),  # ready
    },
    pairs=True,
    first_item=0,
    waypoints_turn=True,
    first_log=0,
    first_motor=1,
    rest_percent=0.0,
)

ARDUSUB = Identity(
    name="ardusub",
    autopilot=AUTOPILOT_ARDUPILOT,
    numbers={mode: (int(mode),) for mode in Mode},
    pairs=False,
    first_item=1,
    waypoints_turn=False,
    first_log=1,
    first_motor=0,
    rest_percent=50.0,
)

IDENTITIES = {identity.name: identity for identity in (GENERIC, ARDUSUB)}
"""Identities by the name that the command line takes."""

SETTABLE = tuple(row.mode for row in MODE_TABLE if row.on_request)
"""Modes that a person may select; DOCK is entered by a docking request instead."""

NAMES: Mapping[Mode, str] = {
    Mode.MANUAL: "Manual", Mode.STABILIZE: "Stabilize", Mode.ALT_HOLD: "Depth Hold", Mode.POSHOLD: "Position Hold",
    Mode.AUTO: "Auto", Mode.GUIDED: "Guided", Mode.SURFACE: "Surface", Mode.MOTOR_DETECT: "Motor Detection",
    Mode.DOCK: "Dock",
}  # fmt: skip
"""Mode names that stations show, in the order of AVAILABLE_MODES. QGroundControl pauses and starts missions of a submarine by them."""
