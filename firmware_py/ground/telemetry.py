"""Messages that a system streams, each built from the picture of the last tick. World NED, body FRD."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from firmware_py.core.rotations import to_euler
from firmware_py.core.types import CHANNELS
from firmware_py.description.vehicle import FACE_NAMES
from firmware_py.ground.identity import TYPE_SUBMARINE, base_mode
from firmware_py.ground.picture import ESC_SILENT, ModulePicture
from firmware_py.ground.subject import ACTIVE, Subject
from firmware_py.ground.tick_times import histograms, load_permille

Values = Mapping[str, Any]
_NAN = math.nan
_UNKNOWN_16, _UNKNOWN_BATTERY = 0xFFFF, -1
_UNKNOWN_TEMPERATURE = 0x7FFF
"""BATTERY_STATUS's value for unknown. SCALED_PRESSURE defines none, but 0 would mean water at freezing point."""
_STATE_STANDBY, _STATE_ACTIVE, _STATE_CRITICAL, _STATE_EMERGENCY = 3, 4, 5, 6
_NO_GPS = 0
"""GPS_FIX_TYPE."""
_FRAME_LOCAL_NED, _FRAME_BODY_FRD = 1, 12
_PWM_CENTRE, _PWM_HALF = 1500, 400


def heartbeat(s: Subject) -> list[Values]:
    mode = base_mode(s.picture.mode(s.body), s.armed)
    return [{
        "type": TYPE_SUBMARINE, "autopilot": s.identity.autopilot, "base_mode": mode, "custom_mode": s.custom_mode,
        "system_status": _state(s), "mavlink_version": 3,
    }]  # fmt: skip


def _state(s: Subject) -> int:
    """Returns the MAV_STATE; the most severe condition prevails."""
    if s.picture.is_stopped(s.body):
        return _STATE_EMERGENCY
    if s.picture.is_in_failsafe(s.body):
        return _STATE_CRITICAL
    return _STATE_ACTIVE if s.armed else _STATE_STANDBY


SENSORS = {
    "gyro": 0x01, "accel": 0x02, "pressure": 0x08, "vision": 0x80, "rate": 0x400, "attitude": 0x800, "yaw": 0x1000,
    "depth": 0x2000, "position": 0x4000, "motors": 0x8000, "battery": 0x2000000, "prearm": 0x10000000,
}  # fmt: skip
"""MAV_SYS_STATUS_SENSOR."""
_SENSOR_FRESH_NS = 500_000_000


def sys_status(s: Subject) -> list[Values]:
    now = s.picture.time_ns
    fresh = s.picture.pose_is_fresh(s.body)
    modules, ready = s.modules, s.record.estimate.ready
    pressure = any(now - m.pressure_ns < _SENSOR_FRESH_NS for m in modules)
    healthy = {
        "gyro": all(now - m.gyro_ns < _SENSOR_FRESH_NS for m in modules),
        "accel": all(now - m.accel_ns < _SENSOR_FRESH_NS for m in modules),
        "pressure": pressure,
        "vision": fresh,
        "rate": True,
        "attitude": ready,
        "yaw": fresh,
        "depth": ready and (pressure or fresh),
        "position": fresh,
        "motors": all(now - m.answered_ns < _SENSOR_FRESH_NS for m in modules),
        "battery": all(now - m.voltage_ns < _SENSOR_FRESH_NS for m in modules),
        "prearm": s.armed or (s.neutral and s.picture.may_arm(s.body)),
    }
    known = sum(SENSORS.values())
    return [{
        "onboard_control_sensors_present": known, "onboard_control_sensors_enabled": known,
        "onboard_control_sensors_health": sum(SENSORS[name] for name, ok in healthy.items() if ok),
        "voltage_battery": _scaled(modules[0].voltage_v, 1e3, _UNKNOWN_16),
        "current_battery": _scaled(sum(m.current_a for m in modules), 1e2, -1), "battery_remaining": _UNKNOWN_BATTERY,
        "errors_comm": s.picture.dropped_frames & 0xFFFF, "load": load_permille(s.picture.times),
    }]  # fmt: skip


