"""The supervisor's rules as data: the transitions (state, trigger, guard, effect, next state), and what each mode needs.

`docs/supervisor.md` is generated from these tables.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from firmware_py.core.types import Action, Mode


class State(IntEnum):
    """Whether a body's thrusters may turn."""

    DISARMED = 0
    ARMED = 1
    ESTOP = 2
    """Latched: left by CLEAR_ESTOP alone."""


class Trigger(IntEnum):
    """What can cause a transition."""

    ESTOP_FRAME = 0
    """An ESTOP frame came from the bus, or a module reports one that the firmware did not hear."""
    ESTOP = 1
    CLEAR_ESTOP = 2
    DISARM = 3
    ARM = 4
    FORCED_ARM = 5
    SET_MODE = 6
    HOLD = 7
    TRACK = 8
    DOCK = 9
    UNDOCK = 10
    SET_POINT = 11
    STICKS = 12
    MOTOR_TEST = 13
    TEST_OVER = 14
    """The motor test that armed the body is over."""
    DOCK_OVER = 15
    """A dock or undock ended without success."""
    FAILSAFE_HOLD = 16
    FAILSAFE_DEPTH = 17
    FAILSAFE_SURFACE = 18
    FAILSAFE_DISARM = 19


TRIGGERS = {action: Trigger[action.name] for action in Action if action.name in Trigger.__members__}
"""Trigger of each request; the supervisor ignores requests without one."""


DOCKING = frozenset({Trigger.DOCK, Trigger.UNDOCK})
"""Requests whose preparation takes a while."""


class Guard(IntEnum):
    """What must hold for a transition."""

    ALWAYS = 0
    ARMING_CHECKS = 1
    """Every arming check, and what the chosen mode needs."""
    FORCED_CHECKS = 2
    """Those arming checks that may not be skipped, and what the chosen mode needs."""
    MODE_PERMITTED = 3
    """The wanted mode has what it needs, and no fail-safe forbids it; a body armed by a motor test must also pass every arming check."""
    MODE_NEEDS = 4
    """The wanted mode has what it needs."""
    ESTOP_QUIET = 5
    """No ESTOP frame came recently."""
    IN_MOTOR_DETECT = 6
    """The mode is MOTOR_DETECT."""
    TESTING = 7
    """A motor test has armed the body."""
    IN_DOCK = 8
    """The mode is DOCK."""
    PARTING_PERMITTED = 9
    """As MODE_PERMITTED, but the fail-safe of a lost partner does not forbid an undock at a joint that is open."""
    JOINT_OPEN = 10
    """The joint should hold but is open: undocking it is the only way to arm a body again that has come apart while disarmed."""


class Effect(IntEnum):
    """What guidance does when a transition is made."""

    NOTHING = 0
    STOP = 1
    """Thrusters stop."""
    ENTER_MODE = 2
    """Steer by the new mode, from where the body is."""
    HOLD_AT = 3
    """Go to the given place and hold it, or hold here."""
    FOLLOW = 4
    """Follow the given trajectory."""
    TAKE_POINT = 5
    """Note the newest streamed set-point."""
    TAKE_STICKS = 6
    """Note the pilot's sticks."""
    TEST_MOTOR = 7
    """Turn the given thruster."""
    ENTER_LEVEL = 8
    """Steer by the new mode, from where the body is, and turn upright if it is steeply tilted, so that cameras see its tags."""


class Transition(NamedTuple):
    """One row of the table."""

    state: State
    trigger: Trigger
    guard: Guard
    effect: Effect
    next_state: State
    mode: Mode | None = None
    """The mode afterwards; None: the one that the request names, or unchanged."""


D, A, E = State
T, G, F = Trigger, Guard, Effect

