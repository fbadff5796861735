"""Frames from a module reach its own Inputs in each tick; and the effect of strangers on the bus."""

import copy
import dataclasses

import pytest

from firmware_py.app.firmware import compose
from firmware_py.bus.codec import Codec, Frame, load_database
from firmware_py.bus.mapping import InputCollector
from firmware_py.core.types import MCU_ESTOP, Action, ModuleInputs, Request
from firmware_py.description.fleet import single
from firmware_py.description.parameters import Parameters
from tests.unit.bus_robot import CODEC, TICK_NS, TWO_BUSES, Robot

# ------------------------------------------------------------------ sensors


def test_sensors_reach_the_module_that_sent_them_on_its_own_bus():
    robot = Robot(TWO_BUSES)
    robot.say("GYRO", (0.1, 0.2, 0.3, 0), number=1, bus=0)
    robot.say("GYRO", (0.4, 0.5, 0.6, 0), number=1, bus=1)
    robot.say("ACCEL", (1.0, 2.0, -9.81, 0), number=2, bus=1)
    first, second, third = robot.tick(0).modules
    assert first.gyro == pytest.approx([0.1, 0.2, 0.3])
    assert second.gyro == pytest.approx([0.4, 0.5, 0.6])
    assert third.gyro is None
    assert third.accel == pytest.approx([1.0, 2.0, -9.81], abs=0.001)
    assert [m.heard for m in (first, second, third)] == [True, True, True]


def test_every_measurement_of_a_module_arrives_in_its_unit():
    robot = Robot()
    robot.say("DEPTH", (121_325, 18.5, 0))
    robot.say("POWER", (11.8, 4.2, 0))
    robot.say("ENVIRONMENT", (31.5, 99_000, 1))
    robot.say("DOCK_CURRENT_ABC", (70, -71, 0, 1, 2, 0))
    robot.say("DOCK_CURRENT_DEF", (0, 0, -8192, 0, 0, 3))
    robot.say("ESC_FEEDBACK_2", (2000, 1.5, 0, -1500, 0.5, 3))
    robot.say("MCU_STATUS", (0, 1, 0b100, 2))
    (module,) = robot.tick(0).modules
    assert (module.pressure_pa, module.water_temperature_c) == (121_325, 18.5)
    assert (module.voltage_v, module.current_a) == pytest.approx((11.8, 4.2))
    assert (module.cabin_temperature_c, module.cabin_pressure_pa, module.leak) == (31.5, 99_000, True)
    assert module.docks == [(0, (70, -71, 0), (1, 2, 0)), (3, (0, 0, -8192), (0, 0, 3))]
    (esc,) = module.esc
    assert (esc.first, esc.rpm, esc.current_a, esc.status) == (2, (2000, -1500), (1.5, 0.5), (0, 3))
    assert module.mcu_state == 2


def test_inputs_start_empty_after_each_tick():
    robot = Robot()
    robot.say("GYRO", (0.1, 0.2, 0.3, 0))
    robot.say("ESTOP", (), number=30)
    assert robot.tick(0).estop
    inputs = robot.tick(1)
    assert inputs.modules == [ModuleInputs()]
    assert not inputs.estop


def test_inputs_of_two_ticks_share_nothing():
    robot = Robot()
    before = robot.tick(0)
    robot.say("DOCK_CURRENT_ABC", (70, 0, 0, 1, 0, 0))
    robot.tick(1)
    assert before.modules == [ModuleInputs()]


@pytest.mark.parametrize(("status", "passes"), [(0, True), (1, True), (2, False), (15, False)])
def test_stale_or_failed_sensor_says_nothing(status, passes):
    robot = Robot()
    robot.say("GYRO", (0.1, 0.2, 0.3, status))
    robot.say("ACCEL", (0.1, 0.2, 0.3, status))
    robot.say("DEPTH", (101_325, 10.0, status))
    (module,) = robot.tick(0).modules
    assert [v is not None for v in (module.gyro, module.accel, module.pressure_pa)] == [passes] * 3
    assert robot.faults == ({} if passes else {"sensor": 3})


def test_failed_supply_measurement_says_nothing():
    robot = Robot()
    robot.say("POWER", (0.0, 0.0, 15))
    assert robot.tick(0).modules[0].voltage_v is None
    assert robot.faults == {"sensor": 1}


