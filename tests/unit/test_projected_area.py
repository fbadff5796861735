"""Projected areas of shapes: exact outlines against closed forms, and the paper's alpha shape against the exact outlines."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import shapely

from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare import alpha, hulls
from firmware_py.prepare.projected_area import (
    Solid,
    areas_and_centroids,
    box,
    outlines,
    plane_basis,
)

Cells = list[tuple[int, int, int]]
EDGE = 0.21
ONE = [(0, 0, 0)]
LINE = [(0, 0, 0), (1, 0, 0)]
QUAD = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
ELBOW = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]


def solids(cells: Cells) -> list[Solid]:
    return [box(np.full(3, EDGE)).placed(np.eye(3), EDGE * np.array(c)) for c in cells]


def fibonacci(n: int) -> np.ndarray:
    """(n, 3) directions: the paper's Algorithm 1 with the pole corrected (errata)."""
    i = np.arange(n)
    phi, theta = np.arccos(1.0 - (2 * i + 1) / n), math.pi * (1.0 + math.sqrt(5.0)) * i
    return np.stack([np.cos(theta) * np.sin(phi), np.sin(theta) * np.sin(phi), np.cos(phi)], axis=1)


SPECIAL = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 0], [0, 1, -1], [1, 1, 1], [-1, 1, 1]])
DIRECTIONS = np.vstack([fibonacci(400), SPECIAL / np.linalg.norm(SPECIAL, axis=1, keepdims=True)])


def test_area_of_one_module_is_that_of_the_closed_form() -> None:
    areas, centroids = areas_and_centroids(solids(ONE), DIRECTIONS)
    np.testing.assert_allclose(areas, EDGE**2 * np.abs(DIRECTIONS).sum(axis=1), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(centroids, 0.0, atol=1e-12)


@pytest.mark.parametrize(("cells", "edges"), [(LINE, (2, 1, 1)), (QUAD, (2, 2, 1))])
def test_area_of_a_block_of_modules_is_that_of_one_box(cells: Cells, edges: tuple[int, ...]) -> None:
    x, y, z = EDGE * np.array(edges)
    areas, centroids = areas_and_centroids(solids(cells), DIRECTIONS)
    np.testing.assert_allclose(areas, np.abs(DIRECTIONS) @ [y * z, x * z, x * y], rtol=0.0, atol=1e-12)
    middle = EDGE * np.mean(cells, axis=0)
    expected = middle - (DIRECTIONS @ middle)[:, None] * DIRECTIONS
    np.testing.assert_allclose(centroids, expected, atol=1e-12)


def test_area_of_an_elbow_agrees_with_counting_rays() -> None:
    rng = np.random.default_rng(5)
    cells = np.array(ELBOW)
    for direction in DIRECTIONS[::83]:
        basis = plane_basis(direction[None])[0]
        flat = rng.uniform(-0.5, 0.5, (40000, 2))
        origins = flat @ basis + EDGE * cells.mean(axis=0)
        hit = np.zeros(len(flat), dtype=bool)
        for cell in EDGE * cells:
            with np.errstate(divide="ignore"):
                near, far = ((s * EDGE / 2 + cell - origins) / direction for s in (-1, 1))
            low, high = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
            hit |= low <= high
        area = areas_and_centroids(solids(ELBOW), direction[None])[0][0]
        assert hit.mean() == pytest.approx(area, abs=4.0 * math.sqrt(area / len(flat)))


@pytest.mark.slow
@pytest.mark.parametrize(("cells", "mean"), [(ONE, 0.06615), (LINE, 0.11025), (QUAD, 0.1764), (ELBOW, 0.14994)])
def test_mean_area_is_a_quarter_of_the_surface_for_convex_shapes(cells: Cells, mean: float) -> None:
    areas = areas_and_centroids(solids(cells), fibonacci(2000))[0]
    assert areas.mean() == pytest.approx(mean, rel=5e-4)
    if cells is ELBOW:
        assert areas.mean() < 14 * EDGE**2 / 4 - 1e-3


def test_convex_hull_would_overestimate_an_elbow() -> None:
    shapes = outlines(solids(ELBOW), fibonacci(1000))
    excess = shapely.area(shapely.convex_hull(shapes)) / shapely.area(shapes) - 1.0
    assert excess.mean() == pytest.approx(0.056, abs=0.002)
    assert excess.max() == pytest.approx(0.157, abs=0.006)  # 1/6 exactly from above, if that direction is sampled


def test_opposite_directions_see_the_same_outline() -> None:
    for cells in (ELBOW, [*ELBOW, (0, 0, 1)]):
        there, back = (areas_and_centroids(solids(cells), s * DIRECTIONS) for s in (1.0, -1.0))
        np.testing.assert_allclose(there[0], back[0], atol=1e-14)
        np.testing.assert_allclose(there[1], back[1], atol=1e-12)


def test_no_direction_is_singular() -> None:
    near_poles = np.array([[0, 0, 1], [0, 0, -1], [1e-12, 0, -1], [0, -1e-9, -1], [1e-16, 1e-16, 1]], dtype=float)
    basis = plane_basis(near_poles)
    assert np.all(np.isfinite(basis))
    for two, direction in zip(basis, near_poles, strict=True):
        np.testing.assert_allclose(two @ two.T, np.eye(2), atol=1e-15)
        np.testing.assert_allclose(np.cross(two[0], two[1]), direction, atol=1e-8)
    areas, centroids = areas_and_centroids(solids(ELBOW), near_poles)
    assert np.all(np.isfinite(areas))
    assert np.all(np.isfinite(centroids))


# ---------------------------------------------------------------- meshes


def _octahedron_with_a_dent() -> Solid:
    """A closed mesh that is not convex: one vertex of an octahedron pushed below the centre."""
    vertices = 0.1 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, -0.4], [0, 0, -1]], dtype=float)
    top = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4]]
    bottom = [[2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    return Solid(vertices, np.array(top + bottom), convex=False)


def test_closed_mesh_need_not_be_convex() -> None:
    mesh = _octahedron_with_a_dent()
    areas, centroids = areas_and_centroids([mesh], np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]))
    np.testing.assert_allclose(areas, [0.02, 0.01, 0.02], atol=1e-12)
    np.testing.assert_allclose(centroids[1], [0.0, 0.0, -0.1 / 3.0], atol=1e-12)


