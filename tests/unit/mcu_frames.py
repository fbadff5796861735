"""Frames that a firmware sends to a microcontroller, and the relays that they switch."""

from collections.abc import Sequence

from firmware_py.bus.codec import Codec, Frame
from hil.nodes import Nodes
from hil.reference_node import CNodes

CODEC = Codec.load()
ARMED, DISARMED = 1, 0
PUSHES, REST = (1, 0, 2, 0, 0, 2), (1, 0, 0, 0, 0, 0)
"""Relay states; face A pulls in both, because it may hold a joint."""


def sync(tick: int) -> Frame:
    return CODEC.message("SYNC").encode(0, [tick])


def thrust(u: float, mode: int, counter: int, halves: str = "AB", number: int = 1) -> list[Frame]:
    return [CODEC.message(f"THRUSTER_CMD_{half}").encode(number, [u, u, u, u, mode], counter) for half in halves]


def dock(relays: Sequence[int], counter: int) -> Frame:
    return CODEC.message("DOCK_CMD").encode(1, relays, counter)


def magnets(nodes: Nodes | CNodes) -> tuple[int, ...]:
    """Relay states of the first module in the simulated world."""
    return tuple(nodes.world.docks.relays[0].tolist())
