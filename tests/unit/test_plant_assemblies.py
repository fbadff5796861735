"""Docked bodies of the plant: lattice, masses by its own sums, motion, drag with shelter. The controller's figures are only compared."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import quad

from firmware_py.core import rotations
from firmware_py.description.fleet import Fleet, Module
from firmware_py.description.schema import DescriptionError, frozen_array
from firmware_py.description.vehicle import Vehicle
from firmware_py.prepare import lattice as controllers_lattice
from firmware_py.prepare.assembly import assemble
from firmware_py.prepare.projected_area import areas_and_centroids, box
from hil.plant import shelter
from hil.plant.draw import skew, stream
from hil.plant.lattice import QUATERNIONS, is_connected, place
from hil.plant.polycube import grow
from hil.plant.spec import CALM, WorldSpec
from hil.plant.world import STEP_NS, Start, World
from hil.scenario import Scenario, load_scenario, make_world
from tests.unit.plant_docks import OCEAN, PERIOD_NS, VEHICLE

UNEVEN = dataclasses.replace(
    VEHICLE,
    inertial=dataclasses.replace(
        VEHICLE.inertial, added=np.array([3.0, 9.0, 6.0, 0.01, 0.03, 0.02]), com_m=np.array([0.01, -0.02, 0.015]), righting_arm_m=0.0
    ),
)
"""A module with uneven added mass, an off-centre centre of mass and no righting moment."""
SHAPES = {
    "line": [[0, 0, 0], [1, 0, 0]],
    "L": [[0, 0, 0], [1, 0, 0], [1, 1, 0]],
    "2x2": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]],
    "tower": [[0, 0, 0], [0, 0, 1], [0, 0, 2], [1, 0, 2], [1, 1, 2]],
}


def maps_of(cells: list[list[int]]) -> np.ndarray:
    count = len(cells)
    return shelter.shelter_maps(0.21 * np.array(cells), np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), 0.21))


def outline(maps: np.ndarray, d: np.ndarray) -> float:
    own = 0.21**2 * np.abs(d).sum()
    return own * sum(shelter.seen_share(maps, k, tuple(d.tolist()))[0] for k in range(len(maps)))


def test_rotation_numbers_mean_the_same_on_both_sides() -> None:
    for q, matrix in zip(QUATERNIONS, controllers_lattice.MATRICES, strict=True):
        np.testing.assert_allclose(rotations.to_matrix(q.copy()), matrix, atol=1e-15)


@pytest.mark.parametrize("name", SHAPES)
def test_parts_of_all_modules_make_up_the_outline_that_the_flow_sees(name: str) -> None:
    cells, rng = SHAPES[name], np.random.default_rng(1)
    maps = maps_of(cells)
    solids = [box(np.full(3, 0.21)).placed(np.eye(3), 0.21 * np.array(c, dtype=float)) for c in cells]
    directions = rng.standard_normal((200, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    exact, _ = areas_and_centroids(solids, directions)
    found = np.array([outline(maps, d) for d in directions])
    error = found / exact - 1.0
    assert np.sqrt(np.mean(error**2)) < 0.02 and np.abs(error).max() < 0.07


def test_flow_from_both_ends_is_resisted_alike() -> None:
    maps = maps_of(SHAPES["L"])
    for d in np.random.default_rng(2).standard_normal((50, 3)):
        for k in range(3):
            assert shelter.seen_share(maps, k, tuple(d.tolist())) == pytest.approx(shelter.seen_share(maps, k, tuple((-d).tolist())))


def test_covered_sides_do_not_count() -> None:
    np.testing.assert_allclose(shelter.side_shares(maps_of(SHAPES["line"])), [[0.5, 1, 1], [0.5, 1, 1]])


def test_line_along_the_flow_has_half_the_drag_of_two_modules_apart() -> None:
    maps = maps_of(SHAPES["line"])
    assert outline(maps, np.array([1.0, 0.0, 0.0])) == pytest.approx(0.21**2)
    assert outline(maps, np.array([0.0, 1.0, 0.0])) == pytest.approx(2 * 0.21**2)


def about_com(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Mass matrix and thruster matrix of the first body about its centre of mass."""
    world = make_world(scenario, 0, PERIOD_NS)
    arrays, x = world._body_arrays, world._body_arrays.state[0]
    r = rotations.rotate_back(x[3:7].copy(), world.body_truth(0).p_wb - x[:3])
    h = np.block([[np.eye(3), skew(r)], [np.zeros((3, 3)), np.eye(3)]])
    columns = world._thrusters.column.copy()
    columns[:, 3:] -= np.cross(r, columns[:, :3])
    return h.T @ (arrays.rigid[0] + arrays.added[0]) @ h, columns.T


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_calm_plant_and_controller_agree_on_any_shape(seed: int) -> None:
    scenario = load_scenario("polycube").for_seed(seed).with_calm_world()
    mass, thrusters = about_com(scenario)
    modules = [Module(number=m.number, body=0, cell=m.cell, rotation=m.rotation) for m in scenario.module]
    fleet = Fleet(module=tuple(modules))
    body = assemble(
        [m.cell.astype(int) for m in fleet.module], [m.rotation for m in fleet.module], [VEHICLE] * len(modules)
    )
    np.testing.assert_allclose(mass, body.mass, atol=1e-12)
    np.testing.assert_allclose(thrusters, body.thrusters.matrix, atol=1e-14)


