"""Docks as operators request them: twice, two at once, from afar, and called off."""

import numpy as np
import pytest

from firmware_py.core.docking import CHANGED, TAKEN
from firmware_py.core.docking_sequence import Stage
from firmware_py.core.rotations import from_euler
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, DockRequest, Mode, Request, Sticks
from firmware_py.description.parameters import Parameters
from firmware_py.prepare.assembly import PITCH_M
from tests.unit.tanks import RING, FaultyTank, tank_with_row


@pytest.mark.slow
@pytest.mark.parametrize("stop", ["e-stop", "DISARM"])
def test_dock_ends_with_an_e_stop_or_disarming_and_is_not_gone_on_with(stop: str) -> None:
    tank = FaultyTank(RING[:2], apart=True)
    tank.without_current = {0, 1}
    tank.states[1][1] = 0.6
    tank.run(2.0)
    tank.run(3.0, Request(Action.ARM, 0), Request(Action.ARM, 1))
    outputs = tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, False)))
    while not (outputs.docks and outputs.docks[0].stage == Stage.APPROACH):
        outputs = tank.run(0.01)
    outputs = tank.run(1.0)
    assert outputs.records[1].mode == Mode.DOCK and any(any(states) for states in tank.pipeline.formation.docking.relays.states)
    stopping = [] if stop == "e-stop" else [Request(Action.DISARM, 0), Request(Action.DISARM, 1)]
    tank.run(0.02, *stopping, estop=stop == "e-stop")
    outputs = tank.run(5.0)
    assert outputs.docks == [] and not any(any(states) for states in tank.pipeline.formation.docking.relays.states)
    assert tank.when("dock of module 2 ended")
    tank.run(0.1, Request(Action.CLEAR_ESTOP, 1))
    outputs = tank.run(0.1, Request(Action.ARM, 1))
    before = tank.states[1][:3].copy()
    outputs = tank.run(5.0)
    assert (outputs.records[1].state, outputs.records[1].mode) == (State.ARMED, Mode.POSHOLD)
    assert np.linalg.norm(tank.states[1][:3] - before) < 0.02


@pytest.mark.slow
def test_second_of_two_docks_to_one_body_in_one_tick_lets_go() -> None:
    tank = FaultyTank([(0, 0, 0), (0, 1, 0), (0, -1, 0)], Parameters().replace("docking.push_m", 0.0), apart=True)
    for state, side in zip(tank.states, (0.0, PITCH_M, -PITCH_M), strict=True):
        state[:7] = [1.0, side, 0.8, *from_euler(0.0, 0.02, 0.0)]
    tank.run(2.0)
    tank.run(0.5, *(Request(Action.ARM, m) for m in range(3)))
    wanted = DockRequest(1, 3, 0, 2), DockRequest(2, 2, 0, 3)
    tank.run(0.03, *(Request(Action.DOCK, request.module, request) for request in wanted))
    assert len(tank.pipeline.formation.docking._docks) == 2
    for dock in tank.pipeline.formation.docking._docks:
        dock.sequence.stage, dock.sequence._gap_m = Stage.VERIFY, 0.0  # as if they had just arrived
    outputs = tank.run(2.0)
    assert [record.stage for outputs in tank.outputs for record in outputs.docks].count(Stage.DOCKED) == 2
    assert tank.shape == [(0, 1), (2,)]
    assert tank.pipeline.formation.docking.relays.states == [[0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0] * 6]
    assert outputs.docks == [] and outputs.records[1].mode == Mode.POSHOLD
    assert tank.when(f"dock of module 3 ended: {CHANGED}")


