"""The plant's docking faces: magnets, funnel, jams, currents, and bodies that merge and part."""

import dataclasses

import numpy as np
import pytest

from firmware_py.core import rotations
from hil.plant.contact import touch
from hil.plant.dock_spec import DockSpec, JamRule
from hil.plant.docking import Joint
from hil.plant.spec import CALM, WorldSpec
from hil.plant.world import Start, World
from tests.unit.plant_docks import ALWAYS, LEVEL, NEVER, OCEAN, OFF, PERIOD_NS, PULL, PUSH, VEHICLE, docked_pair, relays, run, two


def test_magnets_draw_two_modules_together_and_lock() -> None:
    world = docked_pair()
    between = rotations.rotate_back(world.truth(0).q_wm, world.truth(1).p_wm - world.truth(0).p_wm)
    np.testing.assert_allclose(between, [0.21, 0.0, 0.0], atol=1e-12)
    assert world.docks.joints == [Joint(0, 0, 1, 1)]
    assert [c.jammed for c in world.docks.contacts] == [False]


@pytest.mark.parametrize("quarter", [0, 1, 2, 3])
def test_pins_allow_four_rotations(quarter: int) -> None:
    q = rotations.from_euler(np.pi / 2 * quarter + 0.05, 0.0, 0.0)
    level = dataclasses.replace(VEHICLE, inertial=dataclasses.replace(VEHICLE.inertial, righting_arm_m=0.0))  # else it rolls back
    world = two(0.015, q=q, vehicle=level)
    relays(world, PULL)
    run(world, 3.0)
    assert world.bodies == [(0, 1)]
    turned = rotations.difference(world.truth(1).q_wm, world.truth(0).q_wm)
    assert np.cos(turned[0] - np.pi / 2 * quarter) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(turned[1:], 0.0, atol=1e-9)


def test_probe_does_not_lock_with_a_probe() -> None:
    world = two(0.005, q=rotations.from_euler(0.0, 0.0, np.pi))  # +x faces +x
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


@pytest.mark.parametrize("gap_m", [0.0008, -0.0008, -0.01])
def test_faces_lock_from_no_deeper_than_from_afar(gap_m: float) -> None:
    world = two(gap_m)
    world.docks.faces.coil[:], world.docks.faces.inside[0, 1] = 1.0, 1.0
    verdict = world.docks.step(0, 0.01, world._modules, world._body_arrays.state, world._pull_on)
    assert bool(verdict.join) == (abs(gap_m) < DockSpec().lock_m)


@pytest.mark.parametrize("heavy", [0, 1])
def test_lighter_of_two_that_lock_is_turned_more(heavy: int) -> None:
    """Each is turned by the other's share of the total mass until they fit: of a 9 mrad twist, the one with a third of the mass takes 6."""
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
