"""Waypoint files: CSV for spreadsheets, TOML for people. Both give the input of minimum_snap.plan.

CSV: a header out of x_m, y_m, z_m, qw, qx, qy, qz, vx_m_s, vy_m_s, vz_m_s, stop (0 or 1), duration_s (of the piece that
leads there). TOML: [[waypoint]] tables, and optionally duration_s, [limits].
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass

import numpy as np

from firmware_py.core.body import Body
from firmware_py.description.builder import build
from firmware_py.description.schema import DescriptionError, Source, did_you_mean, parse_toml, quantity, refuse_other_length
from firmware_py.prepare.minimum_snap import Limits, Waypoint, check_bounded, plan
from firmware_py.prepare.piecewise import Piecewise

_POSITION = ("x_m", "y_m", "z_m")
_ATTITUDE = ("qw", "qx", "qy", "qz")
_VELOCITY = ("vx_m_s", "vy_m_s", "vz_m_s")
_COLUMNS = (*_POSITION, *_ATTITUDE, *_VELOCITY, "stop", "duration_s")
_SHOWN = 60
"""Longest excerpt of wrong input in a message, characters."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WaypointTable:
    """One [[waypoint]]."""

    position_m: np.ndarray = quantity(unit="m", low=-1e4, high=1e4, shape=(3,), help="position, world NED")
    quaternion: np.ndarray = quantity(
        [], low=-1, high=1, shape=(-1,), help="attitude quaternion, body to world, scalar first; may be left out"
    )
    velocity_m_s: np.ndarray = quantity(
        [], unit="m/s", low=-10, high=10, shape=(-1,), help="velocity at the waypoint, world NED; may be left out"
    )
    stop: bool = quantity(False, help="whether the body comes to rest at the waypoint")
    duration_s: float = quantity(0.0, unit="s", low=0.0, high=1e5, help="duration of the piece that leads to the waypoint; 0: free")

    def __post_init__(self) -> None:
        for name, values, length in (("quaternion", self.quaternion, 4), ("velocity_m_s", self.velocity_m_s, 3)):
            if len(values) not in (0, length):
                raise DescriptionError(f"{name} needs {length} numbers, not {len(values)}", name)
        if len(self.quaternion):
            refuse_other_length("quaternion", self.quaternion)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimitsTable:
    """[limits]; 0 or an empty list leaves a quantity free."""

    velocity_m_s: np.ndarray = quantity([], unit="m/s", low=1e-3, high=10, shape=(-1,), help="velocity limit along x, y, z")
    acceleration_m_s2: np.ndarray = quantity([], unit="m/s^2", low=1e-3, high=10, shape=(-1,), help="acceleration limit along x, y, z")
    corridor_m: float = quantity(
        0.0, unit="m", low=0.0, high=100, help="largest distance from the straight line through two waypoints, and beyond either"
    )
    angular_rate_rad_s: float = quantity(0.0, unit="rad/s", low=0.0, high=20, help="limit of the angular rate")
    angular_acceleration_rad_s2: float = quantity(0.0, unit="rad/s^2", low=0.0, high=100, help="limit of the angular acceleration")
    thruster_share: float = quantity(0.8, low=0.05, high=1.0, help="share of each thruster's force that the path may use")

    def __post_init__(self) -> None:
        for name, values in (("velocity_m_s", self.velocity_m_s), ("acceleration_m_s2", self.acceleration_m_s2)):
            if len(values) not in (0, 3):
                raise DescriptionError(f"{name} needs 3 numbers, not {len(values)}", name)

    def limits(self) -> Limits:
        """The limits as minimum_snap.plan takes them; None where the file leaves a quantity free."""
        return Limits(
            self.velocity_m_s if len(self.velocity_m_s) else None,
            self.acceleration_m_s2 if len(self.acceleration_m_s2) else None,
            self.corridor_m or None,
            self.angular_rate_rad_s or None,
            self.angular_acceleration_rad_s2 or None,
            self.thruster_share,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mission:
    """A waypoint file."""

    waypoint: tuple[WaypointTable, ...] = quantity()
    duration_s: float = quantity(0.0, unit="s", low=0.0, high=1e6, help="duration of the whole path; 0: free")
    limits: LimitsTable = quantity(LimitsTable())

    def __post_init__(self) -> None:
        if len(self.waypoint) < 2:
            raise DescriptionError(f"a trajectory needs two waypoints, not {len(self.waypoint)}")
        given = [w.duration_s > 0.0 for w in self.waypoint[1:]]
        if any(given) and not all(given):
            lacking = given.index(False) + 1
            raise DescriptionError(f"waypoint {lacking} lacks duration_s; give it for every piece or for none", "waypoint", lacking)
        if all(given) and self.duration_s > 0.0:
            raise DescriptionError("duration_s is given for the whole and for every piece; leave one out", "duration_s")

    def plan(self, body: Body | None = None, stretch: bool = True) -> Piecewise:
        """The trajectory. Raises as minimum_snap.plan does."""
        return plan(self._points, self._durations, self.limits.limits(), body, stretch)

    def check_bounded(self) -> None:
        """Raises ValueError where the file gives neither durations nor limits that bound them; a body is not needed for the check."""
        if self._durations is None:
            check_bounded(self._points, self.limits.limits())

    @property
    def _points(self) -> list[Waypoint]:
        points = []
        for w in self.waypoint:
            attitude = w.quaternion if len(w.quaternion) else None
            velocity = w.velocity_m_s if len(w.velocity_m_s) else None
            points.append(Waypoint(w.position_m, attitude, velocity, w.stop))
        return points

    @property
    def _durations(self) -> list[float] | float | None:
        each = [w.duration_s for w in self.waypoint[1:]]
        return each if all(each) else self.duration_s or None


def read_mission(text: str, name: str) -> Mission:
    """The mission in the text of the file called `name`, .csv or .toml.

    Raises:
        DescriptionError: one line with file, line and what would be right.
    """
    if name.lower().endswith(".csv"):
        return _read_csv(text, name)
    if not name.lower().endswith(".toml"):
        raise DescriptionError(f"{name}: a waypoint file ends in .csv or .toml")
    mission: Mission = build(Mission, parse_toml(text, name), Source(name, text))
    return mission


def line_of(text: str, name: str, waypoint: int) -> int:
    """Line of a waypoint, counted from 0, in the text of the file called `name`, which can be read."""
    if not name.lower().endswith(".csv"):
        return Source(name, text).line_of(("waypoint", waypoint))
    reader = csv.reader(io.StringIO(text), skipinitialspace=True)
    return [reader.line_num for row in reader if row][waypoint + 1]


def _read_csv(text: str, path: str) -> Mission:
    reader = csv.DictReader(io.StringIO(text), skipinitialspace=True, restkey="")
    try:
        reader.fieldnames = _header([name.strip() for name in reader.fieldnames or []], path)
        rows = tuple(_waypoint(row, path, reader.line_num) for row in reader)
    except csv.Error as error:
        raise DescriptionError(f"{path}:{reader.line_num + 1}: not valid CSV: {error}") from None
    try:
        return Mission(waypoint=rows)
    except DescriptionError as error:
        line = f":{line_of(text, path, int(error.keys[1]))}" if error.keys else ""
        raise DescriptionError(f"{path}{line}: {error}") from None


def _header(header: list[str], path: str) -> list[str]:
    """The names of the columns. Raises DescriptionError where one is unknown, missing or duplicated."""
    unknown = [name for name in header if name not in _COLUMNS]
    missing = [name for name in _POSITION if name not in header]
    twice = [name for at, name in enumerate(header) if name in header[:at]]
    what = f"column {unknown[0][:_SHOWN]!r} is unknown; {did_you_mean(unknown[0][:_SHOWN], _COLUMNS)}" if unknown else ""
    what = what or (f"column {missing[0]!r} is missing; " if missing else f"column {twice[0]!r} is there twice; " if twice else "")
    if what:
        raise DescriptionError(f"{path}:1: {what}columns are {', '.join(_COLUMNS)}, commas between them")
    return header


def _waypoint(row: dict[str, str], path: str, line: int) -> WaypointTable:
    table: dict[str, object] = {}
    place = f"{path}:{line}"
    if "" in row:
        raise DescriptionError(f"{place}: has more columns than the header; decimals need a point")
    for key, names in (("position_m", _POSITION), ("quaternion", _ATTITUDE), ("velocity_m_s", _VELOCITY)):
        present = [n for n in names if (row.get(n) or "").strip()]
        if present and len(present) != len(names):
            raise DescriptionError(f"{place}: give all of {', '.join(names)}{'' if names is _POSITION else ' or none'}")
        if present:
            table[key] = [_number(row[n], n, place) for n in present]
    if (row.get("duration_s") or "").strip():
        table["duration_s"] = _number(row["duration_s"], "duration_s", place)
    table["stop"] = _truth(row.get("stop") or "0", "stop", place)
    waypoint: WaypointTable = build(WaypointTable, table, Source(path, "", line))
    return waypoint


def _number(text: str, name: str, place: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise DescriptionError(f"{place}: {name}: {text.strip()[:_SHOWN]!r} is not a number") from None
    if not math.isfinite(value):
        raise DescriptionError(f"{place}: {name}: {text.strip()[:_SHOWN]!r} is not a finite number")
    return value


def _truth(text: str, name: str, place: str) -> bool:
    value = _number(text, name, place)
    if value not in (0.0, 1.0):
        raise DescriptionError(f"{place}: {name}: {text.strip()} is neither 0 nor 1")
    return bool(value)
