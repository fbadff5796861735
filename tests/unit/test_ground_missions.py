"""A mission in flight: started, followed along the plan, paused, resumed, jumped in, and replaced by another."""

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.core.types import Action, Mode
from firmware_py.description.parameters import Parameters
from firmware_py.ground.config import GroundConfig
from tests.unit.ground_missions import PLACES, continued, fly, item, plan_of, upload
from tests.unit.ground_requests import NAN
from tests.unit.ground_world import Client, World


@pytest.mark.slow
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


def test_mission_that_came_and_one_that_begins_are_told_at_once(world: World, client: Client) -> None:
    """Regression: a client that armed and started the mission within the second saw none of its items."""
    world.run(150)
    client.clear()
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    world.run(2)
    (told,) = client.all("MISSION_CURRENT")
    assert (told.seq, told.total, told.mission_state) == (0, 3, mavlink.MISSION_STATE_NOT_STARTED)
    fly(world, client)
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_ACTIVE


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_mission_that_is_paused_in_its_last_hold_goes_on_with_that_alone(world: World, client: Client) -> None:
    jump = item(2, (0, 0, 0), command=177, frame=2, p=(0, 1, 0, 0))
    upload(world, client, [item(0, PLACES[0]), item(1, PLACES[1], p=(20, 0, 0, NAN)), jump])
    assert [leg.sequence for leg in fly(world, client).legs] == [0, 1, 0, 1]
    world.run(4100)
    client.command(193, 0)
    world.run(20)
    assert continued(world, client) == [1]


@pytest.mark.parametrize(("seconds", "left"), [(9, [0, 1, 2]), (11, [0, 1, 2]), (14, [0, 1, 2]), (16, [1, 2])])
def test_mission_that_is_paused_in_a_hold_goes_on_with_that_hold(world: World, client: Client, seconds: int, left: list[int]) -> None:
    """As on an ArduSub: what the robot was to look at from there, it has not yet seen."""
    upload(world, client, [item(0, PLACES[0], p=(5, 0, 0, NAN)), item(1, PLACES[1]), item(2, PLACES[2])])
    fly(world, client)
    world.run(100 * seconds)
    client.command(193, 0)
    world.run(120)
    assert client.last("MISSION_CURRENT").seq == left[0]
    assert continued(world, client) == left


@pytest.mark.parametrize("index", [2, 0, -1])
def test_client_that_sets_the_current_item_hears_at_once_which_it_is(world: World, client: Client, index: int) -> None:
    """Also on a link where nothing streams: clients take this message for the answer."""
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


def test_a_mission_is_refused_disarmed_or_when_there_is_none(world: World, client: Client) -> None:
    client.command(300, 0, 0)
    world.run(2)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    upload(world, client, [item(0, PLACES[0])])
    client.clear()
    client.command(300, 0, 0)
    world.run(2)
    assert "the vehicle is disarmed" in client.texts


@pytest.mark.parametrize("cleared", [False, True])
def test_mission_that_flies_on_though_it_was_replaced_or_cleared_says_so_once(world: World, client: Client, cleared: bool) -> None:
    """The answer is ACCEPTED, and MISSION_CURRENT tells of the new mission, or of none."""
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    said = []
    for _ in range(2):
        client.clear()
        if cleared:
            client.send("MISSION_CLEAR_ALL", 1, 1)
        else:
            upload(world, client, [item(0, PLACES[1])])
        world.run(110)
        said.append(client.texts)
    assert said == ["the mission under way flies on, until it is paused or another is started", ""]
    assert world.robot.mode[0] == Mode.AUTO


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


