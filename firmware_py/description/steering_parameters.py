"""Parameters of how modes move the set-point: sticks, speeds, surfacing, and how smoothly one mode follows another.
Part of `parameters`.
"""

from __future__ import annotations

from dataclasses import dataclass

from firmware_py.description.schema import quantity


@dataclass(frozen=True, slots=True, kw_only=True)
class Steering:
    """Limits of the set-point's motion, reached at full stick and on the way to a distant place, and the parameters of modes."""

    stick_share: float = quantity(
        0.5, low=0.05, high=1, help="share of the body's force and moment at full stick", mavlink="STICK_SHARE"
    )
    speed_m_s: float = quantity(
        0.3, unit="m/s", low=0.01, high=3, help="speed at full stick, and on the way to a position", mavlink="NAV_SPEED"
    )
    rate_rad_s: float = quantity(
        0.6, unit="rad/s", low=0.01, high=3, help="turning rate at full stick, and on the way to an attitude", mavlink="NAV_RATE"
    )
    bandwidth: float = quantity(
        6.0, unit="rad/s", low=0.5, high=30, help="bandwidth with which the set-point takes up a new speed", mavlink="NAV_BW"
    )
    stick_timeout_s: float = quantity(
        0.5, unit="s", low=0.05, high=10, help="timeout after which stick input counts as neutral", mavlink="STICK_TIMEOUT"
    )
    stick_dead: float = quantity(
        0.03, low=0, high=0.5, help="deadband: stick deflection up to which an axis counts as neutral", mavlink="STICK_DEAD"
    )
    guided_timeout_s: float = quantity(
        0.5, unit="s", low=0.05, high=60,
        help="timeout after which a streamed set-point without a successor stops moving", mavlink="GUID_TIMEOUT"
    )
    join_m: float = quantity(
        0.10,
        unit="m",
        low=1e-3,  # rounding limits how near a set-point comes, and a path whose start is never reached does not begin
        high=10,
        help="distance to the start of a trajectory above which the start is approached first",
        mavlink="AUTO_JOIN",
    )
    join_rad: float = quantity(
        0.20, unit="rad", low=1e-3, high=3.2,
        help="attitude error at the start of a trajectory above which that attitude is taken up first", mavlink="AUTO_JOIN_ANG"
    )
    # Half of the 65 deg up to which the bench's cameras read a tag; at level_rad_s an upside-down module shows its tags within two seconds.
    hold_tilt_rad: float = quantity(
        0.6, unit="rad", low=0, high=3.2, help="tilt above which a body that a fail-safe makes hold turns upright", mavlink="HOLD_TILT"
    )
    level_rad_s: float = quantity(
        1.5, unit="rad/s", low=0.01, high=10,
        help="turning rate of a body that a fail-safe turns upright, to bring its tags back into view", mavlink="HOLD_LVL_RATE"
    )
    surface_speed_m_s: float = quantity(0.10, unit="m/s", low=0.01, high=2, help="ascent speed in SURFACE", mavlink="SURF_SPEED")
    surface_depth_m: float = quantity(
        0.12, unit="m", low=0, high=10,
        help="depth of the (highest docked) module's centre of mass at the surface; a taller hull stays in the water", mavlink="SURF_DEPTH"
    )
    surface_n_per_kg: float = quantity(
        0.2, unit="N/kg", low=0, high=10,
        help="upward force in SURFACE while depth is unknown, per kg that moves: hull, entrained and added mass; at the surface at least "
        "half of it", mavlink="SURF_LIFT"
    )
    blend_s: float = quantity(
        0.3, unit="s", low=0, high=5, help="time over which the wrench is blended into that of a new mode", mavlink="MODE_BLEND"
    )
    test_share: float = quantity(
        0.3, low=0.01, high=1, help="largest share of full force in a motor test", mavlink="MOT_TEST_MAX"
    )
    test_s: float = quantity(
        0.8, unit="s", low=0.1, high=10, help="time per thruster in MOTOR_DETECT, half of it in reverse", mavlink="MOT_TEST_S"
    )
