"""Parameters of the ground station link and of missions. Part of `parameters`."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_py.description.schema import quantity


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """Ground station link and missions; clients may tune these."""

    stick_z: int = quantity(
        0,
        low=0,
        high=1,
        help="MANUAL_CONTROL z: 0: 0 to 1000 with 500 in the middle, 1: -1000 to 1000",
        mavlink="STICK_Z",
    )
    setpoint_fresh_s: float = quantity(
        0.5,
        unit="s",
        low=0.05,
        high=10,
        help="guided mode needs a set-point not older than this, or it ends",
        mavlink="GUID_FRESH",
    )
    watch_s: float = quantity(
        5.0,
        unit="s",
        low=0.5,
        high=600,
        help="silence after which another ground station may take its place",
        mavlink="GCS_WATCH",
    )
    mission_speed_m_s: float = quantity(
        0.15, unit="m/s", low=0.01, high=2, help="of a mission that names no speed", mavlink="MIS_SPEED"
    )
    mission_acceleration: float = quantity(
        0.10, unit="m/s^2", low=0.01, high=2, help="of a mission, along each axis", mavlink="MIS_ACCEL"
    )
    mission_corridor_m: float = quantity(
        0.10,
        unit="m",
        low=0.01,
        high=100,
        help="distance from the straight line between waypoints",
        mavlink="MIS_CORRIDOR",
    )
