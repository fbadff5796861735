"""The plant in its own process: faults on its bus act as in lockstep, tick for tick."""

import dataclasses
from contextlib import ExitStack
from pathlib import Path

import pytest

from firmware_py.bus.codec import Frame
from firmware_py.bus.port import PortError, open_port
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from hil.bench import open_bench
from hil.faults import Faults
from hil.nodes import make_nodes
from hil.plant.fault_spec import Fault
from hil.plant_process import PlantProcess
from hil.reference_node.plant import SocketPlant
from hil.scenario import load_scenario, make_world
from tests.unit.mcu_frames import CODEC, DISARMED, dock, sync, thrust

PERIOD_NS = 10_000_000


class Sent:
    """A port that records the frames sent."""

    address = "virtual:sent"

    def __init__(self) -> None:
        self.frames: list[Frame] = []

    def send(self, frame: Frame) -> bool:
        self.frames.append(frame)
        return True


def tick_of(k: int) -> list[Frame]:
    """Frames that the firmware sends in a tick; they arrive one by one."""
    return [sync(k), *thrust(0.0, DISARMED, k), dock([0] * 6, k)]


@pytest.mark.slow
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
    nodes = make_nodes(make_world(scenario, 0, PERIOD_NS), CODEC, scenario)
    nodes.faults = Faults(nodes, scenario.fault)
    lockstep = [frame.id for k in range(1, 51) for frame in nodes.step(tick_of(k))]
    plant, port = PlantProcess(scenario, 0, 100, None), Sent()
    for k in range(1, 51):
        plant._advance(k * PERIOD_NS)
        for frame in tick_of(k):
            plant._answer(port, frame)  # type: ignore[arg-type]
    assert sorted(frame.id for frame in port.frames) == sorted(lockstep)


def status_of(module: int, k: int) -> Frame:
    return CODEC.message("MCU_STATUS").encode(module, [k, 1, 0, 2], k)


def test_plant_refuses_a_bus_on_which_somebody_else_answers_as_its_module() -> None:
    plant, port = PlantProcess(load_scenario("hover"), 0, 100, None), Sent()
    plant._answer(port, status_of(2, 1))  # type: ignore[arg-type]
    for k in range(1, 100):
        for frame in tick_of(k):
            plant._answer(port, frame)  # type: ignore[arg-type]
    words = r"^somebody else answers as module 1 on virtual:sent: another plant, or the robot itself; end it, or take another --bus$"
    with pytest.raises(DescriptionError, match=words):
        plant._answer(port, status_of(1, 99))  # type: ignore[arg-type]


class Led(Sent):
    """A bus shared with other nodes, one of which sends SYNC."""

    address = "udp:239.74.163.5:43999"

    def receive(self) -> list[Frame]:
        return [status_of(3, 7), CODEC.message("SYNC").encode(0, (7,))]


def test_lockstep_refuses_a_bus_that_somebody_else_leads() -> None:
    with ExitStack() as stack:
        bench = open_bench(stack, load_scenario("hover"), 0, Parameters(), "virtual:led")
        bench.plant_port = Led()  # type: ignore[assignment]
        with pytest.raises(PortError, match="another SYNC producer"):
            bench.listen()


def test_lockstep_refuses_a_bus_on_which_the_robot_itself_answers() -> None:
    bus = "virtual:with-robot"
    with ExitStack() as stack:
        bench = open_bench(stack, load_scenario("hover"), 0, Parameters(), bus)
        robot = stack.enter_context(open_port(bus))
        robot.send(status_of(2, 1))
        robot.send(status_of(1, 1))
        with pytest.raises(DescriptionError, match=f"somebody else answers as module 1 on {bus}: another plant, or the robot itself"):
            bench.fly()
    assert bench.nodes.world.time_ns == 0, "before anything moves"


def test_plant_that_serves_already_is_not_ended_by_another_that_comes() -> None:
    plant, port = PlantProcess(load_scenario("hover"), 0, 100, None), Sent()
    for k in range(1, 101):
        for frame in tick_of(k):
            plant._answer(port, frame)  # type: ignore[arg-type]
    answered = len(port.frames)
    plant._answer(port, status_of(1, 100))  # type: ignore[arg-type]
    plant._answer(port, tick_of(101)[0])  # type: ignore[arg-type]
    assert len(port.frames) > answered


def test_plant_with_the_c_node_is_answered_by_it_on_its_own_bus(tmp_path: Path) -> None:
    plant, port = SocketPlant(load_scenario("hover"), 0, 100, None, tmp_path / "board"), Sent()
    plant._answer(port, tick_of(1)[0])  # type: ignore[arg-type]
    plant._answer(port, status_of(1, 1))  # type: ignore[arg-type]
