"""Drag of a body from its table: checked against direct sums, symmetric, cached on disk and never trusted when damaged."""

import dataclasses
import itertools
import math
from pathlib import Path

import build_drag_table
import numpy as np
import pytest
from click.testing import Result
from matplotlib.figure import Figure
from typer.testing import CliRunner

from firmware_py.core import drag_lookup
from firmware_py.core.body import DragTable
from firmware_py.description.schema import DescriptionError, frozen_array
from firmware_py.description.vehicle import Payload, Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.description.water import WATER_DENSITY
from firmware_py.prepare import drag_table, lattice, shape_key
from firmware_py.prepare.alpha import lattice_method
from firmware_py.prepare.assembly import assemble, assemble_vehicle
from firmware_py.prepare.drag_cache import DragCache, default_folder
from firmware_py.prepare.joints import Placement
from firmware_py.prepare.projected_area import areas_and_centroids

PITCH = 0.21
ELBOW = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
SHAPES = {
    "one": [(0, 0, 0)],
    "line of four": [(k, 0, 0) for k in range(4)],
    "2x2": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)],
    "elbow": ELBOW,
    "tripod": [*ELBOW, (0, 0, 1)],
    "snake of seven": [(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1), (2, 1, 1), (2, 2, 1), (2, 2, 2)],
}


@pytest.fixture(scope="module")
def modcube() -> Vehicle:
    return load_vehicle("modcube")


@pytest.fixture
def cache(tmp_path: Path) -> DragCache:
    return DragCache(tmp_path / "drag")


def wrench(table: DragTable, nu: np.ndarray) -> np.ndarray:
    return np.asarray(drag_lookup.drag_wrench(table.nodes, table.rotational, table.linear, np.asarray(nu, dtype=float)))


def directions(n: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(n, 3))
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


