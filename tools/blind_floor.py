"""Position error of the best possible filter of a hovering robot without tags: the floor under `make accept ONLY=blind`.

The filter is a Kalman filter of one horizontal axis that knows every parameter of the simulated world: the gust spectrum, the drag of the
water, the noise of IMU and tags. Only the noise drawn afresh at every sample is unknown, and no filter can know more about that (Anderson
and Moore 1979, chapter 5). The robot's own filter knows less, and its thrusters do not follow their commands exactly.

The tilting moment is the one open figure: the gyro measures the rotation, and a filter that also knew the moments would know the tilt
better. The floor is therefore given for several errors of the thruster moments that the filter assumes. Knowing the moments does not
separate a tilt from accelerating water, though: the pressure gradient of the water acts where the buoyancy does, so the robot hangs along
the apparent gravity, and the accelerometer measures the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from command_line import Parser, run_tool

import numpy as np
from scipy.linalg import expm

from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from hil.plant.spec import SensorSpec, WorldSpec
from hil.safety import ICM_20602, Imu
from hil.scenario import load_scenario

PLACE, SPEED, WATER, GUST_TARGET, TILT, RATE, MOMENT, STEADY, GYRO_BIAS, ACCEL_BIAS, PUSH = range(11)
STATES = 11
"""Number of states of one axis: place, m; speed, m/s; velocity of the water and the velocity that its gust tends to, m/s; tilt, rad; rate,
rad/s; transient and steady moment, N m; gyro bias, rad/s; accelerometer bias, m/s^2; steady push, m/s^2.
"""
PERIOD_S = 0.01
HOVERS = 4000
INITIAL_PUSH_SIGMA, INITIAL_MOMENT_SIGMA = 0.1, 0.1
"""Sigma of the steady push, m/s^2, and of the steady moment, N m, before the first tag: more than buoyancy, current and trim produce."""
INITIAL_TILT_SIGMA, INITIAL_RATE_SIGMA, INITIAL_PLACE_SIGMA = 0.05, 0.05, 0.02
"""Sigma of tilt, rad, rate, rad/s, and place, m, before the first tag."""
MOMENT_S = 1.0
"""Correlation time of the unforeseen moment: that of the gusts which the thrusters counteract (`gust_smoothing_s`)."""
UNFORESEEN_N_M = 1e-3
"""Sigma of the unforeseen moment: thruster forces off by 5 % while they counteract gusts of 0.01 m/s^2 at a lever arm of 0.1 m. Ten times
that sigma already changes nothing any more.
"""
EXACT_N_M = 1e-5
"""Sigma of the unforeseen moment for a filter that knows each thruster's force to a ten-thousandth of a newton."""


class Model(NamedTuple):
    """Linear Gaussian model of one axis over one tick."""

    step: np.ndarray
    """(11, 11) transition matrix F."""
    noise: np.ndarray
    """(11,) process noise variances per tick: the diagonal of Q."""
    inertial: tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]]
    """For accelerometer and gyro: (11,) row of the measurement matrix, and the variance of the measurement noise."""
    period_s: float
    start: np.ndarray
    """(11,) initial variances."""


def model(
    world: WorldSpec, sensors: SensorSpec, vehicle: Vehicle, unforeseen_n_m: float = UNFORESEEN_N_M, period_s: float = PERIOD_S
) -> Model:
    """Model of a robot at rest over ground in the world's mean current; accelerating water carries it along (Froude-Krylov and added mass).

    Args:
        unforeseen_n_m: sigma of the transient moment, which is unknown to the filter.
    """
    t1, t2 = world.gust_time_s, world.gust_smoothing_s
    tends = world.gust_m_s * math.sqrt((t1 + t2) / t1)
    moved_kg = vehicle.inertial.wet_kg + vehicle.inertial.added[0]
    area = vehicle.hull.size_m[1] * vehicle.hull.size_m[2]
    pull = world.density * vehicle.drag.cd_face * area * world.current_m_s / moved_kg
    inertia = vehicle.inertial.inertia[1, 1] + vehicle.inertial.added[4]
    upright = world.gravity * vehicle.inertial.wet_kg * vehicle.inertial.righting_arm_m
    rates = np.zeros((STATES, STATES))
    rates[PLACE, SPEED] = 1.0
    rates[WATER, [WATER, GUST_TARGET]] = -1.0 / t2, 1.0 / t2
    rates[SPEED] = rates[WATER]
    rates[SPEED, [SPEED, WATER, PUSH]] += -pull, pull, 1.0
    rates[GUST_TARGET, GUST_TARGET] = -1.0 / t1
    rates[TILT, RATE] = 1.0
    rates[RATE, [TILT, MOMENT, STEADY]] = np.array([-upright, 1.0, 1.0]) / inertia
    rates[RATE] += rates[RATE, TILT] / world.gravity * rates[WATER]
    rates[MOMENT, MOMENT] = -1.0 / MOMENT_S
    noise = np.zeros(STATES)
    noise[GUST_TARGET] = tends**2 * (1.0 - math.exp(-2.0 * period_s / t1))
    noise[MOMENT] = unforeseen_n_m**2 * (1.0 - math.exp(-2.0 * period_s / MOMENT_S))
    noise[GYRO_BIAS], noise[ACCEL_BIAS] = sensors.gyro_walk**2 * period_s, sensors.accel_walk**2 * period_s
    felt, turning = rates[SPEED].copy(), np.zeros(STATES)
    felt[TILT], felt[ACCEL_BIAS] = world.gravity, 1.0
    turning[RATE] = turning[GYRO_BIAS] = 1.0
    water, biases = [world.current_m_s, world.gust_m_s, tends], [sensors.gyro_bias, sensors.accel_bias]
    start = np.array([
        INITIAL_PLACE_SIGMA, *water, INITIAL_TILT_SIGMA, INITIAL_RATE_SIGMA, unforeseen_n_m, INITIAL_MOMENT_SIGMA, *biases,
        INITIAL_PUSH_SIGMA,
    ]) ** 2  # fmt: skip
    inertial = ((felt, sensors.accel_sigma**2), (turning, sensors.gyro_sigma**2))
    return Model(expm(period_s * rates), noise, inertial, period_s, start)


