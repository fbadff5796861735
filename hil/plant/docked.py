"""Which modules make up which bodies in the plant, and what merging and parting do to their motion. The base of World."""

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
from hil.plant.joining import Hanging, centre_of, force_needed, hanging, motion_of, pieces, seats_after_join
from hil.plant.lattice import QUATERNIONS, Place, nearest
from hil.plant.spec import WorldSpec
from hil.plant.thrusters import Thrusters
from hil.plant.water import Water


class _FixedPoint(NamedTuple):
    """What stays where it is when two bodies become one: their common centre of mass, or a module that a load cell holds."""

    p_w: np.ndarray
    """(3,) there, world, m."""
    share: float
    """Of the turn by which the two are off the lattice, what the first body makes of it; the second makes the rest."""
    anchor: int | None = None
    """The module; None: the centre of mass."""


class DockedBodies(ABC):
    """Bodies of one or more modules. `World` makes the parts and moves time."""

    vehicles: tuple[Vehicle, ...]
    spec: WorldSpec
    docks: Docks
    bodies: list[tuple[int, ...]]
    """Modules of each body, its leader first; in the order of the leaders."""
    places: list[Place]
    """Where each module sits in its body."""
    _centres: list[tuple[float, ...]]
    """(3,) what the vehicle files say of each body's centre of mass."""
    _draws: list[ModuleDraw]
    _thrusters: Thrusters
    _water: Water
    _modules: Modules
    _body_arrays: Bodies
    _held: set[int]
    """A module of each body that a load cell holds."""
    _stage: np.ndarray
    _hanging: dict[Joint, Hanging | None]
    """By joint, once it was asked for and as long as no other opens or closes; None: other joints hold as well."""
    _hands: np.ndarray
    """(m, 6) what jets and hands do to each module, about O of its body, body frame."""

    @abstractmethod
    def _step(self, steps: int) -> None:
        """Moves everything on by so many sub-steps."""

    def _seat(self, groups: Sequence[Sequence[int]], places: Sequence[Place]) -> None:
        """Puts the modules into bodies; their states are the caller's business."""
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
        self._hands = np.zeros((len(self.vehicles), 6))
        self._thrust = np.zeros((len(self.bodies), 6))
        self._hanging = {}

    def join(self, joint: Joint) -> None:
        """Makes one body of the two that `joint` links, and closes whatever else then meets. Momentum and centre of mass stay as they are;
        of a body that is clamped, place and attitude.
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
        """That of the bodies a and b, which are about to be one."""
        old = self._body_arrays
        if (held := next((k for k in (a, b) if old.clamped[k]), None)) is not None:
            anchor = self.bodies[held][0]
            return _FixedPoint(self._to_world(held, self.places[anchor].position), float(held == b), anchor)
        masses = old.rigid[[a, b], 0, 0]
        centre_w = np.average([self._to_world(k, centre_of(old, k)) for k in (a, b)], axis=0, weights=masses)
        return _FixedPoint(centre_w, masses[1] / masses.sum())

    def part(self, joint: Joint) -> None:
        """Opens a joint; what no other joint holds becomes a body of its own, moving as it did."""
        b = int(self._modules.body[joint.module])
        self.docks.parted(joint)
        self._hanging = {}
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
        """Puts back the state of every body whose leader is the same."""
        for b, members in enumerate(self.bodies):
            self._body_arrays.state[b] = states[members[0]]

    def _to_world(self, body: int, r: np.ndarray) -> np.ndarray:
        x = self._body_arrays.state[body]
        return np.asarray(x[:3] + rotations.rotate(x[3:7].copy(), r))

    def _flow(self) -> np.ndarray:
        return self._water.flow[0] + self._water.flow[1]

    def _pull_on(self, joint: Joint) -> float:
        """Force that pulls a joint open, N; 0 where others hold as well.

        A moment that bends the joint counts as a force at the disk's rim; one about the face's normal is borne by the pins.
        """
        if joint not in self._hanging:
            self._hanging[joint] = self._find_hanging(joint)
        far = self._hanging[joint]
        if far is None:
            return 0.0
        b = int(self._modules.body[joint.module])
        need = force_needed(far, self._body_arrays.state[b], self._stage[5, b])
        for m in far.members:
            pushing = slice(*np.searchsorted(self._thrusters.module, (m, m + 1)))
            need -= self._thrusters.force[pushing] @ self._thrusters.column[pushing] + self._hands[m]
        need -= self._touch_on(far.members)[b]
        outward, side = self._modules.turn[joint.module] @ FACE_NORMALS[joint.face], 1.0 if joint.other in far.members else -1.0
        at = self._modules.position[joint.module] + 0.5 * self._modules.size[joint.module, joint.face // 2] * outward
        bending = rotations.cross(outward, need[3:] - rotations.cross(at, need[:3]))
        return float(-side * outward @ need[:3] + np.linalg.norm(bending) / DISK_M)

    def _find_hanging(self, joint: Joint) -> Hanging | None:
        """What hangs on `joint` alone, on its other side, or on this one where a clamp holds the other; None where others hold it too."""
        parts = pieces(self.bodies[int(self._modules.body[joint.module])], [j for j in self.docks.joints if j != joint])
        if len(parts) == 1:
            return None
        free = [piece for piece in parts if self._held.isdisjoint(piece)] or parts
        return hanging(self._draws, self._modules, next((p for p in free if joint.other in p), free[0]), self.spec.gravity)

    def _touch_on(self, members: Sequence[int]) -> np.ndarray:
        """(b, 6) what walls and other bodies do to these modules of one body, in that body's row, body frame."""
        chosen = np.zeros(len(self.vehicles), dtype=np.int64)
        chosen[list(members)] = 1
        found = self._body_arrays._replace(wrench=np.zeros((len(self.bodies), 6)))
        touch(found, self._modules, self.docks.faces, self._water, chosen)
        return found.wrench

    def clamp(self, body: int) -> None:
        """Holds a body where it is, by its leader, whatever joins it; `load` then says with what force."""
        self._held.add(self.bodies[body][0])
        self._body_arrays.clamped[body] = 1
        self._body_arrays.state[body, 7:13] = 0.0

    def load(self, body: int) -> np.ndarray:
        """(6,) wrench about O that the body gives to whatever clamps it, body frame; zeros for a body that swims.

        The water that flows around it adds what its momentum asks for: the force of its acceleration, and the Munk moment.
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
        """(b, 6) linear and angular momentum about the world's origin of each body with the water it moves, world."""
        out = np.empty((len(self.bodies), 6))
        for b, x in enumerate(self._body_arrays.state[: len(self.bodies)]):
            r_wb = rotations.to_matrix(x[3:7])
            flow = np.concatenate([r_wb.T @ self._flow(), np.zeros(3)])
            total = self._body_arrays.rigid[b] @ x[7:] + self._body_arrays.added[b] @ (x[7:] - flow)
            p = r_wb @ total[:3]
            out[b] = np.concatenate([p, r_wb @ total[3:] + np.cross(x[:3], p)])
        return out


def _moved_origin(x: np.ndarray, r: np.ndarray) -> np.ndarray:
    """(13,) the same motion told of the point r (3,) of the body frame in place of its origin."""
    moved = x.copy()
    moved[:3] += rotations.rotate(x[3:7].copy(), r.copy())
    moved[7:10] += np.cross(x[10:13], r)
    return moved
