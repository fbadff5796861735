"""A thruster on trial when bodies join or part: its trial goes on in the body that holds it then."""

import numpy as np
import pytest

from firmware_py.core.body import Body
from firmware_py.core.faults import FaultDetector
from firmware_py.core.preload import preload
from firmware_py.core.propagation import ERRORS
from firmware_py.core.rotations import multiply
from firmware_py.core.thruster_trial import JUDGED, SETTLE, ThrusterTrial
from firmware_py.core.topology import Motion, join, moved_wrench, part_of
from firmware_py.core.trial_handover import Held, carried_over
from firmware_py.description.failsafe_parameters import Faults
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble
from tests.unit.robot_in_water import PUSH, TICK_NS, Water

CUBE = load_vehicle("modcube")
ALONE, OTHER = (assemble([(0, 0, 0)], [0], [CUBE], [module]) for module in (0, 1))
PAIR = assemble([(0, 0, 0), (1, 0, 0)], [0, 4], [CUBE] * 2, [1, 0])
"""The module that was alone comes second, and turned."""
WANTED = 3.0 * PUSH
PAIR_WANTED = 3.0 * preload(PAIR.thrusters, np.ones(16, dtype=bool), 0.6)
SIGMA = np.repeat([0.15, 0.006], 3)


def lost(body: Body, thruster: int, wanted: np.ndarray, force_n: float = 1.5) -> np.ndarray:
    """(6,) push that looks like the loss of that force of a thruster."""
    return -force_n * np.sign(wanted[thruster]) * body.thrusters.matrix[:, thruster]


def used_again(thruster: int) -> str:
    return f"thruster {thruster + 1} of module 1 is used again: the robot is pushed as much without it"


def flying(body: Body, wanted: np.ndarray, seed: int) -> Water:
    """A robot that holds its place at the attitude that its module has in PAIR."""
    water = Water(seed, body)
    if body is ALONE:
        water.x[3:7] = multiply(water.x[3:7].copy(), PAIR.q_bm[1].copy())
        water.start = water.x.copy()
    water.run(1.0, armed=False)
    assert water.run(3.0, wanted) == []
    return water


def convicted(thruster: int, gain: float = 1.0, body: Body = ALONE, wanted: np.ndarray = WANTED, push_n: float = 1.5) -> Water:
    """A robot whose thruster was just left out: it lies about its force, or, at a gain of 1, something pushes."""
    water = flying(body, wanted, thruster)
    if gain == 1.0:
        water.pushed = lost(body, thruster, wanted, push_n)
    else:
        water.gain[thruster] = gain
    while water.detector.now.alive.all():
        water.run(0.01, wanted)
    assert water.detector.now.dead == (thruster,)
    return water


def handed_on(after: Body, *before: Water) -> Water:
    """A body made of these, or of a part of one: with their waters, gains, pushes and detectors."""
    water = Water(0, after)
    water.deadband = np.full(after.thrusters.f_max.size, 0.15)
    water.gain = np.ones(after.thrusters.f_max.size)
    for other in before:
        for i, module in enumerate(after.modules):
            if module in other.body.modules:
                j = other.body.modules.index(module)
                water.gain[8 * i : 8 * i + 8] = other.gain[8 * j : 8 * j + 8]
    motions = [(other.body, Motion(other.x, np.eye(ERRORS), 1, 0)) for other in before]
    water.x = (join(motions, after) if len(before) > 1 else part_of(*motions[0], after)).x
    water.start = water.x.copy()
    turns = [moved_wrench(other.body, after)[:3, :3] for other in before]
    water.accel_bias = np.mean([turn @ other.accel_bias for turn, other in zip(turns, before, strict=True)], axis=0)
    water.pushed = sum((moved_wrench(other.body, after) @ other.pushed for other in before), np.zeros(6))
    water.detector = FaultDetector(after, Faults(), TICK_NS)
    water.detector.take_over([other.detector for other in before])
    return water


def dock(water: Water, pull_s: float = 0.0) -> Water:
    """The pair of that robot and one at rest, after magnets pulled for `pull_s`."""
    other = flying(OTHER, WANTED, 20)
    for robot in (water, other):
        robot.free = False
        assert robot.run(pull_s, WANTED) == []
    return handed_on(PAIR, other, water)


@pytest.mark.slow
@pytest.mark.parametrize("pull_s", [0.0, 5.0])
@pytest.mark.parametrize("thruster", range(8))
def test_thruster_convicted_just_before_a_dock_is_used_again_after_it(thruster: int, pull_s: float) -> None:
    """The push goes on. The magnets of an approach pull for 4.7 s on the bench, longer than a trial lasts."""
    both = dock(convicted(thruster), pull_s)
    assert both.detector.now.dead == (8 + thruster,)
    assert [words for _, words in both.run(4.0, PAIR_WANTED)] == [used_again(thruster)]
    assert both.detector.now.dead == ()


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "pull_s"), [(0.0, 0.0), (0.0, 5.0), (-1.0, 0.0)])
@pytest.mark.parametrize("thruster", range(8))
def test_liar_stays_left_out_after_a_dock(thruster: int, gain: float, pull_s: float) -> None:
    both = dock(convicted(thruster, gain), pull_s)
    assert both.run(8.0, PAIR_WANTED) == [] and both.detector.now.dead == (8 + thruster,)


