"""Packets from an enemy or a bad radio. The full numbers are run by `python -m tests.unit.ground_attack 1000000`."""

from firmware_py.core.types import Action
from tests.unit.ground_attack import Attack, forge


def test_random_and_mutated_packets_do_nothing_that_a_valid_sender_could_not() -> None:
    attack = Attack(seed=1)
    attack.run(20_000)
    counts = attack.world.station.counts
    assert counts["good"] > 5_000 and counts["checksum"] > 3_000 and counts["garbage"] > 100_000
    attack.client.clear()
    attack.client.command(410)
    attack.world.run(2)
    assert attack.client.all("COMMAND_ACK"), "the real station is still served"


def test_forged_and_replayed_packets_are_refused_and_the_real_station_stays_in_control() -> None:
    world, real = forge(4_000, seed=1)
    real.command(400, 0)
    world.run(3)
    assert [r.action for r in world.robot.asked] == [Action.DISARM]
