"""Position error of the best possible filter without tags (tools/blind_floor.py), against closed forms of its two limiting cases."""

from __future__ import annotations

import math

import numpy as np
import pytest
from blind_floor import GUST_TARGET, PERIOD_S, PLACE, RATE, STATES, TILT, WATER, floor, model, without_tags

from firmware_py.description.vehicle_file import load_vehicle
from hil.plant.bodies import weigh
from hil.plant.spec import SensorSpec, WorldSpec
from hil.safety import ICM_20602

pytestmark = pytest.mark.slow

BLIND_S = 5.0
UNKNOWN_N_M = 0.1
"""Large enough that the moments are as good as unknown: only the gyro measures the rotation."""


def test_what_feels_nothing_drifts_as_the_water_does() -> None:
    world = WorldSpec(gust_smoothing_s=0.05, current_m_s=0.0)
    axis = model(world, SensorSpec(gyro_walk=0.0, accel_sigma=10.0, accel_walk=0.0), load_vehicle("modcube"), UNKNOWN_N_M)
    covariance = np.zeros((STATES, STATES))
    covariance[WATER : WATER + 2, WATER : WATER + 2] = (
        world.gust_m_s**2
    )  # at the last tag only the robot's own speed is known, not the gust
    _, after = without_tags(axis, covariance, BLIND_S)
    tau, t = world.gust_time_s, BLIND_S
    decay = math.exp(-t / tau)
    integral_of_change = 2.0 * tau**2 * (t / tau - 1.0 + decay) + t**2 - 2.0 * t * tau * (1.0 - decay)
    assert math.sqrt(after[PLACE, PLACE]) == pytest.approx(world.gust_m_s * math.sqrt(integral_of_change), rel=0.02)


def test_in_water_of_which_nothing_is_known_noise_is_integrated_twice() -> None:
    sensors = SensorSpec(gyro_walk=0.0, accel_walk=0.0)
    axis = model(WorldSpec(gust_m_s=1.0), sensors, load_vehicle("modcube"), UNKNOWN_N_M)
    _, after = without_tags(axis, np.zeros((STATES, STATES)), BLIND_S)
    accel = sensors.accel_sigma**2 * PERIOD_S * BLIND_S**3 / 3.0
    tilt = 9.81**2 * sensors.gyro_sigma**2 * PERIOD_S * BLIND_S**5 / 20.0
    assert math.sqrt(after[PLACE, PLACE]) == pytest.approx(math.sqrt(accel + tilt), rel=0.02)


def test_quieter_imu_keeps_the_place_better() -> None:
    (median, most), (quiet_median, quiet_most) = floor(), floor(ICM_20602)
    assert quiet_median < 0.7 * median < 0.7 * most
    assert quiet_most < 0.7 * most


def test_who_knows_the_moments_knows_the_tilt_and_keeps_the_place_better() -> None:
    (unknown, _), (known, _), (nearly, _) = floor(unforeseen_n_m=UNKNOWN_N_M), floor(unforeseen_n_m=0.0), floor()
    assert 0.7 * unknown < known < 0.8 * unknown
    assert nearly == pytest.approx(unknown, rel=0.05)


def test_water_that_accelerates_turns_the_robot_as_it_turns_the_plants() -> None:
    vehicle, world, rate = load_vehicle("modcube"), WorldSpec(), 0.01
    mass, inertia = vehicle.inertial.wet_kg, vehicle.inertial.inertia[1, 1] + vehicle.inertial.added[4]
    lift, up = mass * world.gravity, (0.0, 0.0, -vehicle.inertial.righting_arm_m)
    level, nowhere = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0)
    lifted_at, displaced_at = tuple(lift * c for c in up), tuple(mass * c for c in up)
    _, moment = weigh(lift, nowhere, lift, lifted_at, mass, displaced_at, level, (rate, 0.0, 0.0))
    step = model(world, SensorSpec(), vehicle, 0.0).step
    accelerating, leaning = rate * world.gust_smoothing_s * step[RATE, GUST_TARGET], -rate / world.gravity * step[RATE, TILT]
    assert accelerating == pytest.approx(moment[1] / inertia * PERIOD_S, rel=0.02)
    assert accelerating + leaning == pytest.approx(0.0, abs=0.02 * abs(leaning)), "it hangs along the gravity that it feels"
