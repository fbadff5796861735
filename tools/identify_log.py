"""For tools/identify.py: a recorded flight of one module as arrays: sensor readings and thruster commands.

Reads what the firmware writes (can.log and signals.mcap), through the firmware's own frames; never the plant's truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from firmware_py.app.configuration import firmware_of
from firmware_py.app.firmware import Firmware
from firmware_py.bus.codec import Codec, Frame
from firmware_py.core.body import Body
from firmware_py.core.measurements import Measurements
from firmware_py.core.types import BodyPose, ModuleInputs
from firmware_py.description.parameters import Estimation
from firmware_py.description.vehicle import Vehicle
from firmware_py.runtime.flight_log import FlightLog, LogError

HALVES = ("THRUSTER_CMD_A", "THRUSTER_CMD_B")
LEAST_S = 10.0
"""Shorter logs are refused: they contain too little information."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One flight of n ticks; body frame, SI units.

    Attributes:
        name: its folder. vehicle_name: as in the fleet file.
        vehicle, body, noise: the firmware's own models of the robot and of its sensors.
        period_s: of a tick. time_ns: (n,) of each tick.
        gyro, accel: (n, 3) rate and specific force at the IMU; NaN where none was received.
        command: (n, t) share of full command that acted during the tick that ends at that row.
        armed: (n,) whether the thrusters were armed during that tick. voltage_v: (n,) of the supply, interpolated between readings.
        poses: every tag picture.
    """

    name: str
    vehicle_name: str
    vehicle: Vehicle
    body: Body
    noise: Estimation
    period_s: float
    time_ns: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    command: np.ndarray
    armed: np.ndarray
    voltage_v: np.ndarray
    poses: Sequence[BodyPose]


def read_recording(folder: Path) -> Recording:
    """Reads the flight in `folder`. Raises LogError (no log, more than one module, a gap, too short) and OSError."""
    log = FlightLog(folder)
    if log.configuration is None:
        raise LogError(f"{folder}: its log does not say what flew; this version's logs do")
    firmware = firmware_of(log.configuration, str(folder))
    if len(firmware.fleet.module) > 1:
        raise LogError(f"{folder}: {len(firmware.fleet.module)} modules flew; a vehicle file is fitted to a log of one module alone")
    heard = _heard(log, firmware)
    period_s = 1.0 / firmware.fleet.rate_hz
    if len(heard.time_ns) * period_s < LEAST_S:
        raise LogError(f"{folder}: {len(heard.time_ns) * period_s:.1f} s of flight; at least {LEAST_S:.0f} s are needed")
    if len(heard.poses) < 2:
        raise LogError(f"{folder}: no tag was seen; without poses nothing can be identified")
    vehicle, modules = firmware.vehicles[0], heard.modules
    return Recording(
        str(folder), firmware.fleet.module[0].vehicle, vehicle, firmware.pipeline.bodies[0], firmware.parameters.estimation, period_s,
        np.array(heard.time_ns),
        _rows([m.gyro for m in modules], 3), _rows([m.accel for m in modules], 3),
        _delayed(np.array(heard.command)), _delayed(np.array(heard.armed)),
        _voltage([m.voltage_v for m in modules], vehicle.supply.voltage_v), heard.poses,
    )  # fmt: skip


class _Heard(NamedTuple):
    """Contents of a log, tick by tick; `poses` holds every tag picture."""

    time_ns: list[int]
    modules: list[ModuleInputs]
    armed: list[bool]
    command: list[np.ndarray]
    poses: list[BodyPose]


def _heard(log: FlightLog, firmware: Firmware) -> _Heard:
    """Feeds the frames of a log of one module to the firmware that wrote it. Raises LogError where ticks are missing."""
    heard, commands = _Heard([], [], [], [], []), _Commands(len(firmware.vehicles[0].thruster))
    measurements, collector = Measurements(firmware.pipeline.bodies[0], firmware.fleet.period_ns), firmware.collector
    q_near, before = np.array([1.0, 0.0, 0.0, 0.0]), None
    for logged in log.ticks():
        if before is not None and logged.tick != before + 1:
            raise LogError(f"{log.folder}: ticks {before + 1} to {logged.tick - 1} are missing; give a log without a gap")
        before = logged.tick
        collector.sync_sent(logged.tick, logged.time_ns)
        for bus in range(len(firmware.fleet.buses)):
            collector.take(bus, [Frame(number, data) for at, number, data in logged.received if at == bus])
        inputs = collector.collect(logged.tick, logged.time_ns)
        seen = measurements.fuse(inputs.modules, q_near).tags
        q_near = seen[-1].q_wb if seen else q_near
        armed, command = commands.of(logged.sent)
        heard.time_ns.append(logged.time_ns)
        heard.modules.append(inputs.modules[0])
        heard.armed.append(armed)
        heard.command.append(command)
        heard.poses.extend(seen)
    return heard


class _Commands:
    """Decodes the shares in the THRUSTER_CMD frames that a tick sent."""

    def __init__(self, count: int) -> None:
        codec = Codec.load()
        self._halves, self._count = [codec.message(name) for name in HALVES], count

    def of(self, lines: Sequence[str]) -> tuple[bool, np.ndarray]:
        """Whether armed, and (t,) shares, 0 when disarmed. `lines` are those of can.log."""
        shares, armed = np.zeros(8), False
        for line in lines:
            number, _, data = line.split(" ")[2].partition("#")
            for half, message in enumerate(self._halves):
                if int(number, 16) >> 5 == message.function:
                    values = message.decode(bytes.fromhex(data))
                    shares[4 * half : 4 * half + 4], armed = values[:4], values[4] == 1
        return armed, shares[: self._count] * armed


def _delayed(column: np.ndarray) -> np.ndarray:
    """Column as it acts during the tick that ends at each row: sent in tick k, applied at SYNC k+1, in effect until SYNC k+2."""
    return np.concatenate([np.zeros_like(column[:2]), column[:-2]])


def _rows(values: Sequence[np.ndarray | None], width: int) -> np.ndarray:
    return np.array([np.full(width, np.nan) if v is None else v for v in values])


def _voltage(values: Sequence[float | None], nominal: float) -> np.ndarray:
    known = [i for i, v in enumerate(values) if v is not None]
    if not known:
        return np.full(len(values), nominal)
    return np.interp(np.arange(len(values)), known, [float(values[i] or 0.0) for i in known])
