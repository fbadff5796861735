"""The plant's docking faces: magnets, funnel, jams, joints, and bodies that merge and part."""

import dataclasses

import numpy as np
import pytest
import shapely
import shapely.affinity

from firmware_py.core import rotations
from firmware_py.description.vehicle import Vehicle, load_vehicle
from hil.plant.contact import touch
from hil.plant.dock_spec import DockSpec, JamRule
from hil.plant.docking import DISK_M, Joint
from hil.plant.lattice import Place
from hil.plant.spec import CALM, Tank, WorldSpec
from hil.plant.world import Start, World

PERIOD_NS = 10_000_000
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
OCEAN = Tank(kind="box", size_m=np.array([900.0, 900.0, 900.0]))
VEHICLE = load_vehicle("modcube")
PULL, PUSH, OFF = 1, 2, 0
NEVER, ALWAYS = JamRule(probability_inside=0.0, probability_outside=0.0), JamRule(probability_inside=1.0)


def two(
    gap_m: float, lateral_m: float = 0.0, jam: JamRule = NEVER, q: np.ndarray = LEVEL, vehicle: Vehicle = VEHICLE, **world: float
) -> World:
    """Module 1 before module 0's +x face, -x towards it, in calm deep water."""
    starts = [Start(np.array([0.0, 0.0, 400.0]), LEVEL), Start(np.array([0.21 + gap_m, lateral_m, 400.0]), q)]
    return World(WorldSpec(**{**CALM, **world}), OCEAN, [vehicle] * 2, starts, 0, PERIOD_NS, jam=jam)


def relays(world: World, state: int) -> None:
    world.set_relays(0, [state, 0, 0, 0, 0, 0])
    world.set_relays(1, [0, state, 0, 0, 0, 0])


def run(world: World, seconds: float) -> None:
    for _ in range(round(1e9 * seconds / PERIOD_NS)):
        world.advance(PERIOD_NS)


def docked_pair(**world: float) -> World:
    pair = two(0.02, 0.002, **world)
    relays(pair, PULL)
    run(pair, 3.0)
    assert pair.bodies == [(0, 1)]
    return pair


def test_magnets_draw_two_modules_together_and_lock() -> None:
    world = docked_pair()
    between = rotations.rotate_back(world.truth(0).q_wm, world.truth(1).p_wm - world.truth(0).p_wm)
    np.testing.assert_allclose(between, [0.21, 0.0, 0.0], atol=1e-12)
    assert world.docks.joints == [Joint(0, 0, 1, 1)]
    assert [c.jammed for c in world.docks.contacts] == [False]


@pytest.mark.parametrize("quarter", [0, 1, 2, 3])
def test_pins_allow_four_rotations(quarter: int) -> None:
    q = rotations.from_euler(np.pi / 2 * quarter + 0.05, 0.0, 0.0)
    level = dataclasses.replace(VEHICLE, inertial=dataclasses.replace(VEHICLE.inertial, righting_arm_m=0.0))  # it would roll back
    world = two(0.015, q=q, vehicle=level)
    relays(world, PULL)
    run(world, 3.0)
    assert world.bodies == [(0, 1)]
    turned = rotations.difference(world.truth(1).q_wm, world.truth(0).q_wm)
    assert np.cos(turned[0] - np.pi / 2 * quarter) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(turned[1:], 0.0, atol=1e-9)


def test_probe_does_not_lock_with_a_probe() -> None:
    world = two(0.005, q=rotations.from_euler(0.0, 0.0, np.pi))  # +x looks at +x
    world.set_relays(0, [PULL, 0, 0, 0, 0, 0])
    world.set_relays(1, [PULL, 0, 0, 0, 0, 0])
    run(world, 2.0)
    assert world.bodies == [(0,), (1,)]


def test_merging_keeps_momentum() -> None:
    rng = np.random.default_rng(4)
    starts = [Start(np.array([0.0, 0.0, 400.0]), LEVEL), Start(np.array([0.2104, 3e-4, 400.0003]), rotations.exp(np.full(3, 0.004)))]
    world = World(WorldSpec(current_m_s=0.2), OCEAN, [VEHICLE] * 2, starts, 3, PERIOD_NS)
    for body in (0, 1):
        world.set_motion(body, 0.2 * rng.standard_normal(3), 0.5 * rng.standard_normal(3))
    before = world.momentum().sum(axis=0)
    world.join(Joint(0, 0, 1, 1))
    np.testing.assert_allclose(world.momentum().sum(axis=0), before, rtol=0, atol=1e-9 * np.abs(before).max())


