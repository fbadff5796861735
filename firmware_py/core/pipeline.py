"""The tick, as in the paper's block diagram: measure, estimate, dock, decide, guide, control, allocate, limit.

One call serves the whole fleet.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from firmware_py.core.allocator import Allocator
from firmware_py.core.body import Body
from firmware_py.core.controller import LAWS
from firmware_py.core.depth_gate import DepthGate
from firmware_py.core.docking import DockingStage
from firmware_py.core.docking_detector import tag_table
from firmware_py.core.estimator import Estimator
from firmware_py.core.faults import FaultDetector
from firmware_py.core.formation import Formation
from firmware_py.core.guidance_modes import Guidance
from firmware_py.core.health_monitor import HealthMonitor
from firmware_py.core.joints import holding, joints_of
from firmware_py.core.limiter import Limiter
from firmware_py.core.measurements import Measurements
from firmware_py.core.motor_test import MotorTest
from firmware_py.core.paper_estimator import TagOnlyEstimator
from firmware_py.core.requests import FOR_ALL, readdressed, sift
from firmware_py.core.sensor_watch import SensorWatch
from firmware_py.core.supervisor import Decision, Supervisor
from firmware_py.core.supply import SupplyMeter
from firmware_py.core.thruster import ThrusterLag
from firmware_py.core.transitions import DOCKING, Effect, State, Trigger
from firmware_py.core.types import (
    CHANNELS,
    RELAY_OFF,
    WARNING,
    Action,
    BodyRecord,
    DockRequest,
    Estimate,
    Event,
    Inputs,
    Measured,
    Mode,
    ModuleCommand,
    Outputs,
    Request,
    Thrust,
)  # fmt: skip
from firmware_py.description.parameter_rules import changed
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError

ESTIMATORS: dict[str, type[Estimator] | type[TagOnlyEstimator]] = {"full": Estimator, "paper": TagOnlyEstimator}
ARMING_EVERY_NS = 100_000_000
"""Period at which the arming checks are evaluated for `BodyRecord.may_arm`."""


class BodyPipeline:
    """The stages of one body, in order."""

    def __init__(self, body: Body, parameters: Parameters, period_ns: int) -> None:
        self.body, self.parameters = body, parameters
        self.joints = joints_of(body)
        self._holding = holding(body, self.joints)
        self.sensors = SensorWatch(body.modules)
        self.depth_gate = DepthGate(body)
        self.measurements = Measurements(body, period_ns)
        self.estimator = ESTIMATORS[parameters.estimation.kind](body, parameters.estimation, period_ns)
        self.faults = FaultDetector(body, parameters.faults, period_ns)
        self.health = HealthMonitor(body, parameters, period_ns)
        self.supervisor = Supervisor(parameters)
        self.guidance = Guidance(body, parameters)
        self.motor_test = MotorTest(body, parameters.steering)
        self.dock_over = False
        self._judged_ns, self._could_arm = -ARMING_EVERY_NS, False
        self.parting: list[DockRequest] = []
        """Open joints for which a plan was last requested."""
        self.controller = LAWS[parameters.control.law](body, parameters.control)
        self.allocator = Allocator(body, parameters.allocation)
        self.limiter = Limiter(body, parameters.limiter, period_ns * 1e-9)
        self.lag = ThrusterLag(body.thrusters, period_ns * 1e-9)
        self.slots = body.thrusters.module * CHANNELS + body.thrusters.channel
        self.supply = SupplyMeter(body)

    def retune(self, parameters: Parameters) -> None:
        """Changes gains, noise figures and limits from this tick on; estimate, mode, set-point and forces stay as they are."""
        self.parameters = parameters
        self.estimator.retune(parameters.estimation)
        self.faults.retune(parameters.faults)
        self.motor_test.parameters = parameters.steering
        for stage in (self.health, self.supervisor, self.guidance):
            stage.retune(parameters)
        self.limiter.retune(parameters.limiter)
        self.controller = LAWS[parameters.control.law](self.body, parameters.control)
        if parameters.allocation != self.allocator.parameters:
            self.allocator = Allocator(self.body, parameters.allocation)
            self.allocator.set_alive(self.faults.now.alive)

    def measure(self, inputs: Inputs) -> Estimate:
        """Sensors -> estimate."""
        self.supply.step(inputs.modules)
        mean_n = self.lag.step()
        believed = self.sensors.step(inputs.modules)
        if self.sensors.pressure_heard:
            expected = self.estimator.expected_depth(inputs.time_ns)
            believed = self.depth_gate.step(inputs.time_ns, believed, expected, self.supervisor.armed)
        self.health.believed = believed
        measured = self.measurements.fuse(believed, self.estimator.q_wb)
        estimate = self.estimator.step(inputs.time_ns, measured, self.body.thrusters.matrix.dot(mean_n))
        self.depth_gate.compare(self.estimator.fused)
        self._find_faults(inputs, measured, estimate, mean_n)
        return estimate

    def _find_faults(self, inputs: Inputs, measured: Measured, estimate: Estimate, mean_n: np.ndarray) -> None:
        """Runs the fault detector; thrusters found dead or lying leave the allocation at once."""
        self.faults.step(inputs.modules, measured, estimate, self.lag.force_n, mean_n, self.supervisor.armed, self._is_free())
        if self.faults.changed:
            self.allocator.set_alive(self.faults.now.alive)

    def _is_free(self) -> bool:
        """Whether no magnet pulls at another body, which would push back, or pushes a module of this body away."""
        return all(
            magnets.states == held or all(state in (RELAY_OFF, hold) for state, hold in zip(magnets.states, held, strict=True))
            for magnets, held in zip(self.limiter.magnets, self._holding, strict=True)
        )

    def decide(self, inputs: Inputs, estimate: Estimate, requests: Sequence[Request]) -> list[DockRequest]:
        """Valid requests and fail-safes -> state and mode. Returns the docks and undocks that were granted."""
        mine = [r for r in requests if r.body == self.body.index or r.action in FOR_ALL]
        self.guidance.drop_stale_goals(estimate, self.health.step(inputs, estimate, mine, self.faults.now))
        was_armed = self.supervisor.armed
        decisions = self.supervisor.step(inputs.estop, self.health.now, mine, self._endings())
        for decision in decisions:
            self._apply(decision, inputs.time_ns, estimate)
        self.supervisor.events[:0] = [Event(WARNING, words) for words in self.faults.words]
        if self.supervisor.armed != was_armed:
            self.faults.reset()
            if self.faults.changed:
                self.allocator.set_alive(self.faults.now.alive)
        if not self.supervisor.armed:
            self.guidance.rest(estimate)
            self.motor_test.stop()
        return [decision.argument for decision in decisions if decision.trigger in DOCKING]

    def _endings(self) -> list[Trigger]:
        """Triggers of activities that ended by themselves: DOCK_OVER after a dock, TEST_OVER whenever no motor test runs."""
        ended = [Trigger.DOCK_OVER] if self.dock_over else []
        self.dock_over = False
        return ended if self.motor_test.running else [*ended, Trigger.TEST_OVER]

    def _apply(self, decision: Decision, time_ns: int, estimate: Estimate) -> None:
        self.guidance.apply(decision, time_ns, estimate)
        if decision.effect == Effect.TEST_MOTOR:
            self.motor_test.start(decision.argument, time_ns)
        elif decision.effect == Effect.ENTER_MODE and decision.mode == Mode.MOTOR_DETECT:
            self.motor_test.detect(time_ns)

    def control(self, time_ns: int, estimate: Estimate) -> tuple[BodyRecord, np.ndarray]:
        """Guide, control, allocate, limit. Returns the record of every signal, and the (n,) thruster commands."""
        health = self.health.now
        setpoint, ahead = self.guidance.step(time_ns, estimate, health)
        self.health.compare(setpoint, estimate, self.faults.now.keep)
        wrench = self.controller.step(setpoint, ahead, estimate)
        wrench = self.guidance.mix(wrench, time_ns, estimate, health)
        self.allocator.confine(self.limiter.limits(self.supply.voltage_v))
        thrust = self._allocate(wrench, time_ns)
        supervisor = self.supervisor
        force, command = self.limiter.step(thrust.force_n, supervisor.armed, self.supply.voltage_v, self.faults.now.alive)
        self.lag.command(force)
        self.health.warm = True
        record = BodyRecord(
            self.body.index, supervisor.state, supervisor.mode, estimate, setpoint, wrench, thrust, force, self._may_arm(time_ns),
            supervisor.level,
        )  # fmt: skip
        return record, command

    def _may_arm(self, time_ns: int) -> bool:
        """Whether ARM would be granted. Evaluated ten times a second only, as it runs every check and is for display."""
        if time_ns - self._judged_ns >= ARMING_EVERY_NS:
            self._judged_ns, self._could_arm = time_ns, self.supervisor.may_arm(self.health.now)
        return self._could_arm and self.supervisor.state == State.DISARMED

    def magnets(self, wanted: Sequence[Sequence[int]], due: Collection[int]) -> dict[int, tuple[int, ...]]:
        """Limits the wanted relay states. Returns the states to send, by module: those of modules that are due or whose states changed.

        Args:
            wanted: six states of each module of the fleet.
            due: fleet indices of modules.
        """
        sent = {}
        for module, limiter in zip(self.body.modules, self.limiter.magnets, strict=True):
            before, states = limiter.states, limiter.step(wanted[module])
            if module in due or states != before:
                sent[module] = states
        return sent

    def _allocate(self, wrench: np.ndarray, time_ns: int) -> Thrust:
        """Thruster forces for the wrench, without the part that the remaining thrusters cannot make; or those of a motor test."""
        if self.supervisor.mode == Mode.MOTOR_DETECT:
            force = self.motor_test.step(time_ns)
            return Thrust(force, self.body.thrusters.matrix @ force, (1.0, 1.0))
        return self.allocator.step(self.faults.now.keep.dot(wrench))


class Pipeline:
    """All bodies of one firmware process."""

    def __init__(self, bodies: list[Body], parameters: Parameters, period_ns: int) -> None:
        self._period_ns = period_ns
        self._modules = 1 + max(module for body in bodies for module in body.modules)
        docking = DockingStage(parameters.docking, tag_table(bodies), self._modules)
        self.formation = Formation([BodyPipeline(body, parameters, period_ns) for body in bodies], docking, parameters)

    @property
    def bodies(self) -> list[Body]:
        """The bodies as they are docked now."""
        return self.formation.bodies

    @property
    def parameters(self) -> Parameters:
        """The present parameters."""
        return self.formation.parameters

    def body_pipeline_of(self, body: Body) -> BodyPipeline:
        """Creates the stages of a future body: built outside the control loop, swapped in by a join or part."""
        return BodyPipeline(body, self.parameters, self._period_ns)

    def step(self, inputs: Inputs) -> Outputs:
        """Runs one tick."""
        outputs = Outputs(inputs.tick, inputs.time_ns, [IDLE] * self._modules, False, [], [])
        formation, docking = self.formation, self.formation.docking
        estimates = {pipeline.body.index: pipeline.measure(inputs) for pipeline in formation.pipelines}
        before = formation.bodies_known(inputs.time_ns)
        formation.step(inputs, estimates, outputs)
        formation.watch_distances(inputs.time_ns, estimates)
        bodies = {body.index: body for body in formation.bodies}
        requests, refusals = sift(readdressed(inputs.requests, before, bodies), bodies)
        outputs.events += refusals
        if requests:
            self._retune(requests, outputs)
        for pipeline in formation.pipelines:
            granted = pipeline.decide(inputs, estimates[pipeline.body.index], requests)
            outputs.preparations += formation.preparations_for(pipeline, granted)
            outputs.events += [event._replace(body=pipeline.body.index) for event in pipeline.supervisor.events]
            outputs.estop = outputs.estop or pipeline.supervisor.raises_estop
            if docking.under_way:
                formation.leave(pipeline, outputs)
        wanted, due = docking.relays.states, docking.relays.due(inputs.time_ns)
        for pipeline in formation.pipelines:
            relays = pipeline.magnets(wanted, due)
            record, command = pipeline.control(inputs.time_ns, estimates[pipeline.body.index])
            outputs.records.append(record)
            _command(pipeline, command, relays, outputs)
        return outputs

    def _retune(self, requests: Sequence[Request], outputs: Outputs) -> None:
        """Applies parameters set since the last tick, one after the other. A value that passed a ground station's registry may still be
        refused here.

        While any body is armed, a value is refused after which the arming checks would refuse the parameters. While all are disarmed
        it is taken, because a ground station loads a file one parameter at a time, in an order of its own.
        """
        wanted = dict(r.argument for r in requests if r.action == Action.SET_PARAMETER)
        if not wanted:
            return
        parameters, is_armed = self.parameters, any(pipeline.supervisor.armed for pipeline in self.formation.pipelines)
        for name, value in wanted.items():
            try:
                parameters = changed(parameters, name, value, is_armed)
            except DescriptionError as error:
                outputs.events.append(Event(WARNING, str(error)))
        self.formation.retune(parameters)


IDLE = ModuleCommand(False, np.zeros(CHANNELS), None)
"""Command of a module that belongs to no body."""


def _command(pipeline: BodyPipeline, command: np.ndarray, relays: Mapping[int, tuple[int, ...]], outputs: Outputs) -> None:
    """Writes each module's command: its own thrusters and, where due, its relays."""
    armed, channels = pipeline.supervisor.armed, np.zeros((len(pipeline.body.modules), CHANNELS))
    channels.put(pipeline.slots, command)
    for module, thrusters in zip(pipeline.body.modules, channels, strict=True):
        outputs.modules[module] = ModuleCommand(armed, thrusters, relays.get(module))