def test_trial_waits_while_magnets_pull_and_no_longer() -> None:
    water = convicted(2)
    water.free = False
    assert water.run(10.0, WANTED) == []
    water.free = True
    assert [words for _, words in water.run(2.5, WANTED)] == [used_again(2)]


@pytest.mark.slow
@pytest.mark.parametrize("thruster", range(8))
def test_thruster_convicted_just_before_its_module_parts_is_used_again_if_that_is_pushed_on(thruster: int) -> None:
    """By 2.5 N: 1.5 N are hardly more than the doubt about a module's own buoyancy, trim and accelerometer."""
    part = handed_on(ALONE, convicted(8 + thruster, body=PAIR, wanted=PAIR_WANTED, push_n=2.5))
    assert [words for _, words in part.run(4.0, WANTED)] == [used_again(thruster)]


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.0, -1.0, 1.0], ids=["fakes its speed", "reversed", "the other part is pushed"])
@pytest.mark.parametrize("thruster", range(8))
def test_thruster_stays_left_out_after_its_module_parts_if_nothing_pushes_that(thruster: int, gain: float) -> None:
    whole = convicted(8 + thruster, gain, PAIR, PAIR_WANTED)
    whole.pushed = np.zeros(6)
    part = handed_on(ALONE, whole)
    assert part.run(8.0, WANTED) == [] and part.detector.now.dead == (thruster,)


# ---------------------------------------------------------------- what is handed over


def trial_of(thruster: int, body: Body, base: np.ndarray) -> ThrusterTrial:
    return ThrusterTrial(thruster, base, lost(body, thruster, np.ones(16)), [np.zeros(6)], SIGMA)


def test_trial_begins_anew_with_the_thrusters_number_in_the_new_body() -> None:
    trial = trial_of(3, ALONE, np.zeros(6))
    for _ in range(SETTLE + JUDGED - 1):
        assert trial.is_innocent(np.zeros(6)) is None
    again = carried_over([Held(OTHER, None, np.zeros(6)), Held(ALONE, trial, None)], PAIR, SIGMA)
    assert again is not None and again.thruster == 11
    pushed = lost(PAIR, 11, np.ones(16))
    assert [again.is_innocent(pushed) for _ in range(SETTLE + JUDGED)] == [None] * (SETTLE + JUDGED - 1) + [True]


def test_residuals_of_bodies_that_join_add_up_about_their_common_centre() -> None:
    mine, theirs = np.array([0.0, 0.0, 0.2, 0.01, 0.0, 0.0]), np.array([0.3, 0.0, 0.0, 0.0, 0.02, 0.0])
    again = carried_over([Held(ALONE, trial_of(3, ALONE, mine), None), Held(OTHER, None, theirs)], PAIR, SIGMA)
    assert again is not None
    moved, still = moved_wrench(ALONE, PAIR) @ mine + moved_wrench(OTHER, PAIR) @ theirs, [[0.01, 0.0, 0.0], [0.0, 0.02, 0.0]]
    turned = moved_wrench(ALONE, PAIR)[:3, :3] @ still[0] + still[1]
    np.testing.assert_allclose(again.base, np.r_[moved[:3], 0.5 * (moved[3:] + turned)], atol=1e-12)


def test_nothing_is_handed_over_without_a_trial_its_thruster_or_what_the_other_body_measured() -> None:
    trial = trial_of(3, ALONE, np.zeros(6))
    assert carried_over([Held(ALONE, trial, None), Held(OTHER, None, None)], PAIR, SIGMA) is None
    assert carried_over([Held(ALONE, None, np.zeros(6)), Held(OTHER, None, np.zeros(6))], PAIR, SIGMA) is None
    assert carried_over([Held(PAIR, trial_of(3, PAIR, np.zeros(6)), None)], ALONE, SIGMA) is None


def test_of_two_trials_the_first_goes_on_and_its_thruster_alone() -> None:
    both = [Held(OTHER, trial_of(6, OTHER, np.zeros(6)), np.zeros(6)), Held(ALONE, trial_of(3, ALONE, np.zeros(6)), np.zeros(6))]
    first, second = (carried_over(order, PAIR, SIGMA) for order in (both, both[::-1]))
    assert first is not None and second is not None and (first.thruster, second.thruster) == (6, 11)


def test_wrench_that_is_moved_gives_the_same_power() -> None:
    """A thruster's column in the new body is its column in the old one, moved."""
    for old, new, here, there in ((ALONE, PAIR, slice(0, 8), slice(8, 16)), (PAIR, ALONE, slice(8, 16), slice(0, 8))):
        np.testing.assert_allclose(moved_wrench(old, new) @ old.thrusters.matrix[:, here], new.thrusters.matrix[:, there], atol=1e-12)
