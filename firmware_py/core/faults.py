"""Detection of dead and lying thrusters: from ESC reports, from missing motion, and from modules that fall silent or obey no commands. Runs
between estimator and supervisor.

A thruster that was found faulty stays excluded until the body is disarmed, unless leaving it out shows that something else pushes
(`thruster_trial`), or it was its ESC that failed and is well again, as after a sag of the supply. Those of a module that is silent, or
obeys no commands, stay excluded until it has been well for as long (`SILENT_NS`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.command_watch import CommandWatch
from firmware_py.core.esc_feedback import ESC_DOWN, ESC_FAILED, FAST_MARGIN, FAST_SHARE, WHY, WRONG_SPEED, believed_rpm, count_feedback
from firmware_py.core.missing_thrust import MissingThrust
from firmware_py.core.names import name_modules, name_thruster, places_of
from firmware_py.core.thruster import polynomial
from firmware_py.core.thruster_state import ThrusterFaults, steered_rank, thruster_state
from firmware_py.core.topology import in_both
from firmware_py.core.types import EscFeedback, Estimate, Measured, ModuleInputs
from firmware_py.description.failsafe_parameters import Faults

NEITHER = (-1, -1)
"""Thruster indices for a feedback of ESCs that the vehicle does not have."""
STANDSTILL = 1.45
"""Multiple of the deadband in the vehicle file up to which a healthy propeller may stand still; deadbands differ from thruster to thruster,
on the bench from 0.10 to 0.25 N where the file says 0.17."""
SILENT_NS = 500_000_000
"""Silence, or deafness, after which a module's thrusters are excluded, if the others can make every wrench without them; the fail-safe
`module_silent` acts then too. A silent module that hears nothing either has stopped its thrusters after 100 ms (can_dbc/README.md); one
that still hears stops them because of the exclusion. Those of a deaf module are excluded even if the others cannot."""
WELL_AGAIN = 10
"""Feedbacks in a row without a fault, one second's, after which a thruster whose ESC had failed is used again."""
REPORT_NS = 75_000_000
"""Least time between two feedbacks of an ESC that are judged: three quarters of their period (can_dbc/modcube.dbc). Of ESCs that are heard
in every tick, the counts in a row would end within 30 ms, in which a healthy propeller may just be about to start or to reverse."""
BELIEVED_NS = 500_000_000
"""How long believed forces are kept: the feedback of a module whose answers come late is compared with those of its own time. Against the
present ones, propellers that reverse seemed to disobey where frames were 30 ms late each way."""


def by_channel(body: Body) -> list[dict[int, int]]:
    """Maps, per module, the number of a thruster in the module to its index in the body."""
    t = body.thrusters
    found: list[dict[int, int]] = [{} for _ in body.modules]
    for i, (module, channel) in enumerate(zip(t.module.tolist(), t.channel.tolist(), strict=True)):
        found[module][channel] = i
    return found