@pytest.mark.slow
def test_dock_from_afar_glides_to_the_stand_off_and_keeps_it() -> None:
    tank, near, fastest = tank_with_row(2.0), [], []
    first = len(tank.outputs)
    tank.run(0.03, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    while tank.outputs[-1].docks[0].stage == Stage.PRE_APPROACH:
        tank.run(0.01)
        near.append(tank.states[1][1] - tank.states[0][1])
        fastest.append(np.linalg.norm(tank.states[1][7:10]))
    places = np.array([outputs.records[1].setpoint.p_wb for outputs in tank.outputs[first:]])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps[:-1].max() < 0.0035, "a speed of 0.3 m/s"
    assert steps[-1] < 5 * Parameters().docking.align_m, "near enough to be aligned"
    assert max(fastest) < 0.35
    assert min(near) > PITCH_M + 0.9 * Parameters().docking.standoff_m
    assert len(tank.outputs) - first < 2000


@pytest.mark.slow
def test_dock_whose_way_leads_through_the_target_is_refused() -> None:
    tank = tank_with_row(2.0)
    outputs = tank.run(3.0, Request(Action.DOCK, 1, DockRequest(1, 2, 0, 3)))
    assert tank.when("dock refused: on its way it would come too near to module 1")
    assert outputs.records[1].mode == Mode.POSHOLD and abs(tank.states[1][1] - 2.0) < 0.05


@pytest.mark.slow
def test_straight_dock_is_begun_from_anywhere_as_the_papers() -> None:
    tank = tank_with_row(2.0, parameters=Parameters().replace("docking.approach", "straight"))
    outputs = tank.run(0.5, Request(Action.DOCK, 1, DockRequest(1, 2, 0, 3)))
    assert [dock.stage for dock in outputs.docks] == [Stage.APPROACH] and outputs.records[1].mode == Mode.DOCK


@pytest.mark.slow
def test_body_whose_dock_is_over_may_dock_again() -> None:
    tank = tank_with_row(0.6)
    outputs = tank.run(1.0, Request(Action.DOCK, 1, DockRequest(1, 2, 0, 3)))
    assert outputs.docks == [] and outputs.records[1].mode == Mode.POSHOLD
    outputs = tank.run(1.0, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    assert len(outputs.docks) == 1 and outputs.records[1].mode == Mode.DOCK


@pytest.mark.slow
@pytest.mark.parametrize("wanted", [DockRequest(2, 3, 0, 2), DockRequest(2, 2, 1, 3)], ids=["of the target", "of who docks"])
def test_dock_to_a_face_that_another_dock_is_to_close_is_refused(wanted: DockRequest) -> None:
    """Both bodies would go to the same place and collide there."""
    tank = tank_with_row(0.6, 1.2)
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    outputs = tank.run(0.1, Request(Action.DOCK, 2, wanted))
    assert len(outputs.docks) == 1 and tank.when(f"dock refused: {TAKEN}")
    assert outputs.records[2].mode == Mode.POSHOLD


@pytest.mark.slow
def test_dock_that_would_bring_a_module_where_another_dock_brings_one_is_refused() -> None:
    """Two pairs go to two faces of one robot, and the second modules of both would end at the same place, off its corner."""
    tank = FaultyTank([(0, 0, 0), (-1, 0, 0), (0, 0, 0), (1, 0, 0), (0, 0, 0), (0, 1, 0)], each=2)
    for state, (north, east) in zip(tank.states, [(1.0, 0.0), (1.2, 0.6), (1.8, 0.1)], strict=True):
        state[:7] = [north, east, 0.8, *from_euler(0.0, 0.02, 0.0)]
    tank.run(2.0)
    tank.run(0.5, *(Request(Action.ARM, body) for body in (0, 2, 4)))
    tank.run(0.1, Request(Action.DOCK, 2, DockRequest(2, 3, 0, 2)))
    outputs = tank.run(0.1, Request(Action.DOCK, 4, DockRequest(4, 1, 0, 0)))
    assert len(outputs.docks) == 1 and tank.when(f"dock refused: {TAKEN}")
    assert [record.mode for record in outputs.records] == [Mode.POSHOLD, Mode.DOCK, Mode.POSHOLD]


@pytest.mark.slow
def test_dock_that_is_asked_for_twice_goes_on_and_another_takes_its_place() -> None:
    tank = tank_with_row(0.6, 1.2)
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    while tank.outputs[-1].docks[0].stage != Stage.APPROACH:
        tank.run(0.01)
    tank.run(0.5, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    assert [dock.stage for dock in tank.outputs[-1].docks] == [Stage.APPROACH]
    outputs = tank.run(3.0, Request(Action.DOCK, 1, DockRequest(1, 2, 2, 3)))
    assert [(dock.module_a, dock.module_b) for dock in outputs.docks] == [(2, 1)]
    assert tank.when("dock of module 2 ended: another was asked for")
    assert tank.pipeline.formation.docking.relays.states[0] == [0] * 6
    assert outputs.records[1].mode == Mode.DOCK


@pytest.mark.slow
def test_magnets_of_every_face_that_will_meet_pull_in_a_dock_and_let_go_with_it() -> None:
    tank = FaultyTank(RING, each=2)
    for state, east in zip(tank.states, (0.0, 0.6), strict=True):
        state[:7] = [1.0, east, 0.8, *from_euler(0.0, 0.02, 0.0)]
    tank.run(2.0)
    tank.run(0.5, Request(Action.ARM, 0), Request(Action.ARM, 2))
    tank.run(0.03, Request(Action.DOCK, 2, DockRequest(2, 3, 0, 2)))
    while tank.outputs[-1].docks[0].stage != Stage.APPROACH:
        tank.run(0.01)
    states = tank.pipeline.formation.docking.relays.states
    assert [(state[2], state[3]) for state in states] == [(1, 0), (1, 0), (0, 1), (0, 1)]
    tank.run(0.02)
    pipelines = tank.pipeline.formation.pipelines
    assert not any(pipeline._is_free() for pipeline in pipelines), "no thruster is judged by a motion that magnets shape"
    tank.run(0.1, Request(Action.SET_MODE, 2, Mode.POSHOLD))
    assert [sum(state) for state in tank.pipeline.formation.docking.relays.states] == [1] * 4, "the pairs hold"
    assert all(pipeline._is_free() for pipeline in tank.pipeline.formation.pipelines)


WANTED = Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2))


def on_its_approach(delay: int = 0) -> FaultyTank:
    """Two modules, one of which docks to the other and is in its approach. `delay`: extra ticks that each plan takes."""
    tank = tank_with_row(0.6)
    tank._delay = delay
    tank.run(0.02 + 0.01 * delay, WANTED)
    while tank.outputs[-1].docks[0].stage != Stage.APPROACH:
        tank.run(0.01)
    tank.run(1.5)
    return tank


@pytest.mark.slow
def test_dock_that_is_asked_for_again_while_it_ends_begins_anew() -> None:
    tank = on_its_approach()
    tank.pipeline.formation.docking._docks[0].sequence.abort(0, "on purpose")
    outputs = tank.run(0.2, WANTED)
    assert [dock.stage for dock in outputs.docks] == [Stage.PRE_APPROACH] and outputs.records[1].mode == Mode.DOCK


@pytest.mark.slow
def test_robot_that_was_flown_away_from_a_dock_is_not_flung_back_when_it_is_told_to_dock_again() -> None:
    tank = on_its_approach(delay=50)
    outputs = tank.run(0.05, Request(Action.SET_MODE, 1, Mode.POSHOLD))
    assert outputs.docks == [] and tank.when("dock of module 2 ended")
    for _ in range(18):
        tank.run(0.1, Request(Action.STICKS, 1, Sticks((-1.0, 1.0, 0.0))))
    first = len(tank.outputs)
    outputs = tank.run(1.5, WANTED)
    places = np.array([outputs.records[1].setpoint.p_wb for outputs in tank.outputs[first - 1 :]])
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 0.006
    assert [dock.stage for dock in outputs.docks] == [Stage.PRE_APPROACH] and outputs.records[1].mode == Mode.DOCK


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 100])
def test_dock_whose_plan_is_still_awaited_when_the_one_before_is_over_begins_all_the_same(delay: int) -> None:
    tank = on_its_approach(delay)
    (dock,) = tank.pipeline.formation.docking._docks
    dock.sequence.abort(0, "on purpose")
    while dock.sequence._gap_m < 0.1:
        tank.run(0.01)
    outputs = tank.run(2.0, WANTED)
    assert len(outputs.docks) == 1 and outputs.records[1].mode == Mode.DOCK


