"""Two bodies in each other's way: the time to their collision, and that they stop before it."""

import dataclasses
import math
from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from firmware_py.core.body import Body, deceleration_of
from firmware_py.core.collision import CLOSING_M_S, DRIFT_M_S, MOST_DRIFT_M, OWN_M_S, PIECES, braking_s, cylinders, times_to_brake, within
from firmware_py.core.rotations import from_euler, rotate_back
from firmware_py.core.setpoint import REST, Glider
from firmware_py.core.types import NEVER_AGE_NS, Action, EscFeedback, Estimate, Mode, Request, Setpoint, Sticks
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import PITCH_M, assemble, assemble_vehicle
from tests.unit.tanks import MODCUBE, FaultyTank, world

EDGE_M = float(MODCUBE.hull.size_m[0])
TOUCH_M = EDGE_M * 2.0**0.5
"""Distance of the centres of two level cubes at which their corners can touch first."""
ZERO, STILL, LEVEL = np.zeros(3), np.zeros(6), np.array([1.0, 0.0, 0.0, 0.0])


def at_once(body: Body) -> Body:
    """The body, with thrusters that stop it at once: its time to brake is that to the collision."""
    return dataclasses.replace(body, deceleration=np.full(2, math.inf))


def single(number: int) -> Body:
    return at_once(assemble([(0, 0, 0)], [0], [MODCUBE], [number]))


def at(place: Sequence[float], velocity: Sequence[float] = (0.0, 0.0, 0.0), turn: float = 0.0, **changes: object) -> Estimate:
    """A level body; `turn`: rad/s about the vertical."""
    here = Estimate(np.array(place), LEVEL, np.array([*velocity, 0.0, 0.0, turn]), ZERO, ZERO, ZERO, ZERO, 0, math.nan, 0, 0, True)
    return here._replace(**changes)


def times_of(
    bodies: Sequence[Body],
    estimates: dict[int, Estimate],
    wanted: dict[int, np.ndarray],
    bandwidth: float,
    pairs: Sequence[tuple[int, int]] = (),
) -> dict[int, float]:
    """Times to brake of bodies whose thrusters all turn."""
    return times_to_brake(bodies, estimates, wanted, {body.index: body.deceleration for body in bodies}, bandwidth, pairs)


def reaches(body: Body, q_wb: np.ndarray) -> np.ndarray:
    """(m, 2) radius and half the height of the upright cylinders about the hulls of a body's modules, m."""
    return np.asarray(cylinders(q_wb[None], np.zeros(len(body.modules), dtype=np.int64), body.hull_m))


def pair(
    first: Estimate, second: Estimate, pairs: tuple[tuple[int, int], ...] = (), wanted: Sequence[float] = (0.0, 0.0, 0.0)
) -> tuple[float, float]:
    """Times of bodies 0 and 5; `wanted`: velocity that the guidance of body 0 wants."""
    bodies = [single(0), single(5)]
    times_s = times_of(bodies, {0: first, 5: second}, {0: np.array([*wanted, 0.0, 0.0, 0.0]), 5: STILL}, math.inf, pairs)
    return times_s[0], times_s[5]


def test_time_is_the_gap_over_the_closing_speed() -> None:
    moving, waiting = pair(at([0.0, 0.0, 1.0], [0.2, 0.0, 0.0]), at([1.0, 0.0, 1.0]))
    assert moving == pytest.approx((1.0 - TOUCH_M) / 0.2, rel=1e-9)
    assert math.isnan(waiting), "it does not move"
    both = pair(at([0.0, 0.0, 1.0], [0.2, 0.0, 0.0]), at([1.0, 0.0, 1.0], [-0.3, 0.0, 0.0]))
    assert both == pytest.approx([(1.0 - TOUCH_M) / 0.5] * 2, rel=1e-9)


def test_time_off_the_straight_line_is_that_of_small_steps() -> None:
    """Against a march in steps of 10 us."""
    v, d = np.array([0.31, 0.12, -0.07]), np.array([0.9, 0.2, -0.15])
    t = np.arange(0.0, 5.0, 1e-5)
    left = d - t[:, None] * v
    first = t[np.flatnonzero((np.hypot(left[:, 0], left[:, 1]) <= TOUCH_M) & (np.abs(left[:, 2]) <= EDGE_M))[0]]
    assert pair(at(ZERO, v), at(d))[0] == pytest.approx(first, abs=2e-5)


