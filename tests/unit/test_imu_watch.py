"""An IMU that repeats itself is noticed, and is not measured with; the body flies on without."""

import numpy as np
import pytest

from firmware_py.core.imu_watch import REPEATS, ImuWatch
from firmware_py.core.measurements import Measurements
from firmware_py.core.rotations import difference
from firmware_py.core.types import Action, ModuleInputs, Request
from firmware_py.description.vehicle import load_vehicle
from firmware_py.prepare.assembly import assemble
from tests.unit.test_pipeline import Tank, single

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
PAIR = assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [load_vehicle("modcube")] * 2)


def sample(value: float, accel: float = 9.8) -> ModuleInputs:
    return ModuleInputs(gyro=np.full(3, value), accel=np.full(3, accel))


def test_sample_that_is_repeated_too_often_is_not_believed_until_it_changes() -> None:
    watch = ImuWatch([0])
    assert [watch.step([sample(0.1)]) for _ in range(REPEATS + 3)] == [True] * REPEATS + [False] * 3
    assert watch.frozen == [True]
    assert watch.step([sample(0.2)])
    assert watch.frozen == [False]


@pytest.mark.parametrize("change", ["gyro", "accel"])
def test_one_number_that_changes_is_a_sensor_that_lives(change: str) -> None:
    watch = ImuWatch([0])
    for n in range(5 * REPEATS):
        module = sample(0.1)
        getattr(module, change)[2] += 1e-9 * (n % 2)
        assert watch.step([module])


def test_lost_frames_neither_freeze_nor_thaw() -> None:
    watch = ImuWatch([0])
    for _ in range(5 * REPEATS):
        assert not watch.step([ModuleInputs()])
    assert watch.frozen == [False]
    for n in range(2 * REPEATS + 1):
        watch.step([sample(0.1) if n % 2 == 0 else ModuleInputs()])
    assert watch.frozen == [True]
    assert not watch.step([ModuleInputs(gyro=np.ones(3))])
    assert watch.frozen == [True]


def test_each_module_is_watched_by_itself() -> None:
    watch = ImuWatch([2, 0])
    for n in range(REPEATS + 1):
        assert watch.step([sample(float(n)), sample(9.0), sample(0.1)])
    assert watch.frozen == [True, False]


def test_body_that_takes_over_knows_which_imu_is_frozen() -> None:
    whole = ImuWatch([0, 1])
    for n in range(REPEATS + 1):
        whole.step([sample(0.1 * n), sample(0.1)])
    parts = ImuWatch([0]), ImuWatch([1])
    for part in parts:
        part.take_over([whole])
    assert [part.step([sample(7.0), sample(0.1)]) for part in parts] == [True, False]
    again = ImuWatch([1, 0])
    again.take_over(parts)
    assert again.frozen == [True, False]


def test_frozen_imu_is_left_out_of_the_mean() -> None:
    """The other stands 0.105 m off the centre of mass, and feels 0.21 m/s^2 of a turn at 1 rad/s about each axis."""
    modules = [sample(1.0, 4.0), sample(3.0, 8.0)]
    fuse = Measurements(PAIR).fuse
    both, first, none = (fuse(modules, LEVEL, frozen) for frozen in ([False, False], [False, True], [True, True]))
    assert both.gyro is not None and both.accel is not None and first.gyro is not None and first.accel is not None
    np.testing.assert_allclose([both.gyro[0], both.accel[0], first.gyro[0], first.accel[0]], [2.0, 6.0, 1.0, 4.0 - 0.21])
    assert none.gyro is None and none.accel is None


@pytest.mark.slow
def test_robot_whose_imu_freezes_holds_its_place_and_says_so() -> None:
    tank = Tank([single()])
    tank.run(0.5)
    tank.run(2.0, Request(Action.ARM))
    here, hear = tank.states[0].copy(), tank._hear
    frozen = hear(len(tank.outputs))[0]

    def repeat(tick: int) -> list[ModuleInputs]:
        modules = hear(tick)
        modules[0].gyro, modules[0].accel = frozen.gyro, frozen.accel
        return modules

    tank._hear = repeat  # type: ignore[method-assign]
    tank.run(6.0)
    assert any(event.text == "fail-safe on: no IMU for 0.5 s" for o in tank.outputs for event in o.events)
    np.testing.assert_allclose(tank.states[0][:3], here[:3], atol=5e-3)
    assert np.linalg.norm(difference(tank.states[0][3:7].copy(), here[3:7].copy())) < 0.02