@pytest.mark.slow
def test_dock_that_is_refused_leaves_the_one_under_way_alone() -> None:
    tank = tank_with_row(0.6)
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    outputs = tank.run(1.0, Request(Action.DOCK, 1, DockRequest(1, 2, 0, 3)))
    assert tank.when("dock refused: on its way")
    assert [(dock.face_a, dock.face_b) for dock in outputs.docks] == [(2, 3)] and outputs.records[1].mode == Mode.DOCK


def _pair_about_to_lock(mode: Mode) -> FaultyTank:
    """Two single bodies, the first in `mode`; the second has just arrived at its face."""
    tank = FaultyTank([(0, 0, 0), (0, 1, 0)], Parameters().replace("docking.push_m", 0.0).replace("steering.test_s", 0.1), apart=True)
    for state, side in zip(tank.states, (0.0, PITCH_M), strict=True):
        state[:7] = [1.0, side, 0.8, *from_euler(0.0, 0.02, 0.0)]
    tank.run(2.0)
    tank.run(0.5, Request(Action.ARM, 0), Request(Action.ARM, 1))
    tank.run(1.5, Request(Action.SET_MODE, 0, mode))
    tank.run(0.03, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    (dock,) = tank.pipeline.formation.docking._docks
    dock.sequence.stage, dock.sequence._gap_m = Stage.VERIFY, 0.0  # as if it had just arrived
    return tank


@pytest.mark.slow
def test_robot_that_docks_to_one_in_motor_detect_goes_on_holding() -> None:
    tank = _pair_about_to_lock(Mode.MOTOR_DETECT)
    record = tank.run(2.0).records[0]
    assert tank.shape == [(0, 1)] and (record.state, record.mode) == (State.ARMED, Mode.POSHOLD)


@pytest.mark.slow
@pytest.mark.parametrize(("current_ma", "holds"), [(60.0, True), (50.0, False)])
def test_joint_that_a_dock_has_closed_keeps_the_hysteresis_of_the_dock(current_ma: float, holds: bool) -> None:
    tank = _pair_about_to_lock(Mode.POSHOLD)
    while len(tank.shape) == 2:
        tank.run(0.01)
    tank.pull_ma = current_ma
    tank.run(2.0)
    assert any("a docked partner is lost" in words for _, words in tank.event_log) is not holds


@pytest.mark.slow
def test_joints_of_two_docks_that_close_in_one_tick_both_keep_the_hysteresis() -> None:
    tank = FaultyTank([(0, 0, 0), (0, 1, 0)] * 2, Parameters().replace("docking.push_m", 0.0), apart=True)
    for k, state in enumerate(tank.states):
        state[:7] = [1.0 + k // 2, k % 2 * PITCH_M, 0.8, *from_euler(0.0, 0.02, 0.0)]
    tank.run(2.0)
    tank.run(0.5, *(Request(Action.ARM, m) for m in range(4)))
    tank.run(0.03, *(Request(Action.DOCK, m, DockRequest(m, 3, m - 1, 2)) for m in (1, 3)))
    for dock in tank.pipeline.formation.docking._docks:
        dock.sequence.stage, dock.sequence._gap_m = Stage.VERIFY, 0.0  # as if it had just arrived
    while len(tank.shape) == 4:
        tank.run(0.01)
    assert tank.shape == [(0, 1), (2, 3)]
    tank.pull_ma = 60.0
    tank.run(2.0)
    assert not any("a docked partner is lost" in words for _, words in tank.event_log)


@pytest.mark.slow
@pytest.mark.parametrize("armed", [0, 1])
def test_robot_that_docks_to_one_that_is_disarmed_is_disarmed_and_says_so(armed: int) -> None:
    tank = FaultyTank([(0, 0, 0), (0, 1, 0)], Parameters().replace("docking.push_m", 0.0), apart=True)
    for state, side in zip(tank.states, (0.0, PITCH_M), strict=True):
        state[:7] = [1.0, side, 0.8, *from_euler(0.0, 0.02, 0.0)]
    tank.run(2.0)
    tank.run(0.5, *(Request(Action.ARM, m) for m in range(1 - armed, 2)))
    tank.run(0.03, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    (dock,) = tank.pipeline.formation.docking._docks
    dock.sequence.stage, dock.sequence._gap_m = Stage.VERIFY, 0.0  # as if it had just arrived
    outputs = tank.run(2.0)
    assert tank.shape == [(0, 1)] and outputs.records[0].state == (State.ARMED if armed else State.DISARMED)
    assert any("docked to a body that is not armed" in words for _, words in tank.event_log) is not bool(armed)


@pytest.mark.slow
def test_dock_in_whose_place_another_was_asked_for_before_it_was_planned_never_begins() -> None:
    tank = tank_with_row(0.6, 1.2)
    tank._delay = 50
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2, 0, True)))
    tank.run(0.1, Request(Action.SET_MODE, 1, Mode.POSHOLD))
    first = len(tank.outputs)
    outputs = tank.run(1.0, Request(Action.DOCK, 1, DockRequest(1, 2, 2, 3)))
    assert {(dock.module_a, dock.module_b) for each in tank.outputs[first:] for dock in each.docks} == {(2, 1)}
    assert tank.pipeline.formation.pipelines[0].guidance._goal is None, "nor does its target come"
    assert outputs.records[1].mode == Mode.DOCK and tank.when("dock refused: another was asked for")


