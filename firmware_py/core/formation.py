"""The set of bodies: steers those that dock, joins and parts them within a tick, and hands over state so that no signal jumps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from firmware_py.core.body import Body
from firmware_py.core.collision import times_to_brake
from firmware_py.core.docking import DockingStage
from firmware_py.core.docking_decisions import Decisions, Join, Part
from firmware_py.core.docking_pairs import APART, LOOSE
from firmware_py.core.joints import modules_of
from firmware_py.core.topology import attitude_of, in_both, join, part_of
from firmware_py.core.types import WARNING, DockRequest, Estimate, Event, Inputs, Mode, Outputs, PartRequest
from firmware_py.description.parameters import Parameters

if TYPE_CHECKING:
    from firmware_py.core.pipeline import BodyPipeline

BROKEN_NS = 5_000_000_000
"""How long a DISARM of a body that came apart by itself stops all its pieces: a person who sees it break means the whole, and takes a few
seconds (synthetic) to see it and to act."""
PARTED_NS = 3_000_000_000
"""How long the two pieces of an undock are no obstacles to each other: pushed off by the magnets, one swings back towards the other 0.4 s
later, at 0.07 m/s (measured in dock-undock-dock), before they glide to their places."""


class Formation:
    """The bodies of a fleet as they are docked now, each with its stages."""

    def __init__(self, pipelines: list[BodyPipeline], docking: DockingStage, parameters: Parameters) -> None:
        self.pipelines, self.docking = pipelines, docking
        self.parameters = parameters
        """The present parameters; bodies still in preparation get them when they begin."""
        self._broken: list[tuple[int, Body]] = []
        """Bodies that came apart by themselves, and when; those older than BROKEN_NS are forgotten at the next one."""
        self._parted: list[tuple[int, tuple[int, int]]] = []
        """Numbers of the two pieces of bodies that parted in the last PARTED_NS, and when."""
        self._watch_joints()

    @property
    def bodies(self) -> list[Body]:
        """The bodies, ordered by number."""
        return [pipeline.body for pipeline in self.pipelines]

    def bodies_known(self, time_ns: int) -> list[Body]:
        """The bodies, and those that came apart by themselves so recently that a person may still mean the whole."""
        return [*self.bodies, *(body for _, body in self._broken_lately(time_ns))]

    def _broken_lately(self, time_ns: int) -> list[tuple[int, Body]]:
        return [broken for broken in self._broken if time_ns - broken[0] <= BROKEN_NS]

    def retune(self, parameters: Parameters) -> None:
        """Changes the parameters from this tick on."""
        self.parameters = parameters
        for pipeline in self.pipelines:
            pipeline.retune(parameters)
        self.docking.retune(parameters.docking)

    def step(self, inputs: Inputs, estimates: dict[int, Estimate], outputs: Outputs) -> None:
        """Runs the docks of the whole fleet: steers those under way, joins and parts bodies within this tick."""
        if not (inputs.prepared or self.docking.has_work):
            outputs.joints = self.docking.joints
            return
        bodies = {each.body.index: (each.body, estimates[each.body.index]) for each in self.pipelines}
        waiting, holding = (self._armed_in(mode) if inputs.prepared else [] for mode in (Mode.DOCK, Mode.POSHOLD))
        coming = [each.body.index for each in self.pipelines if each.guidance.is_coming] if self.docking.under_way else []
        decisions = self.docking.step(inputs, bodies, waiting, holding, coming, self._resting())
        self._miss_partners(outputs, [parted.whole for parted in decisions.parts])
        outputs.docks += self.docking.records
        outputs.joints = self.docking.joints
        self._steer(decisions)
        for joined in decisions.joins:
            self._join(joined, inputs.time_ns, estimates)
        for parted in decisions.parts:
            self._part(parted, inputs.time_ns, estimates)
        outputs.events += self.docking.events

    def watch_distances(self, time_ns: int, estimates: dict[int, Estimate]) -> None:
        """Tells each body's health when it must brake before another. Two that dock or have just parted are no obstacles to each other."""
        self._parted = [parted for parted in self._parted if time_ns - parted[0] <= PARTED_NS]
        wanted = {pipeline.body.index: pipeline.guidance.wanted for pipeline in self.pipelines}
        deceleration = {pipeline.body.index: pipeline.faults.now.deceleration for pipeline in self.pipelines}
        pairs = [*self.docking.pairs, *(pieces for _, pieces in self._parted)]
        times_s = times_to_brake(self.bodies, estimates, wanted, deceleration, self.parameters.steering.bandwidth, pairs)
        for pipeline in self.pipelines:
            pipeline.health.collision_s = times_s[pipeline.body.index]
            pipeline.guidance.deceleration = deceleration[pipeline.body.index]

    def preparations_for(self, pipeline: BodyPipeline, granted: Sequence[DockRequest]) -> list[DockRequest | PartRequest]:
        """Preparations needed for the docks and undocks of a body that were granted in this tick."""
        if not pipeline.supervisor.armed:
            return [self._parting(pipeline, request) for request in granted]
        self.docking.expect(pipeline.body.index, granted)
        return [*granted]

    def _parting(self, pipeline: BodyPipeline, request: DockRequest) -> DockRequest | PartRequest:
        """The undock of a disarmed body, which no magnet pushes open: it parts where it has come apart, whichever side was named."""
        apart = [joint for joint in self.docking.open_joints(APART) if joint.module in pipeline.body.modules]
        named = [joint for joint in apart if modules_of(joint) == modules_of(request)]
        return PartRequest((*named, *(joint for joint in apart if joint not in named))) if named else request

    def leave(self, pipeline: BodyPipeline, outputs: Outputs) -> None:
        """Ends docks and undocks of a body at once when its mode is not DOCK."""
        supervisor = pipeline.supervisor
        if supervisor.mode != Mode.DOCK:
            surfaces = supervisor.armed and supervisor.mode == Mode.SURFACE
            self._steer(self.docking.leave(pipeline.body, surfaces))
            outputs.events += [event._replace(body=pipeline.body.index) for event in self.docking.events]

    def _miss_partners(self, outputs: Outputs, parted: Sequence[int]) -> None:
        """Reports joints that are open without a request to their bodies, and asks for the parting of bodies that have come apart once
        their `partner_lost` fail-safe is on. Bodies `parted` in this tick are left out.
        """
        loose = self.docking.open_joints(LOOSE)
        apart = self.docking.open_joints(APART) if loose else []
        for pipeline in self.pipelines:
            if not pipeline.joints or pipeline.body.index in parted:
                continue
            mine = [joint for joint in loose if joint.module in pipeline.body.modules]
            pipeline.health.open_joints = tuple(mine)
            gone = [joint for joint in apart if joint.module in pipeline.body.modules]
            pipeline.parting = pipeline.parting if gone else []  # a joint that closes briefly may drop its plan: ask again when it opens
            if gone and gone != pipeline.parting and pipeline.supervisor.armed and pipeline.supervisor.is_on("partner_lost"):
                pipeline.parting = gone
                outputs.preparations.append(PartRequest(tuple(gone)))

    def _armed_in(self, mode: Mode) -> list[int]:
        """Numbers of the bodies that are armed and in `mode`."""
        return [pipeline.body.index for pipeline in self.pipelines if pipeline.supervisor.armed and pipeline.supervisor.mode == mode]

    def _resting(self) -> list[tuple[int, int]]:
        """Modules and faces whose magnets have used up their on-time."""
        return [
            (module, face)
            for pipeline in self.pipelines
            if pipeline.joints
            for module, magnets in zip(pipeline.body.modules, pipeline.limiter.magnets, strict=True)
            for face in magnets.resting
        ]

    def _steer(self, decisions: Decisions) -> None:
        """Tells the guidance of each body what the docking stage wants of it."""
        for pipeline in self.pipelines:
            number = pipeline.body.index
            if number in decisions.returning:
                pipeline.guidance.go_back()
            if number in decisions.meets:
                pipeline.guidance.meet(decisions.meets[number])
            if number in decisions.setpoints:
                pipeline.guidance.dock(decisions.setpoints[number])
            elif number in decisions.ended:
                pipeline.dock_over = True

    def _join(self, joined: Join, time_ns: int, estimates: dict[int, Estimate]) -> None:
        before = self._pipelines_of(joined.target, joined.active)
        estimate = self._begin(joined.pipeline, before, time_ns)
        if any(pipeline.supervisor.armed for pipeline in before) and not joined.pipeline.supervisor.armed:
            self.docking.events.append(Event(WARNING, "docked to a body that is not armed: all of it is disarmed"))
        self._swap(before, [joined.pipeline], estimates, [estimate])

    def _part(self, parted: Part, time_ns: int, estimates: dict[int, Estimate]) -> None:
        after = [parted.stays, parted.leaves]
        before = self._pipelines_of(parted.whole)
        self._broken = self._broken_lately(time_ns) + [(time_ns, whole.body) for whole in before if whole.parting]
        self._parted.append((time_ns, (parted.stays.body.index, parted.leaves.body.index)))
        found = [self._begin(pipeline, before, time_ns) for pipeline in after]
        parted.leaves.guidance.move_by(parted.away_w)
        self._swap(before, after, estimates, found)

    def _begin(self, pipeline: BodyPipeline, before: Sequence[BodyPipeline], time_ns: int) -> Estimate:
        """Lets a prepared body take over, with the present parameters. Returns its estimate."""
        if pipeline.parameters is not self.parameters:
            pipeline.retune(self.parameters)
        return take_over(pipeline, before, time_ns)

    def _pipelines_of(self, *bodies: int) -> list[BodyPipeline]:
        """Pipelines of the bodies with these numbers, in this order. No body joins or parts twice in a tick."""
        return [pipeline for number in bodies for pipeline in self.pipelines if pipeline.body.index == number]

    def _swap(
        self, before: Sequence[BodyPipeline], after: Sequence[BodyPipeline], estimates: dict[int, Estimate], found: Sequence[Estimate]
    ) -> None:
        """Replaces the bodies `before` by those `after`, whose estimates are `found`; docks with a body that is gone end."""
        for pipeline in before:
            del estimates[pipeline.body.index]
        for pipeline, estimate in zip(after, found, strict=True):
            estimates[pipeline.body.index] = estimate
        kept = [pipeline for pipeline in self.pipelines if pipeline not in before]
        self.pipelines = sorted([*kept, *after], key=lambda pipeline: pipeline.body.index)
        self._steer(self.docking.forget([pipeline.body.index for pipeline in before]))
        self._watch_joints()

    def _watch_joints(self) -> None:
        self.docking.watch_joints([joint for pipeline in self.pipelines for joint in pipeline.joints])