@pytest.mark.parametrize("tilt", [from_euler(0.0, 0.0, 0.0), from_euler(0.7, 0.3, 0.2), from_euler(0.6155, 0.7854, 0.0)])
@pytest.mark.parametrize("towards", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0), (0.3, -1.0, 0.7), (-1.0, 1.0, -3.0)])
def test_hulls_touch_no_sooner_than_the_time_says(tilt: np.ndarray, towards: tuple[float, float, float]) -> None:
    """Against the boxes themselves, by their separating axes (Gottschalk 1996): they overlap when the cylinders do, or later."""
    way = np.array(towards) / np.linalg.norm(towards)
    speed, corner_m = 0.2, 0.5 * EDGE_M
    first, other = at(ZERO, rotate_back(tilt, speed * way), q_wb=tilt), at(way)
    time_s = pair(first, other)[0]
    axes = Rotation.from_quat(tilt[[1, 2, 3, 0]]).as_matrix()
    separating = [*axes.T, *np.eye(3), *(np.cross(a, b) for a in axes.T for b in np.eye(3))]

    def apart(t_s: float) -> bool:
        return any(
            abs(axis @ (way - t_s * speed * way)) > corner_m * (np.abs(axis @ axes).sum() + np.abs(axis).sum()) for axis in separating
        )

    assert apart(time_s - 1e-6)
    touching_s = next(t for t in np.arange(time_s, 5.0, 0.01) if not apart(t))
    assert touching_s - time_s < (3.0**0.5 - 1.0) * EDGE_M / speed, "the cylinder is not much larger than the hull"


@pytest.mark.parametrize("rotation", range(24))
def test_hull_of_a_turned_module_is_as_large_as_its_corners_reach(rotation: int) -> None:
    vehicle = load_vehicle("bluerov2_heavy")
    body = assemble([(0, 0, 0)], [rotation], [vehicle])
    corners = np.array(list(product(*(0.5 * vehicle.hull.size_m[:, None] * [-1.0, 1.0]))))
    turned = Rotation.from_quat(body.q_bm[0][[1, 2, 3, 0]]).apply(corners)
    assert body.hull_m[0] == pytest.approx(np.ptp(turned, axis=0), rel=1e-12)


@pytest.mark.parametrize("signs", list(product((-1.0, 1.0), repeat=3)))
def test_hull_counts_as_the_upright_cylinder_about_its_corners(signs: tuple[float, float, float]) -> None:
    """A long flat hull, tilted and turned each way."""
    q_wb, hull_m = from_euler(*np.multiply(signs, [0.4, 0.3, 0.7])), np.array([0.6, 0.3, 0.1])
    cylinder = cylinders(q_wb[None], np.zeros(1, dtype=np.int64), hull_m[None])
    turn = Rotation.from_quat(q_wb[[1, 2, 3, 0]])
    corners = turn.apply(0.5 * hull_m * list(product((-1.0, 1.0), repeat=3)))
    assert cylinder == pytest.approx(np.array([[np.hypot(corners[:, 0], corners[:, 1]).max(), corners[:, 2].max()]]))


def test_time_within_reach_is_that_of_a_parabola_below_zero() -> None:
    never, always = (math.inf, -math.inf), (-math.inf, math.inf)
    assert within(3.0, -2.0, 1.0) == (1.0, 3.0) and within(-3.0, -1.0, 1.0) == (-1.0, 3.0)
    assert within(4.0, -2.0, 1.0) == (2.0, 2.0) and within(4.01, -2.0, 1.0) == never, "it grazes"
    assert within(0.0, 0.0, 0.0) == within(-1.0, 0.0, 0.0) == always and within(1.0, 0.0, 0.0) == never, "at rest"
    assert within(-1.0, 0.0, 1e-12) == pytest.approx((-1e6, 1e6))


def test_hull_that_grazes_another_touches_it() -> None:
    hulls = [dataclasses.replace(single(number), hull_m=np.array([[0.6, 0.8, 0.4]])) for number in (0, 5)]
    estimates = {0: at([0.0, 0.0, 1.0], [0.5, 0.0, 0.0]), 5: at([2.0, 1.0, 1.0])}
    assert times_of(hulls, estimates, {0: STILL, 5: STILL}, math.inf)[0] == 4.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_times_of_many_bodies_are_those_of_small_steps(seed: int) -> None:
    """Against a march in steps of 1 ms of every module of three bodies, each of which moves on while the others do."""
    rng = np.random.default_rng(seed)
    bodies = [at_once(assemble([(0, 0, 0), (0, 1, 0)], [0, 0], [MODCUBE] * 2, [0, 1])), single(2), single(3)]
    places_w = np.array([[-0.6, -0.5, 1.0], [1.2, 0.1, 1.2], [-0.2, 1.4, 0.9]]) + rng.uniform(-0.2, 0.2, (3, 3))
    turns = [from_euler(*rng.uniform(-3.0, 3.0, 3)) for _ in bodies]
    flights = [0.2 * (np.array([0.3, 0.4, 1.0]) - place) + rng.uniform(-0.1, 0.1, 3) for place in places_w]
    estimates = {
        body.index: at(place, rotate_back(q_wb, v_w), q_wb=q_wb)
        for body, place, q_wb, v_w in zip(bodies, places_w, turns, flights, strict=True)
    }
    seen = [
        (world(np.r_[ZERO, q_wb]).apply(body.r_bm) + place, np.tile(v_w, (len(body.modules), 1)), reaches(body, q_wb))
        for body, place, q_wb, v_w in zip(bodies, places_w, turns, flights, strict=True)
    ]
    t = np.arange(0.0, 12.0, 1e-3)[:, None]
    times = times_of(bodies, estimates, {body.index: STILL for body in bodies}, math.inf)

    def first_touch(i: int) -> float:
        firsts = [math.nan]
        for j in set(range(3)) - {i}:
            for mine, other in product(zip(*seen[i], strict=True), zip(*seen[j], strict=True)):
                line, own = other[0] - mine[0], mine[1] @ (other[0] - mine[0])
                apart = line + t * (other[1] - mine[1])
                nears = (line - apart[1]) @ line / 1e-3 > CLOSING_M_S * np.linalg.norm(line) and own > OWN_M_S * np.linalg.norm(line)
                touch = (np.hypot(*apart[:, :2].T) <= mine[2][0] + other[2][0]) & (abs(apart[:, 2]) <= mine[2][1] + other[2][1])
                firsts += t[touch][:1, 0].tolist() if nears else []
        return float(np.nanmin(firsts)) if len(firsts) > 1 else math.nan

    for i, body in enumerate(bodies):
        assert times[body.index] == pytest.approx(first_touch(i), abs=2e-3, nan_ok=True)


