"""What the best filter there can be would keep of a hovering robot's place without tags: the floor under `make accept ONLY=blind`.

A Kalman filter of one horizontal axis that is told every figure of the simulated world: the gusts' spectrum, the pull of the water, the
noise of IMU and tags. Only what is drawn anew in every sample is unknown, and of that no filter knows more (Anderson and Moore 1979,
chapter 5). The robot's own filter is told less, and its thrusters do not quite what they are told.
"""

from __future__ import annotations

import argparse
import math
from typing import NamedTuple

import numpy as np
from command_line import Parser, run_tool
from scipy.linalg import expm

from firmware_py.description.vehicle import Vehicle, load_vehicle
from hil.plant.spec import SensorSpec, WorldSpec
from hil.safety import ICM_20602, Imu
from hil.scenario import load_scenario

PLACE, SPEED, WATER, TENDS, TILT, GYRO_BIAS, ACCEL_BIAS, PUSH = range(8)
"""State of one axis: m, m/s, m/s of the water and of where its gust tends, rad, rad/s, m/s^2, and the steady push in m/s^2."""
PERIOD_S = 0.01
HOVERS = 4000
PUSHED = 0.1
"""Sigma of the steady push before the first tag, m/s^2: more than buoyancy and current give."""
TILTED, MOVED = 0.05, 0.02
"""The same of tilt, rad, and place, m."""


class Model(NamedTuple):
    """Linear and Gaussian, over one tick."""

    step: np.ndarray
    """(8, 8) F."""
    noise: np.ndarray
    """(8,) variances that a tick adds: the diagonal of Q."""
    felt: np.ndarray
    """(8,) what the accelerometer feels of the state."""
    start: np.ndarray
    """(8,) variances at the beginning."""


def model(world: WorldSpec, sensors: SensorSpec, vehicle: Vehicle) -> Model:
    """A robot at rest over ground in the world's mean current, which water that accelerates takes along (Froude-Krylov and added mass)."""
    t1, t2 = world.gust_time_s, world.gust_smoothing_s
    tends = world.gust_m_s * math.sqrt((t1 + t2) / t1)
    moved_kg = vehicle.inertial.wet_kg + vehicle.inertial.added[0]
    area = vehicle.hull.size_m[1] * vehicle.hull.size_m[2]
    pull = world.density * vehicle.drag.cd_face * area * world.current_m_s / moved_kg
    rates = np.zeros((8, 8))
    rates[PLACE, SPEED] = 1.0
    rates[WATER, [WATER, TENDS]] = -1.0 / t2, 1.0 / t2
    rates[SPEED] = rates[WATER]
    rates[SPEED, [SPEED, WATER, PUSH]] += -pull, pull, 1.0
    rates[TENDS, TENDS] = -1.0 / t1
    rates[TILT, GYRO_BIAS] = 1.0
    noise = np.zeros(8)
    noise[TENDS] = tends**2 * (1.0 - math.exp(-2.0 * PERIOD_S / t1))
    noise[TILT] = (sensors.gyro_sigma * PERIOD_S) ** 2
    noise[GYRO_BIAS], noise[ACCEL_BIAS] = sensors.gyro_walk**2 * PERIOD_S, sensors.accel_walk**2 * PERIOD_S
    felt = rates[SPEED].copy()
    felt[TILT], felt[ACCEL_BIAS] = world.gravity, 1.0
    start = np.array([MOVED, world.current_m_s, world.gust_m_s, tends, TILTED, sensors.gyro_bias, sensors.accel_bias, PUSHED]) ** 2
    return Model(expm(PERIOD_S * rates), noise, felt, start)


def gain(covariance: np.ndarray, row: np.ndarray, variance: float) -> tuple[np.ndarray, np.ndarray]:
    """Kalman's gain (8,) of one measurement, and the covariance (8, 8) after it."""
    seen = covariance @ row
    k = seen / (row @ seen + variance)
    return k, covariance - np.outer(k, seen)


def with_tags(axis: Model, sensors: SensorSpec, seconds: float) -> np.ndarray:
    """(8, 8) covariance after so long with every picture."""
    covariance = np.diag(axis.start)
    tags = [(PLACE, sensors.tag_sigma_m**2), (TILT, math.radians(sensors.tag_sigma_deg) ** 2)]
    pictures = 0
    for tick in range(round(seconds / PERIOD_S)):
        covariance = axis.step @ covariance @ axis.step.T + np.diag(axis.noise)
        covariance = gain(covariance, axis.felt, sensors.accel_sigma**2)[1]
        if tick * PERIOD_S * sensors.tag_rate_hz >= pictures:
            pictures += 1
            for state, variance in tags:
                covariance = gain(covariance, np.eye(8)[state], variance)[1]
    return covariance


def without_tags(axis: Model, covariance: np.ndarray, accel_sigma: float, seconds: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Kalman's gain (8,) of each tick, and the covariance (8, 8) after so long with the accelerometer alone."""
    gains = []
    for _ in range(round(seconds / PERIOD_S)):
        covariance = axis.step @ covariance @ axis.step.T + np.diag(axis.noise)
        k, covariance = gain(covariance, axis.felt, accel_sigma**2)
        gains.append(k)
    return gains, covariance


def largest_errors(
    axis: Model, covariance: np.ndarray, accel_sigma: float, seconds: float, hovers: int = HOVERS, seed: int = 0
) -> np.ndarray:
    """(hovers,) the largest horizontal error of each in so long without tags, m: what the filter errs, drawn by its own statistics.

    Args:
        covariance: (8, 8) when the last tag came, of each of both axes.
    """
    rng = np.random.default_rng(seed)
    errors = rng.multivariate_normal(np.zeros(8), covariance, (2, hovers), method="eigh")
    spread, largest = np.sqrt(axis.noise), np.zeros(hovers)
    for k in without_tags(axis, covariance, accel_sigma, seconds)[0]:
        errors = errors @ axis.step.T + spread * rng.standard_normal(errors.shape)
        innovations = errors @ axis.felt + accel_sigma * rng.standard_normal(errors.shape[:2])
        errors -= innovations[..., None] * k
        largest = np.maximum(largest, np.hypot(*errors[..., PLACE]))
    return largest


def floor(imu: Imu | None = None) -> tuple[float, float]:
    """Median and 95 % of the largest horizontal error in the blind part of the scenario `hover-blind`, m; with another IMU where given."""
    scenario = load_scenario("hover-blind")
    sensors = scenario.sensors if imu is None else SensorSpec(**imu._asdict())
    axis = model(scenario.world, sensors, load_vehicle(scenario.module[0].vehicle))
    covariance = with_tags(axis, sensors, scenario.task.settle_s)
    errors = largest_errors(axis, covariance, sensors.accel_sigma, scenario.task.duration_s)
    return float(np.median(errors)), float(np.quantile(errors, 0.95))


def main() -> None:
    """Prints both floors; takes no arguments."""
    Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for name, imu in (("the simulated IMU", None), ("an ICM-20602", ICM_20602)):
        median, most = floor(imu)
        print(f"{name}: no filter keeps better than {1e3 * median:.1f} mm (median) and {1e3 * most:.1f} mm (95 %)")


if __name__ == "__main__":
    run_tool(main)
