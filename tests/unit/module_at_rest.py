"""Inputs from a module at rest whose sensors all answer."""

import numpy as np

from firmware_py.core.rotations import to_matrix
from firmware_py.core.types import Inputs, ModuleInputs, Request, TagObservation
from firmware_py.description.water import WATER_DENSITY

PERIOD_NS = 10_000_000
PLACE = np.array([0.1, -0.2, 0.5])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def resting(tick: int, requests: list[Request]) -> Inputs:
    """Returns the inputs of one tick from such a module."""
    module = ModuleInputs(answered=True, heard=True, gyro=np.zeros(3), accel=-9.80665 * to_matrix(LEVEL)[2].copy())
    module.pressure_pa = 101325.0 + WATER_DENSITY * 9.80665 * PLACE[2]
    module.tags = [TagObservation(5, 7, tick * PERIOD_NS, np.add(PLACE, [0.0, 0.0, -0.105]), LEVEL)]
    module.voltage_v, module.current_a = 12.0, 1.0
    module.leak, module.cabin_temperature_c, module.cabin_pressure_pa = False, 30.0, 101325.0
    return Inputs(tick, tick * PERIOD_NS, [module], requests)
