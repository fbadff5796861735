"""For tools/bench.py: the cost of a tick of many docked modules beside that of one, with the sensor data of every module.

    .venv/bin/python tools/bench_fleet.py EDGE

holds a cube of EDGE^3 modules and prints the duration of a tick, how far the cube strayed, and the memory of the process.
"""

from __future__ import annotations

import json
from collections import deque
from pathlib import Path
from time import perf_counter_ns

from command_line import Parser, run_tool

import numpy as np

from firmware_py.core import propagation
from firmware_py.core.body import Body
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.propagation import STATES
from firmware_py.core.rotations import multiply, normalise, rotate, to_matrix
from firmware_py.core.thruster import ThrusterLag
from firmware_py.core.types import CHANNELS, Action, DockFeedback, EscFeedback, Inputs, ModuleInputs, Outputs, Request, TagObservation
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.description.water import ATMOSPHERE_PA, GRAVITY, PA_PER_M
from firmware_py.prepare.assembly import assemble
from firmware_py.runtime.realtime import quiet_garbage

PERIOD_NS = 10_000_000
PERIOD_S = 1e-9 * PERIOD_NS
ARM_TICK, SETTLE_TICKS = 50, 300
"""Tick at which the body is armed, its pose being known; and ticks before timing, until the disturbance is learnt and the position held."""
TIMED_TICKS = 100
"""Ten rounds of the slowest sensor data."""
START_W = np.array([0.0, 0.0, 2.0])
CURRENT_N, TRIM_NM = np.array([0.6, -0.4, 0.3]), np.array([0.02, -0.03, 0.01])
"""Each module's share of the disturbance force (world frame) and moment (body frame)."""
SIGMA_M, SIGMA_RAD, SIGMA_RATE, SIGMA_ACCEL = 0.002, 0.009, 0.002, 0.02
DEPTH_EVERY, ESC_EVERY, SLOW_EVERY, TAG_EVERY, TAG_DELAY = 2, 5, 10, 2, 4
"""Ticks between readings of depth, of an ESC, of supply, cabin and magnets, and between pictures; and from a picture to its arrival."""


class FleetInWater:
    """A body in water simulated with the controller's own model plus noise; every module answers in every tick."""

    def __init__(self, body: Body, seed: int) -> None:
        t, modules = body.thrusters, range(len(body.modules))
        self._body, self._rng = body, np.random.default_rng(seed)
        self._plant = body.plant
        self._acts, self._tau = ThrusterLag(t, PERIOD_S), np.zeros(6)
        self.x = np.zeros(STATES)
        """(32,) true state, in the order of core.propagation."""
        self.x[:3], self.x[3] = START_W, 1.0
        self.x[19:22], self.x[22:25] = len(modules) * CURRENT_N, len(modules) * TRIM_NM
        self._past: deque[np.ndarray] = deque([self.x], maxlen=TAG_DELAY + 1)
        self._turned = [to_matrix(np.ascontiguousarray(q)).T for q in body.q_bm]
        self._tags = [int(np.flatnonzero(body.tag_module == m)[-1]) for m in modules]
        self._mine = [np.flatnonzero(t.module == m) for m in modules]
        self._channels = t.module * CHANNELS + t.channel
        self._full_n = t.forward.sum(axis=1), t.reverse.sum(axis=1)

    def move(self, outputs: Outputs) -> None:
        """Advances the simulation by one period under the commands of a tick."""
        t, powers = self._body.thrusters, np.arange(1, 6)
        self._tau = t.matrix @ self._acts.step()
        share = np.concatenate([outputs.modules[m].thrusters for m in self._body.modules])[self._channels, None]
        curves = np.where(share > 0.0, t.forward, t.reverse)
        self._acts.command(np.sum(np.sign(share) * curves * np.abs(share) ** powers, axis=1))
        self.x = propagation.step(self.x, self._tau, PERIOD_S, *self._plant)
        self._past.append(self.x)

    def inputs(self, tick: int, requests: list[Request]) -> Inputs:
        """Inputs of tick `tick`."""
        down = to_matrix(self.x[3:7].copy())[2]
        felt = propagation.inertial_acceleration(self.x, self._tau, *self._plant) - GRAVITY * down
        force = self._acts.force_n
        speed = self._body.thrusters.rpm_at_full * np.sqrt(np.abs(force) / np.where(force > 0.0, *self._full_n))
        rpm = np.copysign(speed, force)
        modules = [self._module(m, tick, felt, down, rpm[mine].tolist()) for m, mine in enumerate(self._mine)]
        return Inputs(tick, tick * PERIOD_NS, modules, requests)

    def _module(self, m: int, tick: int, felt: np.ndarray, down: np.ndarray, rpm: list[float]) -> ModuleInputs:
        body, noise = self._body, self._rng.standard_normal(6)
        found = ModuleInputs(answered=True, heard=True, mcu_state=1)
        found.gyro = self._turned[m] @ self.x[10:13] + SIGMA_RATE * noise[:3]
        found.accel = self._turned[m] @ felt + SIGMA_ACCEL * noise[3:]
        if tick % DEPTH_EVERY == 0:
            depth_m = float(self.x[2] + body.r_bi[m] @ down)
            found.pressure_pa = ATMOSPHERE_PA + PA_PER_M * depth_m
        if tick % ESC_EVERY == m % ESC_EVERY:
            found.esc = [EscFeedback(i, (rpm[i], rpm[i + 1]), (0.1, 0.1), (0, 0)) for i in range(0, len(rpm), 2)]
        if tick % SLOW_EVERY == m % SLOW_EVERY:
            found.voltage_v = float(body.thrusters.voltage_v[self._mine[m][0]])
            found.cabin_temperature_c, found.cabin_pressure_pa, found.leak = 25.0, 1e5, False
            found.docks = [DockFeedback(first, (100.0,) * 3, (1, 1, 1)) for first in (0, 3)]
        if tick % TAG_EVERY == 0 and len(self._past) > TAG_DELAY:
            found.tags = [self._tag(self._tags[m], (tick - TAG_DELAY) * PERIOD_NS)]
        return found

    def _tag(self, k: int, capture_ns: int) -> TagObservation:
        body, then, noise = self._body, self._past[0], self._rng.standard_normal(6)
        q_wb = then[3:7].copy()
        turn = normalise(np.array([1.0, *(0.5 * SIGMA_RAD * noise[:3])]))
        q_wt = multiply(multiply(q_wb, np.ascontiguousarray(body.q_bt[k])), turn)
        p_wt = then[:3] + rotate(q_wb, np.ascontiguousarray(body.r_bt[k])) + SIGMA_M * noise[3:]
        return TagObservation(int(body.tag_ids[k]), 7, capture_ns, p_wt, q_wt)