class FaultDetector:
    """Watches the thrusters of one body."""

    def __init__(self, body: Body, parameters: Faults, period_ns: int) -> None:
        t = body.thrusters
        self._t = t
        self._body, self._rank = body, steered_rank(t.matrix, body.passive)
        self._thruster_at = by_channel(body)
        self._pair_at = [{c: (at.get(c, -1), at.get(c + 1, -1)) for c in range(max(at) + 1)} for at in self._thruster_at]
        """Per module and first channel of an ESC feedback: the indices of its two thrusters, -1 where there is none."""
        self._modules = body.modules
        self._names = tuple(map(name_thruster, places_of(body)))
        self._full_n = np.array([(polynomial(f, 1.0), polynomial(r, 1.0)) for f, r in zip(t.forward, t.reverse, strict=True)])
        """(n, 2) forces at full speed forward and in reverse, N."""
        self._motion = MissingThrust(body, parameters, period_ns)
        self.retune(parameters)
        n = t.f_max.size
        self._obeys = np.ones(n, dtype=bool)
        """Thrusters without a fault of their own."""
        self._silent_after = max(1, SILENT_NS // period_ns)
        self._silence = [0] * len(body.modules)
        """Ticks that each module has been silent or deaf; counts down again while an excluded module is heard."""
        self._silent: list[int] = []
        """Modules, by place in the body, whose thrusters are left out because they are silent or hear no commands."""
        self._deaf: list[int] = []
        """Those of them that have said since that they hear no commands: their thrusters stand still."""
        self._watches = [CommandWatch(period_ns) for _ in body.modules]
        self._stopped: list[int] = []
        """Thrusters that may stand still because their module obeys no commands, or did not until just now."""
        self._ticks, self._report_ticks = 0, -(-REPORT_NS // period_ns)
        self._next_report: dict[tuple[int, int], int] = {}
        """From which tick on the next feedback is judged, by module's place in the body and first channel."""
        self._well: dict[int, int] = {}
        """Feedbacks in a row without a fault of each thruster that is left out because its ESC had failed."""
        self._believed: deque[np.ndarray] = deque(maxlen=max(1, BELIEVED_NS // period_ns))
        """Believed forces (n,) of the latest ticks, N."""
        self._late_ticks = [0] * len(body.modules)
        """How late each module's latest answer was."""
        self._counts = np.zeros((n, len(WHY)), dtype=np.int64)
        """(n, 3) feedbacks in a row that showed ESC_FAILED, STALLED and WRONG_SPEED."""
        self._feedback_means, self._reported_share = np.zeros((n, 2)), np.ones(n)
        """Running means, and the share of the believed force that they show: `means` and `share` of `count_feedback`."""
        self.words: list[str] = []
        """Messages of this tick, for people."""
        self.changed = False
        """Whether `now` changed in this tick."""
        self.now = self._state_of(self._obeys)

    def retune(self, parameters: Faults) -> None:
        """Applies new limits from this tick on; known faults stay."""
        self._limits = np.maximum(parameters.force_n, STANDSTILL * self._t.deadband_n), parameters.dead_share
        self._needed = np.array([parameters.dead_count, parameters.dead_count, parameters.stray_count])
        self._motion.parameters = parameters

    def take_over(self, before: Sequence[FaultDetector]) -> None:
        """Inherits from the bodies that this one is made of, or was part of: excluded thrusters stay excluded."""
        for other in before:
            for i, j in in_both(self._modules, other._modules):
                self._silence[i] = other._silence[j]
                self._watches[i] = other._watches[j]
                self._silent += [i] if j in other._silent else []
                self._deaf += [i] if j in other._deaf else []
                for channel, thruster in self._thruster_at[i].items():
                    number = other._thruster_at[j][channel]
                    self._obeys[thruster] = other._obeys[number]
                    self._well |= {thruster: other._well[number]} if number in other._well else {}
                    self._motion.inherit(thruster, other._motion, number)
        self._motion.take_over([other._motion for other in before])
        self.now = self._usable_state()

    def reset(self) -> None:
        """Trusts all thrusters again."""
        self._counts[:] = 0
        self._motion.reset()
        self.changed = not self.now.alive.all()
        self._obeys[:], self._silent, self._deaf, self._well = True, [], [], {}
        self.now = self._state_of(self._obeys)

    def step(
        self,
        modules: list[ModuleInputs],
        measured: Measured,
        estimate: Estimate,
        force_n: np.ndarray,
        mean_n: np.ndarray,
        armed: bool,
        free: bool,
    ) -> ThrusterFaults:
        """Returns the fault state after this tick.

        Args:
            modules: inputs of the whole fleet, by fleet index.
            measured, estimate: measurements and estimate of this tick.
            force_n, mean_n: (n,) believed forces of the thrusters now, and their mean since the last tick, N.
            armed: while disarmed, only propellers that turn although they should not are looked for.
            free: no magnet pulls at another body or pushes anything away; while one does, the motion says nothing about thrusters.
        """
        self.words, self.changed = [], False
        own = [modules[m] for m in self._modules]
        for i, module in enumerate(own):
            self._watches[i].step(module)
            self._late_ticks[i] = self._late_ticks[i] if module.mcu_state is None else module.late_ticks
        self._believed.append(force_n)
        self._stopped = [i for watch, at in zip(self._watches, self._thruster_at, strict=True) if watch.stopped for i in at.values()]
        free = free and not any(self.now.alive[i] for i in self._stopped)
        found = self._motion.step(measured, estimate, mean_n * self._reported_share, self.now.alive, armed, free)
        if found is not None:
            self._lose(found, "does not push as it says")
        elif self._motion.acquitted is not None:
            self._use_again(self._motion.acquitted, "the robot is pushed as much without it")
        (self._judge_feedback if armed else self._judge_at_rest)(self._feedbacks(own), self._believed_at_answers())
        self._judge_silence(own, armed)
        return self.now

    def _feedbacks(self, modules: list[ModuleInputs]) -> list[list[EscFeedback]]:
        """Returns the feedbacks to judge in this tick, by module: of each pair of ESCs the newest, and none too soon after its last."""
        self._ticks += 1
        due: list[list[EscFeedback]] = [[] for _ in modules]
        for i, module in enumerate(modules):
            for esc in reversed(module.esc):
                if self._next_report.get((i, esc.first), 0) <= self._ticks:
                    self._next_report[i, esc.first] = self._ticks + self._report_ticks
                    due[i].append(esc)
        return due

    def _believed_at_answers(self) -> np.ndarray:
        """Returns the believed forces (n,) at the time of each module's latest answer, N; the present ones where that is not kept."""
        force_n = self._believed[-1]
        if not any(self._late_ticks):
            return force_n
        for i, late_ticks in enumerate(self._late_ticks):
            if 0 < late_ticks < len(self._believed):
                force_n = np.where(self._t.module == i, self._believed[-1 - late_ticks], force_n)
        return force_n

    def _judge_silence(self, modules: list[ModuleInputs], armed: bool) -> None:
        """Excludes the thrusters of modules that have fallen silent or deaf; re-admits them once a module has been well for as long."""
        before, deaf_before = self._silent, self._deaf
        for i, module in enumerate(modules):
            if not module.heard or self._watches[i].deaf:
                self._silence[i] = min(self._silence[i] + 1, self._silent_after)
            elif self._silence[i]:
                self._silence[i] = self._silence[i] - 1 if i in before else 0
        quiet = [i for i, ticks in enumerate(self._silence) if ticks == self._silent_after or (ticks and i in before)]
        self._silent = quiet if armed else []
        self._deaf = [i for i in self._silent if self._watches[i].deaf or i in deaf_before]
        if (self._silent, self._deaf) == (before, deaf_before):
            return
        deaf = [self._modules[i] for i in self._deaf if i not in deaf_before]
        self.words += [f"{name_modules(deaf)} obeys no commands: its thrusters stop"] if deaf else []
        alive, self.now = self.now.alive, self._usable_state()
        if not np.array_equal(alive, self.now.alive):
            self.changed = True
            self._motion.forget()
            used = [self._modules[i] for i in self._silent if self.now.alive[self._t.module == i].any()]
            left_out = [self._modules[i] for i in self._silent if self._modules[i] not in used]
            if left_out:
                self.words.append(f"thrusters of silent {name_modules(left_out)} are left out")
            if used:
                self.words.append(f"thrusters of silent {name_modules(used)} are used blindly: the others cannot make every wrench")
            if not self._silent:
                self.words.append("thrusters of every module are used again")

    def _state_of(self, usable: np.ndarray) -> ThrusterFaults:
        return thruster_state(self._body, usable, self._rank)

    def _usable_state(self) -> ThrusterFaults:
        """Returns the fault state: all thrusters that obey, without those of silent modules where the others have the same rank. Those of
        modules that hear no commands stand still for certain: they are used only where no others are left.
        """
        obeying = self._state_of(self._obeys)
        if not self._silent:
            return obeying
        without = self._state_of(self._obeys & ~np.isin(self._t.module, self._silent))
        if without.lost_axes != obeying.lost_axes:
            turning = self._obeys & ~np.isin(self._t.module, self._deaf)
            without = self._state_of(turning if turning.any() else self._obeys)
        return without._replace(dead=obeying.dead)

    def _judge_feedback(self, feedbacks: list[list[EscFeedback]], force_n: np.ndarray) -> None:
        """Compares every ESC's feedback with the believed force of its thruster."""
        numbers: list[float] = []
        for escs, pair_at in zip(feedbacks, self._pair_at, strict=True):
            for esc in escs:
                numbers += pair_at.get(esc.first, NEITHER)
                numbers += esc.rpm
                numbers += esc.status
        if not numbers:
            return
        feedback = np.array(numbers, dtype=np.float64).reshape(-1, 3, 2)
        full, limits = (self._full_n, self._t.rpm_at_full), (*self._limits, self._needed)
        state = (self._counts, self._feedback_means, self._reported_share)
        found = count_feedback(feedback, force_n, self.now.alive, *full, *limits, *state)
        self._counts[self._stopped] = 0
        if found:
            for i, kind in np.argwhere(self._counts >= self._needed).tolist():
                if self.now.alive[i]:
                    self._lose(i, WHY[kind])
                    self._well |= {i: 0} if kind == ESC_FAILED else {}
        if self._well:
            self._hear_from_failed(feedback)

    def _hear_from_failed(self, feedback: np.ndarray) -> None:
        """Uses a thruster again whose ESC had failed and is well again: a supply that sags for a moment takes all ESCs of a module with it.

        Args:
            feedback: (k, 3, 2) as for `count_feedback`.
        """
        for i, _, status in feedback.transpose(0, 2, 1).reshape(-1, 3).astype(int).tolist():
            if i in self._well:
                self._well[i] = 0 if status in ESC_DOWN else self._well[i] + 1
                if self._well[i] >= WELL_AGAIN:
                    del self._well[i]
                    self._use_again(i, "its ESC is well again")

    def _judge_at_rest(self, feedbacks: list[list[EscFeedback]], force_n: np.ndarray) -> None:
        """Warns of a propeller that turns while disarmed: somebody may be about to reach for it."""
        for escs, thruster_at in zip(feedbacks, self._thruster_at, strict=True):
            for esc in escs:
                for channel, rpm in enumerate(esc.rpm, esc.first):
                    if channel in thruster_at:
                        self._watch_at_rest(thruster_at[channel], rpm, force_n)

    def _watch_at_rest(self, i: int, rpm: float, force_n: np.ndarray) -> None:
        """Judges one feedback while disarmed. The limit follows the believed force, as a propeller runs down after a flight."""
        most = FAST_SHARE * abs(self.believed_rpm(i, force_n[i])) + FAST_MARGIN * self._t.rpm_at_full[i]
        self._counts[i, WRONG_SPEED] = self._counts[i, WRONG_SPEED] + 1 if abs(rpm) > most else 0
        if self._counts[i, WRONG_SPEED] == self._needed[WRONG_SPEED]:
            self.words.append(f"{self._names[i]} turns though it was told to stand still")

    def believed_rpm(self, i: int, force_n: float) -> float:
        """Returns the speed of thruster `i` at a force, 1/min."""
        return float(believed_rpm(force_n, self._full_n[i], self._t.rpm_at_full[i]))

    def _lose(self, i: int, why: str) -> None:
        self._obeys[i] = False
        self.now, self.changed = self._usable_state(), True
        self._motion.forget()
        self.words.append(f"{self._names[i]} {why}: left out")

    def _use_again(self, i: int, why: str) -> None:
        self._obeys[i], self._counts[i] = True, 0
        self.now, self.changed = self._usable_state(), True
        self._motion.forget()
        self.words.append(f"{self._names[i]} is used again: {why}")
