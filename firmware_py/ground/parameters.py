"""The parameter protocol over the registry of description.parameters. Everything is REAL32 on the wire.

Some clients send integers bytewise, others cast them; REAL32 is the one form that all clients understand.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path

import numpy as np

from firmware_py.core.types import WARNING, Action
from firmware_py.description.parameter_rules import changed
from firmware_py.description.parameters import Parameters, registry
from firmware_py.description.schema import DescriptionError, Limits
from firmware_py.ground.stored_parameters import differences_toml, with_stored_values
from firmware_py.ground.system import Arrival, Handler, System

REAL32 = 9
_INTEGERS = {1: "<B", 2: "<b", 3: "<H", 4: "<h", 5: "<I", 6: "<i"}
"""Integer types by MAV_PARAM_TYPE that fit into a float's four bytes, with their struct formats."""
_SMALLEST_NORMAL = 1.1754944e-38
_VALUES_PER_TICK = 5
"""Values sent per tick when a client requests all: a radio's buffer is small."""


class ParameterStore:
    """The parameters of the process; every change makes a new object."""

    def __init__(self, parameters: Parameters, path: Path | None = None) -> None:
        """Overlays `parameters`, with which the process was started, with the values stored in `path`. Raises DescriptionError."""
        self._started = parameters
        self.changed = False
        """Whether there is something to store. Whoever stores it clears this."""
        self.values = with_stored_values(parameters, path)
        self.names: dict[str, tuple[str, Limits]] = {
            limits.mavlink: (dotted, limits) for dotted, limits in registry() if limits.mavlink
        }
        """MAVLink name -> name in the registry, and limits."""
        self.order = list(self.names)

    def get(self, name: str) -> float:
        """Returns the value of the parameter with this MAVLink name. Raises KeyError."""
        return float(attrgetter(self.names[name][0])(self.values))

    def set(self, name: str, value: float, is_armed: bool = False) -> tuple[str, float]:
        """Changes one parameter. Returns the name in the registry and the value as kept.

        Raises:
            DescriptionError: out of range, or in flight (`is_armed`) in contradiction with another parameter.
        """
        dotted, _ = self.names[name]
        before = attrgetter(dotted)(self.values)
        kind = type(before)
        kept = kind(value) if kind is not int else round(value)
        self.values = changed(self.values, dotted, kept, is_armed)
        self.changed = self.changed or kept != before
        return dotted, kept

    def to_toml(self) -> str:
        """Returns all parameters that differ from those at start, as the constructor reads them."""
        return differences_toml(self.values, self._started)


class ParameterService:
    """PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET of one system."""

    def __init__(self, system: System, store: ParameterStore, everybody: Callable[[], list[System]]) -> None:
        self._system, self._store, self._everybody = system, store, everybody
        self._to_send: dict[int, int] = {}
        """Index of the next parameter to send, for each channel that requested all."""

    def handlers(self) -> dict[str, Handler]:
        """Handlers by message name."""
        return {"PARAM_REQUEST_LIST": self._list, "PARAM_REQUEST_READ": self._read, "PARAM_SET": self._set}

    def _list(self, arrival: Arrival) -> None:
        self._to_send[arrival.channel] = 0

    def step(self) -> None:
        """Sends the next few values on every channel that requested all and is not busy."""
        for channel, first in list(self._to_send.items()):
            if channel in self._system.busy:
                continue
            for name in self._store.order[first : first + _VALUES_PER_TICK]:
                self._system.send(channel, "PARAM_VALUE", self._value(name))
            if first + _VALUES_PER_TICK >= len(self._store.order) or channel not in self._system.channels:
                del self._to_send[channel]
            else:
                self._to_send[channel] = first + _VALUES_PER_TICK

    def _read(self, arrival: Arrival) -> None:
        index, order = arrival.message["param_index"], self._store.order
        name = order[index] if 0 <= index < len(order) else arrival.message["param_id"]
        if name in self._store.names:
            self._system.send(arrival.channel, "PARAM_VALUE", self._value(name))

    def _set(self, arrival: Arrival) -> None:
        name = arrival.message["param_id"]
        if name not in self._store.names:
            self._system.say(WARNING, f"parameter {name} is unknown")
            return
        value = wire_value(arrival.message["param_value"], arrival.message["param_type"])
        try:
            if not math.isfinite(value):
                raise DescriptionError(f"parameter {name}: {value} is no number")
            dotted, kept = self._store.set(name, value, self._system.subject.picture.any_armed)
        except DescriptionError as error:
            self._system.say(WARNING, self._in_words_of_clients(str(error)))
            self._system.send(arrival.channel, "PARAM_VALUE", self._value(name))
            return
        self._system.ask(Action.SET_PARAMETER, (dotted, kept))  # applies to every body
        for system in self._everybody():
            system.broadcast("PARAM_VALUE", self._value(name))

    def _in_words_of_clients(self, text: str) -> str:
        """Returns a text with the MAVLink names of the parameters, which are all that clients know."""
        for name, (dotted, _) in sorted(self._store.names.items(), key=lambda each: len(each[1][0]), reverse=True):
            text = text.replace(dotted, name)
        return text

    def _value(self, name: str) -> dict[str, float | str]:
        return {
            "param_id": name, "param_value": self._store.get(name), "param_type": REAL32,
            "param_count": len(self._store.order), "param_index": self._store.order.index(name),
        }  # fmt: skip


def wire_value(value: float, kind: int) -> float:
    """Returns the value that a client meant: the shortest decimal of a REAL32, or an integer, cast to the float or placed in it bytewise.

    The bytes of an integer below 2^23 in magnitude form a denormal float or NaN, which no cast yields, so the two forms cannot be confused.
    """
    if kind in _INTEGERS and (math.isnan(value) or 0 < abs(value) < _SMALLEST_NORMAL):
        letter = _INTEGERS[kind]
        return float(struct.unpack_from(letter, struct.pack("<f", value))[0])
    return float(str(np.float32(value)))
