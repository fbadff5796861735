"""Several senders of sticks: one has control at a time, and a stop is accepted from everybody."""

import pytest

from firmware_py.core.types import Action
from firmware_py.ground.config import GroundConfig
from tests.unit.ground_world import Client, World

ARM_BUTTON, DISARM_BUTTON, ESTOP_BUTTON = 1 << 6, 1 << 4, 1 << 7


def sticks(world: World) -> list[float]:
    """Forward stick of each accepted request."""
    return [r.argument.force[0] for r in world.robot.asked if r.action == Action.STICKS]


def buttons(world: World) -> list[Action]:
    return [r.action for r in world.robot.asked if r.action != Action.STICKS]


@pytest.mark.parametrize("watched", [0, 255])
def test_two_streams_do_not_mix(watched: int) -> None:
    world = World(config=GroundConfig(watch_system=watched))
    pilot, other = world.client(255), world.client(77)
    for _ in range(100):
        pilot.send("MANUAL_CONTROL", 1, 1000, 0, 500, 0, ARM_BUTTON)
        other.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, 1 << 1)
        world.run(1)
    assert sticks(world) == [1.0] * 100 and buttons(world) == [Action.ARM]


def test_two_senders_of_one_system_do_not_mix_either() -> None:
    world = World(config=GroundConfig(watch_system=255))
    pilot, other = world.client(255, 190), world.client(255, 191)
    for client, stick in ((pilot, 1000), (other, 0), (pilot, 1000)):
        client.send("MANUAL_CONTROL", 1, stick, 0, 500, 0, ARM_BUTTON if stick else 0)
    world.run(1)
    assert sticks(world) == [1.0, 1.0] and buttons(world) == [Action.ARM]


def test_sticks_of_another_than_the_watched_station_are_never_taken() -> None:
    world = World(config=GroundConfig(watch_system=255))
    other = world.client(77)
    other.send("MANUAL_CONTROL", 1, 1000, 0, 500, 0, ARM_BUTTON)
    other.send("RC_CHANNELS_OVERRIDE", 1, 1, *[1600] * 8)
    world.run(100)
    other.send("MANUAL_CONTROL", 1, 1000, 0, 500, 0, ARM_BUTTON)
    world.run(1)
    assert not world.robot.asked


def test_station_whose_sticks_are_never_taken_is_told_so_once() -> None:
    """Regression: a station moved its sticks, nothing moved, and no message said why."""
    world = World(config=GroundConfig(watch_system=255))
    other = world.client(77)
    for _ in range(100):
        other.send("MANUAL_CONTROL", 1, 1000, 0, 500, 0, ARM_BUTTON)
        other.send("RC_CHANNELS_OVERRIDE", 1, 1, *[1600] * 8)
        world.run(10)
    assert other.texts == "sticks of 77/190 are not taken: it is not the watched ground station"


def test_sticks_pass_to_another_only_after_the_timeout() -> None:
    world = World()
    pilot, other = world.client(255), world.client(77)
    pilot.send("MANUAL_CONTROL", 1, 1000, 0, 500, 0, 0)
    ticks = round(world.parameters.steering.stick_timeout_s * 100)
    for _ in range(ticks):
        world.run(1)
        other.send("RC_CHANNELS_OVERRIDE", 1, 1, 1500, 1500, 1500, 1500, 1300, 1500, 0, 0)
    assert sticks(world) == [1.0]
    world.run(1)
    other.send("RC_CHANNELS_OVERRIDE", 1, 1, 1500, 1500, 1500, 1500, 1300, 1500, 0, 0)
    pilot.send("MANUAL_CONTROL", 1, 1000, 0, 500, 0, 0)
    world.run(1)
    assert sticks(world) == [1.0, -0.5]
    assert "ground station 77/190 has the sticks" in other.texts


def places(world: World) -> list[float]:
    """x of each accepted set-point."""
    return [r.argument.p_wb[0] for r in world.robot.asked if r.action == Action.SET_POINT]


