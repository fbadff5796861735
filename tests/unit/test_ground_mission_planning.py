"""Flights whose plan is still being made: what ends them before they begin, and plans that arrive too late."""

from types import SimpleNamespace

import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.app.mission_plan import plan_mission
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Mode
from firmware_py.ground.plan_jobs import Plan, PlanJob
from tests.unit.ground_missions import PLACES, begin, continued, go_to, item, plan_of, upload
from tests.unit.ground_world import Client, World


def test_a_plan_that_cannot_be_made_is_told_and_the_body_holds(world: World, client: Client) -> None:
    upload(world, client, [item(0, PLACES[0])])
    job = begin(world, client)
    world.station.planned(0, Plan(job.serial, None, (), "the thrusters would be used to 120 %"))
    world.run(2)
    assert "the thrusters would be used to 120 %" in client.texts
    assert world.robot.mode[0] == Mode.POSHOLD


@pytest.mark.parametrize("ticks", [1, 10])
def test_plan_that_comes_after_something_else_was_asked_for_is_not_flown(world: World, client: Client, ticks: int) -> None:
    """Nothing new is planned until the hold has settled. The old request's plan arrives before that, or later."""
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    old = begin(world, client)
    client.command(224, 2)
    world.run(ticks)
    world.station.planned(0, plan_of(old))
    world.run(3)
    assert Action.TRACK not in [r.action for r in world.robot.asked]


def planning(world: World, client: Client) -> PlanJob:
    """Arms, starts the mission and returns the job that is being planned."""
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    job = begin(world, client)
    client.clear()
    return job


def come_back(world: World, job: PlanJob) -> None:
    world.station.planned(0, plan_of(job))


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


@pytest.mark.parametrize("places", [[], PLACES[:2]], ids=["cleared", "another"])
def test_flight_that_is_being_planned_ends_when_its_mission_is_replaced(
    world: World, client: Client, places: list[tuple[int, int, float]]
) -> None:
    """Regression: minutes later, the body flew the mission that its operator had cleared."""
    job = planning(world, client)
    assert world.station.awaited() == [job.serial]
    upload(world, client, [item(i, place) for i, place in enumerate(places)])
    assert world.station.awaited() == [0] and "flight ended before it began: its mission was replaced" in client.texts
    come_back(world, job)
    world.run(120)
    assert world.robot.mode[0] == Mode.POSHOLD
    ready = mavlink.MISSION_STATE_NOT_STARTED if places else mavlink.MISSION_STATE_NO_MISSION
    assert client.last("MISSION_CURRENT").mission_state == ready


def test_way_to_a_place_goes_on_when_a_mission_comes_while_it_is_planned(world: World, client: Client) -> None:
    job = go_to(world, client)
    upload(world, client, [item(0, PLACES[0])])
    come_back(world, job)
    world.run(3)
    assert world.robot.mode[0] == Mode.AUTO


def test_mission_that_comes_on_the_way_to_a_place_is_not_begun_by_choosing_its_item(world: World, client: Client) -> None:
    come_back(world, go_to(world, client))
    world.run(3)
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    client.send("MISSION_SET_CURRENT", 1, 1, 1)
    world.run(10)
    assert world.robot.mode[0] == Mode.AUTO and world.station.jobs() == []


def test_plan_that_nobody_waits_for_any_more_is_not_made_to_its_end(world: World, client: Client) -> None:
    """Planning hundreds of places takes a minute. Regression: the next plan waited for its end."""
    asked = iter([True, True, False])
    plan = plan_mission(planning(world, client), None, lambda: next(asked))
    assert plan.trajectory is None and next(asked, "no more") == "no more"


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


@pytest.mark.parametrize("plan_first", [False, True])
def test_body_that_becomes_another_as_it_is_to_track_its_plan_holds_instead(plan_first: bool) -> None:
    """The request to track names the body by its number, which the body that it has joined may have as well."""
    world = World(2)
    client = world.client()
    world.robot.state[1] = State.ARMED
    job = planning(world, client)
    steps = [lambda: come_back(world, job), world.robot.dock]
    for step in steps if plan_first else steps[::-1]:
        step()
    world.run(5)
    assert Action.TRACK in [r.action for r in world.robot.asked] and world.robot.mode[0] == Mode.POSHOLD
    assert client.texts.count("flight ended before it began: the body is another one") == 1


def test_body_that_becomes_another_as_the_pilot_takes_it_stays_with_the_pilot() -> None:
    """The hold that is to end the tracking of the old body's plan came after the pilot's mode."""
    world = World(2)
    client = world.client()
    world.robot.state[1] = State.ARMED
    come_back(world, planning(world, client))
    client.send("COMMAND_LONG", 1, 1, 176, 0, 1.0, 1.0, 0, 0, 0, 0, 0)
    world.robot.dock()
    world.run(5)
    assert world.robot.mode[0] == Mode.MANUAL
    assert client.texts.count("flight ended before it began: paused, or something else was asked for") == 1


@pytest.mark.parametrize("ticks_before", [1, 20])
def test_flight_that_a_dock_into_another_body_ended_is_not_begun_by_the_undock(ticks_before: int) -> None:
    """Regression: asked for within two ticks of the dock, it was planned and flown when the body was its own again."""
    world = World(2)
    client, apart = world.client(), list(world.robot.bodies)
    world.robot.state[1] = State.ARMED
    world.run(1)
    client.send("COMMAND_INT", 2, 1, 6, 192, 0, 0, -1, 1, 0, float("nan"), 302084010, 1201614000, -0.4)
    world.run(ticks_before)
    world.station.jobs()
    world.robot.dock()
    world.run(500)
    assert client.texts.count("flight ended before it began: the body is another one") == 1
    world.robot.bodies = apart
    world.run(50)
    assert world.station.jobs() == [] and world.robot.mode[1] == Mode.POSHOLD


@pytest.mark.slow
def test_mission_of_a_robot_that_was_part_of_another_meanwhile_is_not_complete_but_paused() -> None:
    world = World(2)
    client, apart = world.client(), list(world.robot.bodies)
    world.robot.state[1] = State.ARMED
    come_back(world, planning(world, client))
    world.run(1100)
    world.robot.bodies = [SimpleNamespace(index=1, modules=(0, 1), passive=())]
    world.run(3000)
    client.clear()
    world.robot.bodies, world.robot.mode[0] = apart, Mode.POSHOLD
    world.run(120)
    assert not client.all("MISSION_ITEM_REACHED") and "mission complete" not in client.texts
    told = [m for m in client.all("MISSION_CURRENT") if m.get_srcSystem() == 1][-1]
    assert (told.mission_state, told.seq) == (mavlink.MISSION_STATE_PAUSED, 1)
    assert continued(world, client) == [1, 2]


def test_way_to_a_place_ends_by_pause_while_it_is_planned(world: World, client: Client) -> None:
    job = go_to(world, client)
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
    for _ in range(20):  # ticks that were queued before the loop took up the request
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
