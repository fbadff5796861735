"""Process and measurement models against finite differences: every block of the Jacobians, body-frame errors."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from filterpy import kalman
from filterpy.common import Q_continuous_white_noise
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from firmware_py.core import observation, propagation
from firmware_py.core.body import Body
from firmware_py.core.propagation import ERRORS
from firmware_py.core.rotations import difference, exp, from_euler, multiply
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble

BLOCKS = {
    "position": slice(0, 3),
    "attitude": slice(3, 6),
    "velocity": slice(6, 9),
    "rate": slice(9, 12),
    "gyro bias": slice(12, 15),
    "accel bias": slice(15, 18),
    "force": slice(18, 21),
    "moment": slice(21, 24),
    "depth bias": slice(24, 25),
    "righting": slice(25, 28),
}
DT = 1e-4
TAU = np.array([3.0, -2.0, 5.0, 0.4, -0.3, 0.2])
LEVER = np.array([0.05, -0.11, -0.2])


@pytest.fixture(scope="module", params=[1, 3], ids=["one module", "L of three"])
def body(request: pytest.FixtureRequest) -> Body:
    cells = [(0, 0, 0), (1, 0, 0), (1, 1, 0)][: request.param]
    return assemble(cells, [0, 4, 12][: request.param], [load_vehicle("modcube")] * request.param)


def state(seed: int) -> np.ndarray:
    """A fast, tilted robot under a disturbance."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=32) * np.repeat([1.0, 1.0, 0.4, 1.0, 0.02, 0.1, 3.0, 0.3, 0.05, 0.3], [3, 4, 3, 3, 3, 3, 3, 3, 1, 6])
    x[3:7] /= np.linalg.norm(x[3:7])
    x[29:] = Rotation.from_quat(x[[4, 5, 6, 3]]).inv().apply([0.0, 0.0, 1.0])
    return x


def error_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(28,) e with inject(b, e) = a, by scipy."""
    turn = Rotation.from_quat(b[[4, 5, 6, 3]]).inv() * Rotation.from_quat(a[[4, 5, 6, 3]])
    return np.r_[a[:3] - b[:3], turn.as_rotvec(), a[7:29] - b[7:29]]


def differences(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, h: float = 1e-5) -> np.ndarray:
    """Central differences of `function` over the 28 errors."""
    moved = [(propagation.inject(x, h * unit), propagation.inject(x, -h * unit)) for unit in np.eye(ERRORS)]
    return np.array([(function(above) - function(below)) / (2 * h) for above, below in moved]).T


# ---------------------------------------------------------------- process


def transition(x: np.ndarray, dt: float, body: Body, tau: np.ndarray = TAU) -> np.ndarray:
    """(28, 28) the full transition matrix F."""
    still = np.eye(ERRORS)[propagation.MOVING :]
    return np.vstack([propagation.transition(x, tau, dt, *body.plant), still])


def stepped(x: np.ndarray, body: Body, after: np.ndarray, dt: float) -> np.ndarray:
    """State one step after `x`, as the error from `after`."""
    return error_between(propagation.step(x, TAU, dt, *body.plant), after)


@pytest.fixture(scope="module", params=range(5))
def jacobians(body: Body, request: pytest.FixtureRequest) -> tuple[np.ndarray, np.ndarray]:
    """(F - I) / dt as the estimator computes it, and by finite differences of the step."""
    x = state(request.param)
    step = partial(stepped, body=body, after=propagation.step(x, TAU, DT, *body.plant), dt=DT)
    numeric = differences(step, x)
    return (transition(x, DT, body) - np.eye(ERRORS)) / DT, (numeric - np.eye(ERRORS)) / DT


def wrong_blocks(analytic: np.ndarray, numeric: np.ndarray) -> list[tuple[str, str]]:
    """Blocks that differ by more than 0.5 % of themselves and 0.02 % of the largest in their row."""
    wrong = []
    for row, rows in BLOCKS.items():
        of_row = 2e-4 * np.abs(numeric[rows]).max() + 1e-6
        for column, columns in BLOCKS.items():
            block = numeric[rows, columns]
            if np.abs(analytic[rows, columns] - block).max() > 5e-3 * np.abs(block).max() + of_row:
                wrong.append((row, column))
    return wrong


def test_every_block_of_the_transition_is_the_derivative_of_the_step(jacobians: tuple[np.ndarray, np.ndarray]) -> None:
    assert wrong_blocks(*jacobians) == []


@pytest.mark.parametrize(
    "block",
    [
        ("position", "attitude"), ("position", "velocity"), ("attitude", "attitude"), ("attitude", "rate"),
        ("velocity", "attitude"), ("velocity", "velocity"), ("velocity", "rate"), ("velocity", "force"),
        ("rate", "attitude"), ("rate", "rate"), ("rate", "moment"), ("rate", "righting"),
    ],
)  # fmt: skip
def test_block_of_the_wrong_sign_would_be_noticed(
    jacobians: tuple[np.ndarray, np.ndarray], block: tuple[str, str]
) -> None:
    spoilt = jacobians[0].copy()
    spoilt[BLOCKS[block[0]], BLOCKS[block[1]]] *= -1.0
    assert wrong_blocks(spoilt, jacobians[1]) == [block]


def test_force_has_moved_the_robot_by_the_end_of_the_step(body: Body) -> None:
    """The second-order block: half a dt squared over the mass."""
    x = np.zeros(32)
    x[3] = 1.0
    f = transition(x, 0.01, body, np.zeros(6))
    np.testing.assert_allclose(f[0:3, 18:21], 0.5e-4 * body.mass_inv[:3, :3], atol=1e-12)
    np.testing.assert_allclose(f[3:6, 21:24], 0.5e-4 * body.mass_inv[3:, 3:], atol=1e-12)


def test_transition_is_second_order_in_the_step(body: Body) -> None:
    """Halving the step quarters the error of one step's Jacobian or better, down to rounding."""
    x = state(1)
    errors = []
    for dt in (0.02, 0.01, 0.005):
        step = partial(stepped, body=body, after=propagation.step(x, TAU, dt, *body.plant), dt=dt)
        numeric = differences(step, x)
        errors.append(np.abs(transition(x, dt, body) - numeric).max())
    assert errors[1] < 0.35 * errors[0]
    assert errors[2] < 0.35 * errors[1]


