"""The mission protocol: items are uploaded and downloaded, get lost, arrive late, and are overwritten in part."""

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.unit.ground_missions import PLACES, continued, fly, item, upload
from tests.unit.ground_world import Client, World


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
    assert [(m.get_type(), m.seq) for m in client.all("MISSION_REQUEST_INT") + client.all("MISSION_REQUEST")] == (
        [("MISSION_REQUEST_INT", 0)] * 4 + [("MISSION_REQUEST", 0)]
    )
    client.send("MISSION_ITEM_INT", *item(0, PLACES[0]), 0)
    client.send("MISSION_ITEM_INT", *item(0, PLACES[0]), 0)
    client.send("MISSION_ITEM_INT", *item(1, PLACES[1]), 0)
    world.run(1)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_ACCEPTED


def test_client_that_knows_only_the_old_request_for_an_item_brings_its_mission_up(world: World, client: Client) -> None:
    """DroneKit is such a client, because ArduPilot sends no other request; it answers in degrees."""
    client.send("MISSION_COUNT", 1, 1, 3, 0)
    answered = 0
    for _ in range(400):
        world.run(1)
        asked = client.all("MISSION_REQUEST")
        for request in asked[answered:]:
            client.send("MISSION_ITEM", 1, 1, request.seq, 3, 16, 0, 1, 0, 0, 0, 0, 30.2084, 120.1614, -0.4)
        answered = len(asked)
    assert [ack.type for ack in client.all("MISSION_ACK")] == [mavlink.MAV_MISSION_ACCEPTED]


def test_client_that_refuses_the_old_request_for_an_item_goes_on_with_the_new_one(world: World, client: Client) -> None:
    """MAVSDK does so."""
    client.send("MISSION_COUNT", 1, 1, 1, 0)
    world.run_until(lambda: bool(client.all("MISSION_REQUEST")))
    client.send("MISSION_ACK", 1, 1, mavlink.MAV_MISSION_UNSUPPORTED, 0)
    client.clear()
    world.run_until(lambda: bool(client.all("MISSION_REQUEST_INT")))
    client.send("MISSION_ACK", 1, 1, mavlink.MAV_MISSION_UNSUPPORTED, 0)
    client.clear()
    world.run(100)
    assert not client.all("MISSION_REQUEST_INT") and not client.all("MISSION_REQUEST"), "it gave the whole up"


def test_items_of_two_stations_of_one_number_do_not_mix(world: World, client: Client) -> None:
    """Two QGroundControls have the same number; the later transfer replaces the earlier one."""
    other = world.client()
    client.send("MISSION_COUNT", 1, 1, 2, 0)
    other.send("MISSION_COUNT", 1, 1, 2, 0)
    for sender, place in ((client, PLACES[0]), (other, PLACES[1])):
        for sequence in (0, 1):
            sender.send("MISSION_ITEM_INT", *item(sequence, place), 0)
    world.run(1)
    assert not client.all("MISSION_ACK") and other.last("MISSION_ACK").type == mavlink.MAV_MISSION_ACCEPTED
    assert {i.x for i in world.station.services[1].flight.items} == {PLACES[1][0]}


def test_last_item_that_comes_again_is_answered_again_while_another_station_sends_a_mission(world: World, client: Client) -> None:
    """Regression: a station whose mission was accepted, but whose acknowledgement was lost, was never told."""
    other = world.client(254)
    assert upload(world, client, [item(0, PLACES[0])]) == mavlink.MAV_MISSION_ACCEPTED
    other.send("MISSION_COUNT", 1, 1, 2, 0)
    client.clear()
    client.send("MISSION_ITEM_INT", *item(0, PLACES[0]), 0)
    world.run(2)
    assert [ack.type for ack in client.all("MISSION_ACK")] == [mavlink.MAV_MISSION_ACCEPTED] and not other.all("MISSION_ACK")
    for sequence in (0, 1):
        other.send("MISSION_ITEM_INT", *item(sequence, PLACES[1]), 0)
    world.run(2)
    assert [ack.type for ack in other.all("MISSION_ACK")] == [mavlink.MAV_MISSION_ACCEPTED]


def test_station_that_sends_a_mission_while_another_one_does_is_denied_in_words(world: World, client: Client) -> None:
    other = world.client(254)
    for station in (client, other):
        station.send("MISSION_COUNT", 1, 1, 2, 0)
    world.run(1)
    assert [ack.type for ack in other.all("MISSION_ACK")] == [mavlink.MAV_MISSION_DENIED] and not client.all("MISSION_ACK")
    assert other.texts == "mission refused: another station is sending one"