def attitude(s: Subject) -> list[Values]:
    e = s.record.estimate
    roll, pitch, yaw = to_euler(e.q_wb)
    p, q, r = e.nu[3:]
    return [{
        "time_boot_ms": s.time_ms, "roll": roll, "pitch": pitch, "yaw": yaw,
        "rollspeed": p, "pitchspeed": q, "yawspeed": r,
    }]  # fmt: skip


def attitude_quaternion(s: Subject) -> list[Values]:
    e = s.record.estimate
    q, w = e.q_wb, e.nu[3:]
    return [{
        "time_boot_ms": s.time_ms, "q1": q[0], "q2": q[1], "q3": q[2], "q4": q[3],
        "rollspeed": w[0], "pitchspeed": w[1], "yawspeed": w[2],
    }]  # fmt: skip


def local_position_ned(s: Subject) -> list[Values]:
    p, v = s.record.estimate.p_wb, s.v_w
    return [{"time_boot_ms": s.time_ms, "x": p[0], "y": p[1], "z": p[2], "vx": v[0], "vy": v[1], "vz": v[2]}]


_DIAGONAL = (0, 6, 11, 15, 18, 20)
"""Indices of a 6x6 matrix's diagonal in its upper triangle, row by row."""


def odometry(s: Subject) -> list[Values]:
    e = s.record.estimate
    pose, velocity = [0.0] * 21, [_NAN] * 21
    for place, sigma in zip(_DIAGONAL, (*e.sigma_p, *e.sigma_q), strict=True):
        pose[place] = float(sigma) ** 2
    v, w = e.nu[:3], e.nu[3:]
    quality = 100 if s.picture.pose_is_fresh(s.body) else -1
    return [{
        "time_usec": s.time_us, "frame_id": _FRAME_LOCAL_NED, "child_frame_id": _FRAME_BODY_FRD,
        "x": e.p_wb[0], "y": e.p_wb[1], "z": e.p_wb[2], "q": e.q_wb.tolist(), "vx": v[0], "vy": v[1], "vz": v[2],
        "rollspeed": w[0], "pitchspeed": w[1], "yawspeed": w[2], "pose_covariance": pose,
        "velocity_covariance": velocity, "reset_counter": s.picture.restarts.get(s.body, 0) & 0xFF, "estimator_type": 2, "quality": quality,
    }]  # fmt: skip


def global_position_int(s: Subject) -> list[Values]:
    e, v = s.record.estimate, s.v_w
    heading = round(_heading_deg(s) * 100) % 36000 if e.placed else _UNKNOWN_16
    latitude, longitude, altitude = s.origin.geodetic(e.p_wb)
    return [{
        "time_boot_ms": s.time_ms, "lat": round(latitude * 1e7), "lon": round(longitude * 1e7),
        "alt": round(altitude * 1e3), "relative_alt": round(-e.p_wb[2] * 1e3),
        "vx": round(v[0] * 100), "vy": round(v[1] * 100), "vz": round(v[2] * 100),
        "hdg": heading,
    }]  # fmt: skip


def vfr_hud(s: Subject) -> list[Values]:
    e, v = s.record.estimate, s.v_w
    speed = math.hypot(v[0], v[1])
    command = [float(np.abs(m.command).mean()) for m in s.modules]
    return [{
        "airspeed": speed, "groundspeed": speed, "heading": round(_heading_deg(s)) % 360,
        "throttle": round(100 * sum(command) / len(command)), "alt": s.origin.altitude_m - e.p_wb[2], "climb": -v[2],
    }]  # fmt: skip


def battery_status(s: Subject) -> list[Values]:
    return [{
        "id": i, "battery_function": 0, "type": 0, "temperature": _UNKNOWN_TEMPERATURE,
        "voltages": [_scaled(m.voltage_v, 1e3, _UNKNOWN_16), *[_UNKNOWN_16] * 9],
        "current_battery": _scaled(m.current_a, 1e2, -1), "current_consumed": -1, "energy_consumed": -1,
        "battery_remaining": _UNKNOWN_BATTERY,
    } for i, m in enumerate(s.modules)]  # fmt: skip


