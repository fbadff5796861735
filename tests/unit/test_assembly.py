"""Docked modules become one body: masses, thrusters, tags, and what may not be docked (the paper's errata)."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from firmware_py.core import rotations
from firmware_py.core.rigid_body import coriolis_wrench
from firmware_py.description.fleet import Fleet, Module
from firmware_py.description.schema import DescriptionError, frozen_array
from firmware_py.description.vehicle import Payload, Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.description.water import GRAVITY
from firmware_py.prepare import lattice
from firmware_py.prepare.assembly import assemble, assemble_fleet, assemble_vehicle, passive_axes

PITCH = 0.21
Cell = tuple[int, int, int]
SHAPES = {
    "one": [(0, 0, 0)],
    "line of two": [(0, 0, 0), (1, 0, 0)],
    "2x2": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)],
    "L of three, upright": [(0, 0, 0), (1, 0, 0), (0, 0, -1)],
    "tripod": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
}


@pytest.fixture(scope="module")
def modcube() -> Vehicle:
    return load_vehicle("modcube")


@pytest.fixture(scope="module")
def lopsided(modcube: Vehicle) -> Vehicle:
    """A module whose mass, added mass and payload (on its -x face) have no symmetry."""
    inertial = dataclasses.replace(
        modcube.inertial,
        com_m=frozen_array([0.012, -0.007, 0.02]),
        inertia=frozen_array([[0.07, 0.004, -0.003], [0.004, 0.062, 0.002], [-0.003, 0.002, 0.081]]),
        added=frozen_array([3.0, 5.0, 8.0, 0.01, 0.02, 0.03]),
    )
    tool = Payload(
        name="gripper",
        dry_kg=0.8,
        entrained_kg=0.3,
        size_m=frozen_array([0.05, 0.1, 0.04]),
        position_m=frozen_array([-0.13, 0.02, -0.01]),
    )
    return dataclasses.replace(modcube, name="lopsided", inertial=inertial, payload=(tool,))


# ---------------------------------------------------------------- the lattice


def test_module_has_24_ways_to_sit_in_the_lattice() -> None:
    assert len({tuple(m.ravel()) for m in lattice.MATRICES}) == 24
    np.testing.assert_array_equal(lattice.MATRICES[0], np.eye(3))
    for matrix, q in zip(lattice.MATRICES, lattice.QUATERNIONS, strict=True):
        assert np.linalg.det(matrix) == pytest.approx(1.0)
        np.testing.assert_allclose(rotations.to_matrix(q.copy()), matrix, atol=1e-15)


def test_turning_twice_is_again_one_of_the_24() -> None:
    for i, j in itertools.product(range(24), repeat=2):
        both = lattice.MATRICES[i] @ lattice.MATRICES[j]
        np.testing.assert_array_equal(lattice.MATRICES[lattice.PRODUCT[i, j]], both)
    for i in range(24):
        assert lattice.PRODUCT[i, lattice.INVERSE[i]] == 0


# ---------------------------------------------------------------- thrusters


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("modcube", [2.0012, math.sqrt(2), math.sqrt(2), 0.1714, 0.14, 0.07]),
        ("modcube_sim", [2.0, math.sqrt(2), math.sqrt(2), 0.2335, 0.1715, 0.1187]),
    ],
)
def test_thrusters_span_all_six_axes_as_the_paper_s_geometry_says(name: str, expected: list[float]) -> None:
    values = np.linalg.svd(assemble_vehicle(load_vehicle(name)).thrusters.matrix, compute_uv=False)
    np.testing.assert_allclose(values, expected, atol=6e-5)


def test_any_one_dead_thruster_leaves_all_six_axes_and_three_pairs_do_not(modcube: Vehicle) -> None:
    matrix = assemble_vehicle(modcube).thrusters.matrix

    def rank_without(*dead: int) -> int:
        return int(np.linalg.matrix_rank(np.delete(matrix, dead, axis=1), tol=1e-6))

    assert all(rank_without(k) == 6 for k in range(8))
    assert {pair for pair in itertools.combinations(range(8), 2) if rank_without(*pair) < 6} == {(4, 7), (5, 6), (2, 3)}


@pytest.mark.parametrize("shape", SHAPES)
def test_each_thruster_pushes_about_the_common_centre_of_mass(shape: str, lopsided: Vehicle) -> None:
    cells = [(2 * x, 2 * y, 2 * z) for x, y, z in SHAPES[shape]]
    vehicle = dataclasses.replace(lopsided, payload=())
    body = assemble([(x // 2, y // 2, z // 2) for x, y, z in cells], [0] * len(cells), [vehicle] * len(cells))
    total = len(cells) * 9.3
    com = sum(9.3 * (PITCH * np.array(c) / 2 + vehicle.inertial.com_m) for c in cells) / total
    for k, column in enumerate(body.thrusters.matrix.T):
        module, channel = int(body.thrusters.module[k]), int(body.thrusters.channel[k])
        position = PITCH * np.array(cells[module]) / 2 + vehicle.positions[channel] - com
        np.testing.assert_allclose(column[:3], vehicle.directions[channel], atol=1e-12)
        np.testing.assert_allclose(column[3:], np.cross(position, vehicle.directions[channel]), atol=1e-12)
    np.testing.assert_allclose(body.thrusters.matrix @ body.thrusters.pinv, np.eye(6), atol=1e-10)


@pytest.mark.slow
def test_turned_module_brings_its_thrusters_and_tags_along(modcube: Vehicle) -> None:
    upright = assemble_vehicle(modcube)
    for rotation in range(24):
        turn = lattice.MATRICES[rotation]
        turned = assemble([(5, -3, 2)], [rotation], [modcube])
        both = np.kron(np.eye(2), turn)
        np.testing.assert_allclose(turned.thrusters.matrix, both @ upright.thrusters.matrix, atol=1e-12)
        np.testing.assert_allclose(turned.r_bt, upright.r_bt @ turn.T, atol=1e-12)
        for q, q_upright in zip(turned.q_bt, upright.q_bt, strict=True):
            np.testing.assert_allclose(rotations.to_matrix(q), turn @ rotations.to_matrix(q_upright), atol=1e-12)


# ---------------------------------------------------------------- mass


def _all(lopsided: Vehicle, count: int) -> list[Vehicle]:
    """`count` lopsided vehicles, of which only the first carries its payload."""
    return [lopsided] + [dataclasses.replace(lopsided, payload=())] * (count - 1)


def _energy_of_parts(
    body_v: np.ndarray, w: np.ndarray, vehicles: list[Vehicle], cells: list[tuple[int, int, int]], turns: list[int]
) -> float:
    """Kinetic energy from the velocities of the parts, without a mass matrix; `body_v` is the velocity of the lattice's origin."""
    energy = 0.0
    for vehicle, cell, index in zip(vehicles, cells, turns, strict=True):
        turn, origin = lattice.MATRICES[index], PITCH * np.array(cell, dtype=float)
        inertial = vehicle.inertial
        w_m = turn.T @ w
        v = body_v + np.cross(w, origin + turn @ inertial.com_m)
        energy += 0.5 * (inertial.dry_kg + inertial.entrained_kg) * v @ v + 0.5 * w_m @ inertial.inertia @ w_m
        v_m = turn.T @ (body_v + np.cross(w, origin))
        energy += 0.5 * inertial.added[:3] @ v_m**2 + 0.5 * inertial.added[3:] @ w_m**2
        for payload in vehicle.payload:
            mass, (a, b, c) = payload.dry_kg + payload.entrained_kg, payload.size_m
            v = body_v + np.cross(w, origin + turn @ payload.position_m)
            box = mass / 12.0 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
            energy += 0.5 * mass * v @ v + 0.5 * box @ w_m**2
    return energy


