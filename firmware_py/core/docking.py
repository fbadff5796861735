"""Stage 3b of a tick: all docks of the fleet. Detects, steers what is docking, and says when bodies join or part.

Works on the estimates of this tick; the pipeline carries out the joins and parts that it returns, within the same tick.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.docking_detector import FacePair, ModulePoses, PairBank, PairDetector, TagTable
from firmware_py.core.docking_pairs import APART
from firmware_py.core.docking_sequence import (
    RELAY_OFF,
    RELAY_PULL,
    RELAY_PUSH,
    DockingSequence,
    DockPlan,
    Stage,
    UndockPlan,
)
from firmware_py.core.rotations import conjugate, multiply, rotate, rotate_back, to_matrix
from firmware_py.core.types import DockRecord, DockRequest, Estimate, Event, Inputs, Setpoint
from firmware_py.description.parameters import Docking
from firmware_py.description.vehicle import FACE_NORMALS

WARNING, INFORMATION = 4, 6
NEVER_NS = -(1 << 60)
RELAY_PERIOD_NS = 100_000_000
"""DOCK_CMD goes out at 10 Hz, and at once when a relay changes."""


class Prepared(NamedTuple):
    """An answer of the worker."""

    request: DockRequest
    plan: DockPlan | UndockPlan | None
    chains: tuple[Any, ...]
    """The pipelines of the bodies that there will be, ready to take over."""
    refusal: str = ""
    """Why there is no plan."""


class Join(NamedTuple):
    """Two bodies become one, in this tick."""

    target: int
    """Numbers of the bodies."""
    active: int
    chain: Any


class Part(NamedTuple):
    """One body becomes two, in this tick; the leaving one then glides away along `away_w` (3,), m."""

    whole: int
    stays: Any
    leaves: Any
    away_w: np.ndarray


class Decisions(NamedTuple):
    """What the stage wants of the pipeline."""

    setpoints: dict[int, Setpoint]
    """By body: steers it in this tick."""
    joins: list[Join]
    parts: list[Part]
    ended: list[int]
    """Bodies whose dock is over without a join: they hold where they are."""
    meets: dict[int, np.ndarray]
    """By body: (3,) how far it comes to meet the other, world, m, from where it holds."""


class _Dock(NamedTuple):
    """A dock under way."""

    sequence: DockingSequence
    detector: PairDetector
    active: int
    target: int
    prepared: Prepared


class Joint(NamedTuple):
    """Two faces that hold modules of one body together."""

    request: DockRequest
    offset: np.ndarray
    """(3,) centre of its module in the frame of the target module, m."""

    @property
    def pair(self) -> FacePair:
        """What the detector watches."""
        return FacePair(self.request.target_module, self.request.target_face, self.request.module, self.request.face, self.offset)


class _Undock:
    """An undock under way: magnets push until the body parts, which is at once where the joint is open already."""

    def __init__(self, prepared: Prepared, until_ns: int) -> None:
        self.prepared = prepared
        self.until_ns = until_ns


class DockingStage:
    """All docks and joints of the fleet."""

    def __init__(self, parameters: Docking, tags: TagTable, modules: int) -> None:
        self._p = parameters
        self._tags = tags
        self._relays = np.zeros((modules, 6), dtype=np.int64)
        self._due_ns = [NEVER_NS] * modules
        self._docks: list[_Dock] = []
        self._undocks: list[_Undock] = []
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
            self._set_relays(joint.request, RELAY_PULL)

    def open_joints(self, least: int) -> list[DockRequest]:
        """Joints that are `least` LOOSE or APART though they should hold, as requests that name their faces. Those that are being
        undocked are left out.
        """
        if not self._joints.rows.size:
            return []
        rows = self._joints.rows[self._joints.rows["open"] >= least]
        parting = [_modules(undock.prepared.request) for undock in self._undocks]
        found = [
            DockRequest(module, face, target, target_face)
            for (target, module), (target_face, face) in zip(rows["module"].tolist(), rows["face"].tolist(), strict=True)
        ]
        return [joint for joint in found if _modules(joint) not in parting]

    @property
    def joints(self) -> np.ndarray:
        """(k,) of PAIR: what is known of every joint in this tick; a copy."""
        rows = self._joints.rows
        return rows.copy() if rows.size else rows

    @property
    def busy(self) -> frozenset[int]:
        """Bodies that a dock steers."""
        return frozenset(dock.active for dock in self._docks)

    @property
    def under_way(self) -> bool:
        """Whether any dock or undock is."""
        return bool(self._docks or self._undocks)

    def forget(self, bodies: Collection[int]) -> list[int]:
        """Ends every dock that one of these takes part in, bodies that there are no more; returns the active ones."""
        ended = [dock for dock in self._docks if dock.active in bodies or dock.target in bodies]
        for dock in ended:
            self._docks.remove(dock)
            self._set_relays(dock.prepared.request, RELAY_OFF)
            self._say(WARNING, f"dock ended: {CHANGED}")
        return [dock.active for dock in ended]

    def abort(self, body: int, time_ns: int, reason: str) -> None:
        """Ends every dock that a body takes part in."""
        for dock in self._docks:
            if body in (dock.active, dock.target):
                dock.sequence.abort(time_ns, reason)

    def leave(self, body: Body, armed: bool) -> list[Event]:
        """The body is not in the mode DOCK: its undocks end at once, and where it is disarmed its docks. Says so.

        An open joint is parted all the same: that its modules are apart is no wish.
        """
        left: list[tuple[str, DockRequest]] = []
        for undock in [each for each in self._undocks if each.prepared.request.module in body.modules and self._holds(each)]:
            self._undocks.remove(undock)
            self._set_relays(undock.prepared.request, RELAY_PULL)
            left.append(("undock", undock.prepared.request))
        for dock in [each for each in self._docks if each.active == body.index and not armed]:
            self._docks.remove(dock)
            self._set_relays(dock.prepared.request, RELAY_OFF)
            left.append(("dock", dock.prepared.request))
        return [Event(WARNING, f"{what} of module {request.module} ended: {NO_LONGER}") for what, request in left]

    def step(
        self, inputs: Inputs, estimates: Mapping[int, tuple[Body, Estimate]], holding: Collection[int] = ()
    ) -> Decisions:
        """One tick.

        Args:
            estimates: body and its estimate, by the body's number.
            holding: bodies that hold a place which may be moved: only these come to meet another. Looked at when a dock begins.
        """
        self.events, self.records = [], []
        decisions = Decisions({}, [], [], [], {})
        if not (inputs.prepared or self._docks or self._undocks or self._joints.rows.size):
            return decisions
        poses = ModulePoses(inputs.modules, self._tags)
        for prepared in inputs.prepared:
            self._begin(prepared, inputs.time_ns, estimates, holding, decisions)
        if self._joints.rows.size:
            self._joints.step(inputs.time_ns, inputs.modules, poses)
        for dock in list(self._docks):
            self._steer(dock, inputs, estimates, poses, decisions)
        for undock in list(self._undocks):
            self._release(undock, inputs.time_ns, estimates, decisions)
        return decisions

    @property
    def relays(self) -> list[list[int]]:
        """By module: the relay states that docks and joints want."""
        return self._relays.tolist()

    def due(self, time_ns: int) -> list[int]:
        """Modules whose relay states are to be sent in this tick."""
        if min(self._due_ns) > time_ns:
            return []
        due = [module for module, at_ns in enumerate(self._due_ns) if at_ns <= time_ns]
        for module in due:
            self._due_ns[module] = time_ns + RELAY_PERIOD_NS
        return due

    # ------------------------------------------------------------ beginnings

    def _begin(
        self,
        prepared: Prepared,
        time_ns: int,
        estimates: Mapping[int, tuple[Body, Estimate]],
        holding: Collection[int],
        decisions: Decisions,
    ) -> None:
        request = prepared.request
        if prepared.plan is None:
            self._say(WARNING, f"dock refused: {prepared.refusal}")
            decisions.ended.append(_body_of(request.module, estimates))
        elif not _fits(prepared.plan, estimates):
            self._say(WARNING, f"dock refused: {CHANGED}")
            decisions.ended.append(_body_of(request.module, estimates))
        elif isinstance(prepared.plan, UndockPlan):
            holds = _modules(request) not in [_modules(joint) for joint in self.open_joints(APART)]
            self._undocks.append(_Undock(prepared, time_ns + (round(self._p.release_s * 1e9) if holds else 0)))
            self._say(INFORMATION, f"undocking module {request.module} from {request.target_module}")
        else:
            active, target = _body_of(request.module, estimates), _body_of(request.target_module, estimates)
            taken = any(target in (dock.active, dock.target) for dock in self._docks)
            comes = (request.both_approach or self._p.approach == "straight") and target in holding and not taken
            sequence = DockingSequence(prepared.plan, estimates[active][0], estimates[target][0], self._p, time_ns, comes)
            pair = FacePair(request.target_module, request.target_face, request.module, request.face, prepared.plan.place_t)
            self._docks.append(_Dock(sequence, PairDetector(pair, self._p), active, target, prepared))
            self._say(INFORMATION, f"docking module {request.module} to {request.target_module}")

    # ------------------------------------------------------------ each tick

    def _steer(
        self,
        dock: _Dock,
        inputs: Inputs,
        estimates: Mapping[int, tuple[Body, Estimate]],
        poses: ModulePoses,
        decisions: Decisions,
    ) -> None:
        active, target = estimates[dock.active][1], estimates[dock.target][1]
        status = dock.detector.step(inputs.time_ns, inputs.modules, poses)
        before = dock.sequence.stage
        steering = dock.sequence.step(inputs.time_ns, active, target, status)
        stage = dock.sequence.stage
        self._set_relays(dock.prepared.request, steering.relay)
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
            decisions.ended.append(dock.active)
            self._docks.remove(dock)
        else:
            decisions.setpoints[dock.active] = steering.active
        if steering.meets is not None:
            decisions.meets[dock.target] = steering.meets

    def _join(self, dock: _Dock, decisions: Decisions) -> None:
        """One join a tick and body: a dock that comes second finds its bodies gone, and `forget` ends it."""
        joining = {body for join in decisions.joins for body in (join.active, join.target)}
        if joining.isdisjoint((dock.active, dock.target)):
            decisions.joins.append(Join(dock.target, dock.active, dock.prepared.chains[0]))
            self._docks.remove(dock)

    def _release(self, undock: _Undock, time_ns: int, estimates: Mapping[int, tuple[Body, Estimate]], decisions: Decisions) -> None:
        plan = undock.prepared.plan
        assert isinstance(plan, UndockPlan)
        request = plan.request
        if not _fits(plan, estimates):
            self._undocks.remove(undock)
            self._set_relays(request, RELAY_PULL if self._holds(undock) else RELAY_OFF)
            self._say(WARNING, f"undock ended: {CHANGED}")
            return
        self._set_relays(request, RELAY_PUSH)
        if time_ns < undock.until_ns:
            return
        self._set_relays(request, RELAY_OFF)
        whole = _body_of(request.module, estimates)
        estimate = estimates[whole][1]
        away_w = rotate(estimate.q_wb, plan.axis_b) * self._p.standoff_m
        stays, leaves = undock.prepared.chains
        decisions.parts.append(Part(whole, stays, leaves, away_w))
        self._undocks.remove(undock)
        self._say(INFORMATION, f"module {request.module} is undocked from {request.target_module}")

    def _holds(self, undock: _Undock) -> bool:
        """Whether there still is a joint to be undone."""
        return _modules(undock.prepared.request) in [_modules(joint.request) for joint in self._watched]

    def _set_relays(self, request: DockRequest, relay: int) -> None:
        for module, face in sides(request):
            if self._relays[module, face] != relay:
                self._relays[module, face], self._due_ns[module] = relay, NEVER_NS

    def _say(self, severity: int, text: str) -> None:
        self.events.append(Event(severity, text))


def sides(request: DockRequest) -> tuple[tuple[int, int], tuple[int, int]]:
    """Module and face of each side: fleet index, and 0 to 5 for A to F."""
    return (request.module, request.face), (request.target_module, request.target_face)


def joints_of(body: Body) -> list[Joint]:
    """Every joint of a body, in the order of its modules: neighbours of which one turns a probe and the other a drogue to the other."""
    joints: list[Joint] = []
    at = {tuple(cell): i for i, cell in enumerate(body.cells.tolist())}
    for i, cell in enumerate(body.cells):
        neighbours = (at.get(tuple(place), -1) for place in (cell + FACE_NORMALS).tolist())
        joints += [_joint(body, i, j) for j in sorted(neighbours) if j > i]
    faces = dict(zip(body.modules, body.faces, strict=True))
    return [joint for joint in joints if {faces[m][f] for m, f in sides(joint.request)} == {"P", "D"}]


def _joint(body: Body, i: int, j: int) -> Joint:
    """Between the modules i and j of the body, which are neighbours."""
    step = (body.cells[j] - body.cells[i]).astype(np.float64)
    turn_i, turn_j = (to_matrix(np.ascontiguousarray(body.q_bm[k])) for k in (i, j))
    near = int(np.argmax(FACE_NORMALS @ (turn_i.T @ step)))
    far = int(np.argmax(FACE_NORMALS @ (turn_j.T @ -step)))
    offset = rotate_back(np.ascontiguousarray(body.q_bm[i]), body.r_bm[j] - body.r_bm[i])
    return Joint(DockRequest(body.modules[j], far, body.modules[i], near), offset)


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


CHANGED = "the bodies are others than those that it was planned for"
NO_LONGER = "its body is no longer in DOCK"


def _fits(plan: DockPlan | UndockPlan, estimates: Mapping[int, tuple[Body, Estimate]]) -> bool:
    """Whether the bodies are still those that a plan is made for."""
    bodies = {frozenset(body.modules) for body, _ in estimates.values()}
    if isinstance(plan, UndockPlan):
        return frozenset((*plan.stays.modules, *plan.leaves.modules)) in bodies
    request, merged = plan.request, frozenset(plan.merged.modules)
    mine = {module: body for body in bodies for module in body}
    active, target = mine[request.module], mine[request.target_module]
    return active != target and active | target == merged


def _modules(request: DockRequest) -> frozenset[int]:
    return frozenset((request.module, request.target_module))


def _body_of(module: int, estimates: Mapping[int, tuple[Body, Estimate]]) -> int:
    return next(number for number, (body, _) in estimates.items() if module in body.modules)
