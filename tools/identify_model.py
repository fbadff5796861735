"""For tools/identify.py: the equations of motion of one module, with their unknowns.

Newton and Euler about the centre of mass, body frame, motion relative to the water (Fossen 2011, ch. 6 and 8):

    M a  =  sum k_i F_i d_i + D(v) + n down                                 - w' x s - w x (w x s)  + M (w x v) - w x (M v)
    I w' =  sum k_i F_i r_i x d_i - (rot |w| + cross c(v)) w - arm x down   - s x a                 - w x (I w) - v x (M v)

a is the measured specific force plus gravity, w' the derivative of the gyro; F_i is the thruster's curve over the commands sent, behind a
first-order lag, at the measured voltage; v is the velocity less that of the water, which is a mean plus a gust given at knots 2.5 s apart
and linear between them; s is the first moment of mass about the centre in the vehicle file. A known weight adds its force, less its mass
times a, to the first equation, and the moment of that at its point of attachment to the second. M, I, s, D, n, arm and k have one common
factor that no motion shows. Both sides are filtered with one window of 11 ticks: that of the slope of a straight line through the gyro.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from identify_log import Recording
from identify_motion import Motion, filled
from scipy.signal import lfilter

from firmware_py.core.drag_lookup import look_up
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import ThrusterCurve, Vehicle
from firmware_py.description.water import GRAVITY
from firmware_py.prepare.assembly import assemble_vehicle

HALF_WINDOW = 5
"""Ticks to either side of a row. Rows are twice as many ticks apart, so that hardly any sample contributes to two."""
DEADBAND_EDGE_N = 0.01
"""Width of the smoothed edge of a thruster's deadband, which makes the deadband searchable by slopes."""
SHORTEST_LAG_S = 0.005
MODULE_KG, MODULE_M = 15.5, 0.21
"""Total mass and edge of the module for which the widths of the priors were chosen."""
NO_GUST = np.zeros(0)
DOWN = np.array([0.0, 0.0, 1.0])
GUST_S = 5.0
"""Correlation time of gusts: their autocorrelation is exp(-t / GUST_S)."""
KNOT_S = 2.5
"""Time between two knots of the gusts."""


class Unknown(NamedTuple):
    """`size` unknowns under one name, with the standard deviation `width` of their prior about the vehicle file's values."""

    name: str
    size: int
    width: float
    step: float = 1e-4
    """Step of the finite differences."""


def unknowns(vehicle: Vehicle) -> tuple[Unknown, ...]:
    """Unknowns of the vehicle. mass, inertia: logarithms of the totals; SI units. Widths: a module's, in proportion to mass and size.

    shape: errors of the curve's shape. Shares of the force: reverse against forward, small commands against full ones, forward and in
    reverse; then the force missing at small commands, N, forward and in reverse. A load cell with 0.02 N of noise is off by some per cent
    at the forces of a hovering robot, which would bias the gains of thrusters that push one way against those that push the other.
    """
    thrusters, heavier = len(vehicle.thruster), float(np.diag(assemble_vehicle(vehicle).mass)[:3].mean()) / MODULE_KG
    larger = math.cbrt(float(np.prod(vehicle.hull.size_m))) / MODULE_M
    return (
        Unknown("mass", 3, 1.0),
        Unknown("inertia", 3, 1.0),
        Unknown("gain", thrusters, 0.5),
        Unknown("deadband", thrusters, 0.1, 0.003),
        Unknown("lag", 1, 0.1),
        Unknown("shape", 5, 0.05),
        Unknown("drag", 2, 1.0),
        Unknown("rotational", 3, 0.05 * larger**5),
        Unknown("crossflow", 3, 0.5 * larger**4),
        Unknown("arm", 3, 0.5 * heavier * larger),
        Unknown("weight", 1, 5.0 * heavier),
        Unknown("offset", 3, 0.1 * heavier * larger),
    )


NUISANCES = (Unknown("current", 3, 0.3), Unknown("bias", 3, 0.3))
"""Unknowns of one flight: the water's mean velocity, m/s, and the accelerometer's bias, m/s^2."""


