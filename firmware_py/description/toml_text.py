"""Dataclasses of `schema` as TOML text, each value with its own comment, and as plain values for JSON."""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Callable
from typing import Any

import numpy as np

from firmware_py.description.schema import ANYTHING, Limits, describe, limits_of


def to_plain(value: Any) -> Any:
    """A dataclass as lists, dicts and scalars for JSON; `builder.build` reads them back. Fields that are None are left out."""
    if dataclasses.is_dataclass(value):
        items = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value) if field.init)
        return {name: to_plain(item) for name, item in items if item is not None}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [to_plain(item) for item in value] if isinstance(value, tuple) else value


def unit_of(limits: Limits) -> str:
    """Comment of a value: its unit only."""
    return limits.unit


def explained(limits: Limits) -> str:
    """Comment of a value: its help, permitted values and MAVLink name."""
    parts = (limits.help, describe(limits).removeprefix(ANYTHING), limits.mavlink and f"MAVLink {limits.mavlink}")
    return "; ".join(part for part in parts if part)


def to_toml(value: Any, comment: Callable[[Limits], str] = unit_of) -> str:
    """The TOML text of a dataclass of scalars, arrays, tables and lists of tables, each value with its `comment`."""
    head, tail = [], []
    hints = typing.get_type_hints(type(value))
    for field in dataclasses.fields(value):
        item = getattr(value, field.name)
        if dataclasses.is_dataclass(item):
            tail.append(f"\n[{field.name}]\n{to_toml(item, comment)}")
        elif isinstance(item, tuple) and dataclasses.is_dataclass(of := typing.get_args(hints[field.name])[0]):
            none = f"\n# [[{field.name}]]: none; keys: {', '.join(key.name for key in dataclasses.fields(of))}\n"  # TOML cannot extend []
            tail += [f"\n[[{field.name}]]\n{to_toml(each, comment)}" for each in item] or [none]
        else:
            note = comment(limits_of(type(value), field.name))
            head.append(f"{field.name} = {_literal(item)}{f'  # {note}' if note else ''}\n")
    return "".join(head + tail)


def _literal(item: Any) -> str:
    if isinstance(item, bool):
        return "true" if item else "false"
    if isinstance(item, np.ndarray):
        return repr(item.tolist())
    if isinstance(item, str):
        return json.dumps(item, ensure_ascii=False).replace("\x7f", "\\u007f")  # JSON escapes as TOML does, except for DEL
    if isinstance(item, tuple):
        return f"[{', '.join(_literal(each) for each in item)}]"
    return repr(item)
