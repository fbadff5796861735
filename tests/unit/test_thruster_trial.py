"""Thrusters on trial: a push that persists without them acquits them, a liar stays left out."""

from collections.abc import Sequence

import numpy as np
import pytest

from firmware_py.core.faults import FaultDetector
from firmware_py.core.missing_thrust import FORCES, RECENT, RESIDUAL, MissingThrust
from firmware_py.core.thruster_trial import JUDGED, PATIENCE, SETTLE, ThrusterTrial
from firmware_py.description.failsafe_parameters import Faults
from tests.unit.robot_in_water import BODY, PUSH, TICK_NS, Water

SIGMA = np.repeat([0.15, 0.006], 3)
BLAMED = np.array([1.0, 0.0, 0.5, 0.0, 0.02, 0.0])
WANTED = 3.0 * PUSH
LEFT_OUT, USED_AGAIN = "does not push as it says: left out", "is used again: the robot is pushed as much without it"


def as_if_lost(thruster: int) -> np.ndarray:
    """(6,) push that looks like the loss of 1.5 N of a thruster."""
    return -1.5 * np.sign(PUSH[thruster]) * BODY.thrusters.matrix[:, thruster]


def on_trial(thruster: int, since_s: float) -> Water:
    """A robot that something pushes, and whose innocent thruster was left out for that; `since_s` after the push began."""
    water = Water(seed=thruster)
    water.fly()
    water.pushed = as_if_lost(thruster)
    assert [words for _, words in water.run(since_s, WANTED)] == [f"thruster {thruster + 1} of module 1 {LEFT_OUT}"]
    return water


@pytest.mark.slow
@pytest.mark.parametrize("thruster", range(8))
def test_thruster_is_used_again_when_the_robot_is_pushed_as_much_without_it(thruster: int) -> None:
    water = Water(seed=thruster)
    water.fly()
    water.pushed = as_if_lost(thruster)
    found = [words for _, words in water.run(6.0, WANTED)]
    assert found == [f"thruster {thruster + 1} of module 1 {LEFT_OUT}", f"thruster {thruster + 1} of module 1 {USED_AGAIN}"]
    assert water.detector.now.alive.all()
    assert water.detector.now.dead == ()


@pytest.mark.slow
@pytest.mark.parametrize("thruster", range(8))
@pytest.mark.parametrize("gain", [0.0, -1.0], ids=["fakes its speed", "reversed"])
def test_liar_stays_left_out(thruster: int, gain: float) -> None:
    water = Water(seed=thruster)
    water.fly()
    water.gain[thruster] *= gain
    assert [words for _, words in water.run(12.0, WANTED)] == [f"thruster {thruster + 1} of module 1 {LEFT_OUT}"]
    assert water.detector.now.dead == (thruster,)


@pytest.mark.slow
def test_thruster_is_acquitted_twice_and_no_more_until_the_robot_is_armed_again() -> None:
    water = Water(seed=1)
    water.fly()
    found = []
    for _ in range(3):
        water.pushed = as_if_lost(1)
        found += [words for _, words in water.run(8.0, WANTED)]
        water.pushed = np.zeros(6)
        found += [words for _, words in water.run(8.0, WANTED)]
    assert [words for words in found if words.startswith("thruster 2 of module 1 ")] == [
        *[f"thruster 2 of module 1 {LEFT_OUT}", f"thruster 2 of module 1 {USED_AGAIN}"] * 2, f"thruster 2 of module 1 {LEFT_OUT}",
    ]  # fmt: skip
    water.detector.reset()
    water.fly()
    water.pushed = as_if_lost(1)
    assert [words for _, words in water.run(6.0, WANTED)] == [f"thruster 2 of module 1 {LEFT_OUT}", f"thruster 2 of module 1 {USED_AGAIN}"]


def test_thruster_stays_left_out_when_tags_are_lost_for_the_rest_of_its_trial() -> None:
    """Without tags the motion says too little to acquit anybody."""
    water = on_trial(3, 1.0)
    water.tag_age_ns = 600_000_000
    assert water.run(2.5, WANTED) == []
    water.tag_age_ns = 0
    assert water.run(4.0, WANTED) == []
    assert water.detector.now.dead == (3,)