TABLE = (
    Transition(D, T.ESTOP_FRAME, G.ALWAYS, F.STOP, E),
    Transition(D, T.ESTOP, G.ALWAYS, F.STOP, E),
    Transition(D, T.CLEAR_ESTOP, G.ALWAYS, F.NOTHING, D),
    Transition(D, T.DISARM, G.ALWAYS, F.NOTHING, D),
    Transition(D, T.ARM, G.ARMING_CHECKS, F.ENTER_MODE, A),
    Transition(D, T.FORCED_ARM, G.FORCED_CHECKS, F.ENTER_MODE, A),
    Transition(D, T.SET_MODE, G.ALWAYS, F.NOTHING, D),
    Transition(D, T.UNDOCK, G.JOINT_OPEN, F.NOTHING, D),
    Transition(D, T.SET_POINT, G.ALWAYS, F.TAKE_POINT, D),
    Transition(D, T.STICKS, G.ALWAYS, F.TAKE_STICKS, D),
    Transition(D, T.MOTOR_TEST, G.FORCED_CHECKS, F.TEST_MOTOR, A, Mode.MOTOR_DETECT),
    Transition(A, T.ESTOP_FRAME, G.ALWAYS, F.STOP, E),
    Transition(A, T.ESTOP, G.ALWAYS, F.STOP, E),
    Transition(A, T.CLEAR_ESTOP, G.ALWAYS, F.NOTHING, A),
    Transition(A, T.DISARM, G.ALWAYS, F.STOP, D),
    Transition(A, T.ARM, G.ALWAYS, F.NOTHING, A),
    Transition(A, T.FORCED_ARM, G.ALWAYS, F.NOTHING, A),
    Transition(A, T.SET_MODE, G.MODE_PERMITTED, F.ENTER_MODE, A),
    Transition(A, T.HOLD, G.MODE_PERMITTED, F.HOLD_AT, A, Mode.POSHOLD),
    Transition(A, T.TRACK, G.MODE_PERMITTED, F.FOLLOW, A, Mode.AUTO),
    Transition(A, T.DOCK, G.MODE_PERMITTED, F.ENTER_MODE, A, Mode.DOCK),
    Transition(A, T.UNDOCK, G.PARTING_PERMITTED, F.ENTER_MODE, A, Mode.DOCK),
    Transition(A, T.SET_POINT, G.ALWAYS, F.TAKE_POINT, A),
    Transition(A, T.STICKS, G.ALWAYS, F.TAKE_STICKS, A),
    Transition(A, T.MOTOR_TEST, G.IN_MOTOR_DETECT, F.TEST_MOTOR, A),
    Transition(A, T.TEST_OVER, G.TESTING, F.STOP, D, Mode.POSHOLD),
    Transition(A, T.DOCK_OVER, G.IN_DOCK, F.ENTER_MODE, A, Mode.POSHOLD),
    Transition(A, T.FAILSAFE_HOLD, G.MODE_NEEDS, F.ENTER_LEVEL, A, Mode.POSHOLD),
    Transition(A, T.FAILSAFE_DEPTH, G.MODE_NEEDS, F.ENTER_LEVEL, A, Mode.ALT_HOLD),
    Transition(A, T.FAILSAFE_SURFACE, G.ALWAYS, F.ENTER_MODE, A, Mode.SURFACE),
    Transition(A, T.FAILSAFE_DISARM, G.ALWAYS, F.STOP, D),
    Transition(E, T.ESTOP_FRAME, G.ALWAYS, F.NOTHING, E),
    Transition(E, T.ESTOP, G.ALWAYS, F.NOTHING, E),
    Transition(E, T.CLEAR_ESTOP, G.ESTOP_QUIET, F.NOTHING, D),
    Transition(E, T.DISARM, G.ALWAYS, F.NOTHING, E),
    Transition(E, T.SET_POINT, G.ALWAYS, F.TAKE_POINT, E),
    Transition(E, T.STICKS, G.ALWAYS, F.TAKE_STICKS, E),
)

ROWS = {(row.state, row.trigger): row for row in TABLE}


class Need(IntEnum):
    """What a mode requires."""

    ATTITUDE = 0
    DEPTH = 1
    POSITION = 2
    PILOT = 3


class ModeRow(NamedTuple):
    """One mode."""

    mode: Mode
    needs: frozenset[Need]
    by_pilot: bool = False
    """Whether sticks steer it: the pilot may always take it, whatever fail-safe is on."""
    on_request: bool = True
    """Whether SET_MODE may ask for it."""


MODE_TABLE = (
    ModeRow(Mode.MANUAL, frozenset({Need.PILOT}), by_pilot=True),
    ModeRow(Mode.STABILIZE, frozenset({Need.ATTITUDE, Need.PILOT}), by_pilot=True),
    ModeRow(Mode.ALT_HOLD, frozenset({Need.ATTITUDE, Need.DEPTH}), by_pilot=True),
    ModeRow(Mode.POSHOLD, frozenset({Need.ATTITUDE, Need.POSITION})),
    ModeRow(Mode.AUTO, frozenset({Need.ATTITUDE, Need.POSITION})),
    ModeRow(Mode.GUIDED, frozenset({Need.ATTITUDE, Need.POSITION})),
    ModeRow(Mode.SURFACE, frozenset()),
    ModeRow(Mode.MOTOR_DETECT, frozenset()),
    ModeRow(Mode.DOCK, frozenset({Need.ATTITUDE, Need.POSITION}), on_request=False),
)

MODES = {row.mode: row for row in MODE_TABLE}