@pytest.mark.slow
def test_dock_whose_plan_is_still_awaited_when_the_target_of_the_one_before_is_taken_apart_begins_all_the_same() -> None:
    tank = FaultyTank([(0, 0, 0), (0, 1, 0)] * 3, each=2, delay=50)
    for state, north, east in zip(tank.states, (1.0, 1.0, 3.0), (0.0, 2.4, 2.4), strict=True):
        state[:7] = [north, east, 0.8, *from_euler(0.0, 0.02, 0.0)]
    tank.run(2.0)
    tank.run(0.5, *(Request(Action.ARM, body) for body in (0, 2, 4)))
    tank.run(1.0, Request(Action.DOCK, 2, DockRequest(2, 3, 1, 2)))
    tank.run(1.2, Request(Action.UNDOCK, 0, DockRequest(1, 3, 0, 2)))
    outputs = tank.run(1.0, Request(Action.DOCK, 2, DockRequest(3, 0, 5, 1)))
    assert tank.shape == [(0,), (1,), (2, 3), (4, 5)] and tank.when(f"dock of module 3 ended: {CHANGED}")
    assert [(dock.module_a, dock.module_b) for dock in outputs.docks] == [(5, 3)] and outputs.records[2].mode == Mode.DOCK


@pytest.mark.slow
def test_refused_dock_does_not_end_the_one_that_was_asked_for_after_it() -> None:
    tank = FaultyTank([(0, 0, 0), (0, 1, 0)], apart=True, delay=20)
    tank.without_current = {0, 1}
    tank.states[1][1] = 0.6
    tank.run(2.0)
    tank.run(0.5, Request(Action.ARM, 0), Request(Action.ARM, 1))
    tank.run(0.1, Request(Action.DOCK, 1, DockRequest(1, 2, 0, 3)))  # through the target
    tank.run(0.15, Request(Action.DOCK, 1, DockRequest(1, 3, 0, 2)))
    outputs = tank.run(1.0)
    assert tank.when("dock refused") < tank.when("docking module 2 to module 1")
    assert outputs.records[1].mode == Mode.DOCK