def test_later_of_two_statuses_in_a_tick_counts():
    robot = Robot()
    robot.say("MCU_STATUS", (0, 1, 0, 2))
    robot.say("MCU_STATUS", (1, 1, 0, 3))
    assert robot.tick(1).modules[0].mcu_state == 3


def test_requests_and_time_enter_the_inputs_as_given():
    request = Request(Action.ARM)
    inputs = Robot().collector.collect(7, 123, [request])
    assert (inputs.tick, inputs.time_ns, inputs.requests) == (7, 123, [request])


# ------------------------------------------------------------------ answers


def test_module_answers_a_tick_with_the_status_of_that_tick_alone():
    robot = Robot()
    robot.say("MCU_STATUS", (65_537 & 0xFFFF, 1, 0, 2))
    assert robot.collector.all_answered(65_537)
    assert robot.tick(65_537).modules[0].answered
    robot.say("MCU_STATUS", (65_537 & 0xFFFF, 1, 0, 2))
    assert not robot.collector.all_answered(65_538)
    late = robot.tick(65_538).modules[0]
    assert late.heard
    assert not late.answered
    assert late.late_ticks == 1
    robot.say("MCU_STATUS", (65_535, 1, 0, 2))
    assert robot.tick(65_539).modules[0].late_ticks == 4
    assert robot.tick(65_540).modules[0].late_ticks == 0


def test_module_that_fell_silent_does_not_answer_again_when_the_count_of_ticks_comes_round():
    robot = Robot()
    robot.say("MCU_STATUS", (5, 1, 0, 2))
    assert robot.tick(5).modules[0].answered
    assert not robot.collector.all_answered(5 + 65_536)
    assert not robot.tick(5 + 65_536).modules[0].answered


def test_fleet_has_answered_when_its_last_module_has():
    robot = Robot(TWO_BUSES)
    answers = []
    for bus, number in ((1, 2), (0, 1), (1, 1)):
        answers.append(robot.collector.all_answered(9))
        robot.say("MCU_STATUS", (9, 1, 0, 2), number=number, bus=bus)
    assert answers == [False, False, False]
    assert robot.collector.all_answered(9)


# ------------------------------------------------------------------ strangers


@pytest.mark.parametrize("frame", [Frame(0, b""), Frame(30, b""), Frame(31, b"\x01\x02"), Frame(5, bytes(8))])
def test_estop_of_anybody_in_any_length_enters_the_tick(frame):
    robot = Robot(TWO_BUSES)
    robot.collector.take(1, [frame])
    assert robot.tick(0).estop


def test_other_controllers_on_the_bus_are_counted_and_enter_the_tick():
    robot = Robot()
    assert not robot.tick(0).foreign_command
    robot.say("SYNC", (5,), number=0)
    robot.say("THRUSTER_CMD_A", (0, 0, 0, 0, 1))
    robot.say("DOCK_CMD", (0,) * 6)
    assert robot.faults == {"foreign_sync": 1, "foreign_command": 2}
    here, gone = robot.tick(1), robot.tick(2)
    assert (here.foreign_sync, here.foreign_command) == (True, True)
    assert (gone.foreign_sync, gone.foreign_command) == (False, False)


def test_stop_that_held_a_module_is_not_hidden_by_its_next_status_in_the_same_tick():
    robot = Robot()
    for tick, state in ((0, 4), (1, 1)):
        robot.say("MCU_STATUS", (tick, 1, 0, state))
    assert robot.tick(1).modules[0].mcu_state == MCU_ESTOP
    robot.say("MCU_STATUS", (2, 1, 0, 1))
    assert robot.tick(2).modules[0].mcu_state == 1


def test_module_that_is_not_in_the_fleet_changes_nothing():
    robot = Robot()
    robot.say("GYRO", (0.1, 0.2, 0.3, 0), number=29)
    assert robot.tick(0).modules == [ModuleInputs()]
    assert robot.faults == {"module": 1}


def test_heartbeat_of_another_node_is_no_command():
    robot = Robot(TWO_BUSES)
    robot.say("HEARTBEAT", (1, 7), number=30, bus=1)
    assert not robot.tick(0).foreign_command and not robot.faults


