"""The supervisor's transitions, as data: from which state, on which trigger, under which guard, to which state."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from firmware_py.core.types import Action


class State(IntEnum):
    """What a body does."""

    DISARMED = 0
    HOLD = 1
    TRACK = 2
    ESTOP = 3


class Guard(IntEnum):
    """What must hold for a transition, checked by the supervisor."""

    ALWAYS = 0
    MAY_ARM = 1
    ESTOP_CLEAR = 2


class Transition(NamedTuple):
    """One row."""

    state: State
    trigger: Action
    guard: Guard
    next_state: State


ARMED = frozenset({State.HOLD, State.TRACK})
"""States in which thrusters may turn."""

TABLE = (
    Transition(State.DISARMED, Action.ARM, Guard.MAY_ARM, State.HOLD),
    Transition(State.HOLD, Action.DISARM, Guard.ALWAYS, State.DISARMED),
    Transition(State.TRACK, Action.DISARM, Guard.ALWAYS, State.DISARMED),
    Transition(State.HOLD, Action.HOLD, Guard.ALWAYS, State.HOLD),
    Transition(State.TRACK, Action.HOLD, Guard.ALWAYS, State.HOLD),
    Transition(State.HOLD, Action.TRACK, Guard.ALWAYS, State.TRACK),
    Transition(State.TRACK, Action.TRACK, Guard.ALWAYS, State.TRACK),
    Transition(State.DISARMED, Action.ESTOP, Guard.ALWAYS, State.ESTOP),
    Transition(State.HOLD, Action.ESTOP, Guard.ALWAYS, State.ESTOP),
    Transition(State.TRACK, Action.ESTOP, Guard.ALWAYS, State.ESTOP),
    Transition(State.ESTOP, Action.CLEAR_ESTOP, Guard.ESTOP_CLEAR, State.DISARMED),
)

ROWS = {(row.state, row.trigger): row for row in TABLE}
