"""The target of docks: it feels no jolt, comes to meet one active body, and goes back to where it was."""

from itertools import cycle

import numpy as np
import pytest

from firmware_py.core.docking import CHANGED, LED, NO_LONGER, SURFACES
from firmware_py.core.docking_sequence import Stage
from firmware_py.core.rotations import from_euler
from firmware_py.core.setpoint import rest_at
from firmware_py.core.types import Action, DockRequest, Mode, Request, Sticks
from firmware_py.description.parameters import Parameters
from firmware_py.prepare.assembly import PITCH_M
from tests.unit.tanks import FaultyTank, tank_with_modules_at, tank_with_row


@pytest.mark.slow
def test_pilot_of_the_target_feels_no_blow_when_another_docks_to_it() -> None:
    wide = Parameters().replace("docking.push_m", 0.0).replace("docking.position_tolerance_m", 0.1).replace("docking.settled_m", 0.1)
    tank = FaultyTank([(0, 0, 0), (0, 1, 0)], wide, apart=True)
    for state, east in zip(tank.states, (0.0, PITCH_M), strict=True):
        state[:7] = [1.0, east, 0.8, *from_euler(0.0, 0.02, 0.0)]
    tank.run(2.0)
    tank.run(0.5, Request(Action.ARM, 0), Request(Action.ARM, 1))
    sticks = Request(Action.STICKS, 0, Sticks((0.2, 0.0, 0.0)))
    tank.run(0.03, sticks, Request(Action.SET_MODE, 0, Mode.ALT_HOLD), Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    (dock,) = tank.pipeline.formation.docking._docks
    dock.sequence.stage, dock.sequence._gap_m = Stage.VERIFY, 0.0  # as if it had just arrived
    for _ in range(300):
        if len(tank.shape) == 2:
            tank.run(0.01, *([sticks] if len(tank.outputs) % 10 == 5 else []))
    assert len(tank.shape) == 1
    forward = [tank.outputs[-1].records[0].wrench[0]]
    for _ in range(6):
        tank.run(0.1, sticks)
        forward += [outputs.records[0].wrench[0] for outputs in tank.outputs[-10:]]
    assert tank.outputs[-1].records[0].mode == Mode.ALT_HOLD
    assert max(forward) < 1.2 * forward[-1]


@pytest.mark.slow
@pytest.mark.parametrize("approach", ["staged", "straight"])
def test_target_that_is_disarmed_is_not_expected_to_come(approach: str) -> None:
    tank = tank_with_row(2.0, parameters=Parameters().replace("docking.approach", approach), armed=(1,))
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, True)))
    (dock,) = tank.pipeline.formation.docking._docks
    assert dock.sequence.meets_at_w is None and tank.pipeline.formation.pipelines[0].guidance._goal is None


@pytest.mark.slow
@pytest.mark.parametrize("ring", [False, True])
def test_bodies_that_are_to_dock_to_each_other_do_not_chase_each_other(ring: bool) -> None:
    places = [(1.0, 0.0), (1.5, 0.5), (0.4, 0.8)][: 3 if ring else 2]
    tank = tank_with_modules_at(*places)
    wanted = [DockRequest(1, 3, 0, 2), DockRequest(2, 3, 1, 2), DockRequest(0, 1, 2, 0)] if ring else [
        DockRequest(1, 3, 0, 2), DockRequest(0, 0, 1, 1)
    ]
    outputs = tank.run(4.0, *(Request(Action.DOCK, request.module, request) for request in wanted))
    assert tank.when(f"dock refused: {LED}") and len(outputs.docks) == len(wanted) - 1
    assert sum(record.mode == Mode.POSHOLD for record in outputs.records) == 1
    assert max(np.linalg.norm(outputs.records[m].estimate.nu[:3]) for m in range(len(places))) < 0.35


@pytest.mark.slow
def test_target_that_comes_is_sent_on_once_however_often_one_asks() -> None:
    tank = tank_with_row(2.0)
    for turns in (0, 1, 0, 1):
        tank.run(0.2, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, turns, True)))
    goal = tank.pipeline.formation.pipelines[0].guidance._goal
    assert goal is not None and goal.p_wb is not None
    assert 0.6 < goal.p_wb[1] < 0.5 * (2.0 - PITCH_M - Parameters().docking.standoff_m) + 0.01