def test_parting_keeps_momentum_and_motion() -> None:
    world = docked_pair(current_m_s=0.1)
    world.set_motion(0, [0.1, -0.2, 0.05], [0.4, 0.3, -0.5])
    before, seen = world.momentum().sum(axis=0), world.seen()
    world.part(world.docks.joints[0])
    assert world.bodies == [(0,), (1,)]
    np.testing.assert_allclose(world.momentum().sum(axis=0), before, rtol=0, atol=1e-9 * np.abs(before).max())
    np.testing.assert_allclose(world.seen()[:, :13], seen[:, :13], atol=1e-12)


def test_magnets_and_funnel_change_no_momentum() -> None:
    smooth = dataclasses.replace(VEHICLE, drag=dataclasses.replace(VEHICLE.drag, cd_face=0.0, cd_edge=0.0, rotational_cd=0.0))
    smooth = dataclasses.replace(smooth, inertial=dataclasses.replace(VEHICLE.inertial, righting_arm_m=0.0))
    starts = [Start(np.array([0.0, 0.0, 2.0]), LEVEL), Start(np.array([0.24, 0.003, 2.0]), LEVEL)]
    world = World(WorldSpec(**CALM), OCEAN, [smooth] * 2, starts, 0, PERIOD_NS, jam=NEVER)
    world.set_motion(1, [-0.02, 0.0, 0.0], [0.02, 0.01, 0.0])
    relays(world, PULL)
    before = world.momentum().sum(axis=0)
    run(world, 1.5)
    assert world.docks.contacts, "they must have met, or the test proves nothing"
    np.testing.assert_allclose(world.momentum().sum(axis=0), before, rtol=0, atol=1e-6 * np.abs(before).max())


def test_reversed_magnets_push_the_pair_apart() -> None:
    world = docked_pair()
    relays(world, PUSH)
    run(world, 1.0)
    assert world.bodies == [(0,), (1,)]
    assert np.linalg.norm(world.truth(1).p_wm - world.truth(0).p_wm) > 0.25


def test_a_stronger_pull_than_the_magnets_opens_the_joint() -> None:
    world = docked_pair()
    assert world._pull_on(world.docks.joints[0]) < 1.0
    along = VEHICLE.directions[:, 0]
    for module, sign in ((0, -1.0), (1, 1.0)):
        world.set_command(module, np.clip(sign * along / np.abs(along).max(), -0.8, 0.8), True)
    run(world, 0.5)
    pull = world._pull_on(world.docks.joints[0]) if world.docks.joints else np.inf
    assert pull > 15.0, "two modules pull against each other"
    weak = docked_pair()
    weak.docks.faces.coil[:] *= 0.2
    weak.docks.busy = False
    for module, sign in ((0, -1.0), (1, 1.0)):
        weak.set_command(module, np.clip(sign * along / np.abs(along).max(), -0.8, 0.8), True)
    run(weak, 0.5)
    assert weak.bodies == [(0,), (1,)]


def test_pins_bear_a_turn_about_the_joint_and_magnets_a_bending() -> None:
    columns = np.vstack([VEHICLE.directions.T, np.cross(VEHICLE.positions, VEHICLE.directions).T])
    pulls = []
    for axis in (3, 4):  # about the joint's normal, and across it
        world, turn = docked_pair(), np.linalg.pinv(columns)[:, axis]
        for module, sign in ((0, -0.5), (1, 0.5)):
            world.set_command(module, sign * turn / np.abs(turn).max(), True)
        run(world, 0.3)
        pulls.append(world._pull_on(world.docks.joints[0]))
    assert abs(pulls[0]) < 0.2 * pulls[1]


def test_jam_holds_the_faces_apart_until_they_let_go() -> None:
    world = two(0.03, jam=ALWAYS)
    relays(world, PULL)
    run(world, 5.0)
    assert world.bodies == [(0,), (1,)]
    assert world.docks.contacts[0].jammed and world.docks.gap_m > 0.3 * DockSpec().probe_m - 0.001
    relays(world, PUSH)
    run(world, 1.0)
    assert world.docks.gap_m > DockSpec().rearm_m or np.isnan(world.docks.gap_m)
    assert not world.docks.faces.inside.any()


