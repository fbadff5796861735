"""Outputs of the pipeline reach every module in each tick."""

import numpy as np
import pytest

from firmware_py.bus.codec import Receiver
from firmware_py.bus.mapping import OutputEncoder
from firmware_py.core.types import ModuleCommand, Outputs
from firmware_py.description.fleet import single
from tests.unit.bus_robot import CODEC, TICK_NS, TWO_BUSES, Robot


def outputs(*modules, tick=0, time_ns=0, estop=False):
    return Outputs(tick, time_ns, list(modules), estop, [], [])


def command(armed=True, thrusters=(0.0,) * 8, relays=None):
    return ModuleCommand(armed, np.array(thrusters, dtype=float), relays)


def sent(frames):
    return [(bus, CODEC.by_id(frame.id).name, frame.id & 31) for bus, frame in frames]


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
    """A command that says disarmed would make the module release an e-stop raised before the start."""
    robot, encoder = Robot(TWO_BUSES), OutputEncoder(TWO_BUSES, CODEC)
    robot.say("GYRO", (0.0, 0.0, 0.0, 0), number=1, bus=1)
    robot.say("MCU_STATUS", (0, 1, 0, 4), number=2, bus=1)
    frames = encoder.frames(outputs(*[command(armed=False, relays=(0,) * 6)] * 3), robot.collector.without_status)
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
