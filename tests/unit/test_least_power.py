"""Least power: the same wrench within the same limits, with the same signs, for less power; and the thrusters' remaining range."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import LinearConstraint, minimize

from firmware_py.core.allocator import Allocator
from firmware_py.core.body import Body
from firmware_py.core.least_power import LeastPower, slopes
from firmware_py.core.thruster import polynomial, total_power
from firmware_py.description.parameters import Allocation
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble, assemble_vehicle

LEAST = Allocation(mode="least_power")
SQUARE = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]


@pytest.fixture(scope="module", params=[1, 2, 4])
def body(request: pytest.FixtureRequest) -> Body:
    return assemble(SQUARE[: request.param], [0] * request.param, [load_vehicle("modcube")] * request.param)


@pytest.fixture(scope="module")
def heavy() -> Body:
    return assemble_vehicle(load_vehicle("bluerov2_heavy"))


def wrenches(body: Body, count: int, seed: int = 0) -> np.ndarray:
    """Random wrenches well within the body's capability."""
    draw = np.random.default_rng(seed).normal(size=(count, 6))
    reach = float(body.thrusters.f_max[0]) / 10.0
    return 0.12 * reach * len(body.modules) * draw * np.repeat([12.0, 0.8], 3)


def power(body: Body, force: np.ndarray) -> float:
    return float(total_power(force, body.thrusters.power_forward, body.thrusters.power_reverse))


def sides(body: Body, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) lower and upper force of each thruster on its side of zero, clear of the deadband where it was clear before."""
    t = body.thrusters
    low = np.where(base > 0.0, np.minimum(base, t.deadband_n), t.f_min)
    return low, np.where(base > 0.0, t.f_max, np.maximum(base, -t.deadband_n))


def test_wrench_is_made_exactly_and_within_limits(body: Body) -> None:
    for wrench in wrenches(body, 30):
        thrust = Allocator(body, LEAST).step(wrench)
        np.testing.assert_allclose(body.thrusters.matrix @ thrust.force_n, wrench, atol=1e-9)
        assert thrust.scale == (1.0, 1.0)
        assert np.all(thrust.force_n <= body.thrusters.f_max) and np.all(thrust.force_n >= body.thrusters.f_min)


def test_power_is_never_more_and_mostly_much_less_than_that_of_least_squares(body: Body) -> None:
    plain, least = Allocator(body, Allocation()), Allocator(body, LEAST)
    shares = []
    for wrench in wrenches(body, 40, seed=1):
        shares.append(power(body, least.step(wrench).force_n) / power(body, plain.step(wrench).force_n))
    assert max(shares) <= 1.0
    assert np.median(shares) < 0.95


def test_thrusters_keep_their_side_and_stay_clear_of_the_deadband(body: Body) -> None:
    for wrench in wrenches(body, 30, seed=2):
        base = Allocator(body, Allocation()).step(wrench).force_n
        force = Allocator(body, LEAST).step(wrench).force_n
        low, high = sides(body, base)
        assert np.all(force >= low - 1e-12) and np.all(force <= high + 1e-12)


@pytest.mark.parametrize("vehicle", ["modcube", "bluerov2_heavy"])
def test_power_is_the_least_that_another_solver_finds(vehicle: str) -> None:
    """SLSQP (sequential least squares) of scipy on the same problem, with curves of fifth as well as of second order."""
    body = assemble_vehicle(load_vehicle(vehicle))
    t, allocator = body.thrusters, LeastPower(body.thrusters, np.ones(8, dtype=bool))
    free = np.linalg.svd(t.matrix)[2][6:].T
    for wrench in wrenches(body, 12, seed=3):
        base = Allocator(body, Allocation()).step(wrench).force_n
        low, high = sides(body, base)
        within = LinearConstraint(free, low - base, high - base)

        def cost(z: np.ndarray, base: np.ndarray = base) -> float:
            return power(body, np.ascontiguousarray(base + free @ z))

        other = minimize(cost, np.zeros(2), method="SLSQP", constraints=within, options={"ftol": 1e-10, "maxiter": 200})
        assert other.success
        assert cost(free.T @ (allocator.step(base) - base)) <= other.fun * (1.0 + 1e-4)


def test_slopes_are_the_derivatives_of_the_power(heavy: Body) -> None:
    t, h = heavy.thrusters, 1e-4
    force = np.linspace(-35.0, 45.0, 8)
    slope, bend = np.zeros(8), np.zeros(8)
    slopes(force, t.power_forward, t.power_reverse, slope, bend)
    for i, f in enumerate(force):
        c = t.power_forward[i] if f > 0 else t.power_reverse[i]
        assert slope[i] == pytest.approx((polynomial(c, abs(f + h)) - polynomial(c, abs(f - h))) / (2 * h), rel=1e-6)
    assert np.all(bend > 0.0)


@pytest.mark.parametrize("dead", range(8))
def test_dead_thruster_stays_out(dead: int) -> None:
    single = assemble_vehicle(load_vehicle("modcube"))
    allocator = Allocator(single, LEAST)
    allocator.set_alive(np.arange(8) != dead)
    usual = Allocator(single, Allocation())
    usual.set_alive(np.arange(8) != dead)
    less = 0
    for wrench in 0.3 * wrenches(single, 10, seed=4):
        thrust = allocator.step(wrench)
        assert thrust.force_n[dead] == 0.0
        np.testing.assert_allclose(thrust.achieved, [*thrust.scale[:1] * wrench[:3], *thrust.scale[1:] * wrench[3:]], atol=1e-6)
        less += power(single, thrust.force_n) < 0.999 * power(single, usual.step(wrench).force_n)
    assert less >= 5, "and the others still draw the least"


def test_same_wrench_gets_the_same_forces_whatever_came_before(body: Body) -> None:
    allocator = Allocator(body, LEAST)
    for wrench in wrenches(body, 10, seed=5):
        allocator.step(-wrench[::-1].copy())
        assert allocator.step(wrench).force_n.tobytes() == Allocator(body, LEAST).step(wrench).force_n.tobytes()


def test_vehicle_without_freedom_keeps_its_only_answer() -> None:
    rov = assemble_vehicle(load_vehicle("bluerov2"))
    wrench = np.array([5.0, 1.0, 2.0, 0.1, 0.0, 0.2])
    free = Allocator(rov, replace(LEAST, preload_n=0.0)).step(wrench)
    np.testing.assert_allclose(free.achieved, Allocator(rov, replace(Allocation(), preload_n=0.0)).step(wrench).achieved, atol=1e-9)


def test_margin_is_what_the_busiest_thruster_has_left(body: Body) -> None:
    for wrench in wrenches(body, 10, seed=6):
        thrust = Allocator(body, Allocation()).step(wrench)
        limit = np.where(thrust.force_n > 0, body.thrusters.f_max, body.thrusters.f_min)
        assert thrust.margin == pytest.approx(1.0 - np.max(thrust.force_n / limit))


def test_wrench_beyond_limits_leaves_no_margin(body: Body) -> None:
    thrust = Allocator(body, LEAST).step(np.array([500.0, 0, 0, 0, 0, 0]))
    assert thrust.scale[0] < 1.0
    assert thrust.margin == pytest.approx(0.0, abs=1e-6)
