"""Vehicle files: thrusters as published, converted from FLU to FRD where the source is FLU; tags on their faces."""

import dataclasses
import itertools
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from firmware_py import cli
from firmware_py.description.schema import DescriptionError, limits_of
from firmware_py.description.toml_text import to_toml
from firmware_py.description.vehicle import FACE_NAMES, FACE_NORMALS, Drag, Inertial, Vehicle
from firmware_py.description.vehicle_file import load_vehicle, vehicle_names
from firmware_py.prepare.assembly import assemble_vehicle
from tests.unit.capability_layouts import FLU_TO_FRD

MODULES = ("modcube", "modcube_sim")
S, A, B = 0.70710678, 0.848048, 0.529919

PUBLISHED = {
    "modcube": ("FLU", [
        [0.07, 0.07, -0.07, S, S, 0], [0.07, -0.07, -0.07, S, -S, 0], [-0.07, 0.07, 0.07, -S, S, 0],
        [-0.07, -0.07, 0.07, -S, -S, 0], [0.07, 0.07, 0.07, 0, S, S], [0.07, -0.07, 0.07, 0, -S, S],
        [-0.07, 0.07, -0.07, 0, -S, -S], [-0.07, -0.07, -0.07, 0, S, -S],
    ]),
    "modcube_sim": ("FLU", [
        [0.07, 0.07, -0.07, S, -S, 0], [0.07, -0.07, -0.07, S, S, 0], [-0.07, 0.07, 0.07, -S, -S, 0],
        [-0.07, -0.07, 0.07, -S, S, 0], [0.07, 0.07, 0.07, 0, 0, 1], [0.07, -0.07, 0.07, 0, 0, 1],
        [-0.07, 0.07, -0.07, 0, 0, 1], [-0.07, -0.07, -0.07, 0, 0, 1],
    ]),
    "bluerov2": ("FLU", [
        [0.14, -0.092, -0.011, S, S, 0], [0.14, 0.092, -0.011, S, -S, 0], [-0.15, -0.092, -0.011, -S, S, 0],
        [-0.15, 0.092, -0.011, -S, -S, 0], [0, -0.109, 0.066, 0, 0, 1], [0, 0.109, 0.066, 0, 0, 1],
    ]),
    "bluerov2_heavy": ("FLU", [
        [0.14, -0.092, -0.011, S, S, 0], [0.14, 0.092, -0.011, S, -S, 0], [-0.15, -0.092, -0.011, -S, S, 0],
        [-0.15, 0.092, -0.011, -S, -S, 0], [0.118, -0.215, 0.053, 0, 0, 1], [0.118, 0.215, 0.053, 0, 0, 1],
        [-0.118, -0.215, 0.053, 0, 0, 1], [-0.118, 0.215, 0.053, 0, 0, 1],
    ]),
    "girona500": ("FRD", [
        [-0.3297, -0.2587, -0.021, 1, 0, 0], [-0.3297, 0.2587, -0.021, 1, 0, 0], [0.5347, 0, -0.3137, 0, 0, 1],
        [-0.5827, 0, -0.3137, 0, 0, 1], [-0.0627, 0.0307, -0.021, 0, 1, 0],
    ]),
    "chasing_m2": ("FLU", [
        [0.13, -0.1, 0, A, B, 0], [0.13, 0.1, 0, A, -B, 0], [-0.13, -0.1, 0, -A, B, 0], [-0.13, 0.1, 0, -A, -B, 0],
        [0.13, -0.1, 0.05, 0, 0, 1], [0.13, 0.1, 0.05, 0, 0, 1], [-0.13, -0.1, 0.05, 0, 0, 1],
        [-0.13, 0.1, 0.05, 0, 0, 1],
    ]),
}  # fmt: skip
"""Axes and rows [position m, direction] as their sources have them; each vehicle file names its source."""


def wrench_matrix(vehicle: Vehicle) -> np.ndarray:
    """(6, n) [direction; position x direction], by numpy alone."""
    return np.vstack([vehicle.directions.T, np.cross(vehicle.positions, vehicle.directions).T])


def test_every_shipped_vehicle_has_a_published_layout_here() -> None:
    assert set(vehicle_names()) == set(PUBLISHED)


