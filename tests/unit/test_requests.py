"""Requests that make no sense or name no existing body are refused in words, and the robot flies on as before."""

import math
from typing import Any

import numpy as np
import pytest

from firmware_py.core.requests import SOUND, against_request, readdressed, sift
from firmware_py.core.rotations import from_euler
from firmware_py.core.setpoint import rest_at
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, DockRequest, Event, Mode, Request, Setpoint, Sticks
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble
from firmware_py.prepare.paths import Hold
from tests.unit.tanks import DT, Tank, single

NAN, LEVEL, ZERO = math.nan, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
HERE = rest_at(np.array([1.0, 0.0, 0.8]), from_euler(0.1, -0.15, 0.4))
STICKS = Sticks((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))


class Path:
    """A trajectory that may be invalid, at its start, at its end, or both."""

    def __init__(self, start: Any = HERE, duration_s: Any = 2.0, end: Any = None) -> None:
        self.start, self.duration_s, self.end = start, duration_s, start if end is None else end

    def sample(self, t_s: float) -> Any:
        return self.start if t_s == 0.0 else self.end


def spoilt(**parts: Any) -> Setpoint:
    return HERE._replace(**parts)


UNPLACED = [
    spoilt(p_wb=np.array([NAN, 0.0, 0.0])), spoilt(p_wb=np.array([0.0, math.inf, 0.0])), spoilt(p_wb=np.array([0.0, 0.0, 1.1e6])),
    spoilt(v_w=np.array([NAN, 0.0, 0.0])), spoilt(q_wb=np.zeros(4)), spoilt(q_wb=2.0 * LEVEL), spoilt(q_wb=LEVEL * NAN),
]  # fmt: skip
MALFORMED = [
    spoilt(p_wb=[1.0, 0.0, 0.0]), spoilt(q_wb=(1.0, 0.0, 0.0, 0.0)), spoilt(p_wb=np.zeros(2)), spoilt(p_wb=np.zeros((3, 1))),
    spoilt(p_wb=np.zeros(3, np.float32)), spoilt(a_w=np.zeros(6)[::2]), spoilt(alpha_b=None), spoilt(w_b=np.array(["a", "b", "c"])),
    tuple(HERE), [1.0, 2.0, 3.0], "here", 1,
]  # fmt: skip
DOCK = DockRequest(1, 1, 0, 0)
UNSOUND: list[tuple[Action, Any]] = [
    *[(Action.ARM, x) for x in (1, "yes", NAN)],
    *[(Action.HOLD, x) for x in (*UNPLACED, *MALFORMED, Path())],
    *[(Action.SET_POINT, x) for x in (None, *UNPLACED[1:3], *UNPLACED[4:6], *MALFORMED, spoilt(q_wb=np.array([1.0, 0.0, NAN, 0.0])))],
    *[(Action.TRACK, x) for x in (None, HERE, 2.0, Path(duration_s=NAN), Path(duration_s=-1.0), Path(duration_s="long"))],
    *[(Action.TRACK, Path(x)) for x in (None, *UNPLACED, *MALFORMED)],
    (Action.TRACK, Path(HERE, end=UNPLACED[0])), (Action.TRACK, Path(UNPLACED[0], end=HERE)),
    (Action.TRACK, type("Sampleless", (), {"duration_s": 1.0})()),
    (Action.TRACK, type("Endless", (), {"sample": lambda self, t: HERE})()),
    *[(Action.SET_MODE, x) for x in (3, None, "AUTO", Mode.DOCK)],
    *[(Action.STICKS, x) for x in (
        None, (1, 2), (0.0,) * 6, Sticks((1.01, 0.0, 0.0)), Sticks(moment=(0.0, -1.01, 0.0)),
        Sticks(moment=(NAN, 0.0, 0.0)), Sticks((0.0, 0.0)), Sticks(("a", "b", "c")), Sticks(None, None),
    )],
    *[(Action.SET_PARAMETER, x) for x in (None, "control.lead_s", ("control.lead_s",), (1, 2), ("control.lead_s", None), (["a"], 1.0))],
    *[(action, x) for action in (Action.DOCK, Action.UNDOCK) for x in (
        None, (1, 1, 0, 0), DOCK._replace(module=None), DOCK._replace(module=-1), DOCK._replace(face=6), DOCK._replace(face=0.5),
        DOCK._replace(target_face=6), DOCK._replace(target_module="one"), DOCK._replace(quarter_turns=4), DOCK._replace(both_approach=2),
    )],
    *[(Action.MOTOR_TEST, x) for x in (None, (0, 0.1), (0.0, 0.1, 1.0), (-1, 0.1, 1.0), (0, NAN, 1.0), (0, "a", "b"), (0, 0.1, math.inf))],
]  # fmt: skip
SOUND_ONES: list[tuple[Action, Any]] = [
    (Action.ARM, None), (Action.ARM, True), (Action.ARM, False), (Action.DISARM, object()), (Action.ESTOP, NAN), (Action.CLEAR_ESTOP, 1),
    (Action.GROUND_ALIVE, "?"), (Action.HOLD, None), (Action.HOLD, HERE), (Action.TRACK, Path()), (Action.TRACK, Hold(HERE, 3.0)),
    (Action.TRACK, Path(duration_s=0.0)),
    (Action.STICKS, STICKS), (Action.STICKS, Sticks((1.0, -1.0, 0))), (Action.SET_MODE, Mode.AUTO),
    (Action.SET_POINT, HERE), (Action.SET_POINT, spoilt(p_wb=ZERO * NAN)),
    (Action.SET_POINT, spoilt(q_wb=LEVEL * NAN, v_w=np.array([NAN, 0.0, 0.1]))), (Action.SET_PARAMETER, ("control.lead_s", 0.1)),
    (Action.MOTOR_TEST, (0, 0.1, 1.0)), (Action.MOTOR_TEST, (7, -0.1, 2)),
    (Action.HOLD, spoilt(q_wb=LEVEL * 1.0009)), (Action.HOLD, spoilt(p_wb=np.full(3, 1e6))),
]  # fmt: skip
ENDS_A_TASK = [
    Request(Action.DISARM, 1), Request(Action.DISARM, 1, True), Request(Action.HOLD, 1), Request(Action.SET_MODE, 1, Mode.POSHOLD),
    Request(Action.SET_MODE, 1, Mode.SURFACE),
]  # fmt: skip
BEGINS_A_TASK = [
    Request(Action.ARM, 1), Request(Action.HOLD, 1, HERE), Request(Action.SET_MODE, 1, Mode.AUTO), Request(Action.SET_POINT, 1, HERE),
    Request(Action.MOTOR_TEST, 1, (1, 0.3, 2.0)), Request(Action.DOCK, 1, DOCK), Request(Action.STICKS, 1, STICKS),
]  # fmt: skip
PAIR = assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [load_vehicle("modcube")] * 2, [0, 1])
APART = {0: single(0), 1: single(1)}


