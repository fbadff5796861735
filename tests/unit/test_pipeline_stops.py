"""Whole ticks of robots that are stopped, or whose thrusters are tested: which thrusters turn and which do not."""

import numpy as np
import pytest

from firmware_py.core.pipeline import Pipeline
from firmware_py.core.transitions import State
from firmware_py.core.types import INFORMATION, WARNING, Action, Event, Mode, ModuleInputs, Request
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle
from tests.unit.module_at_rest import PERIOD_NS, resting
from tests.unit.tanks import DT, Tank, has_power, single


@pytest.fixture
def tank() -> Tank:
    return Tank([single()])


@pytest.mark.parametrize("stop", ["frame", "request", "disarm"])
def test_stopped_robot_turns_nothing_from_this_very_tick_on(tank: Tank, stop: str) -> None:
    tank.run(0.5)
    tank.run(0.5, Request(Action.ARM))
    assert has_power(tank.outputs[-1])
    request = {"request": [Request(Action.ESTOP)], "disarm": [Request(Action.DISARM)]}.get(stop, [])
    count = len(tank.outputs)
    tank.run(0.5, *request, estop=stop == "frame")
    assert not any(has_power(outputs) or outputs.modules[0].armed for outputs in tank.outputs[count:])


def test_stopped_robot_can_be_cleared_and_armed_again(tank: Tank) -> None:
    tank.run(0.5)
    tank.run(0.5, Request(Action.ARM))
    tank.run(1.0, Request(Action.ESTOP))
    assert not tank.run(DT, Request(Action.ARM)).modules[0].armed, "not before it is cleared"
    tank.run(0.19, Request(Action.CLEAR_ESTOP))
    assert not tank.run(DT, Request(Action.ARM)).modules[0].armed, "not before the modules let go"
    assert tank.run(DT, Request(Action.ARM)).modules[0].armed


def test_robot_stops_when_a_module_says_that_an_e_stop_holds_it_and_is_armed_once_it_has_let_go(tank: Tank) -> None:
    """The ESTOP frame itself was lost on its way to the firmware."""
    hear, says = tank._hear, [2]

    def heard(tick: int) -> list[ModuleInputs]:
        modules = hear(tick)
        modules[0].mcu_state = says[0] if tick % 10 == 0 else None
        return modules

    tank._hear = heard  # type: ignore[method-assign]
    tank.run(0.5)
    assert tank.run(0.5, Request(Action.ARM)).modules[0].armed
    says[0] = 4
    assert tank.run(0.1).records[0].state == State.ESTOP
    tank.run(0.3)
    tank.run(0.3, Request(Action.CLEAR_ESTOP))
    assert tank.run(DT, Request(Action.ARM, 0, True)).records[0].state == State.DISARMED
    says[0] = 1
    tank.run(0.1)
    assert tank.run(DT, Request(Action.ARM)).modules[0].armed


@pytest.mark.slow
def test_motor_test_of_a_disarmed_robot_turns_one_thruster_and_disarms(tank: Tank) -> None:
    tank.run(1.0)
    first = len(tank.outputs)
    tank.run(3.0, Request(Action.MOTOR_TEST, 0, (2, 0.2, 2.0)))
    turned = np.array([outputs.modules[0].thrusters for outputs in tank.outputs[first:]])
    assert 195 <= np.count_nonzero(turned[:, 2]) <= 205 and not np.delete(turned, 2, axis=1).any()
    assert tank.outputs[-1].records[0].state == State.DISARMED


@pytest.mark.slow
def test_motor_detection_turns_one_thruster_after_the_other_with_pauses_between(tank: Tank) -> None:
    p, first = tank.pipeline.parameters.steering, len(tank.outputs)
    tank.run(1.0, Request(Action.SET_MODE, 0, Mode.MOTOR_DETECT))
    tank.run(8 * 1.5 * p.test_s + 1.0, Request(Action.ARM))
    commanded = np.array([outputs.modules[0].thrusters for outputs in tank.outputs[first:]])
    turned = commanded != 0.0
    assert turned.sum(axis=1).max() == 1 and not turned[-1].any()
    begins = np.flatnonzero(np.diff(turned.any(axis=1).astype(int)) == 1) + 1
    assert [int(turned[tick].argmax()) for tick in begins] == list(range(8))
    np.testing.assert_allclose(turned.sum(axis=0) * DT, p.test_s, atol=2 * DT)
    np.testing.assert_allclose(np.diff(begins) * DT, 1.5 * p.test_s, atol=2 * DT)
    assert (commanded[begins, np.arange(8)] > 0.0).all(), "forward first"
    np.testing.assert_allclose((commanded < 0.0).sum(axis=0) * DT, 0.5 * p.test_s, atol=2 * DT)
    force = np.array([outputs.records[0].thrust.force_n for outputs in tank.outputs[first:]])
    rate = np.cumsum(force, axis=0) * DT  # speed of a unit mass
    np.testing.assert_allclose(rate[-1], 0.0, atol=2.0 * DT * np.abs(force).max())
    np.testing.assert_allclose(rate.sum(axis=0) * DT, 0.0, atol=4.0 * DT * p.test_s * np.abs(force).max())  # it is back at its start


