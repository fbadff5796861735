"""The tick, as in the paper's block diagram: measure, estimate, decide, guide, control, allocate, limit. One call serves the whole fleet."""

from __future__ import annotations

import numpy as np

from firmware_py.core.allocator import Allocator
from firmware_py.core.body import Body
from firmware_py.core.controller import Controller
from firmware_py.core.estimator import Estimator, TagOnlyEstimator
from firmware_py.core.limiter import Limiter
from firmware_py.core.measurements import Measurements
from firmware_py.core.setpoint import Guidance
from firmware_py.core.supervisor import Supervisor
from firmware_py.core.thruster import ThrusterLag
from firmware_py.core.types import Action, BodyRecord, Estimate, Inputs, ModuleCommand, Outputs, Request
from firmware_py.description.parameters import Parameters

ESTIMATORS = {"full": Estimator, "paper": TagOnlyEstimator}
CHANNELS = 8
"""Thruster commands that one module's frames carry."""


class BodyPipeline:
    """The stages of one body, in order."""

    def __init__(self, body: Body, parameters: Parameters, period_ns: int) -> None:
        self.body = body
        self.measurements = Measurements(body)
        self.estimator = ESTIMATORS[parameters.estimation.kind](body, parameters.estimation, period_ns)
        self.supervisor = Supervisor(body.modules, parameters.supervision)
        self.guidance = Guidance(parameters.control.lead_s)
        self.controller = Controller(body, parameters.control)
        self.allocator = Allocator(body, parameters.allocation)
        self.limiter = Limiter(body, parameters.limiter, period_ns * 1e-9)
        self.lag = ThrusterLag(body.thrusters, period_ns * 1e-9)
        self.voltage_v = np.array([body.thrusters.voltage_v[body.thrusters.module == m][0] for m in range(len(body.modules))])

    def step(self, inputs: Inputs) -> tuple[BodyRecord, np.ndarray]:
        """Record of every signal, and the (n,) thruster commands."""
        self._read_supply(inputs)
        applied = self.body.thrusters.matrix @ self.lag.step()
        measured = self.measurements.fuse(inputs.modules, self.estimator.q_wb)
        estimate = self.estimator.step(inputs.time_ns, measured, applied)
        self._decide(inputs, estimate)
        setpoint, ahead = self.guidance.step(inputs.time_ns)
        wrench = self.controller.step(setpoint, ahead, estimate)
        thrust = self.allocator.step(wrench)
        force, command = self.limiter.step(thrust.force_n, self.supervisor.armed, self.voltage_v)
        self.lag.command(force)
        record = BodyRecord(self.body.index, self.supervisor.state, estimate, setpoint, wrench, thrust, force)
        return record, command

    def _decide(self, inputs: Inputs, estimate: Estimate) -> None:
        mine = [r for r in inputs.requests if r.body == self.body.index]
        for request in self.supervisor.step(inputs, estimate, mine):
            self._apply(request, inputs.time_ns, estimate)
        if not self.supervisor.armed:
            self.guidance.hold_here(estimate)

    def _apply(self, request: Request, time_ns: int, estimate: Estimate) -> None:
        if request.action == Action.TRACK:
            self.guidance.follow(request.argument, time_ns)
        elif request.action == Action.HOLD and request.argument is not None:
            self.guidance.hold(request.argument)
        else:
            self.guidance.hold_here(estimate)

    def _read_supply(self, inputs: Inputs) -> None:
        for i, module in enumerate(self.body.modules):
            voltage = inputs.modules[module].voltage_v
            if voltage is not None:
                self.voltage_v[i] += VOLTAGE_SMOOTHING * (voltage - self.voltage_v[i])


VOLTAGE_SMOOTHING = 0.5
"""Share of a new voltage reading (10 Hz) that is believed: settles in half a second."""


class Pipeline:
    """All bodies of one firmware process."""

    def __init__(self, bodies: list[Body], parameters: Parameters, period_ns: int) -> None:
        self.parameters = parameters
        self._chains = [BodyPipeline(body, parameters, period_ns) for body in bodies]
        self._modules = sum(len(body.modules) for body in bodies)

    @property
    def bodies(self) -> list[Body]:
        """The bodies as they are docked now."""
        return [chain.body for chain in self._chains]

    def step(self, inputs: Inputs) -> Outputs:
        """One tick."""
        outputs = Outputs(inputs.tick, inputs.time_ns, [IDLE] * self._modules, False, [], [])
        for chain in self._chains:
            record, command = chain.step(inputs)
            outputs.records.append(record)
            outputs.events += chain.supervisor.events
            self._command(chain, command, outputs)
        return outputs

    def _command(self, chain: BodyPipeline, command: np.ndarray, outputs: Outputs) -> None:
        """Hands each module its own thrusters."""
        thrusters = chain.body.thrusters
        channels = np.zeros((len(chain.body.modules), CHANNELS))
        channels[thrusters.module, thrusters.channel] = command
        for i, module in enumerate(chain.body.modules):
            outputs.modules[module] = ModuleCommand(chain.supervisor.armed, channels[i], None)


IDLE = ModuleCommand(False, np.zeros(CHANNELS), None)
"""What a module is told that belongs to no body."""
