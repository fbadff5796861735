"""Energies of surfaces with known answers, and ellipsoids in known bodies."""

import math

import numpy as np
import pytest

from firmware_py.prepare.capability.ellipsoid import largest_inscribed
from firmware_py.prepare.capability.morphology import Harmonics
from firmware_py.prepare.capability.sphere import angles, fibonacci, grid

DIRECTIONS = fibonacci(1000)
HARMONICS = Harmonics(DIRECTIONS)


def spheroid(directions: np.ndarray, axis: int) -> np.ndarray:
    """Radius of the spheroid with half-axes 1, 1 and, along `axis`, 2."""
    half = np.ones(3)
    half[axis] = 2.0
    return np.asarray(1.0 / np.sqrt(np.sum((directions / half) ** 2, axis=1)))


def test_harmonics_are_scipys_made_real() -> None:
    from scipy.special import sph_harm_y

    polar, azimuth = angles(DIRECTIONS)
    rng = np.random.default_rng(2)
    for degree, m in ((0, 0), (1, 0), (1, 1), (2, 1), (5, 3), (10, 0), (10, 7), (10, 10)):
        factor = rng.uniform(0.5, 2.0)
        value = sph_harm_y(degree, m, polar, azimuth) * (-1) ** m * (math.sqrt(2.0) if m else 1.0)
        for part in (value.real, value.imag) if m else (value.real,):
            found = HARMONICS.fit(factor * part)
            assert np.abs(found).max() == pytest.approx(factor, rel=1e-9)
            assert np.sum(np.abs(found) > 1e-9) == 1


def test_wavy_sphere_has_the_known_dirichlet_energy() -> None:
    shape = HARMONICS.shape(1.0 + 0.3 * 0.5 * (3.0 * DIRECTIONS[:, 2] ** 2 - 1.0))
    assert shape.dirichlet == pytest.approx(1.357168, abs=1e-6)
    assert shape.misfit < 1e-12


def test_sphere_has_no_energy_at_all() -> None:
    shape = HARMONICS.shape(np.full(len(DIRECTIONS), 3.0))
    assert shape.dirichlet == pytest.approx(0.0, abs=1e-20)
    assert shape.willmore == pytest.approx(0.0, abs=1e-10)
    assert shape.total_curvature == pytest.approx(4.0 * math.pi, rel=1e-12)


@pytest.fixture(scope="module")
def fine_harmonics() -> Harmonics:
    return Harmonics(DIRECTIONS, 20)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_spheroid_has_the_known_willmore_energy_however_it_lies(fine_harmonics: Harmonics, axis: int) -> None:
    fine = fine_harmonics.shape(spheroid(DIRECTIONS, axis))
    assert fine.willmore == pytest.approx(2.88524, abs=5e-5)
    assert fine.total_curvature == pytest.approx(4.0 * math.pi, rel=1e-9)
    # The paper's degree of 10 is accurate to half a percent.
    assert HARMONICS.shape(spheroid(DIRECTIONS, axis)).willmore == pytest.approx(2.88524, rel=5e-3)


def test_energies_follow_their_scaling() -> None:
    radius = spheroid(DIRECTIONS, 2)
    small, large = HARMONICS.shape(radius), HARMONICS.shape(5.0 * radius)
    assert large.dirichlet == pytest.approx(25.0 * small.dirichlet)
    assert large.dirichlet_scale_free == pytest.approx(small.dirichlet_scale_free)
    assert large.willmore == pytest.approx(small.willmore)


def test_radius_is_taken_about_the_wrench_origin(fine_harmonics: Harmonics) -> None:
    """A unit sphere moved by 0.2 along z is not a sphere about the origin; its Willmore energy stays zero."""
    along = 0.2 * DIRECTIONS[:, 2]
    shape = fine_harmonics.shape(along + np.sqrt(1.0 - 0.04 + along**2))
    assert shape.dirichlet > 0.1
    assert shape.willmore == pytest.approx(0.0, abs=1e-8)


def test_flat_space_has_no_willmore_energy() -> None:
    flat = HARMONICS.shape(DIRECTIONS[:, 2] ** 4)
    assert math.isnan(flat.willmore)
    assert "r_min / r_max" in flat.refused
    pinched = HARMONICS.shape(np.abs(DIRECTIONS[:, 2]) + 1e-3)
    assert math.isnan(pinched.willmore)
    assert pinched.refused


def test_too_few_directions_are_refused() -> None:
    with pytest.raises(ValueError, match="too few"):
        Harmonics(fibonacci(120))


def test_directions_reach_both_poles_alike() -> None:
    assert DIRECTIONS[0, 2] == pytest.approx(-DIRECTIONS[-1, 2])
    assert np.linalg.norm(DIRECTIONS, axis=1) == pytest.approx(1.0)
    assert DIRECTIONS.T @ DIRECTIONS / len(DIRECTIONS) == pytest.approx(np.eye(3) / 3.0, abs=1e-3)
    polar, azimuth = angles(grid(5, 9)[1:-1, :-1].reshape(-1, 3))
    assert (polar.min(), polar.max()) == pytest.approx((math.pi / 4, 3 * math.pi / 4))
    assert np.unique(np.round(azimuth, 9)).size == 8


def test_ball_is_the_largest_ellipsoid_in_a_cube_and_stretches_with_it() -> None:
    normals = np.vstack([np.eye(3), -np.eye(3)])
    assert largest_inscribed(normals, np.ones(6)).volume == pytest.approx(4.0 / 3.0 * math.pi, rel=1e-8)
    box = largest_inscribed(normals, np.array([1.0, 2.0, 3.0, 1.0, 2.0, 5.0]))
    assert box.shape == pytest.approx(np.diag([1.0, 2.0, 4.0]), abs=1e-6)
    assert box.centre == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)


def test_ellipsoid_follows_a_linear_map_of_its_polytope() -> None:
    """John's ellipsoid is affine: the map T of the polytope has |det T| times the volume."""
    rng = np.random.default_rng(5)
    normals, offsets = rng.standard_normal((40, 3)), rng.uniform(0.5, 2.0, 40)
    turn = rng.standard_normal((3, 3))
    plain = largest_inscribed(normals, offsets).volume
    mapped = largest_inscribed(normals @ np.linalg.inv(turn), offsets).volume
    assert mapped == pytest.approx(plain * abs(np.linalg.det(turn)), rel=1e-7)


def test_circle_in_a_triangle_and_a_segment() -> None:
    turn = 2.0 * math.pi * np.arange(3) / 3.0
    triangle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    assert largest_inscribed(triangle, np.ones(3)).volume == pytest.approx(math.pi, rel=1e-8)
    assert largest_inscribed(np.array([[1.0], [-1.0]]), np.array([3.0, 1.0])).volume == pytest.approx(4.0, rel=1e-8)


def test_polytope_without_the_origin_is_refused() -> None:
    with pytest.raises(ValueError, match="origin inside"):
        largest_inscribed(np.eye(3), np.array([1.0, 0.0, 1.0]))