@pytest.mark.parametrize(("name", "number", "values", "is_heard"), [
    ("HEARTBEAT", 30, (0, 7), False), ("HEARTBEAT", 30, (1, 7), True), ("HEARTBEAT", 30, (2, 7), True), ("HEARTBEAT", 30, (3, 7), False),
    ("HEARTBEAT", 31, (1, 7), False), ("ESTOP", 30, (), False), ("SYNC", 0, (5,), False),
])  # fmt: skip
def test_e_stop_box_is_heard_in_the_tick_in_which_it_speaks_and_says_that_it_works(name, number, values, is_heard):
    robot = Robot(TWO_BUSES)
    robot.say(name, values, number=number, bus=1)
    assert [robot.tick(tick).estop_box for tick in (0, 1)] == [is_heard, False]


def test_box_that_reports_a_fault_does_not_hide_that_it_worked_earlier_in_the_tick():
    robot = Robot()
    for state in (1, 3):
        robot.say("HEARTBEAT", (state, 7), number=30)
    assert robot.tick(0).estop_box


def test_dropped_frames_of_all_buses_are_counted_from_the_start():
    robot = Robot(TWO_BUSES)
    gyro = CODEC.message("GYRO").encode(1, (0.0, 0.0, 0.0, 0), 3)
    for bus, frame in ((0, gyro), (0, gyro), (1, gyro), (1, Frame(gyro.id, b"short"))):
        robot.collector.take(bus, [frame])
    assert robot.tick(0).dropped_frames == 2
    assert robot.tick(1).dropped_frames == 2
    assert {kind: count for kind, count in robot.collector.dropped.items() if count} == {"counter": 1, "length": 1}


@pytest.mark.parametrize(("kind", "counts"), [("socketcan", True), ("slcan", True), ("virtual", False), ("udp", False)])
def test_fullest_bus_counts_what_it_carried_in_the_tick_if_it_has_a_bit_rate(kind: str, counts: bool) -> None:
    robot = Robot(dataclasses.replace(TWO_BUSES, buses=(f"{kind}:a", f"{kind}:b")))
    gyro = CODEC.message("GYRO").encode(1, (0.0, 0.0, 0.0, 0), 3)
    robot.collector.take(0, [gyro])
    robot.collector.take(1, [gyro, Frame(0x7FF, b"?")])
    robot.collector.sent([(1, Frame(0, b"")), (0, gyro)])
    assert robot.tick(0).busy_s == pytest.approx(1e-6 * (2 * 135 if counts else 0)), "135 bits of eight bytes each, on the first bus"
    robot.collector.take(1, [gyro, Frame(0x7FF, b"?")])
    assert robot.tick(1).busy_s == pytest.approx(1e-6 * (135 + 65 if counts else 0)), "an unknown frame takes its time too"


def test_frames_that_the_firmware_sends_occupy_the_bus_too():
    firmware = compose(dataclasses.replace(single(), buses=("socketcan:a",)), Parameters())
    status = CODEC.message("MCU_STATUS").encode(1, (1, 0, 0, 1), 0)
    busy_s = []
    for tick in (1, 2):
        firmware.sync(tick, tick * TICK_NS)
        busy_s.append(firmware.step(tick, tick * TICK_NS, [(0, status)], [])[0].busy_s)
    sync, told = 55 + 10 * len(CODEC.message("SYNC").encode(0, (1,)).data), 55 + 10 * len(status.data)
    assert busy_s[0] == pytest.approx(1e-6 * (sync + told))
    assert busy_s[1] > busy_s[0] + 2e-6 * 135, "commands of the eight thrusters went out after the first tick"


def test_message_of_a_module_without_a_handler_is_refused_at_the_start():
    """Regression: a new message in the DBC that nothing takes was told as `somebody else commands modules`."""
    database = load_database()
    InputCollector(TWO_BUSES, Codec(database))
    velocity = copy.deepcopy(next(message for message in database.messages if message.name == "GYRO"))
    velocity._name, velocity.frame_id = "VELOCITY", 0x160
    database.messages.append(velocity)
    with pytest.raises(KeyError, match="VELOCITY"):
        InputCollector(TWO_BUSES, Codec(database))