def test_hull_above_another_has_its_height_for_a_reach() -> None:
    assert pair(at([0.0, 0.0, 1.0], [0.0, 0.0, 0.2]), at([0.1, 0.0, 2.0]))[0] == pytest.approx((1.0 - EDGE_M) / 0.2, rel=1e-9)
    assert math.isnan(pair(at([0.0, 0.0, 1.0], [0.2, 0.0, 0.0]), at([1.0, 0.0, 1.0 + 1.01 * EDGE_M]))[0]), "it passes above"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (at([0.0, 0.0, 1.0], [0.2, 0.0, 0.0]), at([1.0, 1.01 * TOUCH_M, 1.0])),
        (at([0.0, 0.0, 1.0], [-0.2, 0.0, 0.0]), at([1.0, 0.0, 1.0])),
        (at([0.0, 0.0, 1.0], [0.2, 0.0, 0.0]), at([1.0, 0.0, 1.0], [0.2, 0.0, 0.0])),
        (at([0.0, 0.0, 1.0], [0.2, 0.0, 0.0]), at([1.0, 0.0, 1.0], tag_age_ns=NEVER_AGE_NS)),
        (at([0.0, 0.0, 1.0], [0.2, 0.0, 0.0]), at([1.0, 0.0, 1.0], ready=False)),
        (at([0.0, 0.0, 1.0], [0.2, math.nan, 0.0]), at([1.0, 0.0, 1.0])),
        (at([0.0, 0.0, 1.0], [0.99 * CLOSING_M_S, 0.0, 0.0]), at([0.25, 0.0, 1.0])),
        (at(ZERO, [CLOSING_M_S, 0.0, 0.0]), at([1.0, 0.0, 0.0])),
        (at([0.0, 0.0, 1.0], [0.21, 0.0, 0.0]), at([0.25, 0.0, 1.0], [0.2, 0.0, 0.0])),
    ],
    ids=["they pass", "they part", "they fly abreast", "no tag seen", "no attitude", "no speed", "a slow bump", "no faster", "one follows"],
)
def test_bodies_that_do_not_close_in_have_no_time(first: Estimate, second: Estimate) -> None:
    assert np.isnan(pair(first, second)).all()


def test_bodies_that_are_within_reach_and_still_close_in_have_no_time_left() -> None:
    assert pair(at([0.0, 0.0, 1.0], [0.1, 0.0, 0.0]), at([0.25, 0.0, 1.0]))[0] == 0.0
    assert math.isnan(pair(at([0.0, 0.0, 1.0], [-0.1, 0.0, 0.0]), at([0.25, 0.0, 1.0]))[0])


def test_slow_bodies_that_meet_head_on_count_by_the_speed_of_both() -> None:
    assert pair(at(ZERO, [0.05, 0.0, 0.0]), at([0.4, 0.0, 0.0], [-0.05, 0.0, 0.0])) == pytest.approx([(0.4 - TOUCH_M) / 0.1] * 2)
    for own_m_s, gap_m in ((0.99 * OWN_M_S, 0.4), (OWN_M_S, 1.0)):
        one, other = pair(at(ZERO, [own_m_s, 0.0, 0.0]), at([gap_m, 0.0, 0.0], [-0.2, 0.0, 0.0]))
        assert math.isnan(one) and other > 0.0, "it cannot help much"


