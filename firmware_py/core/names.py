"""Names of modules and thrusters in texts for people, who look for them on the robot and not in the arrays of a body.

Modules count from 1 in the order of the fleet file, as in docking commands (docs/ground-station.md): where the fleet has one bus and its
modules are numbered in order, that is the number on the bus. The thrusters of a module count from 1 in the order of its vehicle file, as do
ESC_FEEDBACK_1 to _4 on the bus. Everywhere else in the code both are indices, which count from 0.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from firmware_py.core.body import Body
from firmware_py.description.fleet import module_number


class Place(NamedTuple):
    """Where a thruster is, in whichever body."""

    module: int
    """Fleet index of its module."""
    channel: int
    """Its index within the module."""


def places_of(body: Body) -> tuple[Place, ...]:
    """Returns the place of each thruster of a body, by its index there."""
    t = body.thrusters
    return tuple(Place(body.modules[m], c) for m, c in zip(t.module.tolist(), t.channel.tolist(), strict=True))


def name_module(module: int) -> str:
    """Returns the name of the module with this fleet index: "module 2"."""
    return name_modules([module])


def name_modules(modules: Iterable[int]) -> str:
    """Returns the names of modules by their fleet indices: "module 2, 4"."""
    return f"module {', '.join(str(module_number(module)) for module in modules)}"


def name_pair(first: int, second: int) -> str:
    """Returns the names of two modules by their fleet indices: "modules 2 and 1"."""
    return f"modules {module_number(first)} and {module_number(second)}"


def name_thruster(place: Place) -> str:
    """Returns the name of a thruster: "thruster 4 of module 2"."""
    return f"thruster {_of_module(place.module, [place.channel])}"


def list_thrusters(places: Iterable[Place]) -> list[str]:
    """Returns the numbers of thrusters, or of their ESCs, in a text for each module: "1, 8 of module 1"."""
    channels: dict[int, list[int]] = {}
    for module, channel in places:
        channels.setdefault(module, []).append(channel)
    return [_of_module(module, found) for module, found in channels.items()]


def _of_module(module: int, channels: Iterable[int]) -> str:
    return f"{', '.join(str(channel + 1) for channel in channels)} of {name_module(module)}"
