"""A request in the log is the request that was made, to the last bit."""

import dataclasses
import math
import struct
from typing import Any

import numpy as np
import pytest

from firmware_py.app.mission_plan import Consecutive
from firmware_py.app.replay import TYPES
from firmware_py.core.setpoint import rest_at
from firmware_py.core.types import Action, DockRequest, Mode, Request, Setpoint, Sticks
from firmware_py.prepare import paths
from firmware_py.prepare.minimum_snap import Waypoint, plan
from firmware_py.runtime.request_text import read_request, request_text

RNG = np.random.default_rng(7)
PLACE = rest_at(RNG.normal(size=3), np.array([1.0, 0.0, 0.0, 0.0]))
SNAP = plan([Waypoint(np.zeros(3)), Waypoint(RNG.normal(size=3))], 3.0)
REQUESTS = [
    Request(Action.ARM, 0, True),
    Request(Action.DISARM, 3),
    Request(Action.HOLD, 1, PLACE),
    Request(Action.HOLD, 1, Setpoint(*RNG.normal(size=(6, 3)))),
    Request(Action.HOLD, 1, [0.1, math.nan]),
    Request(Action.SET_MODE, 0, Mode.ALT_HOLD),
    Request(Action.SET_MODE, 0, 2),
    Request(Action.STICKS, 0, Sticks((0.1, -0.2, 1 / 3), (0.0, -0.0, 1e-300))),
    Request(Action.SET_PARAMETER, 0, ("control.position_bandwidth", 2.1)),
    Request(Action.DOCK, 2, DockRequest(2, 1, 0, 0, 3, True)),
    Request(Action.MOTOR_TEST, 0, (3, np.float64(0.05), np.int64(2))),
    Request(Action.TRACK, 0, paths.Hold(PLACE, 5.0)),
    Request(Action.TRACK, 0, paths.spiral(np.zeros(3), 0.3, 0.4, 2.0, 40.0)),
    Request(Action.TRACK, 0, paths.line(PLACE, PLACE, 4.0)),
    Request(Action.TRACK, 0, SNAP),
    Request(Action.TRACK, 0, dataclasses.replace(SNAP, coefficients=RNG.normal(size=(15, 10, 7)), breaks=np.arange(16.0))),
    Request(Action.TRACK, 0, Consecutive(((0.0, SNAP), (4.5, SNAP)), 9.0)),
]


def same(a: Any, b: Any) -> bool:
    """Equal in type, shape and every bit."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.shape == b.shape and b.flags.c_contiguous and a.tobytes() == b.tobytes()
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, tuple | list):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.generic):
        return bool(a == b)
    if isinstance(a, float):
        return isinstance(b, float) and struct.pack("<d", a) == struct.pack("<d", b)
    return type(a) is type(b) and a == b


@pytest.mark.parametrize("request_", REQUESTS, ids=lambda r: f"{r.action.name}-{type(r.argument).__name__}")
def test_request_is_read_back_as_it_was(request_: Request) -> None:
    text = request_text(request_)
    assert "\n" not in text
    assert same(request_, read_request(text, TYPES))


def test_argument_that_nobody_knows_is_named() -> None:
    text = request_text(Request(Action.TRACK, 0, object()))
    with pytest.raises(ValueError, match="type object"):
        read_request(text, TYPES)
