"""The only registry of tunable parameters, each with unit, range, default, help and MAVLink name. Frozen; a change makes a new
object.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from firmware_py.description.builder import build
from firmware_py.description.failsafe_parameters import Failsafes, Faults, Fence
from firmware_py.description.ground_parameters import Ground
from firmware_py.description.schema import DescriptionError, Limits, describe, did_you_mean, limits_of, quantity, read_toml
from firmware_py.description.steering_parameters import Steering


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """PD gains as bandwidth and damping. The body's mass matrix multiplies them, so one set serves every shape."""

    law: str = quantity(
        "model", choices=("model", "paper"), help="drag and Coriolis terms; model: of the desired velocity, paper: of the measured velocity"
    )
    position_bandwidth: float = quantity(
        3.45, unit="rad/s", low=0.1, high=10, help="bandwidth of the position loop", mavlink="POS_BW"
    )
    position_damping: float = quantity(
        1.16, low=0.1, high=5, help="damping ratio of the position loop", mavlink="POS_DAMP"
    )
    attitude_bandwidth: float = quantity(
        2.5, unit="rad/s", low=0.1, high=12, help="bandwidth of the attitude loop", mavlink="ATT_BW"
    )
    attitude_damping: float = quantity(
        1.18, low=0.1, high=5, help="damping ratio of the attitude loop", mavlink="ATT_DAMP"
    )
    drag_feedforward: float = quantity(
        1.0, low=-2, high=2, help="share of the modelled drag fed forward", mavlink="FF_DRAG"
    )
    disturbance_feedforward: float = quantity(
        1.0, low=0, high=1, help="share of the estimated disturbance fed forward", mavlink="FF_DIST"
    )
    lead_s: float = quantity(
        0.09, unit="s", low=0, high=0.5,
        help="lead time of the feed-forward, which compensates thruster lag and bus delay", mavlink="FF_LEAD"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimation:
    """Measurement noise of the sensors, and process noise for what the model leaves out."""

    kind: str = quantity(
        "full",
        choices=("full", "paper"),
        help="full: tags, IMU and depth, with disturbance estimate; paper: tags alone, too noisy for more than the paper's gains",
    )
    tag_sigma_m: float = quantity(
        0.0021, unit="m", low=1e-4, high=1,  # 0.1 mm: motion capture
        help="horizontal tag position noise: across the axis of a camera that looks down", mavlink="TAG_POS_SD"
    )
    tag_sigma_axis_m: float = quantity(
        0.0042, unit="m", low=1e-4, high=1,
        help="vertical tag position noise: along the axis of a camera that looks down", mavlink="TAG_AXIS_SD"
    )
    tag_sigma_rad: float = quantity(
        0.0096, unit="rad", low=5e-4, high=1, help="tag attitude noise, each axis", mavlink="TAG_ATT_SD"
    )
    tag_gate: float = quantity(
        5.0, low=4, high=50,
        help="gate: largest accepted root of a tag's NIS over all six axes; 2.4 is typical", mavlink="TAG_GATE"
    )
    gyro_sigma: float = quantity(0.0022, unit="rad/s", low=1e-6, high=1, help="gyro noise per sample", mavlink="GYRO_SD")
    gyro_bias_walk: float = quantity(
        2.2e-5, unit="rad/s/sqrt(s)", low=0, high=1, help="gyro bias random walk", mavlink="GYRO_WALK"
    )
    accel_sigma: float = quantity(
        0.036, unit="m/s^2", low=1e-4, high=10,
        help="accelerometer noise per sample, including the effect of the mounting position", mavlink="ACC_SD"
    )
    accel_under_way: float = quantity(
        0.33,
        unit="m/s^2/(m/s)",
        low=0,
        high=10,
        help="accelerometer noise added per speed, for errors of mass and drag, in a sample period of 10 ms",
        mavlink="ACC_SD_WAY",
    )
    accel_bias_walk: float = quantity(
        1e-4, unit="m/s^2/sqrt(s)", low=0, high=1, help="accelerometer bias random walk", mavlink="ACC_WALK"
    )
    depth_sigma_m: float = quantity(0.003, unit="m", low=2e-4, high=1, help="depth noise per sample", mavlink="DEPTH_SD")
    depth_bias_walk: float = quantity(
        2e-4, unit="m/sqrt(s)", low=0, high=1, help="depth bias random walk", mavlink="DEPTH_WALK"
    )
    force_walk: float = quantity(
        0.0021, unit="m/s^2/sqrt(s)", low=0, high=10,
        help="random walk of the disturbance force over mass, for a body at rest", mavlink="DIST_F_WALK"
    )
    current_walk: float = quantity(
        0.086, unit="m/s/sqrt(s)", low=0, high=1,
        help="random walk of the water's speed, which acts by drag on a body under way", mavlink="DIST_C_WALK"
    )
    moment_walk: float = quantity(
        0.035, unit="rad/s^2/sqrt(s)", low=0, high=10,
        help="random walk of the disturbance moment over inertia, for a body at rest", mavlink="DIST_M_WALK"
    )
    righting_walk: float = quantity(
        0.007, unit="1/sqrt(s)", low=0, high=1,
        help="random walk of trim and righting arm, relative to their initial uncertainty", mavlink="DIST_R_WALK"
    )
    accel_process: float = quantity(
        0.0107, unit="m/s^2/sqrt(Hz)", low=0, high=10, help="process noise: white unmodelled acceleration", mavlink="PROC_ACC"
    )
    alpha_process: float = quantity(
        0.026,
        unit="rad/s^2/sqrt(Hz)",
        low=0,
        high=10,
        help="process noise: white unmodelled angular acceleration",
        mavlink="PROC_ALPHA",
    )
    alpha_turning: float = quantity(
        0.05, unit="rad/s^2/sqrt(Hz)/(rad/s)", low=0, high=10,
        help="process noise added per turning rate: white unmodelled angular acceleration", mavlink="PROC_ALPHA_W"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Allocation:
    """Allocation of wrenches to thrusters."""

    mode: str = quantity(
        "least_squares",
        choices=("least_squares", "least_power", "pseudo_inverse"),
        help="least_power: uses the thrusters' power curves; pseudo_inverse: clips, as in the paper",
    )
    preload_n: float = quantity(
        0.6,
        unit="N",
        low=0,
        high=5,
        help="preload of thrusters against each other, to stay clear of the deadband",
        mavlink="PRELOAD",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Limiter:
    """Final limits on every thruster and docking magnet, per module."""

    force_share: float = quantity(
        1.0, low=0.05, high=1.0, help="share of each thruster's limit that may be used", mavlink="LIM_FORCE"
    )
    slew_n_per_s: float = quantity(
        200.0, unit="N/s", low=10, high=1e4, help="slew rate limit of a thruster's force", mavlink="LIM_SLEW"
    )
    relay_on_s: float = quantity(
        60.0, unit="s", low=1, high=3600,
        help="longest time that a cold docking magnet may stay on; without effect while relay_duty is 1", mavlink="LIM_MAG_ON"
    )
    relay_duty: float = quantity(
        1.0, low=0.01, high=1,
        help="largest long-term duty cycle of a docking magnet; below 1, docked modules come apart after relay_on_s / (1 - relay_duty)",
        mavlink="LIM_MAG_DUTY"
    )
    relay_w: float = quantity(
        6.0,
        unit="W",
        low=0,
        high=50,
        help="power of a docking magnet that is on, subtracted from the power available to thrusters",
        mavlink="LIM_MAG_W",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Supervision:
    """Limits of arming, end of an e-stop, and re-arming after a restart."""

    tag_fresh_ms: float = quantity(
        500.0, unit="ms", low=10, high=60000,
        help="age of the newest tag above which the pose is too old to arm with", mavlink="TAG_FRESH_MS"
    )
    arm_sigma_m: float = quantity(
        0.05, unit="m", low=1e-3, high=10, help="largest standard deviation of the position to arm with", mavlink="ARM_SIGMA"
    )
    answer_ms: float = quantity(
        200.0,
        unit="ms",
        low=5,
        high=5000,
        help="timeout after which a module that does not answer counts as silent for arming",
        mavlink="ARM_ANSWER_MS",
    )
    esc_fresh_ms: float = quantity(
        1000.0, unit="ms", low=50, high=10000, help="age above which ESC feedback counts as missing", mavlink="ARM_ESC_MS"
    )
    frame_errors_per_s: float = quantity(
        20.0, unit="1/s", low=0, high=10000, help="largest rate of bad frames to arm with", mavlink="ARM_FRAME_ERR"
    )
    bus_load: float = quantity(
        0.8, low=0.05, high=2, help="largest share of a bus in use to arm with, mean over one second, with the most stuff bits",
        mavlink="ARM_BUS_LOAD",
    )
    estop_quiet_ms: float = quantity(
        200.0,
        unit="ms",
        low=200,  # the time that modules themselves wait before they release (docs/mcu.md)
        high=5000,
        help="time without an e-stop frame after which an e-stop is over",
        mavlink="ESTOP_QUIET_MS",
    )
    estop_box: int = quantity(
        0, low=0, high=1, help="1: the robot has an e-stop box, and is not armed before it is heard", mavlink="ARM_ESTOP_BOX"
    )
    rearm: int = quantity(
        0, low=0, high=1, help="after a restart in flight; 1: arm and hold at once, 0: wait to be armed", mavlink="REARM"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Docking:
    """Docking detector and docking sequence."""

    current_threshold_ma: float = quantity(
        70.0, unit="mA", low=1, high=8000,
        help="magnet current, of either sign, that both docked faces must exceed; paper: 70 mA", mavlink="DOCK_MA"
    )
    current_hysteresis_ma: float = quantity(
        15.0, unit="mA", low=0, high=1000,
        help="hysteresis: reduction of the current threshold while the current condition holds", mavlink="DOCK_MA_HYST"
    )
    position_tolerance_m: float = quantity(
        0.0028, unit="m", low=1e-4, high=0.1,
        help="largest position error of docked faces, off one pitch; smaller than a jam leaves", mavlink="DOCK_TOL"
    )
    settled_m: float = quantity(
        0.004,
        unit="m",
        low=1e-4,
        high=0.1,
        help="movement of the relative position that still counts as settled",
        mavlink="DOCK_SETTLED",
    )
    hysteresis_m: float = quantity(
        0.004, unit="m", low=0, high=0.1,
        help="hysteresis: added to position_tolerance_m and settled_m while the position condition holds", mavlink="DOCK_HYST"
    )
    open_m: float = quantity(
        0.02,
        unit="m",
        low=1e-3,
        high=1,
        help="position error above which a joint is open; intact joints show up to 12 mm (Moebius strip)",
        mavlink="DOCK_OPEN",
    )
    debounce_ms: float = quantity(
        150.0,
        unit="ms",
        low=0,
        high=5000,
        help="debounce time of the docking conditions",
        mavlink="DOCK_DEBOUNCE",
    )
    current_fresh_ms: float = quantity(
        250.0, unit="ms", low=10, high=5000, help="age above which a magnet current is stale", mavlink="DOCK_MA_AGE"
    )
    pose_fresh_ms: float = quantity(
        300.0, unit="ms", low=10, high=5000,
        help="age above which a picture is stale; a slow camera needs 5 of its periods", mavlink="DOCK_POSE_AGE"
    )
    approach: str = quantity(
        "staged",
        choices=("staged", "straight"),
        help="staged: align at standoff_m first; straight: on one line, and a target that holds position meets half-way",
    )
    standoff_m: float = quantity(
        0.12, unit="m", low=0.02, high=2, help="gap at which the bodies are aligned", mavlink="DOCK_STANDOFF"
    )
    align_m: float = quantity(
        0.004, unit="m", low=1e-4, high=0.1, help="largest lateral error with which the approach begins", mavlink="DOCK_ALIGN"
    )
    align_rad: float = quantity(
        0.035, unit="rad", low=1e-3, high=1, help="largest angle error with which the approach begins", mavlink="DOCK_ALIGN_ANG"
    )
    align_s: float = quantity(
        1.0, unit="s", low=0, high=30, help="time that the alignment must hold before the approach begins", mavlink="DOCK_ALIGN_T"
    )
    speed_m_s: float = quantity(0.04, unit="m/s", low=0.001, high=0.5, help="largest approach speed", mavlink="DOCK_SPEED")
    contact_speed_m_s: float = quantity(
        0.012, unit="m/s", low=0.001, high=0.5, help="approach speed at contact", mavlink="DOCK_TOUCH"
    )
    push_s: float = quantity(
        3.0,
        unit="s",
        low=0,
        high=60,
        help="time that the faces are pushed together before a jam is declared",
        mavlink="DOCK_PUSH_T",
    )
    push_m: float = quantity(
        0.010, unit="m", low=0, high=0.1, help="distance beyond contact to which the set-point moves", mavlink="DOCK_PUSH"
    )
    release_s: float = quantity(
        1.0,
        unit="s",
        low=0.01,
        high=60,
        help="time that magnets push apart after a jam or to undock; an undock ends once its joints are open, and waits for late readings",
        mavlink="DOCK_RELEASE",
    )
    sigma_m: float = quantity(
        0.005, unit="m", low=1e-4, high=0.1,
        help="standard deviation of the relative position above which docking is aborted", mavlink="DOCK_SIGMA"
    )
    tries: int = quantity(4, low=1, high=20, help="number of attempts before docking fails", mavlink="DOCK_TRIES")
    timeout_s: float = quantity(
        60.0, unit="s", low=1, high=600,
        help="timeout of a docking stage, and of waiting for another body in that stage", mavlink="DOCK_TIMEOUT"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    """All tunables of one firmware process."""

    control: Control = quantity(Control())
    estimation: Estimation = quantity(Estimation())
    allocation: Allocation = quantity(Allocation())
    limiter: Limiter = quantity(Limiter())
    supervision: Supervision = quantity(Supervision())
    docking: Docking = quantity(Docking())
    steering: Steering = quantity(Steering())
    failsafes: Failsafes = quantity(Failsafes())
    faults: Faults = quantity(Faults())
    fence: Fence = quantity(Fence())
    ground: Ground = quantity(Ground())

    def replace(self, dotted: str, value: float | str) -> Parameters:
        """Returns a copy with `group.field` set. Raises DescriptionError if there is no such field or the value is out of range."""
        group_name, _, name = dotted.partition(".")
        if dotted not in (known := dict(registry())):
            raise DescriptionError(f"parameter {dotted!r} is unknown; {did_you_mean(dotted, known)}`modcube parameters` prints them all")
        group = getattr(self, group_name)
        limits = limits_of(type(group), name)
        if isinstance(getattr(group, name), int) and isinstance(value, float) and value.is_integer():
            value = int(value)  # MAVLink sends every number as a float
        fits = type(value) is type(getattr(group, name)) or (type(value) is int and type(getattr(group, name)) is float)
        if not (fits and limits.permits(value)):
            raise DescriptionError(f"parameter {dotted}: {value!r} is out of range; permitted: {describe(limits)}")
        kept = type(getattr(group, name))(value)  # an int where compiled functions expect a float would break the tick
        return dataclasses.replace(self, **{group_name: dataclasses.replace(group, **{name: kept})})


PAPER = Parameters(
    control=Control(
        law="paper",
        position_bandwidth=5.0**0.5,
        position_damping=2.0 / (2.0 * 5.0**0.5),
        attitude_bandwidth=2.0**0.5,
        attitude_damping=1.0 / (2.0 * 2.0**0.5),
        disturbance_feedforward=0.0,
        lead_s=0.0,
    ),
    estimation=Estimation(kind="paper"),
    allocation=Allocation(mode="pseudo_inverse"),
    docking=Docking(approach="straight", speed_m_s=0.03, contact_speed_m_s=0.03, sigma_m=0.1, push_s=15.0, tries=1),
)
"""The paper's controller with the authors' gains, as accelerations: position 5 and 2, attitude 2 and 1. It docks in a straight line at
constant speed, in one try, at any uncertainty up to 0.1 m. The paper gives neither the speed nor the time of pushing: synthetic."""

CONTROLLERS = {
    "modcube": Parameters(),
    "least_power": Parameters(allocation=Allocation(mode="least_power")),
    "paper": PAPER,
    "paper_sequence": Parameters(docking=PAPER.docking),
}
"""Complete parameter sets by name. `paper_sequence` docks as the paper does, and flies and estimates as `modcube` does."""


_TUNABLES = tuple(
    (group.name, field.name, limits_of(type(group.default), field.name))
    for group in dataclasses.fields(Parameters)
    for field in dataclasses.fields(type(group.default))  # type: ignore[arg-type]
)
"""Group, field and limits of every parameter. Computed once, because the tick that arms checks them."""


def registry() -> Iterator[tuple[str, Limits]]:
    """Every parameter as `group.field` with its limits, in a fixed order."""
    for group, name, limits in _TUNABLES:
        yield f"{group}.{name}", limits


def invalid(parameters: Parameters) -> list[str]:
    """Reports, in words, the parameters that are out of range; empty if none is."""
    reasons = []
    for group, name, limits in _TUNABLES:
        value = getattr(getattr(parameters, group), name)
        if not limits.permits(value):
            reasons.append(f"parameter {group}.{name}: {value!r} is out of range; permitted: {describe(limits)}")
    return reasons


def load_parameters(path: Path) -> Parameters:
    """Loads the parameters in `path`; missing ones keep their defaults. Raises DescriptionError, one line."""
    table, source = read_toml(path)
    parameters: Parameters = build(Parameters, table, source)
    return parameters
