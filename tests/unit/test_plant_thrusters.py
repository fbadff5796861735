"""Thrusters, supply and jets of the plant against closed forms."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from firmware_py.core import rotations
from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from hil.batch import fly
from hil.plant.jets import add_jets, in_the_way
from hil.plant.spec import CALM, Tank, WorldSpec
from hil.plant.water import Gusts
from hil.plant.world import Start, World
from hil.scenario import load_scenario, make_world
from tests.unit.plant_docks import LEVEL, OCEAN, PERIOD_NS

CURVE = load_vehicle("modcube").curve


def still(
    positions: list[list[float]] | None = None, seed: int = 0, body: Vehicle | None = None, **world: object
) -> World:
    """Modules at rest in deep calm water."""
    places = positions or [[0.0, 0.0, 400.0]]
    body = body or load_vehicle("modcube")
    spec = WorldSpec(**{**CALM, **world})
    return World(spec, OCEAN, [body] * len(places), [Start(np.array(p), LEVEL) for p in places], seed, PERIOD_NS)


def static_force(u: float) -> float:
    """The vehicle file's polynomial, by numpy."""
    side = CURVE.forward if u > 0 else CURVE.reverse
    return math.copysign(sum(c * abs(u) ** (i + 1) for i, c in enumerate(side)), u)


def one(u: float, channel: int = 2) -> np.ndarray:
    commands = np.zeros(8)
    commands[channel] = u
    return commands


def run(world: World, ticks: int) -> None:
    for _ in range(ticks):
        world.advance(PERIOD_NS)


@pytest.mark.parametrize("u", [1.0, 0.4, -0.3, -1.0])
def test_thruster_follows_its_curve_with_a_first_order_lag(u: float) -> None:
    world = still(thruster_lag_s=0.08)
    world.set_command(0, one(u))
    for tick in range(1, 60):
        world.advance(PERIOD_NS)
        expected = static_force(u) * (1.0 - math.exp(-0.01 * tick / 0.08))
        assert world.truth(0).force_n[2] == pytest.approx(expected, rel=1e-9)


def test_command_within_the_deadband_gives_no_force() -> None:
    world = still(deadband_low_n=0.2, deadband_high_n=0.2)
    for u, moves in [(0.08, False), (0.10, True), (-0.10, False), (-0.13, True)]:
        assert (abs(static_force(u)) > 0.2) == moves
        world.set_command(0, one(u))
        run(world, 1)
        assert (world.truth(0).force_n[2] != 0.0) == moves


def test_wrong_gain_scales_the_force_and_not_the_speed() -> None:
    true, wrong = still(), still(gain_spread=0.05)
    for world in (true, wrong):
        world.set_command(0, np.full(8, 0.5))
        run(world, 5)
    ratio = wrong.truth(0).force_n / true.truth(0).force_n
    np.testing.assert_allclose(ratio, wrong.draw(0).gain)
    assert np.abs(ratio - 1.0).max() > 0.01 and np.abs(ratio - 1.0).max() <= 0.05
    np.testing.assert_allclose(wrong.esc(0)[:, 0], true.esc(0)[:, 0])


def test_speed_goes_with_the_root_of_the_force() -> None:
    world = still()
    world.set_command(0, one(-0.5))
    run(world, 5)
    rpm = CURVE.rpm_at_full * math.sqrt(static_force(-0.5) / static_force(-1.0))
    assert world.esc(0)[2, 0] == pytest.approx(-rpm, rel=1e-9)
    assert not world.esc(0)[[0, 1, 3, 4, 5, 6, 7]].any()


def test_voltage_sags_so_that_supply_and_load_agree() -> None:
    world = still(supply_resistance_ohm=0.2)
    world.set_command(0, np.full(8, 0.5))
    run(world, 5)
    truth = world.truth(0)
    assert truth.voltage_v == pytest.approx(12.0 - 0.2 * truth.current_a, rel=1e-9)
    power_at_12 = 8 * sum(c * static_force(0.5) ** (i + 1) for i, c in enumerate(CURVE.power_forward))
    share = truth.voltage_v / 12.0
    assert truth.current_a == pytest.approx(8.0 / 12.0 + power_at_12 / 12.0 * share**2, rel=1e-9)
    np.testing.assert_allclose(truth.force_n, static_force(0.5) * share**2)


def test_supply_gives_no_more_than_its_current() -> None:
    world = still(supply_limit=True)
    world.set_command(0, np.ones(8))
    run(world, 5)
    truth = world.truth(0)
    assert truth.current_a == pytest.approx(10.0, rel=1e-9)
    assert truth.force_n.max() < 0.4 * static_force(1.0)
    currents = world.esc(0)[:, 1].sum()
    assert currents == pytest.approx(10.0 - 8.0 / 12.0, rel=1e-9)


