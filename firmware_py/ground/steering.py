"""Steering by pilots and programs: MANUAL_CONTROL, RC_CHANNELS_OVERRIDE, streamed set-points. The core decides what to do with them.

MANUAL_CONTROL axes: x forward, y right, z up, r clockwise seen from above, s nose up, t right side down. All range over +-1000,
except z, whose range STICK_Z selects.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from firmware_py.core.requests import is_setpoint
from firmware_py.core.rotations import from_euler, heading, multiply, normalise, rotate, to_euler
from firmware_py.core.setpoint import leashed, leashed_turn
from firmware_py.core.types import NOTICE, WARNING, Action, DockRequest, Mode, Setpoint, Sticks
from firmware_py.description.parameters import Parameters
from firmware_py.ground.dialect import Message
from firmware_py.ground.pilots import Pilots, Sender, SenderArbiter, sender_of
from firmware_py.ground.system import NS_PER_S, STOPPING, Arrival, Handler, System

_FULL, _MIDDLE_UP = 1000.0, 500.0
_ABSENT = 0x7FFF
_PWM_MIDDLE, _PWM_HALF, _PWM_LOW, _PWM_HIGH = 1500.0, 400.0, 800, 2200
_FRAMES_WORLD, _FRAMES_BODY = (1, 7), (8, 9, 12)
"""MAV_FRAME: LOCAL_NED, LOCAL_OFFSET_NED; BODY_NED, BODY_OFFSET_NED, BODY_FRD."""
_FRAME_OFFSETS = (7, 8, 9, 12)
_POSITION_BIT, _VELOCITY_BIT, _ACCELERATION_BIT, _NO_YAW, _NO_YAW_RATE = 0, 3, 6, 0x400, 0x800
"""POSITION_TARGET_TYPEMASK: number of the first of three bits, one per axis, that mark an axis as left out; masks of the last two bits."""
_FORCES, _NO_ACCELERATION = 0x200, 7 << _ACCELERATION_BIT
"""Mask of the bit by which the acceleration fields are forces, N; mask by which all three of them are left out."""
_NO_ATTITUDE = 0x80
"""ATTITUDE_TARGET_TYPEMASK: the attitude is left out."""
_BACK_M = 0.1
"""Largest distance, per axis, between the body and a place that a velocity leads back to it. A body that was held back, as at the fence,
would else stand until the place has come back by `core.setpoint.LEASH_M`. A body that follows is nearer to its place."""
_HAS_PITCH, _HAS_ROLL = 1, 2
"""Bits of `enabled_extensions` in MANUAL_CONTROL: the axes s and t are sent."""
_RC_IGNORED = 0xFFFF
"""Value of a channel of RC_CHANNELS_OVERRIDE that stays as it is; 0 releases the channel."""
BUTTONS: Mapping[int, tuple[Action, Any]] = {
    0: (Action.SET_MODE, Mode.POSHOLD), 1: (Action.SET_MODE, Mode.MANUAL), 2: (Action.SET_MODE, Mode.STABILIZE),
    3: (Action.SET_MODE, Mode.ALT_HOLD), 4: (Action.DISARM, False), 6: (Action.ARM, False), 7: (Action.ESTOP, None),
    8: (Action.CLEAR_ESTOP, None), 9: (Action.DOCK, None), 10: (Action.UNDOCK, None), 11: (Action.SET_MODE, Mode.SURFACE),
}  # fmt: skip
"""Action and argument of each joystick button; the faces of a dock or undock are configured."""
_STOPS_LAST = tuple(sorted(BUTTONS.items(), key=lambda button: button[1][0] in STOPPING))
"""Buttons in the order of execution when several are pressed at once: those that stop come last and prevail."""


class _Override(NamedTuple):
    """Last override of one channel."""

    pwm: int
    at_ns: int


_LET_GO = _Override(0, 0)
_ALL_LET_GO = [_LET_GO] * 6


class _Wanted(NamedTuple):
    """Contents of a streamed set-point; None where its mask leaves a part out. Vector components given as non-finite are infinite."""

    position: np.ndarray | None
    """NaN on axes that are left out."""
    velocity: np.ndarray | None
    acceleration: np.ndarray | None
    yaw: float | None
    rate: float

    @property
    def makes_sense(self) -> bool:
        """Whether all given values are finite, and a position or a velocity is among them."""
        vectors = [v for v in (self.position, self.velocity, self.acceleration) if v is not None]
        numbers = [self.rate, 0.0 if self.yaw is None else self.yaw]
        finite = not any(np.isinf(v).any() for v in vectors) and all(map(math.isfinite, numbers))
        return finite and (self.position is not None or self.velocity is not None)

    def turned(self, yaw: float) -> _Wanted:
        """Returns the set-point rotated from the heading frame to the world frame, for a heading of `yaw`, rad."""
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
        """`dock`: request of the buttons `dock` and `undock`; `may_steer`: whether sticks of a system and component are accepted."""
        self._system, self._parameters, self._dock = system, parameters, dock
        self._pilots = Pilots(system, may_steer, lambda: parameters().steering.stick_timeout_s)
        self._sticks = Sticks()
        self._overrides: dict[Sender, list[_Override]] = {}
        self._arbiter = SenderArbiter(system, "set-points", lambda: parameters().ground.setpoint_fresh_s)
        self._setpoint_ns: int | None = None
        self._setpoint: Setpoint | None = None

    def handlers(self) -> dict[str, Handler]:
        """Handlers by message name."""
        return {
            "MANUAL_CONTROL": self._manual,
            "RC_CHANNELS_OVERRIDE": self._override,
            "SET_POSITION_TARGET_LOCAL_NED": self._target,
            "SET_ATTITUDE_TARGET": self._attitude_target,
        }

    def is_neutral(self, time_ns: int) -> bool:
        """Whether the sticks are within the dead zone, or no pilot is active."""
        deflection = max(map(abs, (*self._sticks.force, *self._sticks.moment)))
        return self._pilots.are_silent(time_ns) or deflection <= self._parameters().steering.stick_dead

    def has_setpoint(self, time_ns: int) -> bool:
        """Whether the last set-point is fresh."""
        fresh_ns = self._parameters().ground.setpoint_fresh_s * NS_PER_S
        return self._setpoint_ns is not None and time_ns - self._setpoint_ns <= fresh_ns

    def step(self, time_ns: int) -> None:
        """Updates `neutral` of the subject; ends guided mode when its set-points time out."""
        s = self._system.subject
        s.neutral = self.is_neutral(time_ns)
        guided = s.armed and s.picture.mode(s.body) == Mode.GUIDED
        if guided and self._setpoint_ns is not None and not self.has_setpoint(time_ns):
            self._setpoint_ns = None
            self._system.ask(Action.SET_MODE, Mode.POSHOLD)
            self._system.say(WARNING, "set-points stay away: holding the place")

    # ------------------------------------------------------------ pilot

    def _manual(self, arrival: Arrival) -> None:
        """Takes sticks and buttons. Sticks for all systems (target 0) would steer every body at once and are ignored, as in ArduPilot.

        Buttons that stop take effect whatever the target and whoever has the sticks.
        """
        m = arrival.message
        extensions = m["enabled_extensions"]
        force = (_axis(m["x"]), _axis(m["y"]), -self._up(m["z"]))
        moment = (
            _axis(m["t"]) if extensions & _HAS_ROLL else 0.0,
            _axis(m["s"]) if extensions & _HAS_PITCH else 0.0,
            _axis(m["r"]),
        )
        fresh = self._pilots.freshly_pressed(arrival, m["buttons"] | m["buttons2"] << 16)
        steers = m["target"] == self._system.outbox.system and self._steer(Sticks(force, moment), arrival)
        for number, (action, argument) in _STOPS_LAST:
            if fresh >> number & 1 and (steers or action in STOPPING):
                self._do(action, argument)

    def _up(self, z: float) -> float:
        if z == _ABSENT:
            return 0.0
        if self._parameters().ground.stick_z == 1:
            return _axis(z)
        return min(max((z - _MIDDLE_UP) / _MIDDLE_UP, -1.0), 1.0)

    def _override(self, arrival: Arrival) -> None:
        """Overrides or releases ArduSub's channels: 1 pitch, 2 roll, 3 up, 4 yaw, 5 forward, 6 right. Ignores messages that do neither.

        A channel that a message leaves unchanged keeps its sender's last override until the stick timeout.
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
        """Applies `sticks` if their sender has control. Returns whether it has."""
        if not self._system.body_is_known:
            self._system.refuse(arrival.time_ns)
            return False
        steers = self._pilots.claim_sticks(arrival)
        if steers:
            self._sticks = sticks
            self._system.ask(Action.STICKS, sticks)
        return steers

    def _do(self, action: Action, argument: Any) -> None:
        if action in (Action.DOCK, Action.UNDOCK):
            argument = self._dock
            if argument is None:
                self._system.say(NOTICE, f"{action.name.lower()} refused: no faces are configured for the button")
                return
        if action == Action.SET_MODE:
            self._system.subject.mode_number = None
        self._system.ask(action, argument)

    # ------------------------------------------------------------ set-points

    def _target(self, arrival: Arrival) -> None:
        m = arrival.message
        if m["coordinate_frame"] not in (*_FRAMES_WORLD, *_FRAMES_BODY) or not self._system.body_is_known:
            return
        mask = m["type_mask"]
        if mask & _FORCES and mask & _NO_ACCELERATION != _NO_ACCELERATION:
            return  # forces are not accelerations, and force control is not supported
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
        """Returns the position to hold: as requested; on an axis without a position moved on by the velocity, or unchanged. An axis
        whose velocity has just ended stays where the body was to be: at the fence, or before another body, its place was ahead of that.
        """
        start, elapsed_s = self._before(time_ns)
        going = np.zeros(3) if velocity is None else velocity
        before = now if start is None else np.where((going == 0.0) & (start.v_w != 0.0), now, start.p_wb)
        at = self._system.subject.record.estimate.p_wb
        moved = before if velocity is None else _reined_in(before, at, velocity) + velocity * elapsed_s
        return np.asarray(moved if position is None else np.where(np.isnan(position), moved, position))

    def _attitude(self, now: np.ndarray, yaw: float | None, rate: float, time_ns: int) -> np.ndarray:
        """Returns the attitude to hold: level at the given yaw; without a yaw the previous attitude, turned further by the rate."""
        if yaw is not None:
            return from_euler(0.0, 0.0, yaw)
        start, elapsed_s = self._before(time_ns)
        q = now if start is None else start.q_wb
        q = leashed_turn(q, self._system.subject.record.estimate.q_wb) if rate else q
        return np.asarray(normalise(multiply(from_euler(0.0, 0.0, rate * elapsed_s), q)))

    def _before(self, time_ns: int) -> tuple[Setpoint | None, float]:
        """Returns the previous set-point and its age, s, while set-points stream in guided mode and armed; otherwise None and 0."""
        s = self._system.subject
        guided = s.armed and s.picture.mode(s.body) == Mode.GUIDED
        if self._setpoint is None or not guided or not self.has_setpoint(time_ns):
            return None, 0.0
        assert self._setpoint_ns is not None
        return self._setpoint, (time_ns - self._setpoint_ns) / NS_PER_S

    def _attitude_target(self, arrival: Arrival) -> None:
        """Takes an attitude, and keeps the position set-point: the robot is omnidirectional."""
        m = arrival.message
        q = np.array(m["q"], dtype=float)
        if m["type_mask"] & _NO_ATTITUDE or not np.all(np.isfinite(q)) or not 0.5 < float(np.linalg.norm(q)) < 2.0:
            return
        if not self._system.body_is_known:
            return
        p_wb = self._place(self._system.subject.record.setpoint.p_wb, None, None, arrival.time_ns)
        zero = np.zeros(3)
        self._stream(Setpoint(p_wb, np.asarray(normalise(q)), zero, zero, zero, zero), arrival)

    def _stream(self, setpoint: Setpoint, arrival: Arrival) -> None:
        """Requests `setpoint` if its sender has control of the set-points; ignores one that the core would refuse, each time in a text."""
        if is_setpoint(setpoint) and self._arbiter.claim(arrival):
            self._setpoint, self._setpoint_ns = setpoint, arrival.time_ns
            self._system.ask(Action.SET_POINT, setpoint)