def test_cube_given_as_a_mesh_has_the_area_of_the_box() -> None:
    cube = box(np.full(3, EDGE))
    as_mesh = Solid(cube.vertices, cube.triangles, convex=False)
    exact = areas_and_centroids([cube], DIRECTIONS)[0]
    np.testing.assert_allclose(areas_and_centroids([as_mesh], DIRECTIONS)[0], exact, atol=1e-12)


def test_normals_of_a_box_point_outward_and_close() -> None:
    solid = box(np.array([0.2, 0.3, 0.4]))
    assert np.linalg.norm(solid.normals, axis=1).sum() == pytest.approx(2 * (0.06 + 0.12 + 0.08))
    np.testing.assert_allclose(solid.normals.sum(axis=0), 0.0, atol=1e-12)
    assert np.all(np.einsum("ij,ij->i", solid.vertices[solid.triangles[:, 0]], solid.normals) > 0.0)


def test_mesh_that_is_open_or_missing_or_turned_in_places_is_refused(tmp_path) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(DescriptionError, match="no such mesh"):
        hulls.load_mesh(str(tmp_path / "hull.off"))
    open_mesh = tmp_path / "open.off"
    open_mesh.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(DescriptionError, match="not closed"):
        hulls.load_mesh(str(open_mesh))
    turned_over = tmp_path / "turned.off"
    turned_over.write_text("OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 3 2\n")
    with pytest.raises(DescriptionError, match=r"turned\.off: some triangles face outwards and others inwards; export it with all normals"):
        hulls.load_mesh(str(turned_over))


