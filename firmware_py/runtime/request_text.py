"""Converts a request to one line of JSON, exact to the last bit, and back. The log records requests in this form.

Plain values are written as they are, lists as lists. Other values are objects that name their type: `{"Mode": 16}`, `{"tuple": [...]}`,
`{"Setpoint": {...}}`, with arrays as `{"array": [...], "shape": [...]}`, long ones as `{"base64": "...", "shape": [...]}` (float64, little
endian); a trajectory is written with its fields.
"""

from __future__ import annotations

import base64
import dataclasses
import json
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np

from firmware_py.core.types import Action, DockRequest, Mode, Request, Setpoint, Sticks

MOST_DIGITS = 1000
"""Longest array that is written digit by digit, at 2 us a value: a mission of 150 places cost the tick 20 ms."""
CORE_TYPES: Mapping[str, type] = {cls.__name__: cls for cls in (DockRequest, Mode, Setpoint, Sticks)}
"""Argument types defined by core itself."""


def request_text(request: Request) -> str:
    """JSON of a request."""
    plain = {"action": request.action.name, "body": request.body, "argument": _plain(request.argument)}
    return json.dumps(plain, separators=(",", ":"))


def read_request(text: str, types: Mapping[str, type]) -> Request:
    """The request that `request_text` wrote; `types` by name. Raises ValueError for an unknown type."""
    plain = json.loads(text)
    return Request(Action[plain["action"]], plain["body"], _value(plain["argument"], types))


def _plain(value: Any) -> Any:
    name = type(value).__name__
    if isinstance(value, IntEnum):
        return {name: int(value)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray) and value.size > MOST_DIGITS:
        return {"base64": base64.b64encode(value.astype("<f8").tobytes()).decode(), "shape": list(value.shape)}
    if isinstance(value, np.ndarray):
        return {"array": value.ravel().tolist(), "shape": list(value.shape)}
    if hasattr(value, "_asdict"):
        return {name: {field: _plain(each) for field, each in value._asdict().items()}}
    if dataclasses.is_dataclass(value):
        return {name: {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}}
    if isinstance(value, tuple):
        return {"tuple": [_plain(each) for each in value]}
    return [_plain(each) for each in value] if isinstance(value, list) else {name: None}


def _value(plain: Any, types: Mapping[str, type]) -> Any:
    if isinstance(plain, list):
        return [_value(each, types) for each in plain]
    if not isinstance(plain, dict):
        return plain
    if "array" in plain:
        return np.array(plain["array"], dtype=np.float64).reshape(plain["shape"])
    if "base64" in plain:
        return np.frombuffer(base64.b64decode(plain["base64"]), "<f8").astype(np.float64).reshape(plain["shape"])
    (name, content), = plain.items()
    if name == "tuple":
        return tuple(_value(each, types) for each in content)
    if name not in types:
        raise ValueError(f"the log holds an argument of type {name}, which cannot be made again; there are {', '.join(sorted(types))}")
    if isinstance(content, dict):
        return types[name](**{field: _value(each, types) for field, each in content.items()})
    return types[name](content)