@pytest.mark.parametrize("name", PUBLISHED)
def test_thrusters_are_the_published_ones_in_frd(name: str) -> None:
    axes, rows = PUBLISHED[name]
    published = np.array(rows, dtype=float)
    turn = FLU_TO_FRD if axes == "FLU" else np.eye(3)
    vehicle = load_vehicle(name)
    np.testing.assert_allclose(vehicle.positions, published[:, :3] @ turn, atol=1e-12)
    np.testing.assert_allclose(vehicle.directions, published[:, 3:] @ turn, atol=1e-4)


def test_flu_becomes_frd_by_a_half_turn_about_x() -> None:
    """Left and up change sign, ahead does not; handedness stays. Singular values alone would not notice a mirror."""
    np.testing.assert_allclose(FLU_TO_FRD, Rotation.from_euler("x", np.pi).as_matrix(), atol=1e-15)
    assert np.linalg.det(FLU_TO_FRD) == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["bluerov2", "bluerov2_heavy"])
def test_vertical_thrusters_sit_above_the_middle_and_push_up(name: str) -> None:
    """Up is -z in FRD; their water leaves downward at a positive command."""
    vehicle = load_vehicle(name)
    vertical = np.abs(vehicle.directions[:, 2]) > 0.9
    assert np.all(vehicle.directions[vertical, 2] < 0) and np.all(vehicle.positions[vertical, 2] < 0)


def test_front_right_thruster_of_the_bluerov_is_on_the_right() -> None:
    """In FRD starboard is +y; its force ahead and to port turns the nose to port, which is negative yaw."""
    vehicle = load_vehicle("bluerov2")
    assert vehicle.positions[0, 0] > 0 and vehicle.positions[0, 1] > 0
    assert wrench_matrix(vehicle)[5, 0] < 0


SINGULAR = {
    "modcube": [2.0012, 1.4142, 1.4142, 0.1714, 0.14, 0.07],
    "modcube_sim": [2.0, 1.4142, 1.4142, 0.2335, 0.1715, 0.1187],
}
"""Singular values of the errata, calculated independently of this code."""


@pytest.mark.parametrize("name", MODULES)
def test_singular_values_are_those_of_the_paper_and_its_simulation(name: str) -> None:
    got = np.linalg.svd(wrench_matrix(load_vehicle(name)), compute_uv=False)
    np.testing.assert_allclose(got, SINGULAR[name], atol=6e-5)


@pytest.mark.parametrize("name", PUBLISHED)
def test_rank_tells_which_vehicles_leave_a_freedom_to_buoyancy(name: str) -> None:
    vehicle = load_vehicle(name)
    rank = 5 if name in ("bluerov2", "girona500") else 6
    assert np.linalg.matrix_rank(wrench_matrix(vehicle), tol=1e-6) == rank
    assert len(vehicle.passive_dof) == 6 - rank


def largest_moment(vehicle: Vehicle, direction: np.ndarray) -> float:
    """Largest moment about `direction` at zero force, within the limits of the thrusters, N m."""
    n = len(vehicle.thruster)
    rows = np.c_[wrench_matrix(vehicle), -np.r_[np.zeros(3), direction]]
    bounds = [(vehicle.force_min_n, vehicle.force_max_n)] * n + [(0, None)]
    return float(linprog(np.r_[np.zeros(n), -1.0], A_eq=rows, b_eq=np.zeros(6), bounds=bounds).x[-1])


def test_moments_of_the_module_are_those_of_the_errata() -> None:
    vehicle = load_vehicle("modcube")
    for axis, expected in enumerate([1.78, 3.17, 1.58]):
        weaker = min(largest_moment(vehicle, sign * np.eye(3)[axis]) for sign in (1.0, -1.0))
        assert weaker == pytest.approx(expected, abs=0.006)


def test_module_without_any_one_thruster_still_moves_in_all_six_axes() -> None:
    matrix = wrench_matrix(load_vehicle("modcube"))
    for dead in range(8):
        assert np.linalg.matrix_rank(np.delete(matrix, dead, axis=1), tol=1e-6) == 6


def test_three_pairs_of_dead_thrusters_cost_an_axis() -> None:
    matrix = wrench_matrix(load_vehicle("modcube"))
    lost = {
        pair
        for pair in itertools.combinations(range(8), 2)
        if np.linalg.matrix_rank(np.delete(matrix, pair, axis=1), tol=1e-6) < 6
    }
    assert lost == {(4, 7), (5, 6), (2, 3)}


