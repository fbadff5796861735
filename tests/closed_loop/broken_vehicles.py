"""Vehicles that differ from their files, and the checks that notice it."""

import dataclasses
import math

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.vehicle import Vehicle
from hil.checks import Result


def failed(result: Result) -> set[str]:
    return {check.name for check in result.checks if not check.passed}


def reversed_thruster(vehicle: Vehicle, index: int) -> Vehicle:
    thrusters = list(vehicle.thruster)
    thrusters[index] = dataclasses.replace(thrusters[index], direction=-thrusters[index].direction)
    return dataclasses.replace(vehicle, thruster=tuple(thrusters))


def turned_tags(vehicle: Vehicle, axis: int) -> Vehicle:
    turn = rotations.exp(math.radians(10.0) * np.eye(3)[axis])
    tags = (dataclasses.replace(t, quaternion=rotations.multiply(np.array(t.quaternion), turn)) for t in vehicle.tag)
    return dataclasses.replace(vehicle, tag=tuple(tags))