def _axis(value: float) -> float:
    return 0.0 if value == _ABSENT else min(max(value / _FULL, -1.0), 1.0)


def _channel(pwm: int) -> float:
    return min(max((pwm - _PWM_MIDDLE) / _PWM_HALF, -1.0), 1.0) if _is_overridden(pwm) else 0.0


def _is_overridden(pwm: int) -> bool:
    return _PWM_LOW <= pwm <= _PWM_HIGH  # neither 0 nor 65535


def _vector(message: Message, names: Sequence[str], left_out: int, instead: float) -> np.ndarray | None:
    """Returns the named fields (3,), `instead` where bits of `left_out` are set; None if all are. Non-finite values become infinite."""
    if left_out & 7 == 7:
        return None
    given = (message[name] if math.isfinite(message[name]) else math.inf for name in names)
    return np.array([instead if left_out >> axis & 1 else value for axis, value in enumerate(given)])


def _reined_in(place: np.ndarray, p_wb: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Returns the place (3,) on its leash from the body at `p_wb` (3,): a short leash on axes on which `velocity` leads it back there."""
    leads_back = velocity * (place - p_wb) < 0.0
    return np.where(leads_back, np.clip(place, p_wb - _BACK_M, p_wb + _BACK_M), leashed(place, p_wb))


def _turned_where_given(p_b: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Returns an offset (3,) turned about the vertical; NaN marks axes left out. If only one of ahead and sideways is, it counts as 0."""
    left_out = np.isnan(p_b)
    left_out[:2] = left_out[:2].all()
    return np.where(left_out, math.nan, rotate(turn, np.nan_to_num(p_b)))