@pytest.mark.parametrize("sag_v", [3.0, 9.0, 11.0, 11.5, 12.0, 24.0])
@pytest.mark.parametrize("resistance_ohm", [0.0, 0.1])
@pytest.mark.parametrize("worlds", [1, 3])  # one by one; in lanes
def test_sagged_battery_gives_what_is_left_of_it(sag_v: float, resistance_ohm: float, worlds: int) -> None:
    flown = [still(supply_resistance_ohm=resistance_ohm, supply_limit=True) for _ in range(worlds)]
    for world in flown:
        world.sag(0, sag_v)
    fly(flown, np.full((20, 8), 0.8))
    truth, left = flown[-1].truth(0), max(0.0, 12.0 - sag_v)
    assert 0.0 <= truth.voltage_v <= left and 0.0 <= truth.current_a <= 10.0 * (1.0 + 1e-12)
    assert truth.voltage_v <= left - resistance_ohm * truth.current_a + 1e-9
    np.testing.assert_allclose(truth.force_n, static_force(0.8) * (truth.voltage_v / 12.0) ** 2, atol=1e-12)
    can_idle = left > 0.0 and 8.0 / left < 10.0 and left > resistance_ohm * 8.0 / left
    assert (truth.voltage_v > 0.0) == can_idle


def test_each_thruster_turns_and_pushes_as_its_place_says() -> None:
    body = load_vehicle("modcube")
    for channel in range(8):
        world = still(body=body)
        world.set_command(0, one(0.5, channel))
        world.advance(PERIOD_NS)
        truth, thruster = world.truth(0), body.thruster[channel]
        force = static_force(0.5)
        np.testing.assert_allclose(truth.v_w, thruster.direction * force * 0.01 / (9.3 + 6.2), atol=1e-5)
        moment = np.cross(thruster.position_m, thruster.direction) * force
        np.testing.assert_allclose(truth.w_b, moment * 0.01 / (0.068 + 0.020), atol=1e-3)


def test_jet_pushes_the_module_in_its_way_and_no_other() -> None:
    # thruster 3 (index 2) pushes along (-1, -1, 0), so its jet leaves along (1, 1, 0)
    behind, beside = [0.4, 0.4, 399.93], [-0.4, 0.4, 399.93]
    world = still([[0.0, 0.0, 400.0], behind, beside], jet_strength=0.3)
    world.set_command(0, one(1.0))
    run(world, 2)
    pushed = world.truth(1).v_w
    assert pushed[0] > 1e-5 and pushed[0] == pytest.approx(pushed[1], rel=0.1)
    assert not world.truth(2).v_w.any()
    calm = still([[0.0, 0.0, 400.0], behind, beside], jet_strength=0.0)
    calm.set_command(0, one(1.0))
    run(calm, 2)
    assert not calm.truth(1).v_w.any()


def test_jet_pushes_less_from_farther_away() -> None:
    def pushed(distance: float) -> float:
        world = still([[0.0, 0.0, 400.0], [distance, distance, 399.93]], jet_strength=0.3)
        world.set_command(0, one(1.0))
        run(world, 2)
        return float(np.linalg.norm(world.truth(1).v_w))

    near, far = pushed(0.3), pushed(1.0)
    assert 0.0 < far < 0.7 * near


@pytest.mark.parametrize("name", ["mobius-2", "mobius-4"])
def test_jets_of_a_body_on_itself_do_not_depend_on_its_pose(name: str) -> None:
    world, rng = make_world(load_scenario(name), 0, PERIOD_NS), np.random.default_rng(0)
    world._thrusters.force[:] = 8.0
    found = []
    for _ in range(50):
        x = world._body_arrays.state[0]
        x[:3], x[3:7] = rng.uniform(-1.0, 1.0, 3), rotations.normalise(rng.standard_normal(4))
        found.append(np.zeros((len(world.vehicles), 6)))
        add_jets(world._thrusters, world._body_arrays, world._modules, 0.3, 0.5, 0.06, found[-1])
    assert found[0].any() and (np.array(found) == found[0]).all()


def test_jet_fades_from_what_falls_back_beside_its_start() -> None:
    ahead = np.array([-1e-3, -1e-15, 0.0, 1e-15, 1e-5, 0.01, 0.06, 0.2])
    shares = [in_the_way((float(a), 0.1, 0.0), (0.21, 0.21, 0.21), (1.0, 0.0, 0.0), 0.06)[1] for a in ahead]
    np.testing.assert_allclose(shares, np.clip(ahead / 0.06, 0.0, 1.0), atol=1e-4)
    assert shares[:4] == [0.0] * 4


def test_same_seed_gives_the_same_world_and_another_does_not() -> None:
    def flight(seed: int) -> np.ndarray:
        world = World(
            WorldSpec(), Tank(), [load_vehicle("modcube")], [Start(np.array([0.0, 0.0, 0.4]), LEVEL)], seed, PERIOD_NS
        )
        world.set_command(0, np.full(8, 0.2))
        run(world, 200)
        return np.concatenate(world.truth(0)[1:6])

    assert (flight(4) == flight(4)).all()
    assert np.abs(flight(4) - flight(5)).max() > 1e-3


