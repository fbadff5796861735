"""The final limits of every thruster: force, slew, supply power and arm state, sampled densely around each boundary."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from firmware_py.core.body import Body
from firmware_py.core.limiter import (
    POWER_HALVINGS,
    VOLTAGE_EXPONENT,
    VOLTAGE_RANGE,
    Limiter,
    MagnetLimiter,
    is_believed,
)  # fmt: skip
from firmware_py.core.thruster import total_power
from firmware_py.core.types import FACES, RELAY_OFF, RELAY_PULL, RELAY_PUSH
from firmware_py.description import parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble

DT = 0.01
NOMINAL = np.array([12.0, 12.0])
QUICK = parameters.Limiter(slew_n_per_s=1e4)
"""Slew limit that permits any force within one tick."""


@pytest.fixture(scope="module")
def body() -> Body:
    """Two modules: 16 thrusters, two supplies."""
    return assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [load_vehicle("modcube")] * 2)


@pytest.fixture(scope="module")
def rich(body: Body) -> Body:
    """The same with supplies that never limit."""
    return replace(body, supply_power_w=np.array([1e6, 1e6]))


def force_of(body: Body, command: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """(n,) forces that the curves of the vehicle file give for commands, times `scale`."""
    t = body.thrusters
    rows = np.where(command[:, None] >= 0.0, t.forward, t.reverse)
    size = [np.polyval(np.r_[row[::-1], 0.0], abs(u)) for row, u in zip(rows, command, strict=True)]
    return scale * np.copysign(size, command)


def power_of(body: Body, force: np.ndarray, module: int) -> float:
    """Electrical power of one module's thrusters, W."""
    t = body.thrusters
    mine = np.flatnonzero(t.module == module)
    rows = [t.power_forward[i] if force[i] > 0 else t.power_reverse[i] for i in mine]
    return float(sum(np.polyval(np.r_[row[::-1], 0.0], abs(force[i])) for row, i in zip(rows, mine, strict=True)))


def around(value: float) -> list[float]:
    """A boundary, and values on both sides of it from one bit away to far."""
    steps = [0.0, *(s * abs(value) * 10.0**-e for e in (12, 9, 6, 3, 1) for s in (-1, 1))]
    return sorted({np.nextafter(value, -np.inf), np.nextafter(value, np.inf), *(value + step for step in steps)})


# ---------------------------------------------------------------- force


@pytest.mark.parametrize("share", [0.05, 0.5, 1.0])
@pytest.mark.parametrize("limit", [10.0, -8.0])
def test_no_thruster_is_asked_beyond_its_limit(rich: Body, limit: float, share: float) -> None:
    for wanted in [*around(limit * share), 100.0 * limit, limit * 1e12]:
        force, command = Limiter(rich, replace(QUICK, force_share=share), 1.0).step(np.full(16, wanted), True, NOMINAL)
        expected = min(wanted, limit * share) if limit > 0 else max(wanted, limit * share)
        np.testing.assert_array_equal(force, expected)
        assert np.all(np.abs(command) <= 1.0)
        np.testing.assert_allclose(force_of(rich, command), force, atol=1e-9)


