"""Robots with a random operator, and robots broken so that each rule is violated."""

import numpy as np
import pytest

import hil.random_operator
from firmware_py.core import transitions
from firmware_py.core.guidance_modes import Guidance
from firmware_py.core.limiter import Limiter
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.transitions import Effect, Guard, State, Transition, Trigger
from firmware_py.core.types import Action
from hil.random_operator import RULES, fly_with_random_operator

Patch = pytest.MonkeyPatch


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 5])  # one in each scenario
def test_no_rule_is_broken_whatever_is_asked(seed: int) -> None:
    operated = fly_with_random_operator(seed, 20.0)
    assert not operated.broken
    assert sum(operated.modes.values()) > 0.2 * operated.ticks, "who is never armed shows nothing"
    assert len(operated.modes) >= 4


def stop_is_left(patch: Patch) -> None:
    row = Transition(State.ESTOP, Trigger.STICKS, Guard.ALWAYS, Effect.NOTHING, State.DISARMED)
    patch.setitem(transitions.ROWS, (State.ESTOP, Trigger.STICKS), row)


def sticks_arm(patch: Patch) -> None:
    row = Transition(State.DISARMED, Trigger.STICKS, Guard.FORCED_CHECKS, Effect.ENTER_MODE, State.ARMED)
    patch.setitem(transitions.ROWS, (State.DISARMED, Trigger.STICKS), row)


def limiter_turns_the_disarmed(patch: Patch) -> None:
    step = Limiter.step
    patch.setattr(Limiter, "step", lambda self, wanted_n, armed, *more: step(self, np.ones_like(wanted_n), True, *more))


def limiter_doubles(patch: Patch) -> None:
    step = Limiter.step

    def doubled(self: Limiter, *arguments: object) -> tuple[np.ndarray, np.ndarray]:
        force_n, commands = step(self, *arguments)  # type: ignore[arg-type]
        return force_n, 1e6 * commands

    patch.setattr(Limiter, "step", doubled)


def body_is_there_twice(patch: Patch) -> None:
    patch.setattr(Pipeline, "bodies", property(lambda self: 2 * self.formation.bodies))


def wrench_is_no_number(patch: Patch) -> None:
    patch.setattr(Guidance, "mix", lambda *_: np.full(6, np.nan))


BREAKS = {
    "flown by one body": body_is_there_twice,
    "signals are numbers": wrench_is_no_number,
    "an e-stop stands until it is cleared": stop_is_left,
    "nobody arms unasked": sticks_arm,
    "who is not armed turns nothing": limiter_turns_the_disarmed,
    "commands are shares": limiter_doubles,
}


@pytest.mark.slow
@pytest.mark.parametrize("rule", RULES)
def test_robot_that_is_broken_on_purpose_breaks_the_rule(rule: str, monkeypatch: Patch) -> None:
    monkeypatch.setattr(hil.random_operator, "SCENARIOS", ("hover",))
    monkeypatch.setattr(hil.random_operator, "WEIGHTS", {Action.ARM: 0.5, Action.DISARM: 0.2, Action.ESTOP: 0.1, Action.CLEAR_ESTOP: 0.2})
    BREAKS[rule](monkeypatch)
    assert fly_with_random_operator(4, 15.0).broken[rule] > 0
