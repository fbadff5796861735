"""What a module says reaches its own Inputs, and what the pipeline says reaches every module, each tick."""

import numpy as np
import pytest

from firmware_py.bus.codec import Codec, Frame, Receiver, pack_quaternion
from firmware_py.bus.mapping import InputCollector, OutputEncoder
from firmware_py.core.types import MCU_ESTOP, Action, ModuleCommand, ModuleInputs, Outputs, Request
from firmware_py.description.fleet import Fleet, Module, single

MS = 1_000_000
TICK_NS = 10 * MS
CODEC = Codec.load()
TWO_BUSES = Fleet(module=(Module(number=1, bus=0), Module(number=1, bus=1), Module(number=2, bus=1)), buses=("a", "b"))


class Robot:
    """A collector with the nodes' side of the bus; each message counts on by itself, like the real nodes'."""

    def __init__(self, fleet=None):
        self.collector = InputCollector(fleet or single(), CODEC)
        self.counters = {}

    def say(self, name, values, number=1, bus=0, counter=None):
        count = self.counters.get((name, number, bus), -1) + 1 if counter is None else counter
        self.counters[name, number, bus] = count
        self.collector.take(bus, [CODEC.message(name).encode(number, values, count)])

    def see_tag(self, tag=4, counter=0, tick=0, offset_ms=0.0, halves="PA", number=1, p=(1.0, 2.0, 3.0)):
        for half in halves:
            if half == "P":
                self.say("TAG_POSITION", p, number, counter=counter)
            else:
                attitude = (*pack_quaternion((1.0, 0.0, 0.0, 0.0)), tag, 7, tick & 0xFF, offset_ms)
                self.say("TAG_ATTITUDE", attitude, number, counter=counter)

    def tick(self, tick, delay_ns=0):
        """The Inputs of a tick whose SYNC went out at tick * TICK_NS."""
        self.collector.sync_sent(tick, tick * TICK_NS)
        return self.collector.collect(tick, tick * TICK_NS + delay_ns)

    @property
    def faults(self):
        return {kind: count for kind, count in self.collector.faults.items() if count}


def outputs(*modules, tick=0, time_ns=0, estop=False):
    return Outputs(tick, time_ns, list(modules), estop, [], [])


def command(armed=True, thrusters=(0.0,) * 8, relays=None):
    return ModuleCommand(armed, np.array(thrusters, dtype=float), relays)


def sent(frames):
    return [(bus, CODEC.by_id(frame.id).name, frame.id & 31) for bus, frame in frames]


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
    assert module.pressure_pa == 121_325
    assert (module.voltage_v, module.current_a) == pytest.approx((11.8, 4.2))
    assert (module.cabin_temperature_c, module.cabin_pressure_pa, module.leak) == (31.5, 99_000, True)
    assert module.docks == [(0, (70, -71, 0), (1, 2, 0)), (3, (0, 0, -8192), (0, 0, 3))]
    (esc,) = module.esc
    assert (esc.first, esc.rpm, esc.current_a, esc.status) == (2, (2000, -1500), (1.5, 0.5), (0, 3))
    assert (module.mcu_state, module.mcu_errors) == (2, 4)


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


def test_errors_of_two_status_frames_add_up():
    robot = Robot()
    robot.say("MCU_STATUS", (0, 1, 0b01, 2))
    robot.say("MCU_STATUS", (1, 1, 0b10, 3))
    (module,) = robot.tick(1).modules
    assert (module.mcu_errors, module.mcu_state) == (0b11, 3)


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


# ------------------------------------------------------------------ tags


