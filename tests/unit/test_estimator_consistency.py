"""The estimator against a plain Kalman filter that gets everything in time order, and against its own covariance."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise
from scipy.spatial.transform import Rotation

from firmware_py.core import propagation
from firmware_py.core.body import Body
from firmware_py.core.controller import Controller
from firmware_py.core.estimator import Estimator
from firmware_py.core.propagation import ERRORS, STATES
from firmware_py.core.rotations import difference, exp, from_euler, multiply, to_matrix
from firmware_py.core.topology import TURNING
from firmware_py.core.types import BodyPose, Estimate, Measured, Setpoint
from firmware_py.description.parameters import Control, Estimation
from firmware_py.description.schema import limits_of
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble

PERIOD = 10_000_000
DT = 0.01
LEVER = np.array([0.0, 0.0, -0.105])
P = Estimation()


@pytest.fixture(scope="module")
def body() -> Body:
    return assemble([(0, 0, 0), (1, 0, 0)], [0, 4], [load_vehicle("modcube")] * 2)


def tag_of(x: np.ndarray, capture_ns: int, noise: np.ndarray | None = None, lever: np.ndarray = LEVER) -> BodyPose:
    """Tag measurement of a robot in state `x`; noise (6,) of position and attitude."""
    e = np.zeros(6) if noise is None else noise
    p_wt = x[:3] + Rotation.from_quat(x[[4, 5, 6, 3]]).apply(lever) + e[:3]
    return BodyPose(capture_ns, p_wt, lever, multiply(x[3:7].copy(), exp(e[3:].copy())), 1)


def inertial_of(x: np.ndarray, moved: np.ndarray, rng: np.random.Generator | None = None, accel_noise: float = 0.0) -> Measured:
    """Measurements of gyro, accelerometer and pressure sensor of a robot in state `x` that accelerates by `moved` (3,)."""
    down = Rotation.from_quat(x[[4, 5, 6, 3]]).inv().apply([0.0, 0.0, 1.0])
    noise = np.zeros(7) if rng is None else rng.normal(size=7)
    gyro = x[10:13] + x[13:16] + P.gyro_sigma * noise[:3]
    accel = x[16:19] + moved - 9.80665 * down + accel_noise * noise[3:6]
    return Measured(gyro, accel, float(x[2] + x[25] + P.depth_sigma_m * noise[6]), [])


def start_state(p_wb: tuple[float, float, float] = (1.0, -0.5, 0.8)) -> np.ndarray:
    x = np.zeros(STATES)
    x[:3] = p_wb
    x[3:7] = from_euler(0.2, -0.4, 1.0)
    x[29:] = to_matrix(x[3:7].copy())[2]
    return x


def still(body: Body, x: np.ndarray) -> np.ndarray:
    """The thruster wrench that holds a robot in state `x`."""
    up = Rotation.from_quat(x[[4, 5, 6, 3]]).inv().apply([0.0, 0.0, -1.0])
    return np.r_[0.0, 0.0, 0.0, -np.cross(body.righting + x[26:29], up)]


@dataclass
class Flight:
    """A randomly drawn flight: truth, wrench and measurements of each tick; tags are in the tick of their arrival."""

    truth: list[np.ndarray] = field(default_factory=list)
    tau: list[np.ndarray] = field(default_factory=list)
    measured: list[Measured] = field(default_factory=list)

    def ticks(self) -> Iterator[tuple[int, np.ndarray, Measured]]:
        for k, (tau, measured) in enumerate(zip(self.tau, self.measured, strict=True)):
            yield k * PERIOD, tau, measured


def process_sigma(body: Body, p: Estimation, x: np.ndarray) -> np.ndarray:
    """(28,) root spectral density of the process noise of a robot in state x, from the definitions of the parameters."""
    m, j = np.diag(body.mass)[:3], np.diag(body.mass)[3:]
    rate = np.linalg.norm(x[10:13])
    drag_slope = 2.0 * body.drag.nodes[..., 0].mean() * np.hypot(np.linalg.norm(x[7:10]), body.reach_m * rate)
    force = np.hypot(p.force_walk * m, p.current_walk * drag_slope)
    alpha = np.hypot(p.alpha_process, p.alpha_turning * rate)
    walks = [p.gyro_bias_walk] * 3 + [p.accel_bias_walk] * 3 + list(force) + list(p.moment_walk * j) + [p.depth_bias_walk]
    return np.array([0.0] * 6 + [p.accel_process] * 3 + [alpha] * 3 + walks + list(p.righting_walk * body.righting_sigma))


def accel_sigma(body: Body, p: Estimation, x: np.ndarray) -> float:
    """Noise of the accelerometer of a robot in state x, from the definitions of the parameters."""
    fastest = np.hypot(np.linalg.norm(x[7:10]), body.reach_m * np.linalg.norm(x[10:13]))
    return float(np.hypot(p.accel_sigma, p.accel_under_way * fastest))


def fly(
    body: Body, seconds: float, seed: int, delay_ms: Callable[[int], float], push: float = 1.0, tag_ms: float = 17.0, p: Estimation = P
) -> Flight:
    """A robot pushed about by slow sines, drawn from the estimator's own model; tags between and on the ticks."""
    rng = np.random.default_rng(seed)
    flight = Flight()
    x = start_state()
    x[13:16], x[16:19], x[25] = rng.normal(scale=0.02, size=3), rng.normal(scale=0.1, size=3), 0.03
    x[26:29] = body.righting_sigma * rng.normal(size=3)
    tag_sigma = np.repeat([p.tag_sigma_m, p.tag_sigma_axis_m, p.tag_sigma_rad], [2, 1, 3])
    count = round(seconds / DT)
    arriving: dict[int, list[BodyPose]] = {}
    pictures, taken = [round(n * tag_ms * 1e6) for n in range(int(seconds * 1e3 / tag_ms))], 0
    for k in range(count):
        t = k * PERIOD
        tau = still(body, x) + push * np.array([4.0, -3.0, 3.0, 0.3, -0.3, 0.3]) * np.sin(0.7 * t * 1e-9 + np.arange(6))
        tau *= k > 0
        before, surprise = x, np.zeros(ERRORS)
        if k:
            surprise = process_sigma(body, p, x) * np.sqrt(DT) * rng.normal(size=ERRORS)
            surprise[3:6] = 0.5 * DT * surprise[9:12]  # a rate gained evenly over this tick has turned it for half of that time
            x = propagation.inject(propagation.step(x, tau, DT, *body.plant), surprise)
        while taken < len(pictures) and pictures[taken] <= t:
            capture = pictures[taken]
            part = (capture - t) * 1e-9 + DT
            seen = x if capture == t else propagation.step(before, tau, part, *body.plant)
            due = -(-(capture + round(delay_ms(taken) * 1e6)) // PERIOD)
            arriving.setdefault(due, []).append(tag_of(seen, capture, tag_sigma * rng.normal(size=6)))
            taken += 1
        flight.truth.append(x)
        flight.tau.append(tau)
        moved = propagation.inertial_acceleration(x, tau, *body.plant) + surprise[6:9] / DT  # measured, although not in the model
        flight.measured.append(inertial_of(x, moved, rng, accel_sigma(body, p, x))._replace(tags=arriving.pop(k, [])))
    return flight


class ReferenceFilter:
    """A textbook Kalman filter on the error state: it gets every event in the order in which it happened, nothing late.

    Measurement Jacobians by finite differences of its own models; the standard covariance update, (I - K H) P.
    """

    def __init__(self, body: Body, first: BodyPose, p: Estimation) -> None:
        self.plant = body.plant
        self.x = np.zeros(STATES)
        self.x[3:7] = first.q_wb
        self.x[:3] = first.p_wt - self._turn(self.x).apply(first.lever_b)
        self.x[29:] = self._turn(self.x).inv().apply([0.0, 0.0, 1.0])
        m, j = np.diag(body.mass)[:3], np.diag(body.mass)[3:]
        sigma = [0.02] * 3 + [0.05] * 3 + [0.2] * 3 + [0.3] * 3 + [0.02] * 3 + [0.1] * 3 + list(0.1 * m) + list(0.3 * j)
        self.covariance = np.diag(np.r_[sigma, 0.1, body.righting_sigma]) ** 2
        self.body, self.p = body, p
        self.time_ns = first.capture_ns

    @staticmethod
    def _turn(x: np.ndarray) -> Rotation:
        return Rotation.from_quat(x[[4, 5, 6, 3]])

    def propagate(self, tau: np.ndarray, to_ns: int) -> float:
        """Propagates to `to_ns`; returns for how long, s."""
        dt = (to_ns - self.time_ns) * 1e-9
        if dt > 0.0:
            f = np.vstack([propagation.transition(self.x, tau, dt, *self.plant), np.eye(ERRORS)[propagation.MOVING :]])
            density = process_sigma(self.body, self.p, self.x) ** 2
            noise = np.diag(density * dt)
            for i in range(3):
                noise[np.ix_([3 + i, 9 + i], [3 + i, 9 + i])] = Q_continuous_white_noise(2, dt, density[9 + i])
            self.x = propagation.step(self.x, tau, dt, *self.plant)
            self.covariance = f @ self.covariance @ f.T + noise
        self.time_ns = to_ns
        return dt

    def _correct(self, residual: Callable[[np.ndarray], np.ndarray], noise: np.ndarray, shared: np.ndarray | None = None) -> None:
        """Fuses a measurement. shared: (28, m) covariance of error and noise (Anderson and Moore, Optimal Filtering, 1979, section 5.5)."""
        h = 1e-6
        moved = [(propagation.inject(self.x, h * e), propagation.inject(self.x, -h * e)) for e in np.eye(ERRORS)]
        jacobian = np.array([(residual(below) - residual(above)) / (2 * h) for above, below in moved]).T
        m = np.zeros((ERRORS, len(noise))) if shared is None else shared
        s = jacobian @ self.covariance @ jacobian.T + jacobian @ m + m.T @ jacobian.T + np.diag(noise)
        gain = (self.covariance @ jacobian.T + m) @ np.linalg.inv(s)
        self.x = propagation.inject(self.x, gain @ residual(self.x))
        self.covariance = self.covariance - gain @ (jacobian @ self.covariance + m.T)

    def fuse_inertial(self, measured: Measured, tau: np.ndarray, elapsed: float, whole: bool = True) -> None:
        """Fuses the inertial sensors and depth of one tick; for a part of a tick (not `whole`), the accelerometer alone.

        The acceleration by thrusters and drag is taken as known; the accelerometer measures the process noise.
        """
        if elapsed <= 0.0:
            return
        base = propagation.inertial_acceleration(self.x, tau, *self.plant)
        mobility, pushed = self.plant[1][:3, :3], self._turn(self.x).inv().apply(self.x[19:22])

        def residual(x: np.ndarray) -> np.ndarray:
            moved = base + mobility @ (self._turn(x).inv().apply(x[19:22]) - pushed)
            expected = inertial_of(x, moved)
            felt = measured.accel - expected.accel
            return np.r_[measured.gyro - expected.gyro, felt, measured.depth_m - expected.depth_m] if whole else felt

        p = self.p
        felt = [(accel_sigma(self.body, p, self.x) ** 2 * DT + p.accel_process**2) / elapsed] * 3
        noise = np.r_[[p.gyro_sigma**2] * 3, felt, p.depth_sigma_m**2] if whole else np.array(felt)
        shared = np.zeros((ERRORS, len(noise)))
        for i in range(3):
            shared[6 + i, i + 3 * whole] = p.accel_process**2
        self._correct(residual, noise, shared)

    def fuse_tag(self, tag: BodyPose) -> None:
        """Fuses one tag; its attitude residual, a rotation vector in the body frame, is taken at first order."""

        def residual(x: np.ndarray) -> np.ndarray:
            turn = self._turn(x)
            seen = Rotation.from_quat(tag.q_wb[[1, 2, 3, 0]])
            return np.r_[tag.p_wt - x[:3] - turn.apply(tag.lever_b), (turn.inv() * seen).as_rotvec()]

        p = self.p
        self._correct(residual, np.repeat([p.tag_sigma_m, p.tag_sigma_axis_m, p.tag_sigma_rad], [2, 1, 3]) ** 2)


def in_order(body: Body, flight: Flight, p: Estimation = P) -> ReferenceFilter:
    """The reference filter, run over all tags that arrived by the end, stopped at the newest of them."""
    tags = sorted((tag for measured in flight.measured for tag in measured.tags), key=lambda tag: tag.capture_ns)
    reference = ReferenceFilter(body, tags[0], p)
    waiting = tags[1:]
    for time_ns, tau, measured in flight.ticks():
        if time_ns <= tags[0].capture_ns:
            continue
        while waiting and waiting[0].capture_ns < time_ns:
            reference.fuse_inertial(measured, tau, reference.propagate(tau, waiting[0].capture_ns), whole=False)
            reference.fuse_tag(waiting.pop(0))
        if not waiting:
            return reference
        reference.fuse_inertial(measured, tau, reference.propagate(tau, time_ns))
        while waiting and waiting[0].capture_ns == time_ns:
            reference.fuse_tag(waiting.pop(0))
        if not waiting:
            return reference
    raise AssertionError("a tag was left over")


def run(body: Body, flight: Flight, p: Estimation = P) -> tuple[Estimator, list[Estimate]]:
    estimator = Estimator(body, p, PERIOD)
    return estimator, [estimator.step(time_ns, measured, tau) for time_ns, tau, measured in flight.ticks()]


# ---------------------------------------------------------------- late tags


@pytest.mark.slow
@pytest.mark.parametrize(
    "delay_ms",
    [lambda n: 0.0, lambda n: 65.0, lambda n: 43.0 + 8.0 * (n % 2), lambda n: 300.0],
    ids=["at once", "65 ms late", "43 and 51 ms late", "300 ms late"],
)
def test_late_tags_count_as_if_they_had_come_in_time(body: Body, delay_ms: Callable[[int], float]) -> None:
    flight = fly(body, 0.9, 1, delay_ms)
    open_gate = replace(P, tag_gate=50.0)
    _, estimates = run(body, flight, open_gate)
    reference = in_order(body, flight)
    x, last = reference.x, reference.time_ns
    for time_ns, tau, measured in flight.ticks():
        if time_ns > last:
            x = propagation.step(x, tau, (time_ns - max(last, time_ns - PERIOD)) * 1e-9, *body.plant)
            x[10:13] = measured.gyro - x[13:16]
    e = estimates[-1]
    np.testing.assert_allclose(e.p_wb, x[:3], atol=2e-6)
    np.testing.assert_allclose(difference(e.q_wb, x[3:7].copy()), 0.0, atol=2e-6)
    np.testing.assert_allclose(e.nu, x[7:13], atol=2e-5)
    np.testing.assert_allclose(e.force_w, x[19:22], atol=1e-4)
    up = Rotation.from_quat(x[[4, 5, 6, 3]]).inv().apply([0.0, 0.0, -1.0])
    np.testing.assert_allclose(e.moment_b, x[22:25] + np.cross(x[26:29], up), atol=1e-4)


def test_same_inputs_give_the_same_bytes(body: Body) -> None:
    flight = fly(body, 0.6, 7, lambda n: 50.0)
    first, second = (run(body, flight)[1] for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert all(np.asarray(u).tobytes() == np.asarray(v).tobytes() for u, v in zip(a, b, strict=True))


# ---------------------------------------------------------------- its own covariance


@pytest.fixture(scope="module")
def drawn(body: Body) -> list[tuple[Flight, list[Estimate]]]:
    flights = [fly(body, 3.0, seed, lambda n: 45.0) for seed in range(8)]
    return [(flight, run(body, flight)[1]) for flight in flights]


SETTLED = 100
"""Ticks after which the filter counts as settled."""


def test_innovations_are_as_large_as_the_filter_expects(drawn: list[tuple[Flight, list[Estimate]]]) -> None:
    """Mean NIS per degree of freedom is 1 for a filter whose model is that of the world: here within four sigma of 1."""
    settled = [e for _, estimates in drawn for e in estimates[SETTLED:] if e.nis_dof]
    dof = sum(e.nis_dof for e in settled)
    mean = sum(e.nis for e in settled) / dof
    assert dof > 5000
    assert abs(mean - 1.0) < 4.0 * np.sqrt(2.0 / dof)


def test_errors_are_as_large_as_the_sigmas_say(drawn: list[tuple[Flight, list[Estimate]]]) -> None:
    position, attitude = [], []
    for flight, estimates in drawn:
        for x, e in zip(flight.truth[SETTLED:], estimates[SETTLED:], strict=True):
            position.append((e.p_wb - x[:3]) / e.sigma_p)
            attitude.append(difference(x[3:7].copy(), e.q_wb) / e.sigma_q)
    for normalised in (position, attitude):
        per_axis = np.mean(np.square(normalised), axis=0)
        assert np.all(per_axis > 0.4) and np.all(per_axis < 2.0), "eight flights are few independent draws an axis"
        assert np.mean(per_axis) == pytest.approx(1.0, abs=0.35)


def sigmas_under_way(body: Body, rate_hz: int, speed_m_s: float) -> np.ndarray:
    """(6,) sigmas of the pose a second after the last tag, for a tick rate; the IMU's noise density is the same at every rate."""
    period_ns, per_sample = 1_000_000_000 // rate_hz, np.sqrt(rate_hz * DT)
    told = replace(P, gyro_sigma=P.gyro_sigma * per_sample, accel_sigma=P.accel_sigma * per_sample)
    estimator, x, seen, tag_ns = Estimator(body, told, period_ns), start_state(), 0, 20_000_000
    x[3:7], x[7] = from_euler(0.0, 0.0, 0.0), speed_m_s
    for k in range(2 * rate_hz):
        time_ns = k * period_ns
        x[0], tags = speed_m_s * time_ns * 1e-9, []
        while seen * tag_ns <= min(time_ns, 1_000_000_000):
            there = np.r_[speed_m_s * seen * tag_ns * 1e-9, x[1:]]
            tags, seen = [*tags, tag_of(there, seen * tag_ns)], seen + 1
        felt = inertial_of(x, np.zeros(3))
        depth_m = felt.depth_m if time_ns % 20_000_000 == 0 else None
        estimate = estimator.step(time_ns, felt._replace(depth_m=depth_m, tags=tags), still(body, x))
    return np.r_[estimate.sigma_p, estimate.sigma_q]


@pytest.mark.slow
@pytest.mark.parametrize("speed_m_s", [0.0, 1.0], ids=["at rest", "under way"])
def test_filter_is_as_sure_at_every_tick_rate(body: Body, speed_m_s: float) -> None:
    """More samples average out only noise that is drawn afresh for each; the error of a wrong mass is not of that kind."""
    usual = sigmas_under_way(body, 100, speed_m_s)
    for rate_hz in (50, 200, 400):
        np.testing.assert_allclose(sigmas_under_way(body, rate_hz, speed_m_s), usual, rtol=0.06, err_msg=f"{rate_hz} Hz")


def test_narrowest_gate_refuses_few_good_tags(body: Body) -> None:
    """The NIS of six axes has a chi-squared distribution: 1.4 % lie beyond 4 squared."""
    narrowest = replace(P, tag_gate=limits_of(Estimation, "tag_gate").low)
    _, estimates = run(body, fly(body, 4.0, 1, lambda n: 45.0), narrowest)
    tags = estimates[-1].rejected + sum(e.nis_dof for e in estimates) / 6
    assert tags > 200
    assert estimates[-1].rejected < 0.05 * tags
    assert all(e.ready for e in estimates[SETTLED:])


def test_estimate_is_better_than_the_tags(drawn: list[tuple[Flight, list[Estimate]]]) -> None:
    errors = [e.p_wb - x[:3] for f, es in drawn for x, e in zip(f.truth[SETTLED:], es[SETTLED:], strict=True)]
    assert np.sqrt(np.mean(np.square(errors))) < 0.6 * P.tag_sigma_m


def test_wrong_lever_arm_of_the_tag_would_be_noticed(body: Body, drawn: list[tuple[Flight, list[Estimate]]]) -> None:
    """A tag assumed 3 cm from where it is fails the bound on the error."""
    flight = drawn[0][0]
    off = np.array([0.0, 0.03, 0.0])
    wrong = [m._replace(tags=[tag._replace(lever_b=tag.lever_b + off) for tag in m.tags]) for m in flight.measured]
    _, estimates = run(body, replace(flight, measured=wrong))
    pairs = list(zip(flight.truth, estimates, strict=True))[SETTLED:]
    assert np.mean([np.square((e.p_wb - x[:3]) / e.sigma_p) for x, e in pairs]) > 5.0


@pytest.mark.slow
def test_drag_of_the_wrong_sign_would_be_noticed(body: Body) -> None:
    """At 0.7 m/s a filter whose drag has the wrong sign refuses good tags; the right one refuses none.

    With the shipped parameters, which trust the accelerometer more than the model, the wrong filter keeps its place and takes the drag for
    a disturbance.
    """
    pushed = replace(body, drag=replace(body.drag, nodes=-body.drag.nodes))
    believing = replace(P, accel_process=0.012, force_walk=0.015, current_walk=0.0, alpha_turning=0.0)
    flight = fly(body, 3.0, 1, lambda n: 45.0, push=6.0, p=believing)
    assert run(body, flight, believing)[1][-1].rejected == 0
    assert run(pushed, flight, believing)[1][-1].rejected > 10
    flight = fly(body, 3.0, 1, lambda n: 45.0, push=6.0)
    right, wrong = (run(each, flight)[1] for each in (body, pushed))
    assert right[-1].rejected == 0
    settled = flight.truth[SETTLED:]
    off = [np.mean([np.linalg.norm(e.force_w - x[19:22]) for x, e in zip(settled, each[SETTLED:], strict=True)]) for each in (right, wrong)]
    assert off[1] > 3.0 * off[0]


@pytest.mark.slow
def test_wrong_arm_and_trim_are_learned_by_tilting(body: Body) -> None:
    """After pitching up by half a radian and back, the filter knows the moment at every pitch, nose down too: up to 0.45 N m here."""
    x, estimator, rng = start_state(), Estimator(body, P, PERIOD), np.random.default_rng(2)
    x[3:7], x[26:29] = from_euler(0.0, 0.0, 0.0), 2.0 * body.righting_sigma * np.array([1.0, 0.0, -1.0])
    for k in range(1200):
        alpha = 0.07 * np.cos(2.0 * np.pi / 12.0 * k * DT)
        tau = still(body, x) + np.r_[0.0, 0.0, 0.0, body.mass[3:, 3:] @ np.array([0.0, alpha, 0.0])]
        before, x = x, propagation.step(x, tau, DT, *body.plant)
        felt = inertial_of(x, propagation.inertial_acceleration(before, tau, *body.plant), rng, P.accel_sigma)
        estimator.step(k * PERIOD, felt._replace(tags=[tag_of(x, k * PERIOD)]), tau)
    known, covariance = estimator.motion.x, estimator.motion.covariance[TURNING]
    for pitch in (-0.5, -0.25, 0.0, 0.25, 0.5):
        up = Rotation.from_rotvec([0.0, -pitch, 0.0]).apply([0.0, 0.0, -1.0])
        off = known[22:25] + np.cross(known[26:29], up) - np.cross(x[26:29], up)
        acts = np.hstack([np.eye(3), np.cross(np.eye(3), up).T])
        sigma = np.sqrt((acts @ covariance @ acts.T).diagonal())
        assert np.all(np.abs(off) < np.minimum(0.03, 3.0 * sigma)), pitch


@pytest.mark.slow
def test_righting_of_a_robot_that_hovers_is_found_by_no_noise() -> None:
    """Five minutes under the controller, with noisy gyro, tags and water, leave its z as unknown as before; jitter is not learnt."""
    body = assemble([(0, 0, 0)], [0], [load_vehicle("modcube")])
    x, rng, estimator, controller = start_state(), np.random.default_rng(2), Estimator(body, P, PERIOD), Controller(body, Control())
    x[3:7], x[26:29] = from_euler(0.0, 0.0, 0.5), body.righting_sigma * np.array([1.0, -1.0, 0.0])
    aim = Setpoint(x[:3].copy(), x[3:7].copy(), *np.zeros((4, 3)))
    wanted, tau, surprise, noise = np.zeros(6), np.zeros(6), np.zeros(ERRORS), np.repeat([P.tag_sigma_m, P.tag_sigma_rad], 3)
    for k in range(30_000):
        tau = tau + (wanted - tau) * (1.0 - np.exp(-DT / 0.08))  # the thrusters' lag
        surprise[6:9], surprise[9:12] = np.sqrt(DT) * np.array([[P.accel_process], [P.alpha_process]]) * rng.normal(size=(2, 3))
        before, x = x, propagation.inject(propagation.step(x, tau, DT, *body.plant), surprise)
        moved = propagation.inertial_acceleration(before, tau, *body.plant) + surprise[6:9] / DT
        tags = [tag_of(x, k * PERIOD, noise * rng.normal(size=6))] if k % 2 == 0 else []
        wanted = controller.step(aim, aim, estimator.step(k * PERIOD, inertial_of(x, moved, rng, P.accel_sigma)._replace(tags=tags), tau))
    found, sigma = estimator.motion.x[26:29], np.sqrt(estimator.motion.covariance.diagonal()[25:])
    assert np.all(np.abs(found - x[26:29]) < 3.0 * sigma)
    assert sigma[2] == pytest.approx(body.righting_sigma[2], rel=0.05), "level, it turns the body in no direction"
    assert abs(found[2]) < 0.3 * sigma[2]
