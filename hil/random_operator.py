"""A random operator who makes any request at any time while anything may fail, and the rules that every tick must keep regardless.

Requests are those of a ground station: arming, modes, set-points, docks, motor tests, parameters, e-stops and their release, in any order.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, NamedTuple

import numpy as np

from firmware_py.app.firmware import BusFrame
from firmware_py.core.setpoint import Trajectory, rest_at
from firmware_py.core.transitions import State
from firmware_py.core.types import (
    CHANNELS,
    FACES,
    Action,
    BodyRecord,
    DockRequest,
    Inputs,
    Mode,
    ModuleCommand,
    Outputs,
    Request,
    Setpoint,
    Sticks,
)
from firmware_py.description.parameters import Parameters, registry
from firmware_py.description.vehicle import FACE_NAMES
from firmware_py.prepare.paths import circle
from hil.bench import Bench, open_bench
from hil.fault_table import SINGLE_FAULTS
from hil.orders import Orders
from hil.plant.draw import stream
from hil.plant.fault_spec import Fault
from hil.scenario import load_scenario

SCENARIOS = ("dock", "mobius-2", "hover")
"""Two bodies that may dock, one body of two modules that may undock, and a single module."""
ASK_EVERY, STREAM_EVERY = 25, 5
"""Ticks between random requests, and between stick positions and heartbeats of the ground station."""
SILENCE_PROBABILITY = 0.01
"""Probability that the ground station falls silent, or returns, whenever a heartbeat is due."""
FACING = (FACE_NAMES.index("-x"), FACE_NAMES.index("+x"))
"""Faces with which the second module of these scenarios meets the first."""
MOST_FAULTS = 5
BREAKS = [fault for fault in SINGLE_FAULTS if fault.kind != "process_killed"]
"""Faults that may be drawn: those of the fault matrix that come alone, except a killed process, which forgets its requests."""
REGISTRY = tuple(registry())
SOON = 2
"""Ticks within which a request takes effect."""


class RandomOperator(Orders):
    """The random requests of one flight of a fleet, drawn from `rng`."""

    def __init__(self, rng: np.random.Generator, modules: int, ticks: int) -> None:
        self.ticks = ticks
        self.asked = dict.fromkeys(Action, -math.inf)
        """Tick of the last request for each action."""
        self._rng, self._modules, self._is_there = rng, modules, True

    def requests(self, time_ns: int, last: Outputs | None) -> list[Request]:
        """The requests in the tick after `last`."""
        if last is None:
            return []
        body, tick, asked = int(self._rng.choice([record.body for record in last.records])), last.tick + 1, list[Request]()
        if tick % STREAM_EVERY == 0:
            self._is_there ^= self._rng.random() < SILENCE_PROBABILITY
            if self._is_there:
                asked += [Request(Action.GROUND_ALIVE), Request(Action.STICKS, body, self._sticks())]
        if tick % ASK_EVERY == 0:
            action = Action(int(self._rng.choice(list(WEIGHTS), p=list(WEIGHTS.values()))))
            asked.append(Request(action, body, ARGUMENTS[action](self._rng, self._modules)))
        self.asked |= {request.action: tick for request in asked}
        return asked

    def _sticks(self) -> Sticks:
        """Random stick positions; centred two times out of three."""
        pushed = self._rng.uniform(-1.0, 1.0, 6) * (self._rng.random() < 0.33)
        return Sticks(tuple(pushed[:3].tolist()), tuple(pushed[3:].tolist()))


WEIGHTS: Mapping[Action, float] = {
    Action.ARM: 0.38, Action.DISARM: 0.05, Action.HOLD: 0.05, Action.ESTOP: 0.02, Action.CLEAR_ESTOP: 0.08, Action.SET_MODE: 0.12,
    Action.SET_POINT: 0.05, Action.TRACK: 0.03, Action.SET_PARAMETER: 0.05, Action.DOCK: 0.08, Action.UNDOCK: 0.04, Action.MOTOR_TEST: 0.05,
}  # fmt: skip
"""Probability of each action. Arming is by far the most frequent, because a disarmed robot breaks no rule."""


def _forced(rng: np.random.Generator, modules: int) -> bool:
    return bool(rng.random() < 0.3)


def _mode(rng: np.random.Generator, modules: int) -> Mode:
    return Mode(int(rng.choice(list(Mode))))


def _place(rng: np.random.Generator, modules: int) -> Setpoint:
    turned = np.array([math.cos(half := rng.uniform(-1.0, 1.0)), 0.0, 0.0, math.sin(half)])
    return rest_at(rng.uniform([-0.4, -0.4, 0.1], [0.4, 0.4, 0.65]), turned)


def _path(rng: np.random.Generator, modules: int) -> Trajectory:
    return circle(np.array([0.0, 0.0, 0.38]), float(rng.uniform(0.1, 0.4)), 1.0, float(rng.uniform(5.0, 20.0)))


def _motor(rng: np.random.Generator, modules: int) -> tuple[int, float, float]:
    """Thruster, share of full command and seconds; the thruster index may be one past the last."""
    return (int(rng.integers(CHANNELS + 1)), float(rng.uniform(-1.0, 1.0)), float(rng.uniform(0.0, 3.0)))


def _parameter(rng: np.random.Generator, modules: int) -> tuple[str, float | str]:
    """Name and value of any parameter; the value is sometimes out of range."""
    name, limits = REGISTRY[int(rng.integers(len(REGISTRY)))]
    if limits.choices:
        return (name, str(rng.choice(limits.choices)))
    low = max(limits.low, -10.0)
    value = float(low + min(20.0, limits.high - low) * rng.uniform(-0.05, 1.05))
    return (name, round(value) if rng.random() < 0.5 else value)


def _faces(rng: np.random.Generator, modules: int) -> DockRequest:
    module, target = rng.integers(modules, size=2).tolist()
    face, target_face = FACING if rng.random() < 0.7 else rng.integers(FACES, size=2).tolist()
    return DockRequest(module, face, target, target_face, both_approach=bool(rng.random() < 0.3))


def _nothing(rng: np.random.Generator, modules: int) -> None:
    return None


ARGUMENTS: Mapping[Action, Callable[[np.random.Generator, int], Any]] = {
    Action.ARM: _forced, Action.DISARM: _forced, Action.SET_MODE: _mode, Action.HOLD: _place, Action.SET_POINT: _place, Action.TRACK: _path,
    Action.MOTOR_TEST: _motor, Action.SET_PARAMETER: _parameter, Action.DOCK: _faces, Action.UNDOCK: _faces, Action.ESTOP: _nothing,
    Action.CLEAR_ESTOP: _nothing,
}  # fmt: skip
"""Generator of each action's argument, given the number of modules."""