def test_pair_that_docks_is_to_touch_and_a_third_body_is_not() -> None:
    moving, waiting = at([0.0, 0.0, 1.0], [0.2, 0.0, 0.0]), at([1.0, 0.0, 1.0])
    for pairs in (((0, 5),), ((5, 0),)):
        assert np.isnan(pair(moving, waiting, pairs)).all()
    assert pair(moving, waiting, ((0, 7), (7, 5)))[0] > 0.0


def test_body_out_of_sight_keeps_others_farther_off() -> None:
    """It counted for minutes as exactly where its last tag was, and a body swam into where a current had carried it."""
    moving = at(ZERO, [0.2, 0.0, 0.0])
    for unseen_s in (0.0, 1.0, 15.0, 300.0):
        there = at([3.0, 0.0, 0.0], tag_age_ns=round(unseen_s * 1e9))
        assert pair(moving, there)[0] == pytest.approx((3.0 - TOUCH_M - min(DRIFT_M_S * unseen_s, MOST_DRIFT_M)) / 0.2, rel=1e-9)
        assert pair(moving._replace(tag_age_ns=there.tag_age_ns), at([3.0, 0.0, 0.0]))[0] == pair(moving, there)[0]
    assert math.isnan(pair(moving, at([3.0, 0.0, 1.01 * EDGE_M], tag_age_ns=300 * 10**9))[0]), "its depth is known"
    assert (DRIFT_M_S, MOST_DRIFT_M) == (0.05, 1.0)


def test_body_that_waits_before_another_has_the_time_that_it_would_need() -> None:
    first, other = at(ZERO), at([1.0, 0.0, 0.0])
    assert pair(first, other, wanted=(0.2, 0.0, 0.0)) == pytest.approx(((1.0 - TOUCH_M) / 0.2, math.nan), nan_ok=True)
    assert math.isnan(pair(first, other, wanted=(-0.2, 0.0, 0.0))[0]), "it wants to leave"
    assert math.isnan(pair(first, other, wanted=(0.0, 0.2, 0.0))[0]), "it wants to go aside"
    moving = at(ZERO, [0.1, 0.0, 0.0])
    assert pair(moving, other, wanted=(0.2, 0.0, 0.0))[0] == pytest.approx((1.0 - TOUCH_M) / 0.2)
    assert pair(moving, other)[0] == pytest.approx((1.0 - TOUCH_M) / 0.1)


def row_of_three() -> Body:
    return at_once(assemble([(-1, 0, 0), (0, 0, 0), (1, 0, 0)], [0] * 3, [MODCUBE] * 3, [1, 2, 3]))


@pytest.mark.parametrize("wanted", [False, True], ids=["it turns", "it wants to turn"])
@pytest.mark.parametrize("tilt", [LEVEL, from_euler(0.5, 0.3, 0.2)], ids=["level", "tilted"])
def test_time_of_a_row_that_turns_is_that_of_its_modules_on_their_arcs(wanted: bool, tilt: np.ndarray) -> None:
    """A row of three and a body that nears it, against a march in steps of 1 ms. A straight piece leaves its arc by a share of the arm."""
    row, other, rate = row_of_three(), single(8), np.array([0.0, 0.0, 1.5])
    off_m = (1.0 - math.cos(math.pi / PIECES)) * PITCH_M
    assert off_m == pytest.approx(0.019 * PITCH_M, rel=0.02)
    t_s = np.arange(0.0, 2.0, 1e-3)[:, None]
    spins = Rotation.from_quat(tilt[[1, 2, 3, 0]]) * Rotation.from_rotvec(t_s * rate)
    (radius, height), (other_radius, other_height) = reaches(row, tilt)[0], reaches(other, LEVEL)[0]
    drift_w = np.array([0.02, -0.03, 0.01])
    for bearing in np.radians([*range(60, 125, 5), 250]):
        place = Rotation.from_quat(tilt[[1, 2, 3, 0]]).apply([0.5 * math.cos(bearing), 0.5 * math.sin(bearing), 0.02])
        coming_w = -0.3 * place
        motion = np.r_[rotate_back(tilt, drift_w), rate]
        first = at(ZERO, q_wb=tilt) if wanted else at(ZERO, q_wb=tilt, nu=motion)
        asked = {1: np.r_[drift_w, rate] if wanted else STILL, 8: STILL}
        times = times_of([row, other], {1: first, 8: at(place, coming_w)}, asked, math.inf)
        gaps = [place + t_s * (coming_w - drift_w) - spins.apply(r_b) for r_b in row.r_bm]

        def touch_s(wider_m: float, gaps: list[np.ndarray] = gaps) -> float:
            level_m, up_m = radius + other_radius + wider_m, height + other_height + wider_m
            return float(t_s[np.any([(np.hypot(*gap[:, :2].T) <= level_m) & (abs(gap[:, 2]) <= up_m) for gap in gaps], axis=0)][0, 0])

        earliest_s, latest_s = touch_s(off_m) - 1e-3, touch_s(-off_m) + 1e-3
        assert 0.05 < earliest_s <= times[1] <= latest_s < earliest_s + 0.1
        assert wanted or times[8] == times[1], "the other meets it as it turns"