def test_jam_rule_is_that_of_the_issue() -> None:
    rule = JamRule()
    assert rule.probability(0.004, 0.060, 5.0) == 0.02
    assert rule.probability(0.0041, 0.0, 0.0) == rule.probability(0.0, 0.061, 0.0) == rule.probability(0.0, 0.0, 5.1) == 0.5


def test_current_rises_with_engagement_and_passes_the_threshold() -> None:
    world = two(0.10)
    relays(world, PULL)
    run(world, 0.5)
    far = world.docks.current_ma()[0, 0]
    pair = docked_pair()
    near = pair.docks.current_ma()[[0, 1], [0, 1]]
    assert 30.0 < far < 55.0 and np.all(near > 90.0)
    relays(pair, OFF)
    run(pair, 0.5)
    np.testing.assert_allclose(pair.docks.current_ma(), 0.0, atol=1e-3)


def test_switching_shows_a_transient() -> None:
    world = two(0.10)
    run(world, 0.1)
    relays(world, PUSH)
    run(world, 0.03)
    assert world.docks.current_ma()[0, 0] < -70.0
    run(world, 0.5)
    assert -55.0 < world.docks.current_ma()[0, 0] < -30.0


def test_colliding_cubes_bounce_off_and_gain_no_energy() -> None:
    world = two(0.05, 0.12)  # beside the funnel: hulls alone
    world.set_motion(1, [-0.15, 0.0, 0.0], np.zeros(3))
    energy = world.kinetic_energy().sum()
    for _ in range(150):
        world.advance(PERIOD_NS)
        away = world.truth(1).p_wm - world.truth(0).p_wm
        assert np.abs(away).max() > 0.205
    assert world.kinetic_energy().sum() < energy
    assert world.truth(0).v_w[0] < -0.01, "the other one was hit"


SMOOTH = dataclasses.replace(
    VEHICLE,
    faces=("-",) * 6,
    drag=dataclasses.replace(VEHICLE.drag, cd_face=0.0, cd_edge=0.0, rotational_cd=0.0),
    inertial=dataclasses.replace(VEHICLE.inertial, righting_arm_m=0.0),
)
"""Hulls alone: nothing but their contact acts on them."""


def hulls(x_m: float, y_m: float = 0.0, roll_deg: float = 0.0, vehicle: Vehicle = SMOOTH) -> World:
    """Two hulls along x, the second one rolled."""
    q = rotations.from_euler(np.radians(roll_deg), 0.0, 0.0)
    starts = [Start(np.array([0.0, 0.0, 400.0]), LEVEL), Start(np.array([x_m, y_m, 400.0]), q)]
    return World(WorldSpec(**CALM), OCEAN, [vehicle] * 2, starts, 0, PERIOD_NS, jam=NEVER)


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
    """To be exact, at every depth by what overlaps of the two squares so far inside their edges; Simpson's rule is exact for that."""
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


@pytest.mark.parametrize("gap_m", [0.0008, -0.0008, -0.01])
def test_faces_lock_from_no_deeper_than_from_afar(gap_m: float) -> None:
    world = two(gap_m)
    world.docks.faces.coil[:], world.docks.faces.inside[0, 1] = 1.0, 1.0
    verdict = world.docks.step(0, 0.01, world._modules, world._body_arrays.state, world._pull_on)
    assert bool(verdict.join) == (abs(gap_m) < DockSpec().lock_m)


SLIPPERY = dataclasses.replace(SMOOTH, faces=VEHICLE.faces)


def start_docked(third_m: float = 100.0, tank: Tank = OCEAN, **world: float) -> World:
    """Two modules docked along x, and a third one on beyond them."""
    starts = [Start(np.array([x, 0.0, 400.0]), LEVEL) for x in (0.0, 0.21, third_m)]
    places = [Place(np.array([x, 0.0, 0.0]), LEVEL.copy()) for x in (0.0, 0.21, 0.0)]
    spec = WorldSpec(**{**CALM, **world})
    return World(spec, tank, [SLIPPERY] * 3, starts, 0, PERIOD_NS, groups=[(0, 1), (2,)], places=places, jam=NEVER)


