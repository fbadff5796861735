"""What the best filter there can be would keep of a hovering robot's place without tags: the floor under `make accept ONLY=blind`.

A Kalman filter of one horizontal axis that is told every figure of the simulated world: the gusts' spectrum, the pull of the water, the
noise of IMU and tags. Only what is drawn anew in every sample is unknown, and of that no filter knows more (Anderson and Moore 1979,
chapter 5). The robot's own filter is told less, and its thrusters do not quite what they are told.

What tilts the robot is the one figure left open: the gyro measures the turning, and a filter that also knew the moments would know the
tilt better. So the floor is told for several errors of the moment that a filter believes the thrusters to make. No moment tells a tilt from
water that accelerates, though: the water's pressure gradient acts where the buoyancy does, so that the robot hangs along the gravity that
it feels, and the accelerometer feels the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from command_line import Parser, run_tool

import numpy as np
from scipy.linalg import expm

from firmware_py.description.vehicle import Vehicle, load_vehicle
from hil.plant.spec import SensorSpec, WorldSpec
from hil.safety import ICM_20602, Imu
from hil.scenario import load_scenario

PLACE, SPEED, WATER, TENDS, TILT, RATE, MOMENT, STEADY, GYRO_BIAS, ACCEL_BIAS, PUSH = range(11)
STATES = 11
"""Of one axis: m, m/s, m/s of the water and of where its gust tends, rad, rad/s, N m that come and go and that stay, rad/s, m/s^2, and the
steady push in m/s^2."""
PERIOD_S = 0.01
HOVERS = 4000
PUSHED, TWISTED = 0.1, 0.1
"""Sigma of the steady push before the first tag, m/s^2, and of the steady moment, N m: more than buoyancy, current and trim give."""
TILTED, TURNED, MOVED = 0.05, 0.05, 0.02
"""The same of tilt, rad, rate, rad/s, and place, m."""
MOMENT_S = 1.0
"""Time over which a moment that nobody foresaw comes and goes: that of the gusts which the thrusters work against (`gust_smoothing_s`)."""
UNFORESEEN_N_M = 1e-3
"""Sigma of it: thrusters of 5 % more or less that work against gusts of 0.01 m/s^2 at 0.1 m. By ten times that nothing changes any more."""
EXACT_N_M = 1e-5
"""The same of a filter that knows each thruster's force to a ten-thousandth of a newton."""


class Model(NamedTuple):
    """Linear and Gaussian, over one tick."""

    step: np.ndarray
    """(11, 11) F."""
    noise: np.ndarray
    """(11,) variances that a tick adds: the diagonal of Q."""
    inertial: tuple[tuple[np.ndarray, float], tuple[np.ndarray, float]]
    """Of accelerometer and gyro: (11,) what it feels of the state, and the variance of its noise."""
    start: np.ndarray
    """(11,) variances at the beginning."""


def model(world: WorldSpec, sensors: SensorSpec, vehicle: Vehicle, unforeseen_n_m: float = UNFORESEEN_N_M) -> Model:
    """A robot at rest over ground in the world's mean current, which water that accelerates takes along (Froude-Krylov and added mass).

    Args:
        unforeseen_n_m: sigma of the moment that comes and goes and that the filter is not told.
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
    rates[WATER, [WATER, TENDS]] = -1.0 / t2, 1.0 / t2
    rates[SPEED] = rates[WATER]
    rates[SPEED, [SPEED, WATER, PUSH]] += -pull, pull, 1.0
    rates[TENDS, TENDS] = -1.0 / t1
    rates[TILT, RATE] = 1.0
    rates[RATE, [TILT, MOMENT, STEADY]] = np.array([-upright, 1.0, 1.0]) / inertia
    rates[RATE] += rates[RATE, TILT] / world.gravity * rates[WATER]
    rates[MOMENT, MOMENT] = -1.0 / MOMENT_S
    noise = np.zeros(STATES)
    noise[TENDS] = tends**2 * (1.0 - math.exp(-2.0 * PERIOD_S / t1))
    noise[MOMENT] = unforeseen_n_m**2 * (1.0 - math.exp(-2.0 * PERIOD_S / MOMENT_S))
    noise[GYRO_BIAS], noise[ACCEL_BIAS] = sensors.gyro_walk**2 * PERIOD_S, sensors.accel_walk**2 * PERIOD_S
    felt, turning = rates[SPEED].copy(), np.zeros(STATES)
    felt[TILT], felt[ACCEL_BIAS] = world.gravity, 1.0
    turning[RATE] = turning[GYRO_BIAS] = 1.0
    water, biases = [world.current_m_s, world.gust_m_s, tends], [sensors.gyro_bias, sensors.accel_bias]
    start = np.array([MOVED, *water, TILTED, TURNED, unforeseen_n_m, TWISTED, *biases, PUSHED]) ** 2
    return Model(expm(PERIOD_S * rates), noise, ((felt, sensors.accel_sigma**2), (turning, sensors.gyro_sigma**2)), start)


def gain(covariance: np.ndarray, row: np.ndarray, variance: float) -> tuple[np.ndarray, np.ndarray]:
    """Kalman's gain (11,) of one measurement, and the covariance (11, 11) after it."""
    seen = covariance @ row
    k = seen / (row @ seen + variance)
    return k, covariance - np.outer(k, seen)


