"""Thruster curves and lag: a command makes the wanted force, one tick late and through the lag."""

import math
from dataclasses import replace

import numpy as np
import pytest

from firmware_py.core import thruster
from firmware_py.core.body import ThrusterSet
from firmware_py.core.thruster import ThrusterLag
from firmware_py.description.vehicle_file import load_vehicle, vehicle_names
from firmware_py.prepare.assembly import assemble_vehicle

DT = 0.01


@pytest.fixture(scope="module")
def thrusters() -> ThrusterSet:
    return assemble_vehicle(load_vehicle("modcube")).thrusters


def commands(thrusters: ThrusterSet, force: np.ndarray, scale: float = 1.0) -> np.ndarray:
    n = force.size
    out = np.full(n, np.nan)
    rows = np.zeros(n, dtype=int)
    thruster.commands(
        force,
        np.full(n, scale),
        np.ascontiguousarray(thrusters.forward[rows]),
        np.ascontiguousarray(thrusters.reverse[rows]),
        thrusters.deadband_n[rows].copy(),
        out,
    )
    return out


def force_of(thrusters: ThrusterSet, u: float) -> float:
    """Force by the curve of the vehicle file, written out with numpy."""
    coefficients = thrusters.forward[0] if u >= 0 else thrusters.reverse[0]
    return float(np.copysign(np.polyval(np.r_[coefficients[::-1], 0.0], abs(u)), u))


@pytest.mark.parametrize("x", [0.0, 0.1, 0.5, 1.0, -0.3])
def test_polynomial_is_numpys_without_a_constant(x: float) -> None:
    c = np.array([1.5, 9.0, -0.5, 0.2, -0.1])
    assert thruster.polynomial(c, x) == pytest.approx(np.polyval(np.r_[c[::-1], 0.0], x), abs=1e-15)


@pytest.mark.parametrize("name", vehicle_names())
@pytest.mark.parametrize("side", ["forward", "reverse"])
def test_command_comes_back_from_its_force(name: str, side: str) -> None:
    curve = np.array(getattr(load_vehicle(name).curve, side))
    for u in np.linspace(0.0, 1.0, 101):
        assert thruster.inverse(curve, thruster.polynomial(curve, u)) == pytest.approx(u, abs=1e-11)


def test_force_beyond_the_curve_is_full_command_and_below_is_none(thrusters: ThrusterSet) -> None:
    assert thruster.inverse(thrusters.forward[0], 10.0) == 1.0
    assert thruster.inverse(thrusters.forward[0], 1e9) == 1.0
    assert thruster.inverse(thrusters.forward[0], 0.0) == 0.0
    assert thruster.inverse(thrusters.forward[0], -1.0) == 0.0


def test_commands_make_the_wanted_forces(thrusters: ThrusterSet) -> None:
    wanted = np.array([10.0, 9.99, 5.0, 1.0, 0.1, -0.1, -1.0, -4.0, -7.99, -8.0])
    made = [force_of(thrusters, u) for u in commands(thrusters, wanted)]
    np.testing.assert_allclose(made, wanted, atol=1e-9)


def test_commands_rise_where_the_supply_sags(thrusters: ThrusterSet) -> None:
    wanted = np.array([4.0, -3.0])
    u = commands(thrusters, wanted, scale=0.8)
    np.testing.assert_allclose([0.8 * force_of(thrusters, each) for each in u], wanted, atol=1e-9)


def test_force_within_half_the_deadband_is_not_asked_for(thrusters: ThrusterSet) -> None:
    edge = 0.5 * thrusters.deadband_n[0]
    u = commands(thrusters, edge * np.array([0.0, 0.999, -0.999, 1.001, -1.001]))
    np.testing.assert_array_equal(u[:3], 0.0)
    assert u[3] > 0.0 > u[4]


@pytest.mark.parametrize("name", vehicle_names())
def test_shipped_curves_end_at_their_limits(name: str) -> None:
    vehicle = load_vehicle(name)
    curve = vehicle.curve
    for side, full in ((curve.forward, vehicle.force_max_n), (curve.reverse, -vehicle.force_min_n)):
        assert full <= np.sum(side) * (1 + 1e-9) <= 1.03 * full


def test_power_is_that_of_the_side_which_turns(thrusters: ThrusterSet) -> None:
    force = np.array([3.0, -2.0, 0.0])
    forward = np.ascontiguousarray(thrusters.power_forward[:3])
    reverse = np.ascontiguousarray(thrusters.power_reverse[:3])
    expected = np.polyval(np.r_[forward[0][::-1], 0.0], 3.0) + np.polyval(np.r_[reverse[1][::-1], 0.0], 2.0)
    assert thruster.total_power(force, forward, reverse) == pytest.approx(expected)


# ---------------------------------------------------------------- lag


def test_command_of_tick_k_acts_from_sync_k_plus_1(thrusters: ThrusterSet) -> None:
    lag = ThrusterLag(thrusters, DT)
    assert not lag.step().any(), "tick k: nothing was asked before"
    lag.command(np.full(8, 5.0))
    assert not lag.step().any(), "tick k + 1: its SYNC only now lets the command act"
    assert (lag.step() > 0.0).all(), "tick k + 2: it acted since SYNC k + 1"


def test_step_response_is_the_closed_form(thrusters: ThrusterSet) -> None:
    lag = ThrusterLag(thrusters, DT)
    tau = float(thrusters.lag_s[0])
    lag.command(np.full(8, 5.0))
    lag.step()
    for k in range(1, 60):
        mean = lag.step()
        t0, t1 = (k - 1) * DT, k * DT
        exact_mean = 5.0 * (1.0 + tau / DT * (math.exp(-t1 / tau) - math.exp(-t0 / tau)))
        np.testing.assert_allclose(mean, exact_mean, rtol=1e-12)
        np.testing.assert_allclose(lag.force_n, 5.0 * (1.0 - math.exp(-t1 / tau)), rtol=1e-12)
        lag.command(np.full(8, 5.0))


def test_impulse_of_any_command_sequence_is_kept(thrusters: ThrusterSet) -> None:
    """The integral of a first-order lag's output is that of its input, less what the lag still holds."""
    lag = ThrusterLag(thrusters, DT)
    rng = np.random.default_rng(3)
    asked, given = np.zeros(8), np.zeros(8)
    for _ in range(50):
        given += lag.step() * DT
        command = rng.uniform(-8.0, 10.0, 8)
        lag.command(command)
        asked += command * DT
    given += lag.step() * DT
    lag.command(np.zeros(8))
    given += lag.step() * DT
    np.testing.assert_allclose(given + lag.force_n * thrusters.lag_s, asked, atol=1e-12)


def test_thruster_without_lag_follows_at_once(thrusters: ThrusterSet) -> None:
    lag = ThrusterLag(replace(thrusters, lag_s=np.zeros(8)), DT)
    lag.command(np.full(8, 3.0))
    lag.step()
    np.testing.assert_array_equal(lag.step(), np.full(8, 3.0))