def test_verdict_comes_although_a_block_of_the_trial_could_not_be_measured() -> None:
    water = on_trial(1, 1.2)
    water.heard = 0.0
    water.run(0.08, WANTED)
    water.heard = 1.0
    assert [words for _, words in water.run(2.0, WANTED)] == [f"thruster 2 of module 1 {USED_AGAIN}"]


@pytest.mark.slow
@pytest.mark.parametrize("thruster", range(8))
def test_liar_that_nobody_saw_begin_is_not_acquitted(thruster: int) -> None:
    """What it no longer pushes is missed less once its force falls, and still less once it is left out: as if something pushed."""
    water = Water(seed=thruster)
    water.tag_age_ns = 1_000_000_000
    water.run(1.0, armed=False)
    water.gain[thruster] = 0.0
    water.run(6.0, 4.0 * PUSH)
    water.tag_age_ns = 0
    found = [words for _, words in water.run(6.0, 4.0 * PUSH) + water.run(10.0, 0.5 * PUSH)]
    assert found == [f"thruster {thruster + 1} of module 1 {LEFT_OUT}"]


@pytest.mark.slow
def test_bodies_that_join_or_part_do_not_count_acquittals_anew() -> None:
    water, again = Water(seed=1), 0
    water.fly()
    for _ in range(4):
        for push in (as_if_lost(1), np.zeros(6)):
            water.pushed = push
            again += sum(words == f"thruster 2 of module 1 {USED_AGAIN}" for _, words in water.run(8.0, WANTED))
        before, water.detector = water.detector, FaultDetector(BODY, Faults(), TICK_NS)
        water.detector.take_over([before])
    assert again == 2


def verdicts(*residuals: np.ndarray | None, liar: Sequence[np.ndarray] = (np.zeros(6),)) -> list[bool | None]:
    """Of a trial about a change of BLAMED, after the blocks in which it settles."""
    trial = ThrusterTrial(2, np.ones(6), BLAMED, liar, SIGMA)
    assert trial.thruster == 2
    assert [trial.is_innocent(np.full(6, 100.0)) for _ in range(SETTLE)] == [None] * SETTLE
    return [trial.is_innocent(residual) for residual in residuals]


@pytest.mark.parametrize(("share", "is_innocent"), [(0.0, False), (0.45, False), (0.55, True), (1.0, True)])
def test_verdict_comes_with_the_last_block_and_is_the_nearer_outcome(share: float, is_innocent: bool) -> None:
    residuals = [1.0 + share * BLAMED] * JUDGED
    assert verdicts(*residuals) == [*[None] * (JUDGED - 1), is_innocent]


def test_push_in_another_direction_acquits_nobody() -> None:
    assert verdicts(*[1.0 + np.array([0.2, 3.0, -3.0, 0.1, 0.1, 0.1])] * JUDGED)[-1] is False


def test_every_way_to_lie_must_be_less_likely_than_a_wall() -> None:
    residuals = [1.0 + BLAMED] * JUDGED
    far, near, same = np.zeros(6), 1.5 * BLAMED, BLAMED + 2.9 * np.array([0.15, 0, 0, 0, 0, 0])
    assert verdicts(*residuals, liar=[far, near])[-1] is True
    assert verdicts(*residuals, liar=[far, same])[-1] is False
    assert verdicts(*[1.0 + 1.4 * BLAMED] * JUDGED, liar=[far, near])[-1] is False


def test_trial_in_which_too_little_can_be_measured_ends_without_acquittal() -> None:
    unseen = verdicts(*[None] * (PATIENCE - SETTLE))
    assert unseen == [*[None] * (PATIENCE - SETTLE - 1), False]
    late = verdicts(*[None] * (PATIENCE - SETTLE - JUDGED), *[1.0 + BLAMED] * JUDGED)
    assert late[-1] is True


def test_thruster_is_acquitted_where_it_never_pushed_hard_enough_to_be_missed_so_much() -> None:
    """The wall pushes ten times what the thruster gave at its hardest, so it cannot have lied all along."""
    watch = MissingThrust(BODY, Faults(), TICK_NS)
    watch._blocks[:] = 0.0
    wall = 3.0 * BODY.thrusters.matrix[:, 4]
    watch._blocks[-RECENT:, RESIDUAL] = wall
    watch._blocks[:-RECENT, FORCES][:, 4] = 0.3
    trial = watch._accuse(4)
    assert [trial.is_innocent(wall) for _ in range(SETTLE + JUDGED)][-1] is True
