"""Stage 3 of a tick: all docks of the fleet. Detects docked faces, steers docking bodies, and decides when bodies join or part.

Works on the estimates of this tick; the pipeline carries out the returned joins and parts within the same tick.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.docking_decisions import Decisions, Estimated, Join, Prepared, body_of, fits
from firmware_py.core.docking_detector import FacePair, ModulePoses, PairDetector, TagTable
from firmware_py.core.docking_pairs import APART
from firmware_py.core.docking_plan import DockPlan, UndockPlan
from firmware_py.core.docking_sequence import ENDED, DockingSequence, Stage
from firmware_py.core.docking_traffic import Dock, Traffic, thirds_of
from firmware_py.core.docking_way import obstacle, plans_conflict
from firmware_py.core.joint_watch import JointWatch
from firmware_py.core.joints import Joint, modules_of
from firmware_py.core.magnet_relays import MagnetRelays
from firmware_py.core.names import name_module, name_pair
from firmware_py.core.setpoint import REST, Wish
from firmware_py.core.types import (
    INFORMATION,
    RELAY_OFF,
    RELAY_PULL,
    RELAY_PUSH,
    WARNING,
    DockRecord,
    DockRequest,
    Event,
    Inputs,
)
from firmware_py.core.undocking import Undock
from firmware_py.description.parameters import Docking

CHANGED = "the bodies are others than those that it was planned for"
NO_LONGER = "its body is no longer in DOCK"
HOLDS = "its body is not in DOCK, and {} may still hold each other"
ANOTHER = "another was asked for"
SURFACES = "the body that it was to go to surfaces"
LED = "the body that it is to go to is on its way to it: end that dock first"
TAKEN = "another dock is to bring a module to the same place: end that dock first"


class DockingStage:
    """All docks and joints of the fleet."""

    def __init__(self, parameters: Docking, tags: TagTable, modules: int) -> None:
        self._p = parameters
        self._poses = ModulePoses(tags, modules)
        self.relays = MagnetRelays(modules)
        self._docks: list[Dock] = []
        self._undocks: list[Undock] = []
        self._expected: dict[int, DockRequest] = {}
        """By body: its newest dock or undock that waits for its plan."""
        self._joints = JointWatch(parameters)
        self._closed: list[frozenset[int]] = []
        """Modules of each joint that a dock closes in this tick."""
        self.events: list[Event] = []
        self.records: list[DockRecord] = []

    def retune(self, parameters: Docking) -> None:
        """Changes the parameters of joints, and of docks that begin from now on."""
        self._p = parameters
        self._joints.retune(parameters)

    def watch_joints(self, joints: Sequence[Joint]) -> None:
        """Watches `joints`, all joints of the fleet, and lets their magnets pull, except for joints that are being undocked."""
        self._joints.watch(joints, self._closed)
        parting = self._parting
        self.relays.switch(RELAY_PULL, *(joint.request for joint in joints if modules_of(joint.request) not in parting))

    def open_joints(self, least: int) -> list[DockRequest]:
        """Joints that should hold but are at least `least` (LOOSE or APART), as requests that name their faces. Joints that are being
        undocked are left out.
        """
        parting = self._parting
        return [joint for joint in self._joints.open_joints(least) if modules_of(joint) not in parting]

    @property
    def _parting(self) -> list[frozenset[int]]:
        """Modules of each joint that is being undocked."""
        return [modules_of(joint) for undock in self._undocks for joint in undock.plan.opens]

    @property
    def joints(self) -> np.ndarray:
        """(k,) of PAIR: state of every joint in this tick; a copy."""
        return self._joints.rows

    @property
    def has_work(self) -> bool:
        """Whether there is a joint to watch, or a dock or undock to steer."""
        return self.under_way or len(self._joints) > 0

    @property
    def under_way(self) -> bool:
        """Whether any dock or undock is under way."""
        return bool(self._docks or self._undocks)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Numbers of the active body and the target of each dock under way."""
        return [(dock.active, dock.target) for dock in self._docks]

    def forget(self, bodies: Collection[int]) -> Decisions:
        """Ends every dock in which one of `bodies`, which no longer exist, takes part; a target that was coming goes back."""
        self._expected = {body: request for body, request in self._expected.items() if body not in bodies}
        decisions = Decisions()
        for dock in [each for each in self._docks if each.active in bodies or each.target in bodies]:
            self._give_up(dock, CHANGED, decisions)
            self._end(dock.active, decisions)
        return decisions

    def expect(self, body: int, requests: Sequence[DockRequest]) -> None:
        """Notes that plans for `requests` of `body` were asked for, in this order."""
        self._expected.update((body, request) for request in requests)

    def leave(self, body: Body, surfaces: bool) -> Decisions:
        """Ends the docks and undocks of a body that is not in the mode DOCK at once, because they no longer steer it. If it `surfaces`,
        docks to it end as well, else their active bodies would follow it up. A target that was coming goes back to where it held.

        An open joint is parted in any mode, in the tick in which its plan arrives: its modules are apart already.
        """
        self.events, decisions = [], Decisions()
        mine = [undock for undock in self._undocks if undock.plan.opens[0].module in body.modules]
        for undock in [each for each in mine if self._joints.existing(each.plan.opens)]:
            self._call_off(undock)
            self._say(WARNING, f"undock of {name_module(undock.plan.opens[0].module)} ended: {NO_LONGER}")
        for dock in [each for each in self._docks if each.active == body.index]:
            self._give_up(dock, NO_LONGER, decisions)
        for dock in [each for each in self._docks if surfaces and each.target == body.index]:
            self._give_up(dock, SURFACES, decisions)
            self._end(dock.active, decisions)
        return decisions

    def step(
        self,
        inputs: Inputs,
        estimates: Estimated,
        waiting: Collection[int],
        holding: Collection[int],
        coming: Collection[int],
        resting: Collection[tuple[int, int]],
    ) -> Decisions:
        """Runs one tick.

        Args:
            waiting: bodies in the mode DOCK: only these begin a dock. Used only when a plan has arrived, as `holding` is.
            holding: bodies that hold a place which may be moved: only these come to meet another.
            coming: bodies that are on their way to meet another.
            resting: modules and faces whose magnets are forced off.
        """
        self.events, self.records, self._closed = [], [], []
        decisions = Decisions()
        self._poses.take(inputs.modules)
        for prepared in inputs.prepared:
            self._begin(prepared, inputs.time_ns, estimates, waiting, holding, decisions)
        self._joints.step(inputs.time_ns, inputs.modules, self._poses, resting)
        traffic = Traffic(self._docks, estimates, coming, self._p)
        for dock in list(self._docks):
            self._steer(dock, inputs, estimates, traffic, decisions)
        for undock in list(self._undocks):
            self._release(undock, inputs.time_ns, estimates, decisions)
        return decisions

    # ------------------------------------------------------------ beginnings

    def _begin(
        self,
        prepared: Prepared,
        time_ns: int,
        estimates: Estimated,
        waiting: Collection[int],
        holding: Collection[int],
        decisions: Decisions,
    ) -> None:
        request, plan = prepared.request, prepared.plan
        mine = body_of(request.module, estimates)
        if self._expected.get(mine) == request:
            del self._expected[mine]
        under_way = next((dock for dock in self._docks if dock.active == mine), None)
        if under_way is not None and under_way.prepared.request == request and under_way.sequence.stage not in ENDED:
            return
        refusal = self._refusal(prepared, estimates, waiting, holding)
        if plan is None or refusal:
            what = "undock" if mine == body_of(request.target_module, estimates) else "dock"
            self._say(WARNING, f"{what} refused: {refusal}")
            if under_way is None:
                self._end(mine, decisions)
        elif isinstance(plan, UndockPlan):
            self._begin_undock(plan, prepared.pipelines, time_ns)
        else:
            if under_way is not None:
                self._give_up(under_way, ANOTHER, decisions)
            self._begin_dock(prepared, plan, time_ns, estimates, holding)

    def _refusal(self, prepared: Prepared, estimates: Estimated, waiting: Collection[int], holding: Collection[int]) -> str:
        """Reason why a plan is not begun; empty if it is."""
        plan = prepared.plan
        if plan is None:
            return prepared.refusal
        if not fits(plan, estimates):
            return CHANGED
        if isinstance(plan, UndockPlan):
            whole = body_of(plan.opens[0].module, estimates)
            holds = next(iter(self._still_closed(plan)), None)
            newest = self._expected.get(whole)
            if holds is not None and newest is not None and newest.target_module not in estimates[whole][0].modules:
                return ANOTHER  # a dock, since then
            return "" if holds is None or whole in waiting else HOLDS.format(name_pair(*sorted(modules_of(holds))))
        mine, others = (body_of(module, estimates) for module in (plan.request.module, plan.request.target_module))
        if mine not in waiting:
            return NO_LONGER
        if mine in self._expected:
            return ANOTHER
        if mine in self._leaders(others):
            return LED
        if any(plans_conflict(plan, dock.sequence.plan) for dock in self._docks if dock.active != mine):
            return TAKEN
        target_approaches = self._target_approaches(plan, others, holding)
        return obstacle(plan, estimates[mine], estimates[others], thirds_of(estimates, mine, others), target_approaches, self._p)

    def _target_approaches(self, plan: DockPlan, target: int, holding: Collection[int]) -> bool:
        """Whether the target is to come half the way."""
        taken = any(target in (dock.active, dock.target) for dock in self._docks)
        return (plan.request.both_approach or self._p.approach == "straight") and target in holding and not taken

    def _leaders(self, body: int) -> list[int]:
        """The bodies that steer `body`: the target of its dock, the target of that body's dock, and so on. No body leads itself."""
        targets, found = {dock.active: dock.target for dock in self._docks}, list[int]()
        while body in targets:
            body = targets[body]
            found.append(body)
        return found

    def _drop(self, dock: Dock) -> None:
        """Removes a dock from those under way and switches its magnets off."""
        self._docks.remove(dock)
        self.relays.switch(RELAY_OFF, *dock.sequence.plan.closes)

    def _give_up(self, dock: Dock, reason: str, decisions: Decisions) -> None:
        """Ends a dock early; a target that was coming goes back to where it held."""
        self._drop(dock)
        self._say(WARNING, f"dock of {name_module(dock.prepared.request.module)} ended: {reason}")
        if dock.sequence.meets_at_w is not None:
            decisions.returning.append(dock.target)

    def _begin_undock(self, plan: UndockPlan, pipelines: tuple[Any, ...], time_ns: int) -> None:
        opens = set(map(modules_of, plan.opens))
        if any(set(map(modules_of, undock.plan.opens)) == opens for undock in self._undocks):
            return
        self._undocks.append(Undock.begun(plan, pipelines, time_ns, bool(self._still_closed(plan)), self._p, self._joints))
        self._say(INFORMATION, f"undocking {name_module(plan.opens[0].module)} from {name_module(plan.opens[0].target_module)}")

    def _still_closed(self, plan: UndockPlan) -> list[DockRequest]:
        """Joints that magnets have to push open: those not known to be APART."""
        apart = [modules_of(joint) for joint in self.open_joints(APART)]
        return [joint for joint in plan.opens if modules_of(joint) not in apart]

    def _begin_dock(
        self,
        prepared: Prepared,
        plan: DockPlan,
        time_ns: int,
        estimates: Estimated,
        holding: Collection[int],
    ) -> None:
        request = prepared.request
        active, target = body_of(request.module, estimates), body_of(request.target_module, estimates)
        target_approaches = self._target_approaches(plan, target, holding)
        sequence = DockingSequence(plan, estimates[active][0], estimates[target][0], self._p, time_ns, target_approaches)
        pair = FacePair(request.target_module, request.target_face, request.module, request.face, plan.place_t, plan.q_ta)
        at = estimates[active][1]
        start_pose = REST._replace(p_wb=at.p_wb.copy(), q_wb=at.q_wb.copy())
        self._docks.append(Dock(sequence, PairDetector(pair, self._p), active, target, prepared, start_pose, set()))
        self._say(INFORMATION, f"docking {name_module(request.module)} to {name_module(request.target_module)}")

    # ------------------------------------------------------------ each tick

    def _steer(self, dock: Dock, inputs: Inputs, estimates: Estimated, traffic: Traffic, decisions: Decisions) -> None:
        if blocked := traffic.blocked(dock):
            self._give_up(dock, blocked, decisions)
            self._end(dock.active, decisions)
            return
        active, target = estimates[dock.active][1], estimates[dock.target][1]
        status = dock.detector.step(inputs.time_ns, inputs.modules, self._poses)
        before = dock.sequence.stage
        steering = dock.sequence.step(inputs.time_ns, active, target, status, self._wish(dock, traffic))
        stage = dock.sequence.stage
        self.relays.switch(steering.relay, *dock.sequence.plan.closes)
        errors, pair = dock.sequence.errors(active, target), dock.detector.pair
        self.records.append(
            DockRecord(
                pair.module_a, pair.face_a, pair.module_b, pair.face_b, int(stage), dock.sequence.tries, dock.detector.currents_ma,
                status.current, status.position, errors.gap_m, errors.lateral_m, status.position_error_m,
            )
        )  # fmt: skip
        if stage != before:
            reason = f": {dock.sequence.reason}" if dock.sequence.reason and stage > Stage.DOCKED else ""
            self._say(WARNING if stage > Stage.DOCKED else INFORMATION, f"dock {before.name} -> {stage.name}{reason}")
            if stage in (Stage.ABORTED, Stage.FAILED) and traffic.is_coming(dock):
                decisions.returning.append(dock.target)  # nobody watches its way any more
        if stage == Stage.DOCKED:
            self._join(dock, decisions)
        elif stage in (Stage.ABORTED, Stage.FAILED) and steering.is_apart:
            self._docks.remove(dock)
            self._end(dock.active, decisions)
        else:
            decisions.setpoints[dock.active] = steering.active
        if steering.meets is not None:
            decisions.meets[dock.target] = steering.meets

    def _wish(self, dock: Dock, traffic: Traffic) -> Wish | None:
        """What the active body glides by while a third body blocks its way, or None; each reason to wait is reported once per dock."""
        wait = traffic.wait(dock)
        if wait is None:
            return None
        if wait.words not in dock.reported:
            dock.reported.add(wait.words)
            self._say(WARNING, f"dock of {name_module(dock.prepared.request.module)} {wait.words}")
        return wait.wish

    def _end(self, active: int, decisions: Decisions) -> None:
        """Ends docking for the body, unless it still waits for a plan or takes part in an undock under way."""
        parting = {module for undock in self._undocks for module in (*undock.plan.stays.modules, *undock.plan.leaves.modules)}
        if active not in self._expected and active not in parting:
            decisions.ended.append(active)

    def _join(self, dock: Dock, decisions: Decisions) -> None:
        """Joins two bodies, at most once per tick and body: a second dock finds its bodies gone, and `forget` ends it."""
        if decisions.joining.isdisjoint((dock.active, dock.target)):
            decisions.joins.append(Join(dock.target, dock.active, dock.prepared.pipelines[0]))
            self._docks.remove(dock)
            self._closed += map(modules_of, dock.sequence.plan.closes)

    def _release(self, undock: Undock, time_ns: int, estimates: Estimated, decisions: Decisions) -> None:
        plan, request = undock.plan, undock.plan.opens[0]
        if not fits(plan, estimates):
            self._call_off(undock)
            self._say(WARNING, f"undock ended: {CHANGED}")
            return
        self.relays.switch(RELAY_PUSH, *plan.opens)
        whole = body_of(request.module, estimates)
        changes = whole in decisions.joining or whole in [part.whole for part in decisions.parts]
        if changes or undock.pushes(time_ns, self._joints):  # if it changes, the body is gone in the next tick, which ends this undock
            return
        held_by = undock.held_by(time_ns, self._joints)
        if held_by and time_ns < undock.last_ns:
            return
        if held_by:
            self._call_off(undock)
            self._say(WARNING, f"undock of {name_module(request.module)} ended: {held_by}")
            self._end(whole, decisions)
            return
        self.relays.switch(RELAY_OFF, *plan.opens)
        decisions.parts.append(undock.part(whole, estimates, self._p))
        self._undocks.remove(undock)
        self._say(INFORMATION, f"{name_module(request.module)} is undocked from {name_module(request.target_module)}")

    def _call_off(self, undock: Undock) -> None:
        """Ends an undock early: magnets pull again where the joint still exists, and go off where another undock has removed it."""
        self._undocks.remove(undock)
        left = self._joints.existing(undock.plan.opens)
        self.relays.switch(RELAY_OFF, *(joint for joint in undock.plan.opens if joint not in left))
        self.relays.switch(RELAY_PULL, *left)

    def _say(self, severity: int, text: str) -> None:
        self.events.append(Event(severity, text))
