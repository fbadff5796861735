"""Several bodies, each its own MAVLink system: commands and refusals stay separate; docked bodies form their leader's system."""

from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.core.failsafes import PILOTED
from firmware_py.core.supervisor import Supervisor
from firmware_py.core.transitions import State
from firmware_py.core.types import WARNING, Action, Event, Mode
from firmware_py.description.parameters import Parameters
from tests.unit.failsafe_causes import FIELDS, ROWS, bad, quick
from tests.unit.ground_missions import PLACES, item, upload
from tests.unit.ground_requests import NAN
from tests.unit.ground_world import Client, World


@pytest.fixture
def world() -> World:
    return World(modules=2)


@pytest.mark.parametrize("name", FIELDS)
def test_each_fail_safe_is_told_by_the_system_of_its_body(world: World, client: Client, name: str) -> None:
    supervisor = Supervisor(replace(Parameters(), failsafes=quick(name)))
    supervisor.state, supervisor.mode = State.ARMED, Mode.MANUAL if ROWS[name].modes == PILOTED else Mode.GUIDED
    supervisor.step(False, bad(name), [])
    world.robot.events = [event._replace(body=1) for event in supervisor.events]
    world.run(1)
    said = client.all("STATUSTEXT")
    assert {text.get_srcSystem() for text in said} == {2}
    assert "".join(text.text for text in said).startswith(f"fail-safe on: {ROWS[name].words}")


def test_refusal_of_one_body_is_told_by_its_system_and_answers_its_command_alone(world: World, client: Client) -> None:
    world.robot.refuse[Action.ARM] = "no tag was seen"
    client.command(400, 1, target=2)
    client.command(176, 1, 1, target=1)
    world.run(3)
    assert {(ack.get_srcSystem(), ack.command, ack.result) for ack in client.all("COMMAND_ACK")} == {(2, 400, 2), (1, 176, 0)}
    assert [(t.get_srcSystem(), t.text) for t in client.all("STATUSTEXT")] == [(2, "ARM refused: no tag was seen")]


def test_what_is_refused_to_one_body_does_not_answer_the_same_command_to_another(world: World, client: Client) -> None:
    client.command(400, 1, target=1)
    client.command(400, 1, target=2)
    world.robot.events = [Event(4, "ARM refused: no tag was seen", 1)]
    world.run(3)
    assert {(ack.get_srcSystem(), ack.result) for ack in client.all("COMMAND_ACK")} == {(1, 0), (2, 2)}


def test_what_is_about_no_body_is_told_once(world: World, client: Client) -> None:
    world.robot.events = [Event(4, "no more log"), Event(6, "body 1 is one with body 0", 7)]
    world.run(1)
    assert [(t.get_srcSystem(), t.text) for t in client.all("STATUSTEXT")] == [(1, "no more log"), (1, "body 1 is one with body 0")]


def test_docked_bodies_are_their_leaders_system_with_everything_of_every_module(world: World, client: Client) -> None:
    world.robot.dock()
    world.run(2)
    client.clear()
    world.run(250)
    assert {m.get_srcSystem() for m in client.all("ATTITUDE")} == {1}
    assert {m.id for m in client.all("BATTERY_STATUS")} == {0, 1}
    assert {m.port for m in client.all("SERVO_OUTPUT_RAW")} == {0, 1}
    assert {m.name for m in client.all("NAMED_VALUE_FLOAT")} >= {"DOCK0+X", "DOCK1+X", "WRENCH_MRG"}
    client.send("MANUAL_CONTROL", 1, 500, 0, 500, 0, 0)
    client.send("MANUAL_CONTROL", 2, 500, 0, 500, 0, 0)
    client.command(209, 16, 0, 20, 1.0)
    client.command(400, 1, target=2)
    world.run(2)
    assert [(r.action, r.body) for r in world.robot.asked] == [(Action.STICKS, 0), (Action.MOTOR_TEST, 0)]


def test_undock_of_a_disarmed_body_is_accepted_once_it_is_two(world: World, client: Client) -> None:
    """A disarmed body enters no mode, so only the split shows that the undock was accepted."""
    apart = world.robot.bodies
    world.robot.dock()
    world.run(10)
    client.command(31011, 2, 1, 1, 0)
    world.run(10)
    assert not client.all("COMMAND_ACK")
    world.robot.bodies = apart
    world.run(2)
    assert [(ack.command, ack.result) for ack in client.all("COMMAND_ACK")] == [(31011, mavlink.MAV_RESULT_ACCEPTED)]


def test_undock_of_modules_that_are_apart_is_not_accepted_before_it_is_refused(world: World, client: Client) -> None:
    """A tick that had ended before the request decides nothing about it."""
    world.run(10)
    client.command(31011, 1, 0, 2, 1)
    world.run(2)
    assert not client.all("COMMAND_ACK")
    world.robot.events = [Event(WARNING, "UNDOCK refused: modules 1 and 2 are not of one body", 0)]
    world.run(2)
    assert [(ack.command, ack.result) for ack in client.all("COMMAND_ACK")] == [(31011, mavlink.MAV_RESULT_DENIED)]


def test_parted_bodies_are_two_systems_again(world: World, client: Client) -> None:
    apart = world.robot.bodies
    world.robot.dock()
    world.run(10)
    world.robot.bodies = apart
    client.clear()
    world.run(101)
    assert {m.get_srcSystem() for m in client.all("HEARTBEAT")} == {1, 2}


@pytest.fixture
def docked(world: World, client: Client) -> World:
    """Two armed bodies that have docked; system 1 leads."""
    for target in (1, 2):
        client.command(400, 1, target=target)
    world.run(3)
    world.robot.dock()
    world.run(3)
    world.robot.asked.clear()
    client.clear()
    return world


