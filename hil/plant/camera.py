"""A camera that finds the pose of tags in the tank: free-running, late, noisy, and blind where a hull is in the way.

A planar tag has two poses that look nearly alike: the true one, and that turned half round about the line of sight and
half round about the tag's own normal. Face-on both coincide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.vehicle import Tag, Vehicle
from hil.plant.draw import stream
from hil.plant.sensors import Noise
from hil.plant.spec import CameraPose, SensorSpec
from hil.plant.world import World

HALF_TURN_Z = np.array([0.0, 0.0, 0.0, 1.0])


class Sighting(NamedTuple):
    """One tag in one picture."""

    module: int
    tag_id: int
    capture_ns: int
    p_wt: np.ndarray
    q_wt: np.ndarray
    quality: int


class _Seen(NamedTuple):
    """A module at the time of a picture."""

    p_wm: np.ndarray
    q_wm: np.ndarray


class Camera:
    """Takes a picture whenever one is due and reports the best tag of every module that it can read."""

    def __init__(
        self,
        pose: CameraPose,
        spec: SensorSpec,
        vehicles: Sequence[Vehicle],
        tags: Sequence[int],
        seed: int,
        index: int = 0,
    ) -> None:
        self._pose, self._spec = pose, spec
        self._axis = pose.axis / np.linalg.norm(pose.axis)
        self._sizes = [0.5 * v.hull.size_m for v in vehicles]
        self._tags = [[t for t in v.tag if t.id in tags] for v in vehicles]
        self._period_ns = round(1e9 / spec.tag_rate_hz)
        phase = spec.tag_phase * stream(seed, "tag_phase", index).uniform()
        self.next_ns = round(phase * self._period_ns)
        # One stream per module and camera, so that a module more changes nothing for the others.
        key = [index * 64 + m for m in range(len(vehicles))]
        self._noise = [Noise(stream(seed, "tag_noise", k), 6) for k in key]
        self._loss = [stream(seed, "tag_loss", k) for k in key]
        self._flip = [stream(seed, "tag_flip", k) for k in key]
        self._before, self._before_ns = np.zeros((len(vehicles), 16)), 0

    def watch(self, world: World) -> list[Sighting]:
        """Sightings of all pictures due up to the world's time. To be called at the start and after every advance."""
        before, before_ns = self._before, self._before_ns
        self._before, self._before_ns = world.seen(), world.time_ns
        found = []
        while self.next_ns <= world.time_ns:
            elapsed_s, span_s = 1e-9 * (self.next_ns - before_ns), 1e-9 * (world.time_ns - before_ns)
            modules = [_between(a, b, elapsed_s, span_s) for a, b in zip(before, self._before, strict=True)]
            for m in range(len(modules)):
                sighting = self._look(modules, m, self.next_ns)
                if sighting is not None:
                    found.append(sighting)
            self.next_ns += self._period_ns
        return found

    def _look(self, modules: Sequence[_Seen], m: int, capture_ns: int) -> Sighting | None:
        """The best readable tag of module m with its errors, or None. Draws the same numbers whatever it sees."""
        noise, lost = self._noise[m].take(), self._loss[m].random() < self._spec.tag_dropped
        flipped = self._flip[m].random() < self._spec.tag_flipped
        best, cosine = None, math.cos(math.radians(self._spec.tag_incidence_deg))
        for tag in self._tags[m]:
            seen = self._incidence(modules, m, tag)
            if seen > cosine:
                best, cosine = tag, seen
        if best is None or lost:
            return None
        p, q = tag_pose(modules[m].p_wm, modules[m].q_wm, best)
        if flipped:
            sight = (self._pose.position_m - p) / np.linalg.norm(self._pose.position_m - p)
            q = rotations.multiply(rotations.multiply(np.concatenate([[0.0], sight]), q), HALF_TURN_Z)
        spec = self._spec
        p = p + spec.tag_sigma_m * noise[:3]
        p = p + self._axis * (self._axis @ noise[:3]) * (spec.tag_sigma_axis_m - spec.tag_sigma_m)
        q = rotations.multiply(q, rotations.exp(math.radians(spec.tag_sigma_deg) * noise[3:]))
        return Sighting(m, best.id, capture_ns, p, rotations.normalise(q), round(7 * cosine))

    def _incidence(self, modules: Sequence[_Seen], m: int, tag: Tag) -> float:
        """Cosine between the tag's outward normal and the line of sight; -1 where it is out of view or covered."""
        p, q = tag_pose(modules[m].p_wm, modules[m].q_wm, tag)
        line = self._pose.position_m - p
        sight = line / np.linalg.norm(line)
        if -sight @ self._axis < math.cos(math.radians(self._pose.half_view_deg)):
            return -1.0
        for other, seen in enumerate(modules):
            if other != m and crosses_box(p, self._pose.position_m, seen.p_wm, seen.q_wm, self._sizes[other]):
                return -1.0
        return float(-rotations.to_matrix(q)[:, 2] @ sight)


def tag_pose(p_wm: np.ndarray, q_wm: np.ndarray, tag: Tag) -> tuple[np.ndarray, np.ndarray]:
    """World pose of a tag on a module; its z axis points into the face."""
    return p_wm + rotations.rotate(q_wm, np.array(tag.position_m)), rotations.multiply(q_wm, np.array(tag.quaternion))


def crosses_box(a: np.ndarray, b: np.ndarray, p: np.ndarray, q: np.ndarray, half: np.ndarray) -> bool:
    """Whether the segment from a to b crosses the box of half edges `half` at pose p, q (slab test)."""
    r = rotations.to_matrix(q)
    start, step = r.T @ (a - p), r.T @ (b - a)
    enter, leave = 0.0, 1.0
    for i in range(3):
        if abs(step[i]) < 1e-12:
            if abs(start[i]) > half[i]:
                return False
            continue
        near, far = sorted(((-half[i] - start[i]) / step[i], (half[i] - start[i]) / step[i]))
        enter, leave = max(enter, near), min(leave, far)
    return enter < leave


def _between(a: np.ndarray, b: np.ndarray, elapsed_s: float, span_s: float) -> _Seen:
    """Pose `elapsed_s` after a, where b is `span_s` after a: cubic in position, constant rate of turn.

    a, b: (16,) rows of `World.seen`.
    """
    if span_s <= 0.0:
        return _Seen(b[:3], b[3:7])
    s = elapsed_s / span_s
    r = 1.0 - s
    p = r * r * ((1 + 2 * s) * a[:3] + s * span_s * a[7:10]) + s * s * ((3 - 2 * s) * b[:3] - r * span_s * b[7:10])
    turned = rotations.difference(b[3:7], a[3:7])
    return _Seen(p, rotations.multiply(a[3:7], rotations.exp(s * turned)))
