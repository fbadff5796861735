"""The docking sequence alone: a straight dock begun near ends as any other, and a dock that is refused at once moves nobody."""

import math

import numpy as np
import pytest

from firmware_py.core.docking_detector import PairStatus
from firmware_py.core.docking_sequence import DockingSequence, Stage
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
