"""Guidance: what each mode makes of sticks, set-points and trajectories, and that no change of mode jumps."""

import itertools
import math

import numpy as np
import pytest

from firmware_py.core.guidance_modes import Guidance
from firmware_py.core.health import Health
from firmware_py.core.rotations import difference, from_euler, heading, rotate, to_matrix
from firmware_py.core.setpoint import LEASH_M, rest_at
from firmware_py.core.supervisor import Decision
from firmware_py.core.transitions import Effect, Trigger
from firmware_py.core.types import Estimate, Mode, Setpoint, Sticks
from firmware_py.description.parameters import Parameters, registry
from firmware_py.description.vehicle import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle
from tests.unit.healths import BLIND, GOOD, UPRIGHT

BODY = assemble_vehicle(load_vehicle("modcube"))
ZERO = np.zeros(3)
TICK = 10_000_000
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
WRENCH = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
FLOWN = [Mode.MANUAL, Mode.STABILIZE, Mode.ALT_HOLD, Mode.POSHOLD, Mode.AUTO, Mode.GUIDED, Mode.SURFACE, Mode.DOCK]


def estimate(p: tuple[float, ...] = (0.0, 0.0, 1.0), q: np.ndarray | None = None, nu: tuple[float, ...] = (0.0,) * 6) -> Estimate:
    level = np.array([1.0, 0.0, 0.0, 0.0]) if q is None else q
    return Estimate(
        np.array(p), level, np.array(nu), ZERO, ZERO, np.full(3, 0.002), np.full(3, 0.002), 20_000_000, 1.0, 0, 0, True
    )


class Flight:
    """Guidance over ticks, with a body that does what it is told."""

    def __init__(self, parameters: Parameters | None = None) -> None:
        self.guidance = Guidance(BODY, parameters or Parameters())
        self.time_ns = 0
        self.estimate = estimate()
        self.guidance.rest(self.estimate)
        self.setpoints: list[Setpoint] = []
        self.wrenches: list[np.ndarray] = []

    def do(self, effect: Effect, mode: Mode = Mode.POSHOLD, argument: object = None) -> None:
        self.guidance.apply(Decision(Trigger.SET_MODE, effect, mode, argument), self.time_ns, self.estimate)

    def run(self, seconds: float, sticks: Sticks | None = None, health: Health = GOOD, follows: bool = True) -> Setpoint:
        for _ in range(round(seconds / 0.01)):
            self.time_ns += TICK
            if sticks is not None:
                self.do(Effect.TAKE_STICKS, self.guidance.mode, sticks)
            self.guidance.look(self.estimate, health)
            now, _ = self.guidance.step(self.time_ns, self.estimate, health)
            self.setpoints.append(now)
            self.wrenches.append(self.guidance.mix(WRENCH, self.time_ns, self.estimate, health))
            if follows:
                self.estimate = self.estimate._replace(p_wb=now.p_wb, q_wb=now.q_wb)
        return self.setpoints[-1]