def asked_of(world: World) -> list[tuple[Action, int]]:
    return [(request.action, request.body) for request in world.robot.asked]


def answers(client: Client) -> list[tuple[int, int, int]]:
    return [(ack.get_srcSystem(), ack.command, ack.result) for ack in client.all("COMMAND_ACK")]


@pytest.mark.parametrize(("number", "parameter", "action"), [(31012, 0, Action.ESTOP), (185, 1, Action.ESTOP), (400, 0, Action.DISARM)])
def test_what_stops_a_docked_system_reaches_the_body_that_holds_its_module(
    docked: World, client: Client, number: int, parameter: float, action: Action
) -> None:
    client.command(number, parameter, target=2)
    docked.run(5)
    assert asked_of(docked) == [(action, 0)]
    assert answers(client) == [(2, number, 0)]
    assert docked.robot.state[0] != State.ARMED


@pytest.mark.parametrize(("button", "action"), [(4, Action.DISARM), (7, Action.ESTOP)])
def test_stopping_buttons_of_a_docked_system_act_and_its_sticks_do_not(docked: World, client: Client, button: int, action: Action) -> None:
    client.send("MANUAL_CONTROL", 2, 500, 0, 500, 0, 1 << button | 1 << 6 | 1 << 1)
    docked.run(2)
    assert asked_of(docked) == [(action, 0)]


def test_refused_disarming_of_a_docked_system_is_answered_by_it(docked: World, client: Client) -> None:
    docked.robot.refuse[Action.DISARM] = "it moves"
    client.command(400, 0, target=2)
    docked.run(3)
    assert answers(client) == [(2, 400, 2)]


@pytest.mark.parametrize(("number", "parameter"), [(400, 1), (176, 1), (185, 0), (31013, 0), (300, 0), (2000, 0)])
def test_every_other_command_to_a_docked_system_is_refused_with_the_name_of_its_leader(
    docked: World, client: Client, number: int, parameter: float
) -> None:
    client.command(number, parameter, 1, target=2)
    docked.run(2)
    assert answers(client) == [(2, number, 1)]
    assert client.texts == "system 2 is not steered: docked, system 1 leads it now"
    assert not asked_of(docked)


def test_old_mode_message_to_a_docked_system_is_refused_too(docked: World, client: Client) -> None:
    client.send("SET_MODE", 2, 1, 1 << 16)
    docked.run(2)
    assert answers(client) == [(2, 176, 1)] and not asked_of(docked)


def test_streams_to_a_docked_system_are_told_of_once_in_five_seconds(docked: World, client: Client) -> None:
    for _ in range(100):
        client.send("MANUAL_CONTROL", 2, 500, 0, 500, 0, 0)
        client.send("RC_CHANNELS_OVERRIDE", 2, 1, *[1600] * 8)
        client.send("PARAM_SET", 2, 1, b"STICK_Z", 1.0, 9)
        docked.run(9)
    assert client.texts.count("system 1 leads it now") == 2
    assert not asked_of(docked) and docked.station.store.values.ground.stick_z == 0


def test_what_is_for_all_is_not_refused_by_a_docked_system(docked: World, client: Client) -> None:
    client.command(410, target=0)
    docked.run(2)
    assert answers(client) == [(1, 410, 0)] and not client.texts


def test_body_that_has_parted_watches_the_station_that_all_watch(world: World, client: Client) -> None:
    """Regression: a parted body took heartbeats from the first station it heard, so the loss of the watched one stopped no body."""
    other, apart = world.client(254), world.robot.bodies
    client.heartbeat()
    world.robot.dock()
    for _ in range(7):
        client.heartbeat()
        world.run(100)
    world.robot.bodies = apart
    world.run(1)
    world.robot.asked.clear()
    for _ in range(2):
        other.heartbeat()
        world.run(100)
    assert not [request for request in world.robot.asked if request.action == Action.GROUND_ALIVE]
    client.heartbeat()
    world.run(1)
    assert {request.body for request in world.robot.asked if request.action == Action.GROUND_ALIVE} == {0, 1}
    assert "254/190 is watched" not in client.texts


GOES_TO_PLACES = {
    "COMMAND_INT": ((0, 0, 6, 192, 0, 0, -1, 1, 0, NAN, 302084010, 1201614000, -0.4), "COMMAND_ACK", "result", mavlink.MAV_RESULT_DENIED),
    "MISSION_COUNT": ((0, 0, 1), "MISSION_ACK", "type", mavlink.MAV_MISSION_DENIED),
    "MISSION_WRITE_PARTIAL_LIST": ((0, 0, 0, 0), "MISSION_ACK", "type", mavlink.MAV_MISSION_DENIED),
}
"""Messages addressed to all systems, and how each is refused where there are several bodies."""


@pytest.mark.parametrize("name", GOES_TO_PLACES)
def test_place_that_is_for_all_is_gone_to_by_the_one_body_and_of_several_by_none(world: World, client: Client, name: str) -> None:
    """Regression: both bodies planned a path to the one place."""
    values, answer, field, denied = GOES_TO_PLACES[name]
    for system in (1, 2):
        upload(world, client, [item(0, PLACES[0])], target=system)
    client.command(400, 1, target=0)
    world.run(3)
    client.clear()
    client.send(name, *values)
    world.run(10)
    assert [getattr(m, field) for m in client.all(answer)] == [denied, denied]
    assert world.station.jobs() == [] and not client.all("MISSION_REQUEST_INT")
    assert client.texts.count("it is for all, and there are several bodies") == 2
    world.robot.dock()
    world.run(1)
    client.send(name, *values)
    world.run(10)
    assert len(world.station.jobs()) + len(client.all("MISSION_REQUEST_INT")) == 1
