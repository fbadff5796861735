"""Thrusters on trial: a push that persists without them acquits them, a liar stays left out."""

import numpy as np
import pytest

from firmware_py.core.thruster_trial import JUDGED, SETTLE, ThrusterTrial
from tests.unit.robot_in_water import BODY, PUSH, Water

SIGMA = np.repeat([0.15, 0.006], 3)
WANTED = 3.0 * PUSH
LEFT_OUT, USED_AGAIN = "does not push as it says: left out", "is used again: the robot is pushed as much without it"


def as_if_lost(thruster: int) -> np.ndarray:
    """(6,) push that looks like the loss of 1.5 N of a thruster."""
    return -1.5 * np.sign(PUSH[thruster]) * BODY.thrusters.matrix[:, thruster]


@pytest.mark.parametrize("thruster", range(8))
def test_thruster_is_used_again_when_the_robot_is_pushed_as_much_without_it(thruster: int) -> None:
    water = Water(seed=thruster)
    water.fly()
    water.pushed = as_if_lost(thruster)
    found = [words for _, words in water.run(6.0, WANTED)]
    assert found == [f"thruster {thruster + 1} {LEFT_OUT}", f"thruster {thruster + 1} {USED_AGAIN}"]
    assert water.detector.now.alive.all()
    assert water.detector.now.dead == ()


@pytest.mark.parametrize("thruster", range(8))
@pytest.mark.parametrize("gain", [0.0, -1.0], ids=["fakes its speed", "reversed"])
def test_liar_stays_left_out(thruster: int, gain: float) -> None:
    water = Water(seed=thruster)
    water.fly()
    water.gain[thruster] *= gain
    assert [words for _, words in water.run(12.0, WANTED)] == [f"thruster {thruster + 1} {LEFT_OUT}"]
    assert water.detector.now.dead == (thruster,)


def test_thruster_is_acquitted_twice_and_no_more_until_the_robot_is_armed_again() -> None:
    water = Water(seed=1)
    water.fly()
    found = []
    for _ in range(3):
        water.pushed = as_if_lost(1)
        found += [words for _, words in water.run(8.0, WANTED)]
        water.pushed = np.zeros(6)
        found += [words for _, words in water.run(8.0, WANTED)]
    assert [words for words in found if words.startswith("thruster 2 ")] == [
        *[f"thruster 2 {LEFT_OUT}", f"thruster 2 {USED_AGAIN}"] * 2, f"thruster 2 {LEFT_OUT}",
    ]  # fmt: skip
    water.detector.reset()
    water.fly()
    water.pushed = as_if_lost(1)
    assert [words for _, words in water.run(6.0, WANTED)] == [f"thruster 2 {LEFT_OUT}", f"thruster 2 {USED_AGAIN}"]


def test_thruster_stays_left_out_when_tags_are_lost_during_its_trial() -> None:
    """Without tags the motion says too little to acquit anybody."""
    water = Water(seed=3)
    water.fly()
    water.pushed = as_if_lost(3)
    assert [words for _, words in water.run(1.0, WANTED)] == [f"thruster 4 {LEFT_OUT}"]
    water.tag_age_ns = 600_000_000
    assert water.run(0.2, WANTED) == []
    water.tag_age_ns = 0
    assert water.run(4.0, WANTED) == []
    assert water.detector.now.dead == (3,)


def test_verdict_comes_with_the_last_block_and_the_first_ones_do_not_count() -> None:
    blamed = np.array([1.0, 0.0, 0.5, 0.0, 0.02, 0.0])
    for wall, innocent in ((0.0, False), (0.45, False), (0.55, True), (1.0, True)):
        trial = ThrusterTrial(2, np.ones(6), blamed, SIGMA)
        settling = [trial.is_innocent(np.full(6, 100.0)) for _ in range(SETTLE)]
        verdicts = [trial.is_innocent(1.0 + wall * blamed) for _ in range(JUDGED)]
        assert settling + verdicts == [None] * (SETTLE + JUDGED - 1) + [innocent]
        assert trial.thruster == 2


def test_push_in_another_direction_acquits_nobody() -> None:
    trial = ThrusterTrial(0, np.zeros(6), np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), SIGMA)
    verdicts = [trial.is_innocent(np.array([0.2, 3.0, -3.0, 0.1, 0.1, 0.1])) for _ in range(SETTLE + JUDGED)]
    assert verdicts[-1] is False