@pytest.mark.parametrize(("module", "force"), [(1, 60.0), (0, -60.0), (1, -60.0)])
def test_hand_on_one_of_two_loads_their_joint_with_half_its_force(module: int, force: float) -> None:
    world = start_docked()
    world.push[module, 0] = force
    world._step(0)
    assert world._pull_on(world.docks.joints[0]) == pytest.approx(abs(force) / 2 * np.sign(force if module else -force), rel=1e-6)


@pytest.mark.parametrize("cells", [(0, 1, 2), (2, 1, 0), (2, 0, 1), (0, 2, 1)])
def test_joints_of_a_row_that_is_clamped_at_one_end_carry_all_of_a_pull_at_the_other(cells: tuple[int, ...]) -> None:
    """However its modules are counted: the clamp is on the first, and the load cell bears what it holds."""
    start, along = Start(np.array([0.0, 0.0, 400.0]), LEVEL), np.array([0.21, 0.0, 0.0])
    places = [Place((cell - cells[0]) * along, LEVEL.copy()) for cell in cells]
    world = World(WorldSpec(**CALM), OCEAN, [SLIPPERY] * 3, [start] * 3, 0, PERIOD_NS, groups=[(0, 1, 2)], places=places, jam=NEVER)
    world.clamp(0)
    end = int(np.argmax(np.abs(np.subtract(cells, cells[0]))))
    world.push[end, 0] = pull = 50.0 * np.sign(cells[end] - cells[0])
    world._step(0)
    beyond = [joint for joint in world.docks.joints if end in (joint.module, joint.other) or abs(cells[end] - cells[0]) == 2]
    assert len(beyond) == (2 if abs(cells[end] - cells[0]) == 2 else 1)
    assert [world._pull_on(joint) for joint in beyond] == pytest.approx([50.0] * len(beyond), abs=1e-9)
    assert world.load(0)[0] == pytest.approx(pull)


def test_what_touches_one_of_two_loads_their_joint_with_half_its_force() -> None:
    deep = 2e-4
    world = start_docked(0.42 - deep)
    assert world._pull_on(world.docks.joints[0]) == pytest.approx(-0.5 * 0.21**2 * deep * DockSpec().contact_n_m3, rel=2e-3)


def test_jet_on_one_of_two_loads_their_joint_as_a_hand_would() -> None:
    world = start_docked(0.6, jet_strength=0.3)
    along = VEHICLE.directions[:, 0]
    world.set_command(2, 0.8 * along / np.abs(along).max(), True)
    run(world, 0.2)
    world._step(0)
    jet, load = world._hands[1].copy(), world._pull_on(world.docks.joints[0])
    assert jet[0] < -0.01 and not world._hands[0].any()
    world.jet_strength = 0.0
    world._step(0)
    assert abs(world._pull_on(world.docks.joints[0])) < 0.01 * abs(load)
    world.push[1, :3], world.push[1, 3:] = jet[:3], jet[3:] - np.cross([0.21, 0.0, 0.0], jet[:3])
    world._step(0)
    assert world._pull_on(world.docks.joints[0]) == pytest.approx(load, abs=1e-9)


def impulse(world: World, module: int) -> np.ndarray:
    """(6,) momentum and angular momentum about the world's origin of one module with the still water that it moves, world."""
    truth, draw = world.truth(module), world.draw(module)
    v, w = rotations.rotate_back(truth.q_wm, truth.v_w), truth.w_b
    robot = draw.mass * (v + np.cross(w, draw.com))
    p = robot + draw.added[:3] * v
    spin = np.cross(draw.com, robot) + draw.inertia @ w + draw.added[3:] * w
    p_w = rotations.rotate(truth.q_wm, p)
    return np.concatenate([p_w, rotations.rotate(truth.q_wm, spin) + np.cross(truth.p_wm, p_w)])