@pytest.mark.parametrize("system", [254, 255], ids=["another", "of the same number"])
def test_mission_that_is_being_sent_is_not_cleared_by_another_station(world: World, client: Client, system: int) -> None:
    """It would end without a word to its sender, which waits for requests of items that never come."""
    other = world.client(system)
    client.send("MISSION_COUNT", 1, 1, 2, 0)
    other.send("MISSION_CLEAR_ALL", 1, 1, 0)
    world.run(1)
    assert [ack.type for ack in other.all("MISSION_ACK")] == [mavlink.MAV_MISSION_DENIED]
    assert other.texts == "mission refused: another station is sending one"
    for number in range(2):
        client.send("MISSION_ITEM_INT", *item(number, PLACES[number]), 0)
        world.run(1)
    assert [ack.type for ack in client.all("MISSION_ACK")] == [mavlink.MAV_MISSION_ACCEPTED]
    other.send("MISSION_CLEAR_ALL", 1, 1, 0)
    world.run(1)
    assert other.last("MISSION_ACK").type == mavlink.MAV_MISSION_ACCEPTED and not world.station.services[1].flight.items


def test_station_clears_the_mission_that_it_is_sending_itself_over_a_new_link_too(world: World, client: Client) -> None:
    client.send("MISSION_COUNT", 1, 1, 2, 0)
    world.run(1)
    world.station.leave(client.channel)
    again = world.client()
    again.send("MISSION_CLEAR_ALL", 1, 1, 0)
    world.run(1)
    assert [ack.type for ack in again.all("MISSION_ACK")] == [mavlink.MAV_MISSION_ACCEPTED]


@pytest.mark.parametrize("current", [2, 3])
@pytest.mark.parametrize("name", ["MISSION_ITEM", "MISSION_ITEM_INT"])
def test_item_that_is_a_place_to_go_to_at_once_is_refused_and_told_of(world: World, client: Client, name: str, current: int) -> None:
    """ArduPilot's way before there was a command for it, used by DroneKit's simple_goto and by QGroundControl before 4.3."""
    client.send(name, 1, 1, 0, 3, 16, current, 1, 0, 0, 0, 0, 30, 120, -0.4)
    world.run(1)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_UNSUPPORTED and "COMMAND_INT" in client.texts


@pytest.mark.parametrize("last", [item(1, PLACES[1]), item(1, PLACES[1], command=22)])
def test_last_item_that_comes_again_is_answered_again(world: World, client: Client, last: tuple[float, ...]) -> None:
    """A client whose acknowledgement was lost resends its last item until it receives one."""
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
    assert [ack.type for ack in client.all("MISSION_ACK")] == [mavlink.MAV_MISSION_ACCEPTED]  # only for MISSION_CLEAR_ALL


@pytest.mark.parametrize(("kind", "asked_again"), [(0, 0), (1, 1), (2, 1)])
def test_client_that_gives_up_fences_or_rally_points_goes_on_with_its_mission(
    world: World, client: Client, kind: int, asked_again: int
) -> None:
    client.send("MISSION_COUNT", 1, 1, 2, 0)
    world.run(1)
    client.send("MISSION_ACK", 1, 1, mavlink.MAV_MISSION_OPERATION_CANCELLED, kind)
    client.clear()
    world.run(30)
    assert len(client.all("MISSION_REQUEST_INT")) == asked_again


def test_a_transfer_that_breaks_off_leaves_the_old_mission(world: World, client: Client) -> None:
    upload(world, client, [item(0, PLACES[0])])
    client.clear()
    client.send("MISSION_COUNT", 1, 1, 3, 0)
    world.run(600)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_OPERATION_CANCELLED
    assert len(world.station.services[1].flight.items) == 1


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


def test_mission_that_flies_is_not_written_over_in_part_and_a_paused_one_goes_on_where_it_was(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    world.run(1100)
    client.clear()
    client.send("MISSION_WRITE_PARTIAL_LIST", 1, 1, 2, 2, 0)
    world.run(2)
    assert client.last("MISSION_ACK").type == mavlink.MAV_MISSION_DENIED
    assert "mission refused: it flies, and is not changed in part" in client.texts
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
    assert "mission refused: it flies, and is not changed in part" in client.texts
    assert world.station.services[1].flight.items == before
