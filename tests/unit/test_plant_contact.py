"""Contact of two free bodies may only dissipate energy: collisions at any tilt, against an independent computation of the spring energy."""

import dataclasses

import numpy as np
import pytest
import shapely
import shapely.affinity
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection

from firmware_py.core import rotations
from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from hil.plant.contact import touch
from hil.plant.dock_spec import DockSpec
from hil.plant.spec import CALM, WorldSpec
from hil.plant.world import STEP_NS, Start, World
from tests.unit.plant_docks import LEVEL, OCEAN, PERIOD_NS, SLIPPERY, SMOOTH, hulls, run, two

DEPTH_M = 400.0
COLLISIONS = 120
TICKS = 250
DAMPED, ELASTIC = 1e-9, 1e-4
"""Share of the energy that the integration may add: in contact with the usual dissipation, and without dissipation."""


def pair(
    away_m: np.ndarray, q: np.ndarray, other_q: np.ndarray, vehicle: Vehicle = SMOOTH, step_ns: int = STEP_NS, **springs: float
) -> World:
    """Two modules without drag in calm deep water; `springs`: fields of `contact.Faces` to replace."""
    first = np.array([0.0, 0.0, DEPTH_M])
    starts = [Start(first, q), Start(first + away_m, other_q)]
    world = World(WorldSpec(**CALM), OCEAN, [vehicle] * 2, starts, 0, PERIOD_NS, step_ns)
    world.docks.faces = world.docks.faces._replace(**springs)
    return world


def colliding_pair(seed: int, **springs: float) -> World:
    """Two turning hulls about to collide off centre: for every third seed almost face to face, else at any tilt."""
    rng = np.random.default_rng(seed)
    q, other_q = (rotations.normalise(rng.standard_normal(4)) for _ in range(2))
    way = rng.standard_normal(3)
    if seed % 3 == 0:
        other_q, way = rotations.normalise(rotations.multiply(q, rotations.exp(0.1 * rng.standard_normal(3)))), rotations.to_matrix(q)[:, 1]
    way = way / np.linalg.norm(way)
    side = np.cross(way, rng.standard_normal(3))
    side /= np.linalg.norm(side)
    world = pair(0.38 * way + rng.uniform(0.0, 0.25) * side, q, other_q, **springs)
    speed = rng.uniform(0.05, 0.3)
    world.set_motion(0, np.zeros(3), rng.uniform() * rng.standard_normal(3))
    world.set_motion(1, -speed * way + 0.3 * speed * rng.standard_normal() * side, rng.uniform() * rng.standard_normal(3))
    return world


def energy_history(world: World) -> np.ndarray:
    """(TICKS + 1,) kinetic energy of both hulls, J: before they meet, and after each tick."""
    energy = [world.kinetic_energy().sum()]
    for _ in range(TICKS):
        world.advance(PERIOD_NS)
        energy.append(world.kinetic_energy().sum())
    return np.array(energy)


@pytest.mark.slow
def test_hulls_that_collide_at_any_tilt_gain_no_energy_and_keep_their_momentum() -> None:
    met = 0
    for seed in range(COLLISIONS):
        world = colliding_pair(seed)
        momentum = world.momentum().sum(axis=0)
        energy = energy_history(world)
        assert energy.max() <= (1.0 + DAMPED) * energy[0], f"collision {seed}"
        np.testing.assert_allclose(world.momentum().sum(axis=0), momentum, rtol=0, atol=2e-6 * np.abs(momentum).max())
        met += bool(energy[-1] < 0.99 * energy[0])
    assert met > 0.8 * COLLISIONS, "they must meet, or the test proves nothing"