def test_joint_of_a_tumbling_pair_bears_what_changes_the_momentum_of_the_other_one() -> None:
    """Newton and Euler about the world's origin: what weight, buoyancy and an off-axis hand do not give to module 1, the joint gives."""
    uneven = {"added": np.array([3.0, 9.0, 6.0, 0.01, 0.03, 0.02]), "com_m": np.array([0.01, -0.02, 0.015]), "righting_arm_m": 0.01}
    vehicle = dataclasses.replace(SLIPPERY, inertial=dataclasses.replace(VEHICLE.inertial, **uneven))
    places = [Place(np.zeros(3), LEVEL), Place(np.array([0.21, 0.0, 0.0]), rotations.from_euler(np.pi / 2, 0.0, 0.0))]
    starts = [Start(np.array([0.3, -0.2, 2.0]), rotations.from_euler(0.4, -0.7, 1.9))] * 2
    world = World(WorldSpec(**CALM), OCEAN, [vehicle] * 2, starts, 0, PERIOD_NS, 10_000, groups=[(0, 1)], places=places)
    world.push[1] = hand = np.array([1.5, -4.0, 2.5, 0.2, -0.3, 0.4])
    world.set_motion(0, [0.5, -0.4, 0.6], [0.8, -1.1, 1.4])
    before = impulse(world, 1)
    world._step(1)
    pull, middle, near = world._pull_on(world.docks.joints[0]), world.truth(1), world.truth(0)
    world._step(1)
    need = (impulse(world, 1) - before) / 2e-5
    draw, down = world.draw(1), np.array([0.0, 0.0, 1.0])
    acts = [
        (rotations.rotate(middle.q_wm, hand[:3].copy()), np.zeros(3)),
        (draw.mass * 9.81 * down, draw.com),
        (-draw.buoyancy_n * down, draw.buoyancy_at),
    ]
    for force, at in acts:
        need -= np.concatenate([force, np.cross(middle.p_wm + rotations.rotate(middle.q_wm, at), force)])
    need[3:] -= rotations.rotate(middle.q_wm, hand[3:].copy())
    outward = rotations.rotate(near.q_wm, np.array([1.0, 0.0, 0.0]))
    bending = np.cross(outward, need[3:] - np.cross(near.p_wm + 0.105 * outward, need[:3]))
    assert np.linalg.norm(bending) > 0.1, "it must bend, or the test proves nothing"
    assert pull == pytest.approx(-outward @ need[:3] + np.linalg.norm(bending) / DISK_M, abs=1e-5)


@pytest.mark.parametrize("heavy", [0, 1])
def test_lighter_of_two_that_lock_is_turned_more(heavy: int) -> None:
    """Each by the other's share of their mass, and so that they fit: of a twist of 9 mrad a third of the mass takes 6."""
    inertial = VEHICLE.inertial
    twice = dataclasses.replace(inertial, dry_kg=2.0 * inertial.dry_kg, entrained_kg=2.0 * inertial.entrained_kg)
    vehicles = [VEHICLE, VEHICLE]
    vehicles[heavy] = dataclasses.replace(VEHICLE, inertial=twice)
    tilted, twist = rotations.from_euler(0.3, -0.2, 1.0), np.array([0.006, -0.006, 0.003])
    reach = rotations.rotate(tilted, np.array([0.21, 0.0, 0.0]))
    places = [np.array([0.0, 0.0, 400.0]), np.array([0.0, 0.0, 400.0]) + reach]
    starts = [Start(places[0], tilted), Start(places[1], rotations.multiply(tilted, rotations.exp(twist)))]
    world = World(WorldSpec(**CALM), OCEAN, vehicles, starts, 0, PERIOD_NS)
    before = [world.truth(m).q_wm for m in range(2)]
    world.join(Joint(0, 0, 1, 1))
    np.testing.assert_allclose(rotations.difference(world.truth(0).q_wm, world.truth(1).q_wm), 0.0, atol=1e-12)
    turned = [rotations.difference(world.truth(m).q_wm, before[m]) for m in range(2)]
    np.testing.assert_allclose(np.linalg.norm(turned[heavy]), 0.003, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(turned[1 - heavy]), 0.006, rtol=1e-9)


def test_current_of_a_lone_module_dies_away_as_it_rose() -> None:
    world = World(WorldSpec(**CALM), OCEAN, [VEHICLE], [Start(np.array([0.0, 0.0, 400.0]), LEVEL)], 0, PERIOD_NS)
    world.set_relays(0, [PULL, 0, 0, 0, 0, 0])
    run(world, 1.0)
    assert world.docks.current_ma()[0, 0] == pytest.approx(DockSpec().idle_ma, rel=1e-3)
    world.set_relays(0, [OFF] * 6)
    run(world, 0.1)
    assert world.docks.faces.coil[0, 0] == pytest.approx(np.exp(-0.1 / DockSpec().coil_lag_s), rel=1e-3)
    run(world, 2.0)
    np.testing.assert_allclose(world.docks.current_ma(), 0.0, atol=1e-6)


