"""All messages of can_dbc/modcube.dbc, read once at start."""

from __future__ import annotations

import functools
from importlib import resources
from typing import Any

import cantools.database

from firmware_py.bus.codec.message import CodecError, MessageCodec


def load_database() -> Any:
    """Returns cantools' database of the DBC shipped with the package, in which ids are functions without node numbers."""
    text = (resources.files("can_dbc") / "modcube.dbc").read_text(encoding="utf-8")
    return cantools.database.load_string(text, "dbc", frame_id_mask=0x7E0)


_shipped = functools.cache(load_database)
"""That database, parsed once, for codecs, which only read it."""


class Codec:
    """All messages of the DBC."""

    def __init__(self, database: Any) -> None:
        self.messages: tuple[MessageCodec, ...] = tuple(MessageCodec(message) for message in database.messages)
        self._by_name = {message.name: message for message in self.messages}
        self._by_function = {message.function: message for message in self.messages}
        if len(self._by_function) != len(self.messages):
            raise CodecError("two messages of the DBC have the same function")

    @classmethod
    def load(cls) -> Codec:
        """Loads the DBC shipped with the package (20 ms the first time; load it once and pass it on)."""
        return cls(_shipped())

    def message(self, name: str) -> MessageCodec:
        """Returns the message called `name`. Raises KeyError, which lists the known names."""
        try:
            return self._by_name[name]
        except KeyError:
            raise KeyError(f"no message {name!r}; there are {', '.join(self._by_name)}") from None

    def by_id(self, can_id: int) -> MessageCodec | None:
        """Returns the message of an 11-bit id, whatever its node number; None if the DBC has none. 0x000..0x01F is ESTOP."""
        return self._by_function.get(can_id >> 5) if 0 <= can_id <= 0x7FF else None