# ---------------------------------------------------------------- tags and faces


@pytest.mark.parametrize("name", PUBLISHED)
def test_tags_lie_in_their_faces_and_look_out(name: str) -> None:
    """A tag on a face has the face's number, sits on the hull, and its z axis points into the face."""
    vehicle = load_vehicle(name)
    for tag in vehicle.tag:
        normal = FACE_NORMALS[tag.id]
        z_axis = Rotation.from_quat(np.array(tag.quaternion[[1, 2, 3, 0]])).as_matrix()[:, 2]
        np.testing.assert_allclose(z_axis, -normal, atol=1e-9)
        np.testing.assert_allclose(tag.position_m, 0.5 * vehicle.hull.size_m * normal, atol=1e-9)


@pytest.mark.parametrize("name", MODULES)
def test_module_carries_a_tag_on_every_face(name: str) -> None:
    assert sorted(tag.id for tag in load_vehicle(name).tag) == list(range(6))


def test_faces_are_named_after_their_normals() -> None:
    for name, normal in zip(FACE_NAMES, FACE_NORMALS, strict=True):
        expected = np.zeros(3)
        expected["xyz".index(name[1])] = 1.0 if name[0] == "+" else -1.0
        np.testing.assert_array_equal(normal, expected)


@pytest.mark.parametrize("name", PUBLISHED)
def test_inertia_of_every_vehicle_is_one_that_a_body_can_have(name: str) -> None:
    """Symmetric, positive, and no principal moment above the sum of the others."""
    inertia = np.array(load_vehicle(name).inertial.inertia)
    np.testing.assert_array_equal(inertia, inertia.T)
    a, b, c = np.linalg.eigvalsh(inertia)
    assert a > 0.0 and c <= a + b + 1e-12


def test_what_is_assumed_is_said() -> None:
    for name in vehicle_names():
        vehicle = load_vehicle(name)
        assert vehicle.source and vehicle.assumption
    assert "layout" in load_vehicle("chasing_m2").assumption


def test_drag_along_the_diagonal_follows_from_face_and_edge() -> None:
    """cd = c0 + c4 (x^4 + y^4 + z^4): face 1, edge 1/2, corner 1/3."""
    vehicle = load_vehicle("modcube")
    slope = (vehicle.drag.cd_face - vehicle.drag.cd_edge) / 0.5
    assert vehicle.cd_corner == pytest.approx(vehicle.drag.cd_face - slope * 2.0 / 3.0)


# ---------------------------------------------------------------- refusals


