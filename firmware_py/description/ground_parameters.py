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
        help="range of MANUAL_CONTROL z; 0: 0 to 1000 with neutral at 500, 1: -1000 to 1000",
        mavlink="STICK_Z",
    )
    setpoint_fresh_s: float = quantity(
        0.5,
        unit="s",
        low=0.05,
        high=10,
        help="timeout of streamed set-points: guided mode neither starts nor continues without a newer one",
        mavlink="GUID_FRESH",
    )
    watch_s: float = quantity(
        3.0,  # less than FS_GCS_LIM: an onlooker who was heard first and leaves must not count as the loss of the pilot's station
        unit="s",
        low=0.5,
        high=600,
        help="silence of the watched ground station after which another may take its place; keep it below FS_GCS_LIM",
        mavlink="GCS_WATCH",
    )
    mission_speed_m_s: float = quantity(
        0.15, unit="m/s", low=0.01, high=2, help="speed of a mission that specifies no speed", mavlink="MIS_SPEED"
    )
    mission_acceleration: float = quantity(
        0.10, unit="m/s^2", low=0.01, high=2, help="acceleration limit of a mission, along each axis", mavlink="MIS_ACCEL"
    )
    mission_corridor_m: float = quantity(
        0.10,
        unit="m",
        low=0.01,
        high=100,
        help="largest distance of a mission's path from the straight line between waypoints",
        mavlink="MIS_CORRIDOR",
    )
