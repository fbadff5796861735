"""Whole ticks in a small simulated world: arm, hold and follow; fleets; and modelling mistakes that must show in the flight."""

from dataclasses import replace

import numpy as np
import pytest

from firmware_py.core.body import Body
from firmware_py.core.controller import LAWS, Controller
from firmware_py.core.failsafes import Level
from firmware_py.core.rotations import difference, exp, from_euler, multiply
from firmware_py.core.setpoint import rest_at
from firmware_py.core.types import Action, Estimate, Mode, ModuleInputs, Request, Setpoint
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble
from firmware_py.prepare.paths import line
from tests.unit.tanks import DT, PERIOD, START, Tank, has_power, single


@pytest.fixture
def tank() -> Tank:
    return Tank([single()])


# ---------------------------------------------------------------- one robot


def test_disarmed_robot_turns_nothing(tank: Tank) -> None:
    tank.run(1.0)
    assert not any(has_power(outputs) or outputs.modules[0].armed for outputs in tank.outputs)
    assert tank.outputs[-1].records[0].estimate.ready


def test_disarmed_robot_is_wanted_where_it_is(tank: Tank) -> None:
    """Nothing must jump when it arms."""
    record = tank.run(1.0).records[0]
    np.testing.assert_array_equal(record.setpoint.p_wb, record.estimate.p_wb)
    np.testing.assert_array_equal(record.setpoint.q_wb, record.estimate.q_wb)


def test_control_law_of_one_s_own_steers_and_keeps_doing_so_with_new_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a law was a yes or no of the paper's formula, and one with a formula of its own had no place."""

    class Heave(Controller):
        def step(self, now: Setpoint, ahead: Setpoint, estimate: Estimate) -> np.ndarray:
            return np.array([0.0, 0.0, 2.5, 0.0, 0.0, 0.0])

    monkeypatch.setitem(LAWS, "model", Heave)
    own = Tank([single()])
    own.run(1.0)
    for request in (Request(Action.ARM), Request(Action.SET_PARAMETER, argument=("control.position_bandwidth", 2.0))):
        own.run(DT, request)
        assert own.run(1.0).records[0].wrench[2] == 2.5


def test_robot_that_may_not_arm_says_why(tank: Tank) -> None:
    outputs = tank.run(DT, Request(Action.ARM))
    assert not outputs.modules[0].armed
    assert any(event.text.startswith("ARM refused: ") for event in outputs.events)


def test_robot_does_not_arm_before_every_stage_has_run_once(tank: Tank) -> None:
    cold = "compiled code is not warm yet"
    first, second = (tank.run(DT, Request(Action.ARM)) for _ in range(2))
    refused = [[event.text for event in outputs.events if event.text.startswith("ARM refused: ")] for outputs in (first, second)]
    assert [cold in text for texts in refused for text in texts] == [True, False]


def test_record_says_whether_arm_would_be_granted(tank: Tank) -> None:
    assert not tank.run(DT).records[0].may_arm, "it has seen nothing yet"
    assert tank.run(0.5).records[0].may_arm
    assert not tank.run(DT, estop=True).records[0].may_arm, "not for one tick more"
    tank.run(1.0)
    assert tank.run(0.2, Request(Action.CLEAR_ESTOP)).records[0].may_arm
    armed = tank.run(DT, Request(Action.ARM))
    assert armed.modules[0].armed
    assert not armed.records[0].may_arm


def test_record_says_what_a_fail_safe_has_made_of_the_mode(tank: Tank) -> None:
    tank.run(0.5)
    assert tank.run(DT, Request(Action.ARM)).records[0].level == Level.NONE
    hot = [Request(Action.SET_PARAMETER, 0, (f"failsafes.cabin_hot_{name}", 0.0)) for name in ("limit", "delay_s")]
    surfacing = tank.run(3 * DT, *hot).records[0]
    assert (surfacing.mode, surfacing.level) == (Mode.SURFACE, Level.SURFACE)