def slices_by_name(parts: Sequence[Unknown], first: int = 0) -> dict[str, slice]:
    """Slice of each unknown in the vector of all, by name."""
    ends = first + np.cumsum([p.size for p in parts])
    return {p.name: slice(int(end) - p.size, int(end)) for p, end in zip(parts, ends, strict=True)}


class Weight(NamedTuple):
    """A known weight that hung on the vehicle for part of a flight."""

    newton: float
    """Weight in water."""
    kg: float
    """Mass in air."""
    from_s: float
    until_s: float
    at_m: tuple[float, float, float] | None = None
    """Point of attachment, module frame as in the vehicle file; None: the middle of the hull's bottom."""


def initial_values(vehicle: Vehicle) -> dict[str, np.ndarray]:
    """The unknowns at the vehicle file's values."""
    body, count = assemble_vehicle(vehicle), len(vehicle.thruster)
    total = np.diag(body.mass)
    return {
        "mass": np.log(total[:3]),
        "inertia": np.log(total[3:]),
        "gain": np.ones(count),
        "deadband": np.full(count, vehicle.curve.deadband_n),
        "lag": np.array([max(vehicle.curve.lag_s, SHORTEST_LAG_S)]),
        "shape": np.zeros(5),
        "drag": np.array([vehicle.drag.cd_face, vehicle.drag.cd_edge]),
        "rotational": body.drag.rotational,
        "crossflow": np.zeros(3),
        "arm": body.righting,
        "weight": np.zeros(1),
        "offset": np.zeros(3),
    }


