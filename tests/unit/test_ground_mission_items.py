"""Mission items, singly and together: which are refused on arrival, and the legs that result from the rest."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.app.mission_plan import plan_mission
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.mission_legs import Leg
from firmware_py.ground.plan_jobs import PlanJob
from tests.unit.ground_missions import PLACES, begin, fly, item, upload
from tests.unit.ground_requests import NAN
from tests.unit.ground_world import Client, World


@pytest.mark.parametrize(
    ("bad", "result"),
    [
        (item(0, (1000, 1000, -0.4), frame=1), mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
        (item(0, PLACES[0], command=22), mavlink.MAV_MISSION_UNSUPPORTED),
        (item(0, (2**31 - 1, 0, -0.4)), mavlink.MAV_MISSION_INVALID_PARAM5_X),
        (item(0, (0, 2**31 - 1, -0.4)), mavlink.MAV_MISSION_INVALID_PARAM6_Y),
        (item(0, (900_000_001, -1_800_000_001, -0.4)), mavlink.MAV_MISSION_INVALID_PARAM5_X),
        (item(0, (0, 0, NAN)), mavlink.MAV_MISSION_INVALID_PARAM7),
        (item(0, PLACES[0], p=(-1, 0, 0, 0)), mavlink.MAV_MISSION_INVALID_PARAM1),
        (item(0, (0, 0, 0), command=178, frame=2, p=(2, 0.5, -1, 0)), mavlink.MAV_MISSION_INVALID_PARAM1),
        (item(0, (0, 0, 0), command=178, frame=2, p=(1, 15.0, -1, 0)), mavlink.MAV_MISSION_INVALID_PARAM2),
        (item(0, (0, 0, 0), command=178, frame=2, p=(1, 1e-6, -1, 0)), mavlink.MAV_MISSION_INVALID_PARAM2),
    ],
)
def test_items_that_cannot_be_flown_are_refused_when_they_come(
    world: World, client: Client, bad: tuple[float, ...], result: int
) -> None:
    assert upload(world, client, [bad]) == result
    assert "mission refused: item 0" in client.texts


@pytest.mark.parametrize(
    ("place", "result", "side"),
    [
        ((302084000, 1201614000, 1.5), mavlink.MAV_MISSION_INVALID_PARAM7, "0.50 m beyond FENCE_TOP, -1 m"),
        ((302084000, 1201614000, -51.0), mavlink.MAV_MISSION_INVALID_PARAM7, "1.00 m beyond FENCE_BOTTOM, 50 m"),
        ((302094000, 1201614000, -0.4), mavlink.MAV_MISSION_INVALID_PARAM5_X, "m beyond FENCE_NORTH, 100 m"),
        ((302074000, 1201614000, -0.4), mavlink.MAV_MISSION_INVALID_PARAM5_X, "m beyond FENCE_NORTH, 100 m"),
        ((302084000, 1201625000, -0.4), mavlink.MAV_MISSION_INVALID_PARAM6_Y, "m beyond FENCE_EAST, 100 m"),
    ],
)
def test_item_outside_the_fence_is_refused_when_it_comes(
    world: World, client: Client, place: tuple[int, int, float], result: int, side: str
) -> None:
    assert upload(world, client, [item(0, PLACES[0]), item(1, place)]) == result
    assert "mission refused: item 1, " in client.texts and side in client.texts
    assert not world.station.services[1].flight.items


def test_item_on_the_fence_is_taken_and_the_fence_is_the_one_that_was_set(world: World, client: Client) -> None:
    on_top = item(0, (302084000, 1201614000, 1.0))
    assert upload(world, client, [on_top]) == mavlink.MAV_MISSION_ACCEPTED
    client.send("PARAM_SET", 1, 1, b"FENCE_TOP", 0.2, 9)
    world.run(2)
    assert upload(world, client, [on_top]) == mavlink.MAV_MISSION_INVALID_PARAM7
    assert upload(world, client, [item(0, PLACES[0])]) == mavlink.MAV_MISSION_ACCEPTED


def test_home_of_an_ardupilot_mission_may_lie_outside_the_fence() -> None:
    world = World(config=GroundConfig(identity="ardusub"))
    home = item(0, (302084000, 1201614000, 30.0))
    assert upload(world, world.client(), [home, item(1, PLACES[0])]) == mavlink.MAV_MISSION_ACCEPTED


def test_jump_items_repeat_and_endless_ones_are_refused(world: World, client: Client) -> None:
    jump = item(2, (0, 0, 0), command=177, frame=2, p=(0, 2, 0, 0))
    upload(world, client, [item(0, PLACES[0]), item(1, PLACES[1]), jump])
    assert [leg.sequence for leg in fly(world, client).legs] == [0, 1] * 3
    world = World()
    client = world.client()
    upload(world, client, [item(0, PLACES[0]), item(1, (0, 0, 0), command=177, frame=2, p=(0, -1, 0, 0))])
    client.command(400, 1)
    world.run(3)
    client.clear()
    client.command(300, 0, 0)
    world.run(3)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert "jumps for ever" in client.texts


def test_holds_delays_and_speeds_belong_to_their_items(world: World, client: Client) -> None:
    items = [
        item(0, (0, 0, 0), command=178, frame=2, p=(1, 0.3, -1, 0)),
        item(1, PLACES[0], p=(2.5, 0, 0, 90)),
        item(2, (0, 0, 0), command=93, frame=2, p=(4, -1, -1, -1)),
        item(3, PLACES[1]),
    ]
    upload(world, client, items)
    first, second = fly(world, client).legs
    assert (first.hold_s, first.speed_m_s, first.yaw) == (6.5, pytest.approx(0.3), pytest.approx(math.pi / 2))
    assert (second.hold_s, second.yaw) == (0.0, None)


def test_mission_that_begins_with_a_delay_waits_where_the_robot_is_and_then_goes(world: World, client: Client) -> None:
    delays = [item(i, (0, 0, 0), command=93, frame=2, p=(seconds, -1, -1, -1)) for i, seconds in enumerate((20, 5))]
    upload(world, client, [*delays, item(2, PLACES[0])])
    job = fly(world, client)
    plan = plan_mission(job, None)
    assert [leg.sequence for leg in job.legs] == [0, 2] and plan.trajectory is not None
    assert plan.arrivals_s[0] == 0.0 and plan.arrivals_s[1] > 25.5
    assert plan.trajectory.sample(24.9).p_wb == pytest.approx(job.p_wb)
    assert plan.trajectory.sample(plan.arrivals_s[1]).p_wb == pytest.approx(job.legs[1].p_wb, abs=1e-6)


@pytest.mark.parametrize("by", [(20.0, 0.0, 0.0), (0.0, -20.0, 10.0), (10.0, 10.0, 10.0)], ids=["one axis", "two axes", "all axes"])
def test_leg_from_a_stop_to_a_stop_reaches_the_speed_that_was_asked_for_and_no_more(by: tuple[float, float, float]) -> None:
    """Regression: the speed was divided among all axes, also those along which nothing moves."""
    job = PlanJob(1, 0, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), (Leg(0, np.array(by), None, 0.0, 0.3),), 10.0, 1.0)
    plan = plan_mission(job, None)
    assert plan.trajectory is not None
    speeds = [np.linalg.norm(plan.trajectory.sample(t).v_w) for t in np.linspace(0.0, plan.arrivals_s[0], 500)]
    assert 0.29 < max(speeds) <= 0.3 * (1.0 + 1e-6)


@pytest.mark.slow
def test_lanes_are_flown_at_their_speed_within_the_corridor() -> None:
    """Regression: the same lanes took 3.5 times as long as at their speed throughout, longer than with a stop at each end."""
    places, corridor_m = [np.array([10.0 * (k % 4 in (1, 2)), k // 2, 2.0]) for k in range(5)], 0.1
    legs = tuple(Leg(k, place, 0.4 * k, 0.0, 0.3) for k, place in enumerate(places[1:]))
    plan = plan_mission(PlanJob(1, 0, places[0], np.array([1.0, 0.0, 0.0, 0.0]), legs, 0.1, corridor_m), None)
    assert plan.trajectory is not None
    assert plan.arrivals_s[-1] == pytest.approx(plan.trajectory.duration_s) and plan.arrivals_s[-1] < 1.5 * 22.0 / 0.3
    for a, b, *times in zip(places, places[1:], (0.0, *plan.arrivals_s), plan.arrivals_s, strict=False):
        along = (b - a) / np.linalg.norm(b - a)
        ways = np.array([plan.trajectory.sample(t).p_wb - a for t in np.linspace(*times, 500)])
        assert np.linalg.norm(ways - np.outer(ways @ along, along), axis=1).max() <= corridor_m
        assert -corridor_m <= (ways @ along).min() and (ways @ along).max() <= np.linalg.norm(b - a) + corridor_m
        np.testing.assert_allclose(ways[-1] + a, b, atol=1e-6)


@pytest.mark.parametrize(("asked", "flown"), [(-1.0, 0.3), (-2.0, 0.15)])
def test_speed_of_minus_one_is_as_before_and_minus_two_the_parameters(world: World, client: Client, asked: float, flown: float) -> None:
    client.command(178, 1, 0.3)
    client.command(178, 1, asked)
    upload(world, client, [item(0, PLACES[0])])
    assert fly(world, client).legs[0].speed_m_s == pytest.approx(flown)


@pytest.mark.parametrize(("asked", "flown"), [(-1.0, 0.3), (-2.0, 0.15)])
def test_item_with_such_a_speed_says_the_same(world: World, client: Client, asked: float, flown: float) -> None:
    speeds = [item(i, (0, 0, 0), command=178, frame=2, p=(1, speed, -1, 0)) for i, speed in enumerate((0.3, asked))]
    upload(world, client, [*speeds, item(2, PLACES[0])])
    assert fly(world, client).legs[0].speed_m_s == pytest.approx(flown)


def test_spline_has_no_heading_and_turns_nobody_north(world: World, client: Client) -> None:
    upload(world, client, [item(0, PLACES[0], command=82, p=(0, 0, 0, 0))])
    assert fly(world, client).legs[0].yaw is None


def test_ardupilots_missions_begin_with_home_which_is_not_flown() -> None:
    world = World(config=GroundConfig(identity="ardusub"))
    client = world.client()
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    assert [leg.sequence for leg in begin(world, client, 300, 0, 0).legs] == [1, 2]


@pytest.mark.parametrize(("identity", "yaw"), [("generic", 0.0), ("ardusub", None)])
def test_fourth_parameter_of_a_waypoint_turns_the_robot_but_for_clients_of_an_ardusub(identity: str, yaw: float | None) -> None:
    """QGroundControl writes 0 in this parameter for an ArduPilot, which ignores it."""
    world = World(config=GroundConfig(identity=identity))
    client = world.client()
    upload(world, client, [item(i, place, p=(0, 0, 0, 0)) for i, place in enumerate(PLACES)])
    assert {leg.yaw for leg in begin(world, client, 300, 0, 0).legs} == {yaw}


def test_jump_to_home_flies_to_no_home_that_may_lie_outside_the_fence() -> None:
    world = World(config=GroundConfig(identity="ardusub"))
    client = world.client()
    home = item(0, (302184000, 1201614000, 100.0), frame=0)  # a kilometre away
    jump = item(2, (0, 0, 0), command=177, frame=2, p=(0, 1, 0, 0))
    assert upload(world, client, [home, item(1, PLACES[0]), jump, item(3, PLACES[1])]) == mavlink.MAV_MISSION_ACCEPTED
    assert [leg.sequence for leg in begin(world, client, 300, 0, 0).legs] == [1, 1, 3]
