"""For each fail-safe: its figure and words, a health just beyond its limit, and parameters with which it alone acts, without delay."""

import math
from dataclasses import replace
from typing import Any

from firmware_py.core.failsafes import TABLE
from firmware_py.core.health import Health
from firmware_py.core.types import DockRequest
from firmware_py.description.failsafe_parameters import Failsafes as Parameters
from tests.unit.healths import GOOD

P = Parameters()
ROWS = {row.name: row for row in TABLE}
FIELDS: dict[str, str] = {
    "leak": "leak", "bus_silent": "bus_silent_s", "foreign_sync": "foreign_sync",
    "foreign_command": "foreign_command", "battery_critical": "voltage_share",
    "cabin_hot": "cabin_c", "cabin_pressure": "cabin_change_pa", "axis_lost": "lost_axes",
    "attitude_lost": "attitude_off_deg", "place_lost": "place_off_m", "depth_unknown": "",
    "tag_gone": "tag_age_s", "partner_lost": "open_joints", "estimator": "nis_ratio", "rejected": "rejected_share",
    "tag_lost": "tag_age_s", "pushed": "push_m_s", "tag_late": "tag_age_s",
    "depth_lost": "depth_age_s", "imu_lost": "imu_age_s", "sensor_lost": "sensor_age_s", "module_silent": "silent_s", "module_late": "late",
    "estop_box_silent": "estop_box_age_s", "ticks_missed": "missed_percent", "fence": "outside_m", "collision": "collision_s",
    "ground_lost": "ground_age_s", "pilot_lost": "pilot_age_s",
    "thruster_lost": "dead", "cabin_unknown": "cabin_age_s", "battery_unknown": "battery_age_s", "battery_low": "voltage_share",
}  # fmt: skip
"""Field of Health that each fail-safe judges; depth_unknown and pushed judge two (see `spoilt`)."""
YES: dict[str, Any] = {
    "leak": True, "foreign_sync": True, "foreign_command": True, "axis_lost": 1,
    "partner_lost": (DockRequest(0, 0, 1, 1),), "thruster_lost": (3,), "module_late": (1,),
}  # fmt: skip
WORDS = {
    "leak": "water in a cabin",
    "bus_silent": "bus silent for 2.0 s",
    "foreign_sync": "somebody else sends SYNC",
    "foreign_command": "somebody else commands modules",
    "battery_critical": "battery critical: 80% of its voltage",
    "cabin_hot": "cabin hot: 70 degC",
    "cabin_pressure": "cabin pressure off by 20000 Pa",
    "axis_lost": "the thrusters left cannot make every wrench",
    "attitude_lost": "attitude not held: 30 deg off",
    "place_lost": "place not held: 0.5 m off",
    "depth_unknown": "depth unknown for 5.0 s",
    "tag_gone": "no tag for 8.0 s",
    "partner_lost": "a docked partner is lost",
    "estimator": "sensors and model disagree: 5.0 of the expected",
    "rejected": "tags refused: 80% of them",
    "tag_lost": "no tag for 8.0 s",
    "pushed": "pushed out of sight as by a current of 0.5 m/s",
    "tag_late": "no tag for 1.0 s",
    "depth_lost": "no pressure for 1.0 s",
    "imu_lost": "no IMU for 0.5 s",
    "sensor_lost": "a module of several has no IMU or no pressure for 1.0 s",
    "module_silent": "a module is silent for 0.5 s",
    "module_late": "a module answers too late, or for another tick",
    "estop_box_silent": "e-stop box silent for 5.0 s",
    "ticks_missed": "ticks missed: 5% of them",
    "fence": "outside the fence by 0.05 m",
    "collision": "another body is in the way, 0.2 s to brake",
    "ground_lost": "ground station silent for 5.0 s",
    "pilot_lost": "pilot silent for 1.0 s",
    "thruster_lost": "a thruster is out",
    "cabin_unknown": "no reading of a cabin for 2.0 s",
    "battery_unknown": "no reading of a battery for 2.0 s",
    "battery_low": "battery low: 87% of its voltage",
}
"""Words of each with its cause only just present (see `bad`)."""


def spoilt(name: str, value: float) -> Health:
    """`GOOD` with the figure of fail-safe `name` at `value`."""
    if name == "depth_unknown":
        return GOOD._replace(tag_age_s=value, depth_age_s=value)
    if name == "pushed":
        return GOOD._replace(tag_age_s=0.6, push_m_s=value)
    return GOOD._replace(**{FIELDS[name]: value})


def bad(name: str) -> Health:
    """`GOOD` with the cause of fail-safe `name` only just present."""
    if name in YES:
        return GOOD._replace(**{FIELDS[name]: YES[name]})
    limit = getattr(P, f"{name}_limit")
    return spoilt(name, math.nextafter(limit, -math.inf if ROWS[name].below else math.inf))


def quick(name: str) -> Parameters:
    """Parameters with which fail-safe `name` alone acts, without delay."""
    none = {f"{row.name}_action": 0 for row in TABLE if row.name != name}
    return replace(P, **none, **{f"{name}_delay_s": 0.0})
