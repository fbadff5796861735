"""Plans a dock or an undock: the geometry of the two faces, and the resulting bodies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from firmware_py.core import rotations
from firmware_py.core.body import Body
from firmware_py.core.docking_plan import DockPlan, UndockPlan
from firmware_py.core.joints import joints_of, modules_of, turned
from firmware_py.core.names import name_module, name_modules, name_pair
from firmware_py.core.types import DockRequest
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import FACE_NORMALS, Vehicle, face_mismatch
from firmware_py.prepare.assembly import PITCH_M, assemble
from firmware_py.prepare.joints import connected_to
from firmware_py.prepare.lattice import MATRICES, QUATERNIONS, nearest


def plan_dock(request: DockRequest, active: Body, target: Body, vehicles: Sequence[Vehicle], pitch_m: float = PITCH_M) -> DockPlan:
    """The plan of a dock.

    Args:
        request: the faces that are to meet. Of the four rotations that the pins allow, number 0 turns the active module least relative to
            the target module; the others follow in quarter turns about the target face's normal.
        active, target: the two present bodies.
        vehicles: by fleet index.

    Raises:
        DescriptionError: the two faces are not a probe and a drogue, the bodies would overlap, or elsewhere a probe would meet no drogue;
            names the modules.
    """
    faces, target_faces = vehicles[request.module].faces, vehicles[request.target_module].faces
    if why := face_mismatch(faces, request.face, target_faces, request.target_face):
        raise DescriptionError(f"{name_module(request.module)} cannot dock to {name_module(request.target_module)}: {why}")
    turn_t = _turn_of(target, request.target_module)
    normal = _rounded(turn_t @ FACE_NORMALS[request.target_face])
    new_turn = _mated(turn_t, request, normal)
    cell = _cell_of(target, request.target_module) + normal
    change = new_turn @ _turn_of(active, request.module).T
    moved = [cell + _rounded(change @ (c - _cell_of(active, request.module))) for c in active.cells]
    turns = [nearest(change @ _turn_of(active, m)) for m in active.modules]
    modules = (*target.modules, *active.modules)
    merged = assemble(
        [*target.cells, *moved],
        [*(nearest(_turn_of(target, m)) for m in target.modules), *turns],
        [vehicles[m] for m in modules],
        modules,
        pitch_m,
    )
    closes = [joint.request for joint in joints_of(merged) if len(modules_of(joint.request).intersection(active.modules)) == 1]
    return DockPlan(
        request=request,
        closes=tuple(closes),
        merged=merged,
        axis_t=FACE_NORMALS[request.target_face].copy(),
        place_t=FACE_NORMALS[request.target_face] * pitch_m,
        q_ta=np.array(QUATERNIONS[nearest(turn_t.T @ new_turn)]),
    )


def plan_undock(
    request: DockRequest,
    whole: Body,
    vehicles: Sequence[Vehicle],
    pitch_m: float = PITCH_M,
    lost: Sequence[DockRequest] = (),
) -> UndockPlan:
    """The plan of an undock at the joint between two modules of one body.

    Where other joints also connect the two modules, as in a ring, only the requested module leaves, by all of its joints.

    Args:
        lost: open joints of a body that has come apart; no others are then opened.

    Raises:
        DescriptionError: there is no such joint, other joints still connect the pieces, or neighbours block every way out.
    """
    near, far = request.target_module, request.module
    joints = [joint.request for joint in joints_of(whole)]
    wanted, pairs = modules_of(request), [modules_of(joint) for joint in joints]
    if wanted not in pairs:
        raise DescriptionError(f"{name_pair(near, far)} are not docked to each other")
    opened = [wanted, *(modules_of(joint) for joint in lost)]
    piece = connected_to(far, [pair for pair in pairs if pair not in opened])
    if near in piece and not lost:
        piece = {far}
    stays = [m for m in whole.modules if m not in piece]
    if near in piece or connected_to(near, [pair for pair in pairs if not pair & piece]) != set(stays):
        raise DescriptionError(f"{name_pair(near, far)} are also held together by other modules: undock those first")
    opens = [joint if joint.module in piece else turned(joint) for joint in joints if len(modules_of(joint) & piece) == 1]
    opens.sort(key=lambda joint: modules_of(joint) != wanted)
    way = _away(whole, piece, [_cell_of(whole, joint.module) - _cell_of(whole, joint.target_module) for joint in opens])
    leaves = [m for m in whole.modules if m in piece]
    return UndockPlan(tuple(opens), _part(whole, stays, vehicles, pitch_m), _part(whole, leaves, vehicles, pitch_m), way)


def _part(whole: Body, modules: Sequence[int], vehicles: Sequence[Vehicle], pitch_m: float) -> Body:
    """The body that these modules of a whole are on their own."""
    cells = np.array([_cell_of(whole, m) for m in modules])
    turns = [nearest(_turn_of(whole, m)) for m in modules]
    return assemble(cells, turns, [vehicles[m] for m in modules], modules, pitch_m)


def _away(whole: Body, piece: set[int], steps: Sequence[np.ndarray]) -> np.ndarray:
    """(3,) unit vector along which a piece leaves: along its joints, or else along the free axis that points most away from the rest.

    Raises:
        DescriptionError: neighbours block every way; names them.
    """
    inside = np.array([m in piece for m in whole.modules])
    outward = whole.cells[inside].mean(axis=0) - whole.cells[~inside].mean(axis=0)
    along_joints = np.sum(steps, axis=0)
    ways = ([along_joints] if along_joints.any() else []) + sorted(FACE_NORMALS, key=lambda normal: -float(normal @ outward))
    around: set[int] = set()
    for way in ways:
        met = _met(whole, inside, way)
        if not met:
            return np.asarray(way / np.linalg.norm(way))
        around |= met
    who, by = name_modules(sorted(piece)), name_modules(sorted(around))
    raise DescriptionError(f"{who} cannot leave, enclosed by {by}: undock one of those first")


def _met(whole: Body, inside: np.ndarray, way: np.ndarray) -> set[int]:
    """Modules of the rest with which the modules `inside` (n,) would collide within the first pitch along `way` (3,)."""
    offset = whole.cells[~inside] - whole.cells[inside][:, None]
    met = np.all((offset == 0) | (offset == np.sign(way)), axis=-1).any(axis=0)
    return {whole.modules[i] for i in np.flatnonzero(~inside)[met]}


def _mated(turn_t: np.ndarray, request: DockRequest, normal: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of the active module in the target's lattice, its face against the target's."""
    fits = [m for m in MATRICES if np.array_equal(_rounded(m @ FACE_NORMALS[request.face]), -normal)]
    least = max(fits, key=lambda m: float(np.trace(turn_t.T @ m)))
    quarter = rotations.to_matrix(rotations.exp(normal * (0.5 * np.pi * request.quarter_turns)))
    return np.asarray(MATRICES[nearest(quarter @ least)])


def _turn_of(body: Body, module: int) -> np.ndarray:
    """(3, 3) module frame to body frame."""
    return np.asarray(rotations.to_matrix(np.ascontiguousarray(body.q_bm[body.modules.index(module)])))


def _cell_of(body: Body, module: int) -> np.ndarray:
    return np.asarray(body.cells[body.modules.index(module)])


def _rounded(vector: np.ndarray) -> np.ndarray:
    return np.asarray(np.rint(vector), dtype=np.int64)