def test_docked_pair_starts_with_its_centre_of_mass_on_the_path() -> None:
    world = make_world(load_scenario("mobius-2"), 0, PERIOD_NS)
    np.testing.assert_allclose(world.body_truth(0).p_wb, [1.3, 0.0, 1.5], atol=1e-12)
    np.testing.assert_allclose(world.truth(1).p_wm - world.truth(0).p_wm, [0.0, 0.21, 0.0], atol=1e-12)
    assert world.body_truth(0).modules == (0, 1)


def test_docked_modules_keep_supplies_of_their_own() -> None:
    world = make_world(load_scenario("mobius-2").with_calm_world(), 0, PERIOD_NS)
    world.set_command(1, np.full(8, 0.9))
    for _ in range(50):
        world.advance(PERIOD_NS)
    assert world.truth(1).current_a > 5.0 > world.truth(0).current_a


def test_rigid_pair_stays_in_its_lattice_while_it_tumbles() -> None:
    world = make_world(load_scenario("mobius-4"), 1, PERIOD_NS)
    world.set_motion(0, np.array([0.2, 0.1, 0.0]), np.array([0.5, -0.4, 0.8]))
    for _ in range(200):
        world.advance(PERIOD_NS)
    truths = [world.truth(m) for m in range(4)]
    for cell, truth in zip(SHAPES["2x2"], truths, strict=True):
        between = rotations.rotate_back(truths[0].q_wm, truth.p_wm - truths[0].p_wm)
        np.testing.assert_allclose(between, 0.21 * np.array(cell), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_random_shapes_can_be_docked(seed: int) -> None:
    seats = grow(stream(seed, "shape"), 8, VEHICLE.faces)
    assert is_connected(np.array([s.cell for s in seats]))
    assemble([s.cell for s in seats], [s.rotation for s in seats], [VEHICLE] * 8)  # refuses probe against probe


def test_body_whose_cells_do_not_touch_is_refused() -> None:
    scenario = load_scenario("mobius-2")
    apart = dataclasses.replace(scenario.module[1], cell=frozen_array([2, 0, 0]))
    with pytest.raises(DescriptionError, match="modules 1, 2"):
        dataclasses.replace(scenario, module=(scenario.module[0], apart))


# ---------------------------------------------------------------- motion


def docked(cells: list[list[int]], vehicle: Vehicle, turns: tuple[int, ...] = (), step_ns: int = STEP_NS, **world: float) -> World:
    """Modules that start docked and tilted in calm deep water, the first one at the origin of the body."""
    places = [place(np.array(c), r, 0.21, np.array(cells[0])) for c, r in zip(cells, turns or (0,) * len(cells), strict=True)]
    starts = [Start(np.array([0.0, 0.0, 400.0]), rotations.from_euler(0.4, -0.7, 1.9))] * len(cells)
    spec, period_ns = WorldSpec(**{**CALM, **world}), max(step_ns, PERIOD_NS // 1000)
    return World(spec, OCEAN, [vehicle] * len(cells), starts, 0, period_ns, step_ns, groups=[tuple(range(len(cells)))], places=places)


def test_current_only_moves_the_frame_of_docked_modules() -> None:
    """A body of any shape moves relative to a steady current as it does relative to still water (Galilean invariance)."""
    moving, still = (docked(SHAPES["L"], UNEVEN, (0, 4, 12), current_m_s=speed) for speed in (0.3, 0.0))
    current = moving.truth(0).current_w
    assert np.linalg.norm(current) == pytest.approx(0.3)
    moving.set_motion(0, np.array([0.2, -0.1, 0.3]) + current, np.array([0.5, -1.0, 0.8]))
    still.set_motion(0, np.array([0.2, -0.1, 0.3]), np.array([0.5, -1.0, 0.8]))
    for _ in range(100):
        moving.advance(PERIOD_NS)
        still.advance(PERIOD_NS)
    for m in range(3):
        np.testing.assert_allclose(moving.truth(m).p_wm - current, still.truth(m).p_wm, atol=1e-9)
        np.testing.assert_allclose(moving.truth(m).q_wm, still.truth(m).q_wm, atol=1e-9)


def test_neutral_docked_modules_are_carried_along_by_accelerating_water_and_not_turned() -> None:
    """Without drag, a neutral body whose weight and buoyancy act at the same point follows the water (Froude-Krylov and added mass)."""
    smooth = dataclasses.replace(UNEVEN, drag=dataclasses.replace(UNEVEN.drag, cd_face=0.0, cd_edge=0.0, rotational_cd=0.0))
    world = docked(SHAPES["L"], smooth, (0, 4, 12), gust_m_s=0.3, gust_time_s=2.0, gust_smoothing_s=0.5)
    world.set_motion(0, world.truth(0).current_w, np.zeros(3))
    before = world.truth(0).current_w
    for _ in range(100):
        world.advance(PERIOD_NS)
    assert np.linalg.norm(world.truth(0).current_w - before) > 0.05, "the water must have changed its speed, or the test proves nothing"
    for m in range(3):
        np.testing.assert_allclose(world.truth(m).v_w, world.truth(m).current_w, atol=1e-7)
        np.testing.assert_allclose(world.truth(m).w_b, 0.0, atol=1e-7)


def test_accelerometer_of_every_docked_module_feels_what_its_own_motion_says() -> None:
    """Compares specific forces with differences of the hulls' velocities while a body tumbles and an external push turns it."""
    world = docked(SHAPES["L"], UNEVEN, (0, 4, 12), step_ns=10_000)
    world.push[2] = [1.5, 1.0, -2.0, 0.25, 0.15, -0.3]
    world.set_motion(0, np.array([0.2, -0.1, 0.3]), np.array([0.3, -0.6, 0.5]))
    before = [world.truth(m) for m in range(3)]
    world.advance(10_000)
    assert world.bodies == [(0, 1, 2)]
    after = [world.truth(m) for m in range(3)]
    for now, then in zip(before, after, strict=True):
        acceleration = (then.v_w - now.v_w) / 1e-5
        felt = rotations.rotate_back(now.q_wm, acceleration - np.array([0.0, 0.0, 9.81]))
        np.testing.assert_allclose(0.5 * (now.specific_force + then.specific_force), felt, atol=1e-4)


# ---------------------------------------------------------------- drag


def drag_on(world: World, v_b: np.ndarray, w_b: np.ndarray) -> np.ndarray:
    """(6,) drag force and moment of still water about the origin of a neutral body that moves at `v_b`, `w_b`; body frame."""
    world.set_motion(0, rotations.rotate(world.body_truth(0).q_wb, v_b), w_b)
    moving = world._body_arrays.wrench[0].copy()
    world.set_motion(0, np.zeros(3), np.zeros(3))
    return moving - world._body_arrays.wrench[0]


@pytest.mark.parametrize("name", SHAPES)
def test_drag_acts_where_the_middle_of_the_outline_is(name: str) -> None:
    world, cells = docked(SHAPES[name], VEHICLE), SHAPES[name]
    directions = np.random.default_rng(6).standard_normal((40, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    solids = [box(np.full(3, 0.21)).placed(np.eye(3), 0.21 * np.array(c, dtype=float)) for c in cells]
    _, middles = areas_and_centroids(solids, directions)
    for d, middle in zip(directions, middles, strict=True):
        drag = drag_on(world, 0.5 * d, np.zeros(3))
        off_m = np.linalg.norm(drag[3:] - np.cross(middle, drag[:3])) / np.linalg.norm(drag[:3])
        assert off_m < 0.002


def test_sides_that_a_line_of_two_covers_do_not_brake_its_turning() -> None:
    """About the first module's centre, by quadrature: strips of both modules' sides, and the other module's speed through the water."""
    half, reach, cd = 0.105, 0.21, VEHICLE.drag
    open_sides = quad(lambda y: abs(y) * y * y, -half, half)[0]
    across_x = 0.5 * open_sides  # one side of each pair is covered
    near = open_sides + across_x
    far = quad(lambda y: abs(reach + y) * (reach + y) * y, -half, half)[0] + across_x
    turning = 0.5 * WorldSpec().density * cd.rotational_cd * 0.21 * (near + far)
    pushed = 0.5 * WorldSpec().density * cd.cd_face * 0.21**2 * reach**2 * reach
    drag = drag_on(docked(SHAPES["line"], VEHICLE), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert drag[5] == pytest.approx(-(turning + pushed), rel=1e-3)
