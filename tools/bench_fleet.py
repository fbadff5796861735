"""For tools/bench.py: what a tick of many docked modules costs beside that of one, with every module's sensors arriving."""

from __future__ import annotations

from time import perf_counter_ns

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.measurements import ATMOSPHERE_PA, WATER_DENSITY
from firmware_py.core.observation import GRAVITY
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.rotations import conjugate, multiply, normalise, rotate, rotate_back, to_matrix
from firmware_py.core.types import Action, EscFeedback, Inputs, ModuleInputs, Request, TagObservation
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import load_vehicle
from firmware_py.prepare.assembly import assemble

PERIOD_NS = 10_000_000
SETTLE_TICKS = 300
"""Before anything is timed: pose found, armed, holding."""
DEPTH_M = 2.0
SIGMA_M, SIGMA_RAD, SIGMA_RATE, SIGMA_ACCEL = 0.002, 0.009, 0.002, 0.02
ESC_EVERY, SLOW_EVERY, TAG_EVERY = 5, 10, 2
"""Ticks between two feedbacks of an ESC, between two readings of the supply and cabin, and between two pictures."""


class StillFleet:
    """The inputs of a body of n modules that hangs still in the water, with noise; every module answers in every tick."""

    def __init__(self, body: Body, seed: int) -> None:
        self._body, self._rng = body, np.random.default_rng(seed)
        self._modules = range(len(body.modules))
        self._turned = [to_matrix(np.ascontiguousarray(q)).T for q in body.q_bm]
        self._tag_of = {int(m): k for k, m in enumerate(body.tag_module)}

    def inputs(self, tick: int, requests: list[Request]) -> Inputs:
        """Those of tick `tick`."""
        return Inputs(tick, tick * PERIOD_NS, [self._module(m, tick) for m in self._modules], requests, False, 0, False)

    def _module(self, m: int, tick: int) -> ModuleInputs:
        body, noise = self._body, self._rng.standard_normal(13)
        down = np.array([0.0, 0.0, -GRAVITY])
        found = ModuleInputs(answered=True, heard=True, mcu_state=1)
        found.gyro = SIGMA_RATE * noise[:3]
        found.accel = self._turned[m] @ down + SIGMA_ACCEL * noise[3:6]
        if tick % 2 == 0:
            found.pressure_pa = ATMOSPHERE_PA + WATER_DENSITY * GRAVITY * (DEPTH_M + float(body.r_bi[m][2]))
        if tick % ESC_EVERY == m % ESC_EVERY:
            found.esc = [EscFeedback(first, (0.0, 0.0), (0.1, 0.1), (0, 0)) for first in (0, 2, 4, 6)]
        if tick % SLOW_EVERY == m % SLOW_EVERY:
            found.voltage_v = float(body.thrusters.voltage_v[body.thrusters.module == m][0])
            found.cabin_temperature_c, found.cabin_pressure_pa, found.leak = 25.0, 1e5, False
            found.dock_current_ma = [0.0] * 6
        if tick % TAG_EVERY == 0 and m in self._tag_of:
            k = self._tag_of[m]
            q_bt = np.ascontiguousarray(body.q_bt[k])
            place = np.array([0.0, 0.0, DEPTH_M]) + body.r_bt[k] + SIGMA_M * noise[6:9]
            turn = normalise(np.array([1.0, *(0.5 * SIGMA_RAD * noise[9:12])]))
            capture_ns = (tick - 4) * PERIOD_NS
            found.tags = [TagObservation(int(body.tag_ids[k]), 7, capture_ns, place, multiply(q_bt, turn))]
        return found


def cube_of(edge: int) -> Body:
    """A body of edge^3 modules."""
    cells = np.array([(x, y, z) for x in range(edge) for y in range(edge) for z in range(edge)])
    return assemble(cells, [0] * len(cells), [load_vehicle("modcube")] * len(cells))


def tick_us(body: Body, ticks: int = 300, seed: int = 0) -> float:
    """Mean duration of pipeline.step while the body holds its pose, us. Raises RuntimeError when it does not arm."""
    pipeline, fleet = Pipeline([body], Parameters(), PERIOD_NS), StillFleet(body, seed)
    took_ns, armed = 0, False
    for tick in range(1, SETTLE_TICKS + ticks + 1):
        requests = [] if armed or tick % 50 else [Request(Action.ARM, body.index)]
        inputs = fleet.inputs(tick, requests)
        began = perf_counter_ns()
        outputs = pipeline.step(inputs)
        if tick > SETTLE_TICKS:
            took_ns += perf_counter_ns() - began
        armed = outputs.modules[0].armed
    if not armed:
        raise RuntimeError(f"a body of {len(body.modules)} modules did not arm: {[e.text for e in outputs.events]}")
    return 1e-3 * took_ns / ticks
