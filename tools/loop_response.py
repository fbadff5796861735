"""Open-loop response of the attitude and position loops at the plant's input, measured on the flight code.

The stages of a tick (measure, estimate, control, allocate, limit) run against the bench's plant, with its thruster lag, the bus delay of
one tick and tags at 60 Hz that are 40 ms late; noise, current, deadband and quantisation are off, so the rest is linear for small motions.
Sines are added to the forces downstream of the controller, on all axes at once, each at frequencies of its own. With u the controller's
output and p = u + sines the plant's input, the loop broken at that axis, all others closed, is L(jw) = -U(jw) / P(jw), exact at every
frequency of the record's grid.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.pipeline import BodyPipeline
from firmware_py.core.rotations import exp, log
from firmware_py.core.setpoint import rest_at
from firmware_py.core.thruster import commands
from firmware_py.core.types import Inputs, ModuleInputs, TagObservation
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import PITCH_M, assemble
from hil.plant.camera import Camera
from hil.plant.lattice import place
from hil.plant.sensors import Sensors
from hil.plant.spec import CALM, IDEAL, CameraPose, SensorSpec, Tank, WorldSpec
from hil.plant.world import Start, World

BODIES: dict[int, list[tuple[int, int, int]]] = {
    1: [(0, 0, 0)],
    2: [(0, 0, 0), (1, 0, 0)],
    4: [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)],
}
"""Cells of the examined bodies, by their number of modules: one, a line, two by two."""
PERIOD_NS = 10_000_000
PRESSURE_EVERY = 2
"""Ticks between pressure readings."""
SETTLE_TICKS, RECORD_TICKS = 4000, 5000
"""Ticks until the filter's gains have settled; and length of the record, whose frequencies are multiples of 2 pi / 50 s."""
LOWEST_RAD_S, HIGHEST_RAD_S, LINES = 0.3, 30.0, 20
"""Range and number of the excitation frequencies of each axis."""
SHAKE = np.repeat([0.01, 0.02], 3)
"""Acceleration of one sine, m/s^2 and rad/s^2: their sum stays far from the thrusters' limits."""
MAX_OFF_LINE_SHARE = 0.05
"""Largest `off_line_share` of a stable loop. Measured: stable ones up to 0.015, from the beat of tags and ticks; oscillating ones from
0.14."""
MIN_CONTROLLED_SHARE = 0.1
"""Least share of a force or moment requested along one axis that the thrusters must deliver for the axis to count as controlled. The shares
add up to the rank, so one axis always is. Layout.unreachable is stricter: beside the pitch of a BlueROV2 it lists the surge, which tilts
it a little.
"""
HEIGHT_M = 1.5
HOME = rest_at(np.array([0.0, 0.0, HEIGHT_M]), np.array([1.0, 0.0, 0.0, 0.0]))
STEP = np.repeat([0.05, math.radians(5.0)], 3)
"""Step of the set-point: small enough to keep every thruster below its limit."""
STEP_SETTLE_TICKS, STEP_TICKS = 2000, 500


class Scale(NamedTuple):
    """How the plant differs from the controller's model: factors of mass, inertia (both with added mass) and thruster lag."""

    mass: float = 1.0
    inertia: float = 1.0
    lag: float = 1.0


NOMINAL = Scale()


def corners(spread: float) -> list[Scale]:
    """The eight corners of mass, inertia and lag, each up or down by the share `spread`."""
    sides = (1.0 - spread, 1.0 + spread)
    return [Scale(m, i, t) for m in sides for i in sides for t in sides]


def body_of(modules: int, vehicle: str) -> Body:
    """The body of `modules` such vehicles. Raises DescriptionError."""
    return assemble(BODIES[modules], [0] * modules, [load_vehicle(vehicle)] * modules)