def action_of(request: Request) -> str:
    return f"{request.action.name} {getattr(request.argument, 'name', '')}".strip()


def name(value: Any) -> str:
    return value.name if isinstance(value, Action) else type(value).__name__


def test_table_knows_every_action() -> None:
    assert set(SOUND) == set(Action)


@pytest.mark.parametrize(("action", "argument"), UNSOUND, ids=name)
def test_argument_without_sense_is_refused(action: Action, argument: Any) -> None:
    assert against_request(Request(action, 0, argument), {0: PAIR}) == "its argument makes no sense"


def test_test_of_a_thruster_that_is_not_there_is_refused() -> None:
    assert against_request(Request(Action.MOTOR_TEST, 0, (15, 0.1, 1.0)), {0: PAIR}) == ""
    assert against_request(Request(Action.MOTOR_TEST, 0, (16, 0.1, 1.0)), {0: PAIR}) == "there is no thruster 16; there are 16, from 0 on"


@pytest.mark.parametrize(("action", "argument"), SOUND_ONES, ids=name)
def test_argument_with_sense_passes(action: Action, argument: Any) -> None:
    assert against_request(Request(action, 0, argument), APART) == ""


@pytest.mark.parametrize("action", [Action.ESTOP, Action.CLEAR_ESTOP, Action.GROUND_ALIVE, Action.SET_PARAMETER], ids=name)
def test_what_concerns_everybody_may_name_anybody(action: Action) -> None:
    assert against_request(Request(action, 99, ("control.lead_s", 0.1)), APART) == ""


