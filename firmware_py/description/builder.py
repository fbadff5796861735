"""TOML table -> frozen dataclass of `schema`; invalid input is refused with file, line and range. `toml_text` leads back."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import types
import typing
from collections.abc import Mapping
from typing import Any

import numpy as np

from firmware_py.description.schema import (
    SHOWN_CHARACTERS,
    DescriptionError,
    Limits,
    Source,
    describe,
    did_you_mean,
    frozen_array,
    limits_of,
)

_hints = functools.cache(typing.get_type_hints)
"""By dataclass: the types of its fields. Python compiles them from text at every call, a third of the time of reading a file."""


def build(cls: type, table: Mapping[str, Any], source: Source, keys: tuple[str | int, ...] = ()) -> Any:
    """Builds an instance of dataclass `cls` from `table`; refuses unknown, missing, ill-typed and out-of-range keys.

    Only fields made by `quantity` are keys.

    Raises:
        DescriptionError: one line with file, line, key and what would be right.
    """
    hints = _hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init and "limits" in f.metadata}
    for key in table:
        if key not in fields:
            known = ", ".join(sorted(fields))
            question = did_you_mean(key, fields) or _did_you_mean_by_help(key, cls)
            raise source.error((*keys, key), f"unknown key; {question}permitted here: {known}")
    values: dict[str, Any] = {}
    for name, field in fields.items():
        if name in table:
            values[name] = _value(hints[name], limits_of(cls, name), table[name], source, (*keys, name))
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise source.error((*keys, name), f"missing key; it needs {_needed(hints[name], limits_of(cls, name), name)}")
    try:
        return cls(**values)
    except DescriptionError as error:
        raise source.error(keys, str(error), error.keys) from None


def _did_you_mean_by_help(word: str, cls: type) -> str:
    """A "did you mean" question for the only field whose help contains `word`; empty if none or several do."""
    told = [field.name for field in dataclasses.fields(cls) if word in re.findall(r"\w+", limits_of(cls, field.name).help)]
    return f"did you mean {told[0]}? " if len(told) == 1 else ""


def _needed(hint: Any, limits: Limits, name: str) -> str:
    """What a missing field of type `hint` needs, in words."""
    if dataclasses.is_dataclass(hint):
        return f"a table, [{name}]"
    if typing.get_origin(hint) is tuple:
        is_table = dataclasses.is_dataclass(typing.get_args(hint)[0])
        return f"tables, each [[{name}]]" if is_table else "a list"
    return "text" if hint is str and not limits.choices else describe(limits)


def _value(hint: Any, limits: Limits, value: Any, source: Source, keys: tuple[str | int, ...]) -> Any:
    origin = typing.get_origin(hint)
    if origin in (types.UnionType, typing.Union):
        hint = next(a for a in typing.get_args(hint) if a is not type(None))
        origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            needed = f"[[{keys[-2]}]]" if isinstance(keys[-1], int) else f"[{keys[-1]}], and one alone"
            raise source.error(keys, f"must be a table, {needed}")
        return build(typing.cast(type, hint), value, source, keys)
    if origin is tuple:
        item = typing.get_args(hint)[0]
        if not isinstance(value, list):
            raise source.error(keys, f"must be a list{f' of tables, each [[{keys[-1]}]]' if dataclasses.is_dataclass(item) else ''}")
        return tuple(_value(item, limits, v, source, (*keys, i)) for i, v in enumerate(value))
    if hint is np.ndarray or origin is np.ndarray:
        return _array(limits, value, source, keys)
    return _scalar(hint, limits, value, source, keys)


def _array(limits: Limits, value: Any, source: Source, keys: tuple[str | int, ...]) -> np.ndarray:
    try:
        if not _is_numeric(value):
            raise TypeError
        array = frozen_array(value)
    except (TypeError, ValueError):
        raise source.error(keys, "must be numbers only, in rows of equal length") from None
    except OverflowError:
        array = frozen_array(math.inf)
    shape = limits.shape
    if not np.all(np.isfinite(array)):
        raise source.error(keys, "must be finite numbers, not NaN or infinity")
    if shape and (array.ndim != len(shape) or any(s not in (-1, n) for s, n in zip(shape, array.shape, strict=True))):
        raise source.error(keys, f"has {_counted(array.shape)}; needs {_counted(shape)}")
    if array.size and (array.min() < limits.low or array.max() > limits.high):
        raise source.error(keys, f"{_shown(value)} is out of range; permitted: {describe(limits)}")
    return array


def _counted(shape: tuple[int, ...]) -> str:
    """Size of an array of that shape, in words; -1 stands for any length."""
    if not shape:
        return "one number alone"
    if len(shape) > 2:
        return f"{len(shape)} lists one in the other"
    numbers = _many(shape[-1], "number")
    if len(shape) == 2:
        return f"{_many(shape[0], 'row')} of {numbers}"
    return numbers if shape[0] >= 0 else f"a list of {numbers}"


def _many(count: int, thing: str) -> str:
    return f"{thing}s" if count < 0 else f"{count} {thing}{'s' * (count != 1)}"


def _is_numeric(value: Any) -> bool:
    """Whether a value is a number, or a list, possibly nested, of numbers only; booleans and text are none."""
    if isinstance(value, list):
        return all(_is_numeric(item) for item in value)
    return isinstance(value, int | float) and not isinstance(value, bool)


def _shown(value: Any) -> str:
    """The value as TOML shows it, cut to SHOWN_CHARACTERS."""
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    if hasattr(value, "isoformat"):  # a date or a time
        text = value.isoformat()
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."


_KINDS: Mapping[Any, tuple[str, Any]] = {
    bool: ("true or false", bool), str: ("text", str), int: ("a whole number", int), float: ("a number", int | float),
}  # fmt: skip
"""By a field's type: its name in error messages, and the Python types that TOML may give for it."""


def _permitted(limits: Limits) -> str:
    """End of an error message: the permitted values of a field, if it has limits."""
    return f"; permitted: {describe(limits)}" if limits.choices or math.isfinite(limits.low) or math.isfinite(limits.high) else ""


def _scalar(hint: Any, limits: Limits, value: Any, source: Source, keys: tuple[str | int, ...]) -> Any:
    kind, fits = _KINDS[hint]
    if not isinstance(value, fits) or (isinstance(value, bool) and hint is not bool):
        raise source.error(keys, f"{_shown(value)} is not {kind}{_permitted(limits)}")
    if hint is bool:
        return value
    if hint is str:
        if limits.choices and value not in limits.choices:
            raise source.error(keys, f"{_shown(value)} is unknown; {did_you_mean(value, limits.choices)}permitted: {describe(limits)}")
        return value
    try:
        if limits.low <= value <= limits.high and math.isfinite(float(value)):
            return hint(value)
    except OverflowError:
        pass
    raise source.error(keys, f"{_shown(value)} is out of range; permitted: {describe(limits)}")