@pytest.mark.parametrize("shape", SHAPES)
def test_mass_matrix_holds_the_energy_of_all_parts(shape: str, lopsided: Vehicle) -> None:
    cells = SHAPES[shape]
    turns = [0] * len(cells) if len(cells) > 1 else [17]
    vehicles = _all(lopsided, len(cells))
    body = assemble(cells, turns, vehicles)
    origin = -body.r_bm[0] + PITCH * np.array(cells[0])
    rng = np.random.default_rng(3)
    for _ in range(10):
        nu = rng.normal(size=6)
        at_origin = nu[:3] - np.cross(nu[3:], origin)
        expected = _energy_of_parts(at_origin, nu[3:], vehicles, cells, turns)
        assert 0.5 * nu @ body.mass @ nu == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(body.mass, body.mass.T, atol=0.0)
    np.testing.assert_allclose(body.mass @ body.mass_inv, np.eye(6), atol=1e-10)
    assert np.linalg.eigvalsh(body.mass)[0] > 0.0


def test_rigid_part_of_the_mass_matrix_does_not_couple_about_the_centre_of_mass(lopsided: Vehicle) -> None:
    dry = dataclasses.replace(lopsided.inertial, added=frozen_array(np.zeros(6)))
    cells = SHAPES["tripod"]
    body = assemble(cells, [0] * 4, _all(dataclasses.replace(lopsided, inertial=dry), 4))
    np.testing.assert_allclose(body.mass[:3, 3:], 0.0, atol=1e-12)
    np.testing.assert_allclose(body.mass[:3, :3], body.rigid_mass_kg * np.eye(3), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_coriolis_forces_do_no_work_on_any_assembly(shape: str, lopsided: Vehicle) -> None:
    cells = SHAPES[shape]
    mass = assemble(cells, [0] * len(cells), _all(lopsided, len(cells))).mass
    rng = np.random.default_rng(4)
    for _ in range(20):
        nu = rng.normal(size=6)
        assert nu @ coriolis_wrench(mass, nu) == pytest.approx(0.0, abs=1e-11)


def test_inherited_coriolis_signs_fail_the_same_check(lopsided: Vehicle) -> None:
    """In the code that the authors reuse, pitch inertia and products of inertia have a wrong sign, in one place each."""
    mass = assemble_vehicle(lopsided).mass
    nu = np.array([0.3, -0.2, 0.1, 0.5, -0.7, 0.4])
    _, q, r = nu[3:]
    wrong = np.zeros((6, 6))
    wrong[5, 3] -= 2.0 * mass[4, 4] * q
    wrong[4, 5] -= 2.0 * (mass[3, 5] * r + mass[3, 4] * q)
    assert abs(nu @ (coriolis_wrench(mass, nu) + wrong @ nu)) > 1e-2


def test_inherited_rotation_matrix_fails_the_check_that_ours_passes() -> None:
    """The code that the authors reuse has cos(pitch) for cos(roll) in row y, column z."""
    roll, pitch, yaw = 0.3, 0.2, 0.9
    right = rotations.to_matrix(rotations.from_euler(roll, pitch, yaw))
    np.testing.assert_allclose(right @ right.T, np.eye(3), atol=1e-15)
    wrong = right.copy()
    wrong[1, 2] += math.sin(pitch) * math.sin(yaw) * (math.cos(pitch) - math.cos(roll))
    assert np.abs(wrong @ wrong.T - np.eye(3)).max() > 3e-3


def test_righting_moments_of_the_modules_add_up(modcube: Vehicle) -> None:
    body = assemble(SHAPES["2x2"], [0] * 4, [modcube] * 4)
    np.testing.assert_allclose(body.righting, [0.0, 0.0, -4 * GRAVITY * 9.3 * 0.005], atol=1e-12)
    assert float(np.linalg.norm(body.righting)) / 4 == pytest.approx(0.45, abs=0.01)  # 5 mm, at 90 degrees (the paper's errata)
    upside_down = next(i for i, m in enumerate(lattice.MATRICES) if np.array_equal(np.diag(m), [1, -1, -1]))
    swapped = dataclasses.replace(modcube, faces="PDPDDP")
    pair = assemble([(0, 0, 0), (0, 0, 1)], [0, upside_down], [modcube, swapped])
    np.testing.assert_allclose(pair.righting, 0.0, atol=1e-12)


def test_doubt_of_the_righting_moment_lies_along_the_modules_own_axes(modcube: Vehicle) -> None:
    """A level module and one on its side: each with an arm error along its z, trim errors along its x and y, and buoyancy off by 0.5 N."""
    on_its_side = next(i for i, m in enumerate(lattice.MATRICES) if np.array_equal(m, [[1, 0, 0], [0, 0, -1], [0, 1, 0]]))
    body = assemble([(0, 0, 0), (1, 0, 0)], [0, on_its_side], [modcube] * 2)
    arm, trim, lever = GRAVITY * 9.3 * 0.003, GRAVITY * 2.6 * 0.002, 0.5 * 0.105
    assert arm > 5.0 * trim
    expected = [math.sqrt(2.0 * (trim**2 + lever**2)), math.hypot(trim, arm), math.hypot(trim, arm)]
    np.testing.assert_allclose(body.righting_sigma, expected, rtol=1e-12)


def test_supply_of_each_module_is_what_its_electronics_leave(modcube: Vehicle) -> None:
    np.testing.assert_allclose(assemble(SHAPES["2x2"], [0] * 4, [modcube] * 4).supply_power_w, 12.0 * 10.0 - 8.0)


@pytest.mark.slow
def test_no_corner_of_a_hull_is_farther_than_the_reach_of_the_body(modcube: Vehicle) -> None:
    half = 0.5 * modcube.hull.size_m
    for cells in SHAPES.values():
        body = assemble(cells, [0] * len(cells), [modcube] * len(cells))
        corners = [r + half * sign for r in body.r_bm for sign in itertools.product((-1, 1), repeat=3)]
        farthest = np.linalg.norm(corners, axis=1).max()
        assert farthest - 1e-12 <= body.reach_m < 1.25 * farthest


def test_arrays_of_a_body_suit_compiled_functions(modcube: Vehicle) -> None:
    body = assemble(SHAPES["tripod"], [0] * 4, [modcube] * 4)
    arrays = [getattr(body, f.name) for f in dataclasses.fields(body)]
    arrays += [getattr(body.thrusters, f.name) for f in dataclasses.fields(body.thrusters)]
    arrays += [getattr(body.drag, f.name) for f in dataclasses.fields(body.drag)]
    for array in (a for a in arrays if isinstance(a, np.ndarray)):
        assert array.flags.c_contiguous
        assert array.flags.writeable
        assert array.dtype in (np.float64, np.int64)


# ---------------------------------------------------------------- what may not be docked


def test_module_apart_from_the_others_is_refused_by_name(modcube: Vehicle) -> None:
    with pytest.raises(DescriptionError, match="module 10 to module 8"):
        assemble([(0, 0, 0), (1, 0, 0), (3, 0, 0)], [0] * 3, [modcube] * 3, modules=[7, 8, 9])


def test_two_modules_in_one_place_are_refused_by_name(modcube: Vehicle) -> None:
    with pytest.raises(DescriptionError, match="modules 5 and 7 overlap"):
        assemble([(0, 0, 0), (1, 0, 0), (0, 0, 0)], [0] * 3, [modcube] * 3, modules=[4, 5, 6])


def test_probe_against_probe_is_refused_by_name(modcube: Vehicle) -> None:
    half_turn = next(i for i, m in enumerate(lattice.MATRICES) if np.array_equal(np.diag(m), [-1, -1, 1]))
    with pytest.raises(DescriptionError, match=r"module 3's probe on face \+x meets probe on face \+x of module 4"):
        assemble([(0, 0, 0), (1, 0, 0)], [0, half_turn], [modcube] * 2, modules=[2, 3])


def test_drogue_against_drogue_touches_but_holds_nothing(modcube: Vehicle) -> None:
    half_turn = next(i for i, m in enumerate(lattice.MATRICES) if np.array_equal(np.diag(m), [-1, -1, 1]))
    with pytest.raises(DescriptionError, match="no docked face"):
        assemble([(0, 0, 0), (1, 0, 0)], [half_turn, 0], [modcube] * 2)


def test_probe_against_a_bare_face_is_refused(modcube: Vehicle) -> None:
    bare = dataclasses.replace(modcube, faces="P-PDPD")
    with pytest.raises(DescriptionError, match="without drogue"):
        assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [modcube, bare])


