"""The motor test turns what it was told to, as long and as hard as it was told to and may, to the nanosecond: hands are near."""

import dataclasses
import itertools

import numpy as np
import pytest

from firmware_py.core.motor_test import MotorTest
from firmware_py.description.steering_parameters import Steering
from tests.unit.tanks import single

BODY = single()
WEAK = dataclasses.replace(BODY, thrusters=dataclasses.replace(BODY.thrusters, f_min=0.5 * BODY.thrusters.f_min))
"""Half as strong in reverse."""
HIGH, LOW = WEAK.thrusters.f_max, WEAK.thrusters.f_min
START_NS, SECOND = 5_000_000_000, 1_000_000_000
P = Steering(test_share=0.2, test_s=2.0)


def motor_test() -> MotorTest:
    return MotorTest(WEAK, P)


def only(index: int, force_n: float) -> list[float]:
    """Forces of all thrusters of which one turns."""
    forces = [0.0] * HIGH.size
    forces[index] = force_n
    return forces


@pytest.mark.parametrize(("share", "force_n"), [
    (0.1, 0.1 * HIGH[3]), (-0.1, 0.1 * LOW[3]), (0.9, 0.2 * HIGH[3]), (-0.9, 0.2 * LOW[3]), (0.0, 0.0),
])  # fmt: skip
def test_thruster_gives_the_wanted_share_of_its_side_and_no_more_than_it_may(share: float, force_n: float) -> None:
    test = motor_test()
    assert not test.running and not test.step(START_NS).any()
    test.start((3, share, 2.0), START_NS)
    assert test.running
    for later_ns, expected in ((0, only(3, force_n)), (2 * SECOND - 1, only(3, force_n)), (2 * SECOND, [0.0] * HIGH.size)):
        np.testing.assert_allclose(test.step(START_NS + later_ns), expected, rtol=1e-12)
    assert not test.running


@pytest.mark.parametrize(("seconds", "lasts_s"), [(9.0, 9), (10.0, 10), (11.0, 10), (1e6, 10), (0.0, 0), (-1.0, 0)])
def test_test_lasts_as_long_as_it_was_told_to_and_ten_seconds_at_most(seconds: float, lasts_s: int) -> None:
    test = motor_test()
    test.start((0, 0.1, seconds), START_NS)
    assert test.step(START_NS + max(0, lasts_s * SECOND - 1)).any() == (lasts_s > 0)
    assert not test.step(START_NS + lasts_s * SECOND).any()


def test_detection_turns_each_forward_twice_as_long_in_reverse_and_forward_and_then_pauses() -> None:
    """Two seconds each, then one of pause; with the same force either way, that of the weaker side."""
    test = motor_test()
    test.start((5, 0.1, 10.0), START_NS)
    test.detect(START_NS)
    for index in range(HIGH.size):
        force = -0.2 * LOW[index]
        steps = ((0.0, force), (0.5, -force), (1.5, force), (2.0, 0.0), (3.0, 0.0))
        for (begin_s, expected), (end_s, _) in itertools.pairwise(steps):
            for second in (3 * index + begin_s, 3 * index + end_s - 1e-9):
                forces = test.step(START_NS + round(second * SECOND))
                np.testing.assert_allclose(forces, only(index, expected), rtol=1e-12)
                assert test.running
    assert not test.step(START_NS + 3 * HIGH.size * SECOND).any() and not test.running


def test_stopped_or_replaced_test_is_over_at_once() -> None:
    test = motor_test()
    test.detect(START_NS)
    test.start((2, 0.1, 1.0), START_NS)
    np.testing.assert_allclose(test.step(START_NS), only(2, 0.1 * HIGH[2]))
    test.stop()
    assert not test.running and not test.step(START_NS).any()