@pytest.mark.slow
def test_springs_of_hulls_give_back_what_they_took() -> None:
    """Without damping, and therefore without friction, energy is neither lost nor gained."""
    met = 0
    for seed in range(COLLISIONS):
        world = colliding_pair(seed, damping=0.0)
        energy = energy_history(world)
        assert energy.max() <= (1.0 + ELASTIC) * energy[0], f"collision {seed}"
        if not world._body_arrays.wrench.any():  # they have parted
            assert energy[-1] == pytest.approx(energy[0], rel=ELASTIC), f"collision {seed}"
            met += bool(energy.min() < 0.99 * energy[0])
    assert met > 0.7 * COLLISIONS, "they must meet, or the test proves nothing"


def stored(world: World) -> float:
    """Energy of the springs, J: pressure per depth, 2 k, times the four-dimensional volume under the smaller of both depths."""
    planes = []
    for x in world._body_arrays.state:
        normals = rotations.to_matrix(x[3:7].copy()).T
        for normal in np.vstack([normals, -normals]):
            planes.append([*normal, 1.0, -0.105 - normal @ x[:3]])  # depth <= 0.105 - n.(x - centre)
    planes.append([0.0, 0.0, 0.0, -1.0, 0.0])
    planes = np.array(planes)
    inside = linprog([0, 0, 0, 0, -1], A_ub=np.hstack([planes[:, :4], np.ones((13, 1))]), b_ub=-planes[:, 4], bounds=(None, None)).x[:4]
    corners = HalfspaceIntersection(planes, inside).intersections
    return 2.0 * DockSpec().contact_n_m3 * ConvexHull(corners - inside).volume


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_force_and_moment_between_hulls_are_the_slope_of_the_energy_stored(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = rotations.normalise(rng.standard_normal(4))
    other_q = rotations.normalise(rotations.multiply(q, rotations.exp(0.8 * rng.standard_normal(3))))
    way = rng.standard_normal(3)
    world = pair(0.22 * way / np.linalg.norm(way), q, other_q)
    x, chosen = world._body_arrays.state, np.array([0, 1])
    world._body_arrays.wrench[:] = 0.0
    touch(world._body_arrays, world._modules, world.docks.faces, world._water, chosen)
    wrench, before = world._body_arrays.wrench.copy(), x.copy()
    assert wrench.any(), "they overlap, or the test proves nothing"

    def energy(body: int, axis: int, by: float) -> float:
        x[:] = before
        if axis < 3:
            x[body, :3] += by * rotations.to_matrix(before[body, 3:7].copy())[:, axis]
        else:
            x[body, 3:7] = rotations.multiply(before[body, 3:7].copy(), rotations.exp(by * np.eye(3)[axis - 3]))
        return stored(world)

    step = 2e-6
    slope = [[(energy(b, k, step) - energy(b, k, -step)) / (2.0 * step) for k in range(6)] for b in (0, 1)]
    np.testing.assert_allclose(-np.array(slope), wrench, rtol=0, atol=2e-4 * np.abs(wrench).max())


@pytest.mark.parametrize(("coil", "guide"), [(1.0, 0.0), (0.0, 2000.0), (1.0, 2000.0)])
def test_magnets_and_funnel_of_tilted_faces_only_turn_energy_into_motion_and_back(
    coil: float, guide: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Takes a quarter of the usual step, because the funnel is stiff."""
    tilt = rotations.exp(np.array([0.0, 0.1, -0.12]))
    springs = {"guide": guide, "guide_damping": 0.0, "turning": 0.0, "turning_damping": 0.0}
    world = pair(np.array([0.25, 0.006, -0.004]), LEVEL, tilt, SLIPPERY, STEP_NS // 4, **springs)
    monkeypatch.setattr(world, "_dock", lambda _: None)  # the faces neither lock nor let go
    faces = world.docks.faces
    faces.coil[[0, 1], [0, 1]], faces.inside[0, 1] = coil, 1.0
    world.set_motion(1, np.array([-0.01, 0.01, 0.0]), np.array([0.0, 0.1, 0.1]))

    def energy() -> float:
        one, other = world.truth(0), world.truth(1)
        normal, back = rotations.to_matrix(one.q_wm)[:, 0], rotations.to_matrix(other.q_wm)[:, 0]
        way = other.p_wm - 0.105 * back - one.p_wm - 0.105 * normal
        gap = way @ normal
        assert gap > 0.02, "the hulls must not touch"
        side = way - gap * normal
        pull = coil * faces.pull * faces.magnet_gap**2 / np.sqrt((gap + faces.magnet_gap) ** 2 + side @ side)
        return float(world.kinetic_energy().sum() + 0.5 * guide * side @ side - pull)

    start = energy()
    for _ in range(30):
        world.advance(PERIOD_NS)
        assert energy() == pytest.approx(start, rel=1e-7)


def test_colliding_cubes_bounce_off_and_gain_no_energy() -> None:
    world = two(0.05, 0.12)  # beside the funnel: only the hulls touch
    world.set_motion(1, [-0.15, 0.0, 0.0], np.zeros(3))
    energy = world.kinetic_energy().sum()
    for _ in range(150):
        world.advance(PERIOD_NS)
        away = world.truth(1).p_wm - world.truth(0).p_wm
        assert np.abs(away).max() > 0.205
    assert world.kinetic_energy().sum() < energy
    assert world.truth(0).v_w[0] < -0.01, "the other one was hit"


@pytest.mark.parametrize("roll_deg", [0.0, 0.6, 5.0, 20.0, 45.0])
@pytest.mark.parametrize("y_m", [0.0, 0.003])
def test_rolled_cubes_do_not_pass_through_each_other(roll_deg: float, y_m: float) -> None:
    world = hulls(0.23, y_m, roll_deg)
    world.set_motion(1, [-0.1, 0.0, 0.0], np.zeros(3))
    energy, momentum = world.kinetic_energy().sum(), world.momentum().sum(axis=0)
    for _ in range(60):
        world.advance(PERIOD_NS)
        assert world.truth(1).p_wm[0] - world.truth(0).p_wm[0] > 0.209
        assert world.kinetic_energy().sum() <= energy * (1.0 + 1e-9)
    assert world.truth(1).v_w[0] - world.truth(0).v_w[0] > 0.0
    np.testing.assert_allclose(world.momentum().sum(axis=0), momentum, rtol=0, atol=1e-6 * np.abs(momentum).max())


@pytest.mark.parametrize("roll_deg", [0.0, 1e-9, 0.3, 30.0, 45.0])
@pytest.mark.parametrize("y_m", [0.0, 0.05])
def test_overlap_of_faces_bears_by_its_area(roll_deg: float, y_m: float) -> None:
    """At each depth the bearing area is the overlap of both squares, inset by that depth; Simpson's rule is exact for its integral."""
    deep = 2e-4
    world = hulls(0.21 - deep, y_m, roll_deg)

    def area(inset_m: float) -> float:
        square = shapely.box(*(-0.105 + inset_m,) * 2, *(0.105 - inset_m,) * 2)
        return square.intersection(shapely.affinity.translate(shapely.affinity.rotate(square, roll_deg), y_m)).area

    bears = (area(0.0) + 4.0 * area(0.25 * deep) + area(0.5 * deep)) / 6.0
    np.testing.assert_allclose(world._body_arrays.wrench[1, 0], bears * deep * DockSpec().contact_n_m3, rtol=1e-9)


def test_hulls_of_any_size_stop_each_other() -> None:
    girona = load_vehicle("girona500")
    length = girona.hull.size_m[0]
    world = hulls(length + 0.02, vehicle=dataclasses.replace(girona, inertial=dataclasses.replace(girona.inertial, righting_arm_m=0.0)))
    world.set_motion(1, [-0.2, 0.0, 0.0], np.zeros(3))
    run(world, 1.0)
    assert world.truth(1).p_wm[0] - world.truth(0).p_wm[0] > length - 0.01
    assert world.truth(0).v_w[0] < -0.01, "the other one was hit"