class Response(NamedTuple):
    """L of one axis: (k,) frequencies, rad/s, and (k,) complex values."""

    frequency: np.ndarray
    loop: np.ndarray
    off_line_share: float = 0.0
    """Share of the controller's output outside the excitation frequencies: large in a loop that oscillates by itself."""
    controlled: bool = True
    """Whether the thrusters can push along the axis, and it is not left to buoyancy."""


class Loop:
    """One body of docked modules that holds its position: firmware and plant, tick by tick."""

    def __init__(self, modules: int, parameters: Parameters, scale: Scale = NOMINAL, vehicle: str = "modcube") -> None:
        described = load_vehicle(vehicle)
        self.body = body_of(modules, vehicle)
        self._pipeline = BodyPipeline(self.body, parameters, PERIOD_NS)
        self.aim = HOME
        self._sensors_spec = dataclasses.replace(SensorSpec(), **{**IDEAL, "tag_delay_ms": SensorSpec().tag_delay_ms})
        self._world = _world(self.body, [_scaled(described, scale)] * modules, described.curve.lag_s * scale.lag)
        self._sensors = [Sensors(self._sensors_spec, self._world.spec, 0, m) for m in range(modules)]
        self._camera = Camera(CameraPose(), self._sensors_spec, self._world.vehicles, (0, 1, 2, 3, 4, 5), 0)
        self._seen = self._camera.watch(self._world)
        self._commanded = np.zeros(self.body.thrusters.f_max.size)
        self._tick = 0
        self.is_ready = False
        """Whether the estimator knows the pose."""
        self.pose = np.zeros(6)
        """Estimated position, m, and rotation vector, rad."""

    def step(self, shake: np.ndarray) -> np.ndarray:
        """(6,) wrench that the controller gives in this tick; `shake` (6,) N, N m is applied together with that of the tick before."""
        tick, self._tick = self._tick, self._tick + 1
        self._push(self._commanded + self.body.thrusters.pinv @ shake)
        inputs = self._sample(tick)
        pipeline = self._pipeline
        estimate = pipeline.measure(inputs)
        thrust = pipeline.allocator.step(pipeline.controller.step(self.aim, self.aim, estimate))
        self._commanded, _ = pipeline.limiter.step(thrust.force_n, estimate.placed, pipeline.supply.voltage_v)
        pipeline.lag.command(self._commanded)
        self._world.advance(PERIOD_NS)
        self._seen += self._camera.watch(self._world)
        self.is_ready = bool(estimate.placed)
        self.pose = np.concatenate([estimate.p_wb, log(estimate.q_wb)])
        return np.asarray(self.body.thrusters.matrix @ self._commanded)

    def _push(self, force_n: np.ndarray) -> None:
        """Applies the forces commanded in the tick before to the plant, as at SYNC."""
        t, u = self.body.thrusters, np.zeros(force_n.size)
        commands(np.ascontiguousarray(force_n), np.ones(force_n.size), t.forward, t.reverse, np.zeros(force_n.size), u)
        for module in range(len(self.body.modules)):
            self._world.set_command(module, u[t.module == module].tolist())

    def _sample(self, tick: int) -> Inputs:
        """Sensor readings at SYNC, and the tags that have arrived by then."""
        time_ns = self._world.time_ns
        delay_ns = round(1e6 * self._sensors_spec.tag_delay_ms)
        modules = []
        for index, sensors in enumerate(self._sensors):
            truth = self._world.truth(index)
            pressure = sensors.pressure_pa(truth) if tick % PRESSURE_EVERY == 0 else None
            due = [s for s in self._seen if s.module == index and s.capture_ns + delay_ns <= time_ns]
            tags = [TagObservation(s.tag_id, s.quality, s.capture_ns, s.p_wt, s.q_wt) for s in due]
            modules.append(ModuleInputs(sensors.gyro(truth), sensors.accel(truth), pressure, tags=tags, answered=True, heard=True))
        self._seen = [s for s in self._seen if s.capture_ns + delay_ns > time_ns]
        return Inputs(tick, time_ns, modules)