def gain(covariance: np.ndarray, row: np.ndarray, variance: float) -> tuple[np.ndarray, np.ndarray]:
    """Kalman gain (11,) for one measurement, and the covariance (11, 11) after it."""
    seen = covariance @ row
    k = seen / (row @ seen + variance)
    return k, covariance - np.outer(k, seen)


def with_tags(axis: Model, sensors: SensorSpec, seconds: float) -> np.ndarray:
    """(11, 11) covariance after `seconds` with every picture."""
    covariance = np.diag(axis.start)
    tags = [(PLACE, sensors.tag_sigma_m**2), (TILT, math.radians(sensors.tag_sigma_deg) ** 2)]
    pictures = 0
    for tick in range(round(seconds / axis.period_s)):
        covariance = axis.step @ covariance @ axis.step.T + np.diag(axis.noise)
        for row, variance in axis.inertial:
            covariance = gain(covariance, row, variance)[1]
        if tick * axis.period_s * sensors.tag_rate_hz >= pictures:
            pictures += 1
            for state, variance in tags:
                covariance = gain(covariance, np.eye(STATES)[state], variance)[1]
    return covariance


def without_tags(axis: Model, covariance: np.ndarray, seconds: float) -> tuple[list[list[np.ndarray]], np.ndarray]:
    """Kalman gains, (11,) each, of accelerometer and gyro in every tick, and the covariance (11, 11) after `seconds` with these alone."""
    gains: list[list[np.ndarray]] = []
    for _ in range(round(seconds / axis.period_s)):
        covariance = axis.step @ covariance @ axis.step.T + np.diag(axis.noise)
        gains.append([])
        for row, variance in axis.inertial:
            k, covariance = gain(covariance, row, variance)
            gains[-1].append(k)
    return gains, covariance


def largest_errors(axis: Model, covariance: np.ndarray, seconds: float) -> np.ndarray:
    """(HOVERS,) largest horizontal error of each hover over `seconds` without tags, m: the filter's error, sampled from its own statistics.

    Args:
        covariance: (11, 11) at the last tag, for each of the two axes.
    """
    rng = np.random.default_rng(0)
    errors = rng.multivariate_normal(np.zeros(STATES), covariance, (2, HOVERS), method="eigh")
    spread, largest = np.sqrt(axis.noise), np.zeros(HOVERS)
    for gains in without_tags(axis, covariance, seconds)[0]:
        errors = errors @ axis.step.T + spread * rng.standard_normal(errors.shape)
        for k, (row, variance) in zip(gains, axis.inertial, strict=True):
            innovations = errors @ row + math.sqrt(variance) * rng.standard_normal(errors.shape[:2])
            errors -= innovations[..., None] * k
        largest = np.maximum(largest, np.hypot(*errors[..., PLACE]))
    return largest


def floor(imu: Imu | None = None, unforeseen_n_m: float = UNFORESEEN_N_M, rate_hz: int = 100) -> tuple[float, float]:
    """Median and 95 % quantile of the largest horizontal error in the blind part of the scenario `hover-blind`, m; with `imu` if given."""
    scenario = load_scenario("hover-blind")
    sensors = scenario.sensors if imu is None else SensorSpec(**imu._asdict())
    axis = model(scenario.world, sensors, load_vehicle(scenario.module[0].vehicle), unforeseen_n_m, 1.0 / rate_hz)
    errors = largest_errors(axis, with_tags(axis, sensors, scenario.task.settle_s), scenario.task.duration_s)
    return float(np.median(errors)), float(np.quantile(errors, 0.95))


def main() -> None:
    """Prints the floors; takes no arguments."""
    Parser(description=__doc__).parse_args()
    simulated, other = "the simulated IMU", "an ICM-20602"
    for name, imu, rate_hz in ((simulated, None, 100), (f"{simulated} at 400 Hz", None, 400), (other, ICM_20602, 100)):
        for unforeseen_n_m in (UNFORESEEN_N_M, 1e-4, EXACT_N_M):
            median, most = floor(imu, unforeseen_n_m, rate_hz)
            told = f"{name}, moments known to {1e3 * unforeseen_n_m:g} mN m"
            print(f"{told}: no filter keeps better than {1e3 * median:.1f} mm (median) and {1e3 * most:.1f} mm (95 %)")


if __name__ == "__main__":
    run_tool(main)
