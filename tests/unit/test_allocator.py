"""Allocation against other solvers: exact within limits, directions and priority kept beyond, dead thrusters out."""

import itertools
from dataclasses import replace

import clarabel
import numpy as np
import pytest
from scipy import sparse
from scipy.optimize import linprog, lsq_linear

from firmware_py.core.allocator import Allocator
from firmware_py.core.body import Body
from firmware_py.core.preload import preload
from firmware_py.core.types import Thrust, ThrustLimits
from firmware_py.description.parameters import Allocation
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble

HOLDING_SHARE, SHARE_WEIGHT, PRIORITIES = 0.05, 1e3, np.array([1e2, 1e2, 1.0])
"""A twentieth of the largest push is the holding force. Losing it, or the moment, costs a hundred times as much as losing the rest of the
force, and that costs SHARE_WEIGHT times as much as all thrusters at their limits."""
PLAIN = replace(Allocation(), preload_n=0.0)
SQUARE = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
LOSES_RANK = {(4, 7), (5, 6), (2, 3)}
"""Pairs of thrusters without which yaw, or roll and yaw combined, cannot be produced (the paper's errata)."""


@pytest.fixture(scope="module", params=[1, 2, 4])
def body(request: pytest.FixtureRequest) -> Body:
    return assemble(SQUARE[: request.param], [0] * request.param, [load_vehicle("modcube")] * request.param)


@pytest.fixture(scope="module")
def single() -> Body:
    return assemble([(0, 0, 0)], [0], [load_vehicle("modcube")])


def wrenches(body: Body, count: int, size: float, seed: int = 0) -> np.ndarray:
    """Random wrenches; size 1 is near the limits of the body."""
    draw = np.random.default_rng(seed).normal(size=(count, 6))
    return size * len(body.modules) * draw * np.repeat([12.0, 0.8], 3)


def assert_within_limits(body: Body, thrust: Thrust) -> None:
    assert np.all(thrust.force_n <= body.thrusters.f_max) and np.all(thrust.force_n >= body.thrusters.f_min)


# ---------------------------------------------------------------- within limits


def test_wrench_within_limits_is_made_exactly(body: Body) -> None:
    for wrench in wrenches(body, 30, 0.15):
        thrust = Allocator(body, Allocation()).step(wrench)
        np.testing.assert_allclose(body.thrusters.matrix @ thrust.force_n, wrench, atol=1e-11)
        np.testing.assert_allclose(thrust.achieved, wrench, atol=1e-11)
        assert thrust.scale == (1.0, 1.0)
        assert_within_limits(body, thrust)


def test_wrench_within_limits_takes_the_least_effort(body: Body) -> None:
    """No other forces with that wrench have a smaller sum of squares (bounded least squares with a hard weight on the wrench)."""
    t = body.thrusters
    for wrench in wrenches(body, 10, 0.15, seed=1):
        thrust = Allocator(body, PLAIN).step(wrench)
        n, weight = t.f_max.size, 1e4
        rows, target = np.vstack([weight * t.matrix, np.eye(n)]), np.r_[weight * wrench, np.zeros(n)]
        other = lsq_linear(rows, target, (t.f_min, t.f_max), method="bvls", tol=1e-14)
        np.testing.assert_allclose(thrust.force_n, other.x, atol=1e-4)


def test_no_wrench_is_no_force(body: Body) -> None:
    assert not Allocator(body, PLAIN).step(np.zeros(6)).force_n.any()


# ---------------------------------------------------------------- beyond limits


def held_n(body: Body) -> float:
    """Holding force, which has the same priority as the moment, N."""
    t = body.thrusters
    return HOLDING_SHARE * float(np.linalg.norm(t.matrix[:3], axis=0) @ np.maximum(t.f_max, -t.f_min))


