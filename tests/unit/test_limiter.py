"""The last word on every thruster: force, slew, supply power and arm state, densely around each boundary."""

from dataclasses import replace

import numpy as np
import pytest

from firmware_py.core.body import Body
from firmware_py.core.limiter import Limiter
from firmware_py.description import parameters
from firmware_py.description.vehicle import load_vehicle
from firmware_py.prepare.assembly import assemble

DT = 0.01
NOMINAL = np.array([12.0, 12.0])
QUICK = parameters.Limiter(slew_n_per_s=1e4)
"""Any force within one tick."""


@pytest.fixture(scope="module")
def body() -> Body:
    """Two modules: 16 thrusters, two supplies."""
    return assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [load_vehicle("modcube")] * 2)


@pytest.fixture(scope="module")
def rich(body: Body) -> Body:
    """The same with supplies that never limit."""
    return replace(body, supply_power_w=np.array([1e6, 1e6]))


def force_of(body: Body, command: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """(n,) what the curves of the vehicle file make of commands."""
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
    """A boundary, and both sides of it from one bit away to far."""
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
    """The body with supplies that give `factor` of the power that `force` asks of each module."""
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
    """So the direction of its wrench stays; and little of the supply is left unused."""
    wanted = np.random.default_rng(3).uniform(-8.0, 10.0, 16)
    limited = supply_for(body, wanted, factor)
    force, _ = Limiter(limited, QUICK, 1.0).step(wanted.copy(), True, NOMINAL)
    for module in (0, 1):
        mine = body.thrusters.module == module
        share = force[mine] / wanted[mine]
        np.testing.assert_allclose(share, share[0], rtol=1e-12)
        assert power_of(body, force, module) > 0.995 * limited.supply_power_w[module]


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
    """Force goes with voltage to the 1.2 (T200 at 12 and 16 V); the command makes the force that was wanted."""
    wanted = np.linspace(0.5, 4.0, 16) * np.resize([1.0, -1.0], 16)
    force, command = Limiter(rich, QUICK, 1.0).step(wanted, True, np.array([volts, volts]))
    np.testing.assert_array_equal(force, wanted)
    np.testing.assert_allclose(force_of(rich, command, (volts / 12.0) ** 1.2), wanted, atol=1e-9)


def test_each_module_has_its_own_voltage(rich: Body) -> None:
    _, command = Limiter(rich, QUICK, 1.0).step(np.full(16, 3.0), True, np.array([12.0, 10.0]))
    assert np.all(command[8:] > command[:8])


@pytest.mark.parametrize("volts", [0.0, -5.0, 1e6])
def test_absurd_voltage_leaves_commands_within_bounds(rich: Body, volts: float) -> None:
    _, command = Limiter(rich, QUICK, 1.0).step(np.full(16, 5.0), True, np.array([volts, 12.0]))
    assert np.all(command > 0.0) and np.all(command <= 1.0)


# ---------------------------------------------------------------- deadband


def test_force_too_small_for_the_propeller_is_not_commanded(rich: Body) -> None:
    edge = 0.5 * float(rich.thrusters.deadband_n[0])
    for size in around(edge):
        _, command = Limiter(rich, QUICK, 1.0).step(np.full(16, size), True, NOMINAL)
        assert command.any() == (size >= edge)
