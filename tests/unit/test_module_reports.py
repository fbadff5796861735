"""What each module of a body said: fail-safes name the modules behind them, and a new body inherits it."""

import dataclasses
from typing import Any

import pytest

from firmware_py.core.failsafes import TABLE, Failsafes, Watch
from firmware_py.core.module_reports import ModuleReports
from firmware_py.core.types import Mode, ModuleInputs
from firmware_py.description.parameters import Parameters
from tests.unit.monitor_bench import SINGLE, ZERO, MonitorBench, here

WELL = here(
    gyro=ZERO, accel=ZERO, pressure_pa=1e5, voltage_v=12.0, leak=False, cabin_temperature_c=30.0, cabin_pressure_pa=1e5, mcu_state=2
)  # fmt: skip
UNWELL: dict[str, dict[str, Any]] = {
    "leak": {"leak": True},
    "battery_critical": {"voltage_v": 8.0},
    "cabin_hot": {"cabin_temperature_c": 90.0},
    "cabin_pressure": {"cabin_pressure_pa": 5e4},
    "sensor_lost": {"pressure_pa": None},
    "module_silent": {"heard": False, "answered": False, "mcu_state": None},
    "module_late": {"answered": False},
    "cabin_unknown": {"leak": None, "cabin_temperature_c": None, "cabin_pressure_pa": None},
    "battery_unknown": {"voltage_v": None},
    "battery_low": {"voltage_v": 10.0},
}
"""By fail-safe: what a module says that causes it."""


@pytest.mark.parametrize("name", UNWELL)
def test_fail_safe_names_the_modules_behind_it_in_a_body_of_several(name: str) -> None:
    watch = Watch(next(row for row in TABLE if row.name == name), Parameters().failsafes)
    unwell, words = dataclasses.replace(WELL, **UNWELL[name]), []
    for one, three in ((WELL, unwell), (unwell, WELL), (unwell, unwell)):
        pair, alone = MonitorBench(), MonitorBench(SINGLE)
        for bench in (pair, alone):
            bench.step(WELL, WELL)
            for _ in range(300):
                health = bench.step(one, three)
            words.append(watch.words(health))
            assert watch.beyond(health) or bench is alone
    assert [text.partition(" (")[2] for text in words] == ["module 4)", "", "module 2)", "", "module 2, 4)", ""]


@pytest.mark.parametrize("name", UNWELL)
def test_fail_safe_that_spreads_to_another_module_is_told_again_once_and_only_after_its_delay(name: str) -> None:
    """Regression: water in a second cabin was told of nowhere, nor was the second battery, sensor or silent module."""
    bench, failsafes, unwell = MonitorBench(), Failsafes(Parameters().failsafes), dataclasses.replace(WELL, **UNWELL[name])
    told: list[tuple[str, bool]] = []

    def run(one: ModuleInputs, three: ModuleInputs, ticks: int) -> None:
        for _ in range(ticks):
            alarms = failsafes.step(bench.step(one, three), Mode.POSHOLD, False, True)
            told.extend((alarm.words.partition(" (")[2], alarm.again) for alarm in alarms if alarm.begins and alarm.name == name)

    run(WELL, WELL, 10)
    run(unwell, WELL, 1000)
    run(unwell, unwell, 1)
    assert told == [("module 2)", False)], "one bad reading of another module does not count"
    run(unwell, unwell, 1000)
    assert told[1:] == [("module 2, 4)", False)]
    run(unwell, WELL, 1000)
    run(unwell, unwell, 1000)
    assert len(told) == 2, "a module that the texts have named is not told of again"


def test_body_that_is_made_of_another_does_not_tell_again_of_the_modules_that_were_named() -> None:
    bench, failsafes, whole = MonitorBench(), Failsafes(Parameters().failsafes), Failsafes(Parameters().failsafes)
    dry, wet = here(leak=False), here(leak=True)
    for one, three in ((dry, dry), *[(wet, dry)] * 100):
        failsafes.step(bench.step(one, three), Mode.POSHOLD, False, True)
    whole.take_over([failsafes])
    alarms = [alarm for _ in range(100) for alarm in whole.step(bench.step(wet, dry), Mode.POSHOLD, False, True) if alarm.name == "leak"]
    assert alarms == []
    alarms = [alarm for _ in range(100) for alarm in whole.step(bench.step(wet, wet), Mode.POSHOLD, False, True) if alarm.name == "leak"]
    assert [alarm.words for alarm in alarms] == ["water in a cabin (module 2, 4)"]


def test_modules_that_lost_different_sensors_at_different_times_are_all_named() -> None:
    bench, watch = MonitorBench(), Watch(next(row for row in TABLE if row.name == "sensor_lost"), Parameters().failsafes)
    bench.step(WELL, WELL)
    without_imu, without_pressure = dataclasses.replace(WELL, gyro=None), dataclasses.replace(WELL, pressure_pa=None)
    for _ in range(200):
        bench.step(without_imu, WELL)
    for _ in range(200):
        health = bench.step(without_imu, without_pressure)
    assert watch.words(health).endswith(" for 4.0 s (module 2, 4)")


def test_body_inherits_every_report_of_its_modules_and_of_no_other() -> None:
    """A figure of a module that is added to ModuleReports needs no second place: forgotten there, it began anew at every dock."""
    pair, one = ModuleReports([1, 3]), ModuleReports([3])
    for tables in vars(pair).values():
        tables.update({1: "told by 1", 3: "told by 3"})
    one.take_over(pair)
    assert vars(one) == {name: {3: "told by 3"} for name in vars(pair)}
