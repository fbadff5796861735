"""Undocks on request: two at once, one under way, ended ones, and corners of a ring."""

from dataclasses import replace

import numpy as np
import pytest

from firmware_py.core.docking_decisions import Decisions, Join
from firmware_py.core.rotations import difference, rotate
from firmware_py.core.transitions import State
from firmware_py.core.types import RELAY_PUSH, Action, DockRequest, Mode, ModuleInputs, Request
from firmware_py.core.undocking import IN_PLACE, PULLED
from firmware_py.description.parameters import Parameters
from firmware_py.prepare.assembly import PITCH_M
from tests.unit.tanks import RING, FaultyTank, world

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("stop", ["e-stop", "DISARM", "mode"])
def test_undock_ends_with_its_mode_and_the_joint_holds(stop: str) -> None:
    tank = FaultyTank(RING[:2])
    tank.fly()
    tank.run(0.1, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert any(2 in states for states in tank.pipeline.formation.docking.relays.states), "magnets push"
    request = Request(Action.SET_MODE, 0, Mode.POSHOLD) if stop == "mode" else Request(Action.DISARM, 0)
    tank.run(0.02, *([] if stop == "e-stop" else [request]), estop=stop == "e-stop")
    outputs = tank.run(3.0)
    assert tank.shape == [(0, 1)] and tank.when("undock of module 2 ended")
    assert [max(states) for states in tank.pipeline.formation.docking.relays.states] == [1, 1], "and pull again"
    assert outputs.records[0].mode == Mode.POSHOLD


def test_pieces_of_an_undock_hold_the_attitude_that_the_body_was_to_hold() -> None:
    """Regression: each held the attitude that it had then. After six docks and undocks a module leant over by ten degrees."""
    tank = FaultyTank(RING[:2])
    tank.fly()
    tank.run(1.0, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    held = tank.outputs[-1].records[0].setpoint.q_wb
    tank.states[0][11] += 0.5  # something turns it meanwhile, rad/s
    while len(tank.shape) == 1:
        outputs = tank.run(0.01)
    for record in outputs.records:
        assert np.linalg.norm(difference(record.estimate.q_wb, held)) > 0.01
    for record in tank.run(8.0).records:
        assert record.setpoint.q_wb == pytest.approx(held, abs=1e-3)


def test_second_of_two_undocks_of_one_body_in_one_tick_is_ended_and_its_joint_holds() -> None:
    tank = FaultyTank([(0, 0, 0), (1, 0, 0), (2, 0, 0)])
    tank.fly()
    tank.run(3.0, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)), Request(Action.UNDOCK, 0, DockRequest(2, 1, 1, 0)))
    assert tank.shape == [(0,), (1, 2)]
    assert not any("is undocked from 1" in text for _, text in tank.event_log)
    assert tank.when("undock of module 3 ended")
    assert tank.pipeline.formation.docking.relays.states == [[0] * 6, [1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0]]


@pytest.mark.parametrize(("body", "refused"), [(0, DockRequest(2, 1, 0, 0)), (0, DockRequest(1, 0, 3, 1))], ids=["undock", "dock"])
def test_undock_under_way_goes_on_when_what_is_asked_for_meanwhile_is_refused(body: int, refused: DockRequest) -> None:
    tank = FaultyTank([(0, 0, 0), (1, 0, 0), (2, 0, 0), (4, 0, 0)], each=3)
    tank.fly()
    tank.run(0.3, Request(Action.UNDOCK, body, DockRequest(2, 1, 1, 0)))
    tank.run(2.0, Request(Action.UNDOCK if refused.target_module < 3 else Action.DOCK, body, refused))
    assert tank.when("dock refused")
    assert tank.shape == [(0, 1), (2,), (3,)]


def test_undock_that_was_called_off_before_its_plan_came_does_not_part_a_body_that_is_to_dock() -> None:
    """Regression: the plan of the undock found the body in DOCK, where it waited for that of the dock."""
    tank = FaultyTank([(0, 0, 0), (1, 0, 0), (4, 0, 0)], each=2, delay=50)
    tank.fly()
    for action, wanted in ((Action.UNDOCK, DockRequest(1, 1, 0, 0)), (Action.HOLD, None), (Action.DOCK, DockRequest(1, 0, 2, 1))):
        tank.run(0.1, Request(action, 0, wanted))
    tank.run(2.0)
    assert tank.when("undock refused: another was asked for") < tank.when("docking module 2 to module 3")
    assert tank.shape == [(0, 1), (2,)]


