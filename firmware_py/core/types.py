"""The values that pass between the stages of a tick. Everything else about a stage stays in its own file.

One tick: Inputs -> (Estimate, Setpoint, Wrench, Thrust per body) -> Outputs. World NED, body FRD, SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray
CHANNELS, FACES = 8, 6
"""Thruster commands that one module's frames carry; docking faces of a module, each with its relay."""
RELAY_OFF, RELAY_PULL, RELAY_PUSH = 0, 1, 2
"""States of a docking relay, as DOCK_CMD has them."""
MCU_ESTOP = 4
"""State of MCU_STATUS: an e-stop holds the module."""
MCU_UNFIT = (0, 5)
"""States of MCU_STATUS: the module starts, or has a fault of its own."""
CRITICAL, WARNING, NOTICE, INFORMATION = 2, 4, 5, 6
"""Severities of an `Event`, as syslog and STATUSTEXT have them."""
NEVER_NS = -(1 << 60)
"""Time of what has not come yet."""
NEVER_AGE_NS = -NEVER_NS
"""What is so old, or older, has not come yet."""


# ---------------------------------------------------------------- what comes in


class TagObservation(NamedTuple):
    """One tag seen once: both TAG frames of it, paired."""

    tag_id: int
    quality: int
    capture_ns: int
    """Time of the picture, on the firmware's clock."""
    p_wt: Array
    """(3,) tag centre in the world, m."""
    q_wt: Array
    """(4,) tag frame to world."""


class EscFeedback(NamedTuple):
    """Both ESCs of one feedback frame."""

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
    """States that the relays are in."""


@dataclass(slots=True)
class ModuleInputs:
    """What one module's frames said since the previous tick; None or empty where nothing fresh came."""

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
    """Its MCU_STATUS of this tick is in."""
    heard: bool = False
    """Any frame of the module came."""


class Mode(IntEnum):
    """How an armed body is steered; ArduSub's names and numbers where the meaning is the same."""

    STABILIZE = 0
    """Sticks give force and turning rate; attitude is held."""
    ALT_HOLD = 2
    """As STABILIZE, and depth is held."""
    AUTO = 3
    """Follows a trajectory or mission."""
    GUIDED = 4
    """Follows set-points that stream in."""
    SURFACE = 9
    """Rises and stays up."""
    POSHOLD = 16
    """Holds the place; sticks move it."""
    MANUAL = 19
    """Sticks are forces and moments."""
    MOTOR_DETECT = 20
    """Turns one thruster after the other."""
    DOCK = 30
    """The docking sequence steers; modcube's own number."""


class Action(IntEnum):
    """What a person or program may ask of a body; `argument` of the Request in brackets."""

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
    """[(name as in the registry, value)]"""
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
    """Which faces are to meet, or to part."""

    module: int
    """Fleet index of the active module."""
    face: int
    """Its face, 0 to 5 as description.vehicle.FACE_NAMES."""
    target_module: int
    target_face: int
    quarter_turns: int = 0
    """Rotation of the active face about its normal against the target's, 0 to 3."""
    both_approach: bool = False
    """Both bodies move, as in the paper."""


class PartRequest(NamedTuple):
    """What asks for a body to be flown as the pieces that it has come to."""

    joints: tuple[DockRequest, ...]
    """All of its joints that are open."""


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
    """A SYNC of somebody else came since the previous tick."""
    foreign_command: bool = False
    """A THRUSTER_CMD or DOCK_CMD of somebody else came since the previous tick."""
    prepared: list[Any] = field(default_factory=list)
    """Results of the worker: docking.Prepared."""


# ---------------------------------------------------------------- between the stages


class Measured(NamedTuple):
    """Sensors of all modules of a body, fused, in the body frame."""

    gyro: Array | None
    """(3,) rad/s."""
    accel: Array | None
    """(3,) specific force at the centre of mass, m/s^2; where the IMUs heard stand beside it, angular acceleration by the gyro."""
    depth_m: float | None
    """Depth of the centre of mass by pressure, without the datum's bias."""
    tags: list[BodyPose]


