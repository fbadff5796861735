"""Ways of bodies to a dock: which bodies they come too near to, and where they end."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from firmware_py.core.docking_way import WAY_SLACK, Way, first_blocking_module, nearest_pass, obstacle, way_of_active, way_of_target
from firmware_py.core.rotations import from_euler, rotate
from firmware_py.core.types import DockRequest
from firmware_py.description.parameters import Docking
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import PITCH_M, assemble
from firmware_py.prepare.docking import plan_dock
from tests.unit.dock_follower import LEVEL, STAGED, Follower, estimate, face_of


@pytest.mark.slow
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
    """Turning the whole scene by `yaw` changes nothing."""
    target, active = (assemble([(0, 0, 0)], [0], [load_vehicle("modcube")], [m]) for m in (0, 1))
    plan = plan_dock(DockRequest(1, 1, 0, 0), active, target, [load_vehicle("modcube")] * 2)
    q_wb = from_euler(0.0, 0.0, yaw)
    at, there = (estimate(rotate(q_wb, np.array(p)))._replace(q_wb=q_wb) for p in (start, (0.0, 0.0, 0.0)))
    found = nearest_pass(way_of_active(plan, active, at, target, there, 0.12), target, there, 0.03)
    assert found == (None if is_free else 0)


def test_module_beside_the_one_that_is_docked_to_may_be_in_the_way() -> None:
    """The target is a bar of two along y, and the dock is to its first module's +x face: the way from behind leads past the second."""
    vehicles = [load_vehicle("modcube")] * 3
    bar, active = assemble([(0, 0, 0), (0, 1, 0)], [0, 0], vehicles[:2], [0, 1]), assemble([(0, 0, 0)], [0], vehicles[:1], [2])
    plan = plan_dock(DockRequest(2, 1, 0, 0), active, bar, vehicles)
    before, there = np.array([0.33, 0.0, 0.0]) + bar.r_bm[0], estimate(np.zeros(3))
    for offset, wanted in ([0.3, 0.3, 0.0], None), ([-0.5, 0.6, 0.0], 1):
        way = way_of_active(plan, active, estimate(before + np.array(offset)), bar, there, 0.12)
        assert nearest_pass(way, bar, there, 0.03) == wanted


@pytest.mark.parametrize(
    ("approach", "third_m", "is_placed", "is_met"),
    [
        ("staged", (0.3, 0.33, 0.0), True, True),  # beside the stand-off
        ("staged", (0.3, 0.33, 0.0), False, False),
        ("staged", (0.27, 0.0, 0.0), True, False),  # beside the target
        ("straight", (0.27, 0.0, 0.0), True, True),
    ],
)
def test_third_body_is_met_where_the_way_ends_too(approach: str, third_m: tuple[float, ...], is_placed: bool, is_met: bool) -> None:
    vehicle = load_vehicle("modcube")
    target, active, third = (assemble([(0, 0, 0)], [0], [vehicle], [m]) for m in range(3))
    plan = plan_dock(DockRequest(1, 3, 0, 2), active, target, [vehicle] * 2)
    start, there, at = (estimate(np.array(p)) for p in ((0.0, 1.5, 0.0), (0.0, 0.0, 0.0), third_m))
    found = obstacle(plan, (active, start), (target, there), [(third, at._replace(ready=is_placed))], False, Docking(approach=approach))
    assert ("too near to module 3" in found) == is_met


def way_past(third_m: tuple[float, ...], length_m: float, cells: list[tuple[int, int, int]]) -> int | None:
    """Module that a body of these cells meets on a way of `length_m` along +x, centred on the origin; the third body is module 9."""
    vehicle = load_vehicle("modcube")
    body, third = assemble(cells, [0] * len(cells), [vehicle] * len(cells)), assemble([(0, 0, 0)], [0], [vehicle], [9])
    half = np.array([0.5 * length_m, 0.0, 0.0])
    return first_blocking_module(Way(body, -half, LEVEL, half, LEVEL, PITCH_M), [(third, estimate(np.array(third_m)))], STAGED, math.inf)


@pytest.mark.slow
@pytest.mark.parametrize("along_m", np.linspace(-10.0, 10.0, 9).tolist())
def test_body_that_a_long_way_just_touches_is_met_wherever_it_is(along_m: float) -> None:
    assert way_past((along_m, 0.29, 0.0), 30.0, [(0, 0, 0)]) == 9
    assert way_past((along_m, 0.31, 0.0), 30.0, [(0, 0, 0)]) is None


@pytest.mark.slow
def test_body_that_only_the_outermost_module_touches_is_met() -> None:
    row = [(0, k, 0) for k in range(5)]
    assert way_past((0.0, 2 * PITCH_M + 0.29, 0.0), 3.0, row) == 9
    assert way_past((0.0, 2 * PITCH_M + 0.31, 0.0), 3.0, row) is None


