"""The plant's joints: the load that they bear before they open, load sharing, and clamped bodies."""

import dataclasses

import numpy as np
import pytest

from firmware_py.core import rotations
from hil.plant.dock_spec import DockSpec
from hil.plant.docking import DISK_M, Joint
from hil.plant.lattice import Place
from hil.plant.spec import CALM, WorldSpec
from hil.plant.world import Start, World
from tests.unit.plant_docks import LEVEL, NEVER, OCEAN, PERIOD_NS, SLIPPERY, VEHICLE, docked_pair, run, start_docked, two


def test_a_stronger_pull_than_the_magnets_opens_the_joint() -> None:
    world = docked_pair()
    assert world._pull_on(world.docks.joints[0]) < 1.0
    along = VEHICLE.directions[:, 0]
    for module, sign in ((0, -1.0), (1, 1.0)):
        world.set_command(module, np.clip(sign * along / np.abs(along).max(), -0.8, 0.8))
    run(world, 0.5)
    pull = world._pull_on(world.docks.joints[0]) if world.docks.joints else np.inf
    assert pull > 15.0, "two modules pull against each other"
    weak = docked_pair()
    weak.docks.faces.coil[:] *= 0.2
    weak.docks.busy = False
    for module, sign in ((0, -1.0), (1, 1.0)):
        weak.set_command(module, np.clip(sign * along / np.abs(along).max(), -0.8, 0.8))
    run(weak, 0.5)
    assert weak.bodies == [(0,), (1,)]


def test_pins_bear_a_turn_about_the_joint_and_magnets_a_bending() -> None:
    columns = np.vstack([VEHICLE.directions.T, np.cross(VEHICLE.positions, VEHICLE.directions).T])
    pulls = []
    for axis in (3, 4):  # about the joint's normal, and across it
        world, turn = docked_pair(), np.linalg.pinv(columns)[:, axis]
        for module, sign in ((0, -0.5), (1, 0.5)):
            world.set_command(module, sign * turn / np.abs(turn).max())
        run(world, 0.3)
        pulls.append(world._pull_on(world.docks.joints[0]))
    assert abs(pulls[0]) < 0.2 * pulls[1]


@pytest.mark.parametrize(("module", "force"), [(1, 60.0), (0, -60.0), (1, -60.0)])
def test_hand_on_one_of_two_loads_their_joint_with_half_its_force(module: int, force: float) -> None:
    world = start_docked()
    world.push[module, 0] = force
    world._step(0)
    assert world._pull_on(world.docks.joints[0]) == pytest.approx(abs(force) / 2 * np.sign(force if module else -force), rel=1e-6)


@pytest.mark.parametrize("cells", [(0, 1, 2), (2, 1, 0), (2, 0, 1), (0, 2, 1)])
def test_joints_of_a_row_that_is_clamped_at_one_end_carry_all_of_a_pull_at_the_other(cells: tuple[int, ...]) -> None:
    """Whatever the order of the modules: the first one is clamped, and its load cell measures the whole pull."""
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
    world.set_command(2, 0.8 * along / np.abs(along).max())
    run(world, 0.2)
    world._step(0)
    jet, load = world._module_wrenches[1].copy(), world._pull_on(world.docks.joints[0])
    assert jet[0] < -0.01 and not world._module_wrenches[0].any()
    world.jet_strength = 0.0
    world._step(0)
    assert abs(world._pull_on(world.docks.joints[0])) < 0.01 * abs(load)
    world.push[1, :3], world.push[1, 3:] = jet[:3], jet[3:] - np.cross([0.21, 0.0, 0.0], jet[:3])
    world._step(0)
    assert world._pull_on(world.docks.joints[0]) == pytest.approx(load, abs=1e-9)


def impulse(world: World, module: int) -> np.ndarray:
    """(6,) linear and angular momentum, about the world's origin, of one module and the still water that it moves; world frame."""
    truth, draw = world.truth(module), world.draw(module)
    v, w = rotations.rotate_back(truth.q_wm, truth.v_w), truth.w_b
    robot = draw.mass * (v + np.cross(w, draw.com))
    p = robot + draw.added[:3] * v
    spin = np.cross(draw.com, robot) + draw.inertia @ w + draw.added[3:] * w
    p_w = rotations.rotate(truth.q_wm, p)
    return np.concatenate([p_w, rotations.rotate(truth.q_wm, spin) + np.cross(truth.p_wm, p_w)])


def test_joint_of_a_tumbling_pair_bears_what_changes_the_momentum_of_the_other_one() -> None:
    """Newton-Euler about the world's origin: the joint gives module 1 what weight, buoyancy and an off-axis external push do not."""
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
    """The other body gives way, and ends up in the lattice."""
    world = two(6e-4, 8e-4, q=rotations.from_euler(0.0, 0.002, -0.004))
    world.clamp(held)
    before = world.truth(held)
    world.join(Joint(0, 0, 1, 1))
    after, others = world.truth(held), [world.truth(m) for m in (0, 1)]
    np.testing.assert_allclose(after.p_wm, before.p_wm, atol=1e-15)
    np.testing.assert_allclose(after.q_wm, before.q_wm, atol=1e-15)
    between = rotations.rotate_back(others[0].q_wm, others[1].p_wm - others[0].p_wm)
    np.testing.assert_allclose(between, [0.21, 0.0, 0.0], atol=1e-12)
