"""Commands: COMMAND_LONG, COMMAND_INT, SET_MODE. Each is acknowledged at once, or when the supervisor has decided."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from firmware_py.core.requests import QUARTERS
from firmware_py.core.types import CHANNELS, FACES, WARNING, Action, DockRequest, Event, Mode
from firmware_py.description.fleet import module_index
from firmware_py.ground.command import ACCEPTED, COMMAND_INT_ONLY, DENIED, FAILED, TEMPORARILY_REJECTED, UNSUPPORTED, Answer, Command
from firmware_py.ground.dialect import Message
from firmware_py.ground.identity import CUSTOM_MODE_ENABLED, SETTABLE
from firmware_py.ground.message_requests import MessageRequests
from firmware_py.ground.mission_flight import MissionFlight
from firmware_py.ground.mission_items import ABSOLUTE, CHANGE_SPEED, ONE_WAY_SPEEDS, RELATIVE
from firmware_py.ground.steering import Steering
from firmware_py.ground.system import Arrival, Handler, System

DECISION_NS = 400_000_000
"""Time limit of the supervisor's decision. It decides within a tick or two; clients repeat a command after 0.5 s."""
_FORCED = (21196, 2989)
"""Second parameter of a forced arm or disarm: MAVLink's, and ArduPilot's for arming."""

LOITER_UNLIM, RETURN_TO_LAUNCH, LAND = 17, 20, 21
SET_MODE, TERMINATE, REPOSITION, PAUSE_CONTINUE, MOTOR_TEST, SET_MISSION_CURRENT = 176, 185, 192, 193, 209, 224
REBOOT, MISSION_START, ARM = 246, 300, 400
"""MAV_CMD, without their prefixes NAV, DO and PREFLIGHT; ARM is COMPONENT_ARM_DISARM."""
DOCK, UNDOCK, ESTOP, CLEAR_ESTOP = 31010, 31011, 31012, 31013
"""User commands: docs/ground-station.md. Dock: module, face, target module, target face, quarter turns, both move."""
_NEEDED = {ARM: 1, TERMINATE: 1, SET_MISSION_CURRENT: 1, MOTOR_TEST: 3, DOCK: 4, UNDOCK: 4}
"""Number of leading parameters that a command must give: one that is not finite would count as 0, which disarms or clears an e-stop."""

_LEFT_OUT = 2**31 - 1
"""COMMAND_INT's value for an x or y that is left out."""
_PWM = 1100, 1900
"""Range of a motor test's throttle as a pulse width, us. In % the range depends on the identity."""


@dataclass(frozen=True, slots=True)
class Pending:
    """A command that waits for the supervisor's decision."""

    command: Command
    action: Action
    is_done: Callable[[], bool]
    deadline_ns: int