@pytest.mark.slow
def test_step_follows_the_equations_of_motion(body: Body) -> None:
    """Half a second in ticks against an adaptive solver of the same equations."""
    x = state(2)

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        q = np.ascontiguousarray(y[3:7] / np.linalg.norm(y[3:7]))
        turn = Rotation.from_quat(q[[1, 2, 3, 0]])
        nu = np.ascontiguousarray(y[7:13])
        external = TAU + np.r_[turn.inv().apply(x[19:22]), x[22:25]]
        external[3:] += np.cross(x[26:29], turn.inv().apply([0.0, 0.0, -1.0]))
        acceleration = propagation.acceleration(nu, q, external, *body.plant)
        return np.r_[turn.apply(nu[:3]), 0.5 * multiply(q, np.r_[0.0, nu[3:]]), acceleration]

    exact = solve_ivp(rates, (0.0, 0.5), x[:13], method="DOP853", rtol=1e-10, atol=1e-12).y[:, -1]
    y = x
    for _ in range(50):
        y = propagation.step(y, TAU, 0.01, *body.plant)
    exact_turn = np.ascontiguousarray(exact[3:7] / np.linalg.norm(exact[3:7]))
    np.testing.assert_allclose(y[:3], exact[:3], atol=2e-4)
    np.testing.assert_allclose(difference(np.ascontiguousarray(y[3:7]), exact_turn), 0.0, atol=1e-3)
    np.testing.assert_allclose(y[7:13], exact[7:], atol=3e-3)
    np.testing.assert_array_equal(y[13:29], x[13:29], "biases, disturbance and righting stand still")


def test_acceleration_is_force_over_mass_at_rest(body: Body) -> None:
    level = np.array([1.0, 0.0, 0.0, 0.0])
    got = propagation.acceleration(np.zeros(6), level, TAU, *body.plant)
    np.testing.assert_allclose(body.mass @ got, TAU + np.r_[0, 0, 0, np.cross(body.righting, [0, 0, -1])], atol=1e-12)


def test_injected_error_is_a_turn_in_the_body_frame() -> None:
    x = state(3)
    e = np.random.default_rng(5).normal(scale=0.1, size=ERRORS)
    np.testing.assert_allclose(error_between(propagation.inject(x, e), x), e, atol=1e-12)


