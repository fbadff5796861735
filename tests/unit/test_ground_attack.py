"""Packets from an enemy or a bad radio: few here; with MODCUBE_FULL=1 a million, and a hundred thousand forged ones."""

from collections import Counter

import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.core.transitions import State
from firmware_py.ground.dialect import load_dialect
from firmware_py.ground.signing import Signing
from firmware_py.ground.wire import Framer
from tests.figures import at_length, figure
from tests.unit.ground_attack import Attack, forge
from tests.unit.ground_world import Client, World


def assert_in_control(world: World, station: Client) -> None:
    """Asserts that the station can clear the e-stop, arm and disarm: each command is acknowledged and carried out."""
    for number, parameter, state in ((31013, 0, State.DISARMED), (400, 1, State.ARMED), (400, 0, State.DISARMED)):
        station.clear()
        station.command(number, parameter)
        world.run_until(lambda: bool(station.all("COMMAND_ACK")))
        answer = station.last("COMMAND_ACK")
        assert (answer.command, answer.result) == (number, mavlink.MAV_RESULT_ACCEPTED)
        assert world.robot.state[0] == state


@pytest.mark.slow
def test_random_and_mutated_packets_do_nothing_that_a_valid_sender_could_not() -> None:
    attack = Attack(seed=1)
    attack.run(at_length(1_000_000, 20_000))
    counts = attack.world.station.counts
    share = attack.packets / 20_000
    assert counts["good"] > 5_000 * share and counts["checksum"] > 3_000 * share and counts["garbage"] > 100_000 * share
    assert_in_control(attack.world, attack.client)
    figure("random and mutated packets without exception or a change that no valid sender could cause", attack.packets)


def test_forged_and_replayed_packets_are_refused_and_the_real_station_stays_in_control() -> None:
    count = at_length(100_000, 4_000)
    world, real, believed = forge(count, seed=1)
    assert believed == 0
    assert_in_control(world, real)
    figure("packets forged or replayed on a keyed link, the real station in control after them", count)
    figure("packets forged or replayed: believed", believed)


FALSE_STARTS = (b"\xfe", b"\xfd", b"\xfe\xfe\xfe\xfe\xfe\x83", b"\xfd\xff\0\0\0\1\1\0\0\0", b"\xfd\1\0\0\0\1\1\xff\xff\xff")
"""A length too great for its message, unknown flags, a long message, a message that has grown, and an unknown message."""


@pytest.mark.parametrize("false_start", FALSE_STARTS)
def test_flood_of_false_starts_is_given_up_after_a_while(false_start: bytes) -> None:
    """65,000 bytes that all look like the start of a frame would cost 0.2 s, before any signature check."""
    counts: Counter[str] = Counter()
    framer = Framer(load_dialect(), Signing(), counts)
    assert framer.feed(false_start * (65_000 // len(false_start))) == []
    assert counts.total() - counts["garbage"] == 256
    assert counts["garbage"] > 60_000
    message = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mavlink.MAVLink(None, srcSystem=255, srcComponent=190))
    assert [packet.message.name for packet in framer.feed(bytes(message))] == ["HEARTBEAT"]