def test_body_beside_the_sweep_of_a_row_is_not_in_its_way() -> None:
    """The end of the row heads for it, and bends off."""
    row, other, turning = row_of_three(), single(8), at([0.0, 0.0, 1.0], turn=1.0)
    reach_m = PITCH_M + TOUCH_M
    for far_m in (1.02 * reach_m, 0.9 * reach_m):
        place = [PITCH_M, math.sqrt(far_m**2 - PITCH_M**2), 1.0]
        times = times_of([row, other], {1: turning, 8: at(place)}, {1: STILL, 8: STILL}, math.inf)
        assert math.isnan(times[8]) and math.isnan(times[1]) == (far_m > reach_m)


def test_body_within_the_sweep_by_three_hundredths_of_the_arm_is_in_the_way() -> None:
    """Where straight pieces of an arc that are half as long again would pass beside it."""
    row, other, bearing, far_m = row_of_three(), single(8), math.radians(16.875), 0.97 * PITCH_M + TOUCH_M
    estimates = {1: at([0.0, 0.0, 1.0], turn=2.0), 8: at([far_m * math.cos(bearing), far_m * math.sin(bearing), 1.0])}
    assert times_of([row, other], estimates, {1: STILL, 8: STILL}, math.inf)[1] < 0.5 * math.pi / 2.0


