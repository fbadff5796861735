"""When an item counts as reached and a mission as complete: once its time has come and the body is there."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.core.rotations import from_euler
from firmware_py.core.types import WARNING
from tests.unit.ground_missions import PLACES, continued, fly, go_to, item, plan_of, upload
from tests.unit.ground_requests import NAN
from tests.unit.ground_world import Client, World

HELD_BACK = np.array([0.0, 0.4, 0.0])


def start(world: World, client: Client, *items: tuple[float, ...]) -> None:
    upload(world, client, list(items))
    fly(world, client)
    client.clear()


@pytest.mark.slow
def test_body_that_is_held_back_reaches_nothing_until_it_is_there(world: World, client: Client) -> None:
    """Regression: with the body ten metres away, its mission was reported to be complete."""
    world.robot.off_plan = HELD_BACK
    start(world, client, *(item(i, place) for i, place in enumerate(PLACES)))
    world.run(6000)
    assert not client.all("MISSION_ITEM_REACHED") and "mission complete" not in client.texts
    now = client.last("MISSION_CURRENT")
    assert (now.seq, now.mission_state) == (0, mavlink.MISSION_STATE_ACTIVE)
    world.robot.off_plan = np.zeros(3)
    world.run(200)
    assert not client.all("MISSION_ITEM_REACHED"), "it missed the first two, and is at the last one"
    client.command(193, 0)
    world.run(20)
    assert continued(world, client) == [0, 1, 2]


@pytest.mark.slow
@pytest.mark.parametrize(("command", "planned"), [((300, 0, 0), [0, 1, 2]), ((176, 1, 4, 4), [1, 2]), ((193, 1), [1, 2])])
def test_mission_whose_body_does_not_get_to_an_item_is_planned_anew_when_it_is_started_again(
    command: tuple[float, ...], planned: list[int], world: World, client: Client
) -> None:
    """By MISSION_START from item 0, by the mode, and by "continue". Regression: the start was accepted, and nothing happened."""
    start(world, client, *(item(i, place) for i, place in enumerate(PLACES)))
    world.run(1100)
    assert client.last("MISSION_ITEM_REACHED").seq == 0
    world.robot.off_plan = HELD_BACK
    world.run(2600)
    assert "mission item 1 is late" in client.texts
    client.command(*command)
    world.run(10)
    (job,) = world.station.jobs()
    assert [leg.sequence for leg in job.legs] == planned


def test_body_that_comes_late_completes_its_mission_when_it_is_there(world: World, client: Client) -> None:
    world.robot.off_plan = HELD_BACK
    start(world, client, item(0, PLACES[0]))
    world.run(1700)
    assert client.texts == "mission item 0 is late: 0.40 m from its place"
    assert client.last("STATUSTEXT").severity == WARNING
    world.robot.off_plan = np.zeros(3)
    world.run(1)
    assert client.last("MISSION_ITEM_REACHED").seq == 0 and client.texts.endswith("mission complete")


@pytest.mark.slow
def test_item_is_told_once_to_be_late_and_each_that_falls_farther_behind_again(world: World, client: Client) -> None:
    world.robot.off_plan = HELD_BACK
    start(world, client, *(item(i, PLACES[0]) for i in range(3)))
    world.run(1490)
    assert not client.texts
    world.run(1000)
    assert client.texts.count("late") == 1
    world.robot.off_plan = np.zeros(3)
    world.run(1)
    assert client.last("MISSION_ITEM_REACHED").seq == 1, "14.9 s and 4.9 s behind"
    world.robot.off_plan = HELD_BACK
    world.run(1490)
    assert client.texts.count("late") == 1
    world.run(30)
    assert client.texts.count("mission item 2 is late") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("asked_m", "radius_m"), [(0.0, 0.15), (NAN, 0.15), (-1.0, 0.15), (0.05, 0.05), (0.5, 0.5), (1.0, 0.15), (3.0, 0.15)]
)
def test_waypoint_is_reached_within_the_radius_that_its_client_chose(world: World, client: Client, asked_m: float, radius_m: float) -> None:
    """1 m and 3 m are nobody's choice: MAVSDK fills them in."""
    world.robot.off_plan = np.array([0.0, 0.0, radius_m + 0.01])
    start(world, client, item(0, PLACES[0], p=(0, asked_m, 0, NAN)))
    world.run(1100)
    assert not client.all("MISSION_ITEM_REACHED")
    world.robot.off_plan = np.array([0.0, 0.0, radius_m - 0.01])
    world.run(1)
    assert client.last("MISSION_ITEM_REACHED").seq == 0


def test_second_parameter_of_a_loiter_is_no_acceptance_radius(world: World, client: Client) -> None:
    world.robot.off_plan = HELD_BACK
    start(world, client, item(0, PLACES[0], command=19, p=(0, 2, 0, NAN)))
    world.run(1100)
    assert not client.all("MISSION_ITEM_REACHED")


