"""The tick, as in the paper's block diagram: measure, estimate, dock, decide, guide, control, allocate, limit.

One call serves the whole fleet.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from firmware_py.core.allocator import Allocator
from firmware_py.core.body import Body
from firmware_py.core.controller import Controller
from firmware_py.core.docking import Decisions, DockingStage, Join, Part, tag_table
from firmware_py.core.docking_pairs import APART, LOOSE
from firmware_py.core.estimator import Estimator
from firmware_py.core.faults import FaultDetector
from firmware_py.core.guidance_modes import Guidance
from firmware_py.core.health import HealthMonitor
from firmware_py.core.imu_watch import ImuWatch
from firmware_py.core.joints import joints_of
from firmware_py.core.limiter import Limiter
from firmware_py.core.measurements import Measurements
from firmware_py.core.motor_test import MotorTest
from firmware_py.core.paper_estimator import TagOnlyEstimator
from firmware_py.core.requests import FOR_ALL, sift
from firmware_py.core.supervisor import WARNING, Decision, Supervisor
from firmware_py.core.supply import SupplyMeter
from firmware_py.core.thruster import ThrusterLag
from firmware_py.core.topology import in_both, join, part_of
from firmware_py.core.transitions import DOCKING, Effect, State, Trigger
from firmware_py.core.types import (
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
    PartRequest,
    Request,
    Thrust,
)  # fmt: skip
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError

ESTIMATORS: dict[str, type[Estimator] | type[TagOnlyEstimator]] = {"full": Estimator, "paper": TagOnlyEstimator}
ARMING_EVERY_NS = 100_000_000
"""Between two times that the arming checks are asked for what a record says of them."""
CHANNELS = 8
"""Thruster commands that one module's frames carry."""


