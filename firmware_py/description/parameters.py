"""The only registry of tunables: each with unit, range, default, help and its MAVLink name. Frozen; a change is a new object."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from firmware_py.description.schema import DescriptionError, Limits, build, describe, limits_of, quantity, read_toml


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """PD gains as bandwidth and damping, multiplied by the body's mass matrix, so one set serves every shape."""

    law: str = quantity("model", choices=("model", "paper"), help="model: desired velocity in drag and Coriolis; paper: measured")
    position_bandwidth: float = quantity(2.5, unit="rad/s", low=0.1, high=10, help="of the position loop", mavlink="POS_BW")
    position_damping: float = quantity(1.0, low=0.1, high=5, help="damping ratio of the position loop", mavlink="POS_DAMP")
    attitude_bandwidth: float = quantity(3.0, unit="rad/s", low=0.1, high=20, help="of the attitude loop", mavlink="ATT_BW")
    attitude_damping: float = quantity(1.0, low=0.1, high=5, help="damping ratio of the attitude loop", mavlink="ATT_DAMP")
    drag_feedforward: float = quantity(1.0, low=-2, high=2, help="share of the modelled drag fed forward", mavlink="FF_DRAG")
    disturbance_feedforward: float = quantity(
        1.0, low=0, high=1, help="share of the estimated disturbance fed forward", mavlink="FF_DIST"
    )
    lead_s: float = quantity(0.09, unit="s", low=0, high=0.5, help="thruster lag and bus delay made up in feed-forward", mavlink="FF_LEAD")


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimation:
    """Noise of sensors and of what the model leaves out."""

    kind: str = quantity("full", choices=("full", "paper"), help="full: tag, IMU, depth, disturbance; paper: tags alone")
    tag_sigma_m: float = quantity(0.0021, unit="m", low=1e-5, high=1, help="tag position noise across the camera axis", mavlink="TAG_POS_SD")
    tag_sigma_axis_m: float = quantity(0.0042, unit="m", low=1e-5, high=1, help="along the camera axis", mavlink="TAG_AXIS_SD")
    tag_sigma_rad: float = quantity(0.0090, unit="rad", low=1e-5, high=1, help="tag attitude noise, each axis", mavlink="TAG_ATT_SD")
    tag_gate: float = quantity(5.0, low=1, high=50, help="innovation gate in standard deviations", mavlink="TAG_GATE")
    gyro_sigma: float = quantity(0.003, unit="rad/s", low=1e-6, high=1, help="gyro noise per sample", mavlink="GYRO_SD")
    gyro_bias_walk: float = quantity(2e-5, unit="rad/s/sqrt(s)", low=0, high=1, help="gyro bias random walk", mavlink="GYRO_WALK")
    accel_sigma: float = quantity(0.15, unit="m/s^2", low=1e-4, high=10, help="accelerometer noise and unmodelled acceleration", mavlink="ACC_SD")
    accel_bias_walk: float = quantity(1e-4, unit="m/s^2/sqrt(s)", low=0, high=1, help="accelerometer bias random walk", mavlink="ACC_WALK")
    depth_sigma_m: float = quantity(0.003, unit="m", low=1e-5, high=1, help="depth noise", mavlink="DEPTH_SD")
    depth_bias_walk: float = quantity(2e-4, unit="m/sqrt(s)", low=0, high=1, help="depth bias random walk", mavlink="DEPTH_WALK")
    force_walk: float = quantity(0.012, unit="m/s^2/sqrt(s)", low=0, high=10, help="disturbance force over mass", mavlink="DIST_F_WALK")
    moment_walk: float = quantity(0.15, unit="rad/s^2/sqrt(s)", low=0, high=10, help="disturbance moment over inertia", mavlink="DIST_M_WALK")
    accel_process: float = quantity(0.012, unit="m/s^2/sqrt(Hz)", low=0, high=10, help="white unmodelled acceleration", mavlink="PROC_ACC")
    alpha_process: float = quantity(0.05, unit="rad/s^2/sqrt(Hz)", low=0, high=10, help="white unmodelled angular acceleration", mavlink="PROC_ALPHA")


@dataclass(frozen=True, slots=True, kw_only=True)
class Allocation:
    """From wrench to thrusters."""

    mode: str = quantity("least_squares", choices=("least_squares", "pseudo_inverse"), help="pseudo_inverse clips, as the paper's")
    preload_n: float = quantity(
        0.6, unit="N", low=0, high=5, help="thrusters pushed against each other to stay clear of the deadband", mavlink="PRELOAD"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Limiter:
    """The last word on every thruster, per module."""

    force_share: float = quantity(1.0, low=0.05, high=1.0, help="share of each thruster's limit that may be used", mavlink="LIM_FORCE")
    slew_n_per_s: float = quantity(200.0, unit="N/s", low=1, high=1e4, help="fastest change of a thruster's force", mavlink="LIM_SLEW")


@dataclass(frozen=True, slots=True, kw_only=True)
class Supervision:
    """When the vehicle may arm, and when it must not go on."""

    tag_fresh_ms: float = quantity(500.0, unit="ms", low=10, high=60000, help="a pose older than this is stale", mavlink="TAG_FRESH_MS")
    arm_sigma_m: float = quantity(0.05, unit="m", low=1e-3, high=10, help="largest position sigma to arm with", mavlink="ARM_SIGMA")


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    """All tunables of one firmware process."""

    control: Control = quantity(Control())
    estimation: Estimation = quantity(Estimation())
    allocation: Allocation = quantity(Allocation())
    limiter: Limiter = quantity(Limiter())
    supervision: Supervision = quantity(Supervision())

    def replace(self, dotted: str, value: float | str) -> Parameters:
        """A copy with `group.field` set. Raises DescriptionError when there is no such field or the value is out of range."""
        group_name, _, name = dotted.partition(".")
        group = getattr(self, group_name, None)
        if group is None or name not in {f.name for f in dataclasses.fields(group)}:
            raise DescriptionError(f"parameter {dotted!r} is unknown; there are {', '.join(n for n, _ in registry())}")
        limits = limits_of(type(group), name)
        ok = value in limits.choices if limits.choices else isinstance(value, float | int) and limits.low <= value <= limits.high
        if not ok:
            raise DescriptionError(f"parameter {dotted}: {value!r} is out of range; permitted: {describe(limits)}")
        return dataclasses.replace(self, **{group_name: dataclasses.replace(group, **{name: value})})


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
)
"""The paper's controller with the authors' gains, as accelerations: position 5 and 2, attitude 2 and 1 ."""

CONTROLLERS = {"modcube": Parameters(), "paper": PAPER}
"""Whole sets of parameters by name."""


def registry() -> Iterator[tuple[str, Limits]]:
    """Every tunable as `group.field` with its limits, in a fixed order."""
    for group in dataclasses.fields(Parameters):
        cls = group.default.__class__
        for field in dataclasses.fields(cls):
            yield f"{group.name}.{field.name}", limits_of(cls, field.name)


def load_parameters(path: Path) -> Parameters:
    """The parameters in `path`; what it leaves out keeps its default. Raises DescriptionError, one line."""
    table, source = read_toml(path)
    parameters: Parameters = build(Parameters, table, source)
    return parameters