def test_switching_one_error_off_leaves_the_draws_of_the_others() -> None:
    body = load_vehicle("modcube")
    start = [Start(np.array([0.0, 0.0, 0.4]), LEVEL)]
    all_on = World(WorldSpec(), Tank(), [body], start, 7, PERIOD_NS)
    less = World(
        dataclasses.replace(WorldSpec(), mass_spread=0.0, current_m_s=0.0), Tank(), [body], start, 7, PERIOD_NS
    )
    for name in ("drag", "gain", "deadband_n", "com", "buoyancy_at"):
        np.testing.assert_array_equal(getattr(all_on.draw(0), name), getattr(less.draw(0), name))
    assert all_on.draw(0).dry_kg != less.draw(0).dry_kg == pytest.approx(2.6)


def test_draws_stay_within_their_magnitudes_and_fill_them() -> None:
    body, spec = load_vehicle("modcube"), WorldSpec()
    start = [Start(np.array([0.0, 0.0, 0.4]), LEVEL)]
    draws = [World(spec, Tank(), [body], start, seed, PERIOD_NS).draw(0) for seed in range(60)]
    for values, low, high in [
        ([d.dry_kg / 2.6 for d in draws], 0.85, 1.15),
        ([d.added[1] / 6.2 for d in draws], 0.85, 1.15),
        ([d.inertia[2, 2] / 0.068 for d in draws], 0.85, 1.15),
        ([d.drag[0] / 1.05 for d in draws], 0.80, 1.20),
        ([d.deadband_n[3] for d in draws], 0.10, 0.25),
        ([d.com[0] * d.mass / d.dry_kg for d in draws], -0.003, 0.003),
        ([-d.buoyancy_at[2] for d in draws], 0.0, 0.010),
    ]:
        assert low <= min(values) < low + 0.2 * (high - low)
        assert high - 0.2 * (high - low) < max(values) <= high
    errors = np.array([d.buoyancy_n - d.mass * spec.gravity for d in draws])
    np.testing.assert_allclose(np.abs(errors), 0.5)
    assert 10 < (errors > 0).sum() < 50


@pytest.mark.slow
def test_gusts_have_the_wanted_strength_and_smoothness() -> None:
    world = still(current_m_s=0.05, gust_m_s=0.015, gust_time_s=2.0, gust_smoothing_s=0.5)
    flow = np.empty((60_000, 3))
    for i in range(len(flow)):
        world.advance(PERIOD_NS)
        flow[i] = world.truth(0).current_w
    assert np.hypot(*flow.mean(axis=0)[:2]) == pytest.approx(0.05, rel=0.1)
    np.testing.assert_allclose(flow.std(axis=0), 0.015, rtol=0.15)
    # variance of the acceleration of noise through two lags: sigma^2 / (T1 T2)
    np.testing.assert_allclose(np.diff(flow, axis=0).std(axis=0) / 0.01, 0.015 / math.sqrt(2.0 * 0.5), rtol=0.1)


@pytest.mark.slow
def test_gusts_begin_as_they_go_on() -> None:
    """Over many seeds, gust and gust target have the stationary covariance of two lags driven by white noise (Lyapunov, by scipy)."""
    sigma, t1, t2 = 0.3, 5.0, 1.0
    spec = WorldSpec(**{**CALM, "gust_m_s": sigma, "gust_time_s": t1, "gust_smoothing_s": t2})
    gusts = [Gusts(spec, np.random.default_rng(seed), 1e-3) for seed in range(2000)]
    starts, tends = np.concatenate([g.start for g in gusts]), np.concatenate([g.step() for g in gusts])
    kept = solve_continuous_lyapunov(np.array([[-1.0 / t2, 1.0 / t2], [0.0, -1.0 / t1]]), -np.diag([0.0, 1.0]))
    np.testing.assert_allclose(np.cov(starts, tends), sigma**2 * kept / kept[0, 0], rtol=0.08)


def test_step_that_does_not_divide_the_tick_is_refused() -> None:
    with pytest.raises(ValueError, match="does not divide"):
        World(WorldSpec(), Tank(), [load_vehicle("modcube")], [Start(np.zeros(3), LEVEL)], 0, 11_000_000)


def test_finer_steps_change_the_flight_by_less_than_a_micrometre() -> None:
    def flight(step_ns: int) -> np.ndarray:
        start = [Start(np.array([0.0, 0.0, 400.0]), rotations.from_euler(0.3, 0.2, 0.1))]
        world = World(WorldSpec(), OCEAN, [load_vehicle("modcube")], start, 3, PERIOD_NS, step_ns)
        world.set_command(0, np.array([0.5, -0.4, 0.3, 0.6, -0.5, 0.2, 0.4, -0.3]))
        run(world, 300)
        return world.truth(0).p_wm

    np.testing.assert_allclose(flight(2_500_000), flight(500_000), atol=1e-6)
