"""Fields of descriptions, each with unit, range and help, and the TOML files that they are read from, with lines for errors.

Used once at start to read vehicle, fleet, parameter and scenario files. Nothing here runs in a tick.
"""

from __future__ import annotations

import dataclasses
import difflib
import io
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ANYTHING = "a value"
"""Description of a field without unit, range and choices."""
SHOWN_CHARACTERS = 60
"""Length at which a value is cut in an error message."""


class DescriptionError(ValueError):
    """Error in a description; the message is one line: where, what, and what would be right.

    Attributes:
        keys: path from the dataclass that refuses to the offending value, where known; `builder.build` turns it into a line number.
    """

    def __init__(self, what: str, *keys: str | int) -> None:
        super().__init__(what)
        self.keys = keys


@dataclass(frozen=True, slots=True)
class Limits:
    """Permitted values of a field.

    Attributes:
        unit: unit of the value, empty when it has none.
        low, high: inclusive range of every number in the field.
        help: one sentence.
        shape: required shape of an array field; -1 stands for any length.
        choices: the permitted words of a text field.
        mavlink: name of the parameter on MAVLink, empty when it is not exposed.
    """

    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    help: str = ""
    shape: tuple[int, ...] = ()
    choices: tuple[str, ...] = ()
    mavlink: str = ""

    def permits(self, value: Any) -> bool:
        """Whether the field may hold this number or word."""
        return bool(value in self.choices if self.choices else self.low <= value <= self.high)