def test_payload_in_a_neighbour_s_place_is_refused_by_name(modcube: Vehicle, lopsided: Vehicle) -> None:
    assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [lopsided, modcube])
    with pytest.raises(DescriptionError, match="'gripper' of module 1 is in the way of module 2"):
        assemble([(0, 0, 0), (-1, 0, 0)], [0, 0], [lopsided, modcube])


@pytest.mark.parametrize("count", [0, 65])
def test_body_has_1_to_64_modules(modcube: Vehicle, count: int) -> None:
    with pytest.raises(DescriptionError, match="1 to 64"):
        assemble([(k, 0, 0) for k in range(count)], [0] * count, [modcube] * count)


@pytest.mark.slow
def test_64_modules_make_one_body(modcube: Vehicle) -> None:
    cells = list(itertools.product(range(4), repeat=3))
    body = assemble(cells, [0] * 64, [modcube] * 64)
    assert body.thrusters.matrix.shape == (6, 512)
    assert body.rigid_mass_kg == pytest.approx(64 * 9.3)
    np.testing.assert_allclose(body.mass[:3, 3:], 0.0, atol=1e-9)


def test_fleet_starts_as_its_file_says(modcube: Vehicle) -> None:
    modules = (
        Module(number=1, body=3, cell=frozen_array([0, 0, 0])),
        Module(number=2),
        Module(number=3, body=3, cell=frozen_array([0, 1, 0])),
    )
    bodies = assemble_fleet(Fleet(module=modules), {"modcube": modcube})
    assert [b.modules for b in bodies] == [(0, 2), (1,)]
    np.testing.assert_allclose(bodies[0].r_bm, [[0, -PITCH / 2, 0], [0, PITCH / 2, 0]], atol=1e-12)