@pytest.mark.slow
@pytest.mark.parametrize("gap_m", [0.12, 0.0])
def test_way_of_a_tilted_pair_leads_its_module_before_the_face_of_the_other(gap_m: float) -> None:
    dock = Follower()
    dock.astray(sideways_m=0.1, turned_rad=0.3)
    way = way_of_active(dock.plan, dock.active, dock.at, dock.target, dock.there, gap_m)
    begin, end = way.at((0.0, 1.0))
    for k, module in enumerate(dock.active.modules):
        face, normal = face_of(dock.active, module, 0, dock.at)
        np.testing.assert_allclose(begin[k], face - 0.5 * PITCH_M * normal, atol=1e-9)
    arrived = dock.at._replace(p_wb=way.p_end, q_wb=way.q_end)
    mine, inward = face_of(dock.active, 3, 3, arrived)
    np.testing.assert_allclose(mine, dock.face + gap_m * dock.outward, atol=1e-9)
    np.testing.assert_allclose(inward, -dock.outward, atol=1e-9)
    np.testing.assert_allclose(end[1], mine + 0.5 * PITCH_M * dock.outward, atol=1e-9)


@pytest.mark.parametrize("approach", ["staged", "straight"])
def test_way_of_a_target_that_is_looked_at_is_the_one_that_it_is_told_to_come(approach: str) -> None:
    dock = Follower(Docking(approach=approach), target_approaches=True)
    dock.astray(sideways_m=0.2)
    way = way_of_active(dock.plan, dock.active, dock.at, dock.target, dock.there, STAGED.standoff_m if approach == "staged" else 0.0)
    theirs = way_of_target(dock.plan, way, dock.target, dock.there)
    dock.step()
    np.testing.assert_allclose(theirs.p_end, dock.sequence.meets_at_w, atol=1e-9)


@pytest.mark.parametrize("lost", [0, 1])
def test_way_of_bodies_whose_places_nobody_knows_is_judged_by_nobody(lost: int) -> None:
    vehicle = load_vehicle("modcube")
    target, active = (assemble([(0, 0, 0)], [0], [vehicle], [m]) for m in range(2))
    plan = plan_dock(DockRequest(1, 1, 0, 0), active, target, [vehicle] * 2)
    through = [(target, estimate(np.zeros(3))), (active, estimate(np.array([-0.6, 0.0, 0.0])))]
    assert "too near to module 1" in obstacle(plan, through[1], through[0], [], False, Docking())
    through[lost] = (through[lost][0], through[lost][1]._replace(ready=False))
    assert obstacle(plan, through[1], through[0], [], False, Docking()) == ""


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(60))
def test_module_that_comes_too_near_on_the_way_is_found_however_both_bodies_are_turned(seed: int) -> None:
    """Against the same way by scipy: a straight line, with a constant turn rate."""
    dock, rng, standoff_m = Follower(), np.random.default_rng(seed), STAGED.standoff_m
    target, active, plan = dock.target, dock.active, dock.plan
    there, at = (estimate(rng.normal(0.0, 0.35, 3))._replace(q_wb=Rotation.random(rng=rng).as_quat()[[3, 0, 1, 2]]) for _ in range(2))
    r_t, r_a, q_t, q_a, q_ta = (
        Rotation.from_quat(q[[1, 2, 3, 0]]) for q in (there.q_wb, at.q_wb, target.q_bm[1], active.q_bm[1], plan.q_ta)
    )
    r_end = r_t * q_t * q_ta * q_a.inv()
    p_end = there.p_wb + r_t.apply(target.r_bm[1] + q_t.apply(plan.place_t + plan.axis_t * standoff_m)) - r_end.apply(active.r_bm[1])
    shares = np.linspace(0.0, 1.0, 2001)
    turned = Slerp([0.0, 1.0], Rotation.concatenate([r_a, r_end]))(shares)
    mine = at.p_wb + shares[:, None] * (p_end - at.p_wb)
    mine = np.stack([mine + turned.apply(r) for r in active.r_bm], axis=1)
    gaps = np.linalg.norm(mine[:, :, None] - (there.p_wb + r_t.apply(target.r_bm)), axis=3)
    least, ends = gaps.min(axis=0), np.minimum(gaps[0], gaps[-1])
    near = np.clip(ends - 0.25 * standoff_m, 2**0.5 * PITCH_M, 3**0.5 * PITCH_M)
    touching = (least < ends - 0.005) & (least < near)
    wanted = int(np.where(touching, least, np.inf).min(axis=0).argmin()) if touching.any() else None
    assert nearest_pass(way_of_active(plan, active, at, target, there, standoff_m), target, there, WAY_SLACK * standoff_m) == wanted