def test_body_that_is_not_there_is_named_with_those_that_are() -> None:
    assert against_request(Request(Action.ARM, 7), APART) == "module 8 leads no body, but module 1, 2"
    assert against_request(Request(Action.DISARM, 1), {0: PAIR}) == "module 2 leads no body, but module 1"


@pytest.mark.parametrize(
    ("action", "body", "dock", "words"),
    [
        (Action.DOCK, 1, DOCK, ""),
        (Action.DOCK, 1, DOCK._replace(target_module=9), "there is no module 10, but module 1, 2"),
        (Action.DOCK, 1, DOCK._replace(module=5), "there is no module 6, but module 1, 2"),
        (Action.DOCK, 0, DOCK, "module 2 is not of the body of module 1"),
        (Action.DOCK, 1, DOCK._replace(target_module=1), "modules 2 and 2 are already of one body"),
        (
            Action.DOCK, 1, DOCK._replace(face=0),
            "module 2 cannot dock to module 1: +x is a probe and +x a probe; a probe docks to a drogue",
        ),
        (Action.UNDOCK, 1, DOCK, "modules 2 and 1 are not of one body"),
    ],
)
def test_dock_or_undock_of_what_is_not_there_is_refused(action: Action, body: int, dock: DockRequest, words: str) -> None:
    assert against_request(Request(action, body, dock), APART) == words


def test_docked_modules_part_and_do_not_dock_again() -> None:
    assert against_request(Request(Action.UNDOCK, 0, DOCK), {0: PAIR}) == ""
    assert against_request(Request(Action.DOCK, 0, DOCK), {0: PAIR}) == "modules 2 and 1 are already of one body"


def test_sound_requests_keep_their_order_and_the_others_are_answered() -> None:
    requests = [Request(Action.ARM), Request(Action.HOLD, 0, 1), Request(Action.DISARM), Request(Action.ARM, 3)]
    sound, events = sift(requests, APART)
    assert sound == [requests[0], requests[2]]
    assert events == [
        Event(4, "HOLD refused: its argument makes no sense", 0), Event(4, "ARM refused: module 4 leads no body, but module 1, 2", 3),
    ]  # fmt: skip


def test_disarm_reaches_every_body_that_has_a_module_of_the_one_that_it_names() -> None:
    """In the tick in which bodies part or join: modules 0 and 1 were one body, or are one now; body 2 is separate."""
    other = single(2)
    apart, joined = [*APART.values(), other], [PAIR, other]
    requests = [Request(Action.DISARM, 0), Request(Action.ARM, 0), Request(Action.DISARM, 2)]
    assert readdressed(requests, joined, {**APART, 2: other}) == [Request(Action.DISARM, 0), Request(Action.DISARM, 1), *requests[1:]]
    assert readdressed([Request(Action.DISARM, 1)], apart, {0: PAIR, 2: other}) == [Request(Action.DISARM, 0)]
    assert readdressed([Request(Action.DISARM, 7)], apart, {0: PAIR, 2: other}) == [Request(Action.DISARM, 7)], "which nobody is"


@pytest.mark.parametrize("request_", ENDS_A_TASK, ids=action_of)
def test_stop_for_a_number_that_leads_no_body_any_more_reaches_the_body_that_holds_its_module(request_: Request) -> None:
    """A person still sees two robots in the ticks after a join, and whoever sends 'disarm' must be obeyed."""
    joined = [PAIR, single(2)]
    assert readdressed([request_], joined, {body.index: body for body in joined}) == [request_._replace(body=0)]
    assert readdressed([request_], [*APART.values()], APART) == [request_], "there is such a body: it alone is meant"