class Ramp:
    """One metre north in ten seconds, from where it is told."""

    duration_s = 10.0

    def __init__(self, start: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> None:
        self.start = np.array(start)

    def sample(self, t_s: float) -> Setpoint:
        inside = 0.0 < t_s < self.duration_s
        way = 0.1 * min(max(t_s, 0.0), self.duration_s)
        v = np.array([0.1 if inside else 0.0, 0.0, 0.0])
        return Setpoint(np.add(self.start, [way, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]), v, ZERO, ZERO, ZERO)


def sticks(forward: float = 0.0, right: float = 0.0, down: float = 0.0, yaw: float = 0.0) -> Sticks:
    return Sticks((forward, right, down), (0.0, 0.0, yaw))


@pytest.mark.parametrize("modes", list(itertools.product(FLOWN, FLOWN)), ids=lambda pair: "-".join(m.name for m in pair))
def test_no_change_of_mode_jumps(modes: tuple[Mode, Mode]) -> None:
    """Neither the set-point nor the wrench, with sticks held over and a body that moves."""
    flight = Flight()
    for mode in modes:
        flight.do(Effect.ENTER_MODE, mode)
        flight.run(1.0, sticks(0.5, -0.3, 0.4, 0.2))
    steps = np.abs(np.diff(np.array(flight.wrenches[1:]), axis=0))
    assert steps[:, :3].max() < 1.5 and steps[:, 3:].max() < 0.12, "N, N m a tick: the blend's slope"
    places = np.abs(np.diff(np.array([s.p_wb for s in flight.setpoints]), axis=0))
    assert places.max() < 0.01


def test_armed_robot_starts_from_no_wrench() -> None:
    flight = Flight()
    flight.guidance.rest(flight.estimate)
    flight.do(Effect.ENTER_MODE)
    flight.run(0.01)
    np.testing.assert_allclose(flight.wrenches[-1], 0.0, atol=1e-12)
    flight.run(0.5)
    np.testing.assert_allclose(flight.wrenches[-1], WRENCH)


def test_manual_sticks_are_forces_and_moments_of_the_body() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.MANUAL)
    flight.run(0.5, Sticks((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
    wrench = flight.wrenches[-1]
    assert wrench[0] > 5.0 and wrench[5] < -0.3 and not np.any(wrench[1:5])
    flight.run(1.0)
    assert not flight.wrenches[-1].any(), "sticks that fell silent are neutral"


@pytest.mark.parametrize("axis", range(6))
def test_full_stick_is_a_share_of_what_all_thrusters_can_do_along_its_axis(axis: int) -> None:
    flight, held, t = Flight(), np.zeros(6), BODY.thrusters
    held[axis] = 1.0
    flight.do(Effect.ENTER_MODE, Mode.MANUAL)
    flight.run(2.0, Sticks(tuple(held[:3]), tuple(held[3:])), follows=False)
    there, back = (np.where(t.matrix[axis] * sign > 0.0, t.f_max, -t.f_min) for sign in (1.0, -1.0))
    most = 0.5 * np.abs(t.matrix[axis]) @ (there + back)
    np.testing.assert_allclose(flight.wrenches[-1], Parameters().steering.stick_share * most * held, atol=1e-9)


def test_stabilize_keeps_the_controllers_moment() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.STABILIZE)
    flight.run(0.5, sticks(0.5))
    np.testing.assert_allclose(flight.wrenches[-1][3:], WRENCH[3:])
    assert flight.wrenches[-1][0] > 2.0 and flight.wrenches[-1][2] == 0.0


@pytest.mark.parametrize("pitch", [0.0, 0.7, np.pi / 2, -np.pi / 2])
def test_depth_hold_keeps_the_vertical_force_in_every_attitude(pitch: float) -> None:
    flight = Flight()
    flight.estimate = estimate(q=from_euler(0.0, pitch, 0.5))
    flight.guidance.rest(flight.estimate)
    flight.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    flight.run(0.5, sticks(1.0), follows=False)
    force_w = rotate(flight.estimate.q_wb, flight.wrenches[-1][:3].copy())
    wanted_w = rotate(flight.estimate.q_wb, WRENCH[:3].copy())
    assert force_w[2] == pytest.approx(wanted_w[2])
    np.testing.assert_allclose(force_w[1] / force_w[0], np.tan(0.5), atol=1e-6)
    assert force_w[0] > 2.0, "forward is where it looks"


def test_depth_hold_climbs_and_drifts_freely() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    flight.run(2.0, sticks(down=-1.0))
    assert flight.setpoints[-1].p_wb[2] < 0.6
    flight.estimate = flight.estimate._replace(p_wb=np.array([3.0, -2.0, 0.9]))
    now = flight.run(0.01, follows=False)
    np.testing.assert_array_equal(now.p_wb[:2], [3.0, -2.0])
    assert now.p_wb[2] < 0.6


def test_sticks_move_the_held_place_and_leave_it_there() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE)
    flight.run(2.0, sticks(forward=1.0))
    assert flight.setpoints[-1].v_w[0] == pytest.approx(0.3, abs=1e-3)
    flight.run(2.5)
    there = flight.setpoints[-1]
    assert np.abs(there.v_w).max() < 1e-4
    np.testing.assert_allclose(flight.run(1.0).p_wb, there.p_wb, atol=1e-4)


def test_robot_glides_to_a_place_that_it_is_to_hold() -> None:
    flight = Flight()
    flight.do(Effect.HOLD_AT, Mode.POSHOLD, rest_at(np.array([1.0, 0.5, 2.0]), from_euler(0.0, 0.0, 1.0)))
    now = flight.run(15.0)
    np.testing.assert_allclose(now.p_wb, [1.0, 0.5, 2.0], atol=1e-3)
    assert np.linalg.norm(difference(now.q_wb, from_euler(0.0, 0.0, 1.0))) < 1e-3
    flight.run(0.2, sticks(right=1.0))
    assert flight.run(3.0).p_wb[1] > 0.52, "sticks take it away"


def test_held_place_stays_within_the_fence() -> None:
    flight = Flight(Parameters().replace("fence.north_m", 0.5))
    flight.do(Effect.HOLD_AT, Mode.POSHOLD, rest_at(np.array([3.0, 0.0, 1.0]), estimate().q_wb))
    assert flight.run(15.0).p_wb[0] == pytest.approx(0.5, abs=1e-3)
    flight.do(Effect.ENTER_MODE)
    assert flight.run(15.0, sticks(forward=1.0)).p_wb[0] < 0.6


def test_robot_beyond_the_fence_can_be_steered_back_and_no_farther() -> None:
    flight = Flight(Parameters().replace("fence.north_m", 0.5))
    flight.estimate = estimate((0.9, 0.0, 1.0))
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    assert flight.run(3.0, sticks(forward=1.0)).p_wb[0] == pytest.approx(0.9, abs=1e-3)
    assert flight.run(6.0, sticks(forward=-1.0)).p_wb[0] < 0.5


def test_fence_and_speeds_may_change_in_flight() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    before = flight.run(1.0, sticks(forward=1.0))
    flight.guidance.retune(Parameters().replace("fence.north_m", 0.5).replace("steering.speed_m_s", 0.05))
    after = flight.run(DT := 0.01, sticks(forward=1.0))
    assert np.linalg.norm(after.p_wb - before.p_wb) < 1.5 * DT * np.linalg.norm(before.v_w), "nothing jumps"
    assert flight.run(3.0, sticks(forward=1.0)).v_w[0] < 0.0501
    assert flight.run(20.0, sticks(forward=1.0)).p_wb[0] < 0.55


def test_trajectory_is_sampled_now_and_a_thruster_lag_ahead() -> None:
    flight = Flight()
    flight.do(Effect.FOLLOW, Mode.AUTO, Ramp())
    flight.run(0.01)
    began = flight.time_ns
    flight.run(2.0)
    t = (flight.time_ns - began) * 1e-9
    assert flight.setpoints[-1].p_wb[0] == pytest.approx(0.1 * t)
    assert not flight.guidance.finished(flight.time_ns)
    flight.run(9.0)
    assert flight.guidance.finished(flight.time_ns) and flight.setpoints[-1].p_wb[0] == pytest.approx(1.0)


def test_trajectory_that_begins_elsewhere_is_approached_first() -> None:
    flight = Flight()
    flight.do(Effect.FOLLOW, Mode.AUTO, Ramp((0.0, 1.0, 1.0)))
    flight.run(1.0)
    assert flight.setpoints[-1].p_wb[0] == 0.0 and 0.0 < flight.setpoints[-1].p_wb[1] < 0.5
    assert not flight.guidance.finished(flight.time_ns)
    flight.run(20.0)
    np.testing.assert_allclose(flight.setpoints[-1].p_wb, [1.0, 1.0, 1.0], atol=1e-6)


@pytest.mark.parametrize("name", ["steering.join_m", "steering.join_rad"])
def test_trajectory_begins_however_exactly_its_start_is_to_be_met(name: str) -> None:
    flight = Flight(Parameters().replace(name, dict(registry())[name].low))
    flight.estimate = estimate((0.0, 0.1, 1.0), from_euler(0.0, 0.0, 0.3))
    flight.guidance.rest(flight.estimate)
    flight.do(Effect.FOLLOW, Mode.AUTO, Ramp())
    flight.run(20.0)
    assert flight.guidance.finished(flight.time_ns)


def test_stopped_mission_comes_to_rest_smoothly() -> None:
    flight = Flight()
    flight.do(Effect.FOLLOW, Mode.AUTO, Ramp())
    flight.run(3.0)
    flight.do(Effect.ENTER_MODE)
    flight.run(2.0)
    assert 0.3 < flight.setpoints[-1].p_wb[0] < 0.36 and np.abs(flight.setpoints[-1].v_w).max() < 1e-3


def test_streamed_points_are_followed_and_a_stream_that_ends_stops_the_robot() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.GUIDED)
    for _ in range(40):
        nan = np.full(3, np.nan)
        flight.do(Effect.TAKE_POINT, Mode.GUIDED, Setpoint(nan, np.full(4, np.nan), np.array([0.2, 0.0, 0.0]), ZERO, ZERO, ZERO))
        flight.run(0.1)
    assert flight.setpoints[-1].v_w[0] == pytest.approx(0.2, abs=1e-3)
    flight.run(2.5)
    assert np.abs(flight.setpoints[-1].v_w).max() < 1e-3


