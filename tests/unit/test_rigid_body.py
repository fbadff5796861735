"""Fossen's matrices: the identities that they must satisfy, and the physics that follows from them."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from firmware_py.core import rigid_body, rotations
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble

SHAPES = {
    "one module": [(0, 0, 0)],
    "line of two": [(0, 0, 0), (1, 0, 0)],
    "L of three": [(0, 0, 0), (1, 0, 0), (1, 1, 0)],
}


@pytest.fixture(scope="module", params=[*SHAPES, "no symmetry at all"])
def mass(request: pytest.FixtureRequest) -> np.ndarray:
    """(6, 6) mass matrices of docked shapes, and a full one with every coupling."""
    if request.param in SHAPES:
        cells = SHAPES[request.param]
        return assemble(cells, [0] * len(cells), [load_vehicle("modcube")] * len(cells)).mass
    half = np.random.default_rng(2).normal(size=(6, 6))
    return np.ascontiguousarray(half @ half.T + 3.0 * np.eye(6))


@pytest.fixture(params=range(4))
def nu(request: pytest.FixtureRequest) -> np.ndarray:
    return np.random.default_rng(request.param).normal(size=6)


def test_coriolis_forces_do_no_work(mass: np.ndarray, nu: np.ndarray) -> None:
    assert float(nu @ rigid_body.coriolis_wrench(mass, nu)) == pytest.approx(0.0, abs=1e-11 * float(nu @ mass @ nu))


def test_coriolis_wrench_is_kirchhoffs(mass: np.ndarray, nu: np.ndarray) -> None:
    """Kirchhoff's equations: momentum (p, h) changes by w x p and w x h + v x p in the turning frame."""
    momentum = mass @ nu
    v, w, p, h = nu[:3], nu[3:], momentum[:3], momentum[3:]
    expected = np.r_[np.cross(w, p), np.cross(w, h) + np.cross(v, p)]
    np.testing.assert_allclose(rigid_body.coriolis_wrench(mass, nu), expected, atol=1e-12)


def test_free_body_keeps_its_energy(mass: np.ndarray) -> None:
    nu = np.array([0.3, -0.2, 0.5, 1.0, -2.0, 0.7])
    inverse = np.linalg.inv(mass)

    def rates(_: float, x: np.ndarray) -> np.ndarray:
        return -inverse @ rigid_body.coriolis_wrench(mass, x)

    flight = solve_ivp(rates, (0.0, 3.0), nu, method="DOP853", rtol=1e-10, atol=1e-12)
    energies = 0.5 * np.einsum("it,ij,jt->t", flight.y, mass, flight.y)
    assert np.abs(flight.y[:, -1] - nu).max() > 0.05, "it must have moved, or nothing was tested"
    np.testing.assert_allclose(energies, energies[0], rtol=1e-7)


def test_free_body_keeps_its_momentum_in_the_world(mass: np.ndarray) -> None:
    """The impulse seen from the world does not change; energy alone would not notice a sign error in both rows."""
    inverse = np.linalg.inv(mass)

    def rates(_: float, x: np.ndarray) -> np.ndarray:
        q, nu = x[3:7], np.ascontiguousarray(x[7:])
        turn = 0.5 * rotations.multiply(np.ascontiguousarray(q), np.r_[0.0, nu[3:]])
        velocity = rotations.to_matrix(np.ascontiguousarray(q / np.linalg.norm(q))) @ nu[:3]
        return np.r_[velocity, turn, -inverse @ rigid_body.coriolis_wrench(mass, nu)]

    start = np.r_[0.1, 0.2, -0.3, 1.0, 0.0, 0.0, 0.0, 0.3, -0.2, 0.5, 1.0, -2.0, 0.7]
    flight = solve_ivp(rates, (0.0, 2.0), start, method="DOP853", rtol=1e-10, atol=1e-12)

    def world_momentum(x: np.ndarray) -> np.ndarray:
        turn, momentum = Rotation.from_quat(x[[4, 5, 6, 3]]), mass @ x[7:]
        linear = turn.apply(momentum[:3])
        return np.r_[linear, turn.apply(momentum[3:]) + np.cross(x[:3], linear)]

    np.testing.assert_allclose(world_momentum(flight.y[:, -1]), world_momentum(start), atol=1e-6 * np.abs(mass).max())


def test_spinning_body_that_moves_forward_is_thrown_outward() -> None:
    """A 2 kg body at 1 m/s ahead that yaws at 1 rad/s needs 2 N to the right to stay on its circle."""
    mass = np.diag([2.0, 2.0, 2.0, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(
        rigid_body.coriolis_wrench(mass, np.array([1.0, 0.0, 0.0, 0.0, 0.0, 1.0])), [0.0, 2.0, 0.0, 0.0, 0.0, 0.0]
    )


@pytest.mark.parametrize("angle", [-2.0, -0.5, 0.0, 0.3, 1.5, 3.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_buoyancy_rights_the_robot(axis: int, angle: float) -> None:
    """Buoyancy B at height h above the centre of mass rights with -B h sin(angle), whatever the heading."""
    righting = np.array([0.0, 0.0, -0.1275])
    turn = np.eye(3)[axis] * angle
    q = rotations.multiply(rotations.from_euler(0.0, 0.0, 0.8), rotations.exp(turn))
    moment = rigid_body.restoring_moment(righting, q)
    np.testing.assert_allclose(moment, -0.1275 * np.sin(angle) * np.eye(3)[axis], atol=1e-15)


def test_buoyancy_moment_is_arm_times_upward_force() -> None:
    arm, buoyancy = np.array([0.003, -0.002, -0.005]), 25.5
    q = rotations.from_euler(0.5, -0.3, 1.0)
    upward_b = to_body(q, np.array([0.0, 0.0, -buoyancy]))
    np.testing.assert_allclose(rigid_body.restoring_moment(arm * buoyancy, q), np.cross(arm, upward_b), atol=1e-14)


def to_body(q: np.ndarray, vector_w: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(q[[1, 2, 3, 0]]).inv().apply(vector_w)
