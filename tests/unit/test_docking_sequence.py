"""The docking sequence alone: a dock that begins near ends like any other, and one that is aborted before it sets off moves no body."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.core.docking_sequence import DockingSequence, Stage
from firmware_py.core.rotations import conjugate, difference, from_euler, multiply, rotate, rotate_back, to_matrix
from firmware_py.core.setpoint import REST, Wish
from firmware_py.core.types import NEVER_AGE_NS, RELAY_OFF, RELAY_PULL, RELAY_PUSH, DockRequest
from firmware_py.description.parameters import PAPER, Docking
from firmware_py.description.vehicle import FACE_NORMALS
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import PITCH_M, assemble
from firmware_py.prepare.docking import plan_dock
from tests.unit.dock_follower import DRIFT, NEITHER, STAGED, TICK_NS, TILTED, Follower, estimate, face_of


def begin(parameters: Docking, gap_m: float, target_approaches: bool = True) -> tuple[DockingSequence, np.ndarray, np.ndarray]:
    """Returns a sequence and the positions of target and active body, `gap_m` apart along the target's +x."""
    target, active = (assemble([(0, 0, 0)], [0], [load_vehicle("modcube")], [m]) for m in (0, 1))
    plan = plan_dock(DockRequest(1, 1, 0, 0), active, target, [load_vehicle("modcube")] * 2)
    sequence = DockingSequence(plan, active, target, parameters, 0, target_approaches)
    place = target.r_bm[0] + plan.place_t - active.r_bm[0]
    return sequence, np.zeros(3), place + np.array([gap_m, 0.0, 0.0])


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
@pytest.mark.parametrize(("target_face", "face", "target_turn"), [(0, 1, 0), (4, 5, 7), (2, 1, 18)])
def test_quarter_turns_are_counted_about_the_targets_face_outwards(
    quarter_turns: int, target_face: int, face: int, target_turn: int
) -> None:
    """Counted from the smallest rotation that brings the active face onto the target's: none for opposite faces, else the shortest way."""
    vehicles = [load_vehicle("modcube")] * 2
    target, active = assemble([(0, 0, 0)], [target_turn], vehicles[:1], [0]), assemble([(0, 0, 0)], [4], vehicles[:1], [1])
    plan = plan_dock(DockRequest(1, face, 0, target_face, quarter_turns), active, target, vehicles)
    outward, looks = (np.array(FACE_NORMALS[f], dtype=float) for f in (target_face, face))
    least = Rotation.from_rotvec(0.5 * np.pi * np.cross(looks, -outward))
    wanted = Rotation.from_rotvec(0.5 * np.pi * quarter_turns * outward) * least
    np.testing.assert_allclose(wanted.apply(looks), -outward, atol=1e-12)
    np.testing.assert_allclose(to_matrix(plan.q_ta), wanted.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(plan.axis_t, outward)
    q_t, q_a = (Rotation.from_quat(q[[1, 2, 3, 0]]) for q in plan.merged.q_bm)
    np.testing.assert_allclose((q_t.inv() * q_a).as_matrix(), wanted.as_matrix(), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("gap_m", [0.02, 0.12, 0.2, 0.6])
@pytest.mark.parametrize("parameters", [Docking(), PAPER.docking])
def test_dock_that_fails_ends_apart_however_near_it_began(parameters: Docking, gap_m: float) -> None:
    sequence, p_t, p_a = begin(parameters, gap_m, target_approaches=False)
    for tick in range(1, 40_000):
        steering = sequence.step(tick * TICK_NS, estimate(p_a), estimate(p_t), NEITHER)
        if sequence.stage in (Stage.FAILED, Stage.ABORTED) and steering.is_apart:
            break
        p_a = steering.active.p_wb
    assert sequence.stage in (Stage.FAILED, Stage.ABORTED)
    assert steering.is_apart and steering.relay == RELAY_OFF
    ends_m = sequence.errors(estimate(steering.active.p_wb), estimate(p_t)).gap_m
    assert ends_m == pytest.approx(parameters.standoff_m, abs=0.0005)


@pytest.mark.parametrize("approach", ["staged", "straight"])
def test_target_comes_half_of_the_way_and_is_told_once(approach: str) -> None:
    sequence, p_t, p_a = begin(Docking(approach=approach), 0.5)
    told = [sequence.step(tick * TICK_NS, estimate(p_a), estimate(p_t), NEITHER).meets for tick in (1, 2)]
    left = Docking().standoff_m if approach == "staged" else 0.0
    np.testing.assert_allclose(told[0], [0.5 * (0.5 - left), 0.0, 0.0], atol=1e-12)
    assert told[1] is None


def test_target_that_is_not_free_is_not_moved_and_the_line_goes_all_the_way() -> None:
    sequence, p_t, p_a = begin(PAPER.docking, 0.5, target_approaches=False)
    steering = sequence.step(TICK_NS, estimate(p_a), estimate(p_t), NEITHER)
    assert steering.meets is None
    for tick in range(2, 3000):
        steering = sequence.step(tick * TICK_NS, estimate(p_a), estimate(p_t), NEITHER)
        p_a = steering.active.p_wb
        if sequence.stage == Stage.PUSH:
            break
    assert sequence.errors(estimate(p_a), estimate(p_t)).gap_m == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("parameters", [Docking(), Docking(approach="straight")], ids=["staged", "straight"])
def test_dock_between_places_that_are_not_known_well_enough_waits_for_a_second_and_moves_nobody(parameters: Docking) -> None:
    sequence, p_t, p_a = begin(parameters, 0.5)
    for tick in range(1, 101):
        steering = sequence.step(tick * TICK_NS, estimate(p_a, sigma_m=0.02), estimate(p_t), NEITHER)
        assert (sequence.stage, steering.active, steering.meets) == (Stage.PRE_APPROACH, REST, None)
    steering = sequence.step(101 * TICK_NS, estimate(p_a, sigma_m=0.02), estimate(p_t), NEITHER)
    assert sequence.stage == Stage.ABORTED and sequence.reason.startswith("relative sigma")
    assert steering.meets is None


@pytest.mark.parametrize("parameters", [Docking(), Docking(approach="straight")], ids=["staged", "straight"])
def test_dock_sets_off_once_both_places_are_known_well_enough(parameters: Docking) -> None:
    sequence, p_t, p_a = begin(parameters, 0.5)
    sequence.step(TICK_NS, estimate(p_a, sigma_m=0.02), estimate(p_t + 0.1), NEITHER)
    left = Docking().standoff_m if parameters.approach == "staged" else 0.0
    meets = sequence.step(2 * TICK_NS, estimate(p_a), estimate(p_t), NEITHER).meets
    np.testing.assert_allclose(meets, [0.5 * (0.5 - left), 0.0, 0.0], atol=1e-12)
    steering = sequence.step(3 * TICK_NS, estimate(p_a, sigma_m=0.02), estimate(p_t), NEITHER)
    rests = sequence.stage == Stage.PRE_APPROACH and steering.active == REST
    assert rests if parameters.approach == "staged" else sequence.stage == Stage.ABORTED


# ---------------------------------------------------------------- the way to the stand-off


def test_body_that_is_turned_is_turned_before_it_is_aligned() -> None:
    sequence, p_t, p_a = begin(Docking(), Docking().standoff_m)
    turned = estimate(p_a)._replace(q_wb=from_euler(0.0, 0.0, 1.5))
    for tick in range(1, 100):
        steering = sequence.step(tick * TICK_NS, turned, estimate(p_t), NEITHER)
    assert sequence.stage == Stage.PRE_APPROACH and isinstance(steering.active, Wish)
    sequence.step(100 * TICK_NS, estimate(p_a), estimate(p_t), NEITHER)
    assert sequence.stage == Stage.ALIGN


@pytest.mark.parametrize("off", [(0.025, 0.0, 0.0), (-0.025, 0.0, 0.0), (0.0, 0.025, 0.0)])
def test_body_that_is_off_its_stand_off_is_brought_there_before_it_is_aligned(off: tuple[float, ...]) -> None:
    sequence, p_t, p_a = begin(Docking(), Docking().standoff_m)
    for tick in range(1, 10):
        sequence.step(tick * TICK_NS, estimate(p_a + np.array(off)), estimate(p_t), NEITHER)
    assert sequence.stage == Stage.PRE_APPROACH
    sequence.step(10 * TICK_NS, estimate(p_a), estimate(p_t), NEITHER)
    assert sequence.stage == Stage.ALIGN


# ---------------------------------------------------------------- bodies of several modules, in any attitude


def test_pair_is_led_so_that_its_module_stands_before_the_face_of_a_tilted_pair() -> None:
    dock = Follower(nu=DRIFT)
    dock.until(Stage.PUSH)
    steering = dock.step()
    mine, inward = face_of(dock.active, 3, 3, dock.at)
    np.testing.assert_allclose(inward, -dock.outward, atol=1e-9)
    np.testing.assert_allclose(mine, dock.face, atol=0.001)
    np.testing.assert_allclose(np.cross(mine - dock.face, dock.outward), 0.0, atol=1e-9)
    turn, merged = (
        multiply(conjugate(np.ascontiguousarray(a)), np.ascontiguousarray(b))
        for a, b in (
            (multiply(TILTED, dock.target.q_bm[1].copy()), multiply(dock.at.q_wb, dock.active.q_bm[1].copy())),
            (dock.plan.merged.q_bm[1], dock.plan.merged.q_bm[3]),
        )
    )
    assert np.linalg.norm(difference(turn, merged)) < 1e-6
    np.testing.assert_allclose(steering.active.v_w, rotate(TILTED, DRIFT[:3]) - STAGED.contact_speed_m_s * dock.outward, atol=1e-9)


@pytest.mark.parametrize("approach", ["staged", "straight"])
def test_tilted_target_comes_half_of_the_way_in_the_world(approach: str) -> None:
    dock = Follower(Docking(approach=approach), DRIFT, target_approaches=True)
    dock.astray(sideways_m=0.1)
    centre = dock.face - 0.5 * PITCH_M * dock.outward
    r_a = dock.active.r_bm[1].copy()
    way = dock.at.p_wb + rotate(dock.at.q_wb, r_a) - centre - PITCH_M * dock.outward
    before = dock.at.p_wb + rotate(dock.at.q_wb, r_a)
    steering = dock.step()
    if approach == "straight":
        assert np.linalg.norm(dock.at.p_wb + rotate(dock.at.q_wb, r_a) - before) < 0.001, "it begins where it is"
        assert np.linalg.norm(steering.active.v_w) == pytest.approx(STAGED.speed_m_s), "however long the line is"
    left = STAGED.standoff_m if approach == "staged" else 0.0
    np.testing.assert_allclose(steering.meets, 0.5 * (way - left * dock.outward), atol=1e-9)
    np.testing.assert_array_equal(dock.sequence.meets_at_w, dock.there.p_wb + steering.meets)
    if approach == "straight":  # it meets the target where the target comes to rest
        dock.until(Stage.PUSH)
        np.testing.assert_allclose(dock.at.p_wb + rotate(dock.at.q_wb, r_a), centre + PITCH_M * dock.outward + steering.meets, atol=0.002)
        np.testing.assert_allclose(dock.step().active.v_w, -STAGED.contact_speed_m_s * dock.outward, atol=1e-9)


@pytest.mark.parametrize(("sideways_m", "turned_rad"), [(0.005, 0.0), (0.0, 0.04)])
def test_alignment_must_be_good_for_a_whole_second_in_place_and_attitude(sideways_m: float, turned_rad: float) -> None:
    dock = Follower()
    dock.until(Stage.ALIGN)
    for _ in range(90):
        np.testing.assert_allclose(dock.step().active.v_w, 0.0, atol=1e-12)
    dock.astray(sideways_m, turned_rad)
    dock.step()
    for _ in range(95):
        dock.step()
    assert dock.sequence.stage == Stage.ALIGN, "the second begins anew"
    for _ in range(8):
        dock.step()
    assert dock.sequence.stage == Stage.APPROACH


def test_jam_that_a_camera_too_slow_makes_is_told_by_the_parameter_that_helps() -> None:
    dock = Follower(Docking(tries=1))
    dock.until(Stage.FAILED, NEITHER._replace(current=True, position_error_m=math.nan, spread_m=math.nan))
    assert dock.sequence.reason == (
        "jam: current alone after VERIFY, pictures of both are too few or older than 300 ms (DOCK_POSE_AGE), 1 try"
    )


@pytest.mark.slow
def test_approach_that_waits_to_the_end_of_its_time_is_no_jam_and_is_over() -> None:
    """It used to count as a jam: the magnets pushed at whatever stood there, and the dock was tried again."""
    dock = Follower(Docking(timeout_s=20.0))
    dock.until(Stage.APPROACH)
    while dock.sequence.stage == Stage.APPROACH:
        dock.step(waits=REST)
    assert dock.sequence.stage == Stage.ABORTED and dock.step().relay == RELAY_OFF
    assert dock.sequence.reason == "APPROACH took longer than 20 s, waiting for another body"


@pytest.mark.slow
@pytest.mark.parametrize(("approach", "waiting"), [("staged", Stage.APPROACH), ("straight", Stage.PRE_APPROACH)])
def test_time_that_an_approach_waited_is_not_taken_from_what_it_has_to_dock(approach: str, waiting: Stage) -> None:
    """An approach that waited 19 of 20 s used to count as a jam before it arrived, and let go with pushing magnets."""
    dock = Follower(Docking(timeout_s=20.0, approach=approach))
    while dock.sequence.stage != waiting:
        dock.step()
    at = dock.at
    for _ in range(1900):
        dock.step(waits=REST)
        dock.at = at
    dock.until(Stage.PUSH)
    assert dock.sequence.tries == 1


def test_approach_that_is_to_make_room_goes_back_and_begins_anew() -> None:
    dock = Follower()
    dock.until(Stage.APPROACH)
    for _ in range(100):
        dock.step()
    room = REST._replace(p_wb=dock.at.p_wb + 0.5 * dock.outward, q_wb=dock.at.q_wb)
    steering = dock.step(waits=room)
    assert dock.sequence.stage == Stage.PRE_APPROACH and steering.active is room and steering.relay == RELAY_OFF
    dock.until(Stage.PUSH)


@pytest.mark.slow
@pytest.mark.parametrize("approach", ["staged", "straight"])
def test_who_waits_or_makes_room_at_its_stand_off_does_not_go_on_from_there(approach: str) -> None:
    """It used to align, where nothing waits: it came before the face, made room again, and so on endlessly; or drew its line too early."""
    ready, dock = Follower(), Follower(Docking(approach=approach))
    ready.until(Stage.APPROACH)
    dock.at = ready.at
    for wish in (REST, REST._replace(p_wb=dock.at.p_wb + 0.5 * dock.outward, q_wb=dock.at.q_wb)):
        steering = dock.step(waits=wish)
        dock.at = ready.at
        assert dock.sequence.stage == Stage.PRE_APPROACH and steering.active is wish
    dock.until(Stage.PUSH)


@pytest.mark.slow
def test_straight_approach_that_is_to_make_room_goes_back_on_its_line_as_far_as_it_came() -> None:
    dock, came = Follower(Docking(approach="straight")), list[np.ndarray]()
    for _ in range(300):
        came.append(dock.step().active.p_wb)
    room = REST._replace(p_wb=came[0], q_wb=dock.at.q_wb)
    for _ in range(1500):
        steering = dock.step(waits=room)
    assert dock.sequence.stage == Stage.APPROACH and not steering.active.v_w.any()
    np.testing.assert_allclose(dock.at.p_wb, came[0], atol=0.001)


def test_approach_slows_down_to_the_speed_of_contact() -> None:
    dock, speeds = Follower(), {}
    dock.until(Stage.APPROACH)
    while dock.sequence.stage == Stage.APPROACH:
        gap_mm = round(dock.sequence._gap_m * 1000)
        speeds[gap_mm] = -float(dock.step().active.v_w @ dock.outward)
    assert speeds[110] == pytest.approx(STAGED.speed_m_s)
    assert speeds[50] == pytest.approx(0.025, abs=0.0005)
    assert speeds[10] == speeds[1] == pytest.approx(STAGED.contact_speed_m_s)


@pytest.mark.parametrize(("sideways_m", "turned_rad"), [(0.0, 0.0), (0.0065, 0.0), (0.0, 0.055)])
def test_approach_waits_for_a_body_that_is_off_the_cone(sideways_m: float, turned_rad: float) -> None:
    dock = Follower()
    dock.until(Stage.APPROACH)
    before = dock.sequence._gap_m
    for _ in range(50):
        dock.astray(sideways_m, turned_rad)
        steering = dock.step()
        assert steering.relay == RELAY_PULL
    waits = sideways_m > 0.0 or turned_rad > 0.0
    assert (dock.sequence._gap_m == before) == waits
    if not waits:
        assert before - dock.sequence._gap_m == pytest.approx(0.5 * STAGED.speed_m_s, abs=0.001)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("condition", "words"), [("current", "current alone"), ("position", "position alone"), (None, "neither condition")]
)
def test_jam_lets_go_backs_off_turns_a_little_and_is_tried_again_to_the_other_side(condition: str | None, words: str) -> None:
    status = NEITHER if condition is None else NEITHER._replace(**{condition: True})
    dock, turns = Follower(Docking(tries=3)), []
    straight = dock.until(Stage.ALIGN).active.q_wb
    for number in (1, 2, 3):
        assert dock.sequence.tries == number
        aligned = dock.tick
        dock.until(Stage.APPROACH, status)
        assert (dock.tick - aligned) * 0.01 == pytest.approx(STAGED.align_s, abs=0.02), "each time anew"
        assert dock.sequence._gap_m == pytest.approx(STAGED.standoff_m, abs=0.001)
        dock.until(Stage.PUSH, status)
        turns.append(float(np.dot(difference(dock.at.q_wb, straight), rotate_back(straight, dock.outward))))
        if condition is not None:
            dock.until(Stage.VERIFY, status)
        if number == 3:
            break
        began = dock.tick
        assert dock.until(Stage.RELEASE, status).relay == RELAY_PUSH
        assert (dock.tick - began) * 0.01 == pytest.approx(STAGED.push_s, abs=0.02)
        assert dock.sequence.reason == f"jam: {words} after {'PUSH' if condition is None else 'VERIFY'}"
        released = dock.tick
        assert np.linalg.norm(difference(dock.at.q_wb, straight)) == pytest.approx(0.0, abs=1e-9)
        assert dock.until(Stage.BACK_OFF, status).relay == RELAY_OFF
        assert (dock.tick - released) * 0.01 == pytest.approx(STAGED.release_s, abs=0.02)
        assert dock.until(Stage.ALIGN, status).relay == RELAY_OFF
        assert dock.sequence._gap_m > STAGED.standoff_m - 5.1 * STAGED.align_m
    np.testing.assert_allclose(turns, [0.0, 0.03, -0.03], atol=1e-6)
    dock.until(Stage.FAILED, status)
    assert dock.sequence.reason.endswith(", 3 tries")
    assert dock.step().relay == RELAY_OFF


@pytest.mark.slow
def test_module_that_does_not_get_away_stays_in_back_off_until_its_time_is_over() -> None:
    dock = Follower(Docking(tries=2, timeout_s=20.0))
    dock.until(Stage.BACK_OFF)
    stuck = dock.at
    for _ in range(1900):
        dock.at = stuck
        assert dock.step().relay == RELAY_OFF
    assert dock.sequence.stage == Stage.BACK_OFF
    for _ in range(120):
        dock.at = stuck
        dock.step()
    assert dock.sequence.stage == Stage.ABORTED
    assert dock.sequence.reason == "BACK_OFF took longer than 20 s"


@pytest.mark.slow
def test_module_backs_off_slowly_as_far_as_the_stand_off() -> None:
    dock, gaps = Follower(), list[float]()
    dock.until(Stage.BACK_OFF)
    while dock.sequence.stage == Stage.BACK_OFF:
        steering = dock.step()
        np.testing.assert_allclose(steering.active.v_w, 0.04 * dock.outward, atol=1e-9)
        gaps.append(dock.sequence.errors(dock.at, dock.there).gap_m)
    np.testing.assert_allclose(np.diff(gaps), 0.0004, atol=1e-9)
    for _ in range(80):
        steering = dock.step()
    np.testing.assert_allclose(steering.active.v_w, 0.0, atol=1e-12)
    assert dock.sequence.errors(dock.at, dock.there).gap_m == pytest.approx(STAGED.standoff_m, abs=1e-9)


@pytest.mark.slow
def test_faces_that_are_still_near_while_they_push_apart_are_no_dock() -> None:
    dock = Follower()
    dock.until(Stage.RELEASE)
    both = NEITHER._replace(current=True, position=True)
    assert dock.step(both).relay == RELAY_PUSH
    dock.until(Stage.BACK_OFF, both)
    dock.until(Stage.APPROACH)
    dock.step(both)
    assert dock.sequence.stage == Stage.DOCKED


@pytest.mark.slow
@pytest.mark.parametrize("side", ["active", "target"])
def test_dock_needs_both_places_known_but_backs_off_blindly(side: str) -> None:
    dock = Follower()
    dock.until(Stage.RELEASE)
    dock.at, dock.there = (
        body._replace(sigma_p=np.array([0.001, 0.006, 0.001])) if who == side else body
        for who, body in (("active", dock.at), ("target", dock.there))
    )
    dock.step()
    assert dock.sequence.stage == Stage.RELEASE
    dock.until(Stage.ALIGN)
    dock.step()
    assert dock.sequence.stage == Stage.ABORTED
    assert dock.sequence.reason == "relative sigma 6.1 mm, 5.0 permitted"


def test_dock_to_a_body_that_no_camera_has_seen_is_ended_in_words() -> None:
    dock = Follower()
    dock.there = estimate(dock.there.p_wb, 1e3)._replace(tag_age_ns=NEVER_AGE_NS)
    dock.step()
    assert dock.sequence.reason == "no tag has told yet where one of the two bodies is"


def test_push_of_no_time_is_a_jam_at_once() -> None:
    dock = Follower(Docking(push_s=0.0, tries=1))
    dock.until(Stage.PUSH)
    began = dock.tick
    dock.until(Stage.FAILED)
    assert dock.tick - began <= 1
    assert dock.sequence.reason == "jam: neither condition after PUSH, 1 try"


@pytest.mark.slow
def test_push_goes_no_farther_than_it_may() -> None:
    dock = Follower(Docking(push_s=10.0))
    dock.until(Stage.PUSH)
    gaps = []
    for _ in range(500):
        steering = dock.step()
        gaps.append(dock.sequence.errors(dock.at, dock.there).gap_m)
    assert min(gaps) == pytest.approx(-STAGED.push_m, abs=1e-6)
    np.testing.assert_allclose(steering.active.v_w, 0.0, atol=1e-12)
