"""Stage 3 of a tick: all docks of the fleet. Detects, steers what is docking, and says when bodies join or part.

Works on the estimates of this tick; the pipeline carries out the joins and parts that it returns, within the same tick.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.docking_decisions import Decisions, Estimated, Join, Part, Prepared
from firmware_py.core.docking_detector import FacePair, ModulePoses, PairBank, PairDetector, TagTable
from firmware_py.core.docking_pairs import APART
from firmware_py.core.docking_sequence import (
    ENDED,
    DockingSequence,
    DockPlan,
    Stage,
    UndockPlan,
)
from firmware_py.core.docking_way import BEGINNING, WAY_SLACK, Way, nearest_pass, way_of_active, way_of_target
from firmware_py.core.joints import Joint, modules_of
from firmware_py.core.magnet_relays import MagnetRelays
from firmware_py.core.rotations import conjugate, multiply, rotate, rotate_back, to_matrix
from firmware_py.core.setpoint import Wish
from firmware_py.core.types import (
    INFORMATION,
    NEVER_NS,
    RELAY_OFF,
    RELAY_PULL,
    RELAY_PUSH,
    WARNING,
    DockRecord,
    DockRequest,
    Event,
    Inputs,
)
from firmware_py.description.parameters import Docking

CHANGED = "the bodies are others than those that it was planned for"
IN_PLACE = "pictures show that it is still in its place"
PULLED = "its magnets go on pulling"
NO_LONGER = "its body is no longer in DOCK"
ANOTHER = "another was asked for"
SURFACES = "the body that it was to go to surfaces"
LED = "the body that it is to go to is on its way to it: end that dock first"
TAKEN = "another dock is to bring a module to the same place: end that dock first"
REST = Wish(np.zeros(3), np.zeros(3))
"""What a body that waits glides by."""


class _Dock(NamedTuple):
    """A dock under way."""

    sequence: DockingSequence
    detector: PairDetector
    active: int
    target: int
    prepared: Prepared


class _Undock(NamedTuple):
    """An undock under way: magnets push until the body parts, which is at once where every joint is open already."""

    plan: UndockPlan
    chains: tuple[Any, ...]
    since_ns: int
    until_ns: int
    seen_ns: int
    """By then pictures of the latter half of the push are there, if any still come."""
    pulled: Mapping[frozenset[int], np.ndarray]
    """By the modules of a joint: its currents (2,) before the push, mA."""

    @property
    def last_ns(self) -> int:
        """While pictures show it in its place the magnets push on, as long again: a short push shows late."""
        return max(2 * self.until_ns - self.since_ns, self.seen_ns)


class DockingStage:
    """All docks and joints of the fleet."""

    def __init__(self, parameters: Docking, tags: TagTable, modules: int) -> None:
        self._p = parameters
        self._tags = tags
        self.relays = MagnetRelays(modules)
        self._docks: list[_Dock] = []
        self._undocks: list[_Undock] = []
        self._expected: dict[int, DockRequest] = {}
        """By body: the newest dock or undock that waits for its plan."""
        self._joints = PairBank([], parameters)
        self._watched: Sequence[Joint] = ()
        self.events: list[Event] = []
        self.records: list[DockRecord] = []

    def retune(self, parameters: Docking) -> None:
        """Takes other parameters for joints, and for docks that begin from now on."""
        self._p = parameters
        self._joints = PairBank([joint.pair for joint in self._watched], parameters, self._joints)

    def watch_joints(self, joints: Sequence[Joint]) -> None:
        """Watches these joints, all that there are in the fleet; their magnets hold."""
        self._watched = joints
        self._joints = PairBank([joint.pair for joint in joints], self._p, self._joints)
        for joint in joints:
            self.relays.switch(RELAY_PULL, joint.request)

    def open_joints(self, least: int) -> list[DockRequest]:
        """Joints that are `least` LOOSE or APART though they should hold, as requests that name their faces. Those that are being
        undocked are left out.
        """
        if not self._joints.rows.size:
            return []
        parting = [modules_of(joint) for undock in self._undocks for joint in undock.plan.opens]
        found = [self._watched[k].request for k in np.flatnonzero(self._joints.rows["open"] >= least).tolist()]
        return [joint for joint in found if modules_of(joint) not in parting]

    @property
    def joints(self) -> np.ndarray:
        """(k,) of PAIR: what is known of every joint in this tick; a copy."""
        rows = self._joints.rows
        return rows.copy() if rows.size else rows

    @property
    def has_work(self) -> bool:
        """Whether there is anything to watch or to steer."""
        return self.under_way or self._joints.rows.size > 0

    @property
    def under_way(self) -> bool:
        """Whether any dock or undock is."""
        return bool(self._docks or self._undocks)

    def forget(self, bodies: Collection[int]) -> list[int]:
        """Ends every dock that one of these takes part in, bodies that there are no more; returns the active ones."""
        self._expected = {body: request for body, request in self._expected.items() if body not in bodies}
        ended = [dock for dock in self._docks if dock.active in bodies or dock.target in bodies]
        for dock in ended:
            self._drop(dock)
            self._say(WARNING, f"dock ended: {CHANGED}")
        return [dock.active for dock in ended]

    def expect(self, body: int, requests: Sequence[DockRequest]) -> None:
        """Plans of these have been asked for, in this order."""
        self._expected.update((body, request) for request in requests)

    def leave(self, body: Body, surfaces: bool) -> Decisions:
        """The body is not in the mode DOCK: its docks and undocks end at once, for nothing that they want moves it any more. One that
        `surfaces` nobody docks to either: he would follow it up. A target that was coming goes back to where it held.

        An open joint is parted all the same: that its modules are apart is no wish.
        """
        self.events, decisions = [], Decisions()
        for undock in [each for each in self._undocks if each.plan.opens[0].module in body.modules and self._left(each.plan)]:
            self._call_off(undock)
            self._say(WARNING, f"undock of module {undock.plan.opens[0].module} ended: {NO_LONGER}")
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
        resting: Collection[tuple[int, int]],
    ) -> Decisions:
        """One tick.

        Args:
            waiting: bodies in the mode DOCK: only these begin a dock. Looked at when a plan is there, as `holding` is.
            holding: bodies that hold a place which may be moved: only these come to meet another.
            resting: modules and faces whose magnets are off whatever is wanted.
        """
        self.events, self.records = [], []
        decisions = Decisions()
        poses = ModulePoses(inputs.modules, self._tags)
        for prepared in inputs.prepared:
            self._begin(prepared, inputs.time_ns, estimates, waiting, holding, decisions)
        if self._joints.rows.size:
            self._joints.step(inputs.time_ns, inputs.modules, poses, resting)
        for dock in list(self._docks):
            self._steer(dock, inputs, estimates, poses, decisions)
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
        mine = _body_of(request.module, estimates)
        if self._expected.get(mine) == request:
            del self._expected[mine]
        under_way = next((dock for dock in self._docks if dock.active == mine), None)
        if under_way is not None and under_way.prepared.request == request and under_way.sequence.stage not in ENDED:
            return
        refusal = self._refusal(prepared, estimates, waiting, holding)
        if plan is None or refusal:
            self._say(WARNING, f"dock refused: {refusal}")
            if under_way is None:
                self._end(mine, decisions)
        elif isinstance(plan, UndockPlan):
            self._begin_undock(plan, prepared.chains, time_ns)
        else:
            if under_way is not None:
                self._give_up(under_way, ANOTHER, decisions)
            self._begin_dock(prepared, plan, time_ns, estimates, holding)

    def _refusal(self, prepared: Prepared, estimates: Estimated, waiting: Collection[int], holding: Collection[int]) -> str:
        """Why a plan is not begun; empty: it is."""
        plan = prepared.plan
        if plan is None:
            return prepared.refusal
        if not _fits(plan, estimates):
            return CHANGED
        if isinstance(plan, UndockPlan):
            return ""
        mine, others = (_body_of(module, estimates) for module in (plan.request.module, plan.request.target_module))
        if mine not in waiting:
            return NO_LONGER
        if mine in self._expected:
            return ANOTHER
        if mine in self._leaders(others):
            return LED
        if any(_meet(plan, dock.sequence.plan) for dock in self._docks if dock.active != mine):
            return TAKEN
        return self._in_the_way(plan, mine, others, estimates, holding)

    def _in_the_way(self, plan: DockPlan, mine: int, target: int, estimates: Estimated, holding: Collection[int]) -> str:
        """Why a straight way of the two is none; empty: both are free, or nobody knows, which is for the sequence to say.

        The paper's own is drawn through the target from wherever it begins.
        """
        active, other = estimates[mine], estimates[target]
        if not (active[1].placed and other[1].placed):
            return ""
        staged, slack_m = self._p.approach == "staged", WAY_SLACK * self._p.standoff_m
        way = way_of_active(plan, *active, *other, self._p.standoff_m if staged else 0.0)
        met = nearest_pass(way, *other, slack_m) if staged else None
        met = self._met(way, estimates, (mine, target)) if met is None else met
        if met is not None:
            return f"on its way it would come too near to module {met}: bring it before that face first"
        met = self._met(way_of_target(plan, way, *other), estimates, (mine, target)) if self._comes(plan, target, holding) else None
        return "" if met is None else f"module {plan.request.target_module}, which is to meet it, would come too near to module {met}"

    def _met(self, way: Way, estimates: Estimated, pair: Collection[int]) -> int | None:
        """A module of a third body that is where a way leads, as far as is known."""
        thirds = (each for number, each in estimates.items() if number not in pair and each[1].placed)
        passes = (nearest_pass(way, body, at, WAY_SLACK * self._p.standoff_m, BEGINNING) for body, at in thirds)
        return next((module for module in passes if module is not None), None)

    def _comes(self, plan: DockPlan, target: int, holding: Collection[int]) -> bool:
        """Whether the target is to come half of the way."""
        taken = any(target in (dock.active, dock.target) for dock in self._docks)
        return (plan.request.both_approach or self._p.approach == "straight") and target in holding and not taken

    def _leaders(self, body: int) -> list[int]:
        """The bodies that this one is steered by: the target of its dock, the target of that one's, and so on. None is led by itself."""
        targets, found = {dock.active: dock.target for dock in self._docks}, list[int]()
        while body in targets:
            body = targets[body]
            found.append(body)
        return found

    def _drop(self, dock: _Dock) -> None:
        """It is no longer under way, and its magnets let go."""
        self._docks.remove(dock)
        self.relays.switch(RELAY_OFF, *dock.sequence.plan.closes)

    def _give_up(self, dock: _Dock, reason: str, decisions: Decisions) -> None:
        """Ends a dock before its end; a target that was coming goes back to where it held."""
        self._drop(dock)
        self._say(WARNING, f"dock of module {dock.prepared.request.module} ended: {reason}")
        if dock.sequence.met_w.any():
            decisions.returning.append(dock.target)

    def _begin_undock(self, plan: UndockPlan, chains: tuple[Any, ...], time_ns: int) -> None:
        apart = [modules_of(joint) for joint in self.open_joints(APART)]
        holds = any(modules_of(joint) not in apart for joint in plan.opens)
        until_ns, seen_ns = (time_ns + (round(ns) if holds else 0) for ns in (self._p.release_s * 1e9, 2e6 * self._p.pose_fresh_ms))
        self._undocks.append(_Undock(plan, chains, time_ns, until_ns, seen_ns, self._strong(plan.opens)))
        self._say(INFORMATION, f"undocking module {plan.opens[0].module} from {plan.opens[0].target_module}")

    def _begin_dock(
        self,
        prepared: Prepared,
        plan: DockPlan,
        time_ns: int,
        estimates: Estimated,
        holding: Collection[int],
    ) -> None:
        request = prepared.request
        active, target = _body_of(request.module, estimates), _body_of(request.target_module, estimates)
        comes = self._comes(plan, target, holding)
        sequence = DockingSequence(plan, estimates[active][0], estimates[target][0], self._p, time_ns, comes)
        pair = FacePair(request.target_module, request.target_face, request.module, request.face, plan.place_t, plan.q_ta)
        self._docks.append(_Dock(sequence, PairDetector(pair, self._p), active, target, prepared))
        self._say(INFORMATION, f"docking module {request.module} to {request.target_module}")

    # ------------------------------------------------------------ each tick

    def _steer(
        self,
        dock: _Dock,
        inputs: Inputs,
        estimates: Estimated,
        poses: ModulePoses,
        decisions: Decisions,
    ) -> None:
        active, target = estimates[dock.active][1], estimates[dock.target][1]
        status = dock.detector.step(inputs.time_ns, inputs.modules, poses)
        before, waits = dock.sequence.stage, self._waits(dock, estimates)
        steering = dock.sequence.step(inputs.time_ns, active, target, status)
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
        if stage == Stage.DOCKED:
            self._join(dock, decisions)
        elif stage in (Stage.ABORTED, Stage.FAILED) and steering.is_apart:
            self._docks.remove(dock)
            self._end(dock.active, decisions)
        else:
            decisions.setpoints[dock.active] = REST if waits and stage == before else steering.active
        if steering.meets is not None:
            decisions.meets[dock.target] = steering.meets

    def _waits(self, dock: _Dock, estimates: Estimated) -> bool:
        """Whether a third body has come on its way to the stand-off; of each that is said once."""
        if dock.sequence.stage != Stage.PRE_APPROACH or len(estimates) == 2:
            return False
        plan, pair = dock.sequence.plan, (dock.active, dock.target)
        way = way_of_active(plan, *estimates[dock.active], *estimates[dock.target], self._p.standoff_m)
        met = self._met(way, estimates, pair)
        if met not in (None, dock.sequence.waits_for):
            dock.sequence.waits_for = met
            self._say(WARNING, f"dock of module {plan.request.module} waits: module {met} is on its way")
        return met is not None

    def _end(self, active: int, decisions: Decisions) -> None:
        """The body is done with docking, but for what it still waits for the plan of, and an undock under way."""
        parting = {module for undock in self._undocks for module in (*undock.plan.stays.modules, *undock.plan.leaves.modules)}
        if active not in self._expected and active not in parting:
            decisions.ended.append(active)

    def _join(self, dock: _Dock, decisions: Decisions) -> None:
        """One join a tick and body: a dock that comes second finds its bodies gone, and `forget` ends it."""
        if decisions.joining.isdisjoint((dock.active, dock.target)):
            decisions.joins.append(Join(dock.target, dock.active, dock.prepared.chains[0]))
            self._docks.remove(dock)

    def _release(self, undock: _Undock, time_ns: int, estimates: Estimated, decisions: Decisions) -> None:
        plan, request = undock.plan, undock.plan.opens[0]
        if not _fits(plan, estimates):
            self._call_off(undock)
            self._say(WARNING, f"undock ended: {CHANGED}")
            return
        self.relays.switch(RELAY_PUSH, *plan.opens)
        whole = _body_of(request.module, estimates)
        changes = whole in decisions.joining or whole in [part.whole for part in decisions.parts]
        if time_ns < undock.until_ns or changes:  # the next tick has no such body, and ends this
            return
        alone = len(plan.opens) == 1
        seen = alone and self._since(undock, time_ns, "picture_ns")
        if alone and not seen and time_ns < undock.seen_ns:
            return
        held = seen and self._since(undock, time_ns, "near_ns")
        if held or (not seen and self._pulls(undock, time_ns)):
            if time_ns < undock.last_ns:
                return
            self._call_off(undock)
            self._say(WARNING, f"undock of module {request.module} ended: {IN_PLACE if held else PULLED}")
            self._end(whole, decisions)
            return
        self.relays.switch(RELAY_OFF, *plan.opens)
        estimate = estimates[whole][1]
        away_w = rotate(estimate.q_wb, plan.axis_b) * self._p.standoff_m
        stays, leaves = undock.chains
        decisions.parts.append(Part(whole, stays, leaves, away_w))
        self._undocks.remove(undock)
        self._say(INFORMATION, f"module {request.module} is undocked from {request.target_module}")

    def _call_off(self, undock: _Undock) -> None:
        """Ends an undock before its end: magnets pull again where there still is a joint, and let go where another has undone it."""
        self._undocks.remove(undock)
        left = self._left(undock.plan)
        self.relays.switch(RELAY_OFF, *(joint for joint in undock.plan.opens if joint not in left))
        self.relays.switch(RELAY_PULL, *left)

    def _left(self, plan: UndockPlan) -> list[DockRequest]:
        """The joints that still are to be undone."""
        watched = [modules_of(joint.request) for joint in self._watched]
        return [joint for joint in plan.opens if modules_of(joint) in watched]

    def _since(self, undock: _Undock, time_ns: int, picture: str) -> bool:
        """Whether in the latter half of the push pictures were taken of the joint: any (`picture_ns`), or such as show it closed
        (`near_ns`), as where a relay hangs: two bodies would fly against each other. Of several that part at once the funnels hold back
        what leaves across, until thrusters draw it out: of these no picture tells.
        """
        half_ns = (undock.since_ns + time_ns) // 2
        taken = [modules_of(self._watched[i].request) for i in np.flatnonzero(self._joints.rows[picture] > half_ns).tolist()]
        return modules_of(undock.plan.opens[0]) in taken

    def _pulls(self, undock: _Undock, time_ns: int) -> bool:
        """Whether any joint is still held by both its magnets: their currents have not turned, as where relays hang."""
        now = self._strong(undock.plan.opens, (undock.since_ns + time_ns) // 2)
        return any(bool(np.all(now[joint] * before > 0.0)) for joint, before in undock.pulled.items() if joint in now)

    def _strong(self, joints: Sequence[DockRequest], after_ns: int = NEVER_NS) -> dict[frozenset[int], np.ndarray]:
        """Currents (2,), mA, of those of the joints whose magnets both are on, as far as they came after that time."""
        rows, wanted = self._joints.rows, [modules_of(joint) for joint in joints]
        strong = (np.abs(rows["current_ma"]) > self._p.current_threshold_ma) & (rows["current_ns"] > after_ns)
        found = [(modules_of(self._watched[i].request), i) for i in np.flatnonzero(strong.all(axis=1)).tolist()]
        return {joint: rows["current_ma"][i].copy() for joint, i in found if joint in wanted}

    def _say(self, severity: int, text: str) -> None:
        self.events.append(Event(severity, text))


def tag_table(bodies: Sequence[Body]) -> TagTable:
    """Tags of every module in its own frame."""
    table: TagTable = {}
    for body in bodies:
        for k, tag in enumerate(body.tag_ids):
            i = int(body.tag_module[k])
            q_bm = np.ascontiguousarray(body.q_bm[i])
            r_mt = rotate_back(q_bm, body.r_bt[k] - body.r_bm[i])
            q_tm = multiply(conjugate(np.ascontiguousarray(body.q_bt[k])), q_bm)
            table[body.modules[i], int(tag)] = np.concatenate([r_mt, q_tm])
    return table


def _meet(plan: DockPlan, other: DockPlan) -> bool:
    """Whether both would bring a module to one place, beside a body that is to be part of both."""
    common = set(plan.merged.modules).intersection(other.merged.modules)
    if not common:
        return False
    mine, others = (_beside(each.merged, common) for each in (plan, other))
    apart_m = np.linalg.norm(mine[:, None] - others, axis=-1)
    return bool(apart_m.min() < 0.5 * np.linalg.norm(plan.place_t))


def _beside(body: Body, common: Collection[int]) -> np.ndarray:
    """(n, 3) places of those of its modules that are not `common`, in the frame of the first that is, m."""
    first = body.modules.index(min(common))
    places = (body.r_bm - body.r_bm[first]) @ to_matrix(np.ascontiguousarray(body.q_bm[first]))
    return np.asarray(places[[module not in common for module in body.modules]])


def _fits(plan: DockPlan | UndockPlan, estimates: Estimated) -> bool:
    """Whether the bodies are still those that a plan is made for."""
    bodies = {frozenset(body.modules) for body, _ in estimates.values()}
    if isinstance(plan, UndockPlan):
        return frozenset((*plan.stays.modules, *plan.leaves.modules)) in bodies
    request, merged = plan.request, frozenset(plan.merged.modules)
    mine = {module: body for body in bodies for module in body}
    active, target = mine[request.module], mine[request.target_module]
    return active != target and active | target == merged


def _body_of(module: int, estimates: Estimated) -> int:
    return next(number for number, (body, _) in estimates.items() if module in body.modules)
