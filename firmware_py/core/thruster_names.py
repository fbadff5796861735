"""Names of thrusters in texts for people, who look for them on a module and not in the arrays of a body.

Modules count from 0 in the order of the fleet file, as in every other text and in docking commands (docs/ground-station.md). The thrusters
of a module count from 1 in the order of its vehicle file, as do ESC_FEEDBACK_1 to _4 on the bus.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from firmware_py.core.body import Body


class Place(NamedTuple):
    """Where a thruster is, in whichever body."""

    module: int
    """Fleet index of its module."""
    channel: int
    """Its number within the module, from 0."""


def places_of(body: Body) -> tuple[Place, ...]:
    """Returns the place of each thruster of a body, by its index there."""
    t = body.thrusters
    return tuple(Place(body.modules[m], c) for m, c in zip(t.module.tolist(), t.channel.tolist(), strict=True))


def name_of(place: Place) -> str:
    """Returns the name of a thruster: "thruster 4 of module 2"."""
    return f"thruster {_of_module(place.module, [place.channel])}"


def listed(places: Iterable[Place]) -> list[str]:
    """Returns the numbers of thrusters, or of their ESCs, in a text for each module: "1, 8 of module 0"."""
    channels: dict[int, list[int]] = {}
    for module, channel in places:
        channels.setdefault(module, []).append(channel)
    return [_of_module(module, found) for module, found in channels.items()]


def _of_module(module: int, channels: Iterable[int]) -> str:
    return f"{', '.join(str(channel + 1) for channel in channels)} of module {module}"