def test_passive_axis_turns_with_its_module() -> None:
    """A quarter turn about the vertical makes the pitch of the module the roll of the body."""
    bluerov, quarter = load_vehicle("bluerov2"), np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = next(i for i, matrix in enumerate(lattice.MATRICES) if np.array_equal(matrix, quarter))
    assert assemble_vehicle(bluerov).passive == (4,)
    assert assemble([(0, 0, 0)], [turned], [bluerov]).passive == (3,)


@pytest.mark.parametrize(("cells", "passive"), [([(0, 0, 0), (0, 1, 0)], (4,)), ([(0, 0, 0), (1, 0, 0)], ())], ids=["abreast", "in line"])
def test_axis_of_an_assembly_is_passive_only_where_its_thrusters_cannot_make_it(cells: list[Cell], passive: tuple[int, ...]) -> None:
    """Two BlueROV2 in line pitch by their vertical thrusters, two abreast do not."""
    bluerov = dataclasses.replace(load_vehicle("bluerov2"), faces="PDPDPD")
    assert assemble(cells, [0, 0], [bluerov] * 2, pitch_m=0.5).passive == passive
    fleet = Fleet(module=tuple(Module(number=i + 1, body=0, cell=frozen_array(cell)) for i, cell in enumerate(cells)), pitch_m=0.5)
    assert passive_axes(fleet, [0, 1], {fleet.module[0].vehicle: bluerov}) == passive


def test_module_that_controls_every_axis_has_no_passive_one(modcube: Vehicle) -> None:
    assert assemble_vehicle(modcube).passive == ()


def test_vehicle_with_more_thrusters_than_its_frames_carry_cannot_fly(modcube: Vehicle) -> None:
    crowded = dataclasses.replace(modcube, thruster=(*modcube.thruster, modcube.thruster[0]))
    with pytest.raises(DescriptionError, match=r"vehicle crowded\.toml: 9 thrusters; a module's frames carry 8"):
        assemble_fleet(Fleet(module=(Module(number=1, vehicle="crowded.toml"),)), {"crowded.toml": crowded})