def test_speed_that_the_body_cannot_make_leads_no_set_point_away_that_it_would_run_after() -> None:
    """Somebody holds it, or 8 m/s were asked for: when the speed ends, so does the motion."""
    flight, nan = Flight(), np.full(3, np.nan)
    flight.do(Effect.ENTER_MODE, Mode.GUIDED)
    for _ in range(50):
        flight.do(Effect.TAKE_POINT, Mode.GUIDED, Setpoint(nan, np.full(4, np.nan), np.array([8.0, 0.0, 0.0]), ZERO, ZERO, ZERO))
        flight.run(0.1, follows=False)
    assert np.abs(flight.setpoints[-1].p_wb - flight.estimate.p_wb).max() < LEASH_M + 0.1
    flight.run(4.0, follows=False)
    assert flight.setpoints[-1].p_wb[0] < LEASH_M + 0.1 and np.abs(flight.setpoints[-1].v_w).max() < 1e-3


@pytest.mark.parametrize("mode", [Mode.ALT_HOLD, Mode.POSHOLD])
def test_sticks_lead_no_set_point_away_from_a_robot_that_lies_on_the_ground(mode: Mode) -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, mode)
    flight.run(20.0, sticks(down=1.0), follows=False)
    assert flight.setpoints[-1].p_wb[2] < flight.estimate.p_wb[2] + LEASH_M + 0.15
    flight.run(0.1, sticks(), follows=False)
    assert flight.setpoints[-1].p_wb[2] == pytest.approx(flight.estimate.p_wb[2]), "let go, it presses no more"
    assert flight.run(0.5, sticks(down=-1.0), follows=False).p_wb[2] < flight.estimate.p_wb[2], "and it comes off as soon as it is asked to"


