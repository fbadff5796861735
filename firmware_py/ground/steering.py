"""Pilot and program at the stick: MANUAL_CONTROL, RC_CHANNELS_OVERRIDE, streamed set-points. The core decides.

MANUAL_CONTROL: x forward, y right, z up, r clockwise seen from above, s nose up, t right side down; of +-1000, z by
STICK_Z.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.core.rotations import from_euler, heading, multiply, normalise, rotate, to_euler
from firmware_py.core.setpoint import leashed, leashed_turn
from firmware_py.core.types import NOTICE, WARNING, Action, DockRequest, Mode, Setpoint, Sticks
from firmware_py.description.parameters import Parameters
from firmware_py.ground.dialect import Message
from firmware_py.ground.pilots import Pilots, Sender, Turn, sender_of
from firmware_py.ground.system import NS_PER_S, STOPPING, Arrival, Handler, System

_FULL, _MIDDLE_UP = 1000.0, 500.0
_ABSENT = 0x7FFF
_PWM_MIDDLE, _PWM_HALF, _PWM_LOW, _PWM_HIGH = 1500.0, 400.0, 800, 2200
_FRAMES_WORLD, _FRAMES_BODY = (1, 7), (8, 9, 12)
"""MAV_FRAME: LOCAL_NED, LOCAL_OFFSET_NED; BODY_NED, BODY_OFFSET_NED, BODY_FRD."""
_FRAME_OFFSETS = (7, 8, 9, 12)
_POSITION_BIT, _VELOCITY_BIT, _ACCELERATION_BIT, _NO_YAW, _NO_YAW_RATE = 0, 3, 6, 0x400, 0x800
"""The first of three bits, one for each axis that is left out; and POSITION_TARGET_TYPEMASK's last two."""
_FORCES, _NO_ACCELERATION = 0x200, 7 << _ACCELERATION_BIT
"""What stands for accelerations is N; and all three are left out."""
_RC_IGNORED = 0xFFFF
"""A channel of RC_CHANNELS_OVERRIDE that stays as it is; 0 lets it go."""
BUTTONS: tuple[str, ...] = (
    "hold", "manual", "stabilize", "depth", "disarm", "", "arm", "estop", "clear_estop", "dock", "undock", "surface",
)  # fmt: skip
"""What each button of a joystick does, first to last."""
_BUTTON_MODES = {
    "hold": Mode.POSHOLD, "manual": Mode.MANUAL, "stabilize": Mode.STABILIZE, "depth": Mode.ALT_HOLD,
    "surface": Mode.SURFACE,
}  # fmt: skip
_BUTTON_ACTIONS = {
    "arm": Action.ARM, "disarm": Action.DISARM, "estop": Action.ESTOP, "clear_estop": Action.CLEAR_ESTOP,
    "dock": Action.DOCK, "undock": Action.UNDOCK,
}  # fmt: skip
_STOPS_LAST = tuple(sorted(enumerate(BUTTONS), key=lambda button: _BUTTON_ACTIONS.get(button[1]) in STOPPING))
"""The buttons as they are done when several are pressed at once: what stops has the last word."""


class _Override(NamedTuple):
    """One channel as it was overridden last."""

    pwm: int
    at_ns: int


_LET_GO = _Override(0, 0)
_ALL_LET_GO = [_LET_GO] * 6


class _Wanted(NamedTuple):
    """What a streamed set-point gives; None where its mask leaves it out. What is given and no number is infinite."""

    position: np.ndarray | None
    """NaN on axes that are left out."""
    velocity: np.ndarray | None
    acceleration: np.ndarray | None
    yaw: float | None
    rate: float

    @property
    def makes_sense(self) -> bool:
        """Whether everything in it is a number, and it says where to go."""
        vectors = [v for v in (self.position, self.velocity, self.acceleration) if v is not None]
        numbers = [self.rate, 0.0 if self.yaw is None else self.yaw]
        finite = not any(np.isinf(v).any() for v in vectors) and all(map(math.isfinite, numbers))
        return finite and (self.position is not None or self.velocity is not None)

    def turned(self, yaw: float) -> _Wanted:
        """From the body's heading to the world."""
        turn = from_euler(0.0, 0.0, yaw)

        def to_world(v: np.ndarray | None) -> np.ndarray | None:
            return None if v is None else np.asarray(rotate(turn, v))

        return _Wanted(
            None if self.position is None else _turned_where_given(self.position, turn),
            to_world(self.velocity), to_world(self.acceleration), None if self.yaw is None else self.yaw + yaw, self.rate,
        )  # fmt: skip


