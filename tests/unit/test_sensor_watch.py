"""Samples of a frozen IMU and readings that leap are detected and not used; the body flies on without them."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr

from firmware_py.bus.codec import Codec
from firmware_py.core.measurements import Measurements
from firmware_py.core.rotations import difference
from firmware_py.core.sensor_watch import AXIS_REPEATS, IMU_REPEATS, LEAPS, SENSOR_REPEATS, SensorWatch
from firmware_py.core.types import Action, Mode, ModuleInputs, Request
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble
from hil.plant.spec import HALF_A_COUNT
from tests.unit.tanks import PERIOD, Tank, flies_with_noise, single

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
PAIR = assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [load_vehicle("modcube")] * 2)


def sample(value: float, accel: float = 9.8) -> ModuleInputs:
    return ModuleInputs(gyro=np.full(3, value), accel=np.full(3, accel))


def hears(watch: SensorWatch, *modules: ModuleInputs) -> bool:
    """Whether any IMU is believed in a tick with these inputs."""
    return any(module.gyro is not None and module.accel is not None for module in watch.step(modules))


def test_sample_that_is_repeated_ten_times_is_not_believed_until_it_changes() -> None:
    watch = SensorWatch([0])
    assert [hears(watch, sample(0.1)) for _ in range(13)] == [True] * 10 + [False] * 3
    assert hears(watch, sample(0.2))


@pytest.mark.parametrize(("dead", "live"), [("gyro", "accel"), ("accel", "gyro")])
def test_gyro_that_is_stuck_beside_a_live_accelerometer_is_not_believed_nor_the_reverse(dead: str, live: str) -> None:
    watch, rng = SensorWatch([0]), np.random.default_rng(0)
    heard = []
    for _ in range(SENSOR_REPEATS + 3):
        module = ModuleInputs(**{dead: np.zeros(3), live: 0.03 * rng.normal(size=3)})  # type: ignore[arg-type]
        (left,) = watch.step([module])
        assert (left.gyro is None) == (left.accel is None), "what is left of an IMU is not used alone"
        heard.append(left.gyro is not None)
    assert heard == [True] * SENSOR_REPEATS + [False] * 3
    assert hears(watch, ModuleInputs(gyro=rng.normal(size=3) * 0.1, accel=rng.normal(size=3) * 0.1))


@pytest.mark.parametrize("axis", [[0], [1], [2], [0, 1], [0, 2], [1, 2]], ids=str)
@pytest.mark.parametrize("name", ["gyro", "accel"])
def test_single_axis_or_two_that_are_stuck_are_found_too_though_later(name: str, axis: list[int]) -> None:
    watch, rng = SensorWatch([0]), np.random.default_rng(0)
    heard = []
    for _ in range(AXIS_REPEATS + 3):
        module = ModuleInputs(gyro=0.002 * rng.normal(size=3), accel=0.03 * rng.normal(size=3))
        getattr(module, name)[axis] = 0.1
        heard.append(hears(watch, module))
    assert heard == [True] * AXIS_REPEATS + [False] * 3


def test_three_numbers_of_which_each_changes_now_and_then_are_a_sensor_that_lives() -> None:
    watch = SensorWatch([0])
    for n in range(5 * AXIS_REPEATS):
        module = sample(0.1)
        assert module.gyro is not None and module.accel is not None
        for axis in range(3):
            still = (n + 5 * axis) // 15 % 2
            module.gyro[axis] += 1e-9 * still
            module.accel[axis] += 1e-9 * ((n // 9 + axis) % 2)
        assert hears(watch, module)


def repeats_itself(counts: np.ndarray, repeats: int) -> float:
    """Share of samples with which a run of `repeats` repetitions is complete; counts: (n, k) readings in counts, all k must repeat."""
    same = np.cumsum(np.r_[0, (counts[1:] == counts[:-1]).all(axis=1)])
    return float(np.mean(same[repeats:] - same[:-repeats] == repeats))


def test_stillest_healthy_imu_is_taken_for_stuck_less_than_once_in_a_thousand_hours() -> None:
    """The worst case: ideal sensors (half a count of noise) of a robot at rest, whose mean is the middle of a count on every axis."""
    gyro, accel = (Codec.load().message(name).field_details[0].factor for name in ("GYRO", "ACCEL"))
    assert HALF_A_COUNT["gyro_sigma"] == 0.5 * gyro and HALF_A_COUNT["accel_sigma"] == 0.5 * accel
    edges = (np.arange(-7, 8) - 0.5) / 0.5
    share = np.diff(ndtr(edges))
    one = [float(np.sum(share ** (n + 1))) for n in range(AXIS_REPEATS + 1)]  # that n + 1 samples are equal
    measured = np.rint(0.5 * np.random.default_rng(0).standard_normal((400_000, 3)))
    for numbers, repeats in ((1, 10), (3, 4)):
        np.testing.assert_allclose(repeats_itself(measured[:, :numbers], repeats), one[repeats] ** numbers, rtol=0.1)
    samples = 1000 * 3600 * 400
    alarms = samples * np.array([one[IMU_REPEATS] ** 6, 2 * one[SENSOR_REPEATS] ** 3, 6 * one[AXIS_REPEATS]])
    assert alarms.sum() < 0.2, "of one module; less than 1 in a fleet of five"


@pytest.mark.parametrize("broken", ["gyro", "accel"])
def test_imu_that_leaps_with_every_sample_is_not_heard(broken: str) -> None:
    """Otherwise the fail-safe `imu_lost` would not act although no sample is believed."""
    watch, rng = SensorWatch([0]), np.random.default_rng(0)
    for n in range(100):
        module = sample(0.1 + 1e-3 * (n % 2))
        setattr(module, broken, rng.uniform(-16.0, 16.0, 3))
        is_heard = hears(watch, module)
        assert n < IMU_REPEATS or not is_heard


def test_pressure_that_is_repeated_for_two_seconds_is_not_believed_until_it_changes() -> None:
    watch = SensorWatch([0])

    rng = np.random.default_rng(0)

    def is_heard(pressure_pa: float) -> bool:
        module = ModuleInputs(gyro=0.1 * rng.normal(size=3), accel=0.1 * rng.normal(size=3), pressure_pa=pressure_pa)
        assert hears(watch, module), "the live IMU beside it is"
        return watch.pressure_heard

    assert [is_heard(1.1e5) for _ in range(103)] == [True] * 100 + [False] * 3, "at 50 Hz"
    joined = SensorWatch([0])
    joined.take_over([watch])
    joined.step([ModuleInputs(pressure_pa=1.1e5)])
    assert not joined.pressure_heard
    assert is_heard(1.1e5 + 1.0)


@pytest.mark.slow
def test_blind_robot_whose_depth_sensor_freezes_comes_up_instead_of_drifting_at_a_depth_it_believes_in() -> None:
    tank, is_frozen = Tank([single()]), False

    def freeze(module: ModuleInputs) -> None:
        if is_frozen:
            module.pressure_pa, module.tags = 1.1e5, []

    flies_with_noise(tank, freeze, Mode.ALT_HOLD)
    is_frozen = True
    assert tank.run(10.0).records[0].mode == Mode.SURFACE


def test_lost_frames_neither_freeze_nor_thaw() -> None:
    watch = SensorWatch([0])
    for _ in range(5 * IMU_REPEATS):
        assert not hears(watch, ModuleInputs())
    assert hears(watch, sample(0.1))
    for n in range(2 * IMU_REPEATS + 1):
        is_heard = hears(watch, sample(0.1) if n % 2 == 0 else ModuleInputs())
    assert not is_heard
    assert not hears(watch, ModuleInputs())
    assert not hears(watch, sample(0.1))
    assert not hears(watch, ModuleInputs(gyro=np.ones(3)))


def test_each_module_is_watched_by_itself() -> None:
    watch = SensorWatch([2, 0])
    for n in range(IMU_REPEATS + 1):
        assert hears(watch, sample(0.1 * n), sample(9.0), sample(0.1))
    assert [module.gyro is None for module in watch.step([sample(2.0), sample(9.0), sample(0.1)])] == [False, False, True]


def test_body_that_takes_over_knows_which_imu_is_frozen_and_what_was_believed_of_each() -> None:
    whole = SensorWatch([0, 1])
    for n in range(IMU_REPEATS + 1):
        whole.step([sample(0.1 * n), sample(0.1)])
    parts = SensorWatch([0]), SensorWatch([1])
    for part in parts:
        part.take_over([whole])
    assert [part.step([sample(1.1), sample(0.1)])[k].gyro is not None for k, part in enumerate(parts)] == [True, False]
    again = SensorWatch([1, 0])
    again.take_over(parts)
    leapt, frozen = again.step([sample(9.0), sample(0.1)])
    assert leapt.gyro is None and leapt.accel is not None and frozen.accel is None


def test_frozen_imu_is_left_out_of_the_mean() -> None:
    """The other IMU is 0.105 m off the centre of mass: a rate of 1 rad/s about each axis accelerates it by 0.21 m/s^2."""
    watch, fuse = SensorWatch(PAIR.modules), Measurements(PAIR, PERIOD).fuse
    both = fuse(watch.step([sample(1.0, 4.0), sample(3.0, 8.0)]), LEVEL)
    for n in range(IMU_REPEATS + 1):
        first = fuse(watch.step([sample(1.0, 4.0 + 1e-9 * (n % 2)), sample(3.0, 8.0)]), LEVEL)
    for _ in range(IMU_REPEATS + 1):
        none = fuse(watch.step([sample(1.0, 4.0), sample(3.0, 8.0)]), LEVEL)
    assert both.gyro is not None and both.accel is not None and first.gyro is not None and first.accel is not None
    np.testing.assert_allclose([both.gyro[0], both.accel[0], first.gyro[0], first.accel[0]], [2.0, 6.0, 1.0, 4.0 - 0.21])
    assert none.gyro is None and none.accel is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gyro", "accel"])
def test_robot_whose_gyro_or_accelerometer_alone_goes_dead_keeps_upright(name: str) -> None:
    """With a gyro that reads zeros it tumbled at 6 rad/s from the third second on."""
    tank, is_dead, fastest = Tank([single()]), False, 0.0

    def kill(module: ModuleInputs) -> None:
        if is_dead:
            setattr(module, name, np.zeros(3))

    flies_with_noise(tank, kill, Mode.ALT_HOLD)
    is_dead = True
    for _ in range(600):
        tank.run(0.01)
        fastest = max(fastest, float(np.abs(tank.states[0][10:13]).max()))
    assert fastest < 0.5
    assert tank.outputs[-1].records[0].mode == Mode.POSHOLD, "as `imu_lost` wants it"


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


# ---------------------------------------------------------------- readings that leap


def readings(*values: float | None, name: str, axis: int = 1) -> list[bool]:
    """Which of the readings are believed; given in multiples of the leap threshold, None where none came."""
    watch, heard = SensorWatch([0]), []
    unit: Any = 1.0 if name == "pressure_pa" else np.eye(3)[axis]
    for value in values:
        module = ModuleInputs()
        if value is not None:
            setattr(module, name, value * LEAPS[name] * unit)
        heard.append(getattr(watch.step([module])[0], name) is not None)
    return heard


@pytest.mark.parametrize("name", ["gyro", "accel"])
@pytest.mark.parametrize("axis", range(3))
def test_leap_about_any_axis_is_found(name: str, axis: int) -> None:
    assert readings(0.0, 5.0, 0.0, name=name, axis=axis) == [True, False, True]


@pytest.mark.parametrize("name", LEAPS)
def test_reading_that_leaps_is_left_out_and_one_that_stays_there_is_believed(name: str) -> None:
    assert readings(0.0, None, 5.0, None, 5.2, name=name) == [True, False, False, False, True], "with ticks between without a frame"
    assert readings(0.0, 0.0, 5.0, 0.0, 0.9, 0.0, name=name) == [True, True, False, True, True, True]
    assert readings(0.0, 5.0, 5.2, 5.4, name=name) == [True, False, True, True]
    assert readings(0.0, 5.0, -5.0, 0.0, name=name) == [True, False, False, True]
    assert readings(0.0, math.nan, 0.0, name=name) == [True, False, True]
    assert readings(5.0, 0.0, 0.0, name=name) == [True, False, True], "the first may be the wrong one"


@pytest.mark.parametrize(("name", "moved", "leapt"), [("gyro", 0.7, 1.1), ("accel", 1.2, 2.1), ("pressure_pa", 1900.0, 2100.0)])
def test_leap_is_more_than_thrusters_make_in_a_tick_of_20_ms_and_twenty_centimetres_of_water(name: str, moved: float, leapt: float) -> None:
    """Full moment from zero gives 0.7 rad/s, a reversed force 1.2 m/s^2."""
    for step, believed in ((moved, True), (leapt, False)):
        assert readings(0.0, step / LEAPS[name], name=name) == [True, believed]


def test_only_the_reading_that_leaps_is_left_out() -> None:
    watch = SensorWatch([0])
    watch.step([ModuleInputs(np.zeros(3), np.zeros(3), 1e5, heard=True)])
    (left,) = watch.step([ModuleInputs(np.zeros(3), np.array([0.0, 0.0, 50.0]), 1e5, heard=True)])
    assert left.accel is None and left.gyro is not None and left.pressure_pa == 1e5 and left.heard


@pytest.mark.slow
@pytest.mark.parametrize(("name", "off"), [("gyro", 35.0), ("accel", 50.0), ("pressure_pa", 1e5)])
def test_one_wrong_reading_does_not_move_the_robot(name: str, off: float) -> None:
    """Without the sensor watch it moves 50 to 200 mm."""
    tank = Tank([single()])
    tank.run(0.5)
    tank.run(2.0, Request(Action.ARM))
    here, hear, wrong = tank.states[0].copy(), tank._hear, 0

    def glitch(tick: int) -> list[ModuleInputs]:
        nonlocal wrong
        modules = hear(tick)
        if not wrong and getattr(modules[0], name) is not None:
            wrong += 1
            setattr(modules[0], name, getattr(modules[0], name) + off)
        return modules

    tank._hear = glitch  # type: ignore[method-assign]
    farthest = 0.0
    for _ in range(100):
        tank.run(0.01)
        farthest = max(farthest, float(np.linalg.norm(tank.states[0][:3] - here[:3])))
    assert wrong == 1 and farthest < 0.008