def quantity(
    default: Any = dataclasses.MISSING,
    *,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    help: str = "",
    shape: tuple[int, ...] = (),
    choices: tuple[str, ...] = (),
    mavlink: str = "",
) -> Any:
    """Creates a dataclass field with its `Limits`; a default given as a list becomes a read-only float64 array."""
    limits = Limits(unit, low, high, help, shape, choices, mavlink)
    metadata = {"limits": limits}
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata=metadata)
    if isinstance(default, list):
        return dataclasses.field(default_factory=lambda: frozen_array(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def frozen_array(values: Any) -> np.ndarray:
    """A read-only, C-contiguous float64 copy of `values`."""
    array = np.array(values, dtype=np.float64, order="C")
    array.flags.writeable = False
    return array


def refuse_other_length(name: str, values: np.ndarray, tolerance: float = 0.01) -> None:
    """Raises DescriptionError unless the values of the key `name` are a unit vector or quaternion, within `tolerance`."""
    length = float(np.linalg.norm(values))
    if abs(length - 1.0) > tolerance:
        right = f"not 1; give {np.round(values / length, 4).tolist()}" if length else "but must have length 1"
        raise DescriptionError(f"{name} {values.tolist()} has length {length:.4g}, {right}", name)


def limits_of(cls: type, name: str) -> Limits:
    """The `Limits` of field `name` of dataclass `cls`."""
    limits = cls.__dataclass_fields__[name].metadata.get("limits", Limits())  # type: ignore[attr-defined]
    assert isinstance(limits, Limits)
    return limits


_HEADER = re.compile(r"^\s*\[(?P<array>\[)?\s*(?P<name>[^\[\]#]+?)\s*\]")
_KEY = re.compile(r"^\s*(?P<name>[\w.\"-]+)\s*=")


@dataclass(frozen=True, slots=True)
class Source:
    """Origin of a table, so that errors can name file and line."""

    path: str
    text: str
    line: int = 0
    """Line reported for every key when the keys do not stand in `text`; 0: look them up in `text`."""

    def line_of(self, keys: Sequence[str | int]) -> int:
        """1-based line of the key or table that `keys` lead to; if it is not written out, that of the nearest enclosing one."""
        if self.line:
            return self.line
        best_line, best_depth = 1, 0
        table: tuple[str | int, ...] = ()
        count: dict[tuple[str | int, ...], int] = {}
        for number, line in enumerate(self.text.splitlines(), 1):
            if match := _HEADER.match(line):
                table = tuple(match["name"].replace('"', "").split("."))
                if match["array"]:
                    count[table] = count.get(table, -1) + 1
                    table = (*table, count[table])
                path = table
            elif match := _KEY.match(line):
                path = (*table, *match["name"].replace('"', "").split("."))
            else:
                continue
            wanted = tuple(keys)
            if path[: len(wanted)] == wanted:  # the key itself, or the first table of a list that `keys` name as a whole
                path = wanted
            if len(path) > best_depth and path == wanted[: len(path)]:
                best_line, best_depth = number, len(path)
        return best_line

    def error(self, keys: Sequence[str | int], what: str, within: Sequence[str | int] = ()) -> DescriptionError:
        """The error for `keys`: `file:line: a.b: what`; the line is that of the sub-key `within`."""
        name = "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in keys).lstrip(".")
        return DescriptionError(f"{self.path}:{self.line_of((*keys, *within))}: {name}{': ' if name else ''}{what}")


def read_toml(path: Path) -> tuple[dict[str, Any], Source]:
    """The table in `path` and its source; a byte order mark is skipped.

    Raises:
        DescriptionError: the file cannot be read or is not valid TOML.
    """
    text = read_text(path)
    return parse_toml(text, str(path)), Source(str(path), text)


def read_text(path: Path) -> str:
    """The text of a UTF-8 file with line endings normalised; a byte order mark is skipped. Raises DescriptionError."""
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: not a possible file name
        raise DescriptionError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    try:
        return io.StringIO(data.decode("utf-8-sig"), newline=None).read()
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        what = f"cannot be read: byte 0x{data[error.start]:02x} is no text in UTF-8; save it as such"
        raise DescriptionError(f"{path}:{line}: {what}") from None


def parse_toml(text: str, path: str) -> dict[str, Any]:
    """The table in `text`, the contents of the file at `path`. Raises DescriptionError."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, and input that Python itself refuses to read
        match = re.search(r"line (\d+)", str(error))
        last = len(text.splitlines()) if "at end of document" in str(error) else 1
        raise DescriptionError(f"{path}:{match.group(1) if match else last}: not valid TOML: {str(error).splitlines()[0]}") from None


def is_there(path: Path, look: Callable[[Path], bool] = Path.exists) -> bool:
    """Whether `look` finds something at `path`; not, where the name is too long for the file system, of which `look` itself raises."""
    try:
        return look(path)
    except OSError:
        return False


def unknown_name(kind: str, name: str, known: Sequence[str]) -> DescriptionError:
    """The error of a `name` that is neither one of the `known` names of a `kind` of thing nor a .toml file."""
    if is_there(Path(name), Path.is_dir):
        return DescriptionError(f"{name}: is a folder; give a .toml file")
    return DescriptionError(f"{kind} {name!r} is unknown; {did_you_mean(name, known)}there are {', '.join(known)}, or give a .toml file")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A "did you mean" question for the name in `known` that is closest to `word`; empty if none is close."""
    names, small = {name.lower(): name for name in known}, word.lower()
    near = [name for name in names if name.startswith(f"{small}_")] or difflib.get_close_matches(small, names, 1)  # the unit was left out
    return f"did you mean {names[near[0]]}? " if near else ""


def is_file_name(name: str) -> bool:
    """Whether `name` can name a file or folder: printable, without separators, neither `.` nor `..`."""
    return name not in ("", ".", "..") and name.isprintable() and not set(name) & set("/\\")


def repeated(items: Sequence[object]) -> Iterator[int]:
    """Indices of the items that occur earlier in the sequence already."""
    return (i for i, item in enumerate(items) if item in items[:i])


def describe(limits: Limits) -> str:
    """Permitted values of a field, in words."""
    if limits.choices:
        return "one of " + ", ".join(limits.choices)
    unit = f" {limits.unit}" if limits.unit else ""
    if math.isfinite(limits.low) and math.isfinite(limits.high):
        return f"{limits.low:g} to {limits.high:g}{unit}"
    if math.isfinite(limits.low) or math.isfinite(limits.high):
        return f"at least {limits.low:g}{unit}" if math.isfinite(limits.low) else f"at most {limits.high:g}{unit}"
    return f"{ANYTHING}{f' in{unit}' if unit else ''}"