def take_over(pipeline: BodyPipeline, before: Sequence[BodyPipeline], time_ns: int) -> Estimate:
    """Hands motion, forces, health and arm state of the previous bodies (its parts, or the whole) to `pipeline`. Returns its estimate."""
    if len(before) == 1:
        motion = part_of(before[0].body, before[0].estimator.motion, pipeline.body)
    else:
        motion = join([(other.body, other.estimator.motion) for other in before], pipeline.body)
    for other in before:
        _take_forces(pipeline, other)
    pipeline.sensors.take_over([other.sensors for other in before])
    pipeline.depth_gate.take_over([other.depth_gate for other in before])
    pipeline.faults.take_over([other.faults for other in before])
    pipeline.allocator.set_alive(pipeline.faults.now.alive)
    pipeline.health.take_over([other.health for other in before])
    pipeline.supervisor.take_over([other.supervisor for other in before])
    estimate = pipeline.estimator.restart(time_ns, motion)
    namesake = next((other.guidance for other in before if other.body.index == pipeline.body.index), None)
    q_wb = attitude_of(pipeline.body, before[0].body, before[0].guidance.held_q_wb)
    wrench = pipeline.body.thrusters.matrix @ pipeline.limiter.force_n
    pipeline.guidance.take_over(pipeline.supervisor.mode, estimate, wrench, q_wb, namesake)
    return estimate


def _take_forces(pipeline: BodyPipeline, other: BodyPipeline) -> None:
    """Hands over thruster forces, so that no command jumps, the remaining on-time of magnets, and supply voltages."""
    mine, theirs = pipeline.body, other.body
    forces = [array.copy() for array in pipeline.lag.forces]
    limited = pipeline.limiter.force_n.copy()
    for i, j in in_both(mine.modules, theirs.modules):
        here, there = mine.thrusters.module == i, theirs.thrusters.module == j
        for array, source in zip(forces, other.lag.forces, strict=True):
            array[here] = source[there]
        limited[here] = other.limiter.force_n[there]
        pipeline.limiter.magnets[i] = other.limiter.magnets[j]
        pipeline.supply.voltage_v[i] = other.supply.voltage_v[j]
    pipeline.lag.restart(*forces)
    pipeline.limiter.continue_from(limited)
