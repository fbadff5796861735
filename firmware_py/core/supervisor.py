"""Stage 3 of a tick: runs the transition table of `transitions` for one body and says in words why it refuses."""

from __future__ import annotations

import numpy as np

from firmware_py.core.transitions import ARMED, ROWS, Guard, State
from firmware_py.core.types import Action, Estimate, Event, Inputs, Request
from firmware_py.description.parameters import Supervision

WARNING, INFORMATION = 4, 6


class Supervisor:
    """State of one body. Refusals and changes leave as events."""

    def __init__(self, modules: tuple[int, ...], parameters: Supervision) -> None:
        self._modules = modules
        self._p = parameters
        self.state = State.DISARMED
        self.events: list[Event] = []

    @property
    def armed(self) -> bool:
        """Whether thrusters may turn."""
        return self.state in ARMED

    def step(self, inputs: Inputs, estimate: Estimate, requests: list[Request]) -> list[Request]:
        """Runs this tick's triggers; returns the requests that were granted, in order."""
        self.events = []
        if inputs.estop and self.state != State.ESTOP:
            self._try(Request(Action.ESTOP), inputs, estimate)
        return [r for r in requests if self._try(r, inputs, estimate)]

    def _try(self, request: Request, inputs: Inputs, estimate: Estimate) -> bool:
        row = ROWS.get((self.state, request.action))
        if row is None:
            self._say(WARNING, f"{request.action.name} refused: not possible in {self.state.name}")
            return False
        reasons = self._reasons(row.guard, inputs, estimate)
        if reasons:
            self._say(WARNING, f"{request.action.name} refused: {'; '.join(reasons)}")
            return False
        if row.next_state != self.state:
            self._say(INFORMATION, f"{self.state.name} -> {row.next_state.name}")
        self.state = row.next_state
        return True

    def _reasons(self, guard: Guard, inputs: Inputs, estimate: Estimate) -> list[str]:
        """Why `guard` does not hold, in words; empty when it does."""
        if guard == Guard.MAY_ARM:
            return self._against_arming(inputs, estimate)
        if guard == Guard.ESTOP_CLEAR and inputs.estop:
            return ["the e-stop is still raised"]
        return []

    def _against_arming(self, inputs: Inputs, estimate: Estimate) -> list[str]:
        reasons = []
        if not estimate.ready:
            reasons.append("no pose yet")
        elif estimate.tag_age_ns > self._p.tag_fresh_ms * 1e6:
            reasons.append(f"pose is {estimate.tag_age_ns / 1e6:.0f} ms old, {self._p.tag_fresh_ms:.0f} permitted")
        elif float(np.max(estimate.sigma_p)) > self._p.arm_sigma_m:
            reasons.append(f"pose sigma {np.max(estimate.sigma_p) * 1e3:.0f} mm, {self._p.arm_sigma_m * 1e3:.0f} permitted")
        silent = [str(m) for m in self._modules if not inputs.modules[m].answered]
        if silent:
            reasons.append(f"module {', '.join(silent)} does not answer")
        if inputs.estop:
            reasons.append("e-stop raised")
        return reasons

    def _say(self, severity: int, text: str) -> None:
        self.events.append(Event(severity, text))