@pytest.mark.slow
@pytest.mark.parametrize("stop", [Request(Action.DISARM, 1), Request(Action.SET_MODE, 1, Mode.MANUAL)], ids=["DISARM", "mode"])
def test_target_does_not_come_to_meet_a_robot_that_has_left_the_dock_before_it_was_planned(stop: Request) -> None:
    tank = tank_with_row(2.0)
    tank._delay = 30
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, True)))
    tank.run(1.0, stop)
    assert tank.when(f"dock refused: {NO_LONGER}")
    assert tank.pipeline.formation.pipelines[0].guidance._goal is None


@pytest.mark.slow
def test_target_that_comes_goes_back_when_the_dock_is_called_off() -> None:
    tank = tank_with_row(2.0)
    held = tank.pipeline.formation.pipelines[0].guidance._glider.at.p_wb.copy()
    tank.run(0.5, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, True)))
    tank.run(0.1, Request(Action.SET_MODE, 1, Mode.POSHOLD))
    goal = tank.pipeline.formation.pipelines[0].guidance._goal
    assert goal is not None and goal.p_wb is not None
    np.testing.assert_allclose(goal.p_wb, held, atol=0.02)


@pytest.mark.slow
def test_target_that_comes_goes_back_when_the_dock_aborts() -> None:
    """The active body loses its tags: its own estimate grows too unsure, and nobody watches the target's way any more."""
    tank = tank_with_row(1.6)
    held = tank.pipeline.formation.pipelines[0].guidance._held().p_wb.copy()
    tank.run(1.0, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, True)))
    tank.hidden = {1}
    tank.run(3.0)
    assert tank.when("ABORTED") and not tank.pipeline.formation.docking.under_way
    np.testing.assert_allclose(tank.pipeline.formation.pipelines[0].guidance._held().p_wb, held, atol=0.02)


@pytest.mark.slow
def test_target_that_comes_goes_back_when_the_body_that_it_comes_to_meet_is_taken_apart() -> None:
    tank = FaultyTank([(0, 0, 0), (0, 1, 0)] * 2, each=2)
    for state, east in zip(tank.states, (0.0, 2.4), strict=True):
        state[:7] = [1.0, east, 0.8, *from_euler(0.0, 0.02, 0.0)]
    tank.run(2.0)
    tank.run(0.5, Request(Action.ARM, 0), Request(Action.ARM, 2))
    held = tank.pipeline.formation.pipelines[0].guidance._held().p_wb.copy()
    tank.run(0.5, Request(Action.DOCK, 2, DockRequest(2, 3, 1, 2, 0, True)))
    tank.run(2.0, Request(Action.UNDOCK, 2, DockRequest(3, 3, 2, 2)))
    assert tank.shape == [(0, 1), (2,), (3,)] and tank.when(f"dock of module 3 ended: {CHANGED}")
    np.testing.assert_allclose(tank.pipeline.formation.pipelines[0].guidance._held().p_wb, held, atol=0.02)


ELSEWHERE = Request(Action.HOLD, 0, rest_at(np.array([1.0, -0.5, 0.8]), np.array([1.0, 0.0, 0.0, 0.0])))
LEFTWARDS = Request(Action.STICKS, 0, Sticks((0.0, -1.0, 0.0)))


@pytest.mark.slow
@pytest.mark.parametrize("move", [ELSEWHERE, LEFTWARDS], ids=["sent", "steered"])
def test_target_that_came_and_was_moved_by_a_person_since_stays_there_when_the_dock_is_called_off(move: Request) -> None:
    tank = tank_with_row(3.0)
    tank.run(1.0, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, True)))
    guidance = tank.pipeline.formation.pipelines[0].guidance
    assert guidance._goal is not None
    tank.run(1.0, move)
    goal = guidance._goal
    outputs = tank.run(1.0, Request(Action.SET_MODE, 1, Mode.POSHOLD))
    assert outputs.docks == [] and tank.when(f"dock of module 2 ended: {NO_LONGER}")
    assert guidance._goal is goal and (goal is None) == (move is LEFTWARDS)