class Seen(NamedTuple):
    """One module in one tick."""

    flown_by: int
    """Number of bodies that claim the module."""
    record: BodyRecord
    """Record of the module's body."""
    command: ModuleCommand
    before: int
    """State of the module's body in the previous tick."""
    was_armed: bool
    """Whether its body contains a module that was armed in the previous tick: this one, or one that it has docked to."""
    ticks_since_request: Mapping[Action, float]
    """Ticks since the last request for each action."""


def _is_finite(record: BodyRecord) -> bool:
    signals = (*record.estimate[:5], *record.setpoint, record.wrench, record.thrust.force_n, record.commanded_n)
    return all(np.isfinite(signal).all() for signal in signals)


RULES: Mapping[str, Callable[[Seen], bool]] = {
    "flown by one body": lambda s: s.flown_by == 1,
    "commands are shares": lambda s: bool((np.abs(s.command.thrusters) <= 1.0).all()),
    "who is not armed turns nothing": lambda s: s.record.state == State.ARMED or not (s.command.armed or s.command.thrusters.any()),
    "nobody arms unasked": lambda s: (
        s.record.state != State.ARMED
        or s.was_armed
        or min(s.ticks_since_request[Action.ARM], s.ticks_since_request[Action.MOTOR_TEST]) <= SOON
    ),
    "an e-stop stands until it is cleared": lambda s: (
        s.before != State.ESTOP or s.record.state == State.ESTOP or s.ticks_since_request[Action.CLEAR_ESTOP] <= SOON
    ),
    "signals are numbers": lambda s: _is_finite(s.record),
}  # fmt: skip
"""Invariants of each module in every tick."""


class Operated(NamedTuple):
    """One flight with a random operator."""

    broken: Counter[str]
    """Number of violations of each rule, one per module and tick."""
    modes: Counter[str]
    """Number of armed ticks in each mode, summed over the modules."""
    ticks: int


def fly_with_random_operator(seed: int, duration_s: float) -> Operated:
    """Flies for `duration_s` with faults and requests drawn from `seed`. The firmware's exceptions propagate."""
    rng, base = stream(seed, "operator"), load_scenario(SCENARIOS[seed % len(SCENARIOS)])
    faults = tuple(_fault(rng, duration_s) for _ in range(rng.integers(MOST_FAULTS + 1)))
    scenario = dataclasses.replace(base, estop_box=True, fault=faults)
    operated = Operated(Counter(), Counter(), round(100 * duration_s))
    operator = RandomOperator(rng, len(scenario.module), operated.ticks)
    with ExitStack() as stack:
        bench = open_bench(stack, scenario, seed, Parameters(), f"virtual:operator{seed}")
        bench.script = operator
        before: dict[int, int] = {}

        def watch(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
            nonlocal before
            seen = _seen(bench, operator, outputs, before)
            before = {module: each.record.state for module, each in seen.items()}
            for each in seen.values():
                operated.broken.update(rule for rule, holds in RULES.items() if not holds(each))
                operated.modes.update([Mode(each.record.mode).name] if each.record.state == State.ARMED else [])

        bench.fly([watch])
    return operated


def _fault(rng: np.random.Generator, duration_s: float) -> Fault:
    at_s = float(rng.uniform(0.0, duration_s))
    return dataclasses.replace(BREAKS[int(rng.integers(len(BREAKS)))], at_s=at_s, until_s=at_s + float(rng.uniform(0.1, 10.0)))


def _seen(bench: Bench, operator: RandomOperator, outputs: Outputs, before: Mapping[int, int]) -> dict[int, Seen]:
    """Input of the rules after a tick, by module; `before`: state of each module's body in the previous tick."""
    bodies, ticks_since_request = bench.firmware.pipeline.bodies, {action: outputs.tick - tick for action, tick in operator.asked.items()}
    records = {record.body: record for record in outputs.records}
    seen = {}
    for module, command in enumerate(outputs.modules):
        holders = [body for body in bodies if module in body.modules]
        holder = holders[0] if holders else bodies[0]  # a module of no body breaks the first rule in any case
        was_armed = any(before.get(other) == State.ARMED for other in holder.modules)
        record, state = records[holder.index], before.get(module, State.DISARMED)
        seen[module] = Seen(len(holders), record, command, state, was_armed, ticks_since_request)
    return seen
