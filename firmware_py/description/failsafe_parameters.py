"""Fail-safe parameters: limit, delay, action and latching of each fail-safe; also the fence and the thruster fault limits.

Part of `parameters`. core.failsafes has the matching table: what is measured, in which modes, in which order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from firmware_py.description.schema import quantity

ACTION = "0 none, 1 warn, 2 hold position, 3 hold depth and attitude, 4 surface, 5 disarm"
LATCHED = "1: latched until disarmed, 0: ends once the cause has been gone for clear_s"


def delay(default_s: float, mavlink: str) -> Any:
    """A field for the time that the cause must last."""
    return quantity(default_s, unit="s", low=0, high=600, help="time the cause must last before the fail-safe acts", mavlink=mavlink)


def action(default: int, mavlink: str) -> Any:
    """A field for the action, see `ACTION`."""
    return quantity(default, low=0, high=5, help=ACTION, mavlink=mavlink)


def latched(default: int, mavlink: str) -> Any:
    """A field for whether the fail-safe stays on until the body is disarmed."""
    return quantity(default, low=0, high=1, help=LATCHED, mavlink=mavlink)


@dataclass(frozen=True, slots=True, kw_only=True)
class Failsafes:
    """One block per fail-safe, gravest first, in the order of core.failsafes."""

    # water in a cabin
    leak_delay_s: float = delay(0.5, "FS_LEAK_S")
    leak_action: int = action(4, "FS_LEAK_ACT")
    leak_latched: int = latched(1, "FS_LEAK_LAT")
    # every module silent, or this process stopped for a while: the bus is off, and thrusters stop by themselves
    bus_silent_limit: float = quantity(
        2.0, unit="s", low=0.1, high=60,
        help="longest permitted time without a frame from any module, or without a tick", mavlink="FS_BUS_LIM"
    )
    bus_silent_delay_s: float = delay(0.0, "FS_BUS_S")
    bus_silent_action: int = action(5, "FS_BUS_ACT")
    bus_silent_latched: int = latched(0, "FS_BUS_LAT")
    # another node sends SYNC
    foreign_sync_delay_s: float = delay(0.0, "FS_SYNC_S")
    foreign_sync_action: int = action(4, "FS_SYNC_ACT")
    foreign_sync_latched: int = latched(1, "FS_SYNC_LAT")
    # another node sends THRUSTER_CMD or DOCK_CMD
    foreign_command_delay_s: float = delay(0.0, "FS_CMD_S")
    foreign_command_action: int = action(1, "FS_CMD_ACT")
    foreign_command_latched: int = latched(0, "FS_CMD_LAT")
    # battery nearly empty
    battery_critical_limit: float = quantity(
        0.8, low=0.3, high=1.2, help="lowest permitted supply voltage, as a share of the nominal voltage", mavlink="FS_BATC_LIM"
    )
    battery_critical_delay_s: float = delay(5.0, "FS_BATC_S")
    battery_critical_action: int = action(4, "FS_BATC_ACT")
    battery_critical_latched: int = latched(1, "FS_BATC_LAT")
    # electronics too hot
    cabin_hot_limit: float = quantity(
        70.0, unit="degC", low=0, high=150, help="highest permitted cabin temperature", mavlink="FS_HOT_LIM"
    )
    cabin_hot_delay_s: float = delay(5.0, "FS_HOT_S")
    cabin_hot_action: int = action(4, "FS_HOT_ACT")
    cabin_hot_latched: int = latched(0, "FS_HOT_LAT")
    # the hull fails
    cabin_pressure_limit: float = quantity(
        20000.0, unit="Pa", low=100, high=200000,
        help="largest permitted change of a cabin's pressure since its first reading", mavlink="FS_CABP_LIM"
    )
    cabin_pressure_delay_s: float = delay(2.0, "FS_CABP_S")
    cabin_pressure_action: int = action(4, "FS_CABP_ACT")
    cabin_pressure_latched: int = latched(1, "FS_CABP_LAT")
    # the remaining thrusters cannot make every wrench
    axis_lost_delay_s: float = delay(3.0, "FS_AXIS_S")
    axis_lost_action: int = action(4, "FS_AXIS_ACT")
    axis_lost_latched: int = latched(1, "FS_AXIS_LAT")
    # the body does not turn as it is told: something holds or tows it, thrusters or gains do not fit it, or frames come too late. With 5 it
    # is disarmed, as by ArduSub's crash check, which also waits for 30 deg and two seconds
    attitude_lost_limit: float = quantity(
        30.0, unit="deg", low=5, high=180, help="largest permitted angle between body and set-point, RMS over one second",
        mavlink="FS_ATT_LIM",
    )
    attitude_lost_delay_s: float = delay(2.0, "FS_ATT_S")
    attitude_lost_action: int = action(1, "FS_ATT_ACT")
    attitude_lost_latched: int = latched(0, "FS_ATT_LAT")
    # the body is not where it is told to be: something pushes, holds or tows it harder than its thrusters can, or its tags have jumped.
    # On the bench 6 N move a module by less than 0.3 m, and it swims back at 0.7 m/s: 3 s outlast the way back from a jump of 1 m
    place_lost_limit: float = quantity(
        0.5, unit="m", low=0.05, high=100, help="largest permitted distance between body and set-point, RMS over one second",
        mavlink="FS_PLC_LIM",
    )
    place_lost_delay_s: float = delay(3.0, "FS_PLC_S")
    place_lost_action: int = action(1, "FS_PLC_ACT")
    place_lost_latched: int = latched(0, "FS_PLC_LAT")
    # depth unknown
    depth_unknown_limit: float = quantity(
        5.0, unit="s", low=0.1, high=600,
        help="longest permitted time with neither a trusted pressure reading nor a tag, or without an attitude", mavlink="FS_DEPU_LIM"
    )
    depth_unknown_delay_s: float = delay(0.0, "FS_DEPU_S")
    depth_unknown_action: int = action(4, "FS_DEPU_ACT")
    depth_unknown_latched: int = latched(0, "FS_DEPU_LAT")
    # tags do not come back: a body that a fail-safe holds at its depth surfaces, 30 s after the last tag, or 22 s after the loss of a pilot
    # who flew without tags
    tag_gone_limit: float = quantity(
        8.0, unit="s", low=0.1, high=3600,
        help="longest permitted time without a tag; counts also in an ALT_HOLD that a fail-safe chose", mavlink="FS_TAGG_LIM"
    )
    tag_gone_delay_s: float = delay(22.0, "FS_TAGG_S")
    tag_gone_action: int = action(4, "FS_TAGG_ACT")
    tag_gone_latched: int = latched(0, "FS_TAGG_LAT")
    # a docked partner is lost
    partner_lost_delay_s: float = delay(0.4, "FS_PART_S")
    partner_lost_action: int = quantity(
        2, low=0, high=5, help=f"{ACTION}; with 0 a body that has come apart is still flown as one", mavlink="FS_PART_ACT"
    )
    partner_lost_latched: int = latched(0, "FS_PART_LAT")
    # sensors and model disagree
    estimator_limit: float = quantity(
        5.0, low=1.5, high=100, help="largest permitted NIS of the tags over its expected value, mean over one second", mavlink="FS_EST_LIM"
    )
    estimator_delay_s: float = delay(2.0, "FS_EST_S")
    estimator_action: int = action(3, "FS_EST_ACT")
    estimator_latched: int = latched(0, "FS_EST_LAT")
    # the gate rejects tags
    rejected_limit: float = quantity(
        0.8, low=0.05, high=1, help="largest permitted share of tags rejected by the gate, mean over one second", mavlink="FS_REJ_LIM"
    )
    rejected_delay_s: float = delay(2.0, "FS_REJ_S")
    rejected_action: int = action(3, "FS_REJ_ACT")
    rejected_latched: int = latched(0, "FS_REJ_LAT")
    # position unknown
    tag_lost_limit: float = quantity(
        8.0, unit="s", low=0.1, high=600,
        help="longest permitted time without a tag in modes that hold or follow a position", mavlink="FS_TAGL_LIM"
    )
    tag_lost_delay_s: float = delay(0.0, "FS_TAGL_S")
    tag_lost_action: int = action(3, "FS_TAGL_ACT")
    tag_lost_latched: int = latched(0, "FS_TAGL_LAT")
    # a wall, a hand or a rope pushes while no tag is seen: the estimated position runs away
    pushed_limit: float = quantity(
        0.5, unit="m/s", low=0.05, high=10,
        help="largest permitted push without tags, as speed of an equivalent current, RMS over one second", mavlink="FS_PUSH_LIM"
    )
    pushed_delay_s: float = delay(0.5, "FS_PUSH_S")
    pushed_action: int = action(3, "FS_PUSH_ACT")
    pushed_latched: int = latched(0, "FS_PUSH_LAT")
    # position uncertain
    tag_late_limit: float = quantity(
        1.0, unit="s", low=0.05, high=60,
        help="longest permitted time without a tag in position modes other than POSHOLD", mavlink="FS_TAGM_LIM"
    )
    tag_late_delay_s: float = delay(0.0, "FS_TAGM_S")
    tag_late_action: int = action(2, "FS_TAGM_ACT")
    tag_late_latched: int = latched(0, "FS_TAGM_LAT")
    # pressure sensor lost
    depth_lost_limit: float = quantity(
        1.0, unit="s", low=0.1, high=60, help="longest permitted time without a trusted pressure reading", mavlink="FS_DEPL_LIM"
    )
    depth_lost_delay_s: float = delay(0.0, "FS_DEPL_S")
    depth_lost_action: int = action(1, "FS_DEPL_ACT")
    depth_lost_latched: int = latched(0, "FS_DEPL_LAT")
    # the IMU is silent, faulty or frozen
    imu_lost_limit: float = quantity(
        0.5, unit="s", low=0.1, high=60,
        help="longest permitted time without a trusted IMU sample from any module of the body", mavlink="FS_IMU_LIM"
    )
    imu_lost_delay_s: float = delay(0.0, "FS_IMU_S")
    imu_lost_action: int = action(2, "FS_IMU_ACT")
    imu_lost_latched: int = latched(0, "FS_IMU_LAT")
    # a module of several has lost its IMU or pressure sensor: the body flies on with those of the others, the module alone could not
    sensor_lost_limit: float = quantity(
        1.0, unit="s", low=0.1, high=60,
        help="longest permitted time without a trusted IMU sample or pressure of a single module, in a body of several",
        mavlink="FS_SENS_LIM",
    )
    sensor_lost_delay_s: float = delay(0.0, "FS_SENS_S")
    sensor_lost_action: int = action(1, "FS_SENS_ACT")
    sensor_lost_latched: int = latched(0, "FS_SENS_LAT")
    # a CAN node is silent, or obeys no commands
    module_silent_limit: float = quantity(
        0.5, unit="s", low=0.1, high=60,
        help="longest permitted time in which a single module is silent, or reports that it obeys no commands", mavlink="FS_MOD_LIM"
    )
    module_silent_delay_s: float = delay(0.0, "FS_MOD_S")
    module_silent_action: int = action(2, "FS_MOD_ACT")
    module_silent_latched: int = latched(0, "FS_MOD_LAT")
    # a module is heard, but for ARM_ANSWER_MS no MCU_STATUS came in its own tick: its bus delays frames, or its board is slow. The delay
    # outlasts old frames that a bus brings at once when it is back
    module_late_delay_s: float = delay(0.5, "FS_LATE_S")
    module_late_action: int = action(1, "FS_LATE_ACT")
    module_late_latched: int = latched(0, "FS_LATE_LAT")
    # the e-stop box is unplugged or dead: nobody could stop the robot with it. The limit is ten of its HEARTBEATs, so that a bus that loses
    # a third of its frames does not raise it
    estop_box_silent_limit: float = quantity(
        5.0, unit="s", low=1, high=60,
        help="longest permitted silence of the e-stop box, once it was heard; it sends HEARTBEAT at 2 Hz", mavlink="FS_EBOX_LIM"
    )
    estop_box_silent_delay_s: float = delay(0.0, "FS_EBOX_S")
    estop_box_silent_action: int = action(2, "FS_EBOX_ACT")
    estop_box_silent_latched: int = latched(0, "FS_EBOX_LAT")
    # the controller is late
    ticks_missed_limit: float = quantity(
        5.0, unit="%", low=1, high=100, help="largest permitted share of missed ticks, mean over one second", mavlink="FS_TICK_LIM"
    )
    ticks_missed_delay_s: float = delay(0.5, "FS_TICK_S")
    ticks_missed_action: int = action(2, "FS_TICK_ACT")
    ticks_missed_latched: int = latched(0, "FS_TICK_LAT")
    # outside the fence. A body that holds a place on it moves about that place by millimetres, and a mission's item may lie 20 mm beyond
    fence_limit: float = quantity(
        0.05, unit="m", low=0, high=10,
        help="largest permitted distance of the body beyond the fence; counts also in an ALT_HOLD that a fail-safe chose",
        mavlink="FS_FENC_LIM",
    )
    fence_delay_s: float = delay(0.2, "FS_FENC_S")
    fence_action: int = action(2, "FS_FENC_ACT")
    fence_latched: int = latched(0, "FS_FENC_LAT")
    # another body is in the way; docks and undocks give way by themselves. The delay takes half of the limit, the other half is margin
    collision_limit: float = quantity(
        0.2, unit="s", low=0, high=60,
        help="least permitted time until the body must brake to stop before another towards which it moves or wants to; 0: not watched",
        mavlink="FS_COL_LIM",
    )
    collision_delay_s: float = delay(0.1, "FS_COL_S")
    collision_action: int = action(2, "FS_COL_ACT")
    collision_latched: int = latched(0, "FS_COL_LAT")
    # ground station lost
    ground_lost_limit: float = quantity(
        5.0, unit="s", low=0.5, high=600,
        help="longest permitted silence of the ground station that is watched, once one was heard", mavlink="FS_GCS_LIM"
    )
    ground_lost_delay_s: float = delay(0.0, "FS_GCS_S")
    ground_lost_action: int = action(2, "FS_GCS_ACT")
    ground_lost_latched: int = latched(0, "FS_GCS_LAT")
    # pilot input lost
    pilot_lost_limit: float = quantity(
        1.0, unit="s", low=0.1, high=60, help="longest permitted time without stick input, once there was some", mavlink="FS_RC_LIM"
    )
    pilot_lost_delay_s: float = delay(0.0, "FS_RC_S")
    pilot_lost_action: int = action(2, "FS_RC_ACT")
    pilot_lost_latched: int = latched(0, "FS_RC_LAT")
    # a thruster is dead or lies: it counts as that until the body is disarmed, the thruster acquitted (core.thruster_trial), or its failed
    # ESC well again
    thruster_lost_delay_s: float = delay(0.0, "FS_THR_S")
    thruster_lost_action: int = action(1, "FS_THR_ACT")
    thruster_lost_latched: int = latched(0, "FS_THR_LAT")
    # a module does not report whether it leaks: readings come at 5 Hz; the delay allows for the first one
    cabin_unknown_limit: float = quantity(
        2.0, unit="s", low=0.5, high=60,
        help="largest permitted age of a cabin reading (leak, temperature, pressure), also for arming", mavlink="FS_CABU_LIM"
    )
    cabin_unknown_delay_s: float = delay(1.0, "FS_CABU_S")
    cabin_unknown_action: int = action(1, "FS_CABU_ACT")
    cabin_unknown_latched: int = latched(0, "FS_CABU_LAT")
    # a module does not report its battery voltage
    battery_unknown_limit: float = quantity(
        2.0, unit="s", low=0.5, high=60,
        help="largest permitted age of a module's supply voltage reading, also for arming", mavlink="FS_BATU_LIM"
    )
    battery_unknown_delay_s: float = delay(1.0, "FS_BATU_S")
    battery_unknown_action: int = action(1, "FS_BATU_ACT")
    battery_unknown_latched: int = latched(0, "FS_BATU_LAT")
    # battery low
    battery_low_limit: float = quantity(
        0.875, low=0.3, high=1.2, help="lowest permitted supply voltage, as a share of the nominal voltage", mavlink="FS_BATL_LIM"
    )
    battery_low_delay_s: float = delay(5.0, "FS_BATL_S")
    battery_low_action: int = action(1, "FS_BATL_ACT")
    battery_low_latched: int = latched(0, "FS_BATL_LAT")

    clear_s: float = quantity(
        2.0, unit="s", low=0, high=60, help="time the cause must be gone before a fail-safe ends", mavlink="FS_CLEAR_S"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Fence:
    """Permitted region of the body's centre of mass, world. Wide open by default: a tank's size belongs in its parameter file."""

    north_m: float = quantity(
        100.0, unit="m", low=0.1, high=100000.0, help="largest permitted distance north or south of the origin", mavlink="FENCE_NORTH"
    )
    east_m: float = quantity(
        100.0, unit="m", low=0.1, high=100000.0, help="largest permitted distance east or west of the origin", mavlink="FENCE_EAST"
    )
    top_m: float = quantity(-1.0, unit="m", low=-10, high=1000, help="smallest permitted depth", mavlink="FENCE_TOP")
    bottom_m: float = quantity(50.0, unit="m", low=0.1, high=10000.0, help="largest permitted depth", mavlink="FENCE_BOTTOM")


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """When a thruster counts as dead or as lying (core.faults)."""

    force_n: float = quantity(
        0.25, unit="N", low=0.05, high=10,
        help="smallest modelled thruster force at which a propeller that stands still counts as faulty; at least 1.45 deadbands",
        mavlink="FLT_FORCE",
    )
    dead_share: float = quantity(
        0.45, low=0.05, high=0.95, help="share of the expected speed below which a propeller counts as standing still", mavlink="FLT_DEAD"
    )
    dead_count: int = quantity(
        3, low=1, high=50,
        help="consecutive ESC reports that must agree; a repeated standstill at 4 force_n or more counts twice", mavlink="FLT_COUNT"
    )
    stray_count: int = quantity(
        2, low=1, high=50, help="consecutive ESC reports of overspeed or wrong direction, which can overturn the robot", mavlink="FLT_STRAY"
    )
    lie_share: float = quantity(
        0.6, low=0.2, high=1.5, help="share of a thruster's force that must be missing from the measured motion", mavlink="FLT_LIE"
    )
    lie_count: int = quantity(
        4, low=1, high=50, help="consecutive blocks of 0.1 s in which force of the same thruster must be missing", mavlink="FLT_LIE_COUNT"
    )
