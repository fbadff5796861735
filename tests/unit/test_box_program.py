"""Box-constrained least squares with six equality constraints: against another solver, and in hard cases."""

import daqp
import numpy as np
import pytest

from firmware_py.core.box_program import RESIDUAL, nearest

EQUALITY = 5
"""daqp's flag for an equality constraint."""


def solve(rows: np.ndarray, weights: np.ndarray, goal: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(n,) solution; asserts that it is feasible."""
    x = np.full(goal.size, np.nan)
    left = nearest(rows, weights, goal, low, high, x)
    assert left <= RESIDUAL and np.abs(rows.T @ x).max() <= 2.0 * RESIDUAL
    assert np.all(x >= low) and np.all(x <= high)
    return x


def by_daqp(rows: np.ndarray, weights: np.ndarray, goal: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(n,) solution by daqp, which needs linearly independent constraints."""
    sense = np.array([0] * goal.size + [EQUALITY] * rows.shape[1], dtype=np.int32)
    bounds = [np.r_[bound, np.zeros(rows.shape[1])] for bound in (high, low)]
    x, _, flag, _ = daqp.solve(np.diag(weights), -weights * goal, np.ascontiguousarray(rows.T), *bounds, sense)
    assert flag == 1
    return np.asarray(x)


@pytest.mark.parametrize("n", [7, 10, 30, 100])
@pytest.mark.parametrize("rank", [6, 5, 3])
def test_point_is_the_one_another_solver_finds(n: int, rank: int) -> None:
    rng = np.random.default_rng(100 * n + rank)
    for _ in range(20):
        rows, mix = rng.normal(size=(n, rank)), rng.normal(size=(rank, 6)) if rank < 6 else np.eye(6)
        weights, goal = 10.0 ** rng.uniform(-1.0, 3.0, n), rng.normal(scale=3.0, size=n)
        problem = weights, goal, -rng.uniform(0.0, 2.0, n), rng.uniform(0.0, 2.0, n)
        np.testing.assert_allclose(solve(rows @ mix, *problem), by_daqp(rows, *problem), atol=1e-6)


def test_goal_that_is_permitted_is_the_answer_to_the_last_bit() -> None:
    rows = np.vstack([np.eye(6), -np.eye(6)])
    goal = np.tile(np.linspace(-1.0, 1.0, 6), 2)
    np.testing.assert_array_equal(solve(rows, np.ones(12), goal, np.full(12, -1.5), np.full(12, 1.5)), goal)


def test_goal_far_beyond_the_box_is_met_at_its_edge() -> None:
    """Two thrusters against each other, one of them weaker: both give what the weaker one can."""
    rows = np.zeros((2, 6))
    rows[:, 2] = 1.0, -1.0
    x = solve(rows, np.ones(2), np.array([1e6, 1e6]), np.zeros(2), np.array([2.0, 3.0]))
    np.testing.assert_allclose(x, [2.0, 2.0], atol=1e-7)


def test_where_only_nothing_is_permitted_nothing_is_the_answer() -> None:
    x = solve(np.eye(6), np.ones(6), np.full(6, 5.0), np.full(6, -1.0), np.full(6, 1.0))
    np.testing.assert_allclose(x, 0.0, atol=1e-7)


def test_variables_without_room_stay_where_they_are() -> None:
    rng = np.random.default_rng(3)
    rows, goal = rng.normal(size=(20, 6)), rng.normal(size=20)
    low, high = np.where(np.arange(20) < 8, 0.0, -1.0), np.where(np.arange(20) < 8, 0.0, 1.0)
    x = solve(rows, np.ones(20), goal, low, high)
    assert not x[:8].any()
    problem = rows, np.ones(20), goal, low, high
    np.testing.assert_allclose(x, by_daqp(*problem), atol=1e-6)


def test_what_is_no_number_is_not_taken_for_an_answer() -> None:
    rows = np.ones((8, 6))
    rows[3, 2] = np.nan
    assert not nearest(rows, np.ones(8), np.ones(8), -np.ones(8), np.ones(8), np.empty(8)) <= 1.0