class CommandService:
    """The commands of one system."""

    def __init__(self, system: System, missions: MissionFlight, steering: Steering, messages: MessageRequests) -> None:
        self._system, self._missions, self._steering = system, missions, steering
        self._pending: list[Pending] = []
        self.reboot_asked = False
        self._table: dict[int, Callable[[Command], Answer]] = {
            LOITER_UNLIM: lambda c: self._enter(c, Mode.POSHOLD),
            RETURN_TO_LAUNCH: lambda c: self._enter(c, Mode.SURFACE),
            LAND: lambda c: self._enter(c, Mode.SURFACE),
            SET_MODE: self._set_mode,
            CHANGE_SPEED: self._change_speed,
            TERMINATE: self._terminate,
            REPOSITION: self._reposition,
            PAUSE_CONTINUE: self._pause,
            MOTOR_TEST: self._motor_test,
            SET_MISSION_CURRENT: self._set_current,
            REBOOT: self._reboot,
            MISSION_START: lambda c: self._start_mission(max(0, int(c.get(1)))),
            ARM: self._arm,
            DOCK: lambda c: self._dock(c, Action.DOCK),
            UNDOCK: lambda c: self._dock(c, Action.UNDOCK),
            ESTOP: self._estop,
            CLEAR_ESTOP: self._clear_estop,
            **messages.table(),
        }

    def handlers(self) -> dict[str, Handler]:
        """Handlers by message name."""
        return {"COMMAND_LONG": self._long, "COMMAND_INT": self._int, "SET_MODE": self._set_mode_message}

    def hear(self, event: Event) -> None:
        """Takes an event of the tick. A refusal applies to one pending command of that action: the first not yet done, else the newest."""
        text = event.text.removeprefix("FORCED_")
        asked = [pending for pending in self._pending if text.startswith(f"{pending.action.name} refused")]
        if asked:
            self._finish(next((pending for pending in asked if not pending.is_done()), asked[-1]), DENIED)

    def step(self, time_ns: int) -> None:
        """Answers pending commands that are done or timed out, also when the body is gone."""
        for pending in list(self._pending):
            if pending.is_done():
                self._finish(pending, ACCEPTED)
            elif time_ns > pending.deadline_ns:
                self._finish(pending, FAILED)

    def _finish(self, pending: Pending, result: int) -> None:
        self._pending.remove(pending)
        self._acknowledge(pending.command, result)

    def _long(self, arrival: Arrival) -> None:
        """Takes a COMMAND_LONG. A place must come as COMMAND_INT: float32 resolves it only to a metre or two, and a frame is missing."""
        m = arrival.message
        command = Command(m["command"], tuple(m[f"param{i}"] for i in range(1, 8)), arrival)
        if command.number == REPOSITION:
            self._acknowledge(command, COMMAND_INT_ONLY)
        else:
            self._run(command)

    def _int(self, arrival: Arrival) -> None:
        """Takes a COMMAND_INT. Only a place is in 1e-7 deg and has a frame; otherwise x and y are parameters 5 and 6, or left out."""
        m = arrival.message
        plain = (*(math.nan if m[name] == _LEFT_OUT else m[name] for name in ("x", "y")), m["z"])
        last = self._place(m) if m["command"] == REPOSITION else plain
        self._run(Command(m["command"], (*(m[f"param{i}"] for i in range(1, 5)), *last), arrival))

    def _place(self, m: Message) -> tuple[float, float, float]:
        """Returns latitude and longitude, deg, and altitude above sea level, m; NaN if the message has no valid place."""
        known = m["frame"] in (*ABSOLUTE, *RELATIVE) and abs(m["x"]) <= 900_000_000 and abs(m["y"]) <= 1_800_000_000
        above_m = self._system.subject.origin.altitude_m if m["frame"] in RELATIVE else 0.0
        return (m["x"] * 1e-7, m["y"] * 1e-7, m["z"] + above_m) if known else (math.nan,) * 3

    def _run(self, command: Command) -> None:
        handler = self._table.get(command.number)
        if not self._system.body_is_known and not _stops(command):
            answer: Answer = self._refuse(command)
        elif missing := [n for n in range(1, _NEEDED.get(command.number, 0) + 1) if not math.isfinite(command.parameters[n - 1])]:
            answer = self._accept_or_refuse(f"its parameter {missing[0]} is no number", f"command {command.number}", DENIED)
        else:
            answer = UNSUPPORTED if handler is None else handler(command)
        if answer is not None:
            self._acknowledge(command, answer)

    def _refuse(self, command: Command) -> Answer:
        """Refuses a command whose body is gone."""
        self._system.refuse(command.arrival.time_ns)
        return TEMPORARILY_REJECTED

    def _acknowledge(self, command: Command, result: int) -> None:
        values = {"command": command.number, "result": result, **command.arrival.sender}
        self._system.send(command.arrival.channel, "COMMAND_ACK", values)

    def _ask(self, command: Command, action: Action, argument: Any, is_done: Callable[[], bool]) -> Answer:
        self._system.ask(action, argument)
        self._pending.append(Pending(command, action, is_done, command.arrival.time_ns + DECISION_NS))
        return None

    def _accept_or_refuse(self, reason: str, what: str, refusal: int) -> Answer:
        """Returns ACCEPTED if `reason` is empty; otherwise reports the reason and returns `refusal`."""
        if reason:
            self._system.say(WARNING, f"{what} refused: {reason}")
        return refusal if reason else ACCEPTED

    # ------------------------------------------------------------ arming and modes

    def _arm(self, command: Command) -> Answer:
        subject = self._system.subject
        forced = int(command.get(2)) in _FORCED
        if command.get(1) not in (0.0, 1.0):
            return self._deny_switch(command)
        if command.get(1) == 0.0:
            return self._ask(command, Action.DISARM, forced, lambda: not subject.picture.is_armed(subject.leader))
        return self._ask(command, Action.ARM, forced, lambda: subject.armed)

    def _set_mode(self, command: Command) -> Answer:
        identity = self._system.subject.identity
        mode = identity.mode_of_command(command.parameters[1], command.parameters[2]) if _has_custom_mode(command) else None
        number = None
        if mode is not None and identity.pairs:
            number = int(command.parameters[1]) << 16 | int(command.get(3)) << 24
        return self._enter(command, mode, number)

    def _set_mode_message(self, arrival: Arrival) -> None:
        """Takes the old SET_MODE message, which has no acknowledgement of its own."""
        custom = arrival.message["custom_mode"]
        command = Command(SET_MODE, (arrival.message["base_mode"], *[math.nan] * 6), arrival)
        mode = self._system.subject.identity.mode(custom) if _has_custom_mode(command) else None
        answer = self._enter(command, mode, custom) if self._system.body_is_known else self._refuse(command)
        if answer is not None:
            self._acknowledge(command, answer)

    def _enter(self, command: Command, mode: Mode | None, number: int | None = None) -> Answer:
        if mode is None or mode not in SETTABLE:
            return UNSUPPORTED
        if mode == Mode.AUTO:
            return self._start_mission(None)
        if mode == Mode.GUIDED and not self._steering.has_setpoint(command.arrival.time_ns):
            self._system.say(WARNING, "SET_MODE refused: set-points must stream before guided mode")
            return TEMPORARILY_REJECTED
        subject = self._system.subject
        subject.mode_number = number
        return self._ask(command, Action.SET_MODE, mode, lambda: subject.picture.mode(subject.body) == mode)

    # ------------------------------------------------------------ missions

    def _start_mission(self, first: int | None) -> Answer:
        return self._accept_or_refuse(self._missions.start(first), "mission", TEMPORARILY_REJECTED)

    def _pause(self, command: Command) -> Answer:
        if command.get(1) >= 0.5:
            return self._start_mission(None)
        return self._enter(command, Mode.POSHOLD)

    def _set_current(self, command: Command) -> Answer:
        return self._accept_or_refuse(self._missions.jump(int(command.get(1))), "mission", DENIED)

    def _change_speed(self, command: Command) -> Answer:
        if command.get(1) in ONE_WAY_SPEEDS:
            return self._accept_or_refuse("there is none of climbing or descending alone", "speed", DENIED)
        return self._accept_or_refuse(self._missions.set_speed(command.get(2)), "speed", DENIED)

    def _reposition(self, command: Command) -> Answer:
        latitude, longitude, altitude = command.parameters[4:7]
        if not all(map(math.isfinite, (latitude, longitude, altitude))):
            return self._accept_or_refuse("it names no place on the earth", "reposition", DENIED)
        if self._system.is_ambiguous_broadcast(command.arrival):
            return self._accept_or_refuse("it is for all, and there are several bodies", "reposition", DENIED)
        yaw = command.parameters[3] if self._system.subject.identity.waypoints_turn else math.nan
        reason = self._missions.go_to(latitude, longitude, altitude, yaw, command.get(1))
        return self._accept_or_refuse(reason, "reposition", TEMPORARILY_REJECTED)

    # ------------------------------------------------------------ safety, docking, thrusters

    def _estop(self, command: Command) -> Answer:
        s = self._system.subject
        return self._ask(command, Action.ESTOP, None, lambda: s.picture.is_stopped(s.leader))

    def _clear_estop(self, command: Command) -> Answer:
        s = self._system.subject
        return self._ask(command, Action.CLEAR_ESTOP, None, lambda: not s.picture.is_stopped(s.body))

    def _terminate(self, command: Command) -> Answer:
        if command.get(1) >= 0.5:
            return self._estop(command)
        return self._clear_estop(command) if command.get(1) == 0.0 else self._deny_switch(command)

    def _deny_switch(self, command: Command) -> Answer:
        """Denies a command that is neither on nor off: whoever sent it may mean either."""
        return self._accept_or_refuse(f"its parameter 1 is {command.get(1):g}; it needs 0 or 1", f"command {command.number}", DENIED)

    def _reboot(self, command: Command) -> Answer:
        if int(command.get(1)) not in (1, 3):
            return UNSUPPORTED
        picture = self._system.subject.picture  # of the whole fleet, which one process controls
        reason = "a body is armed" if picture.any_armed else "the e-stop is not cleared" if picture.any_stopped else ""
        self.reboot_asked = self.reboot_asked or not reason
        return self._accept_or_refuse(reason, "reboot", DENIED)

    def _dock(self, command: Command, action: Action) -> Answer:
        number, face, target_number, target_face, turns = (int(command.get(i)) for i in range(1, 6))
        last = len(self._system.subject.picture.modules)
        reason = _outside(
            ("module", number, 1, last), ("face", face, 0, FACES - 1), ("target module", target_number, 1, last),
            ("target face", target_face, 0, FACES - 1), ("quarter turns", turns, 0, QUARTERS - 1),
        )  # fmt: skip
        if reason or number == target_number:
            return self._accept_or_refuse(reason or f"module {number} and itself", action.name.lower(), DENIED)
        module, target = module_index(number), module_index(target_number)
        request = DockRequest(module, face, target, target_face, turns, command.get(6) >= 0.5)
        s = self._system.subject
        parts = action == Action.UNDOCK and s.picture.leader(module) == s.picture.leader(target)

        def is_done() -> bool:
            """Whether DOCK mode is entered, or the modules have come apart: a disarmed body undocks without that mode."""
            return s.picture.mode(s.body) == Mode.DOCK or (parts and s.picture.leader(module) != s.picture.leader(target))

        return self._ask(command, action, request, is_done)

    def _motor_test(self, command: Command) -> Answer:
        """Takes motor, throttle type (0: %, 1: PWM), throttle, seconds. First motor number and resting % depend on the identity."""
        s, identity = self._system.subject, self._system.subject.identity
        motor, kind, throttle = int(command.get(1)), int(command.get(2)), command.get(3)
        low, high = _PWM if kind == 1 else (2 * identity.rest_percent - 100, 100)
        first, last = identity.first_motor, identity.first_motor + CHANNELS * len(s.modules) - 1
        reason = _outside(("motor", motor, first, last), ("throttle type", kind, 0, 1), ("throttle", throttle, low, high))
        if reason:
            return self._accept_or_refuse(reason, "motor test", DENIED)
        thruster, share = motor - first, (2 * throttle - low - high) / (high - low)
        seconds = min(max(command.get(4, 1.0), 0.0), 10.0)
        is_turning = lambda: s.picture.mode(s.body) == Mode.MOTOR_DETECT and s.armed  # noqa: E731
        return self._ask(command, Action.MOTOR_TEST, (thruster, share, seconds), is_turning)


def _has_custom_mode(command: Command) -> bool:
    """Whether the custom mode counts: without CUSTOM_MODE_ENABLED it must be ignored, and flags alone select no mode here."""
    return bool(int(command.get(1)) & CUSTOM_MODE_ENABLED)


def _outside(*wanted: tuple[str, float, float, float]) -> str:
    """Describes the first value outside its range; empty if none is. Each entry: name, value, lowest and highest allowed value."""
    return next((f"{name} {value:g}; it needs {low:g} to {high:g}" for name, value, low, high in wanted if not low <= value <= high), "")


def _stops(command: Command) -> bool:
    """Whether a command is an e-stop, termination or disarm, which are accepted whoever leads the body."""
    raised = command.get(1) >= 0.5
    return command.number == ESTOP or (command.number, raised) in ((TERMINATE, True), (ARM, False))