def test_set_points_of_two_do_not_mix_and_pass_to_the_other_after_the_first_is_silent() -> None:
    """The second sender may also send attitudes; the first may be a companion computer instead of the watched station."""
    world = World(config=GroundConfig(watch_system=255))
    first, other = world.client(254), world.client(255)
    for _ in range(10):
        first.send("SET_POSITION_TARGET_LOCAL_NED", 0, 1, 1, 1, 0xDF8, 0.3, 0.1, 0.4, *[0.0] * 8)
        other.send("SET_POSITION_TARGET_LOCAL_NED", 0, 1, 1, 1, 0xDF8, -0.3, 0.1, 0.4, *[0.0] * 8)
        other.send("SET_ATTITUDE_TARGET", 0, 1, 1, 0x7, [1.0, 0.0, 0.0, 0.0], 0, 0, 0, 0.5)
        world.run(1)
    assert places(world) == pytest.approx([0.3] * 10)
    assert other.texts.count("ground station 254/190 has the set-points") == 1
    world.run(round(world.parameters.ground.setpoint_fresh_s * 100) + 1)
    for client, x in ((other, -0.3), (first, 0.3)):
        client.send("SET_POSITION_TARGET_LOCAL_NED", 0, 1, 1, 1, 0xDF8, x, 0.1, 0.4, *[0.0] * 8)
    world.run(1)
    assert places(world)[10:] == pytest.approx([-0.3])
    assert "ground station 255/190 has the set-points" in other.texts


def test_button_that_was_held_before_the_sticks_passed_is_not_pressed_by_that() -> None:
    world = World()
    pilot, other = world.client(255), world.client(77)
    pilot.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, 0)
    for _ in range(100):
        other.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, ARM_BUTTON)
        world.run(1)
    assert len(sticks(world)) > 40 and not buttons(world)


@pytest.mark.parametrize("watched", [0, 255])
def test_estop_and_disarm_buttons_are_taken_from_everybody(watched: int) -> None:
    world = World(config=GroundConfig(watch_system=watched))
    pilot, other = world.client(255), world.client(77)
    for _ in range(3):
        pilot.send("MANUAL_CONTROL", 1, 1000, 0, 500, 0, 0)
        other.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, ESTOP_BUTTON | DISARM_BUTTON | ARM_BUTTON)
        world.run(1)
    assert sticks(world) == [1.0] * 3 and buttons(world) == [Action.DISARM, Action.ESTOP]


@pytest.mark.parametrize(("together", "last"), [(DISARM_BUTTON | ARM_BUTTON, Action.DISARM), (ESTOP_BUTTON | 1 << 8, Action.ESTOP)])
def test_of_buttons_that_are_pressed_together_what_stops_counts(world: World, client: Client, together: int, last: Action) -> None:
    """Regression: disarm with arm armed the robot, and an e-stop was cleared before any module had received it."""
    client.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, together)
    world.run(1)
    assert len(buttons(world)) == 2 and buttons(world)[-1] == last


@pytest.mark.parametrize("raw", [0, 65535])
def test_override_of_no_channel_is_nothing(world: World, client: Client, raw: int) -> None:
    other = world.client(77)
    client.send("RC_CHANNELS_OVERRIDE", 1, 1, *[raw] * 8)
    world.run(1)
    assert not world.robot.asked
    other.send("MANUAL_CONTROL", 1, 1000, 0, 500, 0, 0)
    world.run(1)
    assert sticks(world) == [1.0], "nobody had the sticks"


def test_override_that_ignores_every_channel_does_not_hold_the_sticks(world: World, client: Client) -> None:
    other = world.client(77)
    client.send("RC_CHANNELS_OVERRIDE", 1, 1, *[1500] * 4, 1700, *[65535] * 3)
    world.run(10)
    client.send("RC_CHANNELS_OVERRIDE", 1, 1, *[65535] * 8)
    world.run(round(world.parameters.steering.stick_timeout_s * 100) - 5)
    other.send("MANUAL_CONTROL", 1, 1000, 0, 500, 0, 0)
    world.run(1)
    assert sticks(world) == [0.5, 1.0]


STEERS = {
    "RC_CHANNELS_OVERRIDE": (0, 0, *[1500] * 4, 1700, *[65535] * 3),
    "SET_POSITION_TARGET_LOCAL_NED": (0, 0, 0, 1, 0xDF8, 0.3, 0.1, 0.4, *[0.0] * 8),
    "SET_ATTITUDE_TARGET": (0, 0, 0, 0x7, [1.0, 0.0, 0.0, 0.0], 0, 0, 0, 0.5),
}
"""Messages addressed to all systems, as all of DroneKit's are."""


@pytest.mark.parametrize("name", STEERS)
def test_what_steers_and_is_for_all_steers_the_one_body_and_of_several_none(name: str) -> None:
    """Otherwise several bodies would be steered to one place."""
    world = World(2)
    client = world.client()
    for _ in range(3):
        client.send(name, *STEERS[name])
        world.run(1)
    assert not world.robot.asked
    for system in (1, 2):
        assert client.texts.count(f"system {system} is not steered: target 0, and there are 2 bodies") == 1
    world.robot.dock()
    world.run(1)
    client.send(name, *STEERS[name])
    world.run(1)
    assert [request.body for request in world.robot.asked] == [0]
