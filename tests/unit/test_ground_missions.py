"""Missions: the protocol with pymavlink's messages, what is refused, and how the body is followed along the plan."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.app.mission_plan import plan_mission
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Mode, Setpoint
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.geodesy import Origin
from firmware_py.ground.mission_flight import Plan, PlanJob
from tests.unit.ground_world import Client, World

NAN = float("nan")
PLACES = [(302084010, 1201614010, -0.4), (302084020, 1201614000, -0.3), (302084000, 1201614000, -0.5)]


class Path:
    """A trajectory of ten seconds a leg that stands still."""

    duration_s = 30.0

    def sample(self, t_s: float) -> Setpoint:
        zero = np.zeros(3)
        return Setpoint(zero, np.array([1.0, 0, 0, 0]), zero, zero, zero, zero)


def item(
    sequence: int,
    place: tuple[int, int, float],
    command: int = 16,
    frame: int = 6,
    p: tuple[float, ...] = (0, 0, 0, NAN),
) -> tuple[float, ...]:
    return (1, 1, sequence, frame, command, 0, 1, *p, *place)


def upload(world: World, client: Client, items: list[tuple[float, ...]], kind: int = 0) -> int:
    """Send items as they are asked for; the result."""
    client.clear()
    client.send("MISSION_COUNT", 1, 1, len(items), kind)
    answered = 0
    for _ in range(400):
        world.run(1)
        if client.all("MISSION_ACK"):
            return int(client.last("MISSION_ACK").type)
        asked = client.all("MISSION_REQUEST_INT")
        if len(asked) > answered:
            client.send("MISSION_ITEM_INT", *items[asked[-1].seq], kind)
            answered = len(asked)
    raise AssertionError("no acknowledgement")


def fly(world: World, client: Client, first_arrival_s: float = 10.0) -> PlanJob:
    """Arm, start by mode, plan: the body tracks."""
    client.command(400, 1)
    world.run(3)
    client.command(176, 1, 4, 4)
    world.run(10)
    (job,) = world.station.jobs()
    arrivals = tuple(first_arrival_s * (i + 1) for i in range(len(job.legs)))
    world.station.planned(0, Plan(job.serial, Path(), arrivals))
    world.run(3)
    return job


def continued(world: World, client: Client) -> list[int]:
    """Items that are planned when the mission is continued."""
    client.command(193, 1)
    world.run(10)
    (job,) = world.station.jobs()
    return [leg.sequence for leg in job.legs]


def test_mission_goes_up_and_comes_down_the_same(world: World, client: Client) -> None:
    items = [item(i, place) for i, place in enumerate(PLACES)]
    assert upload(world, client, items) == mavlink.MAV_MISSION_ACCEPTED
    client.clear()
    client.send("MISSION_REQUEST_LIST", 1, 1, 0)
    for i in range(3):
        client.send("MISSION_REQUEST_INT", 1, 1, i, 0)
    client.send("MISSION_REQUEST", 1, 1, 0, 0)
    world.run(1)
    assert client.last("MISSION_COUNT").count == 3
    down = client.all("MISSION_ITEM_INT")
    assert [(m.x, m.y, pytest.approx(m.z)) for m in down] == PLACES and {m.frame for m in down} == {6}
    old = client.last("MISSION_ITEM")
    assert (old.frame, old.x) == (3, pytest.approx(30.208401, abs=1e-5))
    world.run(120)
    assert client.last("MISSION_CURRENT").total == 3


def test_an_item_that_is_lost_is_asked_for_again(world: World, client: Client) -> None:
    client.send("MISSION_COUNT", 1, 1, 2, 0)
    world.run(100)
    assert [m.seq for m in client.all("MISSION_REQUEST_INT")] == [0] * 5
    client.send("MISSION_ITEM_INT", *item(0, PLACES[0]), 0)
    client.send("MISSION_ITEM_INT", *item(0, PLACES[0]), 0)
    client.send("MISSION_ITEM_INT", *item(1, PLACES[1]), 0)
    world.run(1)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_ACCEPTED


@pytest.mark.parametrize("last", [item(1, PLACES[1]), item(1, PLACES[1], command=22)])
def test_last_item_that_comes_again_is_answered_again(world: World, client: Client, last: tuple[float, ...]) -> None:
    """A client whose acknowledgement was lost sends it until it hears one."""
    result = upload(world, client, [item(0, PLACES[0]), last])
    for number, answers in ((1, [result]), (0, [])):
        client.clear()
        client.send("MISSION_ITEM_INT", *[item(0, PLACES[0]), last][number], 0)
        world.run(2)
        assert [ack.type for ack in client.all("MISSION_ACK")] == answers
    client.send("MISSION_CLEAR_ALL", 1, 1, 0)
    client.clear()
    client.send("MISSION_ITEM_INT", *last, 0)
    world.run(2)
    assert [ack.type for ack in client.all("MISSION_ACK")] == [mavlink.MAV_MISSION_ACCEPTED]  # of the clearing alone


def test_a_transfer_that_breaks_off_leaves_the_old_mission(world: World, client: Client) -> None:
    upload(world, client, [item(0, PLACES[0])])
    client.clear()
    client.send("MISSION_COUNT", 1, 1, 3, 0)
    world.run(600)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_OPERATION_CANCELLED
    assert len(world.station.services[1].flight.items) == 1


@pytest.mark.parametrize(
    ("bad", "result"),
    [
        (item(0, (1000, 1000, -0.4), frame=1), mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
        (item(0, PLACES[0], command=22), mavlink.MAV_MISSION_UNSUPPORTED),
        (item(0, (2**31 - 1, 0, -0.4)), mavlink.MAV_MISSION_INVALID_PARAM5_X),
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


def test_local_frame_is_refused_and_fences_are_told_to_be_unsupported(world: World, client: Client) -> None:
    assert upload(world, client, [item(0, PLACES[0])], kind=1) == mavlink.MAV_MISSION_UNSUPPORTED
    client.send("MISSION_REQUEST_LIST", 1, 1, 1)
    world.run(1)
    assert (client.last("MISSION_COUNT").count, client.last("MISSION_COUNT").mission_type) == (0, 1)


def test_too_many_items_find_no_space_and_clear_removes_all(world: World, client: Client) -> None:
    client.send("MISSION_COUNT", 1, 1, 501, 0)
    world.run(1)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_NO_SPACE
    upload(world, client, [item(0, PLACES[0])])
    client.send("MISSION_CLEAR_ALL", 1, 1, 0)
    world.run(1)
    assert not world.station.services[1].flight.items


def test_places_are_about_the_tanks_origin() -> None:
    """Against the series of metres a degree of WGS 84 (Defense Mapping Agency; valid to 0.01 m)."""
    f = math.radians(30.2084)
    north = 111132.92 - 559.82 * math.cos(2 * f) + 1.175 * math.cos(4 * f) - 0.0023 * math.cos(6 * f)
    east = 111412.84 * math.cos(f) - 93.5 * math.cos(3 * f) + 0.118 * math.cos(5 * f)
    origin = Origin(30.2084, 120.1614, 4.0)
    assert origin.local(30.2094, 120.1614, 3.0) == pytest.approx([north * 1e-3, 0.0, 1.0], abs=1e-3)
    assert origin.local(30.2084, 120.1624, 4.0) == pytest.approx([0.0, east * 1e-3, 0.0], abs=1e-3)
    for p in ([0.1, -0.2, 0.5], [50.0, 80.0, -3.0]):
        assert origin.local(*origin.geodetic(np.array(p))) == pytest.approx(p, abs=1e-6)
    date_line = Origin(0.0, 179.9999, 0.0)
    assert date_line.local(0.0, -179.9999, 0.0)[1] == pytest.approx(22.26, abs=0.01)
    assert date_line.geodetic(np.array([0.0, 22.264, 0.0]))[1] == pytest.approx(-179.9999, abs=1e-7), "no client takes more than 180"


def test_mission_starts_by_mode_holds_first_and_tracks_the_plan(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    job = fly(world, client)
    assert [leg.sequence for leg in job.legs] == [0, 1, 2]
    assert job.legs[0].p_wb == pytest.approx([0.11, 0.096, 0.4], abs=2e-3)
    assert np.array_equal(job.p_wb, world.robot.p_wb[0])
    asked = [r.action for r in world.robot.asked]
    assert asked.index(Action.SET_MODE) < asked.index(Action.TRACK)
    assert world.robot.mode[0] == Mode.AUTO
    world.run(1100)
    assert (client.last("MISSION_ITEM_REACHED").seq, client.last("MISSION_CURRENT").seq) == (0, 1)
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_ACTIVE
    world.run(2200)
    assert client.last("MISSION_ITEM_REACHED").seq == 2
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_COMPLETE
    assert "mission complete" in client.texts


def test_pause_and_resume_go_on_at_the_same_item(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    world.run(1100)
    client.command(193, 0)
    world.run(120)
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_PAUSED
    assert continued(world, client) == [1, 2]


def test_mission_that_goes_on_is_as_fast_as_before_it_was_paused(world: World, client: Client) -> None:
    upload(world, client, [item(0, (0, 0, 0), command=178, frame=2, p=(1, 0.3, -1, 0)), item(1, PLACES[0]), item(2, PLACES[1])])
    fly(world, client)
    world.run(1100)
    client.command(193, 0)
    world.run(20)
    client.command(193, 1)
    world.run(10)
    (job,) = world.station.jobs()
    assert [(leg.sequence, leg.speed_m_s) for leg in job.legs] == [(2, pytest.approx(0.3))]


@pytest.mark.parametrize(("kind", "asked", "left"), [
    ("COMMAND_LONG", (193, 0, 0, 0, 0, 0, 0, 0, 0), [1, 3]),
    ("COMMAND_INT", (6, 192, 0, 0, -1, 0, 0, NAN, 302084000, 1201614000, -0.4), [1, 3]),
    ("COMMAND_LONG", (224, 0, 1, 0, 0, 0, 0, 0, 0), [1, 0, 1, 3]),
])  # fmt: skip
def test_rounds_that_were_flown_before_a_pause_are_not_flown_again(
    world: World, client: Client, kind: str, asked: tuple[float, ...], left: list[int]
) -> None:
    jump = item(2, (0, 0, 0), command=177, frame=2, p=(0, 1, 0, 0))
    upload(world, client, [item(0, PLACES[0]), item(1, PLACES[1]), jump, item(3, PLACES[2])])
    assert [leg.sequence for leg in fly(world, client).legs] == [0, 1, 0, 1, 3]
    world.run(3100)
    client.command(193, 0)
    world.run(20)
    client.send(kind, 1, 1, *asked)
    world.run(20)
    world.station.jobs()
    assert continued(world, client) == left


def test_mission_that_is_paused_in_its_last_hold_goes_on_with_that_alone(world: World, client: Client) -> None:
    jump = item(2, (0, 0, 0), command=177, frame=2, p=(0, 1, 0, 0))
    upload(world, client, [item(0, PLACES[0]), item(1, PLACES[1], p=(20, 0, 0, NAN)), jump])
    assert [leg.sequence for leg in fly(world, client).legs] == [0, 1, 0, 1]
    world.run(4100)
    client.command(193, 0)
    world.run(20)
    assert continued(world, client) == [1]


@pytest.mark.parametrize("index", [2, 0, -1])
def test_client_that_sets_the_current_item_hears_at_once_which_it_is(world: World, client: Client, index: int) -> None:
    """Also on a link where nothing streams: a client takes it for the answer."""
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    client.command(511, mavlink.MAVLINK_MSG_ID_MISSION_CURRENT, -1)
    world.run(2)
    client.clear()
    client.command(224, index)
    if index >= 0:
        client.send("MISSION_SET_CURRENT", 1, 1, index)
    world.run(2)
    assert [m.seq for m in client.all("MISSION_CURRENT")] == ([index] * 2 if index >= 0 else [0])
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_ACCEPTED


def test_speed_that_is_set_in_a_pause_counts_when_the_mission_goes_on(world: World, client: Client) -> None:
    upload(world, client, [item(0, PLACES[0]), item(1, PLACES[1])])
    fly(world, client)
    client.command(193, 0)
    world.run(20)
    client.command(178, 1, 0.3)
    client.command(193, 1)
    world.run(10)
    (job,) = world.station.jobs()
    assert [leg.speed_m_s for leg in job.legs] == [pytest.approx(0.3)] * 2


def test_jump_replans_from_where_the_body_is(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    client.clear()
    client.command(224, 2)
    world.run(10)
    (job,) = world.station.jobs()
    assert [leg.sequence for leg in job.legs] == [2]
    client.send("MISSION_SET_CURRENT", 1, 1, 7)
    world.run(2)
    assert "item 7 of 3 does not exist" in client.texts


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
    client.command(400, 1)
    world.run(3)
    client.command(300, 0, 0)
    world.run(10)
    (job,) = world.station.jobs()
    assert [leg.sequence for leg in job.legs] == [1, 2]


def test_jump_to_home_flies_to_no_home_that_may_lie_outside_the_fence() -> None:
    world = World(config=GroundConfig(identity="ardusub"))
    client = world.client()
    home = item(0, (302184000, 1201614000, 100.0), frame=0)  # a kilometre away
    jump = item(2, (0, 0, 0), command=177, frame=2, p=(0, 1, 0, 0))
    assert upload(world, client, [home, item(1, PLACES[0]), jump, item(3, PLACES[1])]) == mavlink.MAV_MISSION_ACCEPTED
    client.command(400, 1)
    world.run(3)
    client.command(300, 0, 0)
    world.run(10)
    (job,) = world.station.jobs()
    assert [leg.sequence for leg in job.legs] == [1, 1, 3]


def test_a_mission_is_refused_disarmed_or_when_there_is_none(world: World, client: Client) -> None:
    client.command(300, 0, 0)
    world.run(2)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    upload(world, client, [item(0, PLACES[0])])
    client.clear()
    client.command(300, 0, 0)
    world.run(2)
    assert "the vehicle is disarmed" in client.texts


def test_a_plan_that_cannot_be_made_is_told_and_the_body_holds(world: World, client: Client) -> None:
    upload(world, client, [item(0, PLACES[0])])
    client.command(400, 1)
    world.run(3)
    client.command(176, 1, 4, 4)
    world.run(10)
    (job,) = world.station.jobs()
    world.station.planned(0, Plan(job.serial, None, (), "the thrusters would be used to 120 %"))
    world.run(2)
    assert "the thrusters would be used to 120 %" in client.texts
    assert world.robot.mode[0] == Mode.POSHOLD


@pytest.mark.parametrize("ticks", [1, 10])
def test_plan_that_comes_after_something_else_was_asked_for_is_not_flown(world: World, client: Client, ticks: int) -> None:
    """Until the hold is settled nothing new is planned: a plan that comes meanwhile is the one before's, as is one that comes later."""
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    client.command(400, 1)
    world.run(3)
    client.command(176, 1, 4, 4)
    world.run(10)
    (old,) = world.station.jobs()
    client.command(224, 2)
    world.run(ticks)
    world.station.planned(0, Plan(old.serial, Path(), (10.0, 20.0, 30.0)))
    world.run(3)
    assert Action.TRACK not in [r.action for r in world.robot.asked]