@pytest.mark.slow
def test_armed_robot_holds_the_place_where_it_armed(tank: Tank) -> None:
    tank.run(0.5)
    armed = tank.run(DT, Request(Action.ARM))
    assert armed.modules[0].armed
    here = tank.states[0].copy()
    tank.run(5.0)
    np.testing.assert_allclose(tank.states[0][:3], here[:3], atol=2e-3)
    assert np.linalg.norm(difference(tank.states[0][3:7].copy(), here[3:7].copy())) < 0.01
    assert np.abs(tank.states[0][7:13]).max() < 5e-3


@pytest.mark.slow
def test_robot_follows_a_path_to_its_end(tank: Tank) -> None:
    tank.run(0.5)
    tank.run(0.5, Request(Action.ARM))
    x = tank.states[0]
    goal = rest_at(x[:3] + np.array([0.4, -0.3, 0.2]), from_euler(0.0, 0.5, 1.5))
    path = line(rest_at(x[:3], x[3:7]), goal, 5.0)
    tank.run(7.0, Request(Action.TRACK, 0, path))
    first = len(tank.outputs) - 700
    errors = [
        np.linalg.norm(tank.past[k][0][:3] - path.sample((k - first) * DT).p_wb) for k in range(first, len(tank.past))
    ]
    assert max(errors) < 0.01
    np.testing.assert_allclose(tank.states[0][:3], goal.p_wb, atol=2e-3)
    assert np.linalg.norm(difference(tank.states[0][3:7].copy(), goal.q_wb)) < 0.01


def test_estimate_is_the_truth_where_the_world_is_the_model(tank: Tank) -> None:
    tank.run(0.5)
    tank.run(3.0, Request(Action.ARM))
    estimate = tank.outputs[-1].records[0].estimate
    np.testing.assert_allclose(estimate.p_wb, tank.states[0][:3], atol=1e-3)
    np.testing.assert_allclose(difference(estimate.q_wb, tank.states[0][3:7].copy()), 0.0, atol=2e-3)
    assert np.abs(estimate.force_w).max() < 0.1 and estimate.rejected == 0


def test_force_that_the_limiter_took_is_not_believed_in() -> None:
    """With thrusters limited to a tenth of their force, the missing force must not be estimated as a current."""
    tank = Tank([single()], Parameters().replace("limiter.force_share", 0.1))
    tank.run(0.5)
    tank.run(0.3, Request(Action.ARM))
    tank.run(2.0, Request(Action.HOLD, 0, rest_at(tank.states[0][:3] + np.array([1.0, 0.0, 0.0]), START)))
    record = tank.outputs[-1].records[0]
    assert np.linalg.norm(record.wrench[:3]) > 5.0 > 4.0 > np.linalg.norm(record.thrust.achieved[:3])
    assert np.linalg.norm(record.estimate.force_w) < 0.5


def test_same_inputs_give_the_same_bytes() -> None:
    flown = []
    for _ in range(2):
        tank = Tank([single()])
        tank.run(0.5)
        tank.run(0.5, Request(Action.ARM))
        flown.append(b"".join(o.modules[0].thrusters.tobytes() + repr(o.records).encode() for o in tank.outputs))
    assert flown[0] == flown[1]


def test_outputs_name_their_tick(tank: Tank) -> None:
    outputs = tank.run(0.1)
    assert (outputs.tick, outputs.time_ns) == (9, 9 * PERIOD)
    assert len(outputs.modules) == len(outputs.records) == 1


def test_sagging_battery_raises_the_commands(tank: Tank) -> None:
    """At 10 V the same force takes more of the full command."""
    tank.run(0.5)
    tank.run(1.0, Request(Action.ARM))
    at_12 = np.abs(tank.outputs[-1].modules[0].thrusters).mean()
    hear = tank._hear

    def sagging(tick: int) -> list[ModuleInputs]:
        modules = hear(tick)
        modules[0].voltage_v = 10.0
        return modules

    tank._hear = sagging  # type: ignore[method-assign]
    tank.run(1.0)
    assert np.abs(tank.outputs[-1].modules[0].thrusters).mean() > 1.05 * at_12


