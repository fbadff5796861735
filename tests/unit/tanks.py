"""Tanks for tests that run whole ticks: a world with the controller's own model, without the bus."""

from collections.abc import Callable

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.spatial.transform import Rotation

from firmware_py.app.preparation import job_key, prepare
from firmware_py.core import propagation
from firmware_py.core.body import Body
from firmware_py.core.docking_decisions import Prepared
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.propagation import STATES
from firmware_py.core.rotations import from_euler, multiply
from firmware_py.core.transitions import State
from firmware_py.core.types import (
    CHANNELS,
    RELAY_PUSH,
    Action,
    DockFeedback,
    EscFeedback,
    Inputs,
    Mode,
    ModuleInputs,
    Outputs,
    Request,
    TagObservation,
)
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.description.water import WATER_DENSITY
from firmware_py.prepare.assembly import PITCH_M, assemble

PERIOD = 10_000_000
DT = 0.01
START = from_euler(0.1, -0.15, 0.4)
TAG_DELAY_TICKS = 4
TOP_FACE = 5
MODCUBE = load_vehicle("modcube")
RING = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
LOST = "fail-safe on: a docked partner is lost"


class Tank:
    """A world with the controller's own model: bodies with lagging thrusters, exact sensors, late tags on the top faces.

    The commands of tick k act from SYNC k + 1 on.
    """

    def __init__(self, bodies: list[Body], parameters: Parameters | None = None, believed: list[Body] | None = None):
        self.bodies = bodies
        self.r_mb = [[Rotation.from_quat(q_bm[[1, 2, 3, 0]]).inv() for q_bm in body.q_bm] for body in bodies]
        self.pipeline = Pipeline(believed or bodies, parameters or Parameters(), PERIOD)
        self.states = [self._start(n) for n in range(len(bodies))]
        self.forces = [np.zeros(b.thrusters.f_max.size) for b in bodies]
        self.acting = [np.zeros((len(b.modules), 8)) for b in bodies]
        self.waiting = [a.copy() for a in self.acting]
        self.wrenches = [np.zeros(6) for _ in bodies]
        self.past: list[list[np.ndarray]] = []
        self.outputs: list[Outputs] = []

    @staticmethod
    def _start(number: int) -> np.ndarray:
        x = np.zeros(STATES)
        x[:3], x[3:7] = [1.0, 2.0 * number, 0.8], START
        return x

    def run(self, seconds: float, *requests: Request, estop: bool = False) -> Outputs:
        """Runs ticks for `seconds`; requests and e-stop enter the first of them."""
        for n in range(round(seconds / DT)):
            self._tick(list(requests) if n == 0 else [], estop and n == 0)
        return self.outputs[-1]

    def _tick(self, requests: list[Request], estop: bool) -> None:
        tick = len(self.outputs)
        if tick:
            for n in range(len(self.bodies)):
                self._move(n)
        self.past.append([x.copy() for x in self.states])
        inputs = Inputs(tick, tick * PERIOD, self._hear(tick), requests, estop=estop)
        self.outputs.append(self.pipeline.step(inputs))
        for n, body in enumerate(self.bodies):
            self.acting[n] = self.waiting[n]
            self.waiting[n] = np.array([self.outputs[-1].modules[m].thrusters for m in body.modules])

    def _move(self, n: int) -> None:
        t = self.bodies[n].thrusters
        u = self.acting[n][t.module, t.channel]
        curves = np.where(u[:, None] >= 0.0, t.forward, t.reverse)
        wanted = np.copysign(polyval(np.abs(u), np.c_[np.zeros(len(u)), curves].T, tensor=False), u)
        end = wanted + (self.forces[n] - wanted) * np.exp(-DT / t.lag_s)
        self.wrenches[n] = t.matrix @ (wanted + (self.forces[n] - end) * t.lag_s / DT)
        self.forces[n] = end
        self.states[n] = propagation.step(self.states[n], self.wrenches[n], DT, *self.bodies[n].plant)

    def _hear(self, tick: int) -> list[ModuleInputs]:
        modules = [ModuleInputs(answered=True, heard=True) for body in self.bodies for _ in body.modules]
        alive = 1e-9 * (tick % 2)  # a sensor that repeats itself counts as stuck
        for n, body in enumerate(self.bodies):
            x, r_wb = self.states[n], world(self.states[n])
            felt = propagation.inertial_acceleration(x, self.wrenches[n], *body.plant)
            felt = felt + r_wb.inv().apply([0.0, 0.0, -9.80665])
            for k, m in enumerate(body.modules):
                r_mb, heard = self.r_mb[n][k], modules[m]
                heard.gyro, heard.accel = r_mb.apply(x[10:13]) + alive, r_mb.apply(felt) + alive
                heard.pressure_pa = 101_325.0 + WATER_DENSITY * 9.80665 * float((x[:3] + r_wb.apply(body.r_bi[k]))[2]) + alive
                heard.voltage_v, heard.current_a, heard.leak, heard.cabin_temperature_c = float(body.nominal_v[k]), 3.0, False, 30.0
                if tick % 10 == 0:
                    heard.esc = self._escs(n, k)
                if tick % 2 == 0 and tick >= TAG_DELAY_TICKS:
                    heard.tags.append(self._tag(n, k, tick - TAG_DELAY_TICKS))
        return modules

    def _escs(self, n: int, k: int) -> list[EscFeedback]:
        t = self.bodies[n].thrusters
        speed = np.sign(self.forces[n]) * t.rpm_at_full * np.sqrt(np.abs(self.forces[n]) / np.where(self.forces[n] > 0, 10.0, 8.0))
        rpm = [float(v) for v in speed[t.module == k]]
        status = [0] * len(rpm) + [3] * (CHANNELS - len(rpm))  # SILENT: not there
        rpm += [0.0] * (CHANNELS - len(rpm))
        return [EscFeedback(i, (rpm[i], rpm[i + 1]), (1.0, 1.0), (status[i], status[i + 1])) for i in range(0, CHANNELS, 2)]

    def _tag(self, n: int, k: int, tick: int) -> TagObservation:
        body, x = self.bodies[n], self.past[tick][n]
        row = int(np.flatnonzero((body.tag_module == k) & (body.tag_ids == TOP_FACE))[0])
        q_wt = multiply(x[3:7].copy(), np.ascontiguousarray(body.q_bt[row]))
        return TagObservation(TOP_FACE, 7, tick * PERIOD, x[:3] + world(x).apply(body.r_bt[row]), q_wt)