class Equations:
    """The equations of one flight: the measurements, and their predictions for given unknowns."""

    def __init__(self, recording: Recording, motion: Motion, curve: ThrusterCurve, weight: Weight | None = None) -> None:
        """`curve` replaces that of the recording's thrusters. Raises DescriptionError where no row is usable."""
        vehicle, window = recording.vehicle, _window(HALF_WINDOW)
        inner = np.arange(HALF_WINDOW, len(recording.time_ns) - HALF_WINDOW, 2 * HALF_WINDOW)
        steady = np.convolve(recording.armed, np.ones(len(window)), "valid") > len(window) - 0.5
        wholly_under = motion.p_wb[inner, 2] > recording.body.reach_m
        self._rows = inner[steady[inner - HALF_WINDOW] & wholly_under]
        if len(self._rows) < 2:
            raise DescriptionError(f"{recording.name}: the vehicle was never armed and wholly under water; give the log of a dive")
        self._window, self._period_s = window, recording.period_s
        self._matrix = recording.body.thrusters.matrix
        self.time_s = 1e-9 * (recording.time_ns[self._rows] - recording.time_ns[0])
        self.vehicle, self.name = vehicle, recording.name
        self.knots = _knots(self.time_s)
        self._w, self._v_w, self._q = motion.w_b[self._rows], motion.v_w[self._rows], motion.q_wb[self._rows]
        down = _to_body(motion.q_wb, np.broadcast_to(DOWN, motion.v_w.shape))
        self._down = down[self._rows]
        lever, slope = recording.body.r_bi[0], np.gradient(motion.w_b, recording.period_s, axis=0)
        moved = _cross(slope, lever) + _cross(motion.w_b, _cross(motion.w_b, lever)) if lever.any() else 0.0
        felt = self._seen(filled(recording.accel) + GRAVITY * down - moved)
        self.measured = np.hstack([felt, _slope(motion.w_b, recording.period_s)[self._rows - HALF_WINDOW]])
        self._command = recording.command
        self._static = np.column_stack([curve_force(curve, u) for u in recording.command.T])
        self._scale = np.square(recording.voltage_v / curve.voltage_v)
        self._nodes = _drag_nodes(vehicle)
        self._loaded = _share(self.time_s, weight)
        self._load = weight or Weight(0.0, 0.0, 0.0, 0.0)
        self._centre = recording.body.r_bm[0]
        """(3,) middle of the hull from the centre of mass, m: added mass and drag act there."""
        self._added_share = vehicle.inertial.added[:3] / np.diag(recording.body.mass)[:3]
        """(3,) share of the added mass in the total along each axis, as in the vehicle file."""
        self._hung = recording.body.r_bm[0] + hung_at(self._load, vehicle)
        self._kept: dict[object, tuple[bytes, object]] = {}

    def predict(self, x: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, 6) acceleration of the centre of mass and derivative of the rate; `x` holds the unknowns and nuisances by name.

        (3 k,) "gust", if present, is the velocity x, y, z of the water at each of the k knots, in excess of its mean.
        """
        thrust = np.column_stack([
            self._once(i, np.array([x["lag"][0], x["deadband"][i], *x["shape"]]), self._thrust) for i in range(len(x["gain"]))
        ])  # fmt: skip
        v, drags = self._once("drag", np.concatenate([x["current"], x.get("gust", NO_GUST)]), self._drag)
        w, mass, inertia = self._w, np.exp(x["mass"]), np.exp(x["inertia"])
        tau = (thrust * x["gain"]) @ self._matrix.T
        drag = x["drag"][0] * drags[0] + x["drag"][1] * drags[1]
        force = tau[:, :3] + drag + (x["weight"] + self._load.newton * self._loaded)[:, None] * self._down
        a, turned, s = self.measured[:, :3] - x["bias"], self.measured[:, 3:], x["offset"]
        force = force - _cross(turned, s) - _cross(w, _cross(w, s)) + mass * _cross(w, v) - _cross(w, mass * v)
        speed = np.abs(v)
        damping = x["rotational"] * np.linalg.norm(w, axis=1, keepdims=True) + x["crossflow"] * (speed.sum(axis=1, keepdims=True) - speed)
        moment = tau[:, 3:] - damping * w - _cross(x["arm"], self._down) - _cross(s, a) - _cross(w, inertia * w)
        moment = moment + _cross(self._centre, drag)
        # the added mass acts in the middle of the hull: its matrix and its Coriolis terms, moved to the centre of mass (Fossen, 2011)
        water = mass * self._added_share
        turning = water * _cross(w, self._centre)
        force = force - water * _cross(turned, self._centre) - _cross(w, turning)
        swum = _cross(self._centre, water * (a - _cross(w, v))) + _cross(w, _cross(self._centre, water * v))
        moment = moment - swum - _cross(v, turning)
        load = self._loaded[:, None] * (self._load.newton * self._down - self._load.kg * a)
        moment = moment - _cross(v, mass * v) + _cross(self._hung, load)
        return np.hstack([force / (mass + self._load.kg * self._loaded[:, None]) + x["bias"], moment / inertia])

    def _once(self, key: object, at: np.ndarray, compute):  # type: ignore[no-untyped-def]
        """Cached result of `compute(key, at)`, recomputed when `at` has changed."""
        kept = self._kept.get(key)
        if kept is None or kept[0] != at.tobytes():
            kept = self._kept[key] = at.tobytes(), compute(key, at)
        return kept[1]

    def _thrust(self, thruster: int, at: np.ndarray) -> np.ndarray:
        """(n,) force of one thruster of gain 1, for a lag, a deadband and a shape (5,) of its curve."""
        lag_s, deadband_n, (reverse, bent, bent_back, more, more_back) = max(float(at[0]), SHORTEST_LAG_S), at[1], at[2:]
        static, small = self._static[:, thruster], 1.0 - np.abs(self._command[:, thruster])
        backwards = static < 0.0
        static = static * (1.0 + np.where(backwards, reverse + bent_back * small, bent * small))
        static = static + np.sign(static) * np.where(backwards, more_back, more) * small**4
        working = 0.5 + 0.5 * np.tanh((np.abs(static) - deadband_n) / (2.0 * DEADBAND_EDGE_N))
        keep = np.exp(-self._period_s / lag_s)
        return self._seen(lfilter([1.0 - keep], [1.0, -keep], static * working) * self._scale)

    def _drag(self, key: str, at: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """(n, 3) velocity through the water of a mean (3,) and gusts, and the (n, 3) force for coefficients (1, 0) and (0, 1)."""
        gusts = at[3:].reshape(-1, 3)
        v = _to_body(self._q, self._v_w - at[:3] - self.knots[:, : len(gusts)] @ gusts)
        flow = np.ascontiguousarray(v + _cross(self._w, self._centre))
        speed = np.linalg.norm(flow, axis=1, keepdims=True)
        return v, [-np.array([look_up(nodes, row)[:1] for row in flow]) * speed * flow for nodes in self._nodes]

    def _seen(self, series: np.ndarray) -> np.ndarray:
        """Filters a series of all ticks with the window and samples it at the rows."""
        columns = series.reshape(len(series), -1).T
        seen = np.column_stack([np.convolve(c, self._window, "valid") for c in columns])[self._rows - HALF_WINDOW]
        return seen if series.ndim > 1 else seen[:, 0]


def _to_body(q: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """(n, 3) world vectors, each rotated into the body frame of its attitude."""
    axis = -q[:, 1:]
    twice = 2.0 * _cross(axis, vectors)
    return np.asarray(vectors + q[:, :1] * twice + _cross(axis, twice))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n, 3) a x b, of (n, 3) or (3,): numpy's own takes five times as long."""
    return np.stack([a[..., i] * b[..., j] - a[..., j] * b[..., i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=-1)


def _knots(time_s: np.ndarray) -> np.ndarray:
    """(n, k) weight of each knot in the gust at each time."""
    count = 2 + int(time_s[-1] / KNOT_S)
    return np.maximum(0.0, 1.0 - np.abs(time_s[:, None] / KNOT_S - np.arange(count)))


def gust_precision(knots: int) -> np.ndarray:
    """(k, k) inverse covariance of gusts of unit variance at the knots, a first-order Gauss-Markov process."""
    keep = math.exp(-KNOT_S / GUST_S)
    diagonal = np.full(knots, 1.0 + keep**2)
    diagonal[[0, -1]] = 1.0
    beside = np.full(knots - 1, -keep)
    return np.asarray(np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)) / (1.0 - keep**2)


def _window(half: int) -> np.ndarray:
    """(2 half + 1,) weights with which the slope of a straight line through as many samples averages the derivative between them."""
    j = np.arange(-half, half)
    between = half * (half + 1) - j * (j + 1.0)
    weights = np.zeros(2 * half + 1)
    weights[:-1] += between
    weights[1:] += between
    return weights / weights.sum()


def _slope(series: np.ndarray, period_s: float) -> np.ndarray:
    """(n - 2 half, k) slope of the straight line through the samples around each sample."""
    j = np.arange(-HALF_WINDOW, HALF_WINDOW + 1.0)
    return np.column_stack([np.convolve(c, -j / (j @ j) / period_s, "valid") for c in series.T])


def curve_force(curve: ThrusterCurve, u: np.ndarray) -> np.ndarray:
    """(n,) force of the curve over commands (n,) from -1 to 1, without its deadband, N."""
    powers = np.arange(1, 6)
    sides = [np.maximum(s * u, 0.0)[:, None] ** powers @ c for s, c in ((1.0, curve.forward), (-1.0, curve.reverse))]
    return np.asarray(sides[0] - sides[1])


def _drag_nodes(vehicle: Vehicle) -> list[np.ndarray]:
    """Drag tables for face and edge coefficients of (1, 0) and (0, 1)."""
    pairs = [dataclasses.replace(vehicle.drag, cd_face=face, cd_edge=1.0 - face) for face in (1.0, 0.0)]
    return [assemble_vehicle(dataclasses.replace(vehicle, drag=drag)).drag.nodes for drag in pairs]


def hung_at(weight: Weight, vehicle: Vehicle) -> np.ndarray:
    """(3,) point where a weight hung, module frame, m."""
    return np.array(weight.at_m) if weight.at_m is not None else 0.5 * vehicle.hull.size_m * DOWN


def _share(time_s: np.ndarray, weight: Weight | None) -> np.ndarray:
    if weight is None:
        return np.zeros(len(time_s))
    return ((time_s >= weight.from_s) & (time_s < weight.until_s)).astype(float)