@pytest.mark.parametrize("request_", BEGINS_A_TASK, ids=action_of)
def test_task_for_a_number_that_leads_no_body_any_more_is_given_to_nobody(request_: Request) -> None:
    """It was meant for one module alone, at its own place."""
    assert readdressed([request_], [PAIR], {0: PAIR}) == [request_]


# ---------------------------------------------------------------- in flight


def pair_in_flight() -> Tank:
    tank = Tank([PAIR])
    tank.run(0.5)
    tank.run(0.5, Request(Action.ARM))
    assert tank.outputs[-1].records[0].state == State.ARMED
    return tank


def test_docked_robot_is_disarmed_by_the_number_of_either_module() -> None:
    outputs = pair_in_flight().run(DT, Request(Action.DISARM, 1))
    assert outputs.records[0].state == State.DISARMED
    assert not any(command.armed or command.thrusters.any() for command in outputs.modules)
    assert not any("refused" in event.text for event in outputs.events)


@pytest.mark.parametrize("mode", [Mode.POSHOLD, Mode.SURFACE])
def test_docked_robot_holds_its_place_or_surfaces_by_the_number_of_either_module(mode: Mode) -> None:
    tank = pair_in_flight()
    tank.run(DT, Request(Action.SET_MODE, 0, Mode.MANUAL))
    assert tank.run(DT, Request(Action.SET_MODE, 1, mode)).records[0].mode == mode
    assert "module 2 leads no body" in tank.run(DT, Request(Action.SET_MODE, 1, Mode.MANUAL)).events[0].text


def test_robot_flies_on_through_every_request_without_sense() -> None:
    """All of them in one tick, ten times within a second: nothing raises, nothing moves, every one is answered."""
    tank = Tank([single()])
    tank.run(0.5)
    tank.run(3.0, Request(Action.ARM))
    for _ in range(10):
        outputs = tank.run(DT, *(Request(action, 0, argument) for action, argument in UNSOUND))
        assert len([event for event in outputs.events if "refused" in event.text]) == len(UNSOUND)
        tank.run(0.1)
    record = tank.outputs[-1].records[0]
    assert (record.state, record.mode) == (State.ARMED, Mode.POSHOLD)
    np.testing.assert_allclose(record.setpoint.p_wb, tank.states[0][:3], atol=2e-3)
    assert np.isfinite(record.commanded_n).all()


def test_place_with_a_hole_in_it_does_not_poison_the_set_point() -> None:
    """A NaN in the glider's state would never leave it."""
    tank = Tank([single()])
    tank.run(0.5)
    tank.run(1.0, Request(Action.ARM))
    for argument in UNPLACED + MALFORMED:
        tank.run(DT, Request(Action.HOLD, 0, argument), Request(Action.SET_POINT, 0, argument))
    outputs = tank.run(1.0, Request(Action.SET_MODE, 0, Mode.GUIDED))
    assert all(np.isfinite(part).all() for part in outputs.records[0].setpoint)
    assert outputs.modules[0].thrusters.any()


def test_dock_that_cannot_be_prepared_leaves_the_body_holding_its_place() -> None:
    """That another pair of faces would be probe against probe is found only in preparation, after the mode has changed."""
    from firmware_py.core.docking_decisions import Prepared

    tank = Tank([single(0), single(1)])
    tank.run(0.5)
    tank.run(0.5, Request(Action.ARM, 0), Request(Action.ARM, 1))
    outputs = tank.run(DT, Request(Action.DOCK, 1, DOCK))
    assert outputs.preparations == [DOCK]
    assert outputs.records[1].mode == Mode.DOCK
    step = tank.pipeline.step

    def refuse_once(inputs: Any) -> Any:
        tank.pipeline.step = step  # type: ignore[method-assign]
        inputs.prepared = [Prepared(DOCK, None, (), "a probe would meet no drogue")]
        return step(inputs)

    tank.pipeline.step = refuse_once  # type: ignore[method-assign]
    outputs = tank.run(2 * DT)
    assert any(event.text == "dock refused: a probe would meet no drogue" for o in tank.outputs[-2:] for event in o.events)
    assert outputs.records[1].mode == Mode.POSHOLD