def test_carried_rate_is_the_gyros_less_its_bias(body: Body) -> None:
    x = state(4)
    gyros = np.array([[0.1, 0.2, 0.3], [np.nan] * 3, [-0.1, 0.4, 0.2]])
    carried = propagation.carry(x, np.tile(TAU, (3, 1)), gyros, 0.01, 0.004, *body.plant)
    np.testing.assert_allclose(carried[10:13], gyros[2] - x[13:16], atol=1e-15)
    by_hand = propagation.step(x, TAU, 0.004, *body.plant)
    by_hand[10:13] = gyros[0] - x[13:16]
    by_hand = propagation.step(by_hand, TAU, 0.01, *body.plant)
    by_hand = propagation.step(by_hand, TAU, 0.01, *body.plant)
    np.testing.assert_allclose(carried[:10], by_hand[:10], atol=1e-15)


def test_carried_pose_is_as_uncertain_as_its_derivatives_say(body: Body) -> None:
    """Variance after carrying for 0.2 s by given gyro samples, against finite differences of the carrying itself."""
    x = state(0)
    x[7:13] *= 0.1
    gyros = np.tile(x[10:13] + x[13:16], (20, 1))
    taus = np.tile(0.1 * TAU, (20, 1))
    now = propagation.carry(x, taus, gyros, 0.01, 0.01, *body.plant)

    def carried(y: np.ndarray) -> np.ndarray:
        return error_between(propagation.carry(y, taus, gyros, 0.01, 0.01, *body.plant), now)[:6]

    jacobian = differences(carried, x)
    sigma = np.repeat([1e-4, 1e-4, 0.02, 0.0, 0.01, 0.0, 2.0, 0.0, 0.0, 0.0], [3, 3, 3, 3, 3, 3, 3, 3, 1, 3])
    expected = np.diag(jacobian @ np.diag(sigma**2) @ jacobian.T)
    no_noise = np.zeros(ERRORS)
    got = observation.carried_pose_variance(x, np.diag(sigma**2), no_noise, body.mass_inv, 0.2, 0.0)
    np.testing.assert_allclose(got, expected, rtol=0.25)


# ---------------------------------------------------------------- measurements


@pytest.mark.parametrize("seed", range(5))
def test_tag_jacobian_is_the_derivative_of_the_residual(seed: int) -> None:
    x = state(seed)
    p_wt, q_wb = x[:3] + 0.3, multiply(x[3:7].copy(), exp(np.array([0.002, -0.001, 0.003])))
    _, h, _ = observation.tag(x, p_wt, LEVER, q_wb, np.ones(6))
    numeric = differences(lambda y: observation.tag(y, p_wt, LEVER, q_wb, np.ones(6))[0], x)
    np.testing.assert_allclose(h, -numeric, atol=3e-3)
    np.testing.assert_allclose(h[:3], -numeric[:3], atol=1e-8)


def test_tag_residual_is_zero_where_the_tag_is() -> None:
    x = state(1)
    p_wt = x[:3] + Rotation.from_quat(x[[4, 5, 6, 3]]).apply(LEVER)
    residual, _, noise = observation.tag(x, p_wt, LEVER, x[3:7].copy(), np.arange(1.0, 7.0))
    np.testing.assert_allclose(residual, 0.0, atol=1e-14)
    np.testing.assert_array_equal(noise, np.arange(1.0, 7.0))


@pytest.mark.parametrize("seed", range(5))
def test_inertial_jacobian_is_the_derivative_of_the_residual(seed: int) -> None:
    x, sigma = state(seed), np.array([0.1, 0.2, 0.3])
    gyro, accel = np.array([0.1, 0.2, 0.3]), np.array([0.5, -0.2, -9.7])
    moved = np.array([0.3, -0.1, 0.2])
    _, h, noise = observation.inertial(x, gyro, accel, 1.2, sigma, moved, np.zeros((3, 3)))
    numeric = differences(lambda y: observation.inertial(y, gyro, accel, 1.2, sigma, moved, np.zeros((3, 3)))[0], x)
    np.testing.assert_allclose(h, -numeric, atol=1e-8)
    np.testing.assert_allclose(noise, np.repeat(sigma, [3, 3, 1]) ** 2)


