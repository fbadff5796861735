"""Values that pass between the stages of a tick. Everything else about a stage stays in its own file.

One tick: Inputs -> (Estimate, Setpoint, Wrench, Thrust per body) -> Outputs. World NED, body FRD, SI units.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from firmware_py.description.vehicle import MOST_THRUSTERS

Array = np.ndarray
CHANNELS, FACES = MOST_THRUSTERS, 6
"""Number of thruster commands in one module's frames; number of docking faces of a module, each with its relay."""
RELAY_OFF, RELAY_PULL, RELAY_PUSH = 0, 1, 2
"""States of a docking relay, as DOCK_CMD has them."""
COMMAND_TIMEOUT_NS = 100_000_000
"""Time without commands after which a module's microcontroller stops its thrusters (can_dbc/README.md)."""
MCU_TIMED_OUT, MCU_ESTOP = 3, 4
"""MCU_STATUS states of a module that hears no commands, and of one that is held by an e-stop."""
MCU_UNFIT = (0, MCU_TIMED_OUT, 5)
"""MCU_STATUS states of a module that is starting, hears no commands, or has a fault of its own: its thrusters stand still."""
CRITICAL, WARNING, NOTICE, INFORMATION = 2, 4, 5, 6
"""Severities of an `Event`, numbered as in syslog and STATUSTEXT."""
NEVER_NS = -(1 << 60)
"""Time of something that has not come yet."""
NEVER_AGE_NS = -NEVER_NS
"""An age of this or more means that nothing has come yet."""


# ---------------------------------------------------------------- inputs


class TagObservation(NamedTuple):
    """One tag seen once: its two TAG frames, paired."""

    tag_id: int
    quality: int
    capture_ns: int
    """Capture time of the picture, on the firmware's clock."""
    p_wt: Array
    """(3,) tag centre in the world, m."""
    q_wt: Array
    """(4,) tag frame to world."""


class EscFeedback(NamedTuple):
    """The two ESCs of one feedback frame."""

    first: int
    """Index of its first thruster in the module."""
    rpm: tuple[float, float]
    current_a: tuple[float, float]
    status: tuple[int, int]


class DockFeedback(NamedTuple):
    """Three docking faces of one feedback frame."""

    first: int
    """Index of the first face."""
    current_ma: tuple[float, float, float]
    relay: tuple[int, int, int]
    """Actual states of the relays."""


@dataclass(slots=True)
class ModuleInputs:
    """Contents of one module's frames since the previous tick; None or empty where nothing fresh came."""

    gyro: Array | None = None
    """(3,) angular rate, module frame, rad/s."""
    accel: Array | None = None
    """(3,) specific force, module frame, m/s^2."""
    pressure_pa: float | None = None
    tags: list[TagObservation] = field(default_factory=list)
    docks: list[DockFeedback] = field(default_factory=list)
    esc: list[EscFeedback] = field(default_factory=list)
    voltage_v: float | None = None
    current_a: float | None = None
    water_temperature_c: float | None = None
    cabin_temperature_c: float | None = None
    cabin_pressure_pa: float | None = None
    leak: bool | None = None
    mcu_state: int | None = None
    answered: bool = False
    """Whether its MCU_STATUS of this tick has arrived."""
    late_ticks: int = 0
    """How many ticks old the newest MCU_STATUS is that has arrived since the previous tick."""
    heard: bool = False
    """Whether any frame of the module came."""


class Mode(IntEnum):
    """How an armed body is steered. Names and numbers are ArduSub's where the meaning is the same."""

    STABILIZE = 0
    """Sticks command force and turning rate; attitude is held."""
    ALT_HOLD = 2
    """As STABILIZE, with depth held."""
    AUTO = 3
    """Follows a trajectory or mission."""
    GUIDED = 4
    """Follows streamed set-points."""
    SURFACE = 9
    """Rises and stays at the surface."""
    POSHOLD = 16
    """Holds the place; sticks move it."""
    MANUAL = 19
    """Sticks command forces and moments directly."""
    MOTOR_DETECT = 20
    """Turns one thruster after the other."""
    DOCK = 30
    """The docking sequence steers. The number is modcube's own."""


