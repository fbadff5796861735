"""Guidance along trajectories, streams of points and to single points: smooth starts, motion and stops."""

import math

import numpy as np
import pytest

from firmware_py.core.rotations import from_euler
from firmware_py.core.setpoint import LEASH_M, rest_at
from firmware_py.core.transitions import Effect
from firmware_py.core.types import Mode, Setpoint
from firmware_py.description.parameters import Parameters, registry
from tests.unit.guidance_flight import LEVEL, ZERO, Flight, Ramp, estimate


def test_trajectory_is_sampled_now_and_a_thruster_lag_ahead() -> None:
    flight = Flight()
    flight.do(Effect.FOLLOW, Mode.AUTO, Ramp())
    flight.run(0.01)
    began = flight.time_ns
    flight.run(2.0)
    t = (flight.time_ns - began) * 1e-9
    assert flight.setpoints[-1].p_wb[0] == pytest.approx(0.1 * t)
    flight.run(9.0)
    assert flight.setpoints[-1].p_wb[0] == pytest.approx(1.0)


def test_trajectory_that_begins_elsewhere_is_approached_first() -> None:
    flight = Flight()
    flight.do(Effect.FOLLOW, Mode.AUTO, Ramp((0.0, 1.0, 1.0)))
    flight.run(1.0)
    assert flight.setpoints[-1].p_wb[0] == 0.0 and 0.0 < flight.setpoints[-1].p_wb[1] < 0.5
    flight.run(20.0)
    np.testing.assert_allclose(flight.setpoints[-1].p_wb, [1.0, 1.0, 1.0], atol=1e-6)


@pytest.mark.parametrize("name", ["steering.join_m", "steering.join_rad"])
def test_trajectory_begins_however_exactly_its_start_is_to_be_met(name: str) -> None:
    flight = Flight(Parameters().replace(name, dict(registry())[name].low))
    flight.estimate = estimate((0.0, 0.1, 1.0), from_euler(0.0, 0.0, 0.3))
    flight.guidance.rest(flight.estimate)
    flight.do(Effect.FOLLOW, Mode.AUTO, Ramp())
    flight.run(20.0)
    np.testing.assert_allclose(flight.setpoints[-1].p_wb, [1.0, 0.0, 1.0], atol=1e-6)


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
    """A hand holds the body, or 8 m/s were requested: when the speed set-points end, so does the motion."""
    flight, nan = Flight(), np.full(3, np.nan)
    flight.do(Effect.ENTER_MODE, Mode.GUIDED)
    for _ in range(50):
        flight.do(Effect.TAKE_POINT, Mode.GUIDED, Setpoint(nan, np.full(4, np.nan), np.array([8.0, 0.0, 0.0]), ZERO, ZERO, ZERO))
        flight.run(0.1, follows=False)
    assert np.abs(flight.setpoints[-1].p_wb - flight.estimate.p_wb).max() < LEASH_M + 0.1
    flight.run(4.0, follows=False)
    assert flight.setpoints[-1].p_wb[0] < LEASH_M + 0.1 and np.abs(flight.setpoints[-1].v_w).max() < 1e-3


@pytest.mark.slow
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
def test_place_that_is_moved_is_the_one_that_the_robot_is_on_its_way_to() -> None:
    flight = Flight()
    flight.do(Effect.HOLD_AT, Mode.POSHOLD, rest_at(np.array([1.0, 0.0, 1.0]), LEVEL))
    flight.run(1.0)
    flight.guidance.move_by(np.array([0.0, 0.5, 0.0]))
    np.testing.assert_allclose(flight.run(40.0).p_wb, [1.0, 0.5, 1.0], atol=1e-3)
    flight.guidance.move_by(np.array([0.0, -0.5, 0.2]))
    np.testing.assert_allclose(flight.run(40.0).p_wb, [1.0, 0.0, 1.2], atol=1e-3)


@pytest.mark.slow
def test_place_is_not_moved_out_of_the_fence() -> None:
    flight = Flight(Parameters().replace("fence.east_m", 2.0))
    flight.guidance.move_by(np.array([0.0, 2.3, 0.0]))
    assert flight.run(60.0).p_wb[1] == pytest.approx(2.0, abs=1e-3)


@pytest.mark.slow
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


def test_trajectory_with_a_hole_is_left_before_it_and_spoils_no_other_mode() -> None:
    class Torn(Ramp):
        def sample(self, t_s: float) -> Setpoint:
            whole = super().sample(t_s)
            return whole._replace(p_wb=whole.p_wb * math.nan) if 1.0 < t_s < 9.0 else whole

    flight = Flight()
    flight.do(Effect.FOLLOW, Mode.AUTO, Torn())
    flight.run(3.0)
    assert np.isfinite(np.concatenate([np.concatenate(setpoint) for setpoint in flight.setpoints])).all()
    assert flight.setpoints[-1].p_wb[0] < 0.3 and np.abs(flight.setpoints[-1].v_w).max() < 1e-3
    flight.do(Effect.ENTER_MODE, Mode.SURFACE)
    assert flight.run(1.0).p_wb[2] < 1.0
