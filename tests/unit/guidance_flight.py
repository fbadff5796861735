"""Guidance over ticks with a body that follows its set-points, and the trajectories and sticks that it is given."""

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.guidance_modes import Guidance
from firmware_py.core.health import Health
from firmware_py.core.supervisor import Decision
from firmware_py.core.transitions import Effect, Trigger
from firmware_py.core.types import Estimate, Mode, Setpoint, Sticks
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle
from tests.unit.healths import GOOD

BODY = assemble_vehicle(load_vehicle("modcube"))
ZERO = np.zeros(3)
TICK = 10_000_000
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
WRENCH = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
FLOWN = [Mode.MANUAL, Mode.STABILIZE, Mode.ALT_HOLD, Mode.POSHOLD, Mode.AUTO, Mode.GUIDED, Mode.SURFACE, Mode.DOCK]


def estimate(p: tuple[float, ...] = (0.0, 0.0, 1.0), q: np.ndarray | None = None, nu: tuple[float, ...] = (0.0,) * 6) -> Estimate:
    level = np.array([1.0, 0.0, 0.0, 0.0]) if q is None else q
    return Estimate(np.array(p), level, np.array(nu), ZERO, ZERO, np.full(3, 0.002), np.full(3, 0.002), 20_000_000, 1.0, 0, 0, True)


class Flight:
    """Guidance over ticks, with a body that follows its set-points exactly."""

    def __init__(self, parameters: Parameters | None = None, body: Body = BODY) -> None:
        self.guidance = Guidance(body, parameters or Parameters())
        self.time_ns = 0
        self.estimate = estimate()
        self.guidance.rest(self.estimate)
        self.setpoints: list[Setpoint] = []
        self.wrenches: list[np.ndarray] = []

    def do(self, effect: Effect, mode: Mode = Mode.POSHOLD, argument: object = None) -> None:
        self.guidance.apply(Decision(Trigger.SET_MODE, effect, mode, argument), self.time_ns, self.estimate)

    def run(self, seconds: float, sticks: Sticks | None = None, health: Health = GOOD, follows: bool = True) -> Setpoint:
        for _ in range(round(seconds / 0.01)):
            self.time_ns += TICK
            if sticks is not None:
                self.do(Effect.TAKE_STICKS, self.guidance.mode, sticks)
            self.guidance.drop_stale_goals(self.estimate, health)
            now, _ = self.guidance.step(self.time_ns, self.estimate, health)
            self.setpoints.append(now)
            self.wrenches.append(self.guidance.mix(WRENCH, self.time_ns, self.estimate, health))
            if follows:
                self.estimate = self.estimate._replace(p_wb=now.p_wb, q_wb=now.q_wb)
        return self.setpoints[-1]


class Ramp:
    """A trajectory one metre north in ten seconds, from `start`."""

    duration_s = 10.0

    def __init__(self, start: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> None:
        self.start = np.array(start)

    def sample(self, t_s: float) -> Setpoint:
        inside = 0.0 < t_s < self.duration_s
        way = 0.1 * min(max(t_s, 0.0), self.duration_s)
        v = np.array([0.1 if inside else 0.0, 0.0, 0.0])
        return Setpoint(np.add(self.start, [way, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), v, ZERO, ZERO, ZERO)


def sticks(forward: float = 0.0, right: float = 0.0, down: float = 0.0, yaw: float = 0.0) -> Sticks:
    return Sticks((forward, right, down), (0.0, 0.0, yaw))