def servo_output_raw(s: Subject) -> list[Values]:
    return [{
        "time_usec": s.time_us & 0xFFFFFFFF, "port": i,
        **{f"servo{n + 1}_raw": round(_PWM_CENTRE + _PWM_HALF * float(c)) for n, c in enumerate(m.command)},
    } for i, m in enumerate(s.modules)]  # fmt: skip


def esc_status(s: Subject) -> list[Values]:
    return [{
        "index": CHANNELS * i + first, "time_usec": s.time_us, "rpm": [round(r) for r in m.rpm[first : first + 4]],
        "voltage": [m.voltage_v] * 4, "current": m.esc_current_a[first : first + 4],
    } for i, m in enumerate(s.modules) for first in (0, 4)]  # fmt: skip


_ESC_FAILURES = (0, 64, 4, 0)
"""ESC_FAILURE_FLAGS of each EscStatus: none, generic, over-temperature; a silent ESC has no flag, it is reported offline."""
_BY_CAN = 4
"""ESC_CONNECTION_TYPE."""


def esc_info(s: Subject) -> list[Values]:
    count = CHANNELS * len(s.modules)
    return [{
        "index": CHANNELS * i + first, "time_usec": s.time_us, "counter": m.esc_frames & 0xFFFF, "count": count,
        "connection_type": _BY_CAN, "info": _online(s, m, first),
        "failure_flags": [_ESC_FAILURES[status] for status in m.esc_status[first : first + 4]],
        "error_count": (0, 0, 0, 0), "temperature": (_UNKNOWN_TEMPERATURE,) * 4,
    } for i, m in enumerate(s.modules) for first in (0, 4)]  # fmt: skip


def _online(s: Subject, m: ModulePicture, first: int) -> int:
    """Returns a bit mask of those of the four ESCs from `first` on that are heard; 0 when their module does not answer."""
    answers = s.picture.time_ns - m.answered_ns < _SENSOR_FRESH_NS
    return sum(1 << n for n, status in enumerate(m.esc_status[first : first + 4]) if answers and status != ESC_SILENT)


def scaled_pressure(s: Subject) -> list[Values]:
    m = s.modules[0]
    return [_pressure(s, m.cabin_pressure_pa, m.cabin_temperature_c)]


def scaled_pressure2(s: Subject) -> list[Values]:
    m = s.modules[0]
    return [_pressure(s, m.pressure_pa, m.water_temperature_c)]


def _pressure(s: Subject, pressure_pa: float, temperature_c: float) -> Values:
    return {
        "time_boot_ms": s.time_ms, "press_abs": pressure_pa / 100, "press_diff": 0.0,
        "temperature": _scaled(temperature_c, 100, _UNKNOWN_TEMPERATURE),
    }  # fmt: skip


def named_value_float(s: Subject) -> list[Values]:
    """Docking currents, A, as DOCK0+X (module within the body, face), and WRENCH_MRG, the busiest thruster's remaining share of range."""
    values = [
        (f"DOCK{i}{FACE_NAMES[face].upper()}", current * 1e-3)
        for i, m in enumerate(s.modules)
        for face, current in enumerate(m.dock_current_ma)
        if not math.isnan(current)
    ]
    values.append(("WRENCH_MRG", s.record.thrust.margin))
    return [{"time_boot_ms": s.time_ms, "name": name, "value": value} for name, value in values]


def extended_sys_state(s: Subject) -> list[Values]:
    return [{"vtol_state": 0, "landed_state": 2 if s.armed else 1}]


def home_position(s: Subject) -> list[Values]:
    o = s.origin
    return [{
        "latitude": round(o.latitude_deg * 1e7), "longitude": round(o.longitude_deg * 1e7),
        "altitude": round(o.altitude_m * 1e3), "q": (1.0, 0.0, 0.0, 0.0), "time_usec": s.time_us,
    }]  # fmt: skip


