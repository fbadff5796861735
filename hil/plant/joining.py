"""Merging and splitting bodies: new seats of their modules, and the motion that conserves momentum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.vehicle import FACE_NORMALS
from hil.plant.bodies import Bodies, Modules
from hil.plant.docking import Joint
from hil.plant.draw import ModuleDraw, mass_about_body_origin
from hil.plant.lattice import QUATERNIONS, Place, nearest


def seats_after_join(
    places: Sequence[Place], modules: Modules, joint: Joint, kept: int, moved: Sequence[int], q_kl: np.ndarray
) -> list[Place]:
    """Returns the seats of all modules after the body of `moved` has joined the body of module `kept`, face to face.

    Args:
        q_kl: (4,) attitude of the moved body's frame in the kept body's, rounded here to the nearest lattice rotation.
    """
    near_face, far, far_face = (
        (joint.face, joint.other, joint.other_face) if kept == joint.module else (joint.other_face, joint.module, joint.face)
    )
    lattice = QUATERNIONS[nearest(q_kl)].copy()
    turn = rotations.to_matrix(lattice)
    normal = modules.turn[kept] @ FACE_NORMALS[near_face]
    reach = 0.5 * (modules.size[kept, near_face // 2] + modules.size[far, far_face // 2])
    origin = places[kept].position + reach * normal - turn @ places[far].position
    seats = list(places)
    for m in moved:
        quaternion = QUATERNIONS[nearest(rotations.multiply(lattice, places[m].quaternion))].copy()
        seats[m] = Place(origin + turn @ places[m].position, quaternion)
    return seats


def pieces(members: Sequence[int], joints: Sequence[Joint]) -> list[tuple[int, ...]]:
    """Splits the modules of a body into connected pieces; the modules of each piece are in ascending order."""
    linked: Mapping[int, set[int]] = {m: set() for m in members}
    for joint in joints:
        if joint.module in linked and joint.other in linked:
            linked[joint.module].add(joint.other)
            linked[joint.other].add(joint.module)
    left, found = set(members), []
    while left:
        front = [min(left)]
        piece = set(front)
        while front:
            fresh = linked[front.pop()] - piece
            piece |= fresh
            front += fresh
        left -= piece
        found.append(tuple(sorted(piece)))
    return found


def motion_of(bodies: Bodies, b: int, momentum: np.ndarray, flow_w: np.ndarray) -> None:
    """Sets the velocity of body b, whose pose is already set, from its momentum (6,) about the world's origin, world."""
    x = bodies.state[b]
    turn = rotations.to_matrix(x[3:7].copy())
    p = turn.T @ momentum[:3]
    spin = turn.T @ (momentum[3:] - np.cross(x[:3], momentum[:3]))
    carried_along = bodies.added[b] @ np.concatenate([turn.T @ flow_w, np.zeros(3)])
    x[7:13] = np.linalg.solve(bodies.rigid[b] + bodies.added[b], np.concatenate([p, spin]) + carried_along)


def centre_of(bodies: Bodies, b: int) -> np.ndarray:
    """(3,) centre of mass of body b with its entrained water, body frame."""
    rigid = bodies.rigid[b]
    return np.array([rigid[5, 1], rigid[3, 2], rigid[4, 0]]) / rigid[0, 0]


class SupportedPart(NamedTuple):
    """Part of a body held by a single joint: its modules, mass and weight. Body frame, about O."""

    members: tuple[int, ...]
    mass: np.ndarray
    """(6, 6) rigid plus added mass."""
    weight_n: float
    """Weight in water: weight minus buoyancy."""
    weight_at: np.ndarray
    """(3,) N m: first moment of that weight; its moment is the cross product with the direction down."""


def supported_part(draws: Sequence[ModuleDraw], modules: Modules, members: Sequence[int], gravity: float) -> SupportedPart:
    """Returns the part of a body that consists of these modules."""
    mass, weight_n, weight_at = np.zeros((6, 6)), 0.0, np.zeros(3)
    for m in members:
        d, r, turn = draws[m], modules.position[m], modules.turn[m]
        mass += mass_about_body_origin(d.rigid + np.diag(d.added), r, turn)
        w = d.mass * gravity
        weight_n += w - d.buoyancy_n
        weight_at += w * (r + turn @ d.com) - d.buoyancy_n * (r + turn @ d.buoyancy_at)
    return SupportedPart(tuple(members), mass, weight_n, weight_at)


def force_needed(part: SupportedPart, x: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """(6,) wrench about O, body frame, that part of a body needs in addition to its weight for the present motion.

    x, rate: (13,) state of the body and its derivative. Assumes still water and neglects drag, which acts on all modules and is small
    at docking speeds.
    """
    down = rotations.to_matrix(x[3:7].copy())[2]
    p = part.mass @ x[7:13]
    v, omega = x[7:10].copy(), x[10:13].copy()
    need = part.mass @ rate[7:13]
    need[:3] += rotations.cross(omega, p[:3]) - part.weight_n * down
    need[3:] += rotations.cross(omega, p[3:]) + rotations.cross(v, p[:3]) - rotations.cross(part.weight_at, down)
    return np.asarray(need)