@pytest.mark.parametrize("axis", [3, 5], ids=["roll", "yaw"])
def test_body_whose_turn_carries_its_modules_slowly_is_followed_straight_on(axis: int) -> None:
    arm, exact_s = np.eye(3)[int(axis == 3)], (2.0 - TOUCH_M) / 0.1
    one = dataclasses.replace(single(1), r_bm=arm[None])
    for rate, straight in ((OWN_M_S, True), (1.01 * OWN_M_S, False)):
        turning = np.where(np.arange(6) == axis, rate, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
        estimates = {1: at(ZERO, nu=turning), 8: at(arm + np.array([2.0, 0.0, 0.0]))}
        time_s = times_of([one, single(8)], estimates, {1: STILL, 8: STILL}, math.inf)[1]
        assert (time_s == pytest.approx(exact_s, rel=1e-9)) == straight


def test_bodies_go_straight_on_after_a_whole_turn_of_the_fastest() -> None:
    """A row that spins far away must not hide what a body swims into later."""
    row, bodies = row_of_three(), [single(8), single(9)]
    estimates = {1: at([0.0, 9.0, 1.0], turn=3.0), 8: at([0.0, 0.0, 1.0], [0.2, 0.0, 0.0]), 9: at([2.0, 0.0, 1.0])}
    times = times_of([row, *bodies], estimates, {1: STILL, 8: STILL, 9: STILL}, math.inf)
    assert times[8] == pytest.approx((2.0 - TOUCH_M) / 0.2, rel=1e-9) and math.isnan(times[1])


def test_vehicle_alone_has_nobody_to_meet() -> None:
    alone = at([0.0, 0.0, 1.0], [0.2, 0.0, 0.0])
    assert math.isnan(times_of([assemble_vehicle(MODCUBE)], {0: alone}, {0: np.array([0.2, *STILL[1:]])}, 6.0)[0])


@pytest.mark.parametrize(("speed", "bandwidth"), [(0.1, 6.0), (0.3, 1.0), (1.0, 6.0), (2.0, 30.0)])
def test_braking_covers_the_set_point_s_way_and_that_of_thrusters_at_their_limit(speed: float, bandwidth: float) -> None:
    """Against both alone, in steps of 1 ms: the set-point by the glider itself, full force by its time to rest."""
    deceleration, dt_s = 1.6, 1e-3
    glider = Glider(bandwidth, speed, 1.0)
    glider.put(Setpoint(ZERO, LEVEL, np.array([speed, 0.0, 0.0]), ZERO, ZERO, ZERO))
    for _ in range(round(15.0 / bandwidth / dt_s)):
        glider.step(REST, dt_s)
    at_full_force_m = sum(speed - deceleration * t for t in np.arange(0.0, speed / deceleration, dt_s)) * dt_s
    braking = braking_s(np.array([speed, 0.0]), np.array([deceleration, 20.0]), bandwidth)
    assert speed * braking == pytest.approx(glider.at.p_wb[0] + at_full_force_m, abs=1e-3 * speed)
    assert braking_s(np.array([0.0, 0.5]), np.array([deceleration, 5.0]), 4.0) == pytest.approx(0.5 + 0.5 * 0.1)


def test_time_to_brake_is_that_to_the_collision_less_the_braking() -> None:
    bodies = [assemble([(0, 0, 0)], [0], [MODCUBE], [number]) for number in (0, 5)]
    estimates = {0: at(ZERO, [0.2, 0.0, 0.0]), 5: at([1.0, 0.0, 0.0])}
    alone_s = (1.0 - TOUCH_M) / 0.2 - braking_s(np.array([0.2, 0.0]), bodies[0].deceleration, 6.0)
    assert times_of(bodies, estimates, {0: STILL, 5: STILL}, 6.0)[0] == pytest.approx(alone_s)
    wanted_s = (1.0 - TOUCH_M) / 0.4 - braking_s(np.array([0.4, 0.0]), bodies[0].deceleration, 6.0)
    assert times_of(bodies, estimates, {0: np.array([0.4, *STILL[1:]]), 5: STILL}, 6.0)[0] == pytest.approx(wanted_s)
    assert times_of(bodies, estimates, {0: STILL, 5: STILL}, 0.1)[0] == 0.0, "it brakes too late"


def test_deceleration_is_that_of_the_weakest_axis_which_is_steered() -> None:
    """ModCube: four thrusters at 45 deg along x and y; four along z. A BlueROV2's pitch is left to buoyancy."""
    body = assemble_vehicle(MODCUBE)
    full_n = 0.5 * float(body.thrusters.f_max[0] - body.thrusters.f_min[0])
    assert body.deceleration[0] == pytest.approx(4.0 * math.sqrt(0.5) * full_n / body.mass[0, 0])
    assert body.deceleration[0] < 4.0 * full_n / body.mass[2, 2]
    rov = assemble_vehicle(load_vehicle("bluerov2"))
    along = rov.thrusters.full_wrench / np.diag(rov.mass)
    assert rov.passive == (4,) and 0.85 * min(along[3], along[5]) < rov.deceleration[1] < min(along[3], along[5])
    undeclared = assemble_vehicle(dataclasses.replace(load_vehicle("bluerov2"), passive_dof=()))
    assert undeclared.deceleration.tolist() == rov.deceleration.tolist()


@pytest.mark.parametrize("out", range(8))
def test_thruster_that_is_left_out_takes_the_force_of_its_counterpart_with_it(out: int) -> None:
    """Against the allocation itself: no stronger than what the seven others can do along the weakest axis, and not much weaker."""
    body = assemble_vehicle(MODCUBE)
    t, alive = body.thrusters, np.arange(8) != out
    most = np.where(alive, 0.5 * (t.f_max - t.f_min), 0.0)
    no_force = np.zeros(8)
    able = [
        -linprog(np.r_[no_force, -1.0], None, None, np.c_[t.matrix, -axis], np.zeros(6), [*zip(-most, most, strict=True), (0, None)]).fun
        for axis in np.eye(6)
    ]
    move, turn = (np.array(able) / np.diag(body.mass)).reshape(2, 3).min(axis=1)
    found = deceleration_of(t, body.mass, (), alive)
    assert 0.9 * move < found[0] <= move * (1.0 + 1e-9) and found[0] < 0.7 * body.deceleration[0]
    assert 0.6 * turn < found[1] <= turn * (1.0 + 1e-9) and found[1] < 0.9 * body.deceleration[1]


def test_body_without_any_thrust_along_an_axis_brakes_along_the_others() -> None:
    """It may fly by force. Regression: its time to brake was no number, and another body that it wanted to swim into was not in its way."""
    half = dataclasses.replace(MODCUBE, thruster=MODCUBE.thruster[:4])
    bodies = [assemble([(0, 0, 0)], [0], [half], [number]) for number in (0, 5)]
    assert all(bodies[0].deceleration > 0.0) and np.isfinite(bodies[0].deceleration[0])
    times_s = times_of(bodies, {0: at(ZERO), 5: at([1.0, 0.0, 0.0])}, {0: np.array([0.4, *STILL[1:]]), 5: STILL}, 6.0)
    assert 0.0 < times_s[0] < (1.0 - TOUCH_M) / 0.4


# ------------------------------------------------------------ whole ticks


def two_in_the_water(parameters: Parameters, from_m: float = 0.0) -> FaultyTank:
    tank = FaultyTank([(0, 0, 0), (1, 0, 0)], parameters, apart=True)
    for state, x_m in zip(tank.states, (from_m, 1.2), strict=True):
        state[:7] = [x_m, 0.0, 0.8, *from_euler(0.0, 0.0, 0.0)]
    tank.run(2.0)
    tank.run(0.5, Request(Action.ARM, 0), Request(Action.ARM, 1))
    return tank


def distances(tank: FaultyTank) -> np.ndarray:
    """Distance of both centres in every tick, m."""
    return np.array([np.linalg.norm(states[0][:3] - states[1][:3]) for states in tank.past])


@pytest.mark.slow
@pytest.mark.parametrize("mode", [Mode.GUIDED, Mode.POSHOLD])
def test_body_that_is_sent_through_another_stops_before_it(mode: Mode) -> None:
    tank = two_in_the_water(Parameters())
    beyond = Setpoint(np.array([2.4, 0.0, 0.8]), LEVEL, ZERO, ZERO, ZERO, ZERO)
    sent = [Request(Action.SET_POINT, 0, beyond), Request(Action.SET_MODE, 0, Mode.GUIDED)]
    tank.run(8.0, *(sent if mode == Mode.GUIDED else [Request(Action.HOLD, 0, beyond)]))
    assert tank.when("fail-safe on: another body is in the way")
    assert TOUCH_M < distances(tank).min() < 0.6
    assert [record.mode for record in tank.outputs[-1].records] == [Mode.POSHOLD] * 2
    assert np.linalg.norm(tank.states[0][7:10]) < 0.01 and np.linalg.norm(tank.states[1][:3] - [1.2, 0.0, 0.8]) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("speed_m_s", "bandwidth"), [(1.0, 6.0), (0.3, 1.5)], ids=["fast", "soft"])
