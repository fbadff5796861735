"""The parameter protocol over the registry of description.parameters. Everything is REAL32 on the wire.

Integers on the wire are bytewise for some clients and cast for others; REAL32 is the one form that all understand.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path

import numpy as np

from firmware_py.core.types import WARNING, Action
from firmware_py.description.parameters import Parameters, registry
from firmware_py.description.schema import DescriptionError, Limits
from firmware_py.ground.files import write_atomically
from firmware_py.ground.stored_parameters import differences_toml, laid_over
from firmware_py.ground.system import Arrival, Handler, System

REAL32 = 9
_INTEGERS = {1: "<B", 2: "<b", 3: "<H", 4: "<h", 5: "<I", 6: "<i"}
"""MAV_PARAM_TYPE of integers that fit, and how their bytes lie in the float."""
_SMALLEST_NORMAL = 1.1754944e-38
_AT_ONCE = 5
"""Values sent in one tick when all are asked for: a radio's buffer is small."""


class ParameterStore:
    """The parameters of the process; a change is a new object."""

    def __init__(self, parameters: Parameters, path: Path | None = None) -> None:
        """Lays what `path` holds over `parameters`, with which the process was started. Raises DescriptionError."""
        self._path, self._started = path, parameters
        self.values = laid_over(parameters, path)
        self.names: dict[str, tuple[str, Limits]] = {
            limits.mavlink: (dotted, limits) for dotted, limits in registry() if limits.mavlink
        }
        """MAVLink name -> name in the registry, and limits."""
        self.order = list(self.names)

    def get(self, name: str) -> float:
        """The value of a MAVLink name. Raises KeyError."""
        return float(attrgetter(self.names[name][0])(self.values))

    def set(self, name: str, value: float) -> tuple[str, float]:
        """Change one and store all that differ from the start, where it is no longer as it was; returns its name in the registry and the
        value as kept.

        Raises:
            DescriptionError: out of range.
            OSError: it cannot be stored; the old value stays.
        """
        dotted, _ = self.names[name]
        before = attrgetter(dotted)(self.values)
        kind = type(before)
        kept = kind(value) if kind is not int else round(value)
        changed = self.values.replace(dotted, kept)
        if self._path is not None and kept != before:
            write_atomically(self._path, differences_toml(changed, self._started).encode())
        self.values = changed
        return dotted, kept


class ParameterService:
    """PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET of one system."""

    def __init__(self, system: System, store: ParameterStore, everybody: Callable[[], list[System]]) -> None:
        self._system, self._store, self._everybody = system, store, everybody
        self._to_send: dict[int, int] = {}
        """Of each channel that asked for all: the next one."""

    def handlers(self) -> dict[str, Handler]:
        """By message name."""
        return {"PARAM_REQUEST_LIST": self._list, "PARAM_REQUEST_READ": self._read, "PARAM_SET": self._set}

    def _list(self, arrival: Arrival) -> None:
        self._to_send[arrival.channel] = 0

    def step(self) -> None:
        """Send the next few to everybody who asked for all, where nothing else waits to be sent."""
        for channel, first in list(self._to_send.items()):
            if channel in self._system.busy:
                continue
            for name in self._store.order[first : first + _AT_ONCE]:
                self._system.send(channel, "PARAM_VALUE", self._value(name))
            if first + _AT_ONCE >= len(self._store.order) or channel not in self._system.channels:
                del self._to_send[channel]
            else:
                self._to_send[channel] = first + _AT_ONCE

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
            dotted, kept = self._store.set(name, value)
        except (DescriptionError, OSError) as error:
            stays = f"parameter {name} stays, it cannot be stored"
            wrong = str(error).replace(self._store.names[name][0], name)  # a client knows no other name of it
            self._system.say(WARNING, f"{stays}: {error.filename}: {error.strerror}" if isinstance(error, OSError) else wrong)
            self._system.send(arrival.channel, "PARAM_VALUE", self._value(name))
            return
        self._system.ask(Action.SET_PARAMETER, (dotted, kept))  # it is for every body
        for system in self._everybody():
            system.broadcast("PARAM_VALUE", self._value(name))

    def _value(self, name: str) -> dict[str, float | str]:
        return {
            "param_id": name, "param_value": self._store.get(name), "param_type": REAL32,
            "param_count": len(self._store.order), "param_index": self._store.order.index(name),
        }  # fmt: skip


def wire_value(value: float, kind: int) -> float:
    """What a client meant: the shortest decimal of a REAL32, or an integer that is cast or lies bytewise in the float.

    An integer's bytes make a denormal float or NaN, which nobody casts one to; so the two forms cannot be confused.
    """
    if kind in _INTEGERS and (math.isnan(value) or 0 < abs(value) < _SMALLEST_NORMAL):
        letter = _INTEGERS[kind]
        return float(struct.unpack_from(letter, struct.pack("<f", value))[0])
    return float(str(np.float32(value)))
