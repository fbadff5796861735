"""The plant in a process of its own: what is wrong on its bus is as wrong as in lockstep, tick for tick."""

import dataclasses

import pytest

from firmware_py.bus.codec import Codec, Frame
from hil.faults import Faults
from hil.nodes import make_nodes
from hil.plant.fault_spec import Fault
from hil.plant_process import PlantProcess
from hil.scenario import load_scenario, make_world

PERIOD_NS = 10_000_000
CODEC = Codec.load()


class Sent:
    """A port that keeps what is sent."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []

    def send(self, frame: Frame) -> bool:
        self.frames.append(frame)
        return True


def tick_of(k: int) -> list[Frame]:
    """What the firmware sends in a tick: the frames come one by one."""
    halves = [CODEC.message(f"THRUSTER_CMD_{half}").encode(1, [0.0] * 4 + [0], k) for half in "AB"]
    return [CODEC.message("SYNC").encode(0, [k]), *halves, CODEC.message("DOCK_CMD").encode(1, [0] * 6, k)]


@pytest.mark.parametrize(
    "fault",
    [
        Fault(kind="babble", value=5.0), Fault(kind="foreign_sync"), Fault(kind="estop"),
        Fault(kind="frame_loss", value=1.0, direction="to_plant"), Fault(kind="frame_loss", value=0.5, direction="from_plant"),
        Fault(kind="frame_delay", value=20.0, direction="from_plant"),
    ],
    ids=lambda fault: fault.kind,
)  # fmt: skip
def test_fault_is_per_tick_as_in_lockstep(fault: Fault) -> None:
    scenario = dataclasses.replace(load_scenario("hover"), fault=(fault,))
    nodes = make_nodes(make_world(scenario, 0, PERIOD_NS), CODEC, {1: 0}, scenario)
    nodes.faults = Faults(nodes, scenario.fault)
    lockstep = [frame.id for k in range(1, 51) for frame in nodes.step(tick_of(k))]
    plant, port = PlantProcess(scenario, 0, 100, None), Sent()
    for k in range(1, 51):
        plant._advance(k * PERIOD_NS)
        for frame in tick_of(k):
            plant._answer(port, frame)  # type: ignore[arg-type]
    assert sorted(frame.id for frame in port.frames) == sorted(lockstep)
