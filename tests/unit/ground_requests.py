"""Requests of the ground-link tests, and their results."""

from firmware_py.core.types import Action
from tests.unit.ground_world import Client, World

NAN = float("nan")


def acknowledged(world: World, client: Client, number: int) -> int:
    """Waits until a command is acknowledged; returns the result of the last acknowledgement."""
    world.run_until(lambda: any(a.command == number for a in client.all("COMMAND_ACK")))
    return int([a for a in client.all("COMMAND_ACK") if a.command == number][-1].result)


def ask(world: World, client: Client, number: int, *parameters: float) -> int:
    client.clear()
    client.command(number, *parameters)
    return acknowledged(world, client, number)


def actions(world: World) -> list[Action]:
    return [request.action for request in world.robot.asked if request.action != Action.GROUND_ALIVE]