def with_tags(axis: Model, sensors: SensorSpec, seconds: float) -> np.ndarray:
    """(11, 11) covariance after so long with every picture."""
    covariance = np.diag(axis.start)
    tags = [(PLACE, sensors.tag_sigma_m**2), (TILT, math.radians(sensors.tag_sigma_deg) ** 2)]
    pictures = 0
    for tick in range(round(seconds / PERIOD_S)):
        covariance = axis.step @ covariance @ axis.step.T + np.diag(axis.noise)
        for row, variance in axis.inertial:
            covariance = gain(covariance, row, variance)[1]
        if tick * PERIOD_S * sensors.tag_rate_hz >= pictures:
            pictures += 1
            for state, variance in tags:
                covariance = gain(covariance, np.eye(STATES)[state], variance)[1]
    return covariance


def without_tags(axis: Model, covariance: np.ndarray, seconds: float) -> tuple[list[list[np.ndarray]], np.ndarray]:
    """Kalman's gains, (11,) each, of every tick's accelerometer and gyro, and the covariance (11, 11) after so long with these alone."""
    gains: list[list[np.ndarray]] = []
    for _ in range(round(seconds / PERIOD_S)):
        covariance = axis.step @ covariance @ axis.step.T + np.diag(axis.noise)
        gains.append([])
        for row, variance in axis.inertial:
            k, covariance = gain(covariance, row, variance)
            gains[-1].append(k)
    return gains, covariance


def largest_errors(axis: Model, covariance: np.ndarray, seconds: float) -> np.ndarray:
    """(HOVERS,) the largest horizontal error of each in so long without tags, m: what the filter errs, drawn by its own statistics.

    Args:
        covariance: (11, 11) when the last tag came, of each of both axes.
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


def floor(imu: Imu | None = None, unforeseen_n_m: float = UNFORESEEN_N_M) -> tuple[float, float]:
    """Median and 95 % of the largest horizontal error in the blind part of the scenario `hover-blind`, m; with another IMU where given."""
    scenario = load_scenario("hover-blind")
    sensors = scenario.sensors if imu is None else SensorSpec(**imu._asdict())
    axis = model(scenario.world, sensors, load_vehicle(scenario.module[0].vehicle), unforeseen_n_m)
    errors = largest_errors(axis, with_tags(axis, sensors, scenario.task.settle_s), scenario.task.duration_s)
    return float(np.median(errors)), float(np.quantile(errors, 0.95))


def main() -> None:
    """Prints the floors; takes no arguments."""
    Parser(description=__doc__).parse_args()
    for name, imu in (("the simulated IMU", None), ("an ICM-20602", ICM_20602)):
        for unforeseen_n_m in (UNFORESEEN_N_M, 1e-4, EXACT_N_M):
            median, most = floor(imu, unforeseen_n_m)
            told = f"{name}, moments known to {1e3 * unforeseen_n_m:g} mN m"
            print(f"{told}: no filter keeps better than {1e3 * median:.1f} mm (median) and {1e3 * most:.1f} mm (95 %)")


if __name__ == "__main__":
    run_tool(main)