@pytest.mark.slow
def test_nobody_docks_to_a_body_that_surfaces() -> None:
    tank = tank_with_row(2.0)
    outputs = tank.run(0.5, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    assert outputs.docks and outputs.records[1].mode == Mode.DOCK
    outputs = tank.run(0.1, Request(Action.SET_MODE, 0, Mode.SURFACE))
    assert outputs.docks == [] and tank.when(f"dock of module 2 ended: {SURFACES}")
    assert [record.mode for record in outputs.records] == [Mode.SURFACE, Mode.POSHOLD]
    assert not any(any(states) for states in tank.pipeline.formation.docking.relays.states)


@pytest.mark.slow
def test_target_comes_to_meet_the_first_of_two_alone() -> None:
    tank = FaultyTank([(0, 0, 0), (0, 1, 0), (0, -1, 0)], apart=True)
    for state, y in zip(tank.states, (0.0, 2.0, -1.5), strict=True):
        state[:7] = [1.0, y, 0.8, *from_euler(0.0, 0.02, 0.0)]
    tank.run(2.0)
    tank.run(0.5, *(Request(Action.ARM, m) for m in range(3)))
    wanted = DockRequest(1, 3, 0, 2, 0, True), DockRequest(2, 2, 0, 3, 0, True)
    tank.run(0.2, *(Request(Action.DOCK, request.module, request) for request in wanted))
    assert len(tank.outputs[-1].docks) == 2
    goal = tank.pipeline.formation.pipelines[0].guidance._goal
    assert goal is not None and goal.p_wb is not None
    assert goal.p_wb[1] == pytest.approx(0.5 * (2.0 - PITCH_M - Parameters().docking.standoff_m), abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("approach", ["staged", "straight"])
def test_dock_whose_way_leads_through_a_third_body_is_refused(approach: str) -> None:
    tank = tank_with_modules_at((1.0, 0.0), (1.0, 2.0), (1.1, 1.0), parameters=Parameters().replace("docking.approach", approach))
    outputs = tank.run(0.5, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    assert tank.when("dock refused: on its way it would come too near to module 3")
    assert outputs.docks == [] and outputs.records[1].mode == Mode.POSHOLD and abs(tank.states[1][1] - 2.0) < 0.05


@pytest.mark.slow
def test_dock_whose_target_would_come_through_a_third_body_is_refused() -> None:
    """The active body goes level to the stand-off; the target, which comes half of that way, has another body beside it."""
    tank = tank_with_modules_at((1.0, 0.0), (2.0, 1.5), (1.0, 0.45))
    tank.run(0.5, Request(Action.DOCK, 1, DockRequest(1, 1, 0, 0, 0, True)))
    assert tank.when("dock refused: module 1, which is to meet it, would come too near to module 3")
    outputs = tank.run(0.5, Request(Action.DOCK, 1, DockRequest(1, 1, 0, 0)))
    assert len(outputs.docks) == 1


@pytest.mark.slow
@pytest.mark.parametrize("north_m", [0.45, -0.45])
def test_dock_past_a_third_body_that_leaves_room_is_begun(north_m: float) -> None:
    tank = tank_with_modules_at((1.0, 0.0), (1.0, 2.0), (1.0 + north_m, 1.0))
    outputs = tank.run(0.5, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, True)))
    assert len(outputs.docks) == 1 and outputs.records[1].mode == Mode.DOCK


@pytest.mark.slow
def test_dock_waits_while_a_third_body_is_on_its_way_and_then_goes_on() -> None:
    tank = tank_with_modules_at((1.0, 0.0), (1.0, 2.0), (1.6, 1.0))
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    tank.run(8.0, Request(Action.HOLD, 2, rest_at(np.array([1.0, 1.0, 0.8]), np.array([1.0, 0.0, 0.0, 0.0]))))
    assert tank.when("dock of module 2 waits: module 3 is on its way")
    assert sum("waits" in said for _, said in tank.event_log) == 1
    assert min(np.linalg.norm(past[1][:3] - past[2][:3]) for past in tank.past) > 0.4
    assert tank.outputs[-1].docks[0].stage == Stage.PRE_APPROACH
    tank.run(0.1, Request(Action.HOLD, 2, rest_at(np.array([1.6, 1.0, 0.8]), np.array([1.0, 0.0, 0.0, 0.0]))))
    for _ in range(1500):
        if tank.outputs[-1].docks[0].stage == Stage.PRE_APPROACH:
            tank.run(0.01)
    assert tank.outputs[-1].docks[0].stage == Stage.ALIGN


@pytest.mark.slow
def test_dock_says_of_each_module_once_that_it_waits_though_two_are_as_near() -> None:
    """Noise decides which of two modules on the way is the nearer one."""
    tank = tank_with_modules_at((1.0, 0.0), (1.0, 2.0), (1.6, 0.9), (1.6, 1.3))
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    met = cycle([2, 3])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("firmware_py.core.docking_traffic.first_blocking_module", lambda *_: next(met))
        tank.run(0.2)
    assert [said for _, said in tank.event_log if "waits" in said] == [f"dock of module 2 waits: module {m} is on its way" for m in (3, 4)]


LEVEL, DIAGONAL = (from_euler(0.0, 0.0, yaw) for yaw in (0.0, 0.25 * np.pi))
CLEAR_M = 2.0**0.5 * PITCH_M
"""Distance of the centres at which level cubes do not touch, whatever their headings."""


def send(module: int, north_m: float, east_m: float, q_wb: np.ndarray = LEVEL) -> Request:
    """A request that sends a module to another place at the common depth."""
    return Request(Action.HOLD, module, rest_at(np.array([north_m, east_m, 0.8]), q_wb))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("approach", "east_m", "there"),
    [("straight", 0.8, (1.0, 0.4, LEVEL)), ("staged", 0.34, (1.26, 0.2, DIAGONAL))],
    ids=["of a straight line", "before the face"],
)
def test_approach_waits_while_a_third_body_is_in_its_way_and_then_goes_on(
    approach: str, east_m: float, there: tuple[float, float, np.ndarray]
) -> None:
    parameters = Parameters().replace("docking.approach", approach).replace("failsafes.collision_action", 0)  # the third comes close
    tank = tank_with_modules_at((1.0, 0.0), (1.0, east_m), (1.6, there[1]), parameters=parameters, armed=(1, 2))
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    tank.run(10.0, send(2, *there))
    (dock,) = tank.outputs[-1].docks
    assert dock.stage == Stage.APPROACH and dock.gap_m > 0.03
    assert [said for _, said in tank.event_log if "waits" in said] == ["dock of module 2 waits: module 3 is on its way"]
    assert min(np.linalg.norm(past[1][:3] - past[2][:3]) for past in tank.past) > 0.26
    tank.run(0.1, send(2, 1.6, there[1]))
    while tank.outputs[-1].docks[0].stage == Stage.APPROACH and len(tank.outputs) < 6000:
        tank.run(0.01)
    assert tank.outputs[-1].docks[0].stage == Stage.PUSH


