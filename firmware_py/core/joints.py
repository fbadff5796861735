"""Joints: pairs of faces, a probe in a drogue, by which the modules of a body hold each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.docking_detector import FacePair
from firmware_py.core.rotations import conjugate, multiply, rotate_back
from firmware_py.core.types import FACES, RELAY_OFF, RELAY_PULL, DockRequest
from firmware_py.description.vehicle import FACE_NORMALS


class Joint(NamedTuple):
    """Two faces that hold modules of one body together."""

    request: DockRequest
    offset: np.ndarray
    """(3,) centre of the request's module in the frame of the target module, m."""
    q_ta: np.ndarray
    """(4,) frame of the request's module to frame of the target module."""

    @property
    def pair(self) -> FacePair:
        """The joint as a pair of faces for the docking detector."""
        r = self.request
        return FacePair(r.target_module, r.target_face, r.module, r.face, self.offset, self.q_ta)


def sides(request: DockRequest) -> tuple[tuple[int, int], tuple[int, int]]:
    """Module and face of each side: fleet index, and 0 to 5 for A to F."""
    return (request.module, request.face), (request.target_module, request.target_face)


def turned(request: DockRequest) -> DockRequest:
    """The same joint seen from its other side."""
    return DockRequest(request.target_module, request.target_face, request.module, request.face)


def modules_of(request: DockRequest) -> frozenset[int]:
    """Fleet indices of the modules of both sides."""
    return frozenset((request.module, request.target_module))


def joints_of(body: Body) -> list[Joint]:
    """Every joint of a body, in the order of its modules: neighbours with a probe on one of the facing sides and a drogue on the other."""
    joints: list[Joint] = []
    at = {tuple(cell): i for i, cell in enumerate(body.cells.tolist())}
    for i, cell in enumerate(body.cells):
        neighbours = (at.get(tuple(place), -1) for place in (cell + FACE_NORMALS).tolist())
        joints += [_joint(body, i, j) for j in sorted(neighbours) if j > i]
    faces = dict(zip(body.modules, body.faces, strict=True))
    return [joint for joint in joints if {faces[m][f] for m, f in sides(joint.request)} == {"P", "D"}]


def holding(body: Body, joints: Sequence[Joint]) -> list[tuple[int, ...]]:
    """Relay states of each module of a body: PULL on the faces of its joints, OFF on all others."""
    held = {side for joint in joints for side in sides(joint.request)}
    return [tuple(RELAY_PULL if (m, face) in held else RELAY_OFF for face in range(FACES)) for m in body.modules]


def _joint(body: Body, i: int, j: int) -> Joint:
    """The joint between modules i and j of the body, which are neighbours."""
    step = (body.cells[j] - body.cells[i]).astype(np.float64)
    q_bi, q_bj = (np.ascontiguousarray(body.q_bm[k]) for k in (i, j))
    near = int(np.argmax(FACE_NORMALS @ rotate_back(q_bi, step)))
    far = int(np.argmax(FACE_NORMALS @ rotate_back(q_bj, -step)))
    offset = rotate_back(q_bi, body.r_bm[j] - body.r_bm[i])
    return Joint(DockRequest(body.modules[j], far, body.modules[i], near), offset, multiply(conjugate(q_bi), q_bj))