def test_command_makes_the_force_within_all_limits(rich: Body) -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        wanted = rng.uniform(-8.0, 10.0, 16)
        wanted[np.abs(wanted) < 0.1] = 0.5
        force, command = Limiter(rich, QUICK, 1.0).step(wanted, True, NOMINAL)
        np.testing.assert_array_equal(force, wanted)
        np.testing.assert_allclose(force_of(rich, command), wanted, atol=1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_force_that_is_no_number_is_none(rich: Body, bad: float) -> None:
    wanted = np.full(16, 4.0)
    wanted[5] = bad
    force, command = Limiter(rich, QUICK, 1.0).step(wanted, True, NOMINAL)
    assert force[5] == 0.0 == command[5]
    np.testing.assert_array_equal(np.delete(force, 5), 4.0)
    assert np.isfinite(command).all()


def test_nothing_but_nonsense_is_nothing(rich: Body) -> None:
    limiter = Limiter(rich, QUICK, 1.0)
    for _ in range(3):
        force, command = limiter.step(np.full(16, np.nan), True, NOMINAL)
        assert not force.any() and not command.any()


# ---------------------------------------------------------------- slew


@pytest.mark.parametrize("slew", [1.0, 200.0, 1e4])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_force_changes_no_faster_than_the_slew_limit(rich: Body, slew: float, sign: float) -> None:
    step = slew * DT
    for start in (-2.0, 0.0, 3.0):
        for change in around(sign * step):
            limiter = Limiter(rich, parameters.Limiter(slew_n_per_s=slew), DT)
            limiter.force_n = np.full(16, start)
            force, _ = limiter.step(np.full(16, start + change), True, NOMINAL)
            assert np.all(np.abs(force - start) <= step * (1 + 1e-12))
            expected = np.clip(start + np.clip(change, -step, step), -8.0, 10.0)
            np.testing.assert_allclose(force, expected, atol=1e-12)


@pytest.mark.parametrize("rate_hz", [50, 100, 200, 400])
def test_thrusters_that_pass_to_another_body_change_slowly_for_a_fifth_of_a_second(rich: Body, rate_hz: int) -> None:
    """Regression: by 0.8 N in each tick, which was 40 N/s at 50 Hz, and no easing at all at 400 Hz."""
    limiter, ticks = Limiter(rich, parameters.Limiter(), 1.0 / rate_hz), rate_hz // 5
    limiter.continue_from(np.full(16, 4.0))
    wanted = [-8.0, 10.0] * (ticks // 2) + [-8.0]
    forces = np.array([4.0, *(limiter.step(np.full(16, each), True, NOMINAL)[0][0] for each in wanted)])
    np.testing.assert_allclose(rate_hz * np.abs(np.diff(forces[: ticks + 1])), 80.0, atol=1e-9)
    assert rate_hz * (forces[ticks] - forces[ticks + 1]) == pytest.approx(200.0)


def test_eased_thrusters_change_no_faster_than_the_slew_limit_either(rich: Body) -> None:
    limiter = Limiter(rich, parameters.Limiter(slew_n_per_s=10.0), DT)
    limiter.continue_from(np.zeros(16))
    np.testing.assert_allclose(limiter.step(np.full(16, 5.0), True, NOMINAL)[0], 0.1)


def test_eased_thrusters_stop_at_once_when_disarmed(rich: Body) -> None:
    limiter = Limiter(rich, parameters.Limiter(), DT)
    limiter.continue_from(np.full(16, 4.0))
    force, command = limiter.step(np.full(16, 4.0), False, NOMINAL)
    assert not force.any() and not command.any()


def test_full_reversal_takes_the_time_of_the_slew_limit(rich: Body) -> None:
    """From 10 N to -8 N at 200 N/s: nine ticks of 10 ms."""
    limiter = Limiter(rich, parameters.Limiter(), DT)
    for _ in range(10):
        limiter.step(np.full(16, 10.0), True, NOMINAL)
    forces = [limiter.step(np.full(16, -8.0), True, NOMINAL)[0][0] for _ in range(10)]
    np.testing.assert_allclose(forces[:9], 10.0 - 2.0 * np.arange(1, 10), atol=1e-12)
    assert forces[9] == -8.0


def test_force_that_vanishes_in_nonsense_comes_down_by_the_slew_limit(rich: Body) -> None:
    limiter = Limiter(rich, parameters.Limiter(), DT)
    limiter.force_n = np.full(16, 6.0)
    assert limiter.step(np.full(16, np.nan), True, NOMINAL)[0][0] == pytest.approx(4.0)


# ---------------------------------------------------------------- arm state


def test_disarmed_robot_is_still_in_this_very_tick(rich: Body) -> None:
    limiter = Limiter(rich, parameters.Limiter(), DT)
    for _ in range(20):
        limiter.step(np.full(16, 10.0), True, NOMINAL)
    for wanted in (np.full(16, 10.0), np.full(16, np.nan)):
        force, command = limiter.step(wanted, False, NOMINAL)
        assert not force.any() and not command.any()


def test_robot_that_arms_again_starts_from_nothing(rich: Body) -> None:
    limiter = Limiter(rich, parameters.Limiter(), DT)
    for _ in range(20):
        limiter.step(np.full(16, 10.0), True, NOMINAL)
    limiter.step(np.full(16, 10.0), False, NOMINAL)
    assert limiter.step(np.full(16, 10.0), True, NOMINAL)[0][0] == pytest.approx(2.0)


# ---------------------------------------------------------------- supply power


def supply_for(body: Body, force: np.ndarray, factor: float) -> Body:
    """The body with supplies that give `factor` times the power that `force` needs in each module."""
    needed = [power_of(body, force, module) for module in (0, 1)]
    return replace(body, supply_power_w=factor * np.array(needed))


@pytest.mark.parametrize("factor", [0.0, 1e-3, 0.3, 0.9, 0.999, 1.0 - 1e-9, 1.0 + 1e-9, 1.001, 2.0])
def test_supply_never_gives_more_than_it_has(body: Body, factor: float) -> None:
    wanted = np.random.default_rng(2).uniform(-8.0, 10.0, 16)
    limited = supply_for(body, wanted, factor)
    force, command = Limiter(limited, QUICK, 1.0).step(wanted.copy(), True, NOMINAL)
    for module in (0, 1):
        assert power_of(body, force, module) <= limited.supply_power_w[module] * (1 + 1e-12)
    if factor > 1.0:
        np.testing.assert_array_equal(force, wanted)
    assert np.isfinite(command).all()


@pytest.mark.parametrize("factor", [0.3, 0.7, 0.95])
def test_supply_limit_shrinks_all_forces_of_the_module_alike(body: Body, factor: float) -> None:
    """So the direction of its wrench is kept; and little of the supply is left unused."""
    wanted = np.random.default_rng(3).uniform(-8.0, 10.0, 16)
    limited = supply_for(body, wanted, factor)
    force, _ = Limiter(limited, QUICK, 1.0).step(wanted.copy(), True, NOMINAL)
    for module in (0, 1):
        mine = body.thrusters.module == module
        share = force[mine] / wanted[mine]
        np.testing.assert_allclose(share, share[0], rtol=1e-12)
        assert power_of(body, force, module) > 0.995 * limited.supply_power_w[module]


@pytest.mark.parametrize("share", [1.0, 0.75, 0.5, 0.125])
def test_supply_that_is_just_enough_is_used_to_the_last_bit(body: Body, share: float) -> None:
    """One bit less power gives the next smaller 4096th of the forces."""
    t, wanted = body.thrusters, np.full(16, 4.0)
    exact = float(total_power(wanted[:8] * share, t.power_forward[:8].copy(), t.power_reverse[:8].copy()))
    for supply, kept in ((exact, share), (np.nextafter(exact, 0.0), share - 2.0**-12)):
        limiter = Limiter(replace(body, supply_power_w=np.array([supply, 1e6])), QUICK, 1.0)
        force, _ = limiter.step(wanted, True, NOMINAL)
        np.testing.assert_array_equal(force[:8], 4.0 * kept)


def test_weak_supply_of_one_module_leaves_the_other_alone(body: Body) -> None:
    wanted = np.full(16, 5.0)
    weak = replace(body, supply_power_w=np.array([20.0, 1e6]))
    force, _ = Limiter(weak, QUICK, 1.0).step(wanted.copy(), True, NOMINAL)
    assert np.all(force[:8] < 5.0)
    np.testing.assert_array_equal(force[8:], 5.0)


def test_wanted_forces_are_not_written_to(body: Body) -> None:
    wanted = np.full(16, 10.0)
    Limiter(body, QUICK, 1.0).step(wanted, True, NOMINAL)
    np.testing.assert_array_equal(wanted, 10.0)


# ---------------------------------------------------------------- voltage


@pytest.mark.parametrize("volts", [9.0, 10.5, 12.0, 14.0, 16.0])
def test_sagging_supply_is_made_up_for(rich: Body, volts: float) -> None:
    """Force scales with voltage to the power 1.2 (T200 at 12 and 16 V); the command makes the wanted force."""
    wanted = np.linspace(0.5, 4.0, 16) * np.resize([1.0, -1.0], 16)
    force, command = Limiter(rich, QUICK, 1.0).step(wanted, True, np.array([volts, volts]))
    np.testing.assert_array_equal(force, wanted)
    np.testing.assert_allclose(force_of(rich, command, (volts / 12.0) ** 1.2), wanted, atol=1e-9)


def test_each_module_has_its_own_voltage(rich: Body) -> None:
    _, command = Limiter(rich, QUICK, 1.0).step(np.full(16, 3.0), True, np.array([12.0, 10.0]))
    assert np.all(command[8:] > command[:8])


@pytest.mark.parametrize("volts", [0.0, -5.0, 1.0, 1e6, np.nan, np.inf])
def test_absurd_voltage_counts_as_nominal(rich: Body, volts: float) -> None:
    """A sensor that reads nothing must not raise the commands."""
    force, command = Limiter(rich, QUICK, 1.0).step(np.full(16, 5.0), True, np.array([volts, 12.0]))
    np.testing.assert_array_equal(force, 5.0)
    np.testing.assert_array_equal(command[:8], command[8:])


@pytest.mark.parametrize("volts", [8.0, 10.0, 11.99, 12.0, 14.0])
@pytest.mark.parametrize("wanted", [-100.0, 100.0])
def test_no_more_force_is_believed_than_the_supply_can_make(rich: Body, volts: float, wanted: float) -> None:
    """The full command makes the force available at this voltage; more than the limit is never requested."""
    scale = (volts / 12.0) ** 1.2
    full = float(force_of(rich, np.full(16, np.sign(wanted)), scale)[0])
    force, command = Limiter(rich, QUICK, 1.0).step(np.full(16, wanted), True, np.full(2, volts))
    np.testing.assert_allclose(force, np.sign(wanted) * min(abs(full), 10.0 if wanted > 0 else 8.0), rtol=1e-12)
    np.testing.assert_allclose(force_of(rich, command, scale), force, atol=1e-8)


# ---------------------------------------------------------------- deadband


def test_force_too_small_for_the_propeller_is_not_commanded(rich: Body) -> None:
    edge = 0.5 * float(rich.thrusters.deadband_n[0])
    for size in around(edge):
        _, command = Limiter(rich, QUICK, 1.0).step(np.full(16, size), True, NOMINAL)
        assert command.any() == (size >= edge)


# ---------------------------------------------------------------- thrusters that are out


def test_thruster_that_is_out_stops_in_this_very_tick(rich: Body) -> None:
    limiter = Limiter(rich, parameters.Limiter(), DT)
    for _ in range(20):
        limiter.step(np.full(16, 9.0), True, NOMINAL)
    alive = np.arange(16) != 5
    force, command = limiter.step(np.full(16, 9.0), True, NOMINAL, alive)
    assert force[5] == 0.0 == command[5]
    np.testing.assert_array_equal(force[alive], 9.0)
    force, _ = limiter.step(np.full(16, 9.0), True, NOMINAL, np.ones(16, dtype=bool))
    assert force[5] == pytest.approx(2.0), "and comes back by the slew limit"


# ---------------------------------------------------------------- docking magnets

MAGNETS = parameters.Limiter(relay_on_s=2.0, relay_duty=0.25, relay_w=6.0)
ON = (1, 0, 0, 0, 0, 2)


def test_magnet_may_be_on_for_ever_at_full_duty() -> None:
    magnets = MagnetLimiter(parameters.Limiter(relay_on_s=1.0, relay_duty=1.0), 0.5)
    assert all(magnets.step(ON) == ON for _ in range(100))
    assert magnets.step((0,) * 6) == (0,) * 6, "and goes off when it is told to"


def test_magnet_that_is_on_too_long_rests_until_it_is_half_cool() -> None:
    """A magnet loses 0.75 s a second of its 2 s while on, and gains 0.25 s a second while off: so 11 ticks on, 17 off, then 6 and 18."""
    magnets = MagnetLimiter(MAGNETS, 0.25)
    seen = [magnets.step(ON) for _ in range(60)]
    assert {state for states in seen for state in states} == {0, 1, 2}
    lit = [states == ON for states in seen]
    assert all(states in (ON, (0,) * 6) for states in seen)
    edges = [0, *np.flatnonzero(np.diff(lit)) + 1]
    np.testing.assert_array_equal(np.diff(edges), [11, 17, 6, 18, 6])


def test_magnet_rests_when_its_account_is_just_empty_and_lights_when_it_is_just_half_full() -> None:
    """At half duty and ticks of a second the account reads 2 s, 1.5, 1, 0.5, 0; then 0.5, 1."""
    magnets = MagnetLimiter(parameters.Limiter(relay_on_s=2.0, relay_duty=0.5), 1.0)
    assert [magnets.step(ON) == ON for _ in range(9)] == [True] * 4 + [False] * 2 + [True] * 2 + [False]


def test_each_magnet_has_its_own_account() -> None:
    magnets = MagnetLimiter(MAGNETS, 0.25)
    for n in range(11):
        magnets.step((1, 0, 0, 0, 0, 0))
        assert magnets.resting == ([0] if n == 10 else [])
    assert magnets.step((1, 1, 0, 0, 0, 0)) == (0, 1, 0, 0, 0, 0)


def test_all_six_magnets_may_rest_at_once() -> None:
    magnets = MagnetLimiter(MAGNETS, 0.25)
    for _ in range(11):
        magnets.step((1,) * 6)
    assert magnets.resting == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(("duty", "wanted"), [(0.25, (0,) * 6), (1.0, (0,) * 6), (1.0, ON), (1.0, [*ON])])
def test_magnets_whose_accounts_stay_full_cost_nothing(duty: float, wanted: Sequence[int]) -> None:
    """Those that nobody wants, and those of joints, which may be on for ever."""
    magnets = MagnetLimiter(replace(MAGNETS, relay_duty=duty), 0.25)
    magnets.step(wanted)
    assert magnets.step(wanted) is magnets.step(wanted)
    assert magnets.step((0, 1, 0, 0, 0, 0)) == (0, 1, 0, 0, 0, 0)


def test_magnet_that_rested_is_on_again_when_a_new_limit_makes_its_account_full() -> None:
    """Its account, at -0.0625 s when it goes off and 2 s after 33 ticks, is less than half full; by the new limit it is full, and stays."""
    magnets = MagnetLimiter(replace(MAGNETS, relay_on_s=8.0), 0.25)
    while not magnets.resting:
        magnets.step((1,) * 6)
    for _ in range(33):
        magnets.step((0,) * 6)
    assert magnets.resting
    magnets.retune(MAGNETS)
    assert [magnets.step((1,) * 6) for _ in range(2)] == [(0,) * 6, (1,) * 6]


def test_cool_magnet_saves_no_more_than_its_limit() -> None:
    magnets = MagnetLimiter(MAGNETS, 0.25)
    for _ in range(1000):
        magnets.step((0,) * 6)
    lit = [magnets.step(ON) == ON for _ in range(12)]
    assert lit == [True] * 11 + [False]


def test_relay_state_that_does_not_exist_is_off() -> None:
    assert MagnetLimiter(MAGNETS, 0.25).step((3, -1, 1, 7, 2, 0)) == (0, 0, 1, 0, 2, 0)


def test_magnet_that_may_stay_on_for_longer_may_so_once_its_account_is_full(body: Body) -> None:
    limiter = Limiter(body, MAGNETS, 0.25)
    magnets = limiter.magnets[1]
    for _ in range(4):
        magnets.step((0,) * 6)
    limiter.retune(parameters.Limiter(relay_on_s=4.0, relay_duty=0.25, relay_w=6.0))
    for _ in range(32):
        magnets.step((0,) * 6)
    lit = [magnets.step((1, 0, 0, 0, 0, 0))[0] for _ in range(40)]
    assert lit.index(0) == pytest.approx(4.0 / 0.75 / 0.25, abs=1)


def test_magnets_that_are_on_take_their_power() -> None:
    magnets = MagnetLimiter(MAGNETS, 0.25)
    assert magnets.power_w == 0.0 and magnets.states == (0,) * 6
    magnets.step(ON)
    assert magnets.power_w == 12.0
    magnets.step((0,) * 6)
    assert magnets.power_w == 0.0


@pytest.mark.parametrize("magnets_w", [10.0, 30.0, 40.0, 50.0])
def test_thrusters_have_what_the_magnets_leave(body: Body, magnets_w: float) -> None:
    """This also holds for a supply that just sufficed without magnets."""
    limiter = Limiter(replace(body, supply_power_w=np.array([40.0, 40.0])), QUICK, 1.0)
    too_much = np.full(16, 5.0)
    enough, _ = limiter.step(too_much, True, NOMINAL)
    limiter.magnets[1].power_w = magnets_w
    left = max(0.0, 40.0 - magnets_w)
    for wanted in (too_much, enough):
        force, _ = limiter.step(wanted.copy(), True, NOMINAL)
        assert 0.995 * 40.0 < power_of(body, force, 0) <= 40.0
        assert 0.99 * left <= power_of(body, force, 1) <= left
    assert len(limiter.magnets) == 2


# ---------------------------------------------------------------- what passes, for the allocation


@pytest.mark.parametrize("volts", [8.0, 9.7, 11.99, 12.0, 14.0, np.nan])
@pytest.mark.parametrize("share", [0.5, 0.9, 1.0])
def test_room_is_what_passes_when_all_is_asked_for(rich: Body, volts: float, share: float) -> None:
    limiter = Limiter(rich, replace(QUICK, force_share=share), 1.0)
    voltage = np.array([volts, 12.0])
    limits = limiter.limits(voltage)
    for wanted, bound in ((-100.0, limits.low_n), (100.0, limits.high_n)):
        force, _ = limiter.step(np.full(16, wanted), True, voltage)
        np.testing.assert_array_equal(force, bound)


def test_room_has_what_the_magnets_leave_of_each_supply(body: Body) -> None:
    limiter = Limiter(replace(body, supply_power_w=np.array([40.0, 50.0])), QUICK, 1.0)
    np.testing.assert_array_equal(limiter.limits(NOMINAL).supply_w, [40.0, 50.0])
    limiter.magnets[1].power_w = 6.0
    np.testing.assert_array_equal(limiter.limits(NOMINAL).supply_w, [40.0, 44.0])


def test_room_is_made_anew_when_something_has_changed_and_only_then(body: Body) -> None:
    limiter = Limiter(body, QUICK, 1.0)
    first = limiter.limits(NOMINAL)
    assert limiter.limits(NOMINAL.copy()) is first
    sagged = limiter.limits(np.array([9.0, 12.0]))
    assert sagged is not first and np.all(sagged.high_n[:8] < first.high_n[:8])
    limiter.step(np.zeros(16), True, NOMINAL)
    np.testing.assert_array_equal(limiter.limits(NOMINAL).high_n, first.high_n)
    limiter.retune(replace(QUICK, force_share=0.5))
    np.testing.assert_array_equal(limiter.limits(NOMINAL).high_n, 0.5 * first.high_n)


def test_limits_are_made_of_these_numbers() -> None:
    assert (VOLTAGE_EXPONENT, VOLTAGE_RANGE, FACES) == (1.2, (0.6, 1.4), 6)
    assert (RELAY_OFF, RELAY_PULL, RELAY_PUSH) == (0, 1, 2)
    assert POWER_HALVINGS == 12, "replay compares bytes"
    assert is_believed(np.array(VOLTAGE_RANGE)).all()


@pytest.mark.parametrize(("volts", "believed"), [(7.21, 7.21), (7.19, 12.0), (16.79, 16.79), (16.81, 12.0)])
def test_voltage_is_believed_within_its_range(rich: Body, volts: float, believed: float) -> None:
    _, command = Limiter(rich, QUICK, 1.0).step(np.full(16, 2.0), True, np.full(2, volts))
    np.testing.assert_allclose(force_of(rich, command, (believed / 12.0) ** 1.2), 2.0, atol=1e-9)