class BodyPose(NamedTuple):
    """What one or more tags of a body, seen in one picture, say of its pose."""

    capture_ns: int
    p_wt: Array
    """(3,) mean of the tag centres, world, m."""
    lever_b: Array
    """(3,) mean of the tag centres from the centre of mass, body frame, m."""
    q_wb: Array
    """(4,) attitude of the body."""
    tags: float
    """Tags of full quality that it is worth; the noise falls with the root."""


class Estimate(NamedTuple):
    """What the estimator believes at the tick's time."""

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
    """Normalised innovation squared of the tag updates of this tick, summed; NaN without one."""
    nis_dof: int
    """Its degrees of freedom."""
    rejected: int
    """Tag observations refused by the gate so far."""
    ready: bool
    """An attitude has been found: by tags, or before the first by gravity."""

    @property
    def placed(self) -> bool:
        """Whether tags have told heading and place."""
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


class Room(NamedTuple):
    """What passes the limiter for as long as one likes: the allocation's limits."""

    low_n: Array
    """(n,) of each thruster, N, in reverse: negative."""
    high_n: Array
    """(n,) forward."""
    supply_w: Array
    """(m,) what each module's supply has for thrusters, W."""


class Thrust(NamedTuple):
    """Result of the allocation."""

    force_n: Array
    """(n,) force of each thruster, N."""
    achieved: Array
    """(6,) wrench that these forces give."""
    scale: tuple[float, float]
    """Share of the wanted force and moment that is kept, 0 to 1, as far as the thrusters that are left can make them (faults.keep)."""
    margin: float = math.nan
    """Share of its range that the busiest thruster has left, 0 to 1; NaN while single motors are tested."""


# ---------------------------------------------------------------- what goes out


class ModuleCommand(NamedTuple):
    """What one module is told in this tick."""

    armed: bool
    thrusters: Array
    """(8,) share of full command, -1 to 1."""
    relays: tuple[int, ...] | None
    """Six wanted relay states, or None when DOCK_CMD is not due."""


class Event(NamedTuple):
    """Something a person may want to read."""

    severity: int
    """CRITICAL, WARNING or INFORMATION."""
    text: str
    body: int | None = None
    """Number of the body that it is about; None: all of them, or none that there is."""


class BodyRecord(NamedTuple):
    """Every internal signal of one body in one tick, as the recorder stores it."""

    body: int
    state: int
    """core.transitions.State"""
    mode: int
    """Mode; while disarmed the one to arm in."""
    estimate: Estimate
    setpoint: Setpoint
    wrench: Array
    """(6,) wanted wrench, body."""
    thrust: Thrust
    commanded_n: Array
    """(n,) force of each thruster after the limiter."""
    may_arm: bool
    """Disarmed, and every arming check held when they were asked last, at most 0.1 s ago."""
    level: int
    """failsafes.Level: what a fail-safe has made of the mode; NONE when a person chose it."""


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
    """Between the faces, by the estimates."""
    lateral_m: float
    position_error_m: float
    """Off one pitch, by fresh pictures."""


@dataclass(slots=True)
class Outputs:
    """Everything that leaves one tick."""

    tick: int
    time_ns: int
    modules: list[ModuleCommand]
    estop: bool
    """The firmware raises ESTOP."""
    events: list[Event]
    records: list[BodyRecord]
    docks: list[DockRecord] = field(default_factory=list)
    joints: Array | None = None
    """(k,) of docking_pairs.PAIR: all faces that hold modules of one body together."""
    preparations: list[DockRequest | PartRequest] = field(default_factory=list)
    """Docks, undocks of modules of one body, and bodies that have come apart, to be prepared beside the loop; they come back in
    Inputs.prepared.
    """
