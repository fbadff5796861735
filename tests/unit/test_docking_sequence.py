"""The docking sequence alone: a straight dock begun near ends as any other, and a dock that is refused at once moves nobody."""

import math

import numpy as np
import pytest

from firmware_py.core.docking_detector import PairStatus
from firmware_py.core.docking_sequence import DockingSequence, Stage, nearest_pass
from firmware_py.core.rotations import from_euler, rotate
from firmware_py.core.setpoint import Wish
from firmware_py.core.types import DockRequest, Estimate
from firmware_py.description.parameters import PAPER, Docking
from firmware_py.description.vehicle import load_vehicle
from firmware_py.prepare.assembly import assemble
from firmware_py.prepare.docking import plan_dock

TICK_NS = 10_000_000
NEITHER = PairStatus(False, False, 0, 0, math.nan, math.nan, math.nan, False, True)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def estimate(p_wb: np.ndarray, sigma_m: float = 0.001) -> Estimate:
    return Estimate(
        p_wb=p_wb, q_wb=LEVEL, nu=np.zeros(6), force_w=np.zeros(3), moment_b=np.zeros(3), sigma_p=np.full(3, sigma_m),
        sigma_q=np.full(3, 0.001), tag_age_ns=0, nis=1.0, nis_dof=6, rejected=0, ready=True,
    )  # fmt: skip


def begin(parameters: Docking, gap_m: float, comes: bool = True) -> tuple[DockingSequence, np.ndarray, np.ndarray]:
    """A sequence, and where target and active body are: `gap_m` apart along the target's +x."""
    target, active = (assemble([(0, 0, 0)], [0], [load_vehicle("modcube")], [m]) for m in (0, 1))
    plan = plan_dock(DockRequest(1, 1, 0, 0), active, target, [load_vehicle("modcube")] * 2)
    sequence = DockingSequence(plan, active, target, parameters, 0, comes)
    place = target.r_bm[0] + plan.place_t - active.r_bm[0]
    return sequence, np.zeros(3), place + np.array([gap_m, 0.0, 0.0])


@pytest.mark.parametrize("gap_m", [0.02, 0.12, 0.2, 0.6])
@pytest.mark.parametrize("parameters", [Docking(), PAPER.docking])
def test_dock_that_fails_ends_apart_however_near_it_began(parameters: Docking, gap_m: float) -> None:
    sequence, p_t, p_a = begin(parameters, gap_m)
    for tick in range(1, 40_000):
        steering = sequence.step(tick * TICK_NS, estimate(p_a), estimate(p_t), NEITHER)
        if sequence.stage in (Stage.FAILED, Stage.ABORTED) and steering.is_apart:
            break
        p_a = steering.active.p_wb
    assert sequence.stage in (Stage.FAILED, Stage.ABORTED)
    assert steering.is_apart


@pytest.mark.parametrize("approach", ["staged", "straight"])
def test_target_comes_half_of_the_way_and_is_told_once(approach: str) -> None:
    sequence, p_t, p_a = begin(Docking(approach=approach), 0.5)
    told = [sequence.step(tick * TICK_NS, estimate(p_a), estimate(p_t), NEITHER).meets for tick in (1, 2)]
    left = Docking().standoff_m if approach == "staged" else 0.0
    np.testing.assert_allclose(told[0], [0.5 * (0.5 - left), 0.0, 0.0], atol=1e-12)
    assert told[1] is None


def test_target_that_is_not_free_is_not_moved_and_the_line_goes_all_the_way() -> None:
    sequence, p_t, p_a = begin(PAPER.docking, 0.5, comes=False)
    steering = sequence.step(TICK_NS, estimate(p_a), estimate(p_t), NEITHER)
    assert steering.meets is None
    for tick in range(2, 3000):
        steering = sequence.step(tick * TICK_NS, estimate(p_a), estimate(p_t), NEITHER)
        p_a = steering.active.p_wb
        if sequence.stage == Stage.PUSH:
            break
    assert sequence.errors(estimate(p_a), estimate(p_t)).gap_m == pytest.approx(0.0, abs=1e-3)


def test_dock_that_is_aborted_at_once_moves_nobody() -> None:
    sequence, p_t, p_a = begin(Docking(), 0.5)
    steering = sequence.step(TICK_NS, estimate(p_a, sigma_m=0.02), estimate(p_t), NEITHER)
    assert sequence.stage == Stage.ABORTED
    assert steering.meets is None


# ---------------------------------------------------------------- the way to the stand-off


@pytest.mark.parametrize(
    ("start", "is_free"),
    [
        ((0.8, 0.3, 0.1), True),
        ((0.1, 0.8, 0.0), True),  # past the corner, 0.32 m from centre to centre
        ((0.25, 0.0, 0.0), True),  # from nearer than the stand-off, straight back
        ((0.33, 0.0, 0.0), True),
        ((0.0, 0.5, 0.0), False),  # along the edge, 0.28 m
        ((-0.6, 0.0, 0.0), False),  # through it
        ((-0.6, 0.0, 1.5), False),
        ((-0.6, 3.0, 0.0), True),  # around it, wide enough
        ((-30.0, 0.0, 0.0), False),  # through it, from far
        ((0.0, 0.22, -0.05), False),  # from beside it, over its edge
    ],
)
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_way_to_the_stand_off_is_free_where_it_keeps_clear_of_the_target(start: tuple[float, ...], is_free: bool, yaw: float) -> None:
    """The whole scene turned by `yaw` is the same scene."""
    target, active = (assemble([(0, 0, 0)], [0], [load_vehicle("modcube")], [m]) for m in (0, 1))
    plan = plan_dock(DockRequest(1, 1, 0, 0), active, target, [load_vehicle("modcube")] * 2)
    q_wb = from_euler(0.0, 0.0, yaw)
    at, there = (estimate(rotate(q_wb, np.array(p)))._replace(q_wb=q_wb) for p in (start, (0.0, 0.0, 0.0)))
    found = nearest_pass(plan, active, at, target, there, 0.12)
    assert found == (None if is_free else 0)


def test_module_beside_the_one_that_is_docked_to_may_be_in_the_way() -> None:
    """A bar of two along y, docked to at its first module's +x face: the way from behind leads past the second."""
    vehicles = [load_vehicle("modcube")] * 3
    bar, active = assemble([(0, 0, 0), (0, 1, 0)], [0, 0], vehicles[:2], [0, 1]), assemble([(0, 0, 0)], [0], vehicles[:1], [2])
    plan = plan_dock(DockRequest(2, 1, 0, 0), active, bar, vehicles)
    before = np.array([0.33, 0.0, 0.0]) + bar.r_bm[0]
    assert nearest_pass(plan, active, estimate(before + np.array([0.3, 0.3, 0.0])), bar, estimate(np.zeros(3)), 0.12) is None
    assert nearest_pass(plan, active, estimate(before + np.array([-0.5, 0.6, 0.0])), bar, estimate(np.zeros(3)), 0.12) == 1


def test_body_that_is_turned_is_turned_before_it_is_aligned() -> None:
    sequence, p_t, p_a = begin(Docking(), Docking().standoff_m)
    turned = estimate(p_a)._replace(q_wb=from_euler(0.0, 0.0, 1.5))
    for tick in range(1, 100):
        steering = sequence.step(tick * TICK_NS, turned, estimate(p_t), NEITHER)
    assert sequence.stage == Stage.PRE_APPROACH and isinstance(steering.active, Wish)
    sequence.step(100 * TICK_NS, estimate(p_a), estimate(p_t), NEITHER)
    assert sequence.stage == Stage.ALIGN
