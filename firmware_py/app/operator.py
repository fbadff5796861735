"""Stands in for a person at the vehicle: arms after a start, disarms before the end, and yields to ground stations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from firmware_py.app.last_flight import RECENT_NS
from firmware_py.core.body import Body
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, Outputs, Request
from firmware_py.runtime.teller import write_line

if TYPE_CHECKING:
    from firmware_py.app.ground_station import GroundSide

FAREWELL_TICKS = 10
"""Ticks that still command `disarmed` after a stop was requested."""
ARM_EVERY_S = 1.0
"""Interval between attempts of the Operator to arm, once the pose is known."""
STOP_ACTIONS = frozenset({Action.DISARM, Action.ESTOP})
"""Requests of a person after which only a person arms any body."""
TAKEOVER_ACTIONS = frozenset({Action.SET_MODE, Action.ARM, Action.MOTOR_TEST})
"""Requests of a person after which only a person arms the body concerned."""
REARM_S = RECENT_NS / 1e9
"""How long REARM keeps trying. After that the previous flight no longer tells where the vehicle is, as with a log of that age."""


@dataclass(slots=True)
class Operator:
    """Stands in for a person: arms each body in `to_arm` once, to hold its place, and disarms all when the process is asked to stop."""

    rate_hz: int
    to_arm: set[int] = field(default_factory=set)
    """Fleet indices of modules that are still to be armed. A body is armed if its leader is among them; a module is removed as soon as it
    is armed, by whatever request."""
    limit_s: float = math.inf
    """Time, counted in ticks, after which `to_arm` expires."""
    say: Callable[[str], None] = write_line
    stopping: bool = False
    farewell: int = 0
    _ticks: int = 0
    _next_try: int = 0

    def requests(self, time_ns: int, last: Outputs | None) -> list[Request]:
        """The requests of this tick."""
        self._ticks += 1
        if self.stopping:
            self.farewell += 1  # every body is disarmed in each of these ticks, because a body may be new since the last
            return [Request(Action.DISARM, record.body) for record in last.records] if last is not None else []
        if not self.to_arm or last is None:
            return []
        self._strike_out(last)
        self._expire()
        placed = [record.body for record in last.records if record.body in self.to_arm and record.estimate.placed]
        if not placed or self._ticks < self._next_try:
            return []
        self._next_try = self._ticks + round(ARM_EVERY_S * self.rate_hz)
        return [Request(Action.ARM, body) for body in placed]

    def _strike_out(self, last: Outputs) -> None:
        """Removes modules that have been armed, and after an e-stop all: from then on only a person arms them."""
        self.to_arm.difference_update(index for index, command in enumerate(last.modules) if command.armed)
        if any(record.state == State.ESTOP for record in last.records):
            self.to_arm.clear()

    def _expire(self) -> None:
        """Gives up arming after `limit_s`: by then the vehicle may be in somebody's hands."""
        if self.to_arm and self._ticks >= self.limit_s * self.rate_hz:
            self.to_arm.clear()
            self.say(f"not armed again: the vehicle could not within {self.limit_s:g} s (REARM)")

    def stop(self, *_: object) -> None:
        """Signal handler: starts the farewell."""
        self.stopping = True

    def is_done(self, tick: int, outputs: Outputs) -> bool:
        """Whether the farewell has lasted FAREWELL_TICKS."""
        return self.farewell >= FAREWELL_TICKS


def with_ground(
    operator: Operator, side: GroundSide, bodies: Callable[[], Sequence[Body]]
) -> Callable[[int, Outputs | None], list[Request]]:
    """The requests of the operator and of ground stations. A requested reboot ends the process, which the service then restarts.

    After a ground station disarms or stops the vehicle, the operator arms nothing any more; a body that a ground station arms, motor-tests
    or gives a mode is left to it. During the farewell only disarm and e-stop requests are accepted.
    """

    def requests(time_ns: int, last: Outputs | None) -> list[Request]:
        if side.reboot_asked:  # never a False stored: a signal meanwhile has asked for the stop
            operator.stop()
        asked = [request for request in side.requests() if request.action in STOP_ACTIONS or not operator.stopping]
        if any(request.action in STOP_ACTIONS for request in asked):
            operator.to_arm.clear()
        taken = {request.body for request in asked if request.action in TAKEOVER_ACTIONS}
        operator.to_arm.difference_update(taken, *(body.modules for body in bodies() if body.index in taken))
        return [*operator.requests(time_ns, last), *asked]

    return requests