@pytest.mark.slow
@pytest.mark.parametrize("approach", ["staged", "straight"])
def test_target_that_comes_stops_before_a_third_body_and_goes_back(approach: str) -> None:
    tank = tank_with_modules_at((1.0, 0.0), (1.0, 2.4), (1.6, 0.75), parameters=Parameters().replace("docking.approach", approach))
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, True)))
    outputs = tank.run(8.0, send(2, 1.0, 0.75))
    assert tank.when("dock of module 2 ended: module 3 is where module 1 comes to meet it")
    assert outputs.docks == [] and [record.mode for record in outputs.records] == [Mode.POSHOLD] * 3
    assert min(np.linalg.norm(past[0][:3] - past[2][:3]) for past in tank.past) > CLEAR_M
    assert abs(tank.states[0][1]) < 0.05


@pytest.mark.slow
def test_later_of_two_docks_that_are_on_each_other_s_ways_makes_room() -> None:
    tank = tank_with_modules_at((1.0, 0.0), (1.0, 2.0), (0.0, 1.0), (2.0, 1.0))
    wanted = DockRequest(1, 3, 0, 2), DockRequest(3, 1, 2, 0)
    tank.run(0.1, *(Request(Action.DOCK, request.module, request) for request in wanted))
    outputs = tank.run(12.0)
    assert [dock.stage for dock in outputs.docks] == [Stage.APPROACH] * 2
    assert sum("gives way" in said for _, said in tank.event_log) == 1 and tank.when("dock of module 4 gives way to another")
    assert min(np.linalg.norm(past[1][:3] - past[3][:3]) for past in tank.past) > 0.35