def test_battery_reading_of_nothing_changes_no_command(tank: Tank) -> None:
    """Neither at once nor through the smoothed voltage."""
    tank.run(0.5)
    tank.run(1.0, Request(Action.ARM))
    before = tank.pipeline.formation.pipelines[0].supply.voltage_v.copy()
    hear = tank._hear

    def broken(tick: int) -> list[ModuleInputs]:
        modules = hear(tick)
        modules[0].voltage_v = 0.0 if tick % 10 else float("nan")
        return modules

    tank._hear = broken  # type: ignore[method-assign]
    tank.run(0.3)
    np.testing.assert_array_equal(tank.pipeline.formation.pipelines[0].supply.voltage_v, before)


# ---------------------------------------------------------------- fleets


@pytest.mark.slow
def test_each_body_obeys_its_own_requests() -> None:
    tank = Tank([single(0), single(1)])
    tank.run(0.5)
    outputs = tank.run(0.5, Request(Action.ARM, 1))
    assert [module.armed for module in outputs.modules] == [False, True]
    assert [has_power(outputs, m) for m in (0, 1)] == [False, True]
    assert [record.body for record in outputs.records] == [0, 1]
    tank.run(3.0)
    np.testing.assert_allclose(tank.states[1][:3], tank.past[50][1][:3], atol=5e-3)


def test_what_is_said_names_the_body_that_it_is_about() -> None:
    tank = Tank([single(0), single(1)])
    refused = tank.run(DT, Request(Action.ARM, 1), Request(Action.SET_MODE, 0, 19.5))
    assert {(event.text.split(":")[0], event.body) for event in refused.events} >= {("ARM refused", 1), ("SET_MODE refused", 0)}


@pytest.mark.slow
@pytest.mark.parametrize("modules", [[0, 1, 2], [2, 0, 1]])
def test_docked_shape_holds_its_place_however_its_modules_sit_and_count(modules: list[int]) -> None:
    """The three modules of the L are rotated differently: mixed-up frames, levers or commands would throw it off its place."""
    shape = assemble([(0, 0, 0), (1, 0, 0), (1, 1, 0)], [0, 4, 12], [load_vehicle("modcube")] * 3, modules)
    tank = Tank([shape])
    tank.run(0.5)
    outputs = tank.run(DT, Request(Action.ARM, modules[0]))
    assert all(module.armed for module in outputs.modules)
    here = tank.states[0].copy()
    tank.run(4.0)
    np.testing.assert_allclose(tank.states[0][:3], here[:3], atol=4e-3)
    assert np.linalg.norm(difference(tank.states[0][3:7].copy(), here[3:7].copy())) < 0.02


# ---------------------------------------------------------------- mistakes that have to show


def spoilt(body: Body, mistake: str) -> Body:
    """The body that a wrong vehicle file or a sign error in prepare would produce."""
    t = body.thrusters
    if mistake == "tag lever 3 cm off":
        return replace(body, r_bt=body.r_bt + np.array([0.0, 0.03, 0.0]))
    if mistake == "tag turned by 5 degrees":
        turn = exp(np.array([np.deg2rad(5.0), 0.0, 0.0]))
        return replace(body, q_bt=np.array([multiply(np.ascontiguousarray(q), turn) for q in body.q_bt]))
    if mistake == "two thrusters swapped":
        channel = t.channel.copy()
        channel[[0, 2]] = channel[[2, 0]]
        return replace(body, thrusters=replace(t, channel=channel))
    matrix = t.matrix * np.where(np.arange(8) == 4, -1.0, 1.0)
    return replace(body, thrusters=replace(t, matrix=matrix, pinv=np.linalg.pinv(matrix)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "mistake", ["tag lever 3 cm off", "tag turned by 5 degrees", "two thrusters swapped", "one thruster the wrong way"]
)
def test_mistake_in_the_body_shows_in_the_flight(mistake: str) -> None:
    """The bounds of the tests above are tight enough to fail for each of these."""
    body = single()
    tank = Tank([body], believed=[spoilt(body, mistake)])
    tank.run(0.5)
    tank.run(0.5, Request(Action.ARM))
    goal = rest_at(np.array([1.0, 0.0, 0.8]), START)
    tank.run(4.0, Request(Action.HOLD, 0, goal))
    off = np.linalg.norm(tank.states[0][:3] - goal.p_wb)
    turned = np.linalg.norm(difference(tank.states[0][3:7].copy(), goal.q_wb))
    assert off > 0.004 or turned > 0.02