def flies_with_noise(tank: Tank, tamper: Callable[[ModuleInputs], None], mode: Mode) -> None:
    """Arms the tank's module and flies it for a second in `mode`, with noisy sensors that `tamper` may change in every tick."""
    rng, hear = np.random.default_rng(0), tank._hear

    def heard(tick: int) -> list[ModuleInputs]:
        (module,) = hear(tick)
        assert module.gyro is not None and module.accel is not None and module.pressure_pa is not None
        module.gyro, module.accel = module.gyro + 0.002 * rng.normal(size=3), module.accel + 0.03 * rng.normal(size=3)
        module.pressure_pa += 20.0 * rng.normal()
        tamper(module)
        return [module]

    tank._hear = heard  # type: ignore[method-assign]
    tank.run(1.0)
    tank.run(1.0, Request(Action.ARM))
    tank.run(1.0, Request(Action.SET_MODE, 0, mode))


def world(x: np.ndarray) -> Rotation:
    return Rotation.from_quat(x[[4, 5, 6, 3]])


def single(module: int = 0) -> Body:
    return assemble([(0, 0, 0)], [0], [MODCUBE], [module])


def has_power(outputs: Outputs, module: int = 0) -> bool:
    return bool(outputs.modules[module].thrusters.any())


def _body_of(cells: list[tuple[int, int, int]], first: int) -> Body:
    return assemble(cells, [0] * len(cells), [MODCUBE] * len(cells), list(range(first, first + len(cells))))


