"""A camera that measures the pose of tags in the tank: free-running, delayed, noisy, and occluded by hulls.

The pose of a planar tag is ambiguous: the true pose looks nearly the same as the one turned by 180 deg about the line of sight
and by 180 deg about the tag's own normal. Both coincide when the tag is seen face-on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from firmware_py.core import rotations
from firmware_py.description.vehicle import Tag, Vehicle
from hil.plant.draw import Noise, stream, uniforms
from hil.plant.sight import look, solid_boxes
from hil.plant.spec import CameraPose, SensorSpec
from hil.plant.world import World

SECOND_HAND = 0
"""Quality of a tag located in the world by way of another tag."""
ALL_TAGS = 1 << 16
"""Key of the first random stream of the cameras that read every tag."""
HALF_TURN_Z = np.array([0.0, 0.0, 0.0, 1.0])


class Sighting(NamedTuple):
    """One tag in one picture."""

    module: int
    tag_id: int
    capture_ns: int
    p_wt: np.ndarray
    q_wt: np.ndarray
    quality: int
    carrier: int = -1
    """Module that carries the camera; the pose is in its frame. -1: fixed camera, pose in the world frame."""


class _Drawn(NamedTuple):
    """Random errors of one sighting."""

    noise: np.ndarray
    lost: bool
    flipped: bool


class _Errors:
    """Noise, losses and flips, each from its own random stream."""

    def __init__(self, spec: SensorSpec, seed: int, key: int) -> None:
        self._spec = spec
        self._noise = Noise(stream(seed, "tag_noise", key), 6)
        self._loss, self._flip = uniforms(stream(seed, "tag_loss", key)), uniforms(stream(seed, "tag_flip", key))

    def draw(self) -> _Drawn:
        """Returns the next errors; every call consumes the same count of random numbers."""
        lost = next(self._loss) < self._spec.tag_dropped
        return _Drawn(self._noise.take(), lost, next(self._flip) < self._spec.tag_flipped)


class Camera:
    """Takes a picture whenever one is due and reports the readable tags: the best one of each module, or all."""

    def __init__(
        self,
        pose: CameraPose,
        spec: SensorSpec,
        vehicles: Sequence[Vehicle],
        tags: Sequence[int],
        seed: int,
        index: int = 0,
        carrier: int = -1,
    ) -> None:
        self.carrier = carrier
        self._pose, self._spec = pose, spec
        self._axis = pose.axis / np.linalg.norm(pose.axis)
        self._view = math.cos(math.radians(pose.half_view_deg))
        self._least = math.cos(math.radians(spec.tag_incidence_deg))
        self._tags = [(m, t) for m, v in enumerate(vehicles) for t in v.tag if t.id in tags]
        self._rows = _tag_rows(self._tags)
        self._places = [(np.array(t.position_m), np.array(t.quaternion)) for _, t in self._tags]
        self._boxes = solid_boxes(vehicles)
        self._period_ns = round(1e9 / spec.tag_rate_hz)
        # A carried camera is triggered together with the first one: the node needs both pictures from the same instant.
        phase = spec.tag_phase * stream(seed, "tag_phase", 0 if carrier >= 0 else index).uniform()
        self.next_ns = round(phase * self._period_ns)
        # One stream per module and camera (and per tag, where all are read), so adding one leaves the others unchanged.
        self._errors = [_Errors(spec, seed, index * 64 + m) for m in range(len(vehicles))]
        self._tag_errors = [_Errors(spec, seed, ALL_TAGS + (index * 64 + m) * 16 + t.id) for m, t in self._tags]
        self._before, self._before_ns = np.zeros((len(vehicles), 16)), 0

    def watch(self, world: World) -> list[Sighting]:
        """Returns the sightings of all pictures due up to the world's time. Call at the start and after every advance."""
        before, before_ns = self._before, self._before_ns
        self._before, self._before_ns = world.seen(), world.time_ns
        found: list[Sighting] = []
        while self.next_ns <= world.time_ns:
            elapsed_s, span_s = 1e-9 * (self.next_ns - before_ns), 1e-9 * (world.time_ns - before_ns)
            poses = _between(before, self._before, elapsed_s, span_s)
            found += self._picture(poses, self.next_ns)
            self.next_ns += self._period_ns
        return found

    def _picture(self, poses: np.ndarray, capture_ns: int) -> list[Sighting]:
        """Returns the readable tags with their errors. Consumes the same random numbers whatever is visible."""
        looked = np.empty(len(self._tags))
        eye, axis = self._eye(poses)
        look(tuple(eye.tolist()), tuple(axis.tolist()), self._view, poses, self._rows, self._boxes, looked)
        cosines = looked.tolist()
        chosen = range(len(self._tags)) if self._spec.tag_all else self._best(cosines)
        found = []
        for k, errors in zip(chosen, self._tag_errors if self._spec.tag_all else self._errors, strict=True):
            drawn = errors.draw()
            if k >= 0 and cosines[k] > self._least and not drawn.lost and self._tags[k][0] != self.carrier:
                m, tag = self._tags[k]
                p, q = placed(poses[m, :3], poses[m, 3:], *self._places[k])
                p, q = self._blur(p, q, drawn, eye, axis)
                if self.carrier >= 0:
                    p, q = _seen_from(poses[self.carrier], p, q)
                found.append(Sighting(m, tag.id, capture_ns, p, q, max(1, round(7 * cosines[k])), self.carrier))
        return found

    def _best(self, cosines: Sequence[float]) -> list[int]:
        """Index of the tag of each module that faces the camera most directly; -1 for a module without tags."""
        best = [-1] * len(self._errors)
        for k, (m, _) in enumerate(self._tags):
            if best[m] < 0 or cosines[k] > cosines[best[m]]:
                best[m] = k
        return best

    def _eye(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position of the lens and optical axis, world."""
        if self.carrier < 0:
            return self._pose.position_m, self._axis
        p, q = poses[self.carrier, :3], poses[self.carrier, 3:].copy()
        return p + rotations.rotate(q, np.array(self._pose.position_m)), rotations.rotate(q, self._axis.copy())

    def _blur(
        self, p: np.ndarray, q: np.ndarray, drawn: _Drawn, eye: np.ndarray, axis: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the measured pose of a tag: the true pose, flipped where drawn, with noise."""
        if drawn.flipped:
            sight = (eye - p) / np.linalg.norm(eye - p)
            q = rotations.multiply(rotations.multiply(np.concatenate([[0.0], sight]), q), HALF_TURN_Z)
        spec = self._spec
        sigma = (spec.tag_sigma_m, spec.tag_sigma_axis_m, math.radians(spec.tag_sigma_deg))
        return _smear(p, q, drawn.noise, axis, *sigma)


@njit("Tuple((float64[::1],float64[::1]))(float64[::1],float64[::1],float64[::1],float64[::1],float64,float64,float64)", cache=True)
def _smear(p, q, noise, axis, across, along, turn):
    """Adds six standard normal numbers to a pose, scaled by `across` and `along` the optical axis (m) and `turn` (rad)."""
    depth = axis[0] * noise[0] + axis[1] * noise[1] + axis[2] * noise[2]
    q = rotations.multiply(q, rotations.exp(turn * noise[3:]))
    return p + across * noise[:3] + (along - across) * depth * axis, rotations.normalise(q)


def _seen_from(pose: np.ndarray, p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transforms a world pose into the frame of a module at `pose` (7,)."""
    back = rotations.conjugate(pose[3:].copy())
    return rotations.rotate(back, p - pose[:3]), rotations.multiply(back, q)


def in_the_world(relative: Sighting, carrier: Sighting, tag: Tag) -> Sighting:
    """Transforms a carried camera's sighting into the world, by a sighting of the carrier, world frame, from the same instant.

    Args:
        carrier: sighting of `tag` on the module that carries the camera. Its error propagates into the result.
    """
    back = rotations.conjugate(np.array(tag.quaternion))
    q_wc = rotations.multiply(carrier.q_wt, back)
    p_wc = carrier.p_wt - rotations.rotate(q_wc, np.array(tag.position_m))
    p = p_wc + rotations.rotate(q_wc, relative.p_wt)
    q = rotations.normalise(rotations.multiply(q_wc, relative.q_wt))
    return relative._replace(p_wt=p, q_wt=q, quality=SECOND_HAND, carrier=-1)


def _tag_rows(tags: Sequence[tuple[int, Tag]]) -> np.ndarray:
    """(t, 7) argument `tags` of `sight.look`; a tag's z axis points into the face."""
    rows = [[m, *t.position_m, *-rotations.to_matrix(np.array(t.quaternion))[:, 2]] for m, t in tags]
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


@njit("Tuple((float64[::1],float64[::1]))(float64[::1],float64[::1],float64[::1],float64[::1])", cache=True)
def placed(p_wm, q_wm, position, quaternion):
    """World pose of an object at `position` (3,), m, with attitude `quaternion` (4,) on a module; a tag's z axis points into its face."""
    return p_wm + rotations.rotate(q_wm, position), rotations.multiply(q_wm, quaternion)


@njit("float64[:,::1](float64[:,::1],float64[:,::1],float64,float64)", cache=True)
def _between(before, after, elapsed_s, span_s):
    """(m, 7) poses `elapsed_s` after `before`; `after` is `span_s` later. Cubic in position, constant angular rate.

    before, after: (m, 16) from `World.seen`.
    """
    out = np.empty((before.shape[0], 7))
    s = elapsed_s / span_s if span_s > 0.0 else 1.0
    r = 1.0 - s
    for m in range(out.shape[0]):
        a, b = before[m], after[m]
        for i in range(3):
            start, end = (1 + 2 * s) * a[i] + s * span_s * a[7 + i], (3 - 2 * s) * b[i] - r * span_s * b[7 + i]
            out[m, i] = r * r * start + s * s * end
        if s >= 1.0:
            out[m, 3:] = b[3:7]
        else:
            q = a[3:7].copy()
            out[m, 3:] = rotations.multiply(q, rotations.exp(s * rotations.difference(b[3:7].copy(), q)))
    return out
