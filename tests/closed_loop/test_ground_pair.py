"""A docked pair behind its ground link: one system, armed by command and steered by sticks in all six axes."""

from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.core.rotations import difference, rotate_back
from firmware_py.core.types import Inputs, Outputs, Request
from firmware_py.description.parameters import Parameters
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.station import GroundStation
from hil.bench import open_bench
from hil.scenario import load_scenario
from tests.unit.ground_world import Client

ARM_S, READY_S, PUSH_S, REST_S = 1.5, 5.0, 1.5, 1.0
HALF = 500
AXES = {
    "forward": (0, {"x": HALF}), "right": (1, {"y": HALF}), "down": (2, {"z": 250}),
    "right side down": (3, {"t": HALF}), "nose up": (4, {"s": HALF}), "clockwise": (5, {"r": HALF}),
}  # fmt: skip
"""Axis of the body, and the stick that moves the body along it in the positive direction."""


class Pilot:
    """Stands in for the bench's script: a client that arms and then holds one stick after another."""

    trusted = False

    def __init__(self, station: GroundStation) -> None:
        self.station, self.time_ns = station, 0
        self.client = Client(self, 0)  # type: ignore[arg-type]
        station.join(0, 0)
        self.ticks = round(100 * (READY_S + len(AXES) * (PUSH_S + REST_S))) - 1

    def is_over(self, time_ns: int) -> bool:
        return False

    def requests(self, time_ns: int, last: Outputs | None) -> Sequence[Request]:
        self.time_ns = time_ns
        seconds = time_ns * 1e-9 - READY_S
        if time_ns == round(ARM_S * 1e9):
            self.client.command(400, 1)
        if seconds >= 0.0 and time_ns % 50_000_000 == 0:
            number, into_s = divmod(seconds, PUSH_S + REST_S)
            held = {"x": 0, "y": 0, "z": 500, "r": 0, "s": 0, "t": 0}
            if into_s < PUSH_S:
                held |= list(AXES.values())[int(number)][1]
            self.client.send("MANUAL_CONTROL", 1, buttons=0, enabled_extensions=3, **held)
        return self.station.requests()


@pytest.fixture(scope="module")
def flight() -> tuple[Pilot, np.ndarray, np.ndarray]:
    """The pilot after the flight, and position (k, 3) and attitude (k, 4) of the pair at each tick."""
    places, attitudes = [], []
    with ExitStack() as stack:
        bench = open_bench(stack, load_scenario("mobius-2"), 0, Parameters())
        station = GroundStation(GroundConfig(), bench.firmware.fleet, Parameters())
        pilot = Pilot(station)
        bench.script = pilot

        def observe(received: object, sent: object, inputs: Inputs, outputs: Outputs) -> None:
            station.observe(inputs, outputs, bench.firmware.pipeline.bodies)
            for _, frame in station.frames(outputs.time_ns):
                pilot.client.inbox += pilot.client.mav.parse_buffer(frame) or []
            truth = bench.nodes.world.body_truth(0)
            places.append(truth.p_wb)
            attitudes.append(truth.q_wb)

        bench.fly([observe])
    return pilot, np.array(places), np.array(attitudes)


def test_docked_pair_is_one_system(flight: tuple[Pilot, np.ndarray, np.ndarray]) -> None:
    client = flight[0].client
    assert {m.get_srcSystem() for m in client.all("HEARTBEAT")} == {1}
    assert (client.last("COMMAND_ACK").command, client.last("COMMAND_ACK").result) == (400, mavlink.MAV_RESULT_ACCEPTED)
    assert client.last("HEARTBEAT").base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    assert {m.port for m in client.all("SERVO_OUTPUT_RAW")} == {0, 1}
    left = [m.value for m in client.all("NAMED_VALUE_FLOAT") if m.name == "WRENCH_MRG"]
    assert 0.0 <= min(left) < max(left) <= 1.0


@pytest.mark.parametrize("stick", AXES)
def test_docked_pair_goes_where_each_stick_points_and_nowhere_else(flight: tuple[Pilot, np.ndarray, np.ndarray], stick: str) -> None:
    _, places, attitudes = flight
    number, (axis, _) = list(AXES).index(stick), AXES[stick]
    begin = round(100 * (READY_S + number * (PUSH_S + REST_S))) - 1
    end = begin + round(100 * (PUSH_S + REST_S)) - 5
    turned = difference(attitudes[end], attitudes[begin])
    moved = rotate_back(attitudes[begin], places[end] - places[begin])
    p = Parameters().steering
    motion = np.concatenate([moved / (0.5 * p.speed_m_s * PUSH_S), turned / (0.5 * p.rate_rad_s * PUSH_S)])
    assert 0.9 <= motion[axis] <= 1.1
    assert np.max(np.abs(np.delete(motion, axis))) < 0.1