def direct(vehicle: Vehicle, cells: list[tuple[int, int, int]], d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force per squared speed and centre of pressure from the common centre of mass, without a table."""
    parts = [shape_key.part(vehicle, c, 0) for c in cells]
    areas, centroids = areas_and_centroids(shape_key.solids(parts, PITCH), d)
    face, edge = vehicle.drag.cd_face, vehicle.drag.cd_edge
    # Linear in s = sum d^4, through the values on face (s = 1) and edge (s = 1/2).
    cd = edge + (face - edge) * 2.0 * (np.sum(d**4, axis=1) - 0.5)
    middle = PITCH * np.mean(cells, axis=0)
    across = middle - (d @ middle)[:, None] * d
    return 0.5 * WATER_DENSITY * cd * areas, centroids - across


# ---------------------------------------------------------------- force


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_look_up_is_within_one_percent_of_the_exact_drag(shape: str, modcube: Vehicle) -> None:
    cells, d = SHAPES[shape], directions(500)
    table = assemble(cells, [0] * len(cells), [modcube] * len(cells)).drag
    force, pressure = direct(modcube, cells, d)
    found = np.array([drag_lookup.look_up(table.nodes, x) for x in np.ascontiguousarray(d)])
    assert math.sqrt(np.mean((found[:, 0] / force - 1.0) ** 2)) <= 0.01
    moments = np.cross(found[:, 1:], -force[:, None] * d)
    expected = np.cross(pressure, -force[:, None] * d)
    assert np.abs(moments - expected).max() <= 0.03 * force.max() * PITCH


def test_nearest_of_a_thousand_directions_is_worse(modcube: Vehicle) -> None:
    table, d = assemble_vehicle(modcube).drag, directions(500)
    exact = direct(modcube, [(0, 0, 0)], d)[0]
    i = np.arange(1000)
    phi, theta = np.arccos(1.0 - (2 * i + 1) / 1000), math.pi * (1.0 + math.sqrt(5.0)) * i
    nodes = np.stack([np.cos(theta) * np.sin(phi), np.sin(theta) * np.sin(phi), np.cos(phi)], axis=1)
    chosen = nodes[np.argmax(d @ nodes.T, axis=1)]
    nearest = direct(modcube, [(0, 0, 0)], chosen)[0][:, None] * chosen
    ours = np.array([-wrench(table, [*x, 0, 0, 0])[:3] for x in d])
    forces = exact[:, None] * d
    errors = [math.sqrt(np.mean(np.sum((f - forces) ** 2, axis=1) / exact**2)) for f in (ours, nearest)]
    assert errors[0] <= 0.01
    assert errors[1] == pytest.approx(0.05, abs=0.02)


def test_drag_on_a_face_is_half_rho_cd_a(modcube: Vehicle) -> None:
    table = assemble_vehicle(modcube).drag
    expected = -0.5 * WATER_DENSITY * 1.05 * PITCH**2 * 0.3**2
    np.testing.assert_allclose(wrench(table, [0.3, 0, 0, 0, 0, 0]), [expected, 0, 0, 0, 0, 0], atol=1e-12)


def test_edge_and_corner_have_their_own_coefficients(modcube: Vehicle) -> None:
    table, half = assemble_vehicle(modcube).drag, 0.5 * WATER_DENSITY * PITCH**2
    for d, cd in (([1.0, 1.0, 0.0], 0.80), ([1.0, -1.0, 1.0], modcube.cd_corner), ([0.0, 0.0, -1.0], 1.05)):
        unit = np.array(d) / np.linalg.norm(d)
        force = drag_lookup.look_up(table.nodes, unit)[0]
        assert force == pytest.approx(half * cd * np.abs(unit).sum(), rel=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_opposite_motion_has_the_opposite_force(shape: str, modcube: Vehicle) -> None:
    cells = SHAPES[shape]
    table = assemble(cells, [0] * len(cells), [modcube] * len(cells)).drag
    for d in directions(100, seed=1):
        there, back = (wrench(table, [*(s * d), 0, 0, 0]) for s in (1.0, -1.0))
        np.testing.assert_allclose(there, -back, atol=1e-9)


def test_drag_opposes_motion_and_takes_energy(modcube: Vehicle) -> None:
    table = assemble(SHAPES["tripod"], [0] * 4, [modcube] * 4).drag
    rng = np.random.default_rng(2)
    for _ in range(200):
        nu = np.concatenate([rng.normal(size=3), np.zeros(3)])
        force = wrench(table, nu)[:3]
        np.testing.assert_allclose(np.cross(force, nu[:3]), 0.0, atol=1e-9)
        assert force @ nu[:3] < 0.0
        turning = np.concatenate([np.zeros(3), rng.normal(size=3)])
        assert wrench(table, turning) @ turning < 0.0


def test_no_direction_or_speed_gives_nan(modcube: Vehicle) -> None:
    table = assemble(ELBOW, [0] * 3, [modcube] * 3).drag
    corners = itertools.product([-1.0, -1e-300, 0.0, 1e-14, 1e-7, 1.0], repeat=3)
    for v in corners:
        assert np.all(np.isfinite(wrench(table, [*v, 0.0, 0.0, 0.0])))
    np.testing.assert_array_equal(wrench(table, np.zeros(6)), np.zeros(6))


def test_force_does_not_jump_where_sides_of_the_cube_map_meet(modcube: Vehicle) -> None:
    table = assemble(ELBOW, [0] * 3, [modcube] * 3).drag
    for t in np.linspace(-1.0, 1.0, 41):
        for rim in ([1.0, 1.0, t], [t, -1.0, 1.0], [-1.0, t, -1.0]):
            for shift in 1e-9 * np.concatenate([np.eye(3), -np.eye(3)]):  # onto either side of the rim
                found = wrench(table, [*(np.array(rim) + shift), 0, 0, 0])
                np.testing.assert_allclose(found, wrench(table, [*rim, 0, 0, 0]), rtol=0.0, atol=1e-6)


# ---------------------------------------------------------------- turning


def test_turning_a_cube_meets_the_closed_form_damping(modcube: Vehicle) -> None:
    """Over a cube of half-edge h, the integral of max(n . v, 0) r^2 is 6 h^5 about each axis."""
    table = assemble_vehicle(modcube).drag
    expected = 0.5 * WATER_DENSITY * 1.1 * 6.0 * (PITCH / 2) ** 5
    np.testing.assert_allclose(table.rotational, expected, rtol=0.002)


def test_longer_body_is_damped_more_and_docked_faces_do_not_count(modcube: Vehicle) -> None:
    """About its long axis a line of two is damped like two cubes, about the others far more."""
    one = assemble_vehicle(modcube).drag.rotational
    two = assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [modcube] * 2).drag.rotational
    assert two[0] == pytest.approx(2.0 * one[0], rel=1e-9)
    assert two[1] == pytest.approx(two[2], rel=1e-9)
    h = PITCH / 2
    # x faces at distance 2h: 2 h int max(-z) (4 h^2 + z^2); long faces: 2 h int over x of x (h^2 + x^2) up to 2 h.
    ends = 2 * 2 * h * (2 * h**2 * h**2 + h**4 / 4)
    sides = 2 * 2 * h * (2 * h**2 * h**2 + 4 * h**4)
    assert two[1] == pytest.approx(0.5 * WATER_DENSITY * 1.1 * (ends + sides), rel=0.005)


# ---------------------------------------------------------------- other vehicles


def test_published_damping_is_used_in_place_of_areas(modcube: Vehicle) -> None:
    quadratic = frozen_array([18.18, 21.66, 36.99, 1.55, 1.56, 1.57])
    drag = dataclasses.replace(modcube.drag, quadratic=quadratic, linear=frozen_array([4.0, 6.0, 5.0, 0.1, 0.2, 0.3]))
    table = assemble_vehicle(dataclasses.replace(modcube, drag=drag)).drag
    for axis in range(6):
        nu = np.zeros(6)
        nu[axis] = -0.5
        expected = np.zeros(6)
        expected[axis] = quadratic[axis] * 0.25 + drag.linear[axis] * 0.5
        np.testing.assert_allclose(wrench(table, nu), expected, atol=1e-12)


@pytest.mark.parametrize("columns", [[1, 2, 0], [2, 0, 1]])
def test_published_damping_turns_with_its_module(columns: list[int], modcube: Vehicle) -> None:
    """The module's axes lie along other axes of the body, and each keeps its own damping."""
    quadratic, linear = frozen_array([18.18, 21.66, 36.99, 1.55, 2.56, 3.57]), frozen_array([4.0, 6.0, 5.0, 0.1, 0.2, 0.3])
    drag = dataclasses.replace(modcube.drag, quadratic=quadratic, linear=linear)
    rotation = next(i for i, m in enumerate(lattice.MATRICES) if np.array_equal(m, np.eye(3)[columns]))
    table = assemble([(0, 0, 0)], [rotation], [dataclasses.replace(modcube, drag=drag)]).drag
    for axis in range(6):
        along = 3 * (axis // 3) + columns.index(axis % 3)  # in the body
        expected = np.zeros(6)
        expected[along] = quadratic[axis] * 0.25 + linear[axis] * 0.5
        np.testing.assert_allclose(wrench(table, -0.5 * np.eye(6)[along]), expected, atol=1e-12)


def test_payload_adds_to_the_outline(modcube: Vehicle) -> None:
    size, centre = frozen_array([0.3, 0.05, 0.05]), frozen_array([0.255, 0.0, 0.0])
    tool = Payload(name="arm", dry_kg=0.0, size_m=size, position_m=centre)
    table = assemble_vehicle(dataclasses.replace(modcube, payload=(tool,))).drag
    bare = assemble_vehicle(modcube).drag
    side, front = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    added = 0.5 * WATER_DENSITY * 1.05 * 0.3 * 0.05
    assert drag_lookup.look_up(table.nodes, side)[0] - drag_lookup.look_up(bare.nodes, side)[0] == pytest.approx(added)
    assert drag_lookup.look_up(table.nodes, front)[0] == pytest.approx(drag_lookup.look_up(bare.nodes, front)[0])


def test_alpha_mode_gives_the_same_table_within_one_percent(modcube: Vehicle) -> None:
    placements = [Placement(modcube, (0, 0, 0), 0)]
    exact = drag_table.build(placements, np.zeros(3), PITCH, nodes_per_rim=5)
    sampled = drag_table.build(placements, np.zeros(3), PITCH, mode="alpha", method=lattice_method, nodes_per_rim=5)
    np.testing.assert_allclose(sampled.nodes[..., 0], exact.nodes[..., 0], rtol=0.01)


# ---------------------------------------------------------------- turned and moved shapes, kept on disk


@pytest.mark.slow
@pytest.mark.parametrize("rotation", range(24))
def test_turned_shape_has_the_turned_drag(rotation: int, modcube: Vehicle) -> None:
    slab = dataclasses.replace(modcube.hull, size_m=frozen_array([0.21, 0.15, 0.09]))
    vehicle = dataclasses.replace(modcube, hull=slab, faces="PDPDPD")
    straight = assemble(ELBOW, [0] * 3, [vehicle] * 3).drag
    turn = lattice.MATRICES[rotation]
    cells = np.rint(np.array(ELBOW) @ turn.T + np.array([3, -2, 7])).astype(int)
    turned = assemble(cells, [rotation] * 3, [vehicle] * 3).drag
    for d in directions(20, seed=3):
        expected = wrench(straight, [*d, *d[::-1]])
        found = wrench(turned, [*(turn @ d), *(turn @ d[::-1])])
        np.testing.assert_allclose(found, np.concatenate([turn @ expected[:3], turn @ expected[3:]]), atol=1e-9)


@pytest.mark.slow
def test_turned_or_moved_shape_is_one_entry_in_the_cache(modcube: Vehicle, cache: DragCache) -> None:
    for rotation in range(24):
        turned = np.array(SHAPES["tripod"]) @ lattice.MATRICES[rotation].T
        cells = np.rint(turned + np.array([rotation, 0, -5])).astype(int)
        assemble(cells, [rotation] * 4, [modcube] * 4, cache=cache)
    assert len(list(cache.folder.iterdir())) == 1
    mirrored = np.array(SHAPES["snake of seven"])
    for cells in (mirrored, mirrored * [-1, 1, 1]):
        assemble(cells, [0] * 7, [modcube] * 7, cache=cache)
    assert len(list(cache.folder.iterdir())) == 3


def test_kept_table_equals_the_one_built(modcube: Vehicle, cache: DragCache) -> None:
    first, second = (assemble(ELBOW, [0] * 3, [modcube] * 3, cache=cache).drag for _ in range(2))
    np.testing.assert_array_equal(first.nodes, second.nodes)
    np.testing.assert_array_equal(first.nodes, assemble(ELBOW, [0] * 3, [modcube] * 3).drag.nodes)


def test_coefficients_and_masses_do_not_make_new_entries(modcube: Vehicle, cache: DragCache) -> None:
    other = dataclasses.replace(modcube, drag=dataclasses.replace(modcube.drag, cd_face=0.9))
    for vehicle in (modcube, other):
        assemble([(0, 0, 0)], [0], [vehicle], cache=cache)
    assert len(list(cache.folder.iterdir())) == 1


@pytest.mark.parametrize("damage", ["cut short", "one bit", "older version", "another key", "empty", "not finite"])
def test_damaged_or_older_file_is_rebuilt_never_believed(damage: str, modcube: Vehicle, cache: DragCache) -> None:
    good = assemble(ELBOW, [0] * 3, [modcube] * 3, cache=cache).drag.nodes
    path = next(cache.folder.iterdir())
    raw = path.read_bytes()
    broken = {
        "cut short": raw[:-9],
        "one bit": raw[:-1000] + bytes([raw[-1000] ^ 1]) + raw[-999:],
        "older version": raw.replace(b"outlines 1 ", b"outlines 0 ", 1),
        "another key": raw.replace(b"exact 13", b"exact 12", 1),
        "empty": b"",
        "not finite": raw[:-8] + b"\xff" * 8,
    }[damage]
    path.write_bytes(broken)
    np.testing.assert_array_equal(assemble(ELBOW, [0] * 3, [modcube] * 3, cache=cache).drag.nodes, good)
    assert path.read_bytes() == raw


def test_body_is_built_without_a_folder_that_can_be_written(modcube: Vehicle, tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    body = assemble([(0, 0, 0)], [0], [modcube], cache=DragCache(blocked / "drag"))
    np.testing.assert_array_equal(body.drag.nodes, assemble_vehicle(modcube).drag.nodes)


def test_cache_is_where_the_user_s_environment_says() -> None:
    home = Path("home")
    assert default_folder({"XDG_CACHE_HOME": "/elsewhere"}, home) == Path("/elsewhere/modcube/drag")
    assert default_folder({}, home) == home / ".cache" / "modcube" / "drag"
    assert default_folder({"XDG_CACHE_HOME": "relative"}, home) == home / ".cache" / "modcube" / "drag"


# ---------------------------------------------------------------- tools/build_drag_table.py


def drag_tool(*arguments: str) -> Result:
    return CliRunner().invoke(build_drag_table.app, arguments)


@pytest.mark.parametrize("place", ["folder", "file/spaces.png", "spaces.none"])
def test_picture_that_cannot_be_written_is_refused_in_one_line(place: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    given = drag_tool("--cells", "0,0,0", "--cache", str(tmp_path / "drag"), "--out", str(tmp_path / place))
    assert isinstance(given.exception, DescriptionError)
    assert "\n" not in str(given.exception) and f"--out {tmp_path / place}: " in str(given.exception)
    assert not (tmp_path / "folder.png").exists()


def test_cache_that_cannot_be_written_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    given = drag_tool("--cells", "0,0,0", "--cache", str(tmp_path / "file"), "--out", str(tmp_path / "spaces.png"))
    assert isinstance(given.exception, DescriptionError)
    assert str(given.exception) == f"--cache {tmp_path / 'file'}: {tmp_path / 'file'} is a file; a folder is needed"


@pytest.mark.slow
def test_picture_is_right_handed_with_z_down_and_its_table_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    given = drag_tool("--cells", "0,0,0 0,1,0 1,0,0", "--cache", str(tmp_path / "drag"), "--out", str(tmp_path / "spaces.png"))
    assert given.exit_code == 0, given.stderr
    limits = [np.diff(getattr(drawn[0].axes[0], f"get_{axis}lim")())[0] for axis in "xyz"]
    assert np.prod(limits) > 0.0 > limits[2]
    table = given.stdout[given.stdout.index("shape") :]
    assert all(f"({','.join(map(str, flow))})" in table for flow in build_drag_table.FLOWS)
    assert max(map(len, table.splitlines()[:4])) <= 80 and "\u2026" not in table


def test_one_module_is_not_several() -> None:
    assert [list(build_drag_table.shapes_of(cells)) for cells in ("0,0,0", "0,0,0 1,0,0")] == [["1 module"], ["2 modules"]]