def cube_of(edge: int) -> Body:
    """A cube-shaped body of edge^3 modules."""
    cells = np.array([(x, y, z) for x in range(edge) for y in range(edge) for z in range(edge)])
    return assemble(cells, [0] * len(cells), [load_vehicle("modcube")] * len(cells))


class Hold:
    """The pipeline of one armed body that holds its place in the water."""

    def __init__(self, body: Body, seed: int = 0) -> None:
        """Raises RuntimeError when it does not arm."""
        self._body, self._fleet, self._tick = body, FleetInWater(body, seed), 0
        self._pipeline, self._said = Pipeline([body], Parameters(), PERIOD_NS), list[str]()
        self.strayed_m = 0.0
        """Largest distance from the set-point."""
        self.run(SETTLE_TICKS)
        self.strayed_m = 0.0

    @quiet_garbage()
    def run(self, ticks: int) -> float:
        """Mean duration of pipeline.step, us. Raises RuntimeError when the body disarms or a healthy thruster is left out."""
        took_ns = 0
        for _ in range(ticks):
            inputs = self._fleet.inputs(self._tick, [Request(Action.ARM, self._body.index)] if self._tick == ARM_TICK else [])
            began = perf_counter_ns()
            outputs = self._pipeline.step(inputs)
            took_ns += perf_counter_ns() - began
            self._take(outputs)
        if not outputs.modules[0].armed or any("left out" in words for words in self._said):
            raise RuntimeError(f"a body of {len(self._body.modules)} modules does not hold: {'; '.join(self._said)}")
        return 1e-3 * took_ns / ticks

    def _take(self, outputs: Outputs) -> None:
        self._tick += 1
        self._fleet.move(outputs)
        self._said += [event.text for event in outputs.events]
        self.strayed_m = max(self.strayed_m, float(np.linalg.norm(self._fleet.x[:3] - outputs.records[0].setpoint.p_wb)))


def peak_memory_mb() -> float:
    """Peak memory of this process, MB. Not from getrusage, whose figure starts at that of the parent process."""
    status = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    return float(status["VmHWM"].split()[0]) / 1024.0


def main() -> None:
    """Holds a cube of modules in a process of its own; prints the results."""
    parser = Parser(description=__doc__)
    parser.add_argument("side", type=int, choices=range(1, 5), help="edge of the cube, in modules")
    flight = Hold(cube_of(parser.parse_args().side))
    tick_us = flight.run(TIMED_TICKS)
    print(json.dumps({"tick_us": tick_us, "strayed_m": flight.strayed_m, "memory_mb": peak_memory_mb()}))


if __name__ == "__main__":
    run_tool(main)
