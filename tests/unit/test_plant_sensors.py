"""IMU and depth sensor of the plant: what they read at rest, and the statistics of their errors."""

import numpy as np
import pytest

from firmware_py.core import rotations
from firmware_py.description.vehicle_file import load_vehicle
from hil.plant.sensors import Sensors
from hil.plant.spec import CALM, IDEAL, SensorSpec, Tank, WorldSpec
from hil.plant.world import Start, Truth, World

PERIOD_NS = 10_000_000
WORLD = WorldSpec(**CALM)


def at_rest(q: np.ndarray | None = None) -> Truth:
    start = Start(np.array([0.0, 0.0, 0.4]), np.array([1.0, 0.0, 0.0, 0.0]) if q is None else q)
    return World(WORLD, Tank(), [load_vehicle("modcube")], [start], 0, PERIOD_NS).truth(0)


def sensors(seed: int = 0, module: int = 0, **changes: float) -> Sensors:
    return Sensors(SensorSpec(**{**IDEAL, **changes}), WORLD, seed, module)


def test_level_module_at_rest_feels_gravity_upwards() -> None:
    np.testing.assert_allclose(sensors().accel(at_rest()), [0.0, 0.0, -9.81], atol=1e-12)


def test_module_on_its_side_feels_gravity_along_y() -> None:
    # rolled 90 deg to the right: its y axis points down, so the force that holds it points to -y
    body = at_rest(rotations.from_euler(np.pi / 2, 0.0, 0.0))
    felt = sensors().accel(body)
    assert felt[1] == pytest.approx(-9.81, abs=0.02) and abs(felt[2]) < 0.02


def test_pressure_grows_with_depth() -> None:
    assert sensors().pressure_pa(at_rest()) == pytest.approx(101325.0 + 998.2 * 9.81 * 0.4)


def test_white_noise_has_the_wanted_sigma() -> None:
    truth, noisy = at_rest(), sensors(gyro_sigma=0.002, accel_sigma=0.03, depth_sigma_m=0.002)
    gyro = np.array([noisy.gyro(truth) for _ in range(5000)])
    accel = np.array([noisy.accel(truth) for _ in range(5000)])
    pressure = np.array([noisy.pressure_pa(truth) for _ in range(5000)])
    np.testing.assert_allclose(gyro.std(axis=0), 0.002, rtol=0.05)
    np.testing.assert_allclose(accel.std(axis=0), 0.03, rtol=0.05)
    assert pressure.std() / (998.2 * 9.81) == pytest.approx(0.002, rel=0.05)
    assert np.abs(gyro.mean(axis=0)).max() < 2e-4
    assert np.abs(np.corrcoef(gyro[1:, 0], gyro[:-1, 0])[0, 1]) < 0.05


def test_bias_differs_by_seed_and_by_module() -> None:
    truth = at_rest()
    readings = [sensors(seed, module, gyro_bias=0.005).gyro(truth) for seed in range(20) for module in range(20)]
    assert len({tuple(r) for r in readings}) == 400
    assert np.std(readings) == pytest.approx(0.005, rel=0.1)


def test_bias_walks_with_the_root_of_time() -> None:
    ends, truth = [], at_rest()
    for seed in range(300):
        walking = sensors(seed, accel_walk=0.01)
        for second in range(1, 5):
            reading = walking.accel(truth._replace(time_ns=second * 1_000_000_000))
        ends.append(reading - [0.0, 0.0, -9.81])
    assert np.std(ends) == pytest.approx(0.01 * 2.0, rel=0.1)


def test_same_seed_gives_the_same_readings() -> None:
    def readings() -> list[float]:
        imu, truth = Sensors(SensorSpec(), WORLD, 9, 2), at_rest()
        return [*imu.gyro(truth), *imu.accel(truth), imu.pressure_pa(truth)]

    assert readings() == readings()
