"""A vehicle's process that was killed in flight holds again, but arms no body whose joints may have changed."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_py.app import vehicle_process
from firmware_py.app.operator import Operator
from firmware_py.core.types import Inputs, Outputs
from firmware_py.description.fleet import Fleet, Module
from firmware_py.description.parameters import Parameters, Supervision
from firmware_py.runtime.clock import boot_id
from firmware_py.runtime.recorder import CAN_LOG, Recorder
from firmware_py.runtime.tick_messages import Message, TickMessages
from tests.unit.can_logs import FLEET, dock_line, docked, lines_of
from tests.unit.vehicle_runs import bus_of, fly

REARM = Parameters(supervision=Supervision(rearm=1))
HOLDS = "the process before ended in flight: holding as soon as the vehicle may (REARM)"


def write_log_killed_in_flight(tmp_path: Path, more: str = "", modules: tuple[Module, ...] = FLEET.module) -> Fleet:
    """Writes the log of a process that was killed in flight just now; returns the fleet."""
    tmp_path.joinpath("log").mkdir()
    Recorder(tmp_path / "log", {"boot": boot_id()}).close()
    tmp_path.joinpath("log", CAN_LOG).write_text(lines_of([True] * 3) + more)
    return Fleet(module=modules, buses=(bus_of(tmp_path), f"{bus_of(tmp_path)}-b"))


@pytest.mark.slow
def test_process_killed_in_flight_holds_again_where_a_parameter_says_so(tmp_path: Path) -> None:
    fleet = write_log_killed_in_flight(tmp_path)
    assert HOLDS in fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=fleet)
    assert (tmp_path / "log" / "0002" / CAN_LOG).exists()
    assert HOLDS not in fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=fleet)  # 0002 ended disarmed


@pytest.mark.slow
def test_flight_whose_recorder_failed_before_its_end_is_not_taken_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: its log ended with commands to armed modules, a moment ago, although they were disarmed since."""
    fleet = write_log_killed_in_flight(tmp_path)
    of = TickMessages.of

    def fail(messages: TickMessages, received: int, inputs: Inputs, outputs: Outputs) -> Iterator[Message]:
        if outputs.tick == 2:
            raise MemoryError
        return of(messages, received, inputs, outputs)

    with monkeypatch.context() as failing:
        failing.setattr(TickMessages, "of", fail)
        said = fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=fleet)
    assert HOLDS in said and any(line.endswith("no more recording: MemoryError: ") for line in said)
    torn = tmp_path / "log" / "0002" / CAN_LOG
    assert torn.stat().st_mtime == 0.0 and " T\n" in torn.read_text()


@pytest.mark.slow
def test_process_killed_in_flight_waits_to_be_armed_otherwise(tmp_path: Path) -> None:
    fleet = write_log_killed_in_flight(tmp_path)
    assert HOLDS not in fly(tmp_path, None, parameters=REARM, fleet=fleet)
    assert HOLDS not in fly(tmp_path, tmp_path / "log", fleet=fleet)


PAIR = dock_line(0, (1, 0, 0, 0, 0, 0)) + dock_line(1, (0, 1, 0, 0, 0, 0))
"""Face A of the first module and face B of the second pull."""
APART = (
    "warning: modules 1 (number 1 on {bus}), 2 (number 2 on {bus}) were docked, or about to be, and their magnets let go: "
    "the fleet file has to say so (body, cell) before they fly as one or REARM arms them"
)


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [REARM, Parameters()])
def test_modules_that_docked_in_flight_are_named_and_not_armed_again(tmp_path: Path, parameters: Parameters) -> None:
    said = fly(tmp_path, tmp_path / "log", parameters=parameters, fleet=write_log_killed_in_flight(tmp_path, PAIR))
    assert said[0] == APART.format(bus=bus_of(tmp_path))
    assert HOLDS not in said
    assert any(line.startswith("running at") for line in said)  # the start is not refused


@pytest.mark.slow
def test_modules_that_the_fleet_file_has_docked_hold_again(tmp_path: Path) -> None:
    said = fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=write_log_killed_in_flight(tmp_path, PAIR, docked(0, 1)))
    assert said[0] == HOLDS


@pytest.mark.slow
def test_dock_at_another_face_than_the_fleet_files_is_none_of_its_joints(tmp_path: Path) -> None:
    said = fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=write_log_killed_in_flight(tmp_path, PAIR, docked(1, 0)))
    assert said[0] == APART.format(bus=bus_of(tmp_path))
    assert HOLDS not in said


UNDOCKED = dock_line(0, (0,) * 6) + dock_line(1, (0,) * 6)


@pytest.mark.slow
@pytest.mark.parametrize("hold", [True, False])
def test_modules_that_were_undocked_in_flight_are_named_and_not_armed_as_one(
    tmp_path: Path, hold: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    to_arm: list[set[int]] = []

    def operator(rate_hz: int, modules: set[int], *others: Any) -> Operator:
        to_arm.append(set(modules))
        return Operator(rate_hz, modules, *others)

    monkeypatch.setattr(vehicle_process, "Operator", operator)
    fleet = write_log_killed_in_flight(tmp_path, PAIR + UNDOCKED, docked(0, 1))
    said = fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=fleet, hold=hold)
    both = "1 (number 1 on {bus}), 2 (number 2 on {bus})".format(bus=bus_of(tmp_path))
    assert said[0].startswith(f"warning: modules {both} were told to let go of joints that the fleet file has: ")
    assert sum(line.startswith(f"texts and commands count modules in the order of the fleet file: {both}") for line in said) == 1
    assert to_arm == [set()]
    assert HOLDS not in said
    again = fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=fleet, hold=hold)
    assert again[0] == said[0], "it is as true at the second restart"
    assert to_arm == [set(), set()]


@pytest.mark.slow
def test_relays_of_single_modules_are_no_undock(tmp_path: Path) -> None:
    assert fly(tmp_path, tmp_path / "log", parameters=REARM, fleet=write_log_killed_in_flight(tmp_path, UNDOCKED))[0] == HOLDS