class Steering:
    """Sticks, buttons and set-points of one system."""

    def __init__(
        self,
        system: System,
        parameters: Callable[[], Parameters],
        dock: DockRequest | None,
        may_steer: Callable[[int, int], bool],
    ) -> None:
        """`dock` is what the buttons `dock` and `undock` ask for; `may_steer`: whose sticks are taken, by system and component."""
        self._system, self._parameters, self._dock = system, parameters, dock
        self._pilots = Pilots(system, may_steer, lambda: parameters().steering.stick_timeout_s)
        self._sticks = Sticks()
        self._overrides: dict[Sender, list[_Override]] = {}
        self._turn = Turn(system, "set-points", lambda: parameters().ground.setpoint_fresh_s)
        self._setpoint_ns: int | None = None
        self._setpoint: Setpoint | None = None

    def handlers(self) -> dict[str, Handler]:
        """By message name."""
        return {
            "MANUAL_CONTROL": self._manual,
            "RC_CHANNELS_OVERRIDE": self._override,
            "SET_POSITION_TARGET_LOCAL_NED": self._target,
            "SET_ATTITUDE_TARGET": self._attitude_target,
        }

    def is_neutral(self, time_ns: int) -> bool:
        """Whether nobody holds a stick."""
        deflection = max(map(abs, (*self._sticks.force, *self._sticks.moment)))
        return self._pilots.are_silent(time_ns) or deflection <= self._parameters().steering.stick_dead

    def has_setpoint(self, time_ns: int) -> bool:
        """Whether set-points stream in."""
        fresh_ns = self._parameters().ground.setpoint_fresh_s * NS_PER_S
        return self._setpoint_ns is not None and time_ns - self._setpoint_ns <= fresh_ns

    def step(self, time_ns: int) -> None:
        """End guided mode when its set-points stay away."""
        s = self._system.subject
        s.neutral = self.is_neutral(time_ns)
        guided = s.armed and s.picture.mode(s.body) == Mode.GUIDED
        if guided and self._setpoint_ns is not None and not self.has_setpoint(time_ns):
            self._setpoint_ns = None
            self._system.ask(Action.SET_MODE, Mode.POSHOLD)
            self._system.say(WARNING, "set-points stay away: holding the place")

    # ------------------------------------------------------------ pilot

    def _manual(self, arrival: Arrival) -> None:
        """Sticks for all (target 0) would steer every body at once: they are nobody's, as ArduPilot has it. What stops is for all."""
        m = arrival.message
        extensions = m["enabled_extensions"]
        force = (_axis(m["x"]), _axis(m["y"]), -self._up(m["z"]))
        moment = (
            _axis(m["t"]) if extensions & 2 else 0.0,
            _axis(m["s"]) if extensions & 1 else 0.0,
            _axis(m["r"]),
        )
        fresh = self._pilots.freshly_pressed(arrival, m["buttons"] | m["buttons2"] << 16)
        steers = m["target"] == self._system.outbox.system and self._steer(Sticks(force, moment), arrival)
        for number, name in _STOPS_LAST:
            if fresh >> number & 1 and (steers or _BUTTON_ACTIONS.get(name) in STOPPING):
                self._do(name)

    def _up(self, z: float) -> float:
        if z == _ABSENT:
            return 0.0
        if self._parameters().ground.stick_z == 1:
            return _axis(z)
        return min(max((z - _MIDDLE_UP) / _MIDDLE_UP, -1.0), 1.0)

    def _override(self, arrival: Arrival) -> None:
        """ArduSub's channels: 1 pitch, 2 roll, 3 up, 4 yaw, 5 forward, 6 right. One that neither overrides nor lets go is nothing.

        A channel that a message leaves out stays as its sender had it, for as long as sticks count.
        """
        now_ns, oldest_ns = arrival.time_ns, arrival.time_ns - self._parameters().steering.stick_timeout_s * NS_PER_S
        fresh = ((who, [o if o.at_ns >= oldest_ns else _LET_GO for o in kept]) for who, kept in self._overrides.items())
        self._overrides = {who: kept for who, kept in fresh if kept != _ALL_LET_GO}
        before = self._overrides.get(sender_of(arrival), _ALL_LET_GO)
        channels = [arrival.message[f"chan{i}_raw"] for i in range(1, 7)]
        after = [old if pwm == _RC_IGNORED else _Override(pwm, now_ns) for old, pwm in zip(before, channels, strict=True)]
        if not any(_is_overridden(o.pwm) for o in (*before, *after)) or all(pwm == _RC_IGNORED for pwm in channels):
            return
        pitch, roll, up, yaw, forward, right = (_channel(o.pwm) for o in after)
        if self._steer(Sticks((forward, right, -up), (roll, pitch, yaw)), arrival):
            self._overrides[sender_of(arrival)] = after

    def _steer(self, sticks: Sticks, arrival: Arrival) -> bool:
        """Take the sticks of who has them. Returns whether it was the sender."""
        if not self._system.body_is_known:
            self._system.refuse(arrival.time_ns)
            return False
        steers = self._pilots.steers(arrival)
        if steers:
            self._sticks = sticks
            self._system.ask(Action.STICKS, sticks)
        return steers

    def _do(self, name: str) -> None:
        if name in _BUTTON_MODES:
            self._system.subject.mode_number = None
            self._system.ask(Action.SET_MODE, _BUTTON_MODES[name])
        elif name in ("dock", "undock"):
            if self._dock is None:
                self._system.say(NOTICE, f"{name} refused: no faces are configured for the button")
            else:
                self._system.ask(_BUTTON_ACTIONS[name], self._dock)
        elif name in _BUTTON_ACTIONS:
            argument = False if name in ("arm", "disarm") else None
            self._system.ask(_BUTTON_ACTIONS[name], argument)

    # ------------------------------------------------------------ set-points

    def _target(self, arrival: Arrival) -> None:
        m = arrival.message
        if m["coordinate_frame"] not in (*_FRAMES_WORLD, *_FRAMES_BODY) or not self._system.body_is_known:
            return
        mask = m["type_mask"]
        if mask & _FORCES and mask & _NO_ACCELERATION != _NO_ACCELERATION:
            return  # a force is no acceleration, and there is no control of forces
        wanted = _Wanted(
            position=_vector(m, ("x", "y", "z"), mask >> _POSITION_BIT, math.nan),
            velocity=_vector(m, ("vx", "vy", "vz"), mask >> _VELOCITY_BIT, 0.0),
            acceleration=_vector(m, ("afx", "afy", "afz"), mask >> _ACCELERATION_BIT, 0.0),
            yaw=None if mask & _NO_YAW else m["yaw"],
            rate=0.0 if mask & _NO_YAW_RATE else m["yaw_rate"],
        )
        if not wanted.makes_sense:
            return
        record = self._system.subject.record
        if m["coordinate_frame"] in _FRAMES_BODY:
            wanted = wanted.turned(to_euler(heading(record.setpoint.q_wb))[2])
        if wanted.position is not None and m["coordinate_frame"] in _FRAME_OFFSETS:
            wanted = wanted._replace(position=wanted.position + record.estimate.p_wb)
        q_wb = self._attitude(record.setpoint.q_wb, wanted.yaw, wanted.rate, arrival.time_ns)
        p_wb = self._place(record.setpoint.p_wb, wanted.position, wanted.velocity, arrival.time_ns)
        zero, rate = np.zeros(3), np.array([0.0, 0.0, wanted.rate])
        v_w = zero if wanted.velocity is None else wanted.velocity
        a_w = zero if wanted.acceleration is None else wanted.acceleration
        self._stream(Setpoint(p_wb, q_wb, v_w, rate, a_w, zero), arrival)

    def _place(
        self, now: np.ndarray, position: np.ndarray | None, velocity: np.ndarray | None, time_ns: int
    ) -> np.ndarray:
        """Where to be: as asked for; on an axis without a place further along its velocity, or as before."""
        start, elapsed_s = self._before(time_ns)
        before = now if start is None else start.p_wb
        at = self._system.subject.record.estimate.p_wb
        moved = before if velocity is None else leashed(before, at) + velocity * elapsed_s
        return np.asarray(moved if position is None else np.where(np.isnan(position), moved, position))

    def _attitude(self, now: np.ndarray, yaw: float | None, rate: float, time_ns: int) -> np.ndarray:
        """Level at the given yaw; without one as before, turned on by the rate."""
        if yaw is not None:
            return from_euler(0.0, 0.0, yaw)
        start, elapsed_s = self._before(time_ns)
        q = now if start is None else start.q_wb
        q = leashed_turn(q, self._system.subject.record.estimate.q_wb) if rate else q
        return np.asarray(normalise(multiply(from_euler(0.0, 0.0, rate * elapsed_s), q)))

    def _before(self, time_ns: int) -> tuple[Setpoint | None, float]:
        """The set-point before, while they stream in guided mode, and its age, s."""
        s = self._system.subject
        guided = s.armed and s.picture.mode(s.body) == Mode.GUIDED
        if self._setpoint is None or not guided or not self.has_setpoint(time_ns):
            return None, 0.0
        assert self._setpoint_ns is not None
        return self._setpoint, (time_ns - self._setpoint_ns) / NS_PER_S

    def _attitude_target(self, arrival: Arrival) -> None:
        """An attitude, held at the place where it is: the robot is omnidirectional."""
        m = arrival.message
        q = np.array(m["q"], dtype=float)
        if m["type_mask"] & 0x80 or not np.all(np.isfinite(q)) or not 0.5 < float(np.linalg.norm(q)) < 2.0:
            return
        if not self._system.body_is_known:
            return
        start, _ = self._before(arrival.time_ns)
        p_wb = (start or self._system.subject.record.setpoint).p_wb
        zero = np.zeros(3)
        self._stream(Setpoint(p_wb, np.asarray(normalise(q)), zero, zero, zero, zero), arrival)

    def _stream(self, setpoint: Setpoint, arrival: Arrival) -> None:
        """Follow it, where it is the sender's turn."""
        if self._turn.is_of(arrival):
            self._setpoint, self._setpoint_ns = setpoint, arrival.time_ns
            self._system.ask(Action.SET_POINT, setpoint)


def _axis(value: float) -> float:
    return 0.0 if value == _ABSENT else min(max(value / _FULL, -1.0), 1.0)


def _channel(pwm: int) -> float:
    return min(max((pwm - _PWM_MIDDLE) / _PWM_HALF, -1.0), 1.0) if _is_overridden(pwm) else 0.0


def _is_overridden(pwm: int) -> bool:
    return _PWM_LOW <= pwm <= _PWM_HIGH  # neither 0 nor 65535


def _vector(message: Message, names: Sequence[str], left_out: int, instead: float) -> np.ndarray | None:
    """(3,) as given, with `instead` on the axes whose bits of `left_out` are set; None when all are. What is no number is infinite."""
    if left_out & 7 == 7:
        return None
    given = (message[name] if math.isfinite(message[name]) else math.inf for name in names)
    return np.array([instead if left_out >> axis & 1 else value for axis, value in enumerate(given)])


def _turned_where_given(p_b: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """An offset (3,) turned about the vertical. Of ahead and sideways one alone that is left out is no offset there."""
    left_out = np.isnan(p_b)
    left_out[:2] = left_out[:2].all()
    return np.where(left_out, math.nan, rotate(turn, np.nan_to_num(p_b)))
