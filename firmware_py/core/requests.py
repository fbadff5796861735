"""Validation of requests: a table of argument checks by action, and a check of the addressed body. Runs before stage 4 of a tick.

An invalid request from any client gets no farther than this file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.names import name_module, name_modules, name_pair
from firmware_py.core.transitions import MODES
from firmware_py.core.types import FACES, WARNING, Action, DockRequest, Event, Mode, Request, Setpoint, Sticks
from firmware_py.description.vehicle import face_mismatch

QUARTERS = 4
FARTHEST = 1e6
"""Largest magnitude of a valid number, in m, m/s, rad/s and so on."""
UNIT = 1e-3
"""Tolerance of a quaternion's length from 1."""
FOR_ALL = frozenset({Action.ESTOP, Action.CLEAR_ESTOP, Action.GROUND_ALIVE, Action.SET_PARAMETER})
"""Requests that concern every body, whichever one they name: ESTOP frames stop all modules."""


def _anything(argument: Any) -> bool:
    return True


def _is_forced(argument: Any) -> bool:
    return argument is None or isinstance(argument, bool)


def _is_mode(argument: Any) -> bool:
    return isinstance(argument, Mode) and MODES[argument].on_request


def _is_real(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= FARTHEST


def _is_array(value: Any, size: int, may_lack: bool) -> bool:
    """Whether `value` is a contiguous float64 (size,) array, as compiled functions take it, within FARTHEST; NaN passes if `may_lack`."""
    whole = isinstance(value, np.ndarray) and value.dtype == np.float64 and value.shape == (size,) and value.flags.c_contiguous
    return whole and bool(np.all((np.abs(value) <= FARTHEST) | (np.isnan(value) & may_lack)))


def _is_sticks(argument: Any) -> bool:
    """Whether `argument` is a Sticks of six deflections within -1 to 1."""
    if not isinstance(argument, Sticks) or not all(isinstance(group, tuple) and len(group) == 3 for group in argument):
        return False
    return all(_is_real(value) and abs(value) <= 1.0 for group in argument for value in group)


def is_setpoint(argument: Any, may_lack: bool = False) -> bool:
    """Whether `argument` is a valid Setpoint; with `may_lack`, NaN marks quantities that are not commanded."""
    if not isinstance(argument, Setpoint):
        return False
    p_wb, q_wb, *rest = argument
    if not all(_is_array(value, 3, may_lack) for value in (p_wb, *rest)) or not _is_array(q_wb, 4, may_lack):
        return False
    return abs(math.sqrt(float(q_wb @ q_wb)) - 1.0) <= UNIT or (may_lack and bool(np.isnan(q_wb).all()))


def _is_place(argument: Any) -> bool:
    return argument is None or is_setpoint(argument)


def _is_point(argument: Any) -> bool:
    return is_setpoint(argument, may_lack=True)


def _is_trajectory(argument: Any) -> bool:
    """Whether `argument` can be sampled, and starts and ends at valid set-points."""
    duration_s: Any = getattr(argument, "duration_s", None)
    if not _is_real(duration_s) or duration_s < 0.0 or not callable(getattr(argument, "sample", None)):
        return False
    return is_setpoint(argument.sample(0.0)) and is_setpoint(argument.sample(duration_s))


def _is_parameter(argument: Any) -> bool:
    if not isinstance(argument, tuple) or len(argument) != 2:
        return False
    name, value = argument
    return isinstance(name, str) and isinstance(value, int | float | str)


def _is_dock(argument: Any) -> bool:
    if not isinstance(argument, DockRequest):
        return False
    *numbers, both_approach = argument
    if not all(type(number) is int and number >= 0 for number in numbers) or not isinstance(both_approach, bool):
        return False
    return argument.face < FACES and argument.target_face < FACES and argument.quarter_turns < QUARTERS


def _is_motor_test(argument: Any) -> bool:
    if not isinstance(argument, tuple) or len(argument) != 3:
        return False
    index, share, seconds = argument
    return type(index) is int and index >= 0 and _is_real(share) and _is_real(seconds)


SOUND: Mapping[Action, Callable[[Any], bool]] = {
    Action.ARM: _is_forced,
    Action.DISARM: _anything,
    Action.HOLD: _is_place,
    Action.TRACK: _is_trajectory,
    Action.ESTOP: _anything,
    Action.CLEAR_ESTOP: _anything,
    Action.SET_MODE: _is_mode,
    Action.STICKS: _is_sticks,
    Action.SET_POINT: _is_point,
    Action.SET_PARAMETER: _is_parameter,
    Action.DOCK: _is_dock,
    Action.UNDOCK: _is_dock,
    Action.MOTOR_TEST: _is_motor_test,
    Action.GROUND_ALIVE: _anything,
}
"""Argument check of each action. Actions that stop a robot are never refused for their argument."""


def sift(requests: Sequence[Request], bodies: Mapping[int, Body]) -> tuple[list[Request], list[Event]]:
    """The valid requests that reach a body, and a warning with the reason for each of the others."""
    if not requests:
        return [], []
    reasons = [against_request(request, bodies) for request in requests]
    sound = [request for request, why in zip(requests, reasons, strict=True) if not why]
    refused = [(request, why) for request, why in zip(requests, reasons, strict=True) if why]
    return sound, [Event(WARNING, f"{request.action.name} refused: {why}", request.body) for request, why in refused]


def readdressed(requests: Sequence[Request], before: Sequence[Body], bodies: Mapping[int, Body]) -> list[Request]:
    """Readdresses requests whose body has joined or parted, in this tick or earlier: those that stop a body reach the modules it had.

    DISARM goes to every body that has a module of the body it named. A request that merely ends what a body does goes to the body that
    holds the module of that number if no body has the number any more.

    Args:
        before: the bodies at the beginning of the tick, and those that broke apart lately. bodies: the present ones, by number.
    """
    found: list[Request] = []
    for request in requests:
        is_meant = request.action == Action.DISARM or (request.body not in bodies and _ends_a_task(request))
        meant = _holders(request.body, before, bodies) if is_meant else []
        found += [request._replace(body=number) for number in meant] or [request]
    return found


def _ends_a_task(request: Request) -> bool:
    """Whether the request makes a body hold its place or surface, whatever it does: safe for the whole of which it is a part now."""
    if request.action == Action.HOLD:
        return request.argument is None
    return request.action == Action.SET_MODE and request.argument in (Mode.POSHOLD, Mode.SURFACE)


def _holders(named: int, before: Sequence[Body], bodies: Mapping[int, Body]) -> list[int]:
    """Numbers of the bodies that include a module of a body that has the number `named`, or had it in `before`. A body
    has the number of its first module: if none has it now, the one that includes that module counts.
    """
    modules = {named, *(module for body in (*before, *bodies.values()) if body.index == named for module in body.modules)}
    return [number for number, body in bodies.items() if not modules.isdisjoint(body.modules)]


def against_request(request: Request, bodies: Mapping[int, Body]) -> str:
    """Reason, in words, why a request is refused; empty if it is valid. `bodies`: by number."""
    if not SOUND[request.action](request.argument):
        return "its argument makes no sense"
    if request.action in FOR_ALL:
        return ""
    if request.body not in bodies:
        return f"{name_module(request.body)} leads no body, but {name_modules(sorted(bodies))}"
    if request.action == Action.MOTOR_TEST and request.argument[0] >= (count := bodies[request.body].thrusters.f_max.size):
        return f"there is no thruster {request.argument[0]}; there are {count}, from 0 on"
    if request.action in (Action.DOCK, Action.UNDOCK):
        return _against_faces(request.action, request.argument, request.body, bodies)
    return ""


def _against_faces(action: Action, dock: DockRequest, body: int, bodies: Mapping[int, Body]) -> str:
    """Reason why two modules can neither dock nor undock; empty if they can. For an undock it does not matter which faces it names."""
    faces = {module: kinds for each in bodies.values() for module, kinds in zip(each.modules, each.faces, strict=True)}
    unknown = {dock.module, dock.target_module} - faces.keys()
    if unknown:
        return f"there is no {name_module(min(unknown))}, but {name_modules(sorted(faces))}"
    if dock.module not in bodies[body].modules:
        return f"{name_module(dock.module)} is not of the body of {name_module(body)}"
    together = dock.target_module in bodies[body].modules
    if together == (action == Action.DOCK):
        return f"{name_pair(dock.module, dock.target_module)} are {'already' if together else 'not'} of one body"
    why = "" if together else face_mismatch(faces[dock.module], dock.face, faces[dock.target_module], dock.target_face)
    return why and f"{name_module(dock.module)} cannot dock to {name_module(dock.target_module)}: {why}"