def test_module_that_has_just_been_undocked_may_dock_again_at_once() -> None:
    """Regression: the dock was given up, because two bodies that have just parted need a few pictures to know their places again."""
    tank = FaultyTank([(0, 0, 0), (1, 0, 0)])
    tank.fly()
    tank.run(0.01, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    while len(tank.shape) == 1:
        tank.run(0.01)
    outputs = tank.run(1.5, Request(Action.DOCK, 1, DockRequest(1, 1, 0, 0)))
    assert outputs.records[1].mode == Mode.DOCK and len(outputs.docks) == 1
    assert not any("ABORTED" in text for _, text in tank.event_log)


@pytest.mark.parametrize(("ahead", "behind", "glides"), [(False, False, 1), (True, False, 0), (False, True, 1), (True, True, None)])
def test_what_is_undocked_glides_to_no_third_body(ahead: bool, behind: bool, glides: int | None) -> None:
    """When a chain of three was taken apart, the middle one once glided away from the last and pressed against the first."""
    tank = FaultyTank([(0, 0, 0), (1, 0, 0)] * 3, each=2)
    standoff_m = Parameters().docking.standoff_m
    along_w = world(tank.states[0]).apply([2.0 * PITCH_M + standoff_m, 0.0, 0.0])
    for n, is_there, way in (1, ahead, 1.0), (2, behind, -1.0):
        tank.states[n][:3] = tank.states[0][:3] + way * (along_w if is_there else 3.0 * along_w)
    tank.run(0.5)
    records = tank.run(1.0, *(Request(Action.ARM, body.index) for body in tank.bodies)).records
    assert [record.state for record in records] == [State.ARMED] * 3
    half_w = rotate(records[0].setpoint.q_wb, np.array([0.5 * PITCH_M, 0.0, 0.0]))
    held = [records[0].setpoint.p_wb - half_w, records[0].setpoint.p_wb + half_w]
    tank.run(4.0, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert tank.shape == [(0,), (1,), (2, 3), (4, 5)]
    holds = [pipeline.guidance._held().p_wb for pipeline in tank.pipeline.formation.pipelines[:2]]
    gone_m = np.linalg.norm(np.array(holds) - held, axis=1)
    assert gone_m == pytest.approx([standoff_m * (module == glides) for module in (0, 1)], abs=0.01)


@pytest.mark.slow
def test_corner_of_a_ring_is_undocked_by_both_its_joints_and_leaves_across() -> None:
    tank = FaultyTank(RING)
    tank.fly()
    tank.run(0.5, Request(Action.UNDOCK, 0, DockRequest(3, 1, 2, 0)))
    assert [sum(state == 2 for state in states) for states in tank.pipeline.formation.docking.relays.states] == [0, 1, 1, 2]
    outputs = tank.run(5.0)
    assert tank.shape == [(0, 1, 2), (3,)]
    rest, corner = (pipeline.guidance._glider.at.p_wb for pipeline in tank.pipeline.formation.pipelines)
    assert outputs.records[1].mode == Mode.POSHOLD and np.linalg.norm(corner - rest) > 0.3
    assert [max(states) for states in tank.pipeline.formation.docking.relays.states] == [1, 1, 1, 0]


@pytest.mark.parametrize("hung", [{2, 3}, {1, 3}, {2}, {3}], ids=str)
def test_corner_of_a_ring_stays_where_the_relays_of_a_joint_hang(hung: set[int]) -> None:
    """Funnels hold back a module that leaves diagonally, so pictures prove nothing; but currents of a held joint do not change sign."""
    tank = FaultyTank(RING)
    tank.fly()
    tank.always_pulling, tank.stuck = hung, True
    outputs = tank.run(2.5, Request(Action.UNDOCK, 0, DockRequest(3, 1, 2, 0)))
    if len(hung) == 1:  # the other magnet pushes as hard as this one pulls
        assert tank.shape == [(0, 1, 2), (3,)]
        return
    pushed_s = tank.when(f"undock of module 4 ended: {PULLED}") - tank.when("undocking module 4")
    assert pushed_s == pytest.approx(2.0 * Parameters().docking.release_s, abs=0.02) and tank.shape == [(0, 1, 2, 3)]
    assert outputs.records[0].mode == Mode.POSHOLD
    assert [sum(states) for states in tank.pipeline.formation.docking.relays.states] == [2] * 4, "and all pull again"


def test_corner_of_a_ring_whose_hanging_relays_have_nothing_before_them_any_more_is_undocked() -> None:
    """Their currents keep their sign but are as low as those of idle coils. So are all others, hence the fail-safe is switched off."""
    tank = FaultyTank(RING, Parameters().replace("failsafes.partner_lost_action", 0))
    tank.fly()
    tank.always_pulling, tank.stuck, tank.pull_ma = {2, 3}, True, 40.0
    tank.run(2.5, Request(Action.UNDOCK, 0, DockRequest(3, 1, 2, 0)))
    assert tank.shape == [(0, 1, 2), (3,)]


@pytest.mark.parametrize("hung", [set(), {0, 1}], ids=str)
def test_module_out_of_sight_is_undocked_unless_its_magnets_go_on_pulling(hung: set[int]) -> None:
    tank = FaultyTank(RING[:2])
    tank.fly()
    tank.hidden, tank.always_pulling = {1}, hung
    tank.run(2.5, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert tank.shape == ([(0, 1)] if hung else [(0,), (1,)])
    pushed_s = (tank.when("undock of module 2 ended") if hung else tank.when("module 2 is undocked")) - tank.when("undocking module 2")
    assert pushed_s == pytest.approx((2.0 if hung else 1.0) * Parameters().docking.release_s, abs=0.02)


@pytest.mark.parametrize("hung", [set(), {2, 3}], ids=str)
def test_push_shorter_than_currents_need_tells_a_corner_that_leaves_from_one_that_hanging_relays_hold(hung: set[int]) -> None:
    tank = FaultyTank(RING, Parameters().replace("docking.release_s", 0.01))
    tank.fly()
    tank.always_pulling, tank.stuck = hung, True
    tank.run(1.0, Request(Action.UNDOCK, 0, DockRequest(3, 1, 2, 0)))
    assert tank.shape == ([(0, 1, 2, 3)] if hung else [(0, 1, 2), (3,)])


@pytest.mark.parametrize("stuck", [False, True])
def test_push_shorter_than_pictures_need_tells_a_module_that_leaves_from_one_that_is_jammed(stuck: bool) -> None:
    """For a single joint, a picture proves more than currents and is waited for: a jammed module stays although both magnets push."""
    tank = FaultyTank(RING[:2], Parameters().replace("docking.release_s", 0.01))
    tank.fly()
    tank.stuck = stuck
    tank.run(1.0, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert tank.shape == ([(0, 1)] if stuck else [(0,), (1,)])
    assert any(IN_PLACE in said for _, said in tank.event_log) == stuck


def test_corner_whose_currents_do_not_come_is_undocked_in_the_end() -> None:
    tank = FaultyTank(RING, Parameters().replace("docking.release_s", 0.01))
    tank.fly()
    hear, tank.stuck = tank._hear, True

    def hear_no_current(tick: int) -> list[ModuleInputs]:
        return [replace(module, docks=[]) for module in hear(tick)]

    tank._hear = hear_no_current  # type: ignore[method-assign]
    tank.run(1.0, Request(Action.UNDOCK, 0, DockRequest(3, 1, 2, 0)))
    assert tank.shape == [(0, 1, 2), (3,)]


def test_magnets_that_push_one_body_apart_push_on_while_another_parts() -> None:
    tank = FaultyTank([(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)], each=2)
    tank.fly()
    tank.run(0.5, Request(Action.ARM, 2))
    tank.run(0.3, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    tank.run(0.05, Request(Action.UNDOCK, 2, DockRequest(3, 1, 2, 0)))
    while (2, 3) in tank.shape:
        assert tank.pipeline.formation.docking.relays.states[2][0] == RELAY_PUSH
        tank.run(0.01)
    assert tank.when("module 2 is undocked") < tank.when("module 4 is undocked")


def test_two_corners_of_a_ring_undocked_at_once_leave_no_magnet_on_between_them() -> None:
    """The first undock ends the second, having opened one of its two joints: magnets left on there would pull module 3 back."""
    tank = FaultyTank(RING)
    tank.fly()
    tank.run(3.0, Request(Action.UNDOCK, 0, DockRequest(3, 1, 2, 0)), Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert tank.shape == [(0, 1, 2), (3,)] and tank.when("undock of module 2 ended")
    assert tank.pipeline.formation.docking.relays.states == [[1, 0, 1, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0] * 6]


def test_undock_that_ends_in_the_tick_of_a_join_is_not_said_to_be_done() -> None:
    tank = FaultyTank([(0, 0, 0), (0, 1, 0), (0, 2, 0)], Parameters().replace("docking.push_m", 0.0))
    tank.fly()
    stage = tank.pipeline.formation.docking
    tank.run(0.1, Request(Action.UNDOCK, 0, DockRequest(1, 3, 0, 2)))
    (undock,) = stage._undocks
    decisions = Decisions({}, [Join(0, 7, None)], [], [], {}, [])
    estimates = {0: (tank.pipeline.bodies[0], tank.outputs[-1].records[0].estimate)}
    stage._release(undock, undock.until_ns, estimates, decisions)
    assert decisions.parts == [] and stage._undocks == [undock]
    assert not any("is undocked" in event.text for event in stage.events)