@pytest.mark.parametrize("seed", range(5))
def test_accelerometer_s_jacobian_is_the_derivative_by_tilt_bias_and_disturbance(seed: int, body: Body) -> None:
    """The derivative by velocity (drag) is left out: 0.4 m/s^2 per m/s, while velocity is known to a centimetre per second."""
    x, gyro, accel = state(seed), np.full(3, np.nan), np.array([0.5, -0.2, -9.7])
    mobility = np.ascontiguousarray(body.mass_inv[:3, :3])

    def residual(y: np.ndarray) -> np.ndarray:
        moved = propagation.inertial_acceleration(y, TAU, *body.plant)
        return observation.inertial(y, gyro, accel, np.nan, np.ones(3), moved, mobility)[0]

    _, h, _ = observation.inertial(x, gyro, accel, np.nan, np.ones(3), np.zeros(3), mobility)
    numeric, known = -differences(residual, x), [*range(3, 6), *range(15, 21)]
    np.testing.assert_allclose(h[:, known], numeric[:, known], atol=2e-3 * np.abs(numeric[:, known]).max())


def test_accelerometer_of_a_level_robot_at_rest_points_up() -> None:
    """It measures the force that holds it: -g along z, which points down."""
    x = np.zeros(32)
    x[3] = 1.0
    residual, _, _ = observation.inertial(x, np.zeros(3), np.array([0.0, 0.0, -9.80665]), 0.0, np.ones(3), np.zeros(3), np.zeros((3, 3)))
    np.testing.assert_allclose(residual, 0.0)
    x[3:7] = from_euler(0.5, 0.0, 0.0)
    felt = np.array([0.0, -9.80665 * np.sin(0.5), -9.80665 * np.cos(0.5)])
    tilted, _, _ = observation.inertial(x, np.zeros(3), felt, 0.0, np.ones(3), np.zeros(3), np.zeros((3, 3)))
    np.testing.assert_allclose(tilted, 0.0, atol=1e-14)


def test_accelerometer_feels_what_moves_the_robot() -> None:
    x = np.zeros(32)
    x[3] = 1.0
    pushed = np.array([0.5, 0.0, -9.80665])
    residual, _, _ = observation.inertial(x, np.zeros(3), pushed, 0.0, np.ones(3), np.array([0.5, 0.0, 0.0]), np.zeros((3, 3)))
    np.testing.assert_allclose(residual, 0.0, atol=1e-15)


def test_acceleration_against_the_world_is_the_change_of_the_velocity_in_it(body: Body) -> None:
    x, h = state(2), 1e-6
    later = propagation.step(x, TAU, h, *body.plant)
    before, after = (Rotation.from_quat(y[[4, 5, 6, 3]]).apply(y[7:10]) for y in (x, later))
    expected = Rotation.from_quat(x[[4, 5, 6, 3]]).inv().apply((after - before) / h)
    np.testing.assert_allclose(propagation.inertial_acceleration(x, TAU, *body.plant), expected, atol=1e-4)


@pytest.mark.parametrize("gyro", [True, False])
@pytest.mark.parametrize("accel", [True, False])
@pytest.mark.parametrize("depth", [True, False])
def test_sensor_that_did_not_come_has_no_row(gyro: bool, accel: bool, depth: bool) -> None:
    x, sigma = state(0), np.array([0.1, 0.2, 0.3])
    moved = np.zeros(3)
    full = observation.inertial(x, np.ones(3), 2 * np.ones(3), 3.0, sigma, moved, np.eye(3))
    nothing = np.full(3, np.nan)
    part = observation.inertial(
        x,
        np.ones(3) if gyro else nothing,
        2 * np.ones(3) if accel else nothing,
        3.0 if depth else np.nan,
        sigma,
        moved,
        np.eye(3),
    )
    rows = np.repeat([gyro, accel, depth], [3, 3, 1])
    np.testing.assert_array_equal(part[0], full[0][rows])
    np.testing.assert_array_equal(part[1], full[1][rows])
    np.testing.assert_array_equal(part[2], full[2][rows])