@pytest.mark.parametrize(("identity", "first", "begun"), [("generic", 0, 0), ("generic", 1, 1), ("ardusub", 0, 1)])
def test_start_that_comes_again_because_its_answer_was_lost_does_not_begin_the_mission_anew(identity: str, first: int, begun: int) -> None:
    """Regression: the robot stopped and flew again from the beginning. ArduSub also ignores a start of the mission that it flies."""
    world = World(config=GroundConfig(identity=identity))
    client = world.client()
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    client.command(400, 1)
    world.run(3)
    client.command(300, first)
    world.run(10)
    (job,) = world.station.jobs()
    assert job.legs[0].sequence == begun
    world.station.planned(0, plan_of(job))
    world.run(1100)
    client.clear()
    client.command(300, first)
    world.run(20)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_ACCEPTED
    assert world.station.jobs() == [] and world.robot.mode[0] == Mode.AUTO
    for number, parameters in ((224, (begun,)), (300, (2,))):
        client.command(number, *parameters)
        world.run(20)
        (job,) = world.station.jobs()
        assert job.legs[0].sequence == parameters[0], "another item, or a jump to the same one, is gone to"


@pytest.mark.slow
@pytest.mark.parametrize(("again", "planned"), [((300, 0), [0, 1, 2]), ((193, 1), [1, 2])])
@pytest.mark.parametrize("taken_by", [(193, 0), (21,), (17,), (176, 1, 1)])
def test_start_right_behind_what_takes_the_body_for_something_else_is_flown(
    world: World, client: Client, taken_by: tuple[int, ...], again: tuple[int, ...], planned: list[int]
) -> None:
    """A radio delivers both at once. Regression: the start was granted because the mission still flew, and the pause then was for good."""
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    world.run(1200)
    client.command(*taken_by)
    client.command(*again)
    world.run(20)
    (job,) = world.station.jobs()
    assert [leg.sequence for leg in job.legs] == planned