def test_tag_picture_gets_the_time_of_its_sync_and_offset():
    robot = Robot()
    for tick in range(296, 301):
        robot.tick(tick)
    robot.see_tag(tag=4, tick=297, offset_ms=3.3, p=(0.5, -1.0, 2.0))
    (tag,) = robot.tick(301).modules[0].tags
    assert (tag.tag_id, tag.quality) == (4, 7)
    assert tag.capture_ns == 297 * TICK_NS + 3_300_000
    assert tag.p_wt == pytest.approx([0.5, -1.0, 2.0])
    assert tag.q_wt == pytest.approx([1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(("age_ticks", "passes"), [(1, True), (50, True), (51, False), (255, False)])
def test_tag_older_than_half_a_second_is_dropped(age_ticks, passes):
    robot = Robot()
    for tick in range(1000 - 255, 1000):
        robot.tick(tick)
    robot.see_tag(tick=1000 - age_ticks)
    assert len(robot.tick(1000).modules[0].tags) == passes
    assert robot.faults == ({} if passes else {"tag_stale": 1})


def test_tag_picture_of_a_sync_that_was_never_sent_is_dropped():
    robot = Robot()
    robot.tick(0)
    robot.see_tag(tick=77)
    assert robot.tick(1).modules[0].tags == []
    assert robot.faults == {"tag_stale": 1}


def test_tag_picture_whose_camera_lost_sync_is_dropped():
    robot = Robot()
    robot.tick(0)
    robot.see_tag(tick=0, offset_ms=25.5)
    assert robot.tick(1).modules[0].tags == []
    assert robot.faults == {"tag_stale": 1}


def test_tag_picture_from_the_future_is_dropped():
    robot = Robot()
    robot.tick(0)
    robot.see_tag(tick=0, offset_ms=20.0)
    assert robot.tick(1).modules[0].tags == []
    assert robot.faults == {"tag_future": 1}


@pytest.mark.parametrize("half", ["P", "A"])
def test_half_an_observation_is_dropped(half):
    robot = Robot()
    robot.tick(0)
    robot.see_tag(halves=half)
    assert [robot.tick(tick).modules[0].tags for tick in (1, 2, 3)] == [[], [], []]
    assert robot.faults == {"tag_unpaired": 1}


@pytest.mark.parametrize("order", ["PA", "AP"])
def test_halves_on_either_side_of_a_tick_are_one_observation(order):
    robot = Robot()
    robot.tick(0)
    robot.see_tag(halves=order[0])
    assert robot.tick(1).modules[0].tags == []
    robot.see_tag(halves=order[1])
    assert len(robot.tick(2).modules[0].tags) == 1
    assert robot.faults == {}


def test_half_does_not_pair_with_the_same_counter_of_a_later_picture():
    robot = Robot()
    robot.tick(0)
    robot.see_tag(halves="P", counter=5, p=(9.0, 9.0, 9.0))
    robot.tick(1)
    robot.tick(2)
    robot.see_tag(halves="A", counter=5, tick=2)
    robot.tick(3)
    assert robot.tick(4).modules[0].tags == []
    assert robot.faults == {"tag_unpaired": 2}


def test_lost_half_does_not_spoil_the_next_observation():
    robot = Robot()
    robot.tick(0)
    robot.see_tag(halves="P", counter=1, p=(9.0, 9.0, 9.0))
    robot.see_tag(halves="PA", counter=2, p=(1.0, 1.0, 1.0))
    (tag,) = robot.tick(1).modules[0].tags
    assert tag.p_wt == pytest.approx([1.0, 1.0, 1.0])


def test_half_does_not_pair_with_a_half_of_its_own_kind_when_the_counter_comes_round():
    robot = Robot()
    robot.tick(0)
    for counter in range(16):
        robot.see_tag(halves="P", counter=counter, p=(9.0, 9.0, 9.0))
    robot.see_tag(halves="PA", counter=0, p=(1.0, 1.0, 1.0))
    (tag,) = robot.tick(1).modules[0].tags
    assert tag.tag_id == 4 and tag.p_wt == pytest.approx([1.0, 1.0, 1.0])
    robot.tick(2)
    assert robot.faults == {"tag_unpaired": 16}


@pytest.mark.parametrize("sequence", ["P1 A1 P2 A2", "P1 P2 A1 A2", "P1 P2 A2 A1"])
def test_two_tags_of_one_module_in_one_picture_are_two_observations(sequence):
    robot = Robot()
    robot.tick(0)
    for item in sequence.split():
        counter = int(item[1])
        robot.see_tag(halves=item[0], counter=counter, tag=counter, p=(float(counter), 0.0, 0.0))
    tags = robot.tick(1).modules[0].tags
    assert sorted((tag.tag_id, tag.p_wt[0]) for tag in tags) == [(1, 1.0), (2, 2.0)]
    assert robot.faults == {}


def test_tags_of_two_modules_with_the_same_counter_stay_apart():
    robot = Robot(Fleet(module=(Module(number=1), Module(number=2))))
    robot.tick(0)
    robot.see_tag(halves="P", number=1, p=(1.0, 0.0, 0.0))
    robot.see_tag(halves="P", number=2, p=(2.0, 0.0, 0.0))
    robot.see_tag(halves="A", number=1)
    robot.see_tag(halves="A", number=2)
    first, second = robot.tick(1).modules
    assert (first.tags[0].p_wt[0], second.tags[0].p_wt[0]) == (1.0, 2.0)


def test_tag_is_no_sign_of_life_of_the_module_that_wears_it():
    robot = Robot()
    robot.tick(0)
    robot.see_tag()
    (module,) = robot.tick(1).modules
    assert module.tags
    assert not module.heard


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


def test_heartbeats_are_kept_by_bus_and_number():
    robot = Robot(TWO_BUSES)
    robot.say("HEARTBEAT", (1, 7), number=30, bus=1)
    assert robot.collector.heartbeats == {(1, 30): 1}


def test_dropped_frames_of_all_buses_are_counted_from_the_start():
    robot = Robot(TWO_BUSES)
    gyro = CODEC.message("GYRO").encode(1, (0.0, 0.0, 0.0, 0), 3)
    for bus, frame in ((0, gyro), (0, gyro), (1, gyro), (1, Frame(gyro.id, b"short"))):
        robot.collector.take(bus, [frame])
    assert robot.tick(0).dropped_frames == 2
    assert robot.tick(1).dropped_frames == 2
    assert {kind: count for kind, count in robot.collector.dropped.items() if count} == {"counter": 1, "length": 1}


# ------------------------------------------------------------------ outputs


def test_sync_goes_out_on_every_bus_and_wraps_at_32_bits():
    frames = OutputEncoder(TWO_BUSES, CODEC).sync(2**32 + 5)
    assert sent(frames) == [(0, "SYNC", 0), (1, "SYNC", 0)]
    assert all(CODEC.message("SYNC").decode(frame.data) == (5,) for _, frame in frames)


def test_every_module_is_told_its_thrusters_in_every_tick():
    encoder = OutputEncoder(TWO_BUSES, CODEC)
    frames = encoder.frames(outputs(command(), command(armed=False), command()))
    halves = ("THRUSTER_CMD_A", "THRUSTER_CMD_B")
    assert sent(frames) == [(bus, half, number) for bus, number in ((0, 1), (1, 1), (1, 2)) for half in halves]
    modes = [CODEC.by_id(frame.id).decode(frame.data)[-1] for _, frame in frames]
    assert modes == [1, 1, 0, 0, 1, 1]


def test_no_module_is_commanded_before_it_has_said_how_it_is():
    """At a command that says disarmed it would let go of an e-stop that was raised before the start."""
    robot, encoder = Robot(TWO_BUSES), OutputEncoder(TWO_BUSES, CODEC)
    robot.say("GYRO", (0.0, 0.0, 0.0, 0), number=1, bus=1)
    robot.say("MCU_STATUS", (0, 1, 0, 4), number=2, bus=1)
    frames = encoder.frames(outputs(*[command(armed=False, relays=(0,) * 6)] * 3), robot.collector.unmet)
    commanded = [(bus, number) for bus, name, number in sent(frames) if name.startswith("THRUSTER")]
    assert commanded == [(1, 2)] * 2
    assert sum(name == "DOCK_CMD" for _, name, _ in sent(frames)) == 3


def test_thruster_commands_keep_their_order_and_counter():
    shares = np.linspace(-0.9, 0.9, 8)
    (_, half_a), (_, half_b) = OutputEncoder(single(), CODEC).frames(outputs(command(thrusters=shares), tick=21))
    received = [Receiver(CODEC).accept(frame) for frame in (half_a, half_b)]
    assert [*received[0].values[:4], *received[1].values[:4]] == pytest.approx(shares.tolist(), abs=0.5 / 2048)
    assert [each.counter for each in received] == [5, 5]


def test_vehicle_with_six_thrusters_sends_zero_to_the_others():
    _, (_, half_b) = OutputEncoder(single(), CODEC).frames(outputs(command(thrusters=(0.5,) * 6)))
    assert CODEC.message("THRUSTER_CMD_B").decode(half_b.data) == (0.5, 0.5, 0.0, 0.0, 1)


def test_docking_relays_go_out_when_given_with_a_fresh_counter_each_time():
    encoder, receiver = OutputEncoder(single(), CODEC), Receiver(CODEC)
    relays = (0, 1, 2, 0, 0, 1)
    for tick in range(0, 640, 16):
        frames = encoder.frames(outputs(command(relays=relays), tick=tick))
        assert sent(frames)[2:] == [(0, "DOCK_CMD", 1)]
        received = receiver.accept(frames[2][1])
        assert received is not None
        assert received.values == relays


@pytest.mark.parametrize("rate_hz", [50, 100, 200, 400])
def test_estop_goes_out_at_20_hz_while_raised(rate_hz):
    encoder = OutputEncoder(TWO_BUSES, CODEC)
    period_ns = 1_000_000_000 // rate_hz
    count = 0
    for tick in range(rate_hz):
        raised = outputs(command(), command(), command(), tick=tick, time_ns=tick * period_ns, estop=True)
        count += sent(encoder.frames(raised)).count((1, "ESTOP", 0))
    assert count == 20


def test_estop_goes_out_at_once_when_raised_again():
    encoder = OutputEncoder(single(), CODEC)
    stops = []
    for tick, estop in enumerate((True, False, True)):
        frames = encoder.frames(outputs(command(), tick=tick, time_ns=tick * TICK_NS, estop=estop))
        stops.append(sent(frames)[0][1] == "ESTOP")
    assert stops == [True, False, True]