def test_clamped_body_stays_clamped_when_others_join_and_part() -> None:
    world = start_docked()
    world.clamp(1)
    world.push[2, 0] = 5.0
    start = world.truth(2).p_wm
    world.part(world.docks.joints[0])
    assert world._body_arrays.clamped.tolist() == [0, 0, 1]
    world.join(Joint(0, 0, 1, 1))
    run(world, 0.2)
    assert world.bodies == [(0, 1), (2,)]
    np.testing.assert_array_equal(world.truth(2).p_wm, start)
    assert world.load(1)[0] == pytest.approx(5.0, rel=1e-3) and not world.load(0).any()


def test_load_cell_in_water_that_gathers_speed_feels_what_would_carry_the_body_away() -> None:
    uneven = dataclasses.replace(VEHICLE, inertial=dataclasses.replace(VEHICLE.inertial, added=np.array([3.0, 9.0, 6.0, 0.01, 0.03, 0.02])))
    tilted = Start(np.array([0.0, 0.0, 400.0]), rotations.from_euler(0.3, -0.5, 1.1))
    held, free = (World(WorldSpec(**CALM), OCEAN, [uneven], [tilted], 0, PERIOD_NS) for _ in range(2))
    held.clamp(0)
    for world in (held, free):
        world._water.flow[1:] = [0.1, 0.05, -0.02], [0.5, -0.3, 0.2]
        world._step(0)
    body = free._body_arrays
    carried_away = (body.rigid[0] + body.added[0]) @ free._stage[5, 0, 7:]
    np.testing.assert_allclose(held.load(0), carried_away, atol=1e-9)
    assert np.linalg.norm(held.load(0) - held._body_arrays.wrench[0]) > 1.0, "the water's own inertia must show"


def test_what_joins_a_clamped_body_stands_still() -> None:
    world = start_docked()
    world.part(world.docks.joints[0])
    world.clamp(0)
    world.set_motion(1, [-0.1, 0.0, 0.0], np.zeros(3))
    world.join(Joint(0, 0, 1, 1))
    assert not world.truth(1).v_w.any() and world._body_arrays.clamped.tolist() == [1, 0]
    world.part(world.docks.joints[0])
    assert world._body_arrays.clamped.tolist() == [1, 0, 0]


@pytest.mark.parametrize("held", [0, 1])
def test_clamped_body_stays_where_it_is_when_another_locks_to_it_askew(held: int) -> None:
    """Which gives way, and sits in the lattice."""
    world = two(6e-4, 8e-4, q=rotations.from_euler(0.0, 0.002, -0.004))
    world.clamp(held)
    before = world.truth(held)
    world.join(Joint(0, 0, 1, 1))
    after, others = world.truth(held), [world.truth(m) for m in (0, 1)]
    np.testing.assert_allclose(after.p_wm, before.p_wm, atol=1e-15)
    np.testing.assert_allclose(after.q_wm, before.q_wm, atol=1e-15)
    between = rotations.rotate_back(others[0].q_wm, others[1].p_wm - others[0].p_wm)
    np.testing.assert_allclose(between, [0.21, 0.0, 0.0], atol=1e-12)


def test_magnets_do_no_work_around_a_loop() -> None:
    world = two(0.012)
    world.docks.faces.coil[[0, 1], [0, 1]] = 1.0
    x, chosen = world._body_arrays.state, np.array([0, 1])

    def force(gap_m: float, side_m: float) -> np.ndarray:
        x[1, 0], x[1, 1] = 0.21 + gap_m, side_m
        world._body_arrays.wrench[:] = 0.0
        touch(world._body_arrays, world._modules, world.docks.faces, world._water, chosen)
        return world._body_arrays.wrench[1, :2].copy()

    def work(start: tuple[float, float], end: tuple[float, float]) -> float:
        way = np.subtract(end, start)
        return float(sum(force(*(start + way * (k + 0.5) / 1000)) @ way for k in range(1000)) / 1000)

    corners = [(0.0002, 0.0), (0.0002, 0.01), (0.012, 0.01), (0.012, 0.0)]
    legs = [work(corners[k - 1], corners[k]) for k in range(4)]
    assert abs(sum(legs)) < 1e-5 * max(np.abs(legs))
    for gap in (0.001, 0.003, 0.02):
        assert force(gap, 0.0)[0] == pytest.approx(-40.0 / (1.0 + gap / 0.003) ** 2, rel=1e-12)
