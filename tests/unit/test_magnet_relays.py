"""Relays of the docking faces: both sides of a joint switch; states are sent at once on change, and ten times a second."""

from firmware_py.core.magnet_relays import MagnetRelays
from firmware_py.core.types import RELAY_PULL, DockRequest

TICK_NS = 10_000_000
OFF = [0] * 6
JOINT = DockRequest(2, 1, 0, 4)
"""Face B of module 2 on face E of module 0."""


def told(relays: MagnetRelays, ticks: range) -> dict[int, list[int]]:
    """Modules whose relay states are sent, by tick; ticks without any are left out."""
    due = {tick: relays.due(tick * TICK_NS) for tick in ticks}
    return {tick: modules for tick, modules in due.items() if modules}


def test_both_faces_of_a_joint_are_switched_and_no_other() -> None:
    relays = MagnetRelays(3)
    assert relays.states == [OFF, OFF, OFF]
    relays.switch(RELAY_PULL, JOINT)
    assert relays.states == [[0, 0, 0, 0, RELAY_PULL, 0], OFF, [0, RELAY_PULL, 0, 0, 0, 0]]


def test_every_module_is_told_from_the_first_tick_on_and_ten_times_a_second() -> None:
    assert told(MagnetRelays(3), range(0, 100)) == {tick: [0, 1, 2] for tick in range(0, 100, 10)}


def test_modules_whose_relays_change_are_told_at_once_and_the_others_in_their_turn() -> None:
    relays = MagnetRelays(3)
    told(relays, range(0, 4))
    relays.switch(RELAY_PULL, JOINT)
    assert told(relays, range(4, 20)) == {4: [0, 2], 10: [1], 14: [0, 2]}
    relays.switch(RELAY_PULL, JOINT)
    assert told(relays, range(20, 24)) == {20: [1]}, "nothing has changed"
