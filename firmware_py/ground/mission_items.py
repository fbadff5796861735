"""Mission items as values: supported commands and frames, and the order of flight. Geodetic frames only.

QGroundControl scales LOCAL_NED wrongly, so items in it are refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core.fence import beyond
from firmware_py.description.failsafe_parameters import Fence
from firmware_py.description.schema import limits_of
from firmware_py.ground.dialect import Message
from firmware_py.ground.geodesy import Origin

WAYPOINT, LOITER_UNLIMITED, LOITER_TIME, LAST_SPLINE, DELAY, JUMP, CHANGE_SPEED = 16, 17, 19, 82, 93, 177, 178
PLACES = (WAYPOINT, LOITER_UNLIMITED, LOITER_TIME, LAST_SPLINE)
_COMMANDS = (*PLACES, DELAY, JUMP, CHANGE_SPEED)
ABSOLUTE, RELATIVE = (0, 5), (3, 6)
"""MAV_FRAME of absolute altitude, and of altitude relative to home."""
UNSUPPORTED_FRAME, UNSUPPORTED, INVALID_1, INVALID_X, INVALID_Y, INVALID_Z = 2, 3, 6, 10, 11, 12
"""MAV_MISSION_RESULT; the codes of invalid parameters count up from INVALID_1."""
SPEED_STAYS, SPEED_DEFAULT = -1.0, -2.0
"""Special values of DO_CHANGE_SPEED's speed."""
SLOWEST, FASTEST = 0.01, 2.0
"""Range of speeds that may be requested, m/s."""
ONE_WAY_SPEEDS = (2, 3)
"""SPEED_TYPE of climb speed and of descent speed, which do not exist here."""
ACCEPTANCE_M = 0.15
"""Distance from its place at which an item counts as reached. On the bench a module stays within 0.04 m of its path at 2 m/s and 1 m/s^2;
one that is 0.14 m off already pushes with its full force (`core.setpoint.LEASH_M`), so beyond this it does not follow its plan."""
_FILLED_IN_M = (1.0, 3.0)
"""Radii that MAVSDK, and older QGroundControls, write where their user gives none: meant for aircraft, wider than most missions here."""
_MOST_STEPS = 1000
_LONGEST_S = 86_400.0
_BEYOND = {"north_m": INVALID_X, "east_m": INVALID_Y, "top_m": INVALID_Z, "bottom_m": INVALID_Z}
"""Result for an item that lies beyond the given side of the fence."""
ON_FENCE_M = 0.02
"""Tolerance of the fence check: the wire's resolution of 1e-7 degrees is 11 mm."""


class MissionError(ValueError):
    """A mission cannot be flown; the message is one line."""


class Item(NamedTuple):
    """One item, as received."""

    sequence: int
    command: int
    frame: int
    parameters: tuple[float, float, float, float]
    x: int
    y: int
    """x and y are latitude and longitude, 1e-7 deg."""
    z: float
    autocontinue: int = 1

    @property
    def is_place(self) -> bool:
        """Whether the item is a place to fly to."""
        return self.command in PLACES

    @property
    def yaw(self) -> float | None:
        """Heading at the place, rad, or None; a spline's fourth parameter is unused."""
        return math.radians(self.parameters[3]) if self.command != LAST_SPLINE and math.isfinite(self.parameters[3]) else None

    @property
    def hold_s(self) -> float:
        """Time to stay at the place."""
        if self.command in (WAYPOINT, LOITER_TIME, LAST_SPLINE) and math.isfinite(self.parameters[0]):
            return self.parameters[0]
        return 0.0

    @property
    def acceptance_m(self) -> float:
        """Distance from the place at which it counts as reached: a waypoint's second parameter if that is above 0 and somebody's choice."""
        radius = self.parameters[1]
        chosen = self.command == WAYPOINT and math.isfinite(radius) and radius > 0 and radius not in _FILLED_IN_M
        return radius if chosen else ACCEPTANCE_M

    @property
    def delay_s(self) -> float:
        """Duration of a delay; 0 for other items."""
        return self.parameters[0] if self.command == DELAY else 0.0

    @property
    def speed_m_s(self) -> float | None:
        """Speed that a change of speed requests; 0 or less: the default. None where the speed stays."""
        speed = self.parameters[1]
        return speed if self.command == CHANGE_SPEED and math.isfinite(speed) and speed != SPEED_STAYS else None

    def place(self, origin: Origin) -> np.ndarray | None:
        """(3,) NED, m; None for an item without a place."""
        if not self.is_place:
            return None
        altitude = self.z + (origin.altitude_m if self.frame in RELATIVE else 0.0)
        return origin.local(self.x * 1e-7, self.y * 1e-7, altitude)