@pytest.mark.parametrize("mode", [Mode.STABILIZE, Mode.ALT_HOLD, Mode.POSHOLD, Mode.GUIDED])
def test_robot_that_is_held_is_turned_the_way_it_was_asked_to_and_never_back(mode: Mode) -> None:
    flight, nan = Flight(), np.full(3, np.nan)
    flight.do(Effect.ENTER_MODE, mode)
    for _ in range(150):
        flight.do(Effect.TAKE_POINT, mode, Setpoint(nan, np.full(4, np.nan), nan, np.array([0.0, 0.0, 0.6]), ZERO, ZERO))
        flight.run(0.1, sticks(yaw=1.0), follows=False)
        assert difference(flight.setpoints[-1].q_wb, flight.estimate.q_wb)[2] > 0.0


def test_robot_that_is_pushed_off_its_place_comes_back_to_it() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    flight.estimate = estimate((3.0, 0.0, 1.0))
    assert np.abs(flight.run(1.0, sticks(), follows=False).p_wb[0]) < 1e-9


@pytest.mark.parametrize(("silence_s", "north_m"), [(60.0, 0.0), (0.1, 3.0)])
def test_point_of_long_ago_is_no_place_to_go_to_when_the_mode_is_entered(silence_s: float, north_m: float) -> None:
    flight = Flight()
    flight.do(Effect.TAKE_POINT, Mode.GUIDED, rest_at(np.array([3.0, 0.0, 1.0]), estimate().q_wb))
    flight.time_ns += round(silence_s * 1e9)
    flight.do(Effect.ENTER_MODE, Mode.GUIDED)
    assert flight.run(40.0).p_wb[0] == pytest.approx(north_m, abs=0.01)


