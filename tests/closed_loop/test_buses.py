"""The same flight on every bus: in lockstep neither the bus nor foreign frames on it change it. tests/vcan: on SocketCAN."""

import dataclasses
import os
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from firmware_py.app.firmware import BusFrame
from firmware_py.app.observers import recording
from firmware_py.bus.codec import Frame
from firmware_py.bus.port import Port, open_port
from firmware_py.core.transitions import State
from firmware_py.core.types import Inputs, Outputs
from firmware_py.description.parameters import Parameters
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG, Recorder
from hil.bench import open_bench
from hil.realtime import fly_in_real_time
from hil.scenario import Scenario, load_scenario
from hil.task import Step
from tests.closed_loop.flights import shortened

UDP = f"udp:239.74.163.4:{40_000 + os.getpid() % 20_000}"
"""A separate port for each process, because test processes run in parallel."""
STRANGERS = (Frame(0x71E, bytes(8)), Frame(0x7FE, b""), Frame(0x0A1, bytes(8)), Frame(0x441, b"no"))
"""A wrong length, an unknown id, a wrong CRC and a wrong length in the robot's own ids."""


def fly(scenario: Scenario, bus: str, folder: Path, stranger: Port | None = None) -> dict[str, bytes]:
    """The logs of one flight. Once the robot is armed, `stranger` sends in every tick."""
    folder.mkdir()

    def disturb(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        if stranger is not None and outputs.records[0].state == State.ARMED:
            for frame in STRANGERS:
                stranger.send(frame)

    with ExitStack() as stack:
        bench = open_bench(stack, scenario, 0, Parameters(), bus)
        recorder = Recorder(folder)
        stack.callback(recorder.close)
        bench.fly([recording(recorder, bench.firmware.fleet.rate_hz), disturb])
    return {name: (folder / name).read_bytes() for name in (CAN_LOG, SIGNAL_LOG)}


def sent(logs: dict[str, bytes]) -> list[bytes]:
    """The frames that the firmware sent."""
    return [line for line in logs[CAN_LOG].splitlines() if line.endswith(b" T")]


@pytest.mark.slow
def test_spiral_over_udp_is_the_spiral_over_virtual_byte_for_byte(tmp_path: Path) -> None:
    scenario = shortened("spiral", duration_s=12.0, settle_s=3.0)
    assert fly(scenario, UDP, tmp_path / "udp") == fly(scenario, f"virtual:{tmp_path.name}", tmp_path / "virtual")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["virtual", "udp"])
def test_strangers_on_the_bus_do_not_change_what_the_robot_is_told(tmp_path: Path, kind: str) -> None:
    scenario = shortened("hover", duration_s=2.0, settle_s=2.0)
    bus = UDP if kind == "udp" else f"virtual:{tmp_path.name}"
    alone = fly(scenario, bus, tmp_path / "alone")
    with open_port(bus) as stranger:
        beside = fly(scenario, bus, tmp_path / "beside", stranger)
    assert sent(beside) == sent(alone)
    assert len(beside[CAN_LOG].splitlines()) >= len(alone[CAN_LOG].splitlines()) + 100 * len(STRANGERS)


@pytest.mark.slow
def test_task_whose_steps_are_over_ends_against_the_clock_as_it_does_in_lockstep(tmp_path: Path) -> None:
    dock = load_scenario("dock")
    task = dataclasses.replace(dock.task, settle_s=2.0, duration_s=30.0)
    scenario = dataclasses.replace(dock, task=task, step=(Step(do="wait", duration_s=1.0),))
    flown = fly_in_real_time(scenario, 0, Parameters(), tmp_path, UDP)
    assert flown.wall_s == pytest.approx(6.0, abs=0.1)  # settled, waited, and three seconds more