def measurement(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Covariance, residual, Jacobian and variances of a random measurement."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(ERRORS, ERRORS))
    return half @ half.T, 0.1 * rng.normal(size=6), rng.normal(size=(6, ERRORS)), rng.uniform(1, 2, 6)


@pytest.mark.parametrize("seed", range(5))
def test_update_is_that_of_filterpy(seed: int) -> None:
    covariance, residual, h, variance = measurement(seed)
    error, expected = kalman.update(np.zeros(ERRORS), covariance, residual, np.diag(variance), h)
    nis, x, got = observation.update(state(seed), covariance, residual, h, variance, np.zeros((6, ERRORS)), np.inf)
    np.testing.assert_allclose(got, expected, atol=1e-10)
    np.testing.assert_array_equal(got, got.T)
    np.testing.assert_allclose(x, propagation.inject(state(seed), error), atol=1e-12)
    assert nis == pytest.approx(residual @ np.linalg.inv(h @ covariance @ h.T + np.diag(variance)) @ residual)


@pytest.mark.parametrize("seed", range(5))
def test_update_with_noise_that_moved_the_state_is_that_of_filterpy(seed: int) -> None:
    covariance, residual, h, variance = measurement(seed)
    shared = 0.2 * np.random.default_rng(seed + 100).normal(size=(6, ERRORS))
    h[:, 6:9], shared[:, :6], shared[:, 9:] = 0.0, 0.0, 0.0
    oracle = kalman.KalmanFilter(dim_x=ERRORS, dim_z=6)
    oracle.P, oracle.H, oracle.R, oracle.M = covariance, h, np.diag(variance), shared.T.copy()
    oracle.update_correlated(residual)
    _, x, got = observation.update(state(seed), covariance, residual, h, variance, shared, np.inf)
    np.testing.assert_allclose(got, oracle.P, atol=1e-9)
    np.testing.assert_allclose(x, propagation.inject(state(seed), oracle.x[:, 0]), atol=1e-11)


@pytest.mark.parametrize("spoil", [1e3, np.nan, np.inf])
def test_measurement_beyond_the_gate_changes_nothing(spoil: float) -> None:
    covariance, residual, h, variance = measurement(0)
    residual[2] += spoil
    nis, x, got = observation.update(state(0), covariance, residual, h, variance, np.zeros((6, ERRORS)), 36.0)
    assert not nis <= 36.0
    np.testing.assert_array_equal(x, state(0))
    np.testing.assert_array_equal(got, covariance)


@pytest.mark.parametrize(("axes", "kept"), [(2, 1.0), (3, 0.0)])
def test_stillness_takes_the_speed_over_ground_and_leaves_what_it_says_nothing_of(axes: int, kept: float) -> None:
    x = state(3)
    before, down = Rotation.from_quat(x[[4, 5, 6, 3]]).apply(x[7:10]), np.array([0.0, 0.0, 1.0])
    after, covariance = observation.fuse_stillness(x, np.eye(ERRORS), 1e-9, axes, np.inf)
    now = Rotation.from_quat(after[[4, 5, 6, 3]]).apply(after[7:10])
    np.testing.assert_allclose(now, kept * (before @ down) * down, atol=1e-6)
    np.testing.assert_allclose(after[10:], x[10:], atol=1e-12)
    np.testing.assert_allclose(covariance[3:6, 3:6], np.eye(3), atol=1e-12)


def test_heading_that_is_north_by_definition_is_known_and_no_other_angle() -> None:
    x = state(3)
    after, covariance = observation.fuse_stillness(x, np.eye(ERRORS), 1e9, 2, 1e-9)
    down_b = Rotation.from_quat(x[[4, 5, 6, 3]]).inv().apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(covariance[3:6, 3:6], np.eye(3) - np.outer(down_b, down_b), atol=1e-6)
    np.testing.assert_allclose(difference(after[3:7], x[3:7].copy()), 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_prediction_is_that_of_filterpy(body: Body, seed: int) -> None:
    covariance, density = measurement(seed)[0], np.random.default_rng(seed).uniform(1, 2, ERRORS)
    f = transition(state(seed), DT, body)
    speed, rate = (np.linalg.norm(state(seed)[at]) for at in (slice(7, 10), slice(10, 13)))
    moving = np.repeat([0.0, 0.3 * rate, 0.0, np.hypot(0.7 * speed, 0.2 * rate), 0.0], [9, 3, 6, 3, 7])
    q = np.diag(density + moving**2) * DT
    for i in range(3):
        pair = np.ix_([3 + i, 9 + i], [3 + i, 9 + i])
        q[pair] += Q_continuous_white_noise(2, DT, density[9 + i] + moving[9 + i] ** 2) - np.diag([0.0, q[9 + i, 9 + i]])
    _, expected = kalman.predict(np.zeros(ERRORS), covariance, f, q)
    x, got = propagation.predict(state(seed), covariance, TAU, DT, density, np.array([0.7, 0.2, 0.3]), *body.plant)
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(got, got.T)
    np.testing.assert_array_equal(x, propagation.step(state(seed), TAU, DT, *body.plant))