def test_single_point_is_flown_to_without_a_stream() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.GUIDED)
    flight.run(0.5)
    flight.do(Effect.TAKE_POINT, Mode.GUIDED, rest_at(np.array([0.0, 0.0, 2.0]), estimate().q_wb))
    assert flight.run(15.0).p_wb[2] == pytest.approx(2.0, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [Mode.POSHOLD, Mode.ALT_HOLD])
@pytest.mark.parametrize(
    ("roll", "given", "tilt"),
    [(2.6, None, 0.0), (0.62, None, 0.0), (0.58, None, 0.58), (2.6, Sticks((0.0, 0.0, 0.0), (0.0, 0.0, 0.1)), 2.6)],
    ids=["upside down", "steep", "tilted", "a pilot turns it"],
)
def test_steep_robot_that_a_failsafe_makes_hold_turns_upright_where_it_is(
    mode: Mode, roll: float, given: Sticks | None, tilt: float
) -> None:
    flight = Flight()
    flight.estimate = estimate((1.0, 0.5, 2.0), from_euler(roll, 0.0, 0.3))
    flight.do(Effect.ENTER_LEVEL, mode)
    now = flight.run(15.0, given)
    assert math.acos(to_matrix(now.q_wb)[2, 2]) == pytest.approx(tilt, abs=0.02)
    np.testing.assert_allclose(now.p_wb, [1.0, 0.5, 2.0], atol=0.02)
    steps = [np.linalg.norm(difference(a.q_wb, b.q_wb)) for a, b in itertools.pairwise(flight.setpoints)]
    assert max(steps) <= 1.01 * Parameters().steering.level_rad_s * 0.01


def test_surfacing_robot_rises_levels_and_stays_up() -> None:
    flight = Flight()
    flight.estimate = estimate(q=from_euler(0.4, -0.6, 1.0))
    flight.guidance.rest(flight.estimate)
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    now = flight.run(15.0)
    assert 0.05 < now.p_wb[2] < 0.13 and np.abs(now.v_w).max() < 1e-3
    np.testing.assert_allclose(now.p_wb[:2], 0.0, atol=1e-9)
    assert np.linalg.norm(difference(now.q_wb, heading(now.q_wb))) < 1e-3


def test_surfacing_robot_lifts_blindly_when_it_must() -> None:
    lift = -Parameters().steering.surface_force_n
    for health, expected in (
        (BLIND, [0.0, 0.0, lift, 0.0, 0.0, 0.0]),
        (GOOD._replace(tag_age_s=9.0, depth_age_s=9.0), [0.0, 0.0, lift, *WRENCH[3:]]),
        (GOOD._replace(tag_age_s=9.0), [0.0, 0.0, *WRENCH[2:]]),
        (GOOD, WRENCH),
    ):
        flight = Flight()
        flight.do(Effect.ENTER_MODE, Mode.SURFACE)
        flight.run(0.5, health=health)
        np.testing.assert_allclose(flight.wrenches[-1], expected, atol=1e-12)


