"""Clients' requests about messages: the rate of one, the rates of a group, and single messages."""

from collections import Counter

import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.ground.dialect import load_dialect
from firmware_py.ground.identity import px4
from firmware_py.ground.telemetry import STREAMS
from firmware_py.ground.tick_times import Times
from tests.unit.ground_requests import ask
from tests.unit.ground_world import Client, World


def sent(world: World, ticks: int = 1) -> Counter[int]:
    """Number of frames sent, by message number."""
    counts: Counter[int] = Counter()
    for _ in range(ticks):
        inputs, outputs = world.robot.step(world.station.requests())
        world.station.observe(inputs, outputs, world.robot.bodies)
        counts.update(int.from_bytes(frame[7:10], "little") for _, frame in world.station.frames(outputs.time_ns))
    return counts


@pytest.mark.parametrize("name", sorted(STREAMS.keys() - {"HEARTBEAT"}))
def test_every_message_stops_comes_once_and_streams_as_it_is_asked_to(world: World, client: Client, name: str) -> None:
    world.station.picture.times = Times(0.1, (1,) * 20, (1,) * 20)  # as of a loop that runs on a clock; in lockstep no tick is late
    number = load_dialect().by_name[name].number
    client.command(511, number, -1)
    assert not sent(world, 210)[number]
    client.command(512, number)
    once = sent(world)[number]
    assert once > 0
    client.command(511, number, 250_000)
    assert sent(world, 100)[number] == 5 * once, "at once, and every 250 ms"


def test_message_interval_sets_the_rate_of_this_link_alone(world: World, client: Client) -> None:
    other = world.client(254)
    assert ask(world, client, 511, mavlink.MAVLINK_MSG_ID_ATTITUDE, 20_000) == mavlink.MAV_RESULT_ACCEPTED
    client.clear()
    other.clear()
    world.run(100)
    assert (len(client.all("ATTITUDE")), len(other.all("ATTITUDE"))) == (50, 10)
    ask(world, client, 511, mavlink.MAVLINK_MSG_ID_ATTITUDE, -1)
    client.clear()
    world.run(100)
    assert not client.all("ATTITUDE")
    assert ask(world, client, 510, mavlink.MAVLINK_MSG_ID_ATTITUDE) == mavlink.MAV_RESULT_ACCEPTED
    assert client.last("MESSAGE_INTERVAL").interval_us == -1


@pytest.mark.slow
def test_group_of_messages_streams_as_an_ardusubs_client_asks_on_its_link_alone(world: World, client: Client) -> None:
    """REQUEST_DATA_STREAM, by which QGroundControl, MAVProxy (`set streamrate`) and scripts set rates."""
    other = world.client(254)

    def streamed(group: int, hz: int, start: int = 1) -> list[int]:
        client.send("REQUEST_DATA_STREAM", 1, 1, group, hz, start)
        world.run(1)
        client.clear()
        other.clear()
        world.run(100)
        assert len(other.all("ATTITUDE")) == 10 and client.all("HEARTBEAT")
        return [len(client.all(name)) for name in ("ATTITUDE", "VFR_HUD", "SYS_STATUS", "SERVO_OUTPUT_RAW")]

    assert streamed(mavlink.MAV_DATA_STREAM_EXTRA1, 50) == [50, 4, 2, 2]
    assert streamed(mavlink.MAV_DATA_STREAM_EXTRA1, 20, start=2) == [50, 4, 2, 2], "neither starts nor stops"
    assert streamed(mavlink.MAV_DATA_STREAM_ALL, 5) == [5, 5, 5, 5]
    assert streamed(mavlink.MAV_DATA_STREAM_ALL, 65535) == [100, 100, 100, 100], "once in a tick"
    assert streamed(mavlink.MAV_DATA_STREAM_EXTRA2, 5, start=0) == [100, 0, 100, 100]
    assert streamed(mavlink.MAV_DATA_STREAM_RAW_CONTROLLER, 5) == [100, 0, 100, 100], "there is nothing of it here"
    assert streamed(mavlink.MAV_DATA_STREAM_ALL, 0) == [0, 0, 0, 0]


def test_rates_that_are_asked_of_a_docked_body_again_and_again_are_no_warning_and_count_once_it_is_undocked() -> None:
    world = World(modules=2)
    client, apart = world.client(), world.robot.bodies
    world.robot.dock()
    world.run(1)
    client.clear()
    client.send("REQUEST_DATA_STREAM", 2, 1, mavlink.MAV_DATA_STREAM_ALL, 1, 1)
    world.run(10)
    assert not client.texts
    world.robot.bodies = apart
    client.clear()
    world.run(200)
    assert sum(m.get_srcSystem() == 2 for m in client.all("ATTITUDE")) in (2, 3)


def test_heartbeat_cannot_be_switched_off(world: World, client: Client) -> None:
    assert ask(world, client, 511, mavlink.MAVLINK_MSG_ID_HEARTBEAT, -1) == mavlink.MAV_RESULT_DENIED


def test_request_message_sends_it_once(world: World, client: Client) -> None:
    ask(world, client, 511, mavlink.MAVLINK_MSG_ID_ATTITUDE, -1)
    assert ask(world, client, 512, mavlink.MAVLINK_MSG_ID_ATTITUDE) == mavlink.MAV_RESULT_ACCEPTED
    assert len(client.all("ATTITUDE")) == 1
    assert ask(world, client, 512, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == mavlink.MAV_RESULT_ACCEPTED
    assert client.last("AUTOPILOT_VERSION").capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    assert ask(world, client, 512, mavlink.MAVLINK_MSG_ID_VIBRATION) == mavlink.MAV_RESULT_UNSUPPORTED


def test_available_modes_are_told_one_by_one(world: World, client: Client) -> None:
    ask(world, client, 512, mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES, 0)
    modes = client.all("AVAILABLE_MODES")
    assert len(modes) == modes[0].number_modes and modes[0].mode_name == "Manual"
    ask(world, client, 512, mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES, 4)
    assert (client.last("AVAILABLE_MODES").custom_mode, client.last("AVAILABLE_MODES").mode_name) == (px4(4, 3), "Position Hold")
    dock = modes[-1]
    assert (dock.custom_mode, dock.mode_name, dock.properties) == (px4(4, 9), "Dock", mavlink.MAV_MODE_PROPERTY_NOT_USER_SELECTABLE)
    assert not any(mode.properties for mode in modes[:-1])
    assert ask(world, client, 512, mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES, 10) == mavlink.MAV_RESULT_DENIED


def test_home_position_can_be_asked_for(world: World, client: Client) -> None:
    assert ask(world, client, 410) == mavlink.MAV_RESULT_ACCEPTED
    assert client.all("HOME_POSITION")