def test_last_hold_begins_when_the_body_is_there(world: World, client: Client) -> None:
    world.robot.off_plan = HELD_BACK
    start(world, client, item(0, PLACES[0], p=(5, 0, 0, NAN)))
    world.run(1400)
    world.robot.off_plan = np.zeros(3)
    world.run(490)
    assert client.all("MISSION_ITEM_REACHED") and "mission complete" not in client.texts
    world.run(20)
    assert "mission complete" in client.texts


@pytest.mark.parametrize("is_paused", [False, True])
def test_hold_of_a_body_that_comes_late_begins_when_it_is_there(world: World, client: Client, is_paused: bool) -> None:
    """Regression: it ran from the planned time, so that a body that came 4 s late to a hold of 5 s stayed for one."""
    world.robot.off_plan = HELD_BACK
    start(world, client, item(0, PLACES[0], p=(5, 0, 0, NAN)), item(1, PLACES[1]))
    world.run(1400)
    world.robot.off_plan = np.zeros(3)
    if is_paused:
        client.command(193, 0)
    world.run(10)
    if is_paused:
        assert not world.station.jobs() and client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_PAUSED
        return
    (job,) = world.station.jobs()
    assert [(leg.sequence, leg.hold_s) for leg in job.legs] == [(0, 5.0), (1, 0.0)]
    assert not client.all("MISSION_ITEM_REACHED")
    world.station.planned(0, plan_of(job, first_arrival_s=0.02))
    world.run(50)
    assert [m.seq for m in client.all("MISSION_ITEM_REACHED")][:1] == [0] and not world.station.jobs()


@pytest.mark.slow
def test_delay_without_a_place_is_over_in_time_wherever_the_body_is(world: World, client: Client) -> None:
    world.robot.off_plan = HELD_BACK
    start(world, client, item(0, (0, 0, 0), command=93, frame=2, p=(10, -1, -1, -1)), item(1, PLACES[0]))
    world.run(2100)
    assert {m.seq for m in client.all("MISSION_ITEM_REACHED")} == {0}


def test_body_without_a_pose_has_reached_nothing(world: World, client: Client) -> None:
    start(world, client, item(0, PLACES[0]))
    world.robot.ready = False
    world.run(1600)
    assert not client.all("MISSION_ITEM_REACHED")
    assert client.texts == "mission item 0 is late: its pose is unknown"
    world.robot.ready = True
    world.run(1)
    assert client.last("MISSION_ITEM_REACHED").seq == 0


@pytest.mark.parametrize(
    ("passive", "roll", "reached"),
    [((), 0.0, False), ((2, 3), 0.0, True), ((0, 3, 4), 0.0, False), ((2, 3), math.pi / 2, False), ((1,), math.pi / 2, True)],
)
def test_body_that_leaves_an_axis_to_buoyancy_is_there_wherever_that_holds_it(
    world: World, client: Client, passive: tuple[int, ...], roll: float, reached: bool
) -> None:
    """It is off its place vertically: along its own z axis, or y when it lies on its side."""
    world.robot.q_wb[0] = from_euler(roll, 0.0, 0.0)
    world.robot.bodies[0].passive = passive
    world.robot.off_plan = np.array([0.0, 0.0, 0.6])
    start(world, client, item(0, PLACES[0]))
    world.run(1100)
    assert bool(client.all("MISSION_ITEM_REACHED")) == reached


def test_flight_to_one_place_is_told_to_be_late_too(world: World, client: Client) -> None:
    world.robot.off_plan = HELD_BACK
    world.station.planned(0, plan_of(go_to(world, client)))
    world.run(1600)
    assert client.texts.count("flight is late: 0.40 m from its place") == 1


@pytest.mark.slow
@pytest.mark.parametrize("anew", [False, True])
def test_item_of_a_mission_that_is_over_is_not_told_again_in_the_next_one(world: World, client: Client, anew: bool) -> None:
    """Clients take the item that they heard of last for the farthest: the new mission was done before it began."""
    start(world, client, *(item(i, place) for i, place in enumerate(PLACES)))
    world.run_until(lambda: "mission complete" in client.texts, 4000)
    if anew:
        client.clear()
        client.command(176, 1, 4, 4)
        world.run(2)
    else:
        upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    world.run(100)
    assert not client.all("MISSION_ITEM_REACHED")


@pytest.mark.slow
def test_mission_that_was_replaced_in_flight_is_not_told_to_be_late(world: World, client: Client) -> None:
    world.robot.off_plan = HELD_BACK
    start(world, client, item(0, PLACES[0]))
    upload(world, client, [item(0, PLACES[1])])
    world.run(1700)
    assert "late" not in client.texts