@pytest.mark.parametrize("mode", [Mode.STABILIZE, Mode.ALT_HOLD, Mode.SURFACE])
def test_first_tags_move_the_set_point_with_the_world(mode: Mode) -> None:
    """They tell another place and heading: the robot, which is where it was, is not to go back to what it believed before."""
    flight = Flight()
    flight.do(Effect.ENTER_MODE, mode)
    flight.run(2.0, health=UPRIGHT)
    there = flight.estimate = estimate((5.0, -3.0, 1.4), from_euler(0.0, 0.0, 2.5), (0.1, 0.0, 0.0, 0.0, 0.0, 0.2))
    now = flight.run(0.01, follows=False)
    np.testing.assert_allclose(now.p_wb, there.p_wb, atol=0.01)
    assert np.linalg.norm(difference(now.q_wb, there.q_wb)) < 0.01
    assert flight.run(1.0).p_wb[0] < 5.2


def test_what_was_asked_for_in_the_world_before_is_forgotten_and_what_comes_with_the_first_tags_is_not() -> None:
    flight, there = Flight(), estimate((5.0, -3.0, 1.4))
    flight.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    flight.run(1.0, health=UPRIGHT)
    flight.do(Effect.TAKE_POINT, Mode.ALT_HOLD, rest_at(ZERO, LEVEL))
    flight.estimate = there
    flight.guidance.look(there, GOOD)
    flight.do(Effect.HOLD_AT, Mode.POSHOLD, rest_at(np.array([4.0, -3.0, 1.4]), LEVEL))
    assert flight.run(20.0).p_wb[0] == pytest.approx(4.0, abs=0.01)
    other = Flight()
    other.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    other.run(1.0, health=UPRIGHT)
    other.do(Effect.TAKE_POINT, Mode.ALT_HOLD, rest_at(ZERO, LEVEL))
    other.estimate = there
    other.guidance.look(there, GOOD)
    other.do(Effect.ENTER_MODE, Mode.GUIDED)
    assert other.run(5.0).p_wb[0] == pytest.approx(5.0, abs=0.01)


def test_place_that_tags_tell_a_surfacing_robot_anew_is_not_swum_back_from() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    flight.run(2.0, health=GOOD._replace(tag_age_s=20.0), follows=False)
    flight.estimate = estimate((1.5, -1.0, 1.0))
    now = flight.run(0.01, follows=False)
    np.testing.assert_allclose(now.p_wb[:2], [1.5, -1.0], atol=1e-3)


def test_robot_that_falls_back_on_gravity_goes_on_from_where_it_is_believed_to_be() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    flight.run(1.0)
    flight.estimate = estimate((0.0, 0.0, 1.3), from_euler(0.0, 0.0, 2.5))
    now = flight.run(0.01, health=UPRIGHT, follows=False)
    assert np.linalg.norm(difference(now.q_wb, flight.estimate.q_wb)) < 0.01


def test_tags_that_come_back_move_no_set_point() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.ALT_HOLD)
    flight.run(1.0, health=GOOD._replace(tag_age_s=100.0), follows=False)
    flight.estimate = estimate((0.0, 0.0, 1.3), from_euler(0.0, 0.0, 0.3))
    now = flight.run(0.01, follows=False)
    assert now.p_wb[2] == pytest.approx(1.0) and np.linalg.norm(difference(now.q_wb, flight.estimate.q_wb)) > 0.29


