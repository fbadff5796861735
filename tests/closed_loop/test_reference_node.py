"""The C reference node flies in place of the plant's own MCU, with the same frames."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from ctypes import CDLL
from pathlib import Path
from typing import Any

import pytest

from firmware_py.app.firmware import BusFrame
from firmware_py.bus.codec import Frame
from firmware_py.core.types import Inputs, Outputs
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from hil.bench import Bench, open_bench
from hil.faults import Faults
from hil.nodes import make_nodes
from hil.plant.fault_spec import Fault
from hil.reference_node import CNodes, load_library
from hil.scenario import make_world
from tests.closed_loop.flights import shortened
from tests.unit.mcu_frames import ARMED, CODEC, DISARMED, PUSHES, REST, dock, magnets, sync, thrust

FOLDER = Path(__file__).resolve().parents[2] / "hil" / "reference_node"
RATE_HZ, PERIOD_NS = 100, 10_000_000
pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None or shutil.which("make") is None, reason="gcc is missing (make setup-system)"
)


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> CDLL:
    build = tmp_path_factory.mktemp("node")
    command = ["make", "-C", str(FOLDER), f"BUILD={build}", f"PYTHON={sys.executable}"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return load_library(build / "libmodcube_node.so")


def fly(bench: Bench) -> tuple[list[Any], float]:
    """The frames of every tick, and the final speed of the module, m/s."""
    log: list[Any] = []

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        log.append((tuple(received), tuple(sent)))

    bench.fly([observe])
    return log, float(abs(bench.nodes.world.truth(0).v_w).max())


def test_c_node_does_not_compile_with_a_slow_message_that_it_does_not_send(tmp_path: Path) -> None:
    """Regression: it sent a new slow message with what stood before its ESC readings in memory, and no ENVIRONMENT any more."""
    folder = shutil.copytree(FOLDER, tmp_path / "node")
    (tmp_path / "modcube_wire.h").write_text("#define MODCUBE_SLOW_COUNT (10)\n", encoding="utf-8")
    result = subprocess.run(["gcc", "-E", f"-I{tmp_path}", str(folder / "node.h")], capture_output=True, text=True, check=False)
    assert result.returncode and "send_slow" in result.stderr


@pytest.mark.slow
def test_hover_with_the_c_node_is_the_hover_with_the_plants_own_frame_for_frame(library: CDLL) -> None:
    flights, scenario = [], shortened("hover", 6.0)
    for is_c in (False, True):
        with ExitStack() as stack:
            bench = open_bench(stack, scenario, 0, Parameters())
            if is_c:
                bench.nodes = CNodes(bench.nodes, scenario, library, RATE_HZ)  # type: ignore[assignment]
            flights.append(fly(bench))
    (python, _), (c, speed) = flights
    assert c == python
    assert speed < 0.02
    thrust = {frame.data[:6] for _, sent in c for _, frame in sent if frame.id == 0x081}
    assert len(thrust) > 100  # it flew


@pytest.fixture
def nodes(library: CDLL) -> CNodes:
    scenario = shortened("hover", 1.0)
    world = make_world(scenario, 0, PERIOD_NS)
    return CNodes(make_nodes(world, CODEC, scenario), scenario, library, RATE_HZ)


def test_scenario_with_faults_is_refused_for_c_nodes(library: CDLL) -> None:
    """They would do nothing, and a robot that bears them would have passed."""
    scenario = dataclasses.replace(shortened("hover", 1.0), fault=(Fault(kind="leak", at_s=0.0), Fault(kind="frame_loss", value=0.3)))
    world = make_world(scenario, 0, PERIOD_NS)
    with pytest.raises(DescriptionError, match=r"C nodes have no faults \(leak, frame_loss\); leave them out"):
        CNodes(make_nodes(world, CODEC, scenario), scenario, library, RATE_HZ)


def test_fault_is_refused_in_a_flight_of_c_nodes_too(library: CDLL) -> None:
    scenario = shortened("hover", 1.0)
    own = make_nodes(make_world(scenario, 0, PERIOD_NS), CODEC, scenario)
    faults = Faults(own)
    CNodes(own, scenario, library, RATE_HZ)
    with pytest.raises(DescriptionError, match="C nodes have no faults"):
        faults.add(Fault(kind="leak", at_s=0.0))


def test_robot_on_the_bus_that_answers_as_a_c_node_is_noticed(nodes: CNodes) -> None:
    answers = nodes.step([sync(1)])
    with pytest.raises(DescriptionError, match="somebody else answers as module 1 on can0"):
        nodes.refuse_others(answers, "can0")
    nodes.refuse_others([sync(1)], "can0")


def status(frames: Sequence[Frame]) -> tuple[int, int, int]:
    """Tick, errors and state of the last frame of a tick."""
    tick, _, errors, state = CODEC.message("MCU_STATUS").decode(frames[-1].data)
    return tick, errors, state


def applied(nodes: CNodes) -> list[float]:
    return nodes.c_nodes[1].board._applied


def test_node_applies_a_command_with_the_next_sync_and_says_that_it_is_armed(nodes: CNodes) -> None:
    nodes.step([sync(1), *thrust(0.5, ARMED, 1)])
    assert not any(applied(nodes))
    answers = nodes.step([sync(2)])
    assert applied(nodes) == [0.5] * 8
    assert status(answers) == (2, 0, 2)


def test_node_commands_zero_after_100_ms_of_silence_without_any_sync(nodes: CNodes) -> None:
    nodes.step([*thrust(0.5, ARMED, 1), sync(1)])
    for _ in range(10):
        nodes.step([])
        assert any(applied(nodes))
    nodes.step([])
    assert not any(applied(nodes))
    assert status(nodes.step([sync(13)])) == (13, 8, 3)


def test_half_of_the_thrusters_times_out_by_itself(nodes: CNodes) -> None:
    nodes.step([*thrust(0.5, ARMED, 1), sync(1)])
    for counter in range(2, 14):
        nodes.step([thrust(0.5, ARMED, counter)[1]])
    assert applied(nodes) == [0.0] * 4 + [0.5] * 4


def test_estop_ends_thrust_at_once_and_only_a_disarmed_command_after_200_ms_of_none_releases_it(nodes: CNodes) -> None:
    nodes.step([*thrust(0.5, ARMED, 1), sync(1)])
    nodes.step([Frame(0x01E, b"whatever")])
    assert not any(applied(nodes))
    assert status(nodes.step([*thrust(0.0, DISARMED, 2), sync(2)]))[2] == 4
    for counter in range(3, 25):
        nodes.step(thrust(0.5, ARMED, counter & 15))
    assert status(nodes.step([sync(30)]))[2] == 4
    nodes.step(thrust(0.0, DISARMED, 14))
    assert status(nodes.step([sync(31)]))[2] == 1


def test_magnet_that_pushes_goes_off_after_2_s_without_dock_cmd_and_one_that_pulls_stays(nodes: CNodes) -> None:
    nodes.step([dock(PUSHES, 1)])
    for _ in range(200):
        nodes.step([])
        assert magnets(nodes) == PUSHES
    nodes.step([])
    assert magnets(nodes) == REST


def test_estop_ends_pushing_at_once_and_until_it_is_released(nodes: CNodes) -> None:
    nodes.step([dock(PUSHES, 1), sync(1)])
    nodes.step([Frame(0x01E, b"")])
    assert magnets(nodes) == REST
    for counter in range(2, 32):
        nodes.step([dock(PUSHES, counter)])
        assert magnets(nodes) == REST
    nodes.step([*thrust(0.0, DISARMED, 1), dock(PUSHES, 32)])
    assert magnets(nodes) == PUSHES


@pytest.mark.slow
def test_c_node_switches_its_magnets_as_the_plants_own_does_frame_for_frame(nodes: CNodes) -> None:
    """Frames come, stop, and come again around the 2 s timeout and an e-stop."""
    scenario = shortened("hover", 1.0)
    own = make_nodes(make_world(scenario, 0, PERIOD_NS), CODEC, scenario)
    stop, release = [Frame(0x000, b"")], thrust(0.0, DISARMED, 2)
    script = {1: [dock(PUSHES, 1)], 203: [dock(PUSHES, 2)], 300: stop, 310: [dock(PUSHES, 3)], 330: release, 340: [dock(PUSHES, 4)]}
    pushed = []
    for tick in range(1, 560):
        frames = [sync(tick), *script.get(tick, [])]
        assert nodes.step(frames) == own.step(frames)
        assert magnets(nodes) == magnets(own)
        pushed += [tick] if magnets(own) == PUSHES else []
    assert pushed == [*range(1, 202), *range(203, 300), *range(340, 541)]


def test_node_reports_bad_frames_once_in_its_next_status(nodes: CNodes) -> None:
    good = thrust(0.5, ARMED, 1)
    torn = Frame(good[0].id, good[0].data[:-1] + bytes([good[0].data[-1] ^ 1]))
    short = Frame(good[1].id, good[1].data[:5])
    answers = nodes.step([*good, torn, short, good[0], sync(1)])
    assert status(answers)[1] == 1 | 2 | 4
    assert status(nodes.step([sync(2)]))[1] == 0


def test_node_starts_again_wherever_the_tick_jumps_to(nodes: CNodes) -> None:
    assert status(nodes.step([sync(70_000)]))[0] == 70_000 & 0xFFFF
    assert status(nodes.step([sync(3)]))[0] == 3