def test_start_that_comes_again_behind_a_mode_that_is_refused_does_not_begin_the_mission_anew(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    world.robot.refuse[Action.SET_MODE] = "the pilot is not there"
    client.command(176, 1, 1)
    world.run(3)
    world.robot.refuse.clear()
    client.command(300, 0)
    world.run(20)
    assert world.station.jobs() == [] and world.robot.mode[0] == Mode.AUTO


@pytest.mark.slow
@pytest.mark.parametrize("by_message", [False, True])
@pytest.mark.parametrize("flown_ticks", [0, 10, 500])
def test_jump_that_comes_again_because_its_answer_was_lost_flies_on(
    world: World, client: Client, by_message: bool, flown_ticks: int
) -> None:
    """Regression: the robot stopped and was replanned at each repetition, from where it had got to."""

    def jump() -> None:
        client.send(*(("MISSION_SET_CURRENT", 1, 1, 1) if by_message else ("COMMAND_LONG", 1, 1, 224, 0, 1, *[0] * 6)))
        world.run(10)

    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    jump()
    jump()
    (job,) = world.station.jobs()
    world.station.planned(0, plan_of(job))
    world.run(3 + flown_ticks)
    jump()
    assert world.station.jobs() == [] and world.robot.mode[0] == Mode.AUTO
    assert client.last("MISSION_CURRENT").seq == 1
    world.run(1000)
    jump()
    (job,) = world.station.jobs()
    assert [leg.sequence for leg in job.legs] == [1, 2], "once the item is reached it is gone back to"


@pytest.mark.parametrize("seconds", [0, 5, 12])
def test_speed_that_is_set_in_flight_counts_from_there(world: World, client: Client, seconds: int) -> None:
    """Regression: it counted from the next flight on."""
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    client.command(178, 1, 0.2)
    fly(world, client)
    assert "m/s" not in client.texts
    world.run(100 * seconds)
    client.command(178, 1, 0.3)
    world.run(10)
    assert "0.3 m/s: the way from here is planned anew" in client.texts
    (job,) = world.station.jobs()
    assert [(leg.sequence, leg.speed_m_s) for leg in job.legs] == [(i, pytest.approx(0.3)) for i in range(seconds // 10, 3)]
    assert np.array_equal(job.p_wb, world.robot.p_wb[0])
    world.station.planned(0, plan_of(job))
    world.run(3)
    for same in (0.3, -1):
        client.command(178, 1, same)
    world.run(10)
    assert world.station.jobs() == [] and world.robot.mode[0] == Mode.AUTO, "the same speed stops no body"
    client.command(178, 1, -2)
    world.run(10)
    (job,) = world.station.jobs()
    assert {leg.speed_m_s for leg in job.legs} == {Parameters().ground.mission_speed_m_s}


@pytest.mark.parametrize("paused", [False, True])
def test_speed_that_is_set_replaces_that_of_an_item_passed_up_to_the_next_such_item(world: World, client: Client, paused: bool) -> None:
    slow, fast = (item(i, (0, 0, 0), command=178, frame=2, p=(1, speed, -1, 0)) for i, speed in ((0, 0.1), (3, 0.5)))
    upload(world, client, [slow, item(1, PLACES[0]), item(2, PLACES[1]), fast, item(4, PLACES[2])])
    fly(world, client)
    if paused:
        client.command(193, 0)
        world.run(20)
    client.command(178, 1, 0.3)
    if paused:
        client.command(193, 1)
    world.run(10)
    (job,) = world.station.jobs()
    assert [leg.speed_m_s for leg in job.legs] == pytest.approx([0.3, 0.3, 0.5])


@pytest.mark.parametrize("ticks", [0, 1, 2, 3, 5])
def test_speed_that_is_set_does_not_take_a_body_back_from_a_hold(world: World, client: Client, ticks: int) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    client.command(193, 0)
    world.run(ticks)
    client.command(178, 1, 0.3)
    world.run(10)
    assert world.station.jobs() == [] and world.robot.mode[0] == Mode.POSHOLD


def test_mission_that_was_replaced_flies_on_at_another_speed_and_reports_nothing(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    upload(world, client, [item(i, PLACES[0]) for i in range(2)])
    client.command(178, 1, 0.3)
    world.run(10)
    (job,) = world.station.jobs()
    world.station.planned(0, plan_of(job))
    world.run(1100)
    assert len(job.legs) == 3 and not client.all("MISSION_ITEM_REACHED")


def test_jump_after_the_same_mission_was_sent_anew_flies_the_new_one(world: World, client: Client) -> None:
    """Neither items reached nor completion are reported for the old mission."""
    mission = [item(i, place) for i, place in enumerate(PLACES)]
    upload(world, client, mission)
    fly(world, client)
    upload(world, client, mission)
    client.command(224, 0)
    world.run(10)
    (job,) = world.station.jobs()
    assert [leg.sequence for leg in job.legs] == [0, 1, 2]


def test_jump_behind_what_takes_the_body_for_something_else_is_flown(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    client.command(176, 1, 1)
    client.command(224, 0)
    assert continued(world, client) == [0, 1, 2]


def test_start_that_comes_again_while_its_mission_is_planned_is_waited_for_once(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    client.command(400, 1)
    world.run(3)
    for _ in range(2):
        client.command(300, 0)
        world.run(10)
    (job,) = world.station.jobs()
    world.station.planned(0, plan_of(job))
    world.run(3)
    assert world.robot.mode[0] == Mode.AUTO


def test_items_at_one_place_are_all_told_to_be_reached(world: World, client: Client) -> None:
    upload(world, client, [item(i, PLACES[0]) for i in range(3)])
    fly(world, client, first_arrival_s=0.0)
    world.run(100)
    assert [m.seq for m in client.all("MISSION_ITEM_REACHED")] == [0, 1, 2, 2, 2], "the last is told again"


@pytest.mark.slow
def test_mission_is_complete_once_its_last_hold_is_over(world: World, client: Client) -> None:
    upload(world, client, [item(0, PLACES[0]), item(1, PLACES[1], p=(5, 0, 0, NAN))])
    fly(world, client)
    world.run(2400)
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_ACTIVE
    assert "mission complete" not in client.texts
    world.run(250)
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_COMPLETE


@pytest.mark.slow
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


@pytest.mark.slow
def test_mission_that_came_while_another_flew_is_started_from_its_beginning(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    world.run(1100)
    upload(world, client, [item(i, place) for i, place in enumerate(reversed(PLACES[:2]))])
    world.run(1000)  # the old mission continues past the new one's end
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