def test_mesh_file_gives_its_solid(tmp_path) -> None:  # type: ignore[no-untyped-def]
    mesh = _octahedron_with_a_dent()
    lines = ["OFF", f"{len(mesh.vertices)} {len(mesh.triangles)} 0"]
    lines += [" ".join(repr(float(c)) for c in v) for v in mesh.vertices]
    lines += ["3 " + " ".join(str(i) for i in t[::-1]) for t in mesh.triangles]
    path = tmp_path / "hull.off"
    path.write_text("\n".join(lines) + "\n")
    solid = hulls.load_mesh(str(path))
    assert not solid.convex
    expected, found = (areas_and_centroids([s], DIRECTIONS)[0] for s in (mesh, solid))
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("turn", "shift_m", "wrong"),
    [
        (1000.0 * np.eye(3), 0.0, "x -250 to 250, y -100 to 100, z -100 to 100 m"),
        (np.eye(3)[[1, 0, 2]], 0.0, "x -0.1 to 0.1, y -0.25 to 0.25, z -0.1 to 0.1 m"),
        (np.eye(3), 0.2, "x -0.05 to 0.45, y 0.1 to 0.3, z 0.1 to 0.3 m"),
        (np.eye(3), 0.02, ""),
    ],
    ids=["millimetres", "other axes", "origin in a corner", "about right"],
)
def test_mesh_that_is_not_where_the_hull_is_is_refused(turn: np.ndarray, shift_m: float, wrong: str, tmp_path: Path) -> None:
    drawn = box(np.array([0.5, 0.2, 0.2]))
    lines = ["OFF", f"{len(drawn.vertices)} {len(drawn.triangles)} 0"]
    lines += [" ".join(repr(float(c)) for c in v) for v in drawn.vertices @ turn.T + shift_m]
    lines += ["3 " + " ".join(map(str, t)) for t in drawn.triangles]
    path = tmp_path / "hull.off"
    path.write_text("\n".join(lines) + "\n")
    modcube = load_vehicle("modcube")
    mine = dataclasses.replace(modcube, hull=dataclasses.replace(modcube.hull, size_m=np.array([0.5, 0.2, 0.2]), mesh=str(path)))
    if wrong:
        with pytest.raises(DescriptionError, match=f"hull.off: the mesh reaches along {wrong}, and hull.size_m is a box of 0.5 x 0.2"):
            hulls.hull_of(mine)
    else:
        assert hulls.hull_of(mine)[0].vertices.shape == (8, 3)


# ---------------------------------------------------------------- the paper's sampling


@pytest.mark.slow
@pytest.mark.parametrize("cells", [ONE, LINE, QUAD, ELBOW], ids=["one", "line", "2x2", "elbow"])
def test_alpha_shape_on_a_lattice_with_boundary_is_within_one_percent(cells: Cells) -> None:
    directions = DIRECTIONS[:: 6 * len(cells)]
    exact, centres = areas_and_centroids(solids(cells), directions)
    sampled, sampled_centres = alpha.lattice_method(solids(cells), directions)
    error = sampled / exact - 1.0
    assert math.sqrt(np.mean(error**2)) <= 0.005
    assert np.abs(error).max() <= 0.01
    np.testing.assert_allclose(sampled_centres, centres, atol=0.002)


@pytest.mark.slow
def test_random_interior_points_underestimate_the_area() -> None:
    exact = areas_and_centroids(solids(ONE), DIRECTIONS[::8])[0]
    sampled = alpha.random_method(seed=1)(solids(ONE), DIRECTIONS[::8])[0]
    assert (sampled / exact - 1.0).mean() == pytest.approx(-0.18, abs=0.03)


def test_alpha_shape_of_a_mesh_agrees_with_its_exact_outline() -> None:
    mesh = [_octahedron_with_a_dent()]
    exact = areas_and_centroids(mesh, DIRECTIONS[::16])[0]
    sampled = alpha.lattice_method(mesh, DIRECTIONS[::16])[0]
    assert np.abs(sampled / exact - 1.0).max() <= 0.05
    assert math.sqrt(np.mean((sampled / exact - 1.0) ** 2)) <= 0.02