def test_docking_sequence_steers_in_its_mode_alone() -> None:
    flight, place = Flight(), rest_at(np.array([0.1, 0.0, 1.0]), estimate().q_wb)
    flight.do(Effect.ENTER_MODE, Mode.DOCK)
    flight.guidance.dock(place)
    assert flight.run(0.01) is place
    flight.do(Effect.ENTER_MODE)
    flight.guidance.dock(rest_at(np.array([9.0, 0.0, 1.0]), estimate().q_wb))
    assert flight.run(1.0).p_wb[0] < 0.11


@pytest.mark.parametrize("pitch", [0.0, 1.0, 1.4, 1.5707, -1.0, -1.4, -1.5707])
def test_heading_is_kept_through_the_vertical(pitch: float) -> None:
    np.testing.assert_allclose(difference(heading(from_euler(0.0, pitch, 0.8)), from_euler(0.0, 0.0, 0.8)), 0.0, atol=1e-3)


# ---------------------------------------------------------------- a place that moves, a body that changes


def test_place_that_is_moved_is_the_one_that_the_robot_is_on_its_way_to() -> None:
    flight = Flight()
    flight.do(Effect.HOLD_AT, Mode.POSHOLD, rest_at(np.array([1.0, 0.0, 1.0]), LEVEL))
    flight.run(1.0)
    flight.guidance.move_by(np.array([0.0, 0.5, 0.0]))
    np.testing.assert_allclose(flight.run(40.0).p_wb, [1.0, 0.5, 1.0], atol=1e-3)
    flight.guidance.move_by(np.array([0.0, -0.5, 0.2]))
    np.testing.assert_allclose(flight.run(40.0).p_wb, [1.0, 0.0, 1.2], atol=1e-3)


def test_place_is_not_moved_out_of_the_fence() -> None:
    flight = Flight(Parameters().replace("fence.east_m", 2.0))
    flight.guidance.move_by(np.array([0.0, 2.3, 0.0]))
    assert flight.run(60.0).p_wb[1] == pytest.approx(2.0, abs=1e-3)


def test_body_that_takes_over_goes_on_at_its_speed_and_from_its_thrusters_wrench() -> None:
    flight, before = Flight(), np.array([4.0, -1.0, 2.0, 0.5, 0.4, -0.3])
    turned = from_euler(0.0, 0.0, 0.5 * math.pi)
    moving = estimate((0.5, 0.5, 1.0), turned, (0.2, 0.0, 0.0, 0.0, 0.0, 0.1))
    flight.guidance.take_over(Mode.POSHOLD, moving, before)
    flight.estimate = moving
    now = flight.run(0.01, follows=False)
    np.testing.assert_allclose(now.p_wb, moving.p_wb, atol=1e-6)
    np.testing.assert_allclose(now.v_w, [0.0, 0.2, 0.0], atol=1e-9)
    np.testing.assert_allclose(flight.wrenches[-1], before, atol=1e-9)
    flight.run(0.5 * Parameters().steering.blend_s, follows=False)
    np.testing.assert_allclose(flight.wrenches[-1], 0.5 * (before + WRENCH), atol=1e-9)
    flight.run(0.5 * Parameters().steering.blend_s, follows=False)
    np.testing.assert_allclose(flight.wrenches[-1], WRENCH, atol=1e-9)


def test_sticks_push_along_the_robots_own_axes() -> None:
    flight = Flight()
    flight.estimate = estimate(q=from_euler(0.0, 0.0, 0.5 * math.pi))
    flight.guidance.rest(flight.estimate)
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    moved = flight.run(2.0, sticks(forward=1.0)).p_wb
    assert moved[1] > 0.3 and abs(moved[0]) < 1e-6


def test_second_dock_begins_without_the_wish_of_the_first() -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.DOCK)
    flight.guidance.dock(rest_at(np.array([0.0, 0.0, 1.1]), LEVEL))
    flight.run(0.1)
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    flight.run(0.1)
    flight.estimate = estimate((3.0, 0.0, 1.0))
    flight.do(Effect.ENTER_MODE, Mode.DOCK)
    assert flight.run(0.1).p_wb[0] == pytest.approx(3.0, abs=0.01)