def test_new_mission_is_not_called_paused_or_done_when_the_old_one_ends(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    upload(world, client, [item(0, PLACES[0])])
    client.command(193, 0)
    world.run(200)
    told = client.last("MISSION_CURRENT")
    assert (told.seq, told.mission_state) == (0, mavlink.MISSION_STATE_NOT_STARTED)


def test_mission_that_flies_is_not_begun_anew_when_it_is_asked_for_again(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    before = len(world.robot.asked)
    client.command(176, 1, 4, 4)
    world.run(20)
    assert world.station.jobs() == [] and len(world.robot.asked) == before and world.robot.mode[0] == Mode.AUTO


def test_items_at_one_place_are_all_told_to_be_reached(world: World, client: Client) -> None:
    upload(world, client, [item(i, PLACES[0]) for i in range(3)])
    fly(world, client, first_arrival_s=0.0)
    world.run(100)
    assert [m.seq for m in client.all("MISSION_ITEM_REACHED")] == [0, 1, 2, 2, 2], "the last is told again"


def test_mission_is_complete_once_its_last_hold_is_over(world: World, client: Client) -> None:
    upload(world, client, [item(0, PLACES[0]), item(1, PLACES[1], p=(5, 0, 0, NAN))])
    fly(world, client)
    world.run(2400)
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_ACTIVE
    assert "mission complete" not in client.texts
    world.run(250)
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_COMPLETE


def test_mission_that_is_done_is_flown_again_from_its_beginning(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    world.run(3200)
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_COMPLETE
    assert continued(world, client) == [0, 1, 2]


def test_mission_goes_on_when_every_client_is_gone(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    world.station.leave(client.channel)
    world.run(2500)
    assert world.robot.mode[0] == Mode.AUTO
    assert world.station.services[1].system.subject.progress.current == 2


def test_reposition_plans_one_leg(world: World, client: Client) -> None:
    client.command(400, 1)
    world.run(3)
    client.clear()
    client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, -1, 1, 0, 1.0, 302084010, 1201614000, -0.4)
    world.run(10)
    (job,) = world.station.jobs()
    assert job.legs[0].p_wb == pytest.approx([0.111, 0, 0.4], abs=2e-3)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_ACCEPTED


@pytest.mark.parametrize(("asked", "flown"), [(0.05, 0.05), (-1.0, 0.15), (0.0, 0.15), (NAN, 0.15)])
def test_reposition_is_as_fast_as_it_asks_for(world: World, client: Client, asked: float, flown: float) -> None:
    client.command(400, 1)
    world.run(3)
    client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, asked, 1, 0, NAN, 302084010, 1201614000, -0.4)
    world.run(10)
    (job,) = world.station.jobs()
    assert job.legs[0].speed_m_s == pytest.approx(flown)


@pytest.mark.parametrize("speed", [1e-6, 50.0])
def test_reposition_at_a_speed_that_no_mission_may_have_is_refused(world: World, client: Client, speed: float) -> None:
    client.command(400, 1)
    world.run(3)
    client.clear()
    client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, speed, 1, 0, NAN, 302084010, 1201614000, -0.4)
    world.run(10)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED and not world.station.jobs()
    assert "reposition refused: a speed of" in client.texts


@pytest.mark.parametrize(("frame", "above", "z"), [(0, 0.0, 0.4), (5, 0.0, 0.4), (3, 400.0, 0.4), (6, 400.0, 0.4)])
def test_reposition_reads_the_altitude_by_its_frame(frame: int, above: float, z: float) -> None:
    world = World(altitude_m=400.0)
    client = world.client()
    client.command(400, 1)
    world.run(3)
    client.send("COMMAND_INT", 1, 1, frame, 192, 0, 0, -1, 1, 0, NAN, 302084000, 1201614000, 400.0 - above - z)
    world.run(10)
    (job,) = world.station.jobs()
    assert job.legs[0].p_wb[2] == pytest.approx(z, abs=1e-3)


@pytest.mark.parametrize(("frame", "x", "y"), [(1, 0, 0), (10, 302084000, 1201614000), (6, 2**31 - 1, 2**31 - 1)])
def test_reposition_to_no_place_is_denied(world: World, client: Client, frame: int, x: int, y: int) -> None:
    client.command(400, 1)
    world.run(3)
    client.clear()
    client.send("COMMAND_INT", 1, 1, frame, 192, 0, 0, -1, 1, 0, NAN, x, y, -0.4)
    world.run(3)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_DENIED
    assert not world.station.jobs()


def test_reposition_in_floats_is_answered_with_command_int_only(world: World, client: Client) -> None:
    client.command(400, 1)
    world.run(3)
    client.clear()
    client.command(192, -1, 0, 0, NAN, 30.2084, 120.1614, -0.4)
    world.run(3)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_COMMAND_INT_ONLY
    assert not world.station.jobs()


def test_reposition_beyond_the_fence_is_refused_and_what_flew_goes_on(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    client.clear()
    client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, -1, 1, 0, NAN, 302084000, 1201614000, -51.0)
    world.run(10)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert "reposition refused: 1.00 m beyond FENCE_BOTTOM, 50 m" in client.texts
    assert not world.station.jobs()
    world.run(120)
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_ACTIVE


def test_mission_that_came_while_another_flew_is_started_from_its_beginning(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    world.run(1100)
    upload(world, client, [item(i, place) for i, place in enumerate(reversed(PLACES[:2]))])
    world.run(1000)  # the old one goes on past the new one's end
    client.clear()
    world.run(110)
    now = client.last("MISSION_CURRENT")
    assert (now.seq, now.total, now.mission_state) == (0, 2, mavlink.MISSION_STATE_NOT_STARTED)
    assert not client.all("MISSION_ITEM_REACHED")
    client.command(193, 0)
    world.run(20)
    assert continued(world, client) == [0, 1]


def test_jump_after_an_upload_in_flight_goes_on_in_the_new_mission(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    upload(world, client, [item(i, place) for i, place in enumerate(reversed(PLACES))])
    client.send("MISSION_SET_CURRENT", 1, 1, 1)
    world.run(10)
    (job,) = world.station.jobs()
    assert [leg.sequence for leg in job.legs] == [1, 2]


def test_mission_that_flies_is_not_written_over_in_part_and_a_paused_one_goes_on_where_it_was(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    world.run(1100)
    client.clear()
    client.send("MISSION_WRITE_PARTIAL_LIST", 1, 1, 2, 2, 0)
    world.run(2)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_DENIED
    client.command(193, 0)
    world.run(120)
    client.send("MISSION_WRITE_PARTIAL_LIST", 1, 1, 2, 2, 0)
    world.run(2)
    client.send("MISSION_ITEM_INT", *item(2, PLACES[0]), 0)
    world.run(2)
    assert continued(world, client) == [1, 2]


def test_part_of_a_mission_is_written_over(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    before = world.station.services[1].flight.items
    client.clear()
    client.send("MISSION_WRITE_PARTIAL_LIST", 1, 1, 1, 1, 0)
    world.run(2)
    assert client.last("MISSION_REQUEST_INT").seq == 1
    client.send("MISSION_ITEM_INT", *item(1, (PLACES[1][0], PLACES[1][1], -0.123)), 0)
    world.run(2)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_ACCEPTED
    after = world.station.services[1].flight.items
    assert (after[0], after[2]) == (before[0], before[2]) and after[1].z == pytest.approx(-0.123)
    client.send("MISSION_WRITE_PARTIAL_LIST", 1, 1, 2, 3, 0)
    world.run(2)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_INVALID_SEQUENCE
    client.send("MISSION_REQUEST_PARTIAL_LIST", 1, 1, 0, 1, 0)
    world.run(2)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_UNSUPPORTED


def test_part_of_a_mission_that_was_started_meanwhile_is_not_written_over(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    before = world.station.services[1].flight.items
    client.clear()
    client.send("MISSION_WRITE_PARTIAL_LIST", 1, 1, 2, 2, 0)
    fly(world, client)
    client.send("MISSION_ITEM_INT", *item(2, PLACES[0]), 0)
    world.run(2)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_DENIED
    assert world.station.services[1].flight.items == before


def planning(world: World, client: Client) -> PlanJob:
    """Armed, the mission started, its plan under way."""
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    client.command(400, 1)
    world.run(3)
    client.command(176, 1, 4, 4)
    world.run(10)
    (job,) = world.station.jobs()
    client.clear()
    return job


def come_back(world: World, job: PlanJob) -> None:
    world.station.planned(0, Plan(job.serial, Path(), tuple(10.0 * (i + 1) for i in range(len(job.legs)))))


TAKEN = {
    "pause": (193, (0.0,)), "manual": (176, (1.0, 1.0)), "hold": (176, (1.0, 4.0, 3.0)), "land": (21, ()), "disarm": (400, (0.0,)),
    "e-stop": (31012, ()),
}  # fmt: skip


@pytest.mark.parametrize("ticks", [0, 1, 20])
@pytest.mark.parametrize("what", TAKEN)
def test_flight_that_is_being_planned_ends_when_the_pilot_takes_the_vehicle(world: World, client: Client, what: str, ticks: int) -> None:
    job = planning(world, client)
    number, parameters = TAKEN[what]
    client.command(number, *parameters)
    world.run(ticks)
    come_back(world, job)
    world.run(120)
    assert Action.TRACK not in [r.action for r in world.robot.asked]
    assert world.robot.mode[0] != Mode.AUTO
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_PAUSED
    assert client.texts.count("flight ended before it began") == 1


@pytest.mark.parametrize("button", [0, 1, 11])
def test_flight_that_is_being_planned_ends_by_a_button(world: World, client: Client, button: int) -> None:
    job = planning(world, client)
    client.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, 1 << button)
    come_back(world, job)
    world.run(3)
    assert Action.TRACK not in [r.action for r in world.robot.asked]


def test_flight_that_is_being_planned_ends_when_a_fail_safe_changes_the_mode(world: World, client: Client) -> None:
    job = planning(world, client)
    world.robot.mode[0] = Mode.SURFACE
    world.run(1)
    world.robot.mode[0] = Mode.POSHOLD
    world.run(1)
    come_back(world, job)
    world.run(3)
    assert "flight ended before it began: the mode is SURFACE" in client.texts
    assert world.robot.mode[0] == Mode.POSHOLD


@pytest.mark.parametrize("parts", [False, True])
def test_flight_that_is_being_planned_ends_when_the_body_becomes_another(parts: bool) -> None:
    world = World(2)
    client, apart = world.client(), list(world.robot.bodies)
    world.robot.state[1] = State.ARMED
    if parts:
        world.robot.dock()
        world.run(1)
    job = planning(world, client)
    if parts:
        world.robot.bodies = apart
    else:
        world.robot.dock()
    world.run(1)
    come_back(world, job)
    world.run(3)
    assert Action.TRACK not in [r.action for r in world.robot.asked]
    assert client.texts.count("flight ended before it began: the body is another one") == 1


def test_mission_of_a_robot_that_was_part_of_another_meanwhile_is_not_complete_but_paused() -> None:
    world = World(2)
    client, apart = world.client(), list(world.robot.bodies)
    world.robot.state[1] = State.ARMED
    come_back(world, planning(world, client))
    world.run(1100)
    world.robot.bodies = [SimpleNamespace(index=1, modules=(0, 1))]
    world.run(3000)
    client.clear()
    world.robot.bodies, world.robot.mode[0] = apart, Mode.POSHOLD
    world.run(120)
    assert not client.all("MISSION_ITEM_REACHED") and "mission complete" not in client.texts
    told = [m for m in client.all("MISSION_CURRENT") if m.get_srcSystem() == 1][-1]
    assert (told.mission_state, told.seq) == (mavlink.MISSION_STATE_PAUSED, 1)
    assert continued(world, client) == [1, 2]


def test_way_to_a_place_ends_by_pause_while_it_is_planned(world: World, client: Client) -> None:
    client.command(400, 1)
    world.run(3)
    client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, -1, 1, 0, 1.0, 302084010, 1201614000, -0.4)
    world.run(10)
    (job,) = world.station.jobs()
    client.command(193, 0)
    come_back(world, job)
    world.run(3)
    assert world.robot.mode[0] == Mode.POSHOLD and "flight ended before it began" in client.texts


def test_mission_that_was_paused_while_it_was_planned_goes_on_when_it_is_continued(world: World, client: Client) -> None:
    old = planning(world, client)
    client.command(193, 0)
    client.command(193, 1)
    world.run(10)
    (job,) = world.station.jobs()
    come_back(world, old)
    world.run(3)
    assert world.robot.mode[0] == Mode.POSHOLD
    come_back(world, job)
    world.run(3)
    assert world.robot.mode[0] == Mode.AUTO


def test_mission_that_starts_from_another_mode_waits_for_its_hold(world: World, client: Client) -> None:
    upload(world, client, [item(0, PLACES[0])])
    client.command(400, 1)
    client.command(176, 1, 1)
    world.run(3)
    client.command(176, 1, 4, 4)
    for _ in range(20):  # ticks that were queued while the loop took the request
        inputs, outputs = world.robot.step([])
        world.station.observe(inputs, outputs, world.robot.bodies)
    assert world.robot.mode[0] == Mode.MANUAL and not world.station.jobs()
    world.run(3)
    assert world.robot.mode[0] == Mode.POSHOLD and len(world.station.jobs()) == 1


def test_mission_whose_hold_never_comes_ends(world: World, client: Client) -> None:
    upload(world, client, [item(0, PLACES[0])])
    client.command(400, 1)
    client.command(176, 1, 1)
    world.run(3)
    world.robot.refuse[Action.SET_MODE] = "no"
    client.command(176, 1, 4, 4)
    world.run(105)
    assert not world.station.jobs() and "flight ended before it began: the mode is MANUAL" in client.texts
