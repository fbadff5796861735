"""Grouping of modules into bodies, and the motion of bodies that merge or split. Base class of World."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.vehicle import FACE_NORMALS, Vehicle
from hil.plant.bodies import Bodies, Modules
from hil.plant.build import fill_body, make_bodies, make_modules, nominal_centre, seat_thrusters
from hil.plant.contact import touch
from hil.plant.docking import DISK_M, Docks, Joint, joints_between
from hil.plant.draw import ModuleDraw
from hil.plant.joining import SupportedPart, centre_of, force_needed, motion_of, pieces, seats_after_join, supported_part
from hil.plant.lattice import QUATERNIONS, Place, nearest
from hil.plant.spec import WorldSpec
from hil.plant.thrusters import Thrusters
from hil.plant.water import Water


class _FixedPoint(NamedTuple):
    """Point that keeps its place when two bodies merge: their common centre of mass, or a module held by a load cell."""

    p_w: np.ndarray
    """(3,) world, m."""
    share: float
    """Share of the misalignment from the lattice that the first body turns; the second turns the rest."""
    anchor: int | None = None
    """Index of the held module; None: the centre of mass is fixed."""


class DockedBodies(ABC):
    """Bodies of one or more modules. `World` creates the arrays and advances time."""

    vehicles: tuple[Vehicle, ...]
    spec: WorldSpec
    docks: Docks
    bodies: list[tuple[int, ...]]
    """Modules of each body, leader first; sorted by leader."""
    places: list[Place]
    """Seat of each module in its body."""
    _centres: list[tuple[float, ...]]
    """(3,) centre of mass of each body according to the vehicle files, body frame."""
    _draws: list[ModuleDraw]
    _thrusters: Thrusters
    _water: Water
    _modules: Modules
    _body_arrays: Bodies
    _held: set[int]
    """One module of each body held by a load cell."""
    _stage: np.ndarray
    _supported_parts: dict[Joint, SupportedPart | None]
    """Cache of `_find_supported_part` by joint, cleared when a joint opens or closes; None: other joints hold as well."""
    _module_wrenches: np.ndarray
    """(m, 6) wrench of jets and external pushes on each module, about O of its body, body frame."""

    @abstractmethod
    def _step(self, steps: int) -> None:
        """Integrates all bodies over `steps` sub-steps; 0 only updates the derived quantities."""

    def _seat(self, groups: Sequence[Sequence[int]], places: Sequence[Place]) -> None:
        """Groups the modules into bodies and rebuilds the arrays; the caller sets the states."""
        self.bodies = [tuple(members) for members in groups]
        self.places = list(places)
        centres = (nominal_centre([self.vehicles[m] for m in members], [places[m] for m in members]) for members in self.bodies)
        self._centres = [tuple(centre.tolist()) for centre in centres]
        self._modules = make_modules(self.vehicles, self._draws, self.bodies, places)
        seat_thrusters(self._thrusters, self.vehicles, self._modules)
        self._body_arrays = make_bodies(len(self.bodies))
        for b, members in enumerate(self.bodies):
            parts = [(self._draws[m], self._modules.position[m], self._modules.turn[m]) for m in members]
            fill_body(self._body_arrays, b, parts, self.spec)
            self._body_arrays.clamped[b] = not self._held.isdisjoint(members)
        self._stage = np.zeros((6, len(self.bodies), 13))
        self._external = np.zeros((len(self.bodies), 6))
        self._module_wrenches = np.zeros((len(self.vehicles), 6))
        self._thrust = np.zeros((len(self.bodies), 6))
        self._supported_parts = {}

    def join(self, joint: Joint) -> None:
        """Merges the two bodies that `joint` links, and closes every other joint that then meets. Conserves momentum and centre of mass; a
        clamped body keeps its position and attitude instead.
        """
        a, b = sorted((int(self._modules.body[joint.module]), int(self._modules.body[joint.other])))
        old, total = self._body_arrays, self.momentum()
        kept = joint.module if joint.module in self.bodies[a] else joint.other
        q_a, q_b = old.state[a, 3:7].copy(), old.state[b, 3:7].copy()
        q_ab = rotations.multiply(rotations.conjugate(q_a), q_b)
        seats = seats_after_join(self.places, self._modules, joint, kept, self.bodies[b], q_ab)
        lattice = QUATERNIONS[nearest(q_ab)].copy()
        off = rotations.log(rotations.multiply(q_ab, rotations.conjugate(lattice)))
        fixed = self._fixed_point(a, b)
        whole = tuple(sorted((*self.bodies[a], *self.bodies[b])))
        groups = sorted([*(g for k, g in enumerate(self.bodies) if k not in (a, b)), whole])
        states = {g[0]: old.state[k].copy() for k, g in enumerate(self.bodies)}
        self._seat(groups, seats)
        self._restore(states)
        new = groups.index(whole)
        x = self._body_arrays.state[new]
        x[3:7] = rotations.normalise(rotations.multiply(q_a, rotations.exp(off * fixed.share)))
        at = centre_of(self._body_arrays, new) if fixed.anchor is None else self.places[fixed.anchor].position
        x[:3] = fixed.p_w - rotations.rotate(x[3:7].copy(), at)
        motion_of(self._body_arrays, new, total[a] + total[b], self._flow())
        if self._body_arrays.clamped[new]:
            x[7:13] = 0.0
        known = set(self.docks.joints)
        for met in joints_between(self._modules, self.docks.faces.kind):
            if met not in known:
                self.docks.joined(met)
        self._step(0)

    def _fixed_point(self, a: int, b: int) -> _FixedPoint:
        """Fixed point of the merge of bodies a and b."""
        old = self._body_arrays
        if (held := next((k for k in (a, b) if old.clamped[k]), None)) is not None:
            anchor = self.bodies[held][0]
            return _FixedPoint(self._to_world(held, self.places[anchor].position), float(held == b), anchor)
        masses = old.rigid[[a, b], 0, 0]
        centre_w = np.average([self._to_world(k, centre_of(old, k)) for k in (a, b)], axis=0, weights=masses)
        return _FixedPoint(centre_w, masses[1] / masses.sum())

    def part(self, joint: Joint) -> None:
        """Opens a joint; a part held by no other joint becomes a body of its own, with unchanged motion."""
        b = int(self._modules.body[joint.module])
        self.docks.parted(joint)
        self._supported_parts = {}
        parts = pieces(self.bodies[b], self.docks.joints)
        if len(parts) == 1:
            return
        states = {g[0]: self._body_arrays.state[k].copy() for k, g in enumerate(self.bodies)}
        places = list(self.places)
        whole = states[self.bodies[b][0]]
        for piece in parts:
            shift = self.places[piece[0]].position
            states[piece[0]] = _moved_origin(whole, shift)
            for m in piece:
                places[m] = Place(self.places[m].position - shift, self.places[m].quaternion)
        groups = sorted([*(g for k, g in enumerate(self.bodies) if k != b), *parts])
        self._seat(groups, places)
        self._restore(states)
        self._step(0)

    def _restore(self, states: Mapping[int, np.ndarray]) -> None:
        """Restores the state of every body from `states`, by leader."""
        for b, members in enumerate(self.bodies):
            self._body_arrays.state[b] = states[members[0]]

    def _to_world(self, body: int, r: np.ndarray) -> np.ndarray:
        x = self._body_arrays.state[body]
        return np.asarray(x[:3] + rotations.rotate(x[3:7].copy(), r))

    def _flow(self) -> np.ndarray:
        return self._water.flow[0] + self._water.flow[1]

    def _pull_on(self, joint: Joint) -> float:
        """Force that pulls a joint open, N; 0 where other joints hold as well.

        A bending moment counts as a force at the rim of the disk; the pins carry the moment about the face normal.
        """
        if joint not in self._supported_parts:
            self._supported_parts[joint] = self._find_supported_part(joint)
        far = self._supported_parts[joint]
        if far is None:
            return 0.0
        b = int(self._modules.body[joint.module])
        need = force_needed(far, self._body_arrays.state[b], self._stage[5, b])
        for m in far.members:
            pushing = slice(*np.searchsorted(self._thrusters.module, (m, m + 1)))
            need -= self._thrusters.force[pushing] @ self._thrusters.column[pushing] + self._module_wrenches[m]
        need -= self._touch_on(far.members)[b]
        outward, side = self._modules.turn[joint.module] @ FACE_NORMALS[joint.face], 1.0 if joint.other in far.members else -1.0
        at = self._modules.position[joint.module] + 0.5 * self._modules.size[joint.module, joint.face // 2] * outward
        bending = rotations.cross(outward, need[3:] - rotations.cross(at, need[:3]))
        return float(-side * outward @ need[:3] + np.linalg.norm(bending) / DISK_M)

    def _find_supported_part(self, joint: Joint) -> SupportedPart | None:
        """The part held by `joint` alone: the unclamped side, preferably that of `joint.other`; None where other joints hold it too."""
        parts = pieces(self.bodies[int(self._modules.body[joint.module])], [j for j in self.docks.joints if j != joint])
        if len(parts) == 1:
            return None
        free = [piece for piece in parts if self._held.isdisjoint(piece)] or parts
        return supported_part(self._draws, self._modules, next((p for p in free if joint.other in p), free[0]), self.spec.gravity)

    def _touch_on(self, members: Sequence[int]) -> np.ndarray:
        """(b, 6) wall and contact forces on these modules of one body, in that body's row, body frame."""
        chosen = np.zeros(len(self.vehicles), dtype=np.int64)
        chosen[list(members)] = 1
        found = self._body_arrays._replace(wrench=np.zeros((len(self.bodies), 6)))
        touch(found, self._modules, self.docks.faces, self._water, chosen)
        return found.wrench

    def clamp(self, body: int) -> None:
        """Fixes a body in place by its leader, also after other bodies join it; `load` returns the force on the clamp."""
        self._held.add(self.bodies[body][0])
        self._body_arrays.clamped[body] = 1
        self._body_arrays.state[body, 7:13] = 0.0

    def load(self, body: int) -> np.ndarray:
        """(6,) wrench about O that the body exerts on its clamp, body frame; zeros for a body that is not clamped.

        The flow around the body adds the added-mass force of the accelerating water and the Munk moment.
        """
        arrays = self._body_arrays
        if not arrays.clamped[body]:
            return np.zeros(6)
        turn, added = rotations.to_matrix(arrays.state[body, 3:7].copy()), arrays.added[body]
        _, gust, target = self._water.flow
        flow, rate = turn.T @ self._flow(), turn.T @ (target - gust) / self._water.smoothing_s
        munk = -np.cross(flow, added[:3, :3] @ flow)
        return np.asarray(arrays.wrench[body] + added[:, :3] @ rate + np.concatenate([np.zeros(3), munk]))

    def momentum(self) -> np.ndarray:
        """(b, 6) linear and angular momentum of each body with its added mass, about the world's origin, world."""
        out = np.empty((len(self.bodies), 6))
        for b, x in enumerate(self._body_arrays.state[: len(self.bodies)]):
            r_wb = rotations.to_matrix(x[3:7])
            flow = np.concatenate([r_wb.T @ self._flow(), np.zeros(3)])
            total = self._body_arrays.rigid[b] @ x[7:] + self._body_arrays.added[b] @ (x[7:] - flow)
            p = r_wb @ total[:3]
            out[b] = np.concatenate([p, r_wb @ total[3:] + np.cross(x[:3], p)])
        return out


def _moved_origin(x: np.ndarray, r: np.ndarray) -> np.ndarray:
    """(13,) state of the same motion with the origin moved to the point r (3,), body frame."""
    moved = x.copy()
    moved[:3] += rotations.rotate(x[3:7].copy(), r.copy())
    moved[7:10] += np.cross(x[10:13], r)
    return moved
