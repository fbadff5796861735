"""Random deviations from the vehicle file in one run, drawn per seed, each source of error from its own stream.

The magnitude only scales numbers that are always drawn, so switching one error off changes no other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from firmware_py.description.vehicle import Payload, Vehicle
from hil.plant.spec import WorldSpec

SOURCES = (
    "gusts", "buoyancy", "righting", "trim", "mass", "inertia", "drag", "gain", "deadband", "gyro", "accel", "depth",
    "tag_phase", "tag_noise", "tag_loss", "tag_flip", "power", "rpm", "dock", "contact", "faults",
    "shape", "jam", "load", "start", "fuzz", "estop", "push", "operator",
)  # fmt: skip
"""Names of the streams. Append new ones at the end: the order determines what a seed yields."""


def stream(seed: int, source: str, module: int = 0) -> np.random.Generator:
    """Returns the generator for one source of error of one module, as nested SeedSequence(seed).spawn calls would create it.

    Raises ValueError for a source without a stream.
    """
    if source not in SOURCES:
        raise ValueError(f"no stream is called {source!r}; append the name to SOURCES")
    sequence = np.random.SeedSequence(seed, spawn_key=(SOURCES.index(source), module))
    return np.random.Generator(np.random.PCG64(sequence))


@dataclass(frozen=True, slots=True, eq=False)
class ModuleDraw:
    """True parameters of one simulated module.

    Attributes:
        dry_kg, entrained_kg: masses.
        com: (3,) centre of mass, where the weight of both acts, module frame.
        buoyancy_at: (3,) centre of buoyancy of the whole displaced volume, module frame.
        buoyancy_n: buoyancy that acts there.
        inertia: (3, 3) of robot and entrained water about `com`.
        added: (6,) added mass about the hull centre.
        drag: (5,) coefficients face-on, edge-on, of rotation about x, y, z, unused by a vehicle with `quadratic`.
        linear, quadratic: (6,) published damping, with the same errors as face-on and rotational drag.
        gain, deadband_n: (t,) of each thruster.
        payload: payloads according to the vehicle file.
    """

    dry_kg: float
    entrained_kg: float
    com: np.ndarray
    buoyancy_at: np.ndarray
    buoyancy_n: float
    inertia: np.ndarray
    added: np.ndarray
    drag: np.ndarray
    linear: np.ndarray
    quadratic: np.ndarray
    gain: np.ndarray
    deadband_n: np.ndarray
    payload: tuple[Payload, ...] = ()

    @property
    def mass(self) -> float:
        """Mass of robot and entrained water, kg."""
        return self.dry_kg + self.entrained_kg

    @property
    def rigid(self) -> np.ndarray:
        """(6, 6) mass matrix of robot, payloads and their entrained water about the hull's centre, module frame."""
        total = rigid_matrix(self.mass, self.com, self.inertia)
        for load in self.payload:
            mass = load.dry_kg + load.entrained_kg
            squares = np.square(load.size_m)
            total = total + rigid_matrix(mass, load.position_m, np.diag(mass / 12.0 * (squares.sum() - squares)))
        return total


def draw_module(vehicle: Vehicle, spec: WorldSpec, seed: int, module: int) -> ModuleDraw:
    """Draws the parameters of the module with index `module` in the run `seed`."""
    count, inertial = len(vehicle.thruster), vehicle.inertial

    def spread(source: str, share: float, size: int) -> np.ndarray:
        return 1.0 + share * stream(seed, source, module).uniform(-1.0, 1.0, size)

    mass = spread("mass", spec.mass_spread, 4)
    turn = spread("inertia", spec.inertia_spread, 6)
    dry, entrained = inertial.dry_kg * mass[0], inertial.entrained_kg * mass[0]
    sign = -1.0 if stream(seed, "buoyancy", module).uniform() < 0.5 else 1.0
    arm = inertial.righting_arm_m + spec.righting_spread_m * stream(seed, "righting", module).uniform(-1.0, 1.0)
    shift = np.append(spec.trim_m * stream(seed, "trim", module).uniform(-1.0, 1.0, 2), 0.0)
    drag, factor = vehicle.drag, spread("drag", spec.drag_spread, 5)
    damping = factor[[0, 0, 0, 2, 3, 4]]  # along each axis as face-on, about each as its rotation
    root = np.sqrt(turn[:3])
    deadband = spec.deadband_low_n + (spec.deadband_high_n - spec.deadband_low_n) * stream(
        seed, "deadband", module
    ).uniform(0, 1, count)
    return ModuleDraw(
        dry_kg=dry,
        entrained_kg=entrained,
        com=inertial.com_m + shift * inertial.dry_kg / inertial.wet_kg,
        buoyancy_at=inertial.com_m - np.array([0.0, 0.0, arm]),
        buoyancy_n=(dry + entrained) * spec.gravity + sign * spec.buoyancy_error_n,
        inertia=inertial.inertia * np.outer(root, root),
        added=inertial.added * np.concatenate([mass[1:], turn[3:]]),
        drag=np.array([drag.cd_face, drag.cd_edge, *(drag.rotational_cd,) * 3]) * factor,
        linear=drag.linear * damping,
        quadratic=(drag.quadratic if drag.quadratic.size else np.zeros(6)) * damping,
        gain=spread("gain", spec.gain_spread, count),
        deadband_n=deadband,
        payload=vehicle.payload,
    )


def skew(a: np.ndarray) -> np.ndarray:
    """(3, 3) S with S b = a x b."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def rigid_matrix(mass: float, com: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """(6, 6) mass matrix of a body about O; `com` is its centre of mass from O, `inertia` is about that centre."""
    s = skew(com)
    return np.block([[mass * np.eye(3), -mass * s], [mass * s, inertia - mass * s @ s]])


def mass_about_body_origin(matrix: np.ndarray, position: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Transforms a (6, 6) mass matrix about a module's origin to O of its body: H^T M H.

    H maps [v; w] of O in the body frame to [v; w] of the module in the module frame: v_m = T^T (v + w x r), w_m = T^T w.
    """
    h = np.block([[turn.T, -turn.T @ skew(position)], [np.zeros((3, 3)), turn.T]])
    return h.T @ matrix @ h


BLOCK = 1024
"""Random numbers drawn per block: one call per sample would cost more than the rest of the sensor."""


def uniforms(rng: np.random.Generator) -> Iterator[float]:
    """Yields uniform numbers from 0 to 1 without end, from blocks drawn ahead."""
    while True:
        yield from rng.random(BLOCK).tolist()


class Noise:
    """Standard normal numbers in groups of `width`, from blocks drawn ahead."""

    def __init__(self, rng: np.random.Generator, width: int) -> None:
        self._rng, self._width, self._next = rng, width, BLOCK
        self._block = np.zeros((0, width))

    def take(self) -> np.ndarray:
        """(width,) the next numbers."""
        if self._next >= BLOCK:
            self._block, self._next = self._rng.standard_normal((BLOCK, self._width)), 0
        self._next += 1
        return self._block[self._next - 1]

    def take_many(self, count: int) -> np.ndarray:
        """(count, width) the next groups, the same as `count` calls of `take`."""
        parts = []
        while count > 0:
            parts.append(self.take()[None])
            more = self._block[self._next : self._next + count - 1]
            parts.append(more)
            self._next += len(more)
            count -= 1 + len(more)
        return np.concatenate(parts)