def changed(folder: Path, old: str, new: str, count: int = 1) -> Path:
    """A copy of modcube.toml with `old` replaced by `new`."""
    text = (resources.files("firmware_py") / "vehicles" / "modcube.toml").read_text()
    assert old in text
    path = folder / "odd.toml"
    path.write_text(text.replace(old, new, count))
    return path


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("direction = [0.7071067811865476, -0", "direction = [0.9, -0", r":\d+: thruster\[0\]: .* has length 1.14.*, not 1; give \[0.786"),
        ("quaternion = [1.0, 0.0, 0.0", "quaternion = [1.0, 0.5, 0.0", r":\d+: tag\[5\]: .* has length 1.118, not 1; give \[0.8944,"),
        ("id = 3", "id = 2", r"odd.toml:90: two \[\[tag\]\] tables have the same id"),
        ("[hull]", f'[hull]\nmesh = "{"x" * 300}"', r"odd.toml:\d+: hull.mesh: .*: there is no such mesh"),
        ('faces = "PDPDPD"', 'faces = "PDPD"', "odd.toml:5: faces 'PDPD' needs six letters out of P, D and -"),
        ('faces = "PDPDPD"', 'faces = "PDPDPX"', "needs six letters out of P, D and -"),
        ("dry_kg = 2.6", "dry_kg = 0.0", r"inertial.dry_kg: 0.0 is out of range; permitted: 0.01 to 5000 kg"),
        ("force_min_n = -8.0", "force_min_n = 8.0", r"force_min_n: 8.0 is out of range"),
        ("lag_s = 0.08", "lag_s = nan", r"curve.lag_s: nan is out of range; permitted: 0 to 2 s"),
        ("0.0, 0.068, 0.0], [0.0, 0.0, 0.068", "0.0, 0.068, 0.0], [0.0, 0.0, -0.068", r":\d+: inertial: inertia .* is not physical:"),
        ("inertia = [[0.068, 0.0", "inertia = [[0.068, 0.01", "it must be symmetric and positive"),
        ("0.0, 0.068, 0.0], [0.0, 0.0, 0.068", "0.0, 0.068, 0.0], [0.0, 0.0, 0.2", "no principal moment above the sum of the others"),
        ("forward = [1.5, 9.0, -0.5", "forward = [1.5, 9.0, -20.5", r":\d+: curve: forward .* falls somewhere in 0..1"),
        ("power_reverse = [2.6, 0.52", "power_reverse = [2.6, -0.52", r"odd.toml:31: curve.power_reverse falls somewhere in 0..8 N"),
        ("force_max_n = 10.0", "force_max_n = 30.0", "odd.toml:6: the forward limit of 30 N is above the 10 N of curve.forward"),
        ("cd_edge = 0.80", "cd_edge = 0.80\nquadratic = [1, 2, 3]", r"toml:24: drag.quadratic: has 3 numbers; it needs six, .* or none"),
        (
            "cd_face = 1.05\ncd_edge = 0.80", "cd_face = 5\ncd_edge = 0.1",
            r"odd.toml:23: drag.cd_edge: 0.1 is too small for drag.cd_face, 5: .* must be above cd_face / 4, here 1.25",
        ),
        (
            "cd_edge = 0.80", "cd_edge = 0.80\nlinear = [1e4, 0, 0, 0, 0, 0]",
            r"toml:24: drag.linear: 10000 in surge stops this vehicle within 1\.55 ms, too fast for the ticks; .* at most 775$",
        ),
        ("cd_edge = 0.80", "cd_edge = 0.80\nlinear = [0, 0, 0, 0, 500, 0]", r"drag.linear: 500 in pitch stops .* at most 4\.4$"),
        ("cd_face = 1.05\ncd_edge = 0.80", "cd_face = 1.0\ncd_edge = 0.25", "must be above cd_face / 4, here 0.25"),
        ("[hull]\n", '[hull]\nmesh = "hull.stl"\n', r"odd.toml:\d+: hull.mesh: .*/hull.stl: there is no such mesh"),
        ('name = "modcube"', 'name = ""', r"odd.toml:2: name: '' cannot be the name of a file"),
        ('name = "modcube"', 'name = "../modcube"', r"odd.toml:2: name: '../modcube' cannot be"),
        ('name = "modcube"', r'name = "mod\ncube"', r"odd.toml:2: name: 'mod.ncube' cannot be"),
        ('faces = "P', 'passive_dof = ["roll", "pitch", "roll"]\nfaces = "P', r"odd.toml:5: passive_dof: roll is there twice"),
        ('faces = "P', f'passive_dof = {["surge", "sway", "heave", "roll", "pitch", "yaw"]}\nfaces = "P', "passive_dof: all six are left"),
        ("com_m = [0.0, 0.0, 0.0]", "com_m = [0, 0, 0.11]", r"toml:16: inertial.com_m: \[0.0, 0.0, 0.11\] m is outside the hull"),
        ("dry_kg = 2.6", "dry_kg = 26", r"toml:14: inertial.dry_kg: 32.7 kg, .* cannot float: .* 9.24 kg of water; hull.size_m"),
        ("position_m = [0.105, 0.0, 0.0]", "position_m = [-0.105, 0, 0]", r"odd.toml:\d+: tag\[0\].quaternion: looks into the hull"),
        ("id = 0", "id = 16", r"tag\[0\].id: 16 is out of range; permitted: 0 to 15"),
    ],
)  # fmt: skip
def test_odd_vehicle_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(DescriptionError, match=words):
        load_vehicle(str(changed(tmp_path, old, new)))


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("half", [0.5**0.5, 0.7071, 0.707])
def test_tag_that_stands_upright_at_the_height_of_a_face_does_not_look_into_the_hull(tmp_path: Path, half: float, side: int) -> None:
    """Regression: whether it was refused told the last digit of its quaternion."""
    old = "position_m = [0.105, 0.0, 0.0]\nquaternion = [0.7071067811865476, 0.0, -0.7071067811865476, 0.0]"
    path = changed(tmp_path, old, f"position_m = [0.02, 0.0, {0.105 * side}]\nquaternion = [{half}, 0.0, {-half}, 0.0]")
    np.testing.assert_allclose(load_vehicle(str(path)).tag[0].outward, [1.0, 0.0, 0.0], atol=2e-3)


