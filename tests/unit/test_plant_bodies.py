"""Motion of the plant's bodies against closed forms of mechanics and independently computed integrals."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial import ConvexHull

from firmware_py.core import rotations
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from hil.plant import drag
from hil.plant.spec import CALM, Tank, WorldSpec
from hil.plant.world import Start, World
from tests.unit.plant_docks import LEVEL, OCEAN, PERIOD_NS

UNEVEN = np.array([3.0, 9.0, 6.0, 0.01, 0.03, 0.02])


def vehicle(**inertial: object) -> Vehicle:
    base = load_vehicle("modcube")
    changes = {"righting_arm_m": 0.0, **inertial}
    return dataclasses.replace(base, inertial=dataclasses.replace(base.inertial, **changes))


def frictionless(**inertial: object) -> Vehicle:
    body = vehicle(**inertial)
    return dataclasses.replace(body, drag=dataclasses.replace(body.drag, cd_face=0.0, cd_edge=0.0, rotational_cd=0.0))


def ocean(body: Vehicle, q: np.ndarray = LEVEL, seed: int = 0, **world: object) -> World:
    """One module in deep, wide, calm water."""
    spec = WorldSpec(**{**CALM, **world})
    return World(spec, OCEAN, [body], [Start(np.array([0.0, 0.0, 400.0]), q)], seed, PERIOD_NS)


def run(world: World, seconds: float) -> None:
    for _ in range(round(seconds * 1e9 / PERIOD_NS)):
        world.advance(PERIOD_NS)


def test_tumbling_module_without_drag_keeps_its_energy() -> None:
    world = ocean(frictionless(added=UNEVEN, com_m=np.array([0.01, -0.02, 0.015])))
    world.set_motion(0, [0.3, -0.2, 0.1], [0.5, -1.0, 0.8])
    before = world.kinetic_energy()
    run(world, 20.0)
    assert world.kinetic_energy() == pytest.approx(before, rel=1e-8)
    assert abs(rotations.log(world.truth(0).q_wm)[0]) > 0.1, "it must have turned, or the test proves nothing"


def test_tumbling_module_without_drag_keeps_its_momentum_in_the_world() -> None:
    world = ocean(frictionless(added=UNEVEN, com_m=np.array([0.01, -0.02, 0.015])))
    world.set_motion(0, [0.3, -0.2, 0.1], [0.5, -1.0, 0.8])
    before = world.momentum()
    run(world, 20.0)
    np.testing.assert_allclose(world.momentum(), before, rtol=0, atol=3e-7 * np.abs(before).max())


def test_slender_body_is_turned_broadside_by_the_munk_moment() -> None:
    world = ocean(frictionless(added=UNEVEN))
    world.set_motion(0, [0.4, 0.1, 0.0], [0.0, 0.0, 0.0])
    world.advance(PERIOD_NS)
    inertia = 0.068 + UNEVEN[5]
    moment = -(UNEVEN[1] - UNEVEN[0]) * 0.4 * 0.1
    assert world.truth(0).w_b[2] == pytest.approx(moment / inertia * 0.01, rel=0.02)
    assert world.truth(0).w_b[2] < 0.0, "the nose turns away from where it drifts"


def test_symmetric_top_precesses_at_eulers_rate() -> None:
    inertia = np.diag([0.05, 0.05, 0.09])
    world = ocean(frictionless(added=np.zeros(6), inertia=inertia))
    world.set_motion(0, np.zeros(3), [0.4, 0.0, 2.0])
    run(world, 3.0)
    angle = (0.09 - 0.05) / 0.05 * 2.0 * 3.0
    np.testing.assert_allclose(world.truth(0).w_b, [0.4 * math.cos(angle), 0.4 * math.sin(angle), 2.0], atol=1e-7)


def test_lopsided_module_is_turned_about_other_axes_than_the_hands() -> None:
    """Its products of inertia cause that; a draw scales them with the moments, so their ratios stay."""
    inertia = np.array([[0.08, 0.02, -0.015], [0.02, 0.06, 0.01], [-0.015, 0.01, 0.07]])
    world = ocean(frictionless(added=np.zeros(6), inertia=inertia), inertia_spread=0.3)
    drawn = np.diag(np.diag(world.draw(0).inertia) / np.diag(inertia)) ** 0.5
    assert np.abs(np.diag(drawn) - 1.0).max() > 0.02
    moment = np.array([0.3, -0.2, 0.4])
    world.push[0, 3:] = moment
    world.advance(PERIOD_NS)
    np.testing.assert_allclose(world.truth(0).w_b / 0.01, np.linalg.solve(drawn @ inertia @ drawn, moment), rtol=0.01)


def test_buoyant_module_rises_along_the_closed_form() -> None:
    body = vehicle()
    world = ocean(body, buoyancy_error_n=0.5)
    side = -1.0 if world.truth(0).specific_force[2] < -WorldSpec().gravity else 1.0  # buoyancy sign of this seed
    mass = 2.6 + 6.7 + 6.2
    k = 0.5 * WorldSpec().density * 1.05 * 0.21**2
    terminal = math.sqrt(0.5 / k)
    # v = v_t tanh(t F / (m v_t)), depth by its integral
    for seconds in (5.0, 15.0, 60.0):
        run(world, seconds - 1e-9 * world.time_ns)
        rate = 0.5 / (mass * terminal)
        assert world.truth(0).v_w[2] == pytest.approx(side * terminal * math.tanh(rate * seconds), rel=1e-4)
        moved = world.truth(0).p_wm[2] - 400.0
        assert moved == pytest.approx(side * terminal / rate * math.log(math.cosh(rate * seconds)), rel=1e-4)


@pytest.mark.slow
def test_drifting_module_ends_up_moving_with_the_current() -> None:
    world = ocean(vehicle(), current_m_s=0.2)
    run(world, 200.0)
    truth = world.truth(0)
    np.testing.assert_allclose(truth.v_w, truth.current_w, atol=0.005)


def test_current_only_moves_the_frame() -> None:
    """A body moves relative to a steady current as it does relative to still water (Galilean invariance)."""
    body = vehicle(added=UNEVEN, com_m=np.array([0.01, 0.0, 0.005]))
    moving, still = ocean(body, current_m_s=0.3), ocean(body)
    current = moving.truth(0).current_w
    moving.set_motion(0, [0.1, 0.05, -0.1], [0.2, -0.3, 0.4])
    still.set_motion(0, np.array([0.1, 0.05, -0.1]) - current, [0.2, -0.3, 0.4])
    run(moving, 5.0)
    run(still, 5.0)
    np.testing.assert_allclose(moving.truth(0).p_wm - 5.0 * current, still.truth(0).p_wm, atol=1e-9)
    np.testing.assert_allclose(moving.truth(0).q_wm, still.truth(0).q_wm, atol=1e-9)


def test_neutral_module_is_carried_along_by_accelerating_water() -> None:
    """Without drag, a neutrally buoyant body follows the water exactly (Froude-Krylov and added mass)."""
    world = ocean(frictionless(added=UNEVEN), gust_m_s=0.3, gust_time_s=2.0, gust_smoothing_s=0.5)
    world.set_motion(0, world.truth(0).current_w, np.zeros(3))
    for _ in range(500):
        world.advance(PERIOD_NS)
        np.testing.assert_allclose(world.truth(0).v_w, world.truth(0).current_w, atol=1e-7)


def test_tilted_module_swings_at_the_pendulum_frequency() -> None:
    body = frictionless(righting_arm_m=0.01)
    world = ocean(body, q=rotations.from_euler(0.02, 0.0, 0.0))
    omega = math.sqrt(9.3 * 9.81 * 0.01 / (0.068 + 0.020))
    run(world, 1.0)
    roll = rotations.to_euler(world.truth(0).q_wm)[0]
    assert roll == pytest.approx(0.02 * math.cos(omega), abs=1e-5)


def test_module_hangs_at_the_angle_of_its_trim() -> None:
    body = vehicle(righting_arm_m=0.006)
    damped = dataclasses.replace(body.drag, linear=np.array([0.0, 0.0, 0.0, 0.1, 0.1, 0.1]))
    world = ocean(dataclasses.replace(body, drag=damped), trim_m=0.003)
    run(world, 60.0)
    down = rotations.rotate_back(world.truth(0).q_wm, np.array([0.0, 0.0, 1.0]))
    draw = world.draw(0)
    lever = draw.com - draw.buoyancy_at
    assert math.hypot(lever[0], lever[1]) > 1e-4
    np.testing.assert_allclose(down, lever / np.linalg.norm(lever), atol=1e-6)


def test_heavy_module_comes_to_rest_on_the_bottom() -> None:
    spec = WorldSpec(**{**CALM, "buoyancy_error_n": 0.5})
    seed = next(s for s in range(20) if sinks(spec, s))
    world = World(spec, Tank(), [vehicle()], [Start(np.array([0.1, 0.1, 0.5]), LEVEL)], seed, PERIOD_NS)
    run(world, 60.0)
    truth = world.truth(0)
    assert np.linalg.norm(truth.v_w) < 1e-4 and np.linalg.norm(truth.w_b) < 1e-3
    # four corners share half a newton
    assert truth.p_wm[2] == pytest.approx(0.76 - 0.105 + 0.5 / 4 / spec.wall_stiffness, abs=1e-4)


@pytest.mark.slow
def test_light_module_floats_at_the_surface() -> None:
    spec = WorldSpec(**{**CALM, "buoyancy_error_n": 0.5})
    seed = next(s for s in range(20) if not sinks(spec, s))
    world = World(
        spec, Tank(), [vehicle(righting_arm_m=0.005)], [Start(np.array([0.1, 0.1, 0.4]), LEVEL)], seed, PERIOD_NS
    )
    run(world, 120.0)
    # height of its 0.0441 m^2 above the surface that costs half a newton of buoyancy
    shown = 0.5 / (spec.density * spec.gravity * 0.21**2)
    assert world.truth(0).p_wm[2] == pytest.approx(0.105 - shown, abs=2e-4)


@pytest.mark.parametrize("q", [LEVEL, rotations.from_euler(math.pi / 2, 0.0, 0.0), rotations.from_euler(0.0, math.pi / 2, 0.3)])
def test_long_hull_that_is_lifted_out_loses_the_buoyancy_of_what_shows(q: np.ndarray) -> None:
    """Whichever side it lies on; the expected loss follows from the geometry of the box."""
    body, out_m = load_vehicle("bluerov2_heavy"), 0.02
    faces = np.array([body.hull.size_m[1] * body.hull.size_m[2], body.hull.size_m[2] * body.hull.size_m[0], np.prod(body.hull.size_m[:2])])
    up = np.argmax(np.abs(rotations.to_matrix(q)[2]))
    lift = []
    for depth_m in (5.0, 0.5 * body.hull.size_m[up] - out_m):
        world = World(WorldSpec(**CALM), OCEAN, [body], [Start(np.array([0.0, 0.0, depth_m]), q)], 0, PERIOD_NS)
        world._step(0)
        lift.append(rotations.rotate(q, world._body_arrays.wrench[0, :3].copy())[2])
    assert lift[1] - lift[0] == pytest.approx(998.2 * 9.81 * faces[up] * out_m, rel=1e-6)


@pytest.mark.parametrize("kind", ["box", "cylinder"])
@pytest.mark.parametrize("way", [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
def test_module_stays_inside_the_tank_and_gains_no_energy_at_its_walls(kind: str, way: tuple[float, float]) -> None:
    tank = Tank(kind=kind, radius_m=0.7, depth_m=0.8)
    world = World(WorldSpec(**CALM), tank, [frictionless()], [Start(np.array([0.0, 0.0, 0.38]), LEVEL)], 0, PERIOD_NS)
    world.set_motion(0, [0.4 * way[0], 0.25 * way[1], 0.1], [0.3, 0.5, -0.6])
    energy, farthest = world.kinetic_energy()[0], 0.0
    for _ in range(600):
        world.advance(PERIOD_NS)
        x, y, z = world.truth(0).p_wm
        outward = [abs(x) / 0.65, abs(y) / 0.6] if kind == "box" else [math.hypot(x, y) / 0.7]
        assert max(outward) < 1.0 and -0.1 < z < 0.85
        farthest = max(farthest, *outward)
    assert farthest > 0.75, "it must have met a wall, or the test proves nothing"
    assert world.kinetic_energy()[0] < 0.9 * energy


def test_wall_too_stiff_for_the_sub_step_is_named_in_place_of_a_motion_beyond_all_numbers() -> None:
    spec = WorldSpec(**{**CALM, "wall_stiffness": 1e6, "wall_damping": 1e5, "buoyancy_error_n": 40.0})
    world = World(spec, Tank(), [vehicle()], [Start(np.array([0.0, 0.0, 0.06]), LEVEL)], 7, PERIOD_NS)
    with pytest.raises(DescriptionError, match=r"s of seed 7 .* too stiff for the sub-step of 2\.5 ms; lower stiffness and damping under"):
        while world.time_ns < 5e9:
            world.advance(PERIOD_NS)
            world.truth(0)


def test_drag_uses_the_outline_that_the_flow_sees() -> None:
    rng = np.random.default_rng(3)
    edges = np.array([0.2, 0.5, 0.3])
    corners = 0.5 * edges * np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    for _ in range(20):
        v = rng.standard_normal(3)
        d = v / np.linalg.norm(v)
        plane = np.linalg.svd(d[None, :])[2][1:]
        area = ConvexHull(corners @ plane.T).volume  # the volume of a plane figure is its area
        assert drag.translation(*edges, 1.0, 1.0, *v) == pytest.approx(area * np.linalg.norm(v), rel=1e-12)


def test_drag_coefficient_is_the_given_one_face_on_and_edge_on() -> None:
    assert drag.translation(1.0, 1.0, 1.0, 1.05, 0.80, 0.0, -2.0, 0.0) == pytest.approx(1.05 * 2.0)
    half = math.sqrt(0.5)
    assert drag.translation(1.0, 1.0, 1.0, 1.05, 0.80, half, 0.0, half) == pytest.approx(0.80 * math.sqrt(2.0))


@pytest.mark.parametrize(("v", "w"), [(0.0, 1.0), (0.3, 2.0), (-0.3, 2.0), (0.05, -2.0), (1.0, 2.0), (0.2, 0.0)])
def test_rotational_damping_is_the_integral_over_strips(v: float, w: float) -> None:
    h = 0.4
    root = [] if w == 0.0 or abs(v / w) > h else [-v / w]
    expected, _ = quad(lambda y: abs(v + w * y) * (v + w * y) * y, -h, h, points=root or None)
    assert drag.strip(v, w, h) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_drag_and_damping_never_give_energy() -> None:
    rng = np.random.default_rng(5)
    world = ocean(vehicle(added=UNEVEN))
    for _ in range(30):
        world.set_motion(0, 0.3 * rng.standard_normal(3), rng.standard_normal(3))
        before = world.kinetic_energy()[0]
        world.advance(PERIOD_NS)
        assert world.kinetic_energy()[0] < before


@pytest.mark.parametrize("name", ["modcube", "bluerov2", "bluerov2_heavy"])
def test_every_seed_has_a_drag_of_its_own_whatever_the_vehicle_file_publishes(name: str) -> None:
    decays = set()
    for seed in range(3):
        world = ocean(load_vehicle(name), seed=seed, drag_spread=0.2)
        world.set_motion(0, [0.3, 0.0, 0.0], [0.0, 0.0, 0.2])
        run(world, 0.5)
        decays.add((world.truth(0).v_w[0], world.truth(0).w_b[2]))
    speeds, rates = (set(each) for each in zip(*decays, strict=True))
    assert len(speeds) == len(rates) == 3


def test_accelerometer_feels_what_the_motion_says() -> None:
    """Specific force against numerical differences of the velocity, while the module tumbles under thrust."""
    world = ocean(vehicle(added=UNEVEN, com_m=np.array([0.01, 0.0, 0.005])), thruster_lag_s=0.08)
    world.set_motion(0, [0.2, 0.0, 0.1], [0.4, -0.5, 0.6])
    world.set_command(0, np.array([0.5, -0.4, 0.3, 0.6, -0.5, 0.2, 0.4, -0.3]))
    run(world, 0.5)
    before = world.truth(0)
    world.advance(PERIOD_NS)
    now = world.truth(0)
    world.advance(PERIOD_NS)
    after = world.truth(0)
    acceleration = (after.v_w - before.v_w) / 0.02
    felt = rotations.rotate_back(now.q_wm, acceleration - np.array([0.0, 0.0, 9.81]))
    np.testing.assert_allclose(now.specific_force, felt, atol=2e-4)
    turned = rotations.difference(after.q_wm, before.q_wm) / 0.02
    np.testing.assert_allclose(now.w_b, turned, atol=2e-3)


def sinks(spec: WorldSpec, seed: int) -> bool:
    world = World(spec, OCEAN, [vehicle()], [Start(np.array([0.0, 0.0, 400.0]), LEVEL)], seed, PERIOD_NS)
    return world.draw(0).buoyancy_n < world.draw(0).mass * spec.gravity
