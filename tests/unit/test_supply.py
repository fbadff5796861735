"""The supply voltage of each module, as the limiter gets it: smoothed, and without implausible readings."""

import math

import numpy as np
import pytest

from firmware_py.core.supply import SupplyMeter
from firmware_py.core.types import ModuleInputs
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble

NOMINAL_V = 12.0


def meter() -> SupplyMeter:
    """A meter for a body of modules 2 and 0, of a fleet of three."""
    return SupplyMeter(assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [load_vehicle("modcube")] * 2, [2, 0]))


def heard(supply: SupplyMeter, two: float | None, zero: float | None = None) -> list[float]:
    supply.step([ModuleInputs(voltage_v=zero), ModuleInputs(voltage_v=3.0), ModuleInputs(voltage_v=two)])
    return np.asarray(supply.voltage_v).tolist()


def test_supply_is_nominal_until_a_module_says_otherwise_and_then_its_own() -> None:
    supply = meter()
    assert heard(supply, None) == [NOMINAL_V, NOMINAL_V]
    assert heard(supply, None, 10.0)[0] == NOMINAL_V
    assert heard(supply, 10.0)[0] < NOMINAL_V


def test_one_reading_moves_the_supply_half_the_way_and_half_a_second_all_of_it() -> None:
    supply = meter()
    assert heard(supply, 10.0)[0] == pytest.approx(11.0)
    for _ in range(4):
        heard(supply, 10.0)
    assert heard(supply, None)[0] == pytest.approx(10.0, abs=0.1)


@pytest.mark.parametrize("wrong_v", [0.0, 0.5, 120.0, -12.0, math.nan, math.inf])
def test_supply_that_cannot_be_true_is_not_believed(wrong_v: float) -> None:
    assert heard(meter(), wrong_v, wrong_v) == [NOMINAL_V, NOMINAL_V]
