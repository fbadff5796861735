"""A health monitor on a bench: two modules of a fleet of four, and what they say."""

import dataclasses
from typing import Any

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.health import Health
from firmware_py.core.health_monitor import HealthMonitor
from firmware_py.core.names import Place
from firmware_py.core.thruster_state import ThrusterFaults
from firmware_py.core.types import Estimate, Inputs, ModuleInputs, Request
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble

TICK_NS = 10_000_000
START_NS = 3600 * 10**9
MODCUBE = load_vehicle("modcube")
SIX = dataclasses.replace(MODCUBE, thruster=MODCUBE.thruster[:6])
BODY = assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [MODCUBE] * 2, [1, 3])
EVERY = tuple(Place(module, channel) for module in (1, 3) for channel in range(8))
SINGLE = assemble([(0, 0, 0)], [0], [MODCUBE], [1])
ZERO = np.zeros(3)
ESTIMATE = Estimate(
    np.array([1.0, -2.0, 3.0]), np.array([1.0, 0, 0, 0]), np.zeros(6), ZERO, ZERO, np.array([0.01, 0.03, 0.02]),
    np.full(3, 0.002), 30_000_000, 6.0, 6, 0, True,
)  # fmt: skip


class MonitorBench:
    """A health monitor with a clock, for modules 1 and 3 of a fleet of four."""

    def __init__(self, body: Body = BODY) -> None:
        self.monitor = HealthMonitor(body, Parameters(), TICK_NS)
        self.count = body.thrusters.f_max.size
        self.tick = 0
        self.time_ns = START_NS
        self.dropped = 0
        self.busy_s = 0.0
        self.foreign: dict[str, bool] = {}

    def step(self, one: ModuleInputs | None = None, three: ModuleInputs | None = None, *requests: Request, **more: Any) -> Health:
        self.tick += 1
        self.time_ns += TICK_NS
        other = more.get("others", ModuleInputs())
        modules = [other, one or ModuleInputs(), other, three or ModuleInputs()]
        estimate = ESTIMATE._replace(**{k: v for k, v in more.items() if k in Estimate._fields})  # type: ignore[arg-type]
        self.monitor.believed = modules
        inputs = Inputs(self.tick, self.time_ns, modules, list(requests), dropped_frames=self.dropped, busy_s=self.busy_s, **self.foreign)
        faults = ThrusterFaults(np.ones(self.count, dtype=bool), (), 0, np.eye(6), np.ones(2))
        return self.monitor.step(inputs, estimate, list(requests), faults)

    def wait(self, seconds: float, **more: object) -> Health:
        for _ in range(round(seconds / 0.01)):
            health = self.step(**more)  # type: ignore[arg-type]
        return health


def here(**said: object) -> ModuleInputs:
    return ModuleInputs(heard=True, answered=True, **said)  # type: ignore[arg-type]