@pytest.mark.slow
def test_dock_that_cannot_go_back_to_make_room_is_given_way_to_by_the_other() -> None:
    tank = tank_with_modules_at((1.0, 0.0), (1.0, 2.0), (0.0, 1.0), (2.0, 1.0), (2.2, 1.6))
    wanted = DockRequest(1, 3, 0, 2), DockRequest(3, 1, 2, 0)
    tank.run(0.1, *(Request(Action.DOCK, request.module, request) for request in wanted))
    tank.run(6.0, send(4, 1.9, 1.0))
    outputs = tank.run(9.0)
    assert [Stage.APPROACH <= dock.stage <= Stage.VERIFY for dock in outputs.docks] == [True] * 2
    assert [said for _, said in tank.event_log if "gives way" in said] == ["dock of module 2 gives way to another"]
    assert min(np.linalg.norm(past[3][:3] - past[n][:3]) for past in tank.past for n in (1, 4)) > 0.35


@pytest.mark.slow
def test_earlier_of_two_docks_makes_room_where_the_later_one_s_room_is_on_its_way() -> None:
    """The earlier dock's target is sent elsewhere, so that its new way leads through the place where the later dock began."""
    tank = tank_with_modules_at((1.0, 0.0), (1.0, 2.0), (0.0, 1.0), (2.0, 1.0), parameters=Parameters().replace("docking.timeout_s", 30.0))
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    tank.run(1.0, Request(Action.DOCK, 3, DockRequest(3, 1, 2, 0)))
    while not any("gives way" in said for _, said in tank.event_log):
        tank.run(0.01)
    tank.run(0.1, send(0, 2.5, 0.3))
    outputs = tank.run(17.0)
    assert tank.when("dock of module 2 gives way to another")
    assert [dock.stage for dock in outputs.docks] == [Stage.APPROACH] * 2
    assert min(np.linalg.norm(past[1][:3] - past[3][:3]) for past in tank.past) > 0.35


@pytest.mark.slow
def test_dock_to_a_target_that_comes_to_meet_another_waits_until_it_is_there() -> None:
    """It used to go in front of the face, into the target's way, and so ended the other's dock."""
    tank = tank_with_modules_at((1.0, 0.0), (2.4, 1.4), (1.75, -0.3))
    tank.run(0.5, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, True)))
    outputs = tank.run(10.0, Request(Action.DOCK, 2, DockRequest(2, 1, 0, 0)))
    assert len(outputs.docks) == 2 and not any("ended" in said for _, said in tank.event_log)
    assert [said for _, said in tank.event_log if "waits" in said] == ["dock of module 3 waits: module 1 is on its way"]


@pytest.mark.slow
def test_straight_line_to_a_target_that_comes_to_meet_another_is_drawn_once_it_is_there() -> None:
    """It used to be drawn at once, to a place that the target was leaving for good."""
    tank = tank_with_modules_at((1.0, 0.0), (2.4, 1.4), (1.75, -0.3), parameters=Parameters().replace("docking.approach", "straight"))
    tank.run(0.5, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    tank.run(0.1, Request(Action.DOCK, 2, DockRequest(2, 1, 0, 0)))
    first, second = (dock.sequence for dock in tank.pipeline.formation.docking._docks)
    assert first.stage == Stage.APPROACH and second.stage == Stage.PRE_APPROACH
    while second.stage == Stage.PRE_APPROACH:
        tank.run(0.01)
    there = second.target_to_meet(tank.outputs[-1].records[0].estimate).p_wb
    np.testing.assert_allclose(there, first.meets_at_w, atol=0.01)


@pytest.mark.slow
def test_target_that_was_sent_elsewhere_is_on_no_way_to_the_place_where_it_was_to_meet() -> None:
    tank = tank_with_modules_at((1.0, 0.0), (1.0, 2.4), (2.0, 0.75))
    tank.run(1.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, True)))
    tank.run(3.0, send(0, 1.0, 0.0))
    outputs = tank.run(3.0, send(2, 1.0, 0.75))
    assert len(outputs.docks) == 1 and not any("ended" in said for _, said in tank.event_log)


@pytest.mark.slow
def test_target_that_has_come_and_is_pushed_a_little_beside_a_third_body_still_has_come() -> None:
    tank = tank_with_modules_at((1.0, 0.0), (1.0, 1.4), (1.6, 0.535))
    tank.run(7.0, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, True)))
    tank.run(5.0, send(2, 1.25, 0.535))
    (dock,) = tank.pipeline.formation.docking._docks
    tank.states[0][19] = -4.0
    tank.run(0.5)
    assert np.linalg.norm(tank.states[0][:3] - dock.sequence.meets_at_w) > 0.006
    assert not any("comes to meet it" in said for _, said in tank.event_log)