class Action(IntEnum):
    """What a person or program may request of a body; the Request's `argument` in brackets."""

    ARM = 1
    """[bool: forced]"""
    DISARM = 2
    """[bool: forced]"""
    HOLD = 3
    """POSHOLD [Setpoint, or None: here]"""
    TRACK = 4
    """AUTO [Trajectory]"""
    ESTOP = 5
    CLEAR_ESTOP = 6
    SET_MODE = 7
    """[Mode]"""
    STICKS = 8
    """[Sticks]"""
    SET_POINT = 9
    """GUIDED's newest set-point [Setpoint]"""
    SET_PARAMETER = 10
    """[(name in the registry, value)]"""
    DOCK = 11
    """[DockRequest]"""
    UNDOCK = 12
    """[DockRequest]"""
    MOTOR_TEST = 13
    """[(thruster, share of full command, seconds)]"""
    GROUND_ALIVE = 14
    """The ground station was heard [None]"""


class Sticks(NamedTuple):
    """Pilot input, each -1 to 1, body FRD: forward, right, down; roll, pitch, yaw."""

    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    moment: tuple[float, float, float] = (0.0, 0.0, 0.0)


class DockRequest(NamedTuple):
    """Which faces are to dock, or to undock."""

    module: int
    """Fleet index of the active module."""
    face: int
    """Its face, 0 to 5 as description.vehicle.FACE_NAMES."""
    target_module: int
    target_face: int
    quarter_turns: int = 0
    """Of the active module about the normal of the target's face, from the seat that turns it least, 0 to 3."""
    both_approach: bool = False
    """Both bodies move, as in the paper."""


class PartRequest(NamedTuple):
    """Request to fly a body that has come apart as its pieces."""

    joints: tuple[DockRequest, ...]
    """All open joints of the body."""


class Request(NamedTuple):
    """One request that enters a tick: from a ground station, a scenario or the command line."""

    action: Action
    body: int = 0
    """Number of the body: the fleet index of its leader."""
    argument: Any = None


@dataclass(slots=True)
class Inputs:
    """Everything that enters one tick."""

    tick: int
    time_ns: int
    modules: list[ModuleInputs]
    requests: list[Request] = field(default_factory=list)
    estop: bool = False
    """An ESTOP frame came since the previous tick."""
    dropped_frames: int = 0
    """Frames dropped by the codec so far, all kinds."""
    foreign_sync: bool = False
    """Another node's SYNC came since the previous tick."""
    foreign_command: bool = False
    """Another node's THRUSTER_CMD or DOCK_CMD came since the previous tick."""
    estop_box: bool = False
    """A HEARTBEAT of an e-stop box that works came since the previous tick."""
    prepared: list[Any] = field(default_factory=list)
    """Results of the worker: docking_decisions.Prepared."""
    busy_s: float = 0.0
    """Time for which frames occupied the fullest bus since the previous tick, s, with the most stuff bits."""


# ---------------------------------------------------------------- between the stages


class Measured(NamedTuple):
    """Sensors of all modules of a body, fused, in the body frame."""

    gyro: Array | None
    """(3,) rad/s."""
    accel: Array | None
    """(3,) specific force at the centre of mass, m/s^2; the lever arm of the IMUs heard is removed with the gyro."""
    depth_m: float | None
    """Depth of the centre of mass from pressure, without the datum's bias."""
    tags: list[BodyPose]


class ExpectedDepth(NamedTuple):
    """What the estimate says that depth sensors must tell."""

    depth_m: float
    """Depth of the centre of mass, with the datum's bias."""
    sigma_m: float
    """Standard deviation of a reading from it."""
    down_b: Sequence[float]
    """(3,) downward unit vector, body frame."""


class BodyPose(NamedTuple):
    """Pose of a body measured by one or more of its tags in one picture."""

    capture_ns: int
    p_wt: Array
    """(3,) mean of the tag centres, world, m."""
    lever_b: Array
    """(3,) mean of the tag centres from the centre of mass, body frame, m."""
    q_wb: Array
    """(4,) attitude of the body."""
    tags: float
    """Equivalent number of tags of full quality; noise falls with its square root."""