def in_parts(body: Body, wrench: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The holding force, the moment, and the rest of the force, each as a (6,) wrench."""
    size, moment = float(np.linalg.norm(wrench[:3])), np.r_[np.zeros(3), wrench[3:]]
    rest = np.r_[wrench[:3] * max(0.0, size - held_n(body)) / size, 0.0, 0.0, 0.0]
    return wrench - moment - rest, moment, rest


def best_by_clarabel(body: Body, wrench: np.ndarray) -> tuple[np.ndarray, float]:
    """The allocator's problem in clarabel's form: (n + 3,) forces and shares, and the least cost."""
    t = body.thrusters
    n = t.f_max.size
    whole = SHARE_WEIGHT * float(t.f_max @ t.f_max)
    weights = np.r_[np.ones(n), whole * PRIORITIES]
    goal = np.r_[np.zeros(n), np.ones(3)]
    equality = np.hstack([t.matrix, *(-part[:, None] for part in in_parts(body, wrench))])
    a = sparse.csc_matrix(np.vstack([equality, np.eye(n + 3), -np.eye(n + 3)]))
    b = np.r_[np.zeros(6), t.f_max, np.ones(3), -t.f_min, np.zeros(3)]
    cones = [clarabel.ZeroConeT(6), clarabel.NonnegativeConeT(2 * n + 6)]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    solver = clarabel.DefaultSolver(sparse.csc_matrix(np.diag(2 * weights)), -2 * weights * goal, a, b, cones, settings)
    x = np.array(solver.solve().x)
    return x, float(weights @ (x - goal) ** 2)


@pytest.mark.parametrize("size", [1.0, 3.0, 10.0])
def test_saturated_answer_is_the_one_another_solver_finds(body: Body, size: float) -> None:
    allocator = Allocator(body, PLAIN)
    saturated = 0
    for wrench in wrenches(body, 12, size, seed=2):
        thrust = allocator.step(wrench)
        if thrust.scale == (1.0, 1.0):
            continue
        saturated += 1
        x, cost = best_by_clarabel(body, wrench)
        force, held, rest = (float(np.linalg.norm(part[:3])) for part in np.array([wrench, *in_parts(body, wrench)])[[0, 1, 3]])
        shares = np.array([x[-3], thrust.scale[1], (thrust.scale[0] * force - x[-3] * held) / rest if rest > 0.0 else x[-1]])
        weights = SHARE_WEIGHT * float(body.thrusters.f_max @ body.thrusters.f_max) * PRIORITIES
        ours = float(thrust.force_n @ thrust.force_n + weights @ (1.0 - shares) ** 2)
        assert ours <= cost + 1e-4 * (1.0 + cost)
        np.testing.assert_allclose(thrust.force_n, x[:-3], atol=2e-2)
        np.testing.assert_allclose(thrust.achieved, x[-3:] @ in_parts(body, wrench), atol=3e-2)
        assert thrust.scale[1] == pytest.approx(x[-2], abs=1e-4)
    assert saturated >= 3


@pytest.mark.parametrize("size", [1.0, 3.0, 10.0])
def test_saturation_keeps_the_directions_of_force_and_moment(body: Body, size: float) -> None:
    allocator = Allocator(body, Allocation())
    for wrench in wrenches(body, 40, size, seed=3):
        thrust = allocator.step(wrench)
        force, moment = thrust.scale
        np.testing.assert_allclose(thrust.achieved, np.r_[force * wrench[:3], moment * wrench[3:]], atol=1e-6)
        assert -1e-9 <= force <= 1.0 + 1e-5 and -1e-9 <= moment <= 1.0 + 1e-5
        assert_within_limits(body, thrust)


@pytest.mark.parametrize("size", [0.15, 1.0, 3.0, 1000.0])
def test_thrusters_that_are_mounted_the_other_way_round_push_backwards_as_they_pushed_forwards(body: Body, size: float) -> None:
    """They then push harder in reverse; the wrench is the same."""
    t = body.thrusters
    turned = replace(
        t, matrix=-t.matrix, pinv=-t.pinv, f_min=-t.f_max, f_max=-t.f_min, forward=t.reverse, reverse=t.forward,
        power_forward=t.power_reverse, power_reverse=t.power_forward,
    )  # fmt: skip
    one, other = Allocator(body, PLAIN), Allocator(replace(body, thrusters=turned), PLAIN)
    for wrench in wrenches(body, 10, size, seed=8):
        before, after = one.step(wrench), other.step(wrench)
        np.testing.assert_allclose(after.force_n, -before.force_n, atol=1e-8)
        np.testing.assert_allclose([*after.scale, after.margin], [*before.scale, before.margin], atol=1e-8)


def test_body_that_lacks_moment_leans_and_does_not_drift(single: Body) -> None:
    """With two thrusters dead and 1.5 times the achievable moment asked for, the small force of a hover is kept along with the moment."""
    allocator = Allocator(single, PLAIN)
    for dead in set(itertools.combinations(range(8), 2)) - LOSES_RANK:
        allocator.set_alive(~np.isin(np.arange(8), dead))
        for direction in np.random.default_rng(6).normal(size=(5, 3)):
            direction /= np.linalg.norm(direction)
            most = allocator.step(np.r_[0.0, 0.0, 0.0, 20.0 * direction]).achieved[3:]
            thrust = allocator.step(np.r_[0.2 * np.roll(direction, 1), 1.5 * most])
            assert 0.4 < thrust.scale[1] < 1.0
            assert thrust.scale[0] > 0.4


@pytest.mark.parametrize(("wrench", "force"), [((0, 0, 2, 6, 0, 0), 1.0), ((0, 0, 2, 0, 0, 9), 0.8)])
def test_force_that_costs_no_moment_is_not_given_up_with_it(single: Body, wrench: tuple[float, ...], force: float) -> None:
    assert Allocator(single, PLAIN).step(np.array(wrench, dtype=float)).scale[0] >= force - 1e-3


def best_share(body: Body, along: np.ndarray, beside: np.ndarray) -> float:
    """Largest share of wrench `along` that is feasible together with all of `beside`, by linear programming."""
    t = body.thrusters
    n = t.f_max.size
    bounds = [*zip(t.f_min, t.f_max, strict=True), (0.0, 1.0)]
    result = linprog(np.r_[np.zeros(n), -1.0], A_eq=np.c_[t.matrix, -along], b_eq=beside, bounds=bounds)
    return float(result.x[-1]) if result.success else 0.0


def test_moment_that_can_be_made_is_made_however_large_the_force(body: Body) -> None:
    """Attitude first: asked for 100 N per module and a feasible moment, the robot keeps the moment."""
    allocator = Allocator(body, Allocation())
    modules = len(body.modules)
    for direction in np.random.default_rng(4).normal(size=(20, 3)):
        force = 100.0 * modules * direction / np.linalg.norm(direction)
        moment = 0.5 * modules * np.roll(direction, 1) / np.linalg.norm(direction)
        assert best_share(body, np.r_[0.0, 0.0, 0.0, moment], np.zeros(6)) == pytest.approx(1.0)
        thrust = allocator.step(np.r_[force, moment])
        assert thrust.scale[1] > 0.995
        assert thrust.scale[0] < 0.5


def test_force_that_is_left_beside_the_moment_is_used(body: Body) -> None:
    allocator = Allocator(body, PLAIN)
    for wrench in wrenches(body, 25, 1.5, seed=5):
        best = best_share(body, np.r_[wrench[:3], 0.0, 0.0, 0.0], np.r_[0.0, 0.0, 0.0, wrench[3:]])
        assert allocator.step(wrench).scale[0] > 0.8 * best - 0.01


def test_paper_mode_clips_the_pseudo_inverse(single: Body) -> None:
    wrench = np.array([40.0, 0.0, 10.0, 0.0, 1.0, 0.0])
    thrust = Allocator(single, replace(Allocation(), mode="pseudo_inverse")).step(wrench)
    raw = np.linalg.pinv(single.thrusters.matrix) @ wrench
    np.testing.assert_allclose(thrust.force_n, np.clip(raw, -8.0, 10.0), atol=1e-12)
    np.testing.assert_allclose(thrust.achieved, single.thrusters.matrix @ thrust.force_n, atol=1e-12)


def test_clipping_bends_the_wrench_and_least_squares_does_not(single: Body) -> None:
    """Why the paper's mode is not the default."""
    wrench = np.array([40.0, 5.0, 0.0, 0.0, 0.5, 0.0])

    def bend(parameters: Allocation) -> float:
        force = Allocator(single, parameters).step(wrench).achieved[:3]
        return float(np.linalg.norm(np.cross(force, wrench[:3])) / np.linalg.norm(force) / np.linalg.norm(wrench[:3]))

    assert bend(replace(Allocation(), mode="pseudo_inverse")) > 0.02
    assert bend(Allocation()) < 1e-6


@pytest.mark.slow
def test_sixty_four_modules_saturate_as_few_do() -> None:
    """512 thrusters: directions kept, attitude first, and the answer is stationary to the last thruster."""
    cells = list(itertools.product(range(4), repeat=3))
    whole = assemble(cells, [0] * 64, [load_vehicle("modcube")] * 64)
    allocator, limits = Allocator(whole, PLAIN), (whole.thrusters.f_min, whole.thrusters.f_max)
    for size in (4.0, 10.0, 100.0):
        for wrench in wrenches(whole, 4, size, seed=9):
            thrust = allocator.step(wrench)
            assert_within_limits(whole, thrust)
            np.testing.assert_allclose(thrust.achieved, np.repeat(thrust.scale, 3) * wrench, atol=1e-5)
            free = ~np.isin(thrust.force_n, limits)
            assert thrust.scale[1] > 0.9 * thrust.scale[0] and 4 <= free.sum() < 512
            # least effort: the forces of all thrusters that are not at a limit follow from one wrench, f = J^T y
            y = np.linalg.lstsq(whole.thrusters.matrix[:, free].T, thrust.force_n[free], rcond=1e-9)[0]
            np.testing.assert_allclose(whole.thrusters.matrix[:, free].T @ y, thrust.force_n[free], atol=1e-4)


def test_wrench_that_is_no_number_gives_no_force_beyond_the_limits(single: Body) -> None:
    thrust = Allocator(single, Allocation()).step(np.array([np.nan, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert not np.isfinite(thrust.force_n).any(), "and the limiter takes what is not finite for nothing"


# ---------------------------------------------------------------- dead thrusters


@pytest.mark.parametrize("dead", range(8))
def test_dead_thruster_leaves_the_problem_at_once(single: Body, dead: int) -> None:
    allocator = Allocator(single, Allocation())
    allocator.step(np.ones(6))
    allocator.set_alive(np.arange(8) != dead)
    for wrench in [*wrenches(single, 10, 0.1, seed=6), *wrenches(single, 10, 3.0, seed=7)]:
        thrust = allocator.step(wrench)
        assert thrust.force_n[dead] == 0.0
        np.testing.assert_allclose(thrust.achieved, single.thrusters.matrix @ thrust.force_n, atol=1e-9)
        expected = np.r_[thrust.scale[0] * wrench[:3], thrust.scale[1] * wrench[3:]]
        np.testing.assert_allclose(thrust.achieved, expected, atol=1e-6)
        assert_within_limits(single, thrust)


@pytest.mark.parametrize("dead", range(8))
def test_small_wrench_is_still_made_without_one_thruster(single: Body, dead: int) -> None:
    allocator = Allocator(single, Allocation())
    allocator.set_alive(np.arange(8) != dead)
    for direction in np.random.default_rng(8).normal(size=(20, 6)):
        force, moment = direction[:3] / np.linalg.norm(direction[:3]), direction[3:] / np.linalg.norm(direction[3:])
        wrench = np.r_[force, 0.1 * moment]
        np.testing.assert_allclose(allocator.step(wrench).achieved, wrench, rtol=1e-3)


def test_thruster_that_comes_back_is_used_again(single: Body) -> None:
    allocator, fresh = Allocator(single, Allocation()), Allocator(single, Allocation())
    allocator.set_alive(np.arange(8) != 3)
    allocator.set_alive(np.ones(8, dtype=bool))
    for wrench in wrenches(single, 5, 1.0, seed=9):
        np.testing.assert_allclose(allocator.step(wrench).force_n, fresh.step(wrench).force_n, atol=1e-9)


@pytest.mark.parametrize("pair", list(itertools.combinations(range(8), 2)))
def test_any_two_dead_thrusters_leave_forces_that_are_finite_and_within_limits(
    single: Body, pair: tuple[int, int]
) -> None:
    allocator = Allocator(single, Allocation())
    allocator.set_alive(~np.isin(np.arange(8), pair))
    for wrench in wrenches(single, 5, 0.1, seed=10):
        thrust = allocator.step(wrench)
        assert_within_limits(single, thrust)
        assert not thrust.force_n[list(pair)].any()
        if pair not in LOSES_RANK and thrust.scale == (1.0, 1.0):
            np.testing.assert_allclose(thrust.achieved, wrench, atol=1e-9)


def test_robot_without_any_thruster_asks_for_nothing(single: Body) -> None:
    allocator = Allocator(single, Allocation())
    allocator.set_alive(np.zeros(8, dtype=bool))
    assert not allocator.step(np.ones(6)).force_n.any()


# ---------------------------------------------------------------- preload


def test_preload_makes_no_wrench(body: Body) -> None:
    alive = np.ones(body.thrusters.f_max.size, dtype=bool)
    np.testing.assert_allclose(body.thrusters.matrix @ preload(body.thrusters, alive, 0.6), 0.0, atol=1e-12)


def test_preload_keeps_every_thruster_clear_of_its_deadband(body: Body) -> None:
    force = Allocator(body, Allocation()).step(np.zeros(6)).force_n
    assert np.all(np.abs(force) > 0.25), "the largest deadband of the draw"
    assert np.all(np.abs(force) < 5 * 0.6 + 1e-9)


@pytest.mark.parametrize("dead", range(8))
def test_preload_without_one_thruster_makes_no_wrench_and_spares_it(single: Body, dead: int) -> None:
    force = preload(single.thrusters, np.arange(8) != dead, 0.6)
    assert force[dead] == 0.0
    np.testing.assert_allclose(single.thrusters.matrix @ force, 0.0, atol=1e-12)


@pytest.mark.parametrize("dead", range(8))
def test_preload_is_worked_out_anew_when_a_thruster_dies(single: Body, dead: int) -> None:
    alive = np.arange(8) != dead
    allocator = Allocator(single, Allocation())
    allocator.set_alive(alive)
    thrust = allocator.step(np.zeros(6))
    np.testing.assert_array_equal(thrust.force_n, preload(single.thrusters, alive, Allocation().preload_n))
    assert thrust.scale == (1.0, 1.0)


def test_preload_is_no_larger_than_it_has_to_be(single: Body) -> None:
    """The layout allows all eight thrusters the same preload; a search of its null space finds it."""
    force = preload(single.thrusters, np.ones(8, dtype=bool), 0.6)
    np.testing.assert_allclose(np.abs(force), 0.6, rtol=0.01)


def test_preload_of_none_is_none(single: Body) -> None:
    assert not preload(single.thrusters, np.ones(8, dtype=bool), 0.0).any()


def test_preload_is_that_of_each_module_alone(body: Body) -> None:
    """Modules may part at any time, so no preload may depend on another module."""
    t = body.thrusters
    force = preload(t, np.ones(t.f_max.size, dtype=bool), 0.6)
    for module in range(len(body.modules)):
        mine = t.module == module
        np.testing.assert_allclose(t.matrix[:, mine] @ force[mine], 0.0, atol=1e-12)


@pytest.mark.parametrize("turn", [0.3, 2.0, 3.1])
def test_preload_does_not_depend_on_how_the_processor_turns_the_null_space(
    single: Body, turn: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    alive = np.ones(8, dtype=bool)
    force = preload(single.thrusters, alive, 0.6)
    svd, turned = np.linalg.svd, np.eye(8)
    turned[6:, 6:] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    monkeypatch.setattr(np.linalg, "svd", lambda matrix: (*(parts := svd(matrix))[:2], turned @ parts[2]))
    np.testing.assert_allclose(preload(single.thrusters, alive, 0.6), force, rtol=1e-12)


# ---------------------------------------------------------------- what the limiter will let pass


def power_w(body: Body, thrust: Thrust) -> np.ndarray:
    """(m,) electrical power of each module's thrusters."""
    t = body.thrusters
    rows = np.where(thrust.force_n[:, None] > 0, t.power_forward, t.power_reverse)
    each = [np.polyval(np.r_[row[::-1], 0.0], abs(force)) for row, force in zip(rows, thrust.force_n, strict=True)]
    return np.bincount(t.module, each)


def test_other_limits_count_at_once_and_are_kept_when_a_thruster_dies(single: Body) -> None:
    allocator = Allocator(single, PLAIN)
    limits = ThrustLimits(0.4 * single.thrusters.f_min, 0.5 * single.thrusters.f_max, np.array([1e6]))
    allocator.confine(limits)
    allocator.set_alive(np.arange(8) != 7)
    for wrench in wrenches(single, 20, 2.0):
        thrust = allocator.step(wrench)
        assert np.all(thrust.force_n <= limits.high_n) and np.all(thrust.force_n >= limits.low_n) and thrust.force_n[7] == 0.0
        assert thrust.margin == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.3, 1.0, 3.0])
def test_body_that_cannot_be_fed_gives_way_in_the_force_that_does_not_hold_first(body: Body, size: float) -> None:
    """Directions are kept and no module exceeds its supply; the share left unused is less than a step of the bisection."""
    plenty, allocator = Allocator(body, PLAIN), Allocator(body, PLAIN)
    fed_less = 0
    for wrench in wrenches(body, 30, size) * np.repeat([1.0, 0.2], 3):
        supply_w = 0.5 * power_w(body, plenty.step(wrench))
        allocator.confine(ThrustLimits(body.thrusters.f_min, body.thrusters.f_max, supply_w))
        thrust = allocator.step(wrench)
        assert np.all(power_w(body, thrust) <= supply_w)
        first = np.sum(in_parts(body, wrench)[:2], axis=0)
        first_alone = plenty.step(first)
        np.testing.assert_allclose(thrust.achieved[:3], thrust.scale[0] * wrench[:3], atol=1e-3)
        np.testing.assert_allclose(thrust.achieved[3:], thrust.scale[1] * wrench[3:], atol=1e-3)
        held = float(np.linalg.norm(thrust.achieved[:3]) / np.linalg.norm(first[:3]))
        if np.all(power_w(body, first_alone) <= supply_w):
            fed_less += 1
            assert thrust.scale[1] == pytest.approx(first_alone.scale[1], abs=2e-2)
            assert thrust.scale[0] < 1.0 and held > first_alone.scale[1] - 2e-2
            assert np.max(power_w(body, thrust) / supply_w) > 0.95
        else:
            assert 0.0 < thrust.scale[1] < 1.0 and held == pytest.approx(thrust.scale[1], abs=1e-3)
    assert fed_less > 5


@pytest.mark.parametrize("force", [300.0, 3000.0, 30000.0])
def test_body_that_wants_far_more_than_can_be_fed_pushes_no_less_for_it(body: Body, force: float) -> None:
    """As one does that was carried metres off its place. Of more than 4 kN a module used to be given its holding force alone."""
    allocator = Allocator(body, Allocation())
    limits = ThrustLimits(body.thrusters.f_min, body.thrusters.f_max, np.full(len(body.modules), 106.0))
    allocator.confine(limits)
    for direction in np.eye(3):
        little, much = (allocator.step(np.r_[size * len(body.modules) * direction, 0.1, -0.2, 0.1]) for size in (30.0, force))
        made = [float(direction @ thrust.achieved[:3]) for thrust in (little, much)]
        assert little.scale[0] < 1.0 and made[1] > 0.95 * made[0]
        assert np.all(power_w(body, much) <= limits.supply_w)


def test_paper_s_allocation_leaves_the_supply_to_the_limiter(single: Body) -> None:
    allocator = Allocator(single, replace(PLAIN, mode="pseudo_inverse"))
    wrench = np.array([15.0, 0.0, 0.0, 0.0, 0.4, 0.0])
    before = allocator.step(wrench)
    allocator.confine(ThrustLimits(single.thrusters.f_min, single.thrusters.f_max, np.array([1.0])))
    np.testing.assert_array_equal(allocator.step(wrench).force_n, before.force_n)


def test_body_whose_supply_cannot_feed_the_preload_leaves_it_to_the_limiter() -> None:
    """Otherwise one weak module would stop the whole body."""
    pair = assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [load_vehicle("modcube")] * 2)
    allocator, wrench = Allocator(pair, Allocation()), np.array([3.0, 0.0, 0.0, 0.0, 0.1, 0.0])
    before = allocator.step(wrench)
    preload_w = power_w(pair, allocator.step(np.zeros(6)))
    allocator.confine(ThrustLimits(pair.thrusters.f_min, pair.thrusters.f_max, preload_w * [0.9, 100.0]))
    np.testing.assert_array_equal(allocator.step(wrench).force_n, before.force_n)


def test_least_power_keeps_within_the_room(single: Body) -> None:
    allocator = Allocator(single, replace(Allocation(), mode="least_power"))
    limits = ThrustLimits(0.3 * single.thrusters.f_min, 0.3 * single.thrusters.f_max, np.array([1e6]))
    allocator.confine(limits)
    for wrench in wrenches(single, 60, 0.15):
        thrust = allocator.step(wrench)
        assert np.all(thrust.force_n <= limits.high_n + 1e-12) and np.all(thrust.force_n >= limits.low_n - 1e-12)