@pytest.mark.parametrize("arm_m", [0.0, -0.005])
def test_rotation_that_buoyancy_does_not_right_is_not_left_to_it(tmp_path: Path, arm_m: float) -> None:
    """A bench flight of such a vehicle capsized in three seconds, 134 deg off."""
    path = changed(tmp_path, "righting_arm_m = 0.005", f"righting_arm_m = {arm_m}")
    assert load_vehicle(str(path)).inertial.righting_arm_m == arm_m
    path.write_text('passive_dof = ["surge", "pitch"]\n' + path.read_text())
    with pytest.raises(DescriptionError, match=r"toml:20: inertial.righting_arm_m: with .* which leaves pitch to it"):
        load_vehicle(str(path))


def test_vehicle_with_more_thrusters_than_its_frames_carry_is_refused_at_the_first_that_is_too_many(tmp_path: Path) -> None:
    path = changed(tmp_path, "[[tag]]", "[[thruster]]\nposition_m = [0.0, 0.0, 0.0]\ndirection = [1.0, 0.0, 0.0]\n\n[[tag]]")
    line = path.read_text()[: path.read_text().rindex("[[thruster]]")].count("\n") + 1
    words = rf"odd.toml:{line}: thruster\[8\]: 9 thrusters; a module's frames carry 8: leave some out, or divide the vehicle"
    with pytest.raises(DescriptionError, match=words):
        cli.vehicle(str(path))


@pytest.mark.parametrize(
    "drag",
    [
        "cd_face = 1.0\ncd_edge = 0.26",
        "cd_face = 0.0\ncd_edge = 0.0",
        "cd_face = 5.0\ncd_edge = 0.1\nquadratic = [1.0, 1.0, 1.0, 0.1, 0.1, 0.1]",
    ],
)
def test_drag_that_is_negative_in_no_direction_is_taken(tmp_path: Path, drag: str) -> None:
    vehicle = load_vehicle(str(changed(tmp_path, "cd_face = 1.05\ncd_edge = 0.80", drag)))
    assert np.all(assemble_vehicle(vehicle).drag.nodes[..., 0] >= 0.0)


def test_vehicle_without_thrusters_is_refused(tmp_path: Path) -> None:
    path = changed(tmp_path, "[[thruster]]", "[[propeller]]", count=-1)
    with pytest.raises(DescriptionError, match="propeller: unknown key"):
        load_vehicle(str(path))


def test_unknown_vehicle_is_answered_with_the_known_ones() -> None:
    with pytest.raises(DescriptionError, match=r"vehicle 'submarine' is unknown; there are .*modcube, modcube_sim"):
        load_vehicle("submarine")


def test_vehicle_file_may_lie_anywhere(tmp_path: Path) -> None:
    path = changed(tmp_path, 'name = "modcube"', 'name = "mine"')
    assert load_vehicle(str(path)).name == load_vehicle(path.name, tmp_path).name == "mine"


def test_vehicle_whose_texts_have_lines_and_whose_hull_is_a_mesh_is_printed_as_a_file_for_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("from").mkdir()
    Path("to").mkdir()
    Path("from/hull.stl").touch()
    modcube = load_vehicle("modcube")
    assumption = 'two\nlines,\t"quoted"\\ and \x7f'
    made = dataclasses.replace(modcube, assumption=assumption, hull=dataclasses.replace(modcube.hull, mesh="hull.stl"))
    Path("from/odd.toml").write_text(to_toml(made), encoding="utf-8")
    Path("to/odd.toml").write_text(to_toml(load_vehicle("from/odd.toml")), encoding="utf-8")
    again = load_vehicle("to/odd.toml")
    assert (again.assumption, again.hull.mesh) == (assumption, str(tmp_path / "from" / "hull.stl"))


def test_file_of_a_vehicle_says_in_which_order_six_figures_stand() -> None:
    six = [limits_of(cls, name) for cls, name in ((Inertial, "added"), (Drag, "linear"), (Drag, "quadratic"))]
    assert all(limits.help.endswith(": surge, sway, heave, roll, pitch, yaw") for limits in six)