def _scaled(vehicle: Vehicle, scale: Scale) -> Vehicle:
    i = vehicle.inertial
    return dataclasses.replace(
        vehicle,
        inertial=dataclasses.replace(
            i,
            dry_kg=i.dry_kg * scale.mass,
            entrained_kg=i.entrained_kg * scale.mass,
            inertia=i.inertia * scale.inertia,
            added=i.added * np.repeat([scale.mass, scale.inertia], 3),
            righting_arm_m=i.righting_arm_m / scale.mass,  # keeps the moment
        ),
    )


def _world(body: Body, vehicles: Sequence[Vehicle], lag_s: float) -> World:
    spec = dataclasses.replace(WorldSpec(), **{**CALM, "thruster_lag_s": lag_s, "supply_limit": False})
    level = np.array([1.0, 0.0, 0.0, 0.0])
    origin = body.cells[0].astype(float)
    places = [place(cell, 0, PITCH_M, origin) for cell in body.cells]
    start = Start(np.array([0.0, 0.0, HEIGHT_M]) + body.r_bm[0], level)
    return World(
        spec, Tank(kind="cylinder"), vehicles, [start] * len(vehicles), 0, PERIOD_NS,
        groups=[tuple(range(len(vehicles)))], places=places,
    )  # fmt: skip


def controlled(body: Body) -> np.ndarray:
    """(6,) whether the thrusters can push along each axis, and it is not left to buoyancy."""
    pushed = np.diag(body.thrusters.matrix @ body.thrusters.pinv) >= MIN_CONTROLLED_SHARE
    pushed[list(body.passive)] = False
    return np.asarray(pushed)


def lines() -> np.ndarray:
    """(6, LINES) whole numbers of periods in the record, all different: the sines of each axis."""
    span_s = RECORD_TICKS * PERIOD_NS * 1e-9
    wanted = np.geomspace(LOWEST_RAD_S, HIGHEST_RAD_S, LINES * 6) * span_s / (2.0 * math.pi)
    taken: list[int] = []
    for each in wanted:
        taken.append(max(math.ceil(each - 0.5), taken[-1] + 1 if taken else 1))
    return np.array(taken).reshape(LINES, 6).T


def measure(modules: int, parameters: Parameters, scale: Scale = NOMINAL, vehicle: str = "modcube") -> list[Response]:
    """Open-loop response of each axis of a body of `modules` modules. Raises DescriptionError where the body never finds its pose."""
    loop, chosen = Loop(modules, parameters, scale, vehicle), lines()
    phase = 2.0 * math.pi * np.random.default_rng(0).uniform(size=chosen.shape)
    time = np.arange(SETTLE_TICKS + RECORD_TICKS) / RECORD_TICKS
    size = SHAKE * np.diag(loop.body.mass)
    shake = np.array([s * np.sin(2.0 * math.pi * np.outer(time, n) + p).sum(axis=1) for s, n, p in zip(size, chosen, phase, strict=True)]).T
    given = np.array([loop.step(each) for each in shake])
    if not loop.is_ready:
        raise DescriptionError(f"{vehicle}: its loops are open, for the camera sees no tag of it; margins need a vehicle with a tag on top")
    # A command of one tick is applied in the next, so the sine of a tick is paired with the wrench of the tick before.
    u = np.fft.rfft(given[SETTLE_TICKS - 1 : -1], axis=0)
    p = u + np.fft.rfft(shake[SETTLE_TICKS:], axis=0)
    base = 2.0 * math.pi / (RECORD_TICKS * PERIOD_NS * 1e-9)
    power = np.square(np.abs(u[1:]))
    beside = np.delete(power, chosen.ravel() - 1, axis=0).sum(axis=0) / np.maximum(power.sum(axis=0), 1e-300)
    pushed = controlled(loop.body)
    return [Response(base * n, -u[n, axis] / p[n, axis], float(beside[axis]), bool(pushed[axis])) for axis, n in enumerate(chosen)]