class Estimate(NamedTuple):
    """The estimator's state at the time of the tick."""

    p_wb: Array
    q_wb: Array
    nu: Array
    """(6,) velocity of the centre of mass and angular rate, body frame."""
    force_w: Array
    """(3,) disturbance force, world, N."""
    moment_b: Array
    """(3,) disturbance moment, body, N m."""
    sigma_p: Array
    """(3,) standard deviation of the position, world, m."""
    sigma_q: Array
    """(3,) standard deviation of the attitude, body axes, rad."""
    tag_age_ns: int
    """Time since the last accepted tag observation was taken; very large before the first."""
    nis: float
    """Normalised innovation squared, summed over the tag updates of this tick; NaN without one."""
    nis_dof: int
    """Degrees of freedom of `nis`."""
    rejected: int
    """Number of tag observations refused so far: beyond the gate, older than one that was fused, against gravity, or not finite."""
    ready: bool
    """Whether an attitude has been found: by tags, or by gravity before the first tag."""
    starts: int = 0
    """How often it started: from the first pose, and anew where tags contradicted it, so that the pose jumped."""

    @property
    def placed(self) -> bool:
        """Whether tags have fixed heading and position."""
        return self.ready and self.tag_age_ns < NEVER_AGE_NS


class Setpoint(NamedTuple):
    """Wanted motion at one time."""

    p_wb: Array
    q_wb: Array
    v_w: Array
    """(3,) velocity, world, m/s."""
    w_b: Array
    """(3,) angular rate, wanted body frame, rad/s."""
    a_w: Array
    """(3,) acceleration, world."""
    alpha_b: Array
    """(3,) angular acceleration, wanted body frame."""


class ThrustLimits(NamedTuple):
    """What the limiter passes continuously: the limits of the allocation."""

    low_n: Array
    """(n,) reverse limit of each thruster, N, negative."""
    high_n: Array
    """(n,) forward limit of each thruster, N."""
    supply_w: Array
    """(m,) power of each module's supply that is available to thrusters, W."""


class Thrust(NamedTuple):
    """Result of the allocation."""

    force_n: Array
    """(n,) force of each thruster, N."""
    achieved: Array
    """(6,) wrench of these forces."""
    scale: tuple[float, float]
    """Shares of the wanted force and moment that are kept, 0 to 1, relative to what the remaining thrusters can make (faults.keep)."""
    margin: float = math.nan
    """Share of its range that the most loaded thruster has left, 0 to 1; NaN while single motors are tested."""


# ---------------------------------------------------------------- outputs


class ModuleCommand(NamedTuple):
    """Command to one module in this tick."""

    armed: bool
    thrusters: Array
    """(8,) share of full command, -1 to 1."""
    relays: tuple[int, ...] | None
    """Six relay states to send, or None when DOCK_CMD is not due."""


class Event(NamedTuple):
    """A message for people."""

    severity: int
    """CRITICAL, WARNING or INFORMATION."""
    text: str
    body: int | None = None
    """Number of the body that it concerns; None: all bodies, or none that exists."""


class BodyRecord(NamedTuple):
    """All internal signals of one body in one tick, as the recorder stores them."""

    body: int
    state: int
    """core.transitions.State"""
    mode: int
    """Mode; while disarmed, the one to arm in."""
    estimate: Estimate
    setpoint: Setpoint
    wrench: Array
    """(6,) wanted wrench, body frame."""
    thrust: Thrust
    commanded_n: Array
    """(n,) force of each thruster after the limiter."""
    may_arm: bool
    """Whether the body is disarmed and passed every arming check at the last evaluation, at most 0.1 s ago."""
    level: int
    """failsafes.Level of the fail-safe that chose the mode; NONE if a person chose it."""


class DockRecord(NamedTuple):
    """The faces of one dock under way in one tick."""

    module_a: int
    face_a: int
    module_b: int
    face_b: int
    stage: int
    """docking_sequence.Stage."""
    tries: int
    current_ma: tuple[float, float]
    current_holds: bool
    position_holds: bool
    gap_m: float
    """Gap between the faces, from the estimates."""
    lateral_m: float
    position_error_m: float
    """Deviation of the relative position from one pitch, from fresh pictures."""


@dataclass(slots=True)
class Outputs:
    """Everything that leaves one tick."""

    tick: int
    time_ns: int
    modules: list[ModuleCommand]
    estop: bool
    """Whether the firmware raises ESTOP."""
    events: list[Event]
    records: list[BodyRecord]
    docks: list[DockRecord] = field(default_factory=list)
    joints: Array | None = None
    """(k,) of docking_pairs.PAIR: all joints, pairs of faces that hold modules of one body together."""
    preparations: list[DockRequest | PartRequest] = field(default_factory=list)
    """Docks, undocks and partings of bodies that have come apart, to be prepared outside the control loop; results return in
    Inputs.prepared.
    """
