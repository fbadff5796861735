"""Several bodies, each a system of its own: what one of them is told or refused is no other's; docked ones are their leader's system."""

from dataclasses import replace

import pytest

from firmware_py.core.supervisor import Supervisor
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Event, Mode
from firmware_py.description.parameters import Parameters
from tests.unit.ground_world import Client, World
from tests.unit.test_failsafes import FIELDS, PILOTED, ROWS, bad, quick


@pytest.fixture
def world() -> World:
    return World(modules=2)


@pytest.fixture
def client(world: World) -> Client:
    return world.client()


@pytest.mark.parametrize("name", FIELDS)
def test_each_fail_safe_is_told_by_the_system_of_its_body(world: World, client: Client, name: str) -> None:
    supervisor = Supervisor(replace(Parameters(), failsafes=quick(name)))
    supervisor.state, supervisor.mode = State.ARMED, Mode.MANUAL if ROWS[name].modes == PILOTED else Mode.GUIDED
    supervisor.step(False, bad(name), [])
    world.robot.events = [event._replace(body=1) for event in supervisor.events]
    world.run(1)
    said = client.all("STATUSTEXT")
    assert {text.get_srcSystem() for text in said} == {2}
    assert "".join(text.text for text in said).startswith(f"fail-safe on: {ROWS[name].words.split('{')[0]}")


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


def test_parted_bodies_are_two_systems_again(world: World, client: Client) -> None:
    apart = world.robot.bodies
    world.robot.dock()
    world.run(10)
    world.robot.bodies = apart
    client.clear()
    world.run(101)
    assert {m.get_srcSystem() for m in client.all("HEARTBEAT")} == {1, 2}