def gps_global_origin(s: Subject) -> list[Values]:
    o = s.origin
    return [{
        "latitude": round(o.latitude_deg * 1e7), "longitude": round(o.longitude_deg * 1e7),
        "altitude": round(o.altitude_m * 1e3), "time_usec": s.time_us,
    }]  # fmt: skip


def gps_raw_int(s: Subject) -> list[Values]:
    """Reports no GPS, in ArduSub's form: DroneKit does not start before it has received a GPS message."""
    unknown = dict.fromkeys(("eph", "epv", "vel", "cog"), _UNKNOWN_16)
    return [{"time_usec": s.time_us, "fix_type": _NO_GPS, "satellites_visible": 0, **unknown}]


def mission_current(s: Subject) -> list[Values]:
    p = s.progress
    return [{
        "seq": p.current, "total": p.total or _UNKNOWN_16, "mission_state": p.state,
        "mission_mode": 1 if p.state == ACTIVE else 2,
    }]  # fmt: skip


def current_mode(s: Subject) -> list[Values]:
    return [{"standard_mode": 0, "custom_mode": s.custom_mode, "intended_custom_mode": s.custom_mode}]


def system_time(s: Subject) -> list[Values]:
    return [{"time_unix_usec": 0, "time_boot_ms": s.time_ms}]


def _heading_deg(s: Subject) -> float:
    return math.degrees(to_euler(s.record.estimate.q_wb)[2]) % 360.0


def _scaled(value: float, factor: float, unknown: int) -> int:
    return unknown if math.isnan(value) else round(value * factor)


STREAMS: Mapping[str, Callable[[Subject], list[Values]]] = {
    "HEARTBEAT": heartbeat,
    "SYS_STATUS": sys_status,
    "ATTITUDE": attitude,
    "ATTITUDE_QUATERNION": attitude_quaternion,
    "LOCAL_POSITION_NED": local_position_ned,
    "ODOMETRY": odometry,
    "GLOBAL_POSITION_INT": global_position_int,
    "VFR_HUD": vfr_hud,
    "BATTERY_STATUS": battery_status,
    "SERVO_OUTPUT_RAW": servo_output_raw,
    "ESC_STATUS": esc_status,
    "ESC_INFO": esc_info,
    "SCALED_PRESSURE": scaled_pressure,
    "SCALED_PRESSURE2": scaled_pressure2,
    "NAMED_VALUE_FLOAT": named_value_float,
    "DEBUG_FLOAT_ARRAY": lambda s: histograms(s.picture.times, s.time_us),
    "EXTENDED_SYS_STATE": extended_sys_state,
    "HOME_POSITION": home_position,
    "GPS_GLOBAL_ORIGIN": gps_global_origin,
    "GPS_RAW_INT": gps_raw_int,
    "MISSION_CURRENT": mission_current,
    "CURRENT_MODE": current_mode,
    "SYSTEM_TIME": system_time,
}
"""All messages that can be streamed or requested."""

DEFAULT_HZ: Mapping[str, float] = {
    "HEARTBEAT": 1, "SYS_STATUS": 2, "ATTITUDE": 10, "ATTITUDE_QUATERNION": 10, "LOCAL_POSITION_NED": 10,
    "ODOMETRY": 5, "GLOBAL_POSITION_INT": 5, "VFR_HUD": 4, "BATTERY_STATUS": 1, "SERVO_OUTPUT_RAW": 2,
    "ESC_STATUS": 1, "ESC_INFO": 0.5, "SCALED_PRESSURE": 1, "SCALED_PRESSURE2": 1, "NAMED_VALUE_FLOAT": 2, "DEBUG_FLOAT_ARRAY": 0.2,
    "EXTENDED_SYS_STATE": 1, "HOME_POSITION": 0.5, "GPS_RAW_INT": 0.5, "MISSION_CURRENT": 1, "CURRENT_MODE": 0.5, "SYSTEM_TIME": 0.5,
}  # fmt: skip
"""Rates until a client requests others."""