def test_body_that_is_fast_or_changes_speed_slowly_brakes_sooner(speed_m_s: float, bandwidth: float) -> None:
    parameters = Parameters().replace("steering.speed_m_s", speed_m_s).replace("steering.bandwidth", bandwidth)
    tank = two_in_the_water(parameters, from_m=-1.5)
    tank.run(12.0, Request(Action.HOLD, 0, Setpoint(np.array([4.0, 0.0, 0.8]), LEVEL, ZERO, ZERO, ZERO, ZERO)))
    assert tank.when("fail-safe on: another body is in the way")
    assert distances(tank).min() > TOUCH_M and np.linalg.norm(tank.states[0][7:10]) < 0.01


@pytest.mark.slow
def test_body_with_a_dead_thruster_brakes_by_those_that_are_left() -> None:
    """Regression: it counted all of them, and swam 0.1 m into the other."""
    tank = two_in_the_water(Parameters().replace("steering.speed_m_s", 2.0), from_m=-2.5)
    escs, move = tank._escs, tank._move

    def failed_escs(n: int, k: int) -> list[EscFeedback]:
        return [esc._replace(status=(1, 0)) if (n, esc.first) == (0, 2) else esc for esc in escs(n, k)]

    def moved(n: int) -> None:
        tank.acting[0][0, 2] = 0.0
        move(n)

    tank._escs, tank._move = failed_escs, moved  # type: ignore[method-assign]
    tank.run(10.0, Request(Action.HOLD, 0, Setpoint(np.array([4.0, 0.0, 0.8]), LEVEL, ZERO, ZERO, ZERO, ZERO)))
    assert tank.outputs[-1].records[0].mode == Mode.POSHOLD and tank.when("fail-safe on: another body is in the way")
    assert distances(tank).min() > TOUCH_M


@pytest.mark.slow
@pytest.mark.parametrize("insists", ["stick", "place", "GUIDED"])
def test_body_that_is_sent_on_and_on_waits_and_goes_on_when_the_way_is_free(insists: str) -> None:
    """A stick held, or a request sent again ten times a second: each takes the body over from the fail-safe."""
    tank = two_in_the_water(Parameters())
    beyond, aside = (Setpoint(np.array([*place, 0.8]), LEVEL, ZERO, ZERO, ZERO, ZERO) for place in ((2.4, 0.0), (1.2, 1.0)))
    asked = {
        "stick": [Request(Action.STICKS, 0, Sticks((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)))],
        "place": [Request(Action.HOLD, 0, beyond)],
        "GUIDED": [Request(Action.SET_POINT, 0, beyond), Request(Action.SET_MODE, 0, Mode.GUIDED)],
    }[insists]
    for _ in range(80):
        tank.run(0.1, *asked)
    assert tank.when("fail-safe on: another body is in the way")
    assert distances(tank).min() > EDGE_M + 0.05 and np.linalg.norm(tank.states[0][7:10]) < 0.02
    tank.run(0.1, Request(Action.HOLD, 1, aside), *asked)
    for _ in range(80):
        tank.run(0.1, *asked)
    assert tank.states[0][0] > 2.0 and distances(tank).min() > EDGE_M + 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate_rad_s", "bearing_deg", "insists"),
    [(1.5, 60.0, False), (3.0, 60.0, False), (1.5, 110.0, False), (1.0, 60.0, True), (1.0, 90.0, True)],
)
def test_row_of_nine_that_is_sent_round_stops_before_another(rate_rad_s: float, bearing_deg: float, insists: bool) -> None:
    """Regression: nobody asked where the turn that it wanted would lead. Sent at 3 rad/s it stopped 0.23 m from the other's middle, and a
    yaw stick that was held (`insists`) carried it through the other.
    """
    tank = FaultyTank([(i, 0, 0) for i in range(10)], Parameters().replace("steering.rate_rad_s", rate_rad_s), each=9)
    bearing = math.radians(bearing_deg)
    for state, place in zip(tank.states, ((0.0, 0.0), (0.84 * math.cos(bearing), 0.84 * math.sin(bearing))), strict=True):
        state[:7] = [*place, 1.5, *LEVEL]
    tank.run(2.0)
    tank.run(0.5, Request(Action.ARM, 0), Request(Action.ARM, 9))
    round_about = Setpoint(np.array([0.0, 0.0, 1.5]), from_euler(0.0, 0.0, 3.05), ZERO, ZERO, ZERO, ZERO)
    if insists:
        for _ in range(40):
            tank.run(0.1, Request(Action.STICKS, 0, Sticks((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))))
    else:
        tank.run(3.0, Request(Action.HOLD, 0, round_about))
    assert tank.when("fail-safe on: another body is in the way")
    row = tank.bodies[0].r_bm
    gaps_m = [np.linalg.norm(states[0][:3] + world(states[0]).apply(row) - states[1][:3], axis=1).min() for states in tank.past]
    assert min(gaps_m) > TOUCH_M and abs(tank.states[0][12]) < 0.05