def item_of(message: Message) -> tuple[Item, int]:
    """Returns the item of a MISSION_ITEM_INT or MISSION_ITEM, and a MAV_MISSION_RESULT for what is wrong with it (0: nothing)."""
    m = message
    degrees = m.name == "MISSION_ITEM"
    x, y = m["x"], m["y"]
    if degrees:
        x, y = (round(v * 1e7) if math.isfinite(v) and abs(v) <= 180 else 2**31 - 1 for v in (x, y))
    parameters = (m["param1"], m["param2"], m["param3"], m["param4"])
    item = Item(m["seq"], m["command"], m["frame"], parameters, x, y, m["z"], m["autocontinue"])
    return item, _fault(item)


def _fault(item: Item) -> int:
    if item.command not in _COMMANDS:
        return UNSUPPORTED
    if item.is_place:
        if item.frame not in (*ABSOLUTE, *RELATIVE):
            return UNSUPPORTED_FRAME
        if abs(item.x) > 900_000_000:
            return INVALID_X
        if abs(item.y) > 1_800_000_000:
            return INVALID_Y
        if not math.isfinite(item.z) or abs(item.z) > 11_000:
            return INVALID_Z
        if math.isfinite(item.parameters[0]) and not 0 <= item.parameters[0] <= _LONGEST_S:
            return INVALID_1
        return 0
    needed = {DELAY: (0,), JUMP: (0, 1), CHANGE_SPEED: (1,)}[item.command]
    for index in needed:
        value = item.parameters[index]
        if not math.isfinite(value) or abs(value) > _LONGEST_S:
            return INVALID_1 + index
    if item.command == CHANGE_SPEED:
        kind, speed = item.parameters[:2]
        return INVALID_1 if kind in ONE_WAY_SPEEDS else INVALID_1 + 1 if speed > 0 and not SLOWEST <= speed <= FASTEST else 0
    return INVALID_1 if item.command == DELAY and item.parameters[0] < 0 else 0


def beyond_fence(place: np.ndarray, fence: Fence) -> tuple[int, str]:
    """Checks a place (3,) NED, m. Returns a MAV_MISSION_RESULT, 0 inside, and in words which side of the fence the place is beyond."""
    for side, beyond_m in beyond(place, fence).items():
        if beyond_m > ON_FENCE_M:
            return _BEYOND[side], f"{beyond_m:.2f} m beyond {limits_of(Fence, side).mavlink}, {getattr(fence, side):g} m"
    return 0, ""


def flight_order(items: Sequence[Item], first: int) -> Iterator[Item]:
    """Yields the items in the order of flight from `first` on, following jumps.

    Raises:
        MissionError: the mission never ends or has too many steps, or a jump has no target.
    """
    left = {item.sequence: int(item.parameters[1]) for item in items if item.command == JUMP}
    at, steps = first, 0
    while at < len(items):
        steps += 1
        if steps > _MOST_STEPS:
            raise MissionError(f"it has more than {_MOST_STEPS} steps")
        item = items[at]
        if item.command != JUMP:
            yield item
            at += 1
            continue
        target = int(item.parameters[0])
        if target not in range(len(items)):
            raise MissionError(f"item {at} jumps to item {target}, which does not exist")
        if left[item.sequence] < 0:
            raise MissionError(f"item {at} jumps for ever")
        at = target if left[item.sequence] > 0 else at + 1
        left[item.sequence] -= left[item.sequence] > 0
