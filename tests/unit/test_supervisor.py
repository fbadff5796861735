"""The supervisor: every row of the table, every trigger that has no row, and every refusal in its own words."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from firmware_py.core.supervisor import INFORMATION, WARNING, Supervisor
from firmware_py.core.transitions import ARMED, ROWS, TABLE, Guard, State, Transition
from firmware_py.core.types import Action, Estimate, Inputs, ModuleInputs, Request
from firmware_py.description.parameters import Supervision

MODULES = (0, 2)
ZERO = np.zeros(3)
GOOD = Estimate(
    ZERO, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(6), ZERO, ZERO, np.full(3, 0.002), np.full(3, 0.01),
    20_000_000, math.nan, 0, 0, True,
)  # fmt: skip


def heard(estop: bool = False, silent: tuple[int, ...] = ()) -> Inputs:
    """A tick in which all three modules of the fleet answer but `silent`."""
    modules = [ModuleInputs(answered=index not in silent) for index in range(3)]
    return Inputs(7, 70_000_000, modules, estop=estop)


def in_state(state: State) -> Supervisor:
    supervisor = Supervisor(MODULES, Supervision())
    supervisor.state = state
    return supervisor


def ask(supervisor: Supervisor, action: Action, estimate: Estimate = GOOD, inputs: Inputs | None = None) -> bool:
    """Whether it was granted."""
    request = Request(action)
    return supervisor.step(heard() if inputs is None else inputs, estimate, [request]) == [request]


def refusal(supervisor: Supervisor, action: Action, estimate: Estimate = GOOD, inputs: Inputs | None = None) -> str:
    """The words of the one refusal; the state has to stay."""
    before = supervisor.state
    assert not ask(supervisor, action, estimate, inputs)
    assert supervisor.state == before
    (event,) = supervisor.events
    assert event.severity == WARNING
    return event.text


# ---------------------------------------------------------------- the table


@pytest.mark.parametrize("row", TABLE, ids=lambda row: f"{row.state.name}-{row.trigger.name}")
def test_every_row_leads_where_it_says(row: Transition) -> None:
    supervisor = in_state(row.state)
    assert ask(supervisor, row.trigger)
    assert supervisor.state == row.next_state
    assert supervisor.armed == (row.next_state in ARMED)
    changed = row.next_state != row.state
    words = [f"{row.state.name} -> {row.next_state.name}"] if changed else []
    assert [event.text for event in supervisor.events] == words
    assert all(event.severity == INFORMATION for event in supervisor.events)


NO_ROW = [pair for pair in itertools.product(State, Action) if pair not in ROWS]


@pytest.mark.parametrize(("state", "action"), NO_ROW, ids=lambda value: value.name)
def test_every_trigger_without_a_row_is_refused_in_words(state: State, action: Action) -> None:
    assert refusal(in_state(state), action) == f"{action.name} refused: not possible in {state.name}"


def test_table_has_one_row_for_a_state_and_a_trigger() -> None:
    assert len(ROWS) == len(TABLE)
    assert len(NO_ROW) + len(TABLE) == len(State) * len(Action)


def test_thrusters_turn_only_after_arming() -> None:
    """From no state but an armed one leads a row into an armed one without the arming guard."""
    for row in TABLE:
        if row.next_state in ARMED and row.state not in ARMED:
            assert row.trigger == Action.ARM and row.guard == Guard.MAY_ARM


def test_every_armed_state_can_be_left_at_any_time() -> None:
    for state in ARMED:
        for action in (Action.DISARM, Action.ESTOP):
            row = ROWS[(state, action)]
            assert row.guard == Guard.ALWAYS and row.next_state not in ARMED


def test_stopped_robot_does_nothing_but_be_cleared() -> None:
    assert [row.trigger for row in TABLE if row.state == State.ESTOP] == [Action.CLEAR_ESTOP]


def test_robot_starts_disarmed() -> None:
    supervisor = Supervisor(MODULES, Supervision())
    assert supervisor.state == State.DISARMED and not supervisor.armed


# ---------------------------------------------------------------- guards, and their words


def test_robot_without_a_pose_does_not_arm() -> None:
    text = refusal(in_state(State.DISARMED), Action.ARM, GOOD._replace(ready=False, tag_age_ns=1 << 60))
    assert text == "ARM refused: no pose yet"


def test_robot_with_a_stale_pose_does_not_arm() -> None:
    text = refusal(in_state(State.DISARMED), Action.ARM, GOOD._replace(tag_age_ns=501_000_000))
    assert text == "ARM refused: pose is 501 ms old, 500 permitted"


def test_robot_that_is_unsure_of_its_pose_does_not_arm() -> None:
    text = refusal(in_state(State.DISARMED), Action.ARM, GOOD._replace(sigma_p=np.array([0.01, 0.08, 0.02])))
    assert text == "ARM refused: pose sigma 80 mm, 50 permitted"


def test_robot_with_a_silent_module_does_not_arm() -> None:
    one = refusal(in_state(State.DISARMED), Action.ARM, inputs=heard(silent=(2,)))
    assert one == "ARM refused: module 2 does not answer"
    both = refusal(in_state(State.DISARMED), Action.ARM, inputs=heard(silent=(0, 2)))
    assert both == "ARM refused: module 0, 2 does not answer"


def test_module_of_another_body_may_be_silent() -> None:
    assert ask(in_state(State.DISARMED), Action.ARM, inputs=heard(silent=(1,)))


def test_all_reasons_are_named_at_once() -> None:
    text = refusal(in_state(State.DISARMED), Action.ARM, GOOD._replace(ready=False), heard(silent=(0,)))
    assert text == "ARM refused: no pose yet; module 0 does not answer"


def test_raised_e_stop_is_not_cleared() -> None:
    text = refusal(in_state(State.ESTOP), Action.CLEAR_ESTOP, inputs=heard(estop=True))
    assert text == "CLEAR_ESTOP refused: the e-stop is still raised"


@pytest.mark.parametrize(("age_ns", "granted"), [(499_999_999, True), (500_000_000, True), (500_000_001, False)])
def test_pose_is_stale_just_beyond_the_limit(age_ns: int, granted: bool) -> None:
    assert ask(in_state(State.DISARMED), Action.ARM, GOOD._replace(tag_age_ns=age_ns)) is granted


@pytest.mark.parametrize(("sigma", "granted"), [(0.0499999, True), (0.05, True), (0.0500001, False), (math.inf, False)])
@pytest.mark.parametrize("axis", range(3))
def test_pose_is_unsure_just_beyond_the_limit(axis: int, sigma: float, granted: bool) -> None:
    sigmas = np.full(3, 0.001)
    sigmas[axis] = sigma
    assert ask(in_state(State.DISARMED), Action.ARM, GOOD._replace(sigma_p=sigmas)) is granted


def test_limits_are_those_of_the_parameters() -> None:
    strict = Supervisor(MODULES, replace(Supervision(), tag_fresh_ms=10.0))
    assert not ask(strict, Action.ARM)


# ---------------------------------------------------------------- e-stop, and order


@pytest.mark.parametrize("state", [State.DISARMED, State.HOLD, State.TRACK])
def test_e_stop_on_the_bus_stops_the_robot_in_this_tick(state: State) -> None:
    supervisor = in_state(state)
    assert supervisor.step(heard(estop=True), GOOD, []) == []
    assert supervisor.state == State.ESTOP and not supervisor.armed
    assert [event.text for event in supervisor.events] == [f"{state.name} -> ESTOP"]


def test_e_stop_that_stays_raised_is_said_once() -> None:
    supervisor = in_state(State.HOLD)
    supervisor.step(heard(estop=True), GOOD, [])
    supervisor.step(heard(estop=True), GOOD, [])
    assert supervisor.events == []


def test_e_stop_comes_before_any_request_of_its_tick() -> None:
    supervisor = in_state(State.DISARMED)
    assert supervisor.step(heard(estop=True), GOOD, [Request(Action.ARM)]) == []
    assert supervisor.state == State.ESTOP


def test_e_stop_that_fell_silent_stays() -> None:
    supervisor = in_state(State.HOLD)
    supervisor.step(heard(estop=True), GOOD, [])
    supervisor.step(heard(), GOOD, [])
    assert supervisor.state == State.ESTOP
    assert ask(supervisor, Action.CLEAR_ESTOP)
    assert supervisor.state == State.DISARMED


def test_requests_of_one_tick_are_taken_in_order() -> None:
    supervisor = in_state(State.DISARMED)
    requests = [Request(Action.TRACK), Request(Action.ARM), Request(Action.TRACK), Request(Action.CLEAR_ESTOP)]
    assert supervisor.step(heard(), GOOD, requests) == requests[1:3]
    assert supervisor.state == State.TRACK
    assert [event.text for event in supervisor.events] == [
        "TRACK refused: not possible in DISARMED",
        "DISARMED -> HOLD",
        "HOLD -> TRACK",
        "CLEAR_ESTOP refused: not possible in TRACK",
    ]


def test_events_are_those_of_the_tick() -> None:
    supervisor = in_state(State.DISARMED)
    ask(supervisor, Action.ARM)
    supervisor.step(heard(), GOOD, [])
    assert supervisor.events == []
