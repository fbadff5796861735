"""What is broken on purpose must fail a check: else the checks would prove nothing."""

import dataclasses
import math

import numpy as np
import pytest

from firmware_py.bus.codec import Frame
from firmware_py.core import rotations
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import Vehicle
from hil.checks import Result
from hil.scenario import load_scenario
from tests.closed_loop.flights import Corrupt, Fly, Rebuild, shortened

HOVER_S = 20.0
PROTECTED_FROM = 0x040
"""Ids below carry no CRC (ESTOP, SYNC); HEARTBEAT is not sent here."""


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


def crc_off_by_one_bit(frame: Frame) -> Frame:
    if frame.id < PROTECTED_FROM:
        return frame
    return Frame(frame.id, frame.data[:-1] + bytes((frame.data[-1] ^ 0x01,)))


@pytest.mark.slow
@pytest.mark.parametrize("thruster", [0, 4])
def test_one_reversed_thruster_fails_the_flight(fly: Fly, rebuild: Rebuild, thruster: int) -> None:
    rebuild(lambda vehicle: reversed_thruster(vehicle, thruster))
    # the firmware finds it and flies on without it, so its warning is what fails
    assert "warnings" in failed(fly(shortened("hover", HOVER_S)))


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_tag_glued_on_ten_degrees_askew_fails_the_flight(fly: Fly, rebuild: Rebuild, axis: int) -> None:
    rebuild(lambda vehicle: turned_tags(vehicle, axis))
    assert not fly(load_scenario("spiral")).passed


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_drag_feed_forward_of_the_wrong_sign_fails_the_flight(fly: Fly, seed: int) -> None:
    """The spiral's drag is a quarter of a newton, which the disturbance makes up for within the check: twice the error shows it."""
    wrong = Parameters().replace("control.drag_feedforward", -1.0)
    assert failed(fly(load_scenario("mobius-1"), seed, wrong)) == {"position_rmse_m"}
    spiral = load_scenario("spiral")
    right_m, wrong_m = (fly(spiral, seed, each).metrics["position_rmse_m"] for each in (Parameters(), wrong))
    assert wrong_m > 2.0 * right_m


@pytest.mark.slow
@pytest.mark.parametrize("to_plant", [True, False], ids=["commands", "answers"])
def test_crc_off_by_one_bit_on_one_side_fails_the_flight(
    fly: Fly, corrupt: Corrupt, to_plant: bool
) -> None:
    corrupt(crc_off_by_one_bit, to_plant)
    assert not fly(shortened("hover", HOVER_S)).passed


@pytest.mark.slow
def test_the_same_hover_unbroken_passes(fly: Fly) -> None:
    assert fly(shortened("hover", HOVER_S)).passed