def test_robot_that_is_turned_far_from_its_set_point_holds_as_it_is() -> None:
    flight = Flight()
    flight.run(0.1)
    flight.estimate = estimate(q=from_euler(0.0, 0.0, 0.5))
    flight.do(Effect.ENTER_MODE)
    assert np.linalg.norm(difference(flight.run(0.01, follows=False).q_wb, flight.estimate.q_wb)) < 1e-6


@pytest.mark.parametrize(
    ("point", "kept"),
    [((9.0, 0.0, 1.0), (2.0, 0.0, 1.0)), ((0.0, -9.0, 1.0), (0.0, -3.0, 1.0)), ((0.0, 0.0, 30.0), (0.0, 0.0, 4.0))],
)
def test_point_beyond_the_fence_is_flown_to_as_far_as_the_fence_goes(point: tuple[float, ...], kept: tuple[float, ...]) -> None:
    fence = {"fence.north_m": 2.0, "fence.east_m": 3.0, "fence.bottom_m": 4.0}
    parameters = Parameters()
    for name, value in fence.items():
        parameters = parameters.replace(name, value)
    flight = Flight(parameters)
    flight.do(Effect.ENTER_MODE, Mode.GUIDED)
    flight.do(Effect.TAKE_POINT, Mode.GUIDED, rest_at(np.array(point), LEVEL))
    np.testing.assert_allclose(flight.run(60.0).p_wb, kept, atol=1e-3)


def test_robot_that_is_told_to_hold_goes_no_farther_to_the_place_that_it_was_sent_to() -> None:
    flight = Flight()
    flight.do(Effect.HOLD_AT, Mode.POSHOLD, rest_at(np.array([5.0, 0.0, 1.0]), LEVEL))
    there = flight.run(3.0).p_wb[0]
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    assert flight.run(20.0).p_wb[0] < there + 0.3


@pytest.mark.parametrize("mode", [Mode.POSHOLD, Mode.SURFACE, Mode.AUTO])
def test_loop_that_stood_still_goes_on_from_the_body_and_not_from_where_it_would_be(mode: Mode) -> None:
    flight = Flight()
    flight.do(Effect.ENTER_MODE, mode)
    if mode == Mode.AUTO:
        flight.guidance.follow(Ramp())
    elif mode == Mode.POSHOLD:
        flight.do(Effect.HOLD_AT, mode, rest_at(np.array([0.6, 0.0, 1.0]), LEVEL))
    before = flight.run(1.0)
    flight.time_ns += 5_000_000_000
    after = flight.run(0.01)
    assert np.linalg.norm(after.p_wb - before.p_wb) < 0.01
    later = flight.run(1.0)
    assert 0.01 < np.linalg.norm(later.p_wb - after.p_wb) < 0.4, "it goes on"


def test_trajectory_with_a_hole_is_left_before_it_and_spoils_no_other_mode() -> None:
    class Torn(Ramp):
        def sample(self, t_s: float) -> Setpoint:
            whole = super().sample(t_s)
            return whole._replace(p_wb=whole.p_wb * math.nan) if 1.0 < t_s < 9.0 else whole

    flight = Flight()
    flight.do(Effect.ENTER_MODE, Mode.AUTO)
    flight.guidance.follow(Torn())
    flight.run(3.0)
    assert np.isfinite(np.concatenate([np.concatenate(setpoint) for setpoint in flight.setpoints])).all()
    assert flight.guidance.finished(flight.time_ns)
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    assert flight.run(1.0).p_wb[2] < 1.0


def test_set_point_that_is_no_number_is_not_gone_on_from() -> None:
    flight = Flight()
    flight.guidance._glider.put(rest_at(np.full(3, math.nan), LEVEL))
    flight.do(Effect.ENTER_MODE, Mode.POSHOLD)
    np.testing.assert_allclose(flight.run(0.01).p_wb, estimate().p_wb, atol=1e-9)
