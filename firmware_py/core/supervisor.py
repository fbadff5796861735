"""Stage 4 of a tick: runs the tables of `transitions` and `failsafes` for one body, and reports in words what it does and refuses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from firmware_py.core.arming import Question, against_arming, missing
from firmware_py.core.failsafes import Failsafes, Level
from firmware_py.core.health import Health
from firmware_py.core.joints import modules_of
from firmware_py.core.names import name_modules
from firmware_py.core.transitions import MODES, ROWS, TRIGGERS, Effect, Guard, Need, State, Transition, Trigger
from firmware_py.core.types import CRITICAL, INFORMATION, WARNING, Event, Mode, Request
from firmware_py.description.parameters import Parameters

LADDER = {
    Level.HOLD: (Trigger.FAILSAFE_HOLD, Trigger.FAILSAFE_DEPTH, Trigger.FAILSAFE_SURFACE),
    Level.DEPTH: (Trigger.FAILSAFE_DEPTH, Trigger.FAILSAFE_SURFACE),
    Level.SURFACE: (Trigger.FAILSAFE_SURFACE,),
    Level.DISARM: (Trigger.FAILSAFE_DISARM,),
}
"""Triggers that a fail-safe tries in order until one is possible."""
IGNORED_FAILSAFES: dict[Guard, tuple[str, ...]] = {Guard.MODE_PERMITTED: (), Guard.PARTING_PERMITTED: ("partner_lost",)}
"""Guards that consult the fail-safes, each with the fail-safes that it ignores."""
MODE_LEVEL = {Mode.SURFACE: Level.SURFACE}
"""Level that a mode provides, whoever chose it: a milder fail-safe does not replace it."""


class Decision(NamedTuple):
    """A completed transition: its trigger, what guidance is to do, the mode afterwards, and the request's argument."""

    trigger: Trigger
    effect: Effect
    mode: Mode
    argument: Any = None


