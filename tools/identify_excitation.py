"""For tools/identify.py: a scenario for `modcube hil run FILE` with the motions that a log lacks."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.rotations import to_matrix
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import ThrusterCurve, Vehicle
from firmware_py.prepare.assembly import assemble_vehicle

SPACE_M = (0.6, 0.5, 0.3)
"""Default travel to either side of the middle: keeps the peaks below 0.45 m/s and 0.35 m/s^2."""
RATE_HZ = 9.0 / 170.0
"""Rounds per second at SPACE_M; a smaller space gets more rounds, to keep the acceleration."""
FREQUENCY = (1.0, 1.3, 1.7)
"""Oscillations of each axis per round, out of step so that axes, diagonals and all speeds in between occur."""
YAW_TURNS, ROLL_TURNS = 0.81, 0.57
"""Turns per round: each peaks at half a rad/s; in slower turning the damping hides the inertia."""
SEEN_DEG, LOOKS = 60.0, 72
"""Incidence up to which a tag counts as seen, less than the 65 deg at which a reading ends; and roll angles that are looked at."""
LARGEST_M_S2 = 0.35
"""Peak acceleration with SPACE_M at RATE_HZ."""
SHARE = 0.35
"""Share of what the thrusters can give, force or moment of roll, that the flight may take; drag, current and other axes need the rest."""
DEADBANDS = (0.10 / 0.17, 0.25 / 0.17)
"""Least and largest deadband of the bench's thrusters, over that of the vehicle file: those of the bench, for a module's 0.17 N."""
MOTIONS: Mapping[str, tuple[tuple[int, ...], bool]] = {
    "along x": ((0,), False),
    "along y": ((1,), False),
    "along z": ((2,), False),
    "fast face-on": ((0, 1, 2), False),
    "fast edge-on": ((0, 1), False),
    "turning": ((), True),
}
"""Axes along which each motion oscillates, and whether it turns."""

TEMPLATE = """\
# Written by tools/identify.py: {why}{left_out}.
name = "excite"
help = "for tools/identify.py: {why}"
tags = [0, 1, 2, 3, 4, 5]

[tank]                  # yours in its place
kind = "cylinder"
radius_m = 3.5
depth_m = 3.0

[[module]]
number = 1
vehicle = "{vehicle}"
position_m = [0.0, 0.0, 1.5]

[[camera]]              # above the tank, looking down
position_m = [0.0, 0.0, -1.2]
axis = [0.0, 0.0, 1.0]

[task]
kind = "lissajous"
settle_s = 10.0
duration_s = {duration:.1f}
centre_m = [0.0, 0.0, 1.5]
amplitude_m = {amplitude}
frequency = {frequency}
turns = {turns:.2f}
yaw_turns = {yaw}
roll_turns = {roll}

[[check]]               # it knew where it was
metric = "estimate_position_rmse_m"
high = 0.01

[[check]]               # it flew all of it: a fail-safe ends the motion
metric = "warnings"
high = 0.0
"""
WORLD = """
[world]                 # the bench's thrusters as the vehicle's
thruster_lag_s = {lag:g}
deadband_low_n = {low:.3g}
deadband_high_n = {high:.3g}
"""


def check_space(space_m: Sequence[float]) -> None:
    """Raises DescriptionError unless the distances, m, are finite and not negative."""
    if not all(0.0 <= free < math.inf for free in space_m):
        raise DescriptionError(f"--space {_words(space_m)}: three distances of 0 m or more are needed, what is free to either side")


def _words(space_m: Sequence[float]) -> str:
    return " ".join(f"{free:g}" for free in space_m)


def is_seen_from_above(vehicle: Vehicle) -> bool:
    """Whether the flight's camera sees a tag of the vehicle while that is level."""
    return any(to_matrix(tag.quaternion.copy())[2, 2] >= math.cos(math.radians(SEEN_DEG)) for tag in vehicle.tag)


def pace_of(body: Body) -> float:
    """The pace, at most 1, at which a body's thrusters can make the motion: one that they saturate in tells wrong numbers."""
    return min(1.0, math.sqrt(SHARE * float(body.deceleration[0]) / LARGEST_M_S2))


def why_no_roll(vehicle: Vehicle) -> str:
    """Why a vehicle cannot roll full turns below the camera, in words; empty where it can."""
    if "roll" in vehicle.passive_dof:
        return "its roll is left to buoyancy"
    body = assemble_vehicle(vehicle)
    if np.linalg.norm(body.righting) > SHARE * body.thrusters.full_wrench[3]:
        return "its thrusters are too weak against its righting moment"
    outward = np.array([-to_matrix(tag.quaternion.copy())[:, 2] for tag in vehicle.tag])
    angle = np.linspace(0.0, 2.0 * np.pi, LOOKS, endpoint=False)
    up = np.stack([np.zeros(LOOKS), np.sin(angle), -np.cos(angle)])
    seen = (outward @ up >= math.cos(math.radians(SEEN_DEG))).any(axis=0)
    return "" if seen.all() else "the camera would lose its tags, which do not face all ways"


def excitation(
    motions: Collection[str],
    vehicle: str,
    space_m: Sequence[float] = SPACE_M,
    duration_s: float = 170.0,
    no_roll: str = "",
    curve: ThrusterCurve | None = None,
    pace: float = 1.0,
) -> str:
    """TOML text of a scenario that makes the `motions` (keys of MOTIONS). Raises DescriptionError where one has no room.

    Args:
        vehicle: name or file. space_m: (3,) how far the vehicle may go to either side of the middle, along each world axis.
        no_roll: why the vehicle turns about the vertical alone, if so.
        curve: of the vehicle's thrusters, whose lag and deadband the bench's then have; None: the bench's own.
        pace: share of the usual speed, by `pace_of`.
    """
    check_space(space_m)
    axes = {axis for motion in motions for axis in MOTIONS[motion][0]}
    turns = any(MOTIONS[motion][1] for motion in motions)
    amplitude = [round(min(most, free), 3) if i in axes else 0.0 for i, (most, free) in enumerate(zip(SPACE_M, space_m, strict=True))]
    if narrow := ", ".join("xyz"[i] for i in sorted(axes) if amplitude[i] == 0.0):
        raise DescriptionError(f"--space {_words(space_m)} leaves no room along {narrow}; give what is free to either side, m")
    reach = np.array([a / full for a, full in zip(amplitude, SPACE_M, strict=True) if a > 0.0])
    rounds = pace * RATE_HZ * duration_s / math.sqrt(reach.max() if reach.size else 1.0)
    text = TEMPLATE.format(
        why=", ".join(motion for motion in MOTIONS if motion in motions),
        vehicle=vehicle,
        duration=duration_s,
        amplitude=amplitude,
        frequency=list(FREQUENCY),
        turns=rounds,
        yaw=YAW_TURNS if turns else 0.0,
        roll=ROLL_TURNS if turns and not no_roll else 0.0,
        left_out=f" without roll: {no_roll}" if no_roll else "",
    )
    if curve is None:
        return text
    low, high = (share * curve.deadband_n for share in DEADBANDS)
    return text + WORLD.format(lag=curve.lag_s, low=low, high=high)