@pytest.mark.slow
def test_row_may_be_turned_until_just_before_another() -> None:
    """Its end comes within 5 cm of where the two can touch."""
    tank = FaultyTank([(i, 0, 0) for i in range(10)], Parameters(), each=9)
    for state, place in zip(tank.states, ((0.0, 0.0), (0.42, 0.42 * 3.0**0.5)), strict=True):
        state[:7] = [*place, 1.5, *LEVEL]
    tank.run(2.0)
    tank.run(0.5, Request(Action.ARM, 0), Request(Action.ARM, 9))
    before = from_euler(0.0, 0.0, math.radians(37.0))
    tank.run(4.0, Request(Action.HOLD, 0, Setpoint(np.array([0.0, 0.0, 1.5]), before, ZERO, ZERO, ZERO, ZERO)))
    assert not any("another body" in said for _, said in tank.event_log)
    assert world(tank.states[0]).as_euler("ZYX", degrees=True)[0] == pytest.approx(37.0, abs=1.0)


@pytest.mark.slow
def test_without_the_fail_safe_it_would_fly_into_the_other() -> None:
    tank = two_in_the_water(Parameters().replace("failsafes.collision_action", 0))
    beyond = Setpoint(np.array([2.4, 0.0, 0.8]), LEVEL, ZERO, ZERO, ZERO, ZERO)
    tank.run(8.0, Request(Action.HOLD, 0, beyond))
    assert distances(tank).min() < 0.5 * EDGE_M


@pytest.mark.slow
def test_body_may_be_brought_before_a_face_and_leave_again() -> None:
    tank = two_in_the_water(Parameters())
    before = 1.2 - PITCH_M - Parameters().docking.standoff_m
    for x_m in (before, 0.0):
        tank.run(8.0, Request(Action.HOLD, 0, Setpoint(np.array([x_m, 0.0, 0.8]), LEVEL, ZERO, ZERO, ZERO, ZERO)))
        assert tank.states[0][0] == pytest.approx(x_m, abs=0.01)
    assert not any("another body" in said for _, said in tank.event_log)


@pytest.mark.slow
@pytest.mark.parametrize("gap_m", [0.1, 0.2])
def test_body_at_rest_close_by_does_not_set_out_into_the_other(gap_m: float) -> None:
    tank = two_in_the_water(Parameters())
    tank.run(10.0, Request(Action.HOLD, 0, Setpoint(np.array([1.2 - EDGE_M - gap_m, 0.0, 0.8]), LEVEL, ZERO, ZERO, ZERO, ZERO)))
    before = len(tank.past)
    tank.run(5.0, Request(Action.HOLD, 0, Setpoint(np.array([2.4, 0.0, 0.8]), LEVEL, ZERO, ZERO, ZERO, ZERO)))
    assert distances(tank)[before:].min() > EDGE_M + gap_m - 0.04


@pytest.mark.slow
def test_body_that_surfaces_below_another_says_so() -> None:
    """It pushed against the other from below, and nobody was told."""
    tank = FaultyTank([(0, 0, 0), (1, 0, 0)], Parameters(), apart=True)
    for state, down_m in zip(tank.states, (1.6, 0.8), strict=True):
        state[:7] = [0.0, 0.0, down_m, *from_euler(0.0, 0.0, 0.0)]
    tank.run(2.0)
    tank.run(0.5, Request(Action.ARM, 0), Request(Action.ARM, 1))
    tank.run(7.0, Request(Action.SET_MODE, 0, Mode.SURFACE))
    assert tank.when("fail-safe on: another body is in the way") and tank.outputs[-1].records[0].mode == Mode.SURFACE
