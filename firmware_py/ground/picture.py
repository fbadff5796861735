"""State of the fleet, gathered tick by tick from Inputs and Outputs: the only source of telemetry."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.failsafes import Level
from firmware_py.core.rotations import rotate_back
from firmware_py.core.transitions import State
from firmware_py.core.types import CHANNELS, FACES, NEVER_NS, BodyRecord, Estimate, Event, Inputs, Mode, ModuleInputs, Outputs
from firmware_py.description.parameters import Supervision
from firmware_py.ground.tick_times import Times

ESC_SILENT = 3
"""EscStatus of an ESC that is not heard."""
_MOST_EVENTS = 64
READINGS = ("voltage_v", "current_a", "pressure_pa", "water_temperature_c", "cabin_pressure_pa", "cabin_temperature_c")
"""Readings of ModuleInputs that a ModulePicture keeps, by the same names."""


@dataclass(slots=True)
class ModulePicture:
    """Newest value of every slow reading of one module. Before the first: NaN, but 0 for ESCs."""

    voltage_v: float = math.nan
    current_a: float = math.nan
    pressure_pa: float = math.nan
    water_temperature_c: float = math.nan
    cabin_pressure_pa: float = math.nan
    cabin_temperature_c: float = math.nan
    dock_current_ma: list[float] = field(default_factory=lambda: [math.nan] * FACES)
    rpm: list[float] = field(default_factory=lambda: [0.0] * CHANNELS)
    esc_current_a: list[float] = field(default_factory=lambda: [0.0] * CHANNELS)
    esc_status: list[int] = field(default_factory=lambda: [ESC_SILENT] * CHANNELS)
    esc_frames: int = 0
    command: np.ndarray = field(default_factory=lambda: np.zeros(CHANNELS))
    """(8,) share of full command, as sent."""
    gyro_ns: int = NEVER_NS
    accel_ns: int = NEVER_NS
    pressure_ns: int = NEVER_NS
    voltage_ns: int = NEVER_NS
    answered_ns: int = NEVER_NS

    def take(self, inputs: ModuleInputs, time_ns: int) -> None:
        """Keeps the readings that `inputs` contains."""
        for name in READINGS:
            if (reading := getattr(inputs, name)) is not None:
                setattr(self, name, reading)
        self.gyro_ns = self.gyro_ns if inputs.gyro is None else time_ns
        self.accel_ns = self.accel_ns if inputs.accel is None else time_ns
        self.pressure_ns = self.pressure_ns if inputs.pressure_pa is None else time_ns
        self.voltage_ns = self.voltage_ns if inputs.voltage_v is None else time_ns
        self.answered_ns = time_ns if inputs.answered else self.answered_ns
        for dock in inputs.docks:
            self.dock_current_ma[dock.first : dock.first + 3] = dock.current_ma
        for esc in inputs.esc:
            self.esc_frames += 1
            pair = slice(esc.first, esc.first + 2)
            self.rpm[pair], self.esc_current_a[pair], self.esc_status[pair] = esc.rpm, esc.current_a, esc.status


class Picture:
    """State of the fleet after the last tick."""

    def __init__(self, modules: int, supervision: Callable[[], Supervision]) -> None:
        self._supervision = supervision
        self.modules = [ModulePicture() for _ in range(modules)]
        self.records: dict[int, BodyRecord] = {}
        self.restarts: dict[int, int] = {}
        """Restarts of each body's estimate since its first pose; with each the reported pose has jumped."""
        self.bodies: dict[int, Body] = {}
        self.time_ns = 0
        self.ticks = 0
        self.estop = False
        self.dropped_frames = 0
        self.times: Times | None = None
        """None in lockstep."""
        self.events: deque[Event] = deque(maxlen=_MOST_EVENTS)
        """Events not yet reported."""

    def observe(self, inputs: Inputs, outputs: Outputs, bodies: Sequence[Body]) -> None:
        """Takes in the results of one tick."""
        self.time_ns = outputs.time_ns
        self.ticks += 1
        self.estop = inputs.estop or outputs.estop
        self.dropped_frames = inputs.dropped_frames
        for module, fresh, command in zip(self.modules, inputs.modules, outputs.modules, strict=True):
            module.take(fresh, outputs.time_ns)
            module.command = command.thrusters
        members = {body.index: body.modules for body in bodies}
        for record in outputs.records:
            self._count_restart(record, members.get(record.body, (record.body,)))
        self.records = {record.body: record for record in outputs.records}
        self.bodies = {body.index: body for body in bodies}
        self.events += outputs.events

    def _count_restart(self, record: BodyRecord, members: tuple[int, ...]) -> None:
        """Counts a restart if the estimate restarted in this tick, or if the body gained or lost a joint."""
        last = self.records.get(record.body)
        goes_on = last is not None and members == self.members(record.body) and _goes_on(last.estimate, record.estimate)
        if record.estimate.ready and not goes_on:
            self.restarts[record.body] = self.restarts.get(record.body, -1) + 1

    def members(self, body: int) -> tuple[int, ...]:
        """Fleet indices of a body's modules."""
        return self.bodies[body].modules if body in self.bodies else (body,)

    def leader(self, module: int) -> int:
        """Number of the body that contains a module; the module's own number if no reported body does."""
        return next((body.index for body in self.bodies.values() if module in body.modules), module)

    def is_armed(self, body: int) -> bool:
        """Whether the body's thrusters may turn."""
        record = self.records.get(body)
        return record is not None and record.state == State.ARMED

    @property
    def any_armed(self) -> bool:
        """Whether any thruster of the fleet may turn."""
        return any(self.is_armed(body) for body in self.records)

    @property
    def any_stopped(self) -> bool:
        """Whether the e-stop holds any body of the fleet."""
        return any(self.is_stopped(body) for body in self.records)

    def mode(self, body: int) -> Mode:
        """Mode of the body, in force or for when it is armed; POSHOLD for an unknown body."""
        record = self.records.get(body)
        return Mode.POSHOLD if record is None else Mode(record.mode)

    def is_stopped(self, body: int) -> bool:
        """Whether the e-stop holds the body."""
        record = self.records.get(body)
        return self.estop or (record is not None and record.state == State.ESTOP)

    def is_in_failsafe(self, body: int) -> bool:
        """Whether the body is armed and a fail-safe determines how it flies."""
        record = self.records.get(body)
        return record is not None and record.state == State.ARMED and record.level > Level.NONE

    def pose_is_fresh(self, body: int) -> bool:
        """Whether the estimate is ready and its last tag is fresh."""
        record = self.records.get(body)
        if record is None or not record.estimate.ready:
            return False
        return record.estimate.tag_age_ns <= self._supervision().tag_fresh_ms * 1e6

    def distance(self, body: int, place: np.ndarray) -> float:
        """Distance between the body's estimate and a place (3,) in the world, m; NaN without a pose. Passive axes do not count: buoyancy
        holds the body along them, wherever a plan wants it.
        """
        record = self.records.get(body)
        if record is None or not record.estimate.ready:
            return math.nan
        gap_b = rotate_back(record.estimate.q_wb, place - record.estimate.p_wb)
        passive = self.bodies[body].passive if body in self.bodies else ()
        gap_b[[axis for axis in passive if axis < 3]] = 0.0
        return float(np.linalg.norm(gap_b))

    def may_arm(self, body: int) -> bool:
        """Whether ARM would be granted."""
        record = self.records.get(body)
        return record is not None and record.may_arm and not self.estop


def _goes_on(before: Estimate, now: Estimate) -> bool:
    """Whether a ready estimate continues that of the tick before."""
    return before.ready and before.starts == now.starts