def step_responses(parameters: Parameters, axes: Sequence[int], vehicle: str) -> np.ndarray:
    """(k, STEP_TICKS) share of a set-point step that a lone vehicle has completed, tick by tick, for each of `axes` in turn."""
    loop, found, still = Loop(1, parameters, vehicle=vehicle), [], np.zeros(6)
    for _ in range(STEP_SETTLE_TICKS):
        loop.step(still)
    for axis in axes:
        step = STEP[axis] * np.eye(6)[axis]
        before = loop.pose[axis]
        loop.aim = rest_at(HOME.p_wb + step[:3], exp(step[3:]))
        moved = []
        for _ in range(STEP_TICKS):
            loop.step(still)
            moved.append((loop.pose[axis] - before) / STEP[axis])
        found.append(moved)
        loop.aim = HOME
        for _ in range(STEP_TICKS):
            loop.step(still)
    return np.array(found)


class Margins(NamedTuple):
    """Smallest distances of a loop from instability."""

    gain_db: float
    """Factor by which the gain may change, up or down."""
    phase_deg: float
    crossover_rad_s: float
    """Highest frequency at which the gain is one."""


class Readings(NamedTuple):
    """Points at which the margins of a loop are read off, frequencies in rad/s."""

    gain: list[tuple[float, float]]
    """Frequency at which the phase is -180 deg, modulo whole turns, and gain there, dB."""
    phase: list[tuple[float, float]]
    """Frequency at which the gain is one, and phase margin there, deg."""


def margins(response: Response) -> Margins:
    """Margins of one loop; infinite for an axis that is not controlled.

    They are zero for a loop that oscillates by itself, and for one that does not cross 0 dB at the frequencies measured.
    """
    if not response.controlled:
        return Margins(math.inf, math.inf, math.nan)
    if response.off_line_share > MAX_OFF_LINE_SHARE or np.isnan(response.loop).any():
        return Margins(0.0, 0.0, math.nan)
    gain, phase = read_off(response)
    if not phase:
        return Margins(0.0, 0.0, math.nan)
    return Margins(min((abs(db) for _, db in gain), default=math.inf), min(deg for _, deg in phase), max(w for w, _ in phase))


def read_off(response: Response) -> Readings:
    """All candidates for the margins of one loop, interpolated over the logarithm of the frequency.

    Where the phase reaches -180 degrees only above the last frequency, the gain at the last frequency is used: it does not rise after that.
    """
    x = np.log(response.frequency)
    gain_db = 20.0 * np.log10(np.maximum(np.abs(response.loop), 1e-300))
    crossovers = _crossings(x, gain_db)
    if not crossovers:
        return Readings([], [])
    phase = np.unwrap(np.angle(response.loop))
    phase += -2.0 * math.pi * round((phase[int(np.argmin(np.abs(gain_db)))] + math.pi) / (2.0 * math.pi))  # near -180 at crossover
    turns = math.pi * np.array([-3.0, -1.0, 1.0])
    gains = [(math.exp(c), float(np.interp(c, x, gain_db))) for turn in turns for c in _crossings(x, phase - turn)]
    gains += [(float(response.frequency[-1]), float(gain_db[-1]))] if phase[-1] > -math.pi else []
    return Readings(gains, [(math.exp(c), abs((math.degrees(np.interp(c, x, phase)) + 360.0) % 360.0 - 180.0)) for c in crossovers])


def _crossings(x: np.ndarray, y: np.ndarray) -> list[float]:
    """Zeros of y, interpolated linearly between its points."""
    at = np.flatnonzero(np.signbit(y[1:]) != np.signbit(y[:-1]))
    return [float(x[i] + (x[i + 1] - x[i]) * y[i] / (y[i] - y[i + 1])) for i in at]