@pytest.mark.parametrize("share", [0.1, -0.1, 1.0, -1.0])
def test_tested_thruster_gives_the_wanted_share_of_its_side_and_never_more_than_it_may(tank: Tank, share: float) -> None:
    tank.run(1.0)
    record = tank.run(0.3, Request(Action.MOTOR_TEST, 0, (2, share, 2.0))).records[0]
    t, most = tank.bodies[0].thrusters, tank.pipeline.parameters.steering.test_share
    force = np.zeros(8)
    force[2] = np.clip(share, -most, most) * (t.f_max[2] if share > 0.0 else -t.f_min[2])
    np.testing.assert_allclose(record.thrust.force_n, force, atol=1e-9)


@pytest.mark.slow
def test_robot_that_lost_an_axis_trusts_its_thrusters_again_once_it_is_disarmed(tank: Tank) -> None:
    """A thruster that no longer turns is found again within half a second of flight."""
    tank.run(0.5)
    tank.run(0.5, Request(Action.ARM))
    pipeline = tank.pipeline.formation.pipelines[0]
    for thruster in (4, 7):
        pipeline.faults._lose(thruster, "stands still")
    pipeline.allocator.set_alive(pipeline.faults.now.alive)
    assert tank.run(0.1).records[0].state == State.ARMED and pipeline.health.now.lost_axes == 1
    tank.run(0.1, Request(Action.DISARM))
    assert pipeline.faults.now.dead == () and tank.run(3.0, Request(Action.ARM)).records[0].state == State.ARMED
    assert tank.outputs[-1].modules[0].thrusters.all(), "and they are used again"


@pytest.mark.slow
def test_warning_of_a_lost_thruster_ends_in_flight_once_the_thruster_is_acquitted(tank: Tank) -> None:
    """It stayed on until the robot was disarmed, although every thruster was in use again."""
    tank.run(0.5)
    tank.run(0.5, Request(Action.ARM))
    pipeline = tank.pipeline.formation.pipelines[0]
    pipeline.faults._lose(3, "does not push as it says")
    tank.run(5.0)
    assert pipeline.supervisor.is_on("thruster_lost")
    pipeline.faults._use_again(3, "the robot is pushed as much without it")
    tank.run(1.9)
    assert pipeline.supervisor.is_on("thruster_lost")
    tank.run(0.2)
    said = [event for outputs in tank.outputs for event in outputs.events if "thruster" in event.text]
    assert said == [Event(WARNING, "fail-safe on: a thruster is out", 0), Event(INFORMATION, "fail-safe over: a thruster is out", 0)]
    assert pipeline.supervisor.armed and not pipeline.supervisor.is_on("thruster_lost")


@pytest.mark.slow
@pytest.mark.parametrize(("gap_s", "is_armed"), [(0.05, True), (0.5, True), (1.99, True), (2.02, False), (5.0, False), (86_400.0, False)])
def test_robot_whose_process_was_stopped_comes_back_disarmed(gap_s: float, is_armed: bool) -> None:
    """By SIGSTOP, or with its computer. Every module answers the first tick after that: nothing else tells of the time that is missing."""
    pipeline = Pipeline([assemble_vehicle(load_vehicle("modcube"))], Parameters(), PERIOD_NS)
    for tick in range(1, 160):
        pipeline.step(resting(tick, [Request(Action.ARM, 0, True)] if tick == 100 else []))
    back = 160 + round(gap_s / DT)
    again = [pipeline.step(resting(tick, [Request(Action.ARM, 0, True)] if tick == back else [])) for tick in range(back, back + 100)]
    assert {outputs.records[0].state for outputs in again} == {State.ARMED if is_armed else State.DISARMED}
    assert any(has_power(outputs) for outputs in again) == is_armed
    assert any("bus silent for" in event.text for event in again[0].events) == (not is_armed)


def test_e_stop_that_only_the_module_of_one_body_has_heard_stops_every_body() -> None:
    """It was pressed on one of two buses while the firmware did not hear that bus."""
    tank = Tank([single(0), single(1)])
    hear, says = tank._hear, [2]

    def heard(tick: int) -> list[ModuleInputs]:
        modules = hear(tick)
        modules[0].mcu_state = says[0]
        return modules

    tank._hear = heard  # type: ignore[method-assign]
    tank.run(0.5)
    assert all(command.armed for command in tank.run(0.5, Request(Action.ARM, 0), Request(Action.ARM, 1)).modules)
    says[0] = 4
    assert [record.state for record in tank.run(DT).records] == [State.ESTOP] * 2