class BodyPipeline:
    """The stages of one body, in order."""

    def __init__(self, body: Body, parameters: Parameters, period_ns: int) -> None:
        self.body, self.parameters = body, parameters
        self.joints = joints_of(body)
        self.measurements = Measurements(body, period_ns)
        self.imus = ImuWatch(body.modules)
        self.estimator = ESTIMATORS[parameters.estimation.kind](body, parameters.estimation, period_ns)
        self.faults = FaultDetector(body, parameters.faults, period_ns)
        self.health = HealthMonitor(body, parameters, period_ns)
        self.supervisor = Supervisor(parameters)
        self.guidance = Guidance(body, parameters)
        self.motor_test = MotorTest(body, parameters.steering)
        self.dock_over = False
        self._asked_ns, self._may = -ARMING_EVERY_NS, False
        self.parting: list[DockRequest] = []
        """Open joints for which a plan was last asked."""
        self.controller = Controller(body, parameters.control)
        self.allocator = Allocator(body, parameters.allocation)
        self.limiter = Limiter(body, parameters.limiter, period_ns * 1e-9)
        self.lag = ThrusterLag(body.thrusters, period_ns * 1e-9)
        self.slots = body.thrusters.module * CHANNELS + body.thrusters.channel
        self.supply = SupplyMeter(body)

    def retune(self, parameters: Parameters) -> None:
        """Takes other gains, noise figures and limits from this tick on; estimate, mode, set-point and forces stay as they are."""
        self.parameters = parameters
        self.estimator.retune(parameters.estimation)
        self.faults.retune(parameters.faults)
        self.motor_test.parameters = parameters.steering
        for stage in (self.health, self.supervisor, self.guidance):
            stage.retune(parameters)
        self.limiter.retune(parameters.limiter)
        self.controller = Controller(self.body, parameters.control)
        if parameters.allocation != self.allocator.parameters:
            self.allocator = Allocator(self.body, parameters.allocation)
            self.allocator.set_alive(self.faults.now.alive)

    def measure(self, inputs: Inputs) -> Estimate:
        """Sensors -> estimate."""
        self.supply.step(inputs.modules)
        mean_n = self.lag.step()
        self.health.imu_heard = self.imus.step(inputs.modules)
        measured = self.measurements.fuse(inputs.modules, self.estimator.q_wb, self.imus.frozen)
        estimate = self.estimator.step(inputs.time_ns, measured, self.body.thrusters.matrix @ mean_n)
        self._find_faults(inputs, measured, estimate, mean_n)
        return estimate

    def _find_faults(self, inputs: Inputs, measured: Measured, estimate: Estimate, mean_n: np.ndarray) -> None:
        """Thrusters that are dead or lie leave the allocation at once."""
        self.faults.step(inputs.modules, measured, estimate, self.lag.force_n, mean_n, self.supervisor.armed)
        if self.faults.changed:
            self.allocator.set_alive(self.faults.now.alive)

    def decide(self, inputs: Inputs, estimate: Estimate, requests: Sequence[Request]) -> list[DockRequest]:
        """Sound requests and fail-safes -> state and mode. Returns the docks and undocks that were granted."""
        mine = [r for r in requests if r.body == self.body.index or r.action in FOR_ALL]
        self.health.step(inputs, estimate, mine, self.faults.now)
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
        """What has come to its end by itself."""
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
        """Guide, control, allocate, limit: record of every signal, and the (n,) thruster commands."""
        health = self.health.now
        setpoint, ahead = self.guidance.step(time_ns, estimate, health)
        wrench = self.controller.step(setpoint, ahead, estimate)
        wrench = self.guidance.mix(wrench, time_ns, estimate, health)
        self.allocator.confine(self.limiter.room(self.supply.voltage_v))
        thrust = self._allocate(wrench, time_ns)
        armed, alive = self.supervisor.armed, self.faults.now.alive
        force, command = self.limiter.step(thrust.force_n, armed, self.supply.voltage_v, alive)
        self.lag.command(force)
        state, mode = self.supervisor.state, self.supervisor.mode
        record = BodyRecord(self.body.index, state, mode, estimate, setpoint, wrench, thrust, force, self._may_arm(time_ns))
        return record, command

    def _may_arm(self, time_ns: int) -> bool:
        """Whether ARM would be granted, asked ten times a second: it takes every check, and people look at it."""
        if time_ns - self._asked_ns >= ARMING_EVERY_NS:
            self._asked_ns, self._may = time_ns, self.supervisor.may_arm(self.health.now)
        return self._may and self.supervisor.state == State.DISARMED

    def magnets(self, wanted: Sequence[Sequence[int]], due: Collection[int]) -> dict[int, tuple[int, ...]]:
        """Relay states that are wanted -> those that may be. Returns what is to be sent, by module: what is due, and what changed.

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
        """Forces for the wrench, less what the thrusters left cannot make; or those of a motor test."""
        if self.supervisor.mode == Mode.MOTOR_DETECT:
            force = self.motor_test.step(time_ns)
            return Thrust(force, self.body.thrusters.matrix @ force, (1.0, 1.0))
        return self.allocator.step(self.faults.now.keep @ wrench if self.faults.now.lost_axes else wrench)

    def take_over(self, before: Sequence[BodyPipeline], time_ns: int) -> Estimate:
        """Goes on from the bodies that this one is made of, or was part of: motion, forces, health, arm state. Returns its estimate."""
        if len(before) == 1:
            motion = part_of(before[0].body, before[0].estimator.motion, self.body)
        else:
            motion = join([(chain.body, chain.estimator.motion) for chain in before], self.body)
        for chain in before:
            self._take_forces(chain)
        self.imus.take_over([chain.imus for chain in before])
        self.faults.take_over([chain.faults for chain in before])
        self.allocator.set_alive(self.faults.now.alive)
        self.health.take_over([chain.health for chain in before])
        self.supervisor.take_over([chain.supervisor for chain in before])
        estimate = self.estimator.restart(time_ns, motion)
        self.guidance.take_over(self.supervisor.mode, estimate, self.body.thrusters.matrix @ self.limiter.force_n)
        return estimate

    def _take_forces(self, other: BodyPipeline) -> None:
        """Thrusters keep the forces they have, so that no command jumps; magnets keep the time that they may still be on."""
        mine, theirs = self.body, other.body
        forces = [array.copy() for array in self.lag.forces]
        limited = self.limiter.force_n.copy()
        for i, j in in_both(mine.modules, theirs.modules):
            here, there = mine.thrusters.module == i, theirs.thrusters.module == j
            for array, source in zip(forces, other.lag.forces, strict=True):
                array[here] = source[there]
            limited[here] = other.limiter.force_n[there]
            self.limiter.magnets[i] = other.limiter.magnets[j]
            self.supply.voltage_v[i] = other.supply.voltage_v[j]
        self.lag.restart(*forces)
        self.limiter.ease(limited)


class Pipeline:
    """All bodies of one firmware process."""

    def __init__(self, bodies: list[Body], parameters: Parameters, period_ns: int) -> None:
        self.parameters = parameters
        self._period_ns = period_ns
        self._chains = [self.chain_of(body) for body in bodies]
        self._modules = 1 + max(module for body in bodies for module in body.modules)
        self.docking = DockingStage(parameters.docking, tag_table(bodies), self._modules)
        self._watch_joints()

    @property
    def bodies(self) -> list[Body]:
        """The bodies as they are docked now."""
        return [chain.body for chain in self._chains]

    def chain_of(self, body: Body) -> BodyPipeline:
        """The stages of a body that is not there yet: made beside the loop, swapped in by a join or part."""
        return BodyPipeline(body, self.parameters, self._period_ns)

    def step(self, inputs: Inputs) -> Outputs:
        """One tick."""
        outputs = Outputs(inputs.tick, inputs.time_ns, [IDLE] * self._modules, False, [], [])
        estimates = {chain.body.index: chain.measure(inputs) for chain in self._chains}
        self._dock(inputs, estimates, outputs)
        requests, refusals = sift(inputs.requests, {chain.body.index: chain.body for chain in self._chains})
        outputs.events += refusals
        self._retune(requests, outputs)
        for chain in self._chains:
            outputs.preparations += chain.decide(inputs, estimates[chain.body.index], requests)
            outputs.events += [event._replace(body=chain.body.index) for event in chain.supervisor.events]
            outputs.estop = outputs.estop or chain.supervisor.raises_estop
            if self.docking.under_way:
                self._leave_docks(chain, inputs.time_ns, outputs)
        wanted, due = self.docking.relays, self.docking.due(inputs.time_ns)
        for chain in self._chains:
            relays = chain.magnets(wanted, due)
            record, command = chain.control(inputs.time_ns, estimates[chain.body.index])
            outputs.records.append(record)
            _command(chain, command, relays, outputs)
        return outputs

    def _leave_docks(self, chain: BodyPipeline, time_ns: int, outputs: Outputs) -> None:
        """Docks and undocks go on in the mode DOCK alone: an armed body backs off from one, any other lets go at once."""
        index, supervisor = chain.body.index, chain.supervisor
        if supervisor.mode == Mode.DOCK:
            return
        if supervisor.armed and index in self.docking.busy:
            self.docking.abort(index, time_ns, "the mode was changed")
        outputs.events += [event._replace(body=index) for event in self.docking.leave(chain.body, supervisor.armed)]

    def _retune(self, requests: Sequence[Request], outputs: Outputs) -> None:
        """Parameters that were set since the last tick. What a ground station's registry let through still may be refused here."""
        wanted = dict.fromkeys(r.argument for r in requests if r.action == Action.SET_PARAMETER)
        if not wanted:
            return
        for name, value in wanted:
            try:
                self.parameters = self.parameters.replace(name, value)
            except DescriptionError as error:
                outputs.events.append(Event(WARNING, str(error)))
        for chain in self._chains:
            chain.retune(self.parameters)
        self.docking.retune(self.parameters.docking)

    def _dock(self, inputs: Inputs, estimates: dict[int, Estimate], outputs: Outputs) -> None:
        """Docks of the whole fleet: steers those under way, joins and parts bodies within this tick."""
        held = [c for c in self._chains if c.supervisor.armed and c.supervisor.mode == Mode.POSHOLD] if inputs.prepared else []
        bodies = {c.body.index: (c.body, estimates[c.body.index]) for c in self._chains}
        decisions = self.docking.step(inputs, bodies, [c.body.index for c in held])
        self._miss_partners(outputs)
        outputs.docks += self.docking.records
        outputs.joints = self.docking.joints
        self._steer(decisions)
        for joined in decisions.joins:
            self._join(joined, inputs.time_ns, estimates)
        for parted in decisions.parts:
            self._part(parted, inputs.time_ns, estimates)
        outputs.events += self.docking.events

    def _miss_partners(self, outputs: Outputs) -> None:
        """Joints that are open though nobody asked: tells the bodies, and parts those that have come apart once their fail-safe is on."""
        loose = self.docking.open_joints(LOOSE)
        apart = self.docking.open_joints(APART) if loose else []
        for chain in self._chains:
            if not chain.joints:
                continue
            chain.health.topology = _words_of([joint for joint in loose if joint.module in chain.body.modules])
            gone = [joint for joint in apart if joint.module in chain.body.modules]
            if gone and gone != chain.parting and chain.supervisor.armed and chain.supervisor.is_on("partner_lost"):
                chain.parting = gone
                outputs.preparations.append(PartRequest(tuple(gone)))

    def _steer(self, decisions: Decisions) -> None:
        for chain in self._chains:
            number = chain.body.index
            if number in decisions.meets:
                chain.guidance.move_by(decisions.meets[number])
            if number in decisions.setpoints:
                chain.guidance.dock(decisions.setpoints[number])
            elif number in decisions.ended:
                chain.dock_over = True

    def _join(self, joined: Join, time_ns: int, estimates: dict[int, Estimate]) -> None:
        before = self._chains_of(joined.target, joined.active)
        estimate = self._begin(joined.chain, before, time_ns)
        self._swap(before, [joined.chain], estimates, [estimate])

    def _part(self, parted: Part, time_ns: int, estimates: dict[int, Estimate]) -> None:
        after = [parted.stays, parted.leaves]
        before = self._chains_of(parted.whole)
        found = [self._begin(chain, before, time_ns) for chain in after]
        parted.leaves.guidance.move_by(parted.away_w)
        self._swap(before, after, estimates, found)

    def _begin(self, chain: BodyPipeline, before: Sequence[BodyPipeline], time_ns: int) -> Estimate:
        """A body that was prepared takes over, with the parameters of now. Returns its estimate."""
        if chain.parameters is not self.parameters:
            chain.retune(self.parameters)
        return chain.take_over(before, time_ns)

    def _chains_of(self, *bodies: int) -> list[BodyPipeline]:
        """Of these bodies, by their numbers, in this order. No body joins or parts twice in a tick."""
        return [chain for number in bodies for chain in self._chains if chain.body.index == number]

    def _swap(
        self, before: Sequence[BodyPipeline], after: Sequence[BodyPipeline], estimates: dict[int, Estimate], found: Sequence[Estimate]
    ) -> None:
        for chain in before:
            del estimates[chain.body.index]
        for chain, estimate in zip(after, found, strict=True):
            estimates[chain.body.index] = estimate
        kept = [chain for chain in self._chains if chain not in before]
        self._chains = sorted([*kept, *after], key=lambda chain: chain.body.index)
        ended = self.docking.forget([chain.body.index for chain in before])
        for chain in kept:
            chain.dock_over = chain.dock_over or chain.body.index in ended
        self._watch_joints()

    def _watch_joints(self) -> None:
        self.docking.watch_joints([joint for chain in self._chains for joint in chain.joints])


def _words_of(open_joints: Sequence[DockRequest]) -> str:
    """The first of them, for people; empty: none is."""
    if not open_joints:
        return ""
    first, more = open_joints[0], len(open_joints) - 1
    others = f", and {more} more pairs" if more else ""
    return f"modules {first.target_module} and {first.module} do not hold together{others}"


IDLE = ModuleCommand(False, np.zeros(CHANNELS), None)
"""What a module is told that belongs to no body."""


def _command(chain: BodyPipeline, command: np.ndarray, relays: Mapping[int, tuple[int, ...]], outputs: Outputs) -> None:
    """Hands each module its own thrusters and, where there are any to be sent, its relays."""
    armed, channels = chain.supervisor.armed, np.zeros((len(chain.body.modules), CHANNELS))
    channels.reshape(-1)[chain.slots] = command
    for module, thrusters in zip(chain.body.modules, channels, strict=True):
        outputs.modules[module] = ModuleCommand(armed, thrusters, relays.get(module))
