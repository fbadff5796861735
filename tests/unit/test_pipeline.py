"""The whole tick in a small world: arm, hold, follow, stop; whole fleets; and mistakes that have to show."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.core import propagation
from firmware_py.core.body import Body
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.propagation import STATES
from firmware_py.core.rotations import difference, exp, from_euler, multiply
from firmware_py.core.transitions import State
from firmware_py.core.types import Action, EscFeedback, Inputs, Mode, ModuleInputs, Outputs, Request, TagObservation
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import load_vehicle
from firmware_py.description.water import WATER_DENSITY
from firmware_py.prepare.assembly import assemble
from firmware_py.prepare.paths import at_rest, line

PERIOD = 10_000_000
DT = 0.01
START = from_euler(0.1, -0.15, 0.4)
TAG_DELAY_TICKS = 4
TOP_FACE = 5


class Tank:
    """A world of the controller's own model: bodies with lagging thrusters, exact sensors, late tags on the top faces.

    What tick k commands acts from SYNC k + 1 on.
    """

    def __init__(self, bodies: list[Body], parameters: Parameters | None = None, believed: list[Body] | None = None):
        self.bodies = bodies
        self.pipeline = Pipeline(believed or bodies, parameters or Parameters(), PERIOD)
        self.states = [self._start(n) for n in range(len(bodies))]
        self.forces = [np.zeros(b.thrusters.f_max.size) for b in bodies]
        self.acting = [np.zeros((len(b.modules), 8)) for b in bodies]
        self.waiting = [a.copy() for a in self.acting]
        self.wrenches = [np.zeros(6) for _ in bodies]
        self.past: list[list[np.ndarray]] = []
        self.outputs: list[Outputs] = []

    @staticmethod
    def _start(number: int) -> np.ndarray:
        x = np.zeros(STATES)
        x[:3], x[3:7] = [1.0, 2.0 * number, 0.8], START
        return x

    def run(self, seconds: float, *requests: Request, estop: bool = False) -> Outputs:
        """Ticks for `seconds`; requests and e-stop enter the first of them."""
        for n in range(round(seconds / DT)):
            self._tick(list(requests) if n == 0 else [], estop and n == 0)
        return self.outputs[-1]

    def _tick(self, requests: list[Request], estop: bool) -> None:
        tick = len(self.outputs)
        if tick:
            for n in range(len(self.bodies)):
                self._move(n)
        self.past.append([x.copy() for x in self.states])
        inputs = Inputs(tick, tick * PERIOD, self._hear(tick), requests, estop=estop)
        self.outputs.append(self.pipeline.step(inputs))
        for n, body in enumerate(self.bodies):
            self.acting[n] = self.waiting[n]
            self.waiting[n] = np.array([self.outputs[-1].modules[m].thrusters for m in body.modules])

    def _move(self, n: int) -> None:
        t = self.bodies[n].thrusters
        u = self.acting[n][t.module, t.channel]
        curves = np.where(u[:, None] >= 0.0, t.forward, t.reverse)
        wanted = np.copysign([np.polyval(np.r_[c[::-1], 0.0], abs(v)) for c, v in zip(curves, u, strict=True)], u)
        end = wanted + (self.forces[n] - wanted) * np.exp(-DT / t.lag_s)
        self.wrenches[n] = t.matrix @ (wanted + (self.forces[n] - end) * t.lag_s / DT)
        self.forces[n] = end
        self.states[n] = propagation.step(self.states[n], self.wrenches[n], DT, *plant(self.bodies[n]))

    def _hear(self, tick: int) -> list[ModuleInputs]:
        modules = [ModuleInputs(answered=True, heard=True) for body in self.bodies for _ in body.modules]
        for n, body in enumerate(self.bodies):
            x = self.states[n]
            felt = propagation.inertial_acceleration(x, self.wrenches[n], *plant(body))
            felt = felt + world(x).inv().apply([0.0, 0.0, -9.80665])
            for k, m in enumerate(body.modules):
                r_mb = Rotation.from_quat(body.q_bm[k][[1, 2, 3, 0]]).inv()
                heard = modules[m]
                heard.gyro, heard.accel = r_mb.apply(x[10:13]), r_mb.apply(felt)
                heard.pressure_pa = 101_325.0 + WATER_DENSITY * 9.80665 * float((x[:3] + world(x).apply(body.r_bi[k]))[2])
                heard.voltage_v, heard.current_a, heard.leak, heard.cabin_temperature_c = 12.0, 3.0, False, 30.0
                if tick % 10 == 0:
                    heard.esc = self._escs(n, k)
                if tick % 2 == 0 and tick >= TAG_DELAY_TICKS:
                    heard.tags.append(self._tag(n, k, tick - TAG_DELAY_TICKS))
        return modules

    def _escs(self, n: int, k: int) -> list[EscFeedback]:
        t = self.bodies[n].thrusters
        speed = (
            np.sign(self.forces[n])
            * t.rpm_at_full
            * np.sqrt(np.abs(self.forces[n]) / np.where(self.forces[n] > 0, 10.0, 8.0))
        )
        rpm = [float(v) for v in speed[t.module == k]]
        return [EscFeedback(i, (rpm[i], rpm[i + 1]), (1.0, 1.0), (0, 0)) for i in range(0, 8, 2)]

    def _tag(self, n: int, k: int, tick: int) -> TagObservation:
        body, x = self.bodies[n], self.past[tick][n]
        row = int(np.flatnonzero((body.tag_module == k) & (body.tag_ids == TOP_FACE))[0])
        q_wt = multiply(x[3:7].copy(), np.ascontiguousarray(body.q_bt[row]))
        return TagObservation(TOP_FACE, 7, tick * PERIOD, x[:3] + world(x).apply(body.r_bt[row]), q_wt)


def plant(body: Body) -> tuple[np.ndarray, ...]:
    drag = body.drag
    return body.mass, body.mass_inv, body.righting, drag.nodes, drag.rotational, drag.linear


def world(x: np.ndarray) -> Rotation:
    return Rotation.from_quat(x[[4, 5, 6, 3]])


def single(module: int = 0) -> Body:
    return assemble([(0, 0, 0)], [0], [load_vehicle("modcube")], [module])


@pytest.fixture
def tank() -> Tank:
    return Tank([single()])


def has_power(outputs: Outputs, module: int = 0) -> bool:
    return bool(outputs.modules[module].thrusters.any())


# ---------------------------------------------------------------- one robot


def test_disarmed_robot_turns_nothing(tank: Tank) -> None:
    tank.run(1.0)
    assert not any(has_power(outputs) or outputs.modules[0].armed for outputs in tank.outputs)
    assert tank.outputs[-1].records[0].estimate.ready


def test_disarmed_robot_is_wanted_where_it_is(tank: Tank) -> None:
    """So that nothing jumps when it arms."""
    record = tank.run(1.0).records[0]
    np.testing.assert_array_equal(record.setpoint.p_wb, record.estimate.p_wb)
    np.testing.assert_array_equal(record.setpoint.q_wb, record.estimate.q_wb)


def test_robot_that_may_not_arm_says_why(tank: Tank) -> None:
    outputs = tank.run(DT, Request(Action.ARM))
    assert not outputs.modules[0].armed
    assert any(event.text.startswith("ARM refused: ") for event in outputs.events)


def test_record_says_whether_arm_would_be_granted(tank: Tank) -> None:
    assert not tank.run(DT).records[0].may_arm, "it has seen nothing yet"
    assert tank.run(0.5).records[0].may_arm
    assert not tank.run(DT, estop=True).records[0].may_arm, "not for one tick more"
    tank.run(1.0)
    assert tank.run(0.2, Request(Action.CLEAR_ESTOP)).records[0].may_arm
    armed = tank.run(DT, Request(Action.ARM))
    assert armed.modules[0].armed
    assert not armed.records[0].may_arm


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
    goal = at_rest(x[:3] + np.array([0.4, -0.3, 0.2]), from_euler(0.0, 0.5, 1.5))
    path = line(at_rest(x[:3], x[3:7]), goal, 5.0)
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
    """A tenth of the thrust, asked for all of it: what is missing must not pass for a current."""
    tank = Tank([single()], Parameters().replace("limiter.force_share", 0.1))
    tank.run(0.5)
    tank.run(0.3, Request(Action.ARM))
    tank.run(2.0, Request(Action.HOLD, 0, at_rest(tank.states[0][:3] + np.array([1.0, 0.0, 0.0]), START)))
    record = tank.outputs[-1].records[0]
    assert np.linalg.norm(record.wrench[:3]) > 5.0 > 4.0 > np.linalg.norm(record.thrust.achieved[:3])
    assert np.linalg.norm(record.estimate.force_w) < 0.5


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
    rate = np.cumsum(force, axis=0) * DT  # of a mass of one
    np.testing.assert_allclose(rate[-1], 0.0, atol=2.0 * DT * np.abs(force).max())
    np.testing.assert_allclose(rate.sum(axis=0) * DT, 0.0, atol=4.0 * DT * p.test_s * np.abs(force).max())  # it is back


@pytest.mark.parametrize("share", [0.1, -0.1, 1.0, -1.0])
def test_tested_thruster_gives_the_wanted_share_of_its_side_and_never_more_than_it_may(tank: Tank, share: float) -> None:
    tank.run(1.0)
    record = tank.run(0.3, Request(Action.MOTOR_TEST, 0, (2, share, 2.0))).records[0]
    t, most = tank.bodies[0].thrusters, tank.pipeline.parameters.steering.test_share
    force = np.zeros(8)
    force[2] = np.clip(share, -most, most) * (t.f_max[2] if share > 0.0 else -t.f_min[2])
    np.testing.assert_allclose(record.thrust.force_n, force, atol=1e-9)


def test_robot_that_lost_an_axis_trusts_its_thrusters_again_once_it_is_disarmed(tank: Tank) -> None:
    """What no longer turns is found again within half a second of flying."""
    tank.run(0.5)
    tank.run(0.5, Request(Action.ARM))
    chain = tank.pipeline.formation.chains[0]
    for thruster in (4, 7):
        chain.faults._lose(thruster, "stands still")
    chain.allocator.set_alive(chain.faults.now.alive)
    assert tank.run(0.1).records[0].state == State.ARMED and chain.health.now.lost_axes == 1
    tank.run(0.1, Request(Action.DISARM))
    assert chain.faults.now.dead == () and tank.run(3.0, Request(Action.ARM)).records[0].state == State.ARMED
    assert tank.outputs[-1].modules[0].thrusters.all(), "and they are used again"


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
    """Neither at once nor by way of the mean."""
    tank.run(0.5)
    tank.run(1.0, Request(Action.ARM))
    before = tank.pipeline.formation.chains[0].supply.voltage_v.copy()
    hear = tank._hear

    def broken(tick: int) -> list[ModuleInputs]:
        modules = hear(tick)
        modules[0].voltage_v = 0.0 if tick % 10 else float("nan")
        return modules

    tank._hear = broken  # type: ignore[method-assign]
    tank.run(0.3)
    np.testing.assert_array_equal(tank.pipeline.formation.chains[0].supply.voltage_v, before)


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


def test_e_stop_that_only_the_module_of_one_body_has_heard_stops_every_body() -> None:
    """It was pressed on one of two buses, while the firmware did not hear that one."""
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


def test_what_is_said_names_the_body_that_it_is_about() -> None:
    tank = Tank([single(0), single(1)])
    refused = tank.run(DT, Request(Action.ARM, 1), Request(Action.SET_MODE, 0, 19.5))
    assert {(event.text.split(":")[0], event.body) for event in refused.events} >= {("ARM refused", 1), ("SET_MODE refused", 0)}


@pytest.mark.slow
@pytest.mark.parametrize("modules", [[0, 1, 2], [2, 0, 1]])
def test_docked_shape_holds_its_place_however_its_modules_sit_and_count(modules: list[int]) -> None:
    """An L of three whose modules all sit differently: a mix-up of frames, levers or commands would throw it about."""
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
    """What a wrong vehicle file or a sign error in prepare would make of a body."""
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
    goal = at_rest(np.array([1.0, 0.0, 0.8]), START)
    tank.run(4.0, Request(Action.HOLD, 0, goal))
    off = np.linalg.norm(tank.states[0][:3] - goal.p_wb)
    turned = np.linalg.norm(difference(tank.states[0][3:7].copy(), goal.q_wb))
    assert off > 0.004 or turned > 0.02