class FaultyTank(Tank):
    """A tank with faults: modules whose magnets carry no current (`without_current`), whose magnets pull whatever the command
    (`always_pulling`), or whose tags are out of sight (`hidden`). With `stuck`, joints that push apart are still seen in their places.
    """

    def __init__(
        self, cells: list[tuple[int, int, int]], parameters: Parameters | None = None, delay: int = 0, apart: bool = False, each: int = 0
    ) -> None:
        """`delay`: extra ticks until a requested plan arrives. `apart`: each module is a body of its own. `each`: modules per body."""
        count = len(cells)
        size = 1 if apart else each or count
        super().__init__([_body_of(cells[m : m + size], m) for m in range(0, count, size)], parameters)
        self.cabin_pa = [101_325.0] * count
        self.without_current: set[int] = set()
        self.hidden: set[int] = set()
        self.always_pulling: set[int] = set()
        self.pull_ma = 110.0
        self.stuck = False
        self.event_log: list[tuple[float, str]] = []
        self._delay, self._plans = delay, list[tuple[int, Prepared]]()
        self._step, self.pipeline.step = self.pipeline.step, self._step_with_plans  # type: ignore[method-assign]

    def _hear(self, tick: int) -> list[ModuleInputs]:
        modules = super()._hear(tick)
        relays = self.pipeline.formation.docking.relays.states
        pushing = [m for m, states in enumerate(relays) if RELAY_PUSH in states and not self.stuck]
        for m, module in enumerate(modules):
            module.cabin_pressure_pa = self.cabin_pa[m]
            if m in self.hidden or m in pushing[1:]:  # modules that push each other apart are not all seen in their places
                module.tags.clear()
            if tick % 4 == 0:
                turned = [state == RELAY_PUSH and m not in self.always_pulling for state in relays[m]]
                current = [0.0 if m in self.without_current else -self.pull_ma if turns else self.pull_ma for turns in turned]
                module.docks = [DockFeedback(first, (*current[first : first + 3],), (1, 1, 1)) for first in (0, 3)]  # type: ignore[arg-type]
        return modules

    def _step_with_plans(self, inputs: Inputs) -> Outputs:
        inputs.prepared = [plan for due, plan in self._plans if due <= inputs.tick]
        self._plans = [each for each in self._plans if each[0] > inputs.tick]
        outputs = self._step(inputs)
        for request in outputs.preparations:
            plan = prepare(request, job_key(request, self.pipeline.bodies)[0], self.pipeline, [MODCUBE] * len(inputs.modules), PITCH_M)
            self._plans.append((inputs.tick + 1 + self._delay, plan))
        self.event_log += [(1e-9 * inputs.time_ns, event.text) for event in outputs.events]
        return outputs

    def fly(self) -> None:
        """Arms the first body, which then holds its place."""
        self.run(0.5)
        assert self.run(1.0, Request(Action.ARM)).records[0].state == State.ARMED

    def lose(self, *modules: int) -> float:
        """Takes the modules out of sight and the current from their magnets; returns the time, s."""
        self.without_current |= set(modules)
        self.hidden |= set(modules)
        return len(self.outputs) * 0.01

    @property
    def shape(self) -> list[tuple[int, ...]]:
        return sorted(body.modules for body in self.pipeline.bodies)

    def when(self, text: str) -> float:
        return next(at for at, said in self.event_log if text in said)


def tank_with_modules_at(
    *places: tuple[float, float], parameters: Parameters | None = None, armed: tuple[int, ...] | None = None
) -> FaultyTank:
    """Single modules at these places (north, east, m), which hold there once armed: all, or those in `armed`. No magnet draws current."""
    modules = range(len(places))
    tank = FaultyTank([(0, m, 0) for m in modules], parameters, apart=True)
    tank.without_current = set(modules)
    for state, (north, east) in zip(tank.states, places, strict=True):
        state[:7] = [north, east, 0.8, *from_euler(0.0, 0.02, 0.0)]
    tank.run(2.0)
    tank.run(0.5, *(Request(Action.ARM, m) for m in modules if armed is None or m in armed))
    return tank


def tank_with_row(*y_m: float, parameters: Parameters | None = None, armed: tuple[int, ...] | None = None) -> FaultyTank:
    """Modules in one line, set up as by `tank_with_modules_at`: the first at 0, the others `y_m` east of it."""
    return tank_with_modules_at(*((1.0, y) for y in (0.0, *y_m)), parameters=parameters, armed=armed)