class Supervisor:
    """State and mode of one body.

    Attributes:
        state, mode: the present ones. While disarmed, `mode` is the one to arm in.
        level: level of the fail-safe that chose the mode; NONE if a person chose it.
        raises_estop: the e-stop came as a request, so the firmware itself raises ESTOP on the bus.
        events: events of this tick.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._p = parameters
        self._failsafes = Failsafes(parameters.failsafes)
        self.state = State.DISARMED
        self.mode = Mode.POSHOLD
        self.level = Level.NONE
        self._chosen = self.mode
        """The mode that a person chose, before a fail-safe acted."""
        self.raises_estop = False
        self.events: list[Event] = []
        self._estop_ns: int | None = None
        self._was_idle = True
        """Whether the body was disarmed in the previous tick, with no module stopped and no recent e-stop that could still hold one."""
        self._testing = False
        """Whether a motor test armed the body, without the arming checks for flight."""

    @property
    def armed(self) -> bool:
        """Whether thrusters may turn."""
        return self.state == State.ARMED

    @property
    def safety(self) -> Level:
        """Fail-safe level that the present mode provides."""
        return max(self.level, MODE_LEVEL.get(self.mode, Level.NONE))

    def may_arm(self, health: Health) -> bool:
        """Whether ARM would be granted now."""
        return self.state == State.DISARMED and not self._reasons(Guard.ARMING_CHECKS, self.mode, health)

    def is_on(self, failsafe: str) -> bool:
        """Whether the fail-safe of that name is on."""
        return self._failsafes.is_on(failsafe)

    def step(self, estop: bool, health: Health, requests: list[Request], endings: Sequence[Trigger] = ()) -> list[Decision]:
        """Runs this tick's triggers in order: e-stop, activities that ended by themselves, requests, fail-safes.

        Args:
            estop: an ESTOP frame came since the previous tick. A module that reports itself stopped counts as one while the body is armed.
                It also counts if the body was disarmed in the previous tick with no module stopped and no recent e-stop: it was
                never cleared.
            health: health of this tick.
            requests: requests for this body, and e-stops for all bodies.
            endings: TEST_OVER while no motor test runs, DOCK_OVER when a dock has ended; ignored silently where they do not apply.
        """
        self.events = []
        decisions: list[Decision | None] = []
        if estop or (health.stopped and (self.armed or self._was_idle)):  # a module has heard an ESTOP that the firmware has not
            self._estop_ns = health.time_ns
            if not estop:
                self._say(CRITICAL, f"e-stop: {name_modules(health.stopped)} says that it heard one")
            decisions.append(self._try(Trigger.ESTOP_FRAME, None, health))
        decisions += [self._try(trigger, None, health) for trigger in endings if self._applies(trigger, health)]
        decisions += [self._request(request, health) for request in requests]
        decisions.append(self._run_failsafes(health))
        self._was_idle = self.state == State.DISARMED and not health.stopped and not self._estop_is_fresh(health)
        return [decision for decision in decisions if decision is not None]

    def _request(self, request: Request, health: Health) -> Decision | None:
        trigger = TRIGGERS.get(request.action)
        if trigger is None:
            return None
        if trigger == Trigger.ARM and request.argument is True:
            trigger = Trigger.FORCED_ARM
        decision = self._try(trigger, request.argument, health)
        if decision is not None and trigger in (Trigger.ESTOP, Trigger.CLEAR_ESTOP):
            if self.raises_estop or trigger == Trigger.ESTOP:  # the modules hear our ESTOP, until now or from now on
                self._estop_ns = health.time_ns
            self.raises_estop = trigger == Trigger.ESTOP
        return decision

    def _run_failsafes(self, health: Health) -> Decision | None:
        """Reports fail-safes that begin and end, and carries out the action of the gravest one."""
        alarms = self._failsafes.step(health, self.mode, self.level > Level.NONE, self.armed)
        if not alarms:
            return None
        begun = any(alarm.begins and alarm.level > Level.WARN for alarm in alarms)
        level = self._failsafes.level
        acts = self.armed and begun and level > self.safety
        if level <= Level.WARN and self.mode == self._chosen:  # all fail-safes that acted are over, and the mode is the chosen one
            self.level = Level.NONE
        if self.level == Level.NONE:
            self._chosen = self.mode
        for alarm in alarms:
            severity = INFORMATION if not alarm.begins else CRITICAL if alarm.level > Level.HOLD else WARNING
            if acts or not alarm.again:  # a recurring one is reported only when it takes over control
                self._say(severity, f"fail-safe {'on' if alarm.begins else 'over'}: {alarm.words}")
        for trigger in self._ladder(level, health) if acts else ():
            if (decision := self._try(trigger, None, health)) is not None:
                self.level = level
                return decision
        return None

    def _ladder(self, level: Level, health: Health) -> tuple[Trigger, ...]:
        """Triggers to try. In MOTOR_DETECT, a body that a test armed, or that never saw a tag, may lie on a bench: it is disarmed."""
        if self.mode == Mode.MOTOR_DETECT and (self._testing or not health.placed):
            return LADDER[Level.DISARM]
        return LADDER[level]

    def _try(self, trigger: Trigger, argument: Any, health: Health) -> Decision | None:
        """Makes the transition of the table's row, or reports why not."""
        row = ROWS.get((self.state, trigger))
        if row is None:
            self._say(WARNING, f"{trigger.name} refused: not possible in {self.state.name}")
            return None
        mode = row.mode if row.mode is not None else argument if trigger == Trigger.SET_MODE else self._mode_after(row)
        reasons = self._reasons(row.guard, mode, health, argument)
        if reasons:
            self._say(WARNING, f"{trigger.name} refused: {'; '.join(dict.fromkeys(reasons))}")
            return None
        self._make(row, mode)
        return Decision(trigger, row.effect, mode, argument)

    def _mode_after(self, row: Transition) -> Mode:
        """The present mode; POSHOLD if the body stops in a mode that no person chose or may choose: it would next be armed in it."""
        comes_to_rest = self.armed and row.next_state != State.ARMED
        chosen = self.level == Level.NONE and not self._testing and MODES[self.mode].on_request
        return Mode.POSHOLD if comes_to_rest and not chosen else self.mode

    def _make(self, row: Transition, mode: Mode) -> None:
        """Makes a transition that was granted, and reports it."""
        if (row.next_state, mode) != (self.state, self.mode):
            self._say(INFORMATION, f"{self.state.name} {self.mode.name} -> {row.next_state.name} {mode.name}")
        if row.next_state != self.state or row.effect in TAKES_OVER:
            self.level = Level.NONE
        if row.effect == Effect.TEST_MOTOR:
            self._testing = self._testing or not self.armed
        elif row.effect in TAKES_OVER or row.next_state != State.ARMED:
            self._testing = False
        self.state, self.mode = row.next_state, mode

    def _reasons(self, guard: Guard, mode: Mode, health: Health, argument: Any = None) -> list[str]:
        """Reasons, in words, why `guard` does not hold; empty if it does. Guards of an undock need its `argument`."""
        if guard in (Guard.ARMING_CHECKS, Guard.FORCED_CHECKS):
            question = Question(health, mode, self._p, self._failsafes, self._estop_age_ms(health))
            return against_arming(question, guard == Guard.FORCED_CHECKS)
        if guard == Guard.MODE_NEEDS:
            return missing(mode, health, self._p)
        is_parting = guard in (Guard.PARTING_PERMITTED, Guard.JOINT_OPEN)
        joint_holds = is_parting and modules_of(argument) not in map(modules_of, health.open_joints)
        if guard == Guard.JOINT_OPEN:
            return ["the body is disarmed, and the joint is not open"] if joint_holds else []
        if guard in IGNORED_FAILSAFES:
            ignored = IGNORED_FAILSAFES[Guard.MODE_PERMITTED if joint_holds else guard]
            reasons = missing(mode, health, self._p) or self._failsafes.reasons_against(mode, health, ignored)
            if self._testing:  # a test armed the body, so the arming checks for flight have not run yet
                reasons = reasons or self._reasons(Guard.ARMING_CHECKS, mode, health)
            return reasons
        is_met, words = OWN_STATE[guard]
        return [] if is_met(self, health) else [words]

    def _applies(self, trigger: Trigger, health: Health) -> bool:
        """Whether the trigger of an ended activity applies in the present state."""
        row = ROWS.get((self.state, trigger))
        return row is not None and not self._reasons(row.guard, self.mode, health)

    def retune(self, parameters: Parameters) -> None:
        """Changes the limits from this tick on; state and mode stay."""
        self._p = parameters
        self._failsafes.retune(parameters.failsafes)

    def take_over(self, before: Sequence[Supervisor]) -> None:
        """Takes over from the previous bodies (its parts, or the whole): armed if all were, in e-stop if any was.

        Fail-safes that were on stay on. The mode is that of the body under the gravest fail-safe; if there is none, the first of the
        bodies' modes that needs no position; else POSHOLD. A body that a motor test armed counts as disarmed, and its mode is dropped.
        MOTOR_DETECT, in which nothing holds a body, goes on in the parts of one, but not in what is joined.
        """
        flown = [other for other in before if not other._testing]  # a motor test never becomes a flight
        states = {State.DISARMED if other._testing else other.state for other in before}
        self.state = State.ESTOP if State.ESTOP in states else State.DISARMED if State.DISARMED in states else State.ARMED
        worst = max(before, key=lambda other: other.safety)
        dropped = Mode.MOTOR_DETECT if len(before) > 1 else None
        unplaced = [other.mode for other in flown if Need.POSITION not in MODES[other.mode].needs and other.mode != dropped]
        kept = [worst.mode] if worst.safety > Level.NONE else unplaced
        self.mode, self.level, self._chosen = next(iter(kept), Mode.POSHOLD), worst.level, worst._chosen
        self.raises_estop = any(other.raises_estop for other in before)
        self._estop_ns = max((other._estop_ns for other in before if other._estop_ns is not None), default=None)
        self._was_idle = all(other._was_idle for other in before)
        self._failsafes.take_over([other._failsafes for other in before])

    def _estop_age_ms(self, health: Health) -> float:
        return math.inf if self._estop_ns is None else (health.time_ns - self._estop_ns) * 1e-6

    def _estop_is_fresh(self, health: Health) -> bool:
        return self._estop_age_ms(health) < self._p.supervision.estop_quiet_ms

    def _say(self, severity: int, text: str) -> None:
        self.events.append(Event(severity, text))


TAKES_OVER = (Effect.ENTER_MODE, Effect.ENTER_LEVEL, Effect.HOLD_AT, Effect.FOLLOW)
"""Effects that set how the body is steered, by a person's or a fail-safe's choice."""
OWN_STATE: dict[Guard, tuple[Callable[[Supervisor, Health], bool], str]] = {
    Guard.ALWAYS: (lambda supervisor, health: True, ""),
    Guard.ESTOP_QUIET: (lambda supervisor, health: not supervisor._estop_is_fresh(health), "the e-stop is still raised"),
    Guard.IN_MOTOR_DETECT: (lambda supervisor, health: supervisor.mode == Mode.MOTOR_DETECT, "the mode is not MOTOR_DETECT"),
    Guard.IN_DOCK: (lambda supervisor, health: supervisor.mode == Mode.DOCK, "the mode is not DOCK"),
    Guard.TESTING: (lambda supervisor, health: supervisor._testing, "no motor test armed the body"),
}
"""Guards that the supervisor's own state decides: whether each holds, and the reason in words if it does not."""
