"""A recorded flight goes through the same code again and comes out the same, and what does not is named."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from firmware_py.app.replay import replay
from firmware_py.app.replay_report import replay_and_say
from firmware_py.core.estimator import Estimator
from firmware_py.core.limiter import Limiter
from firmware_py.description.schema import DescriptionError
from firmware_py.runtime.recorder import CAN_LOG, Recorder
from hil.plant.fault_spec import Fault
from hil.scenario import load_scenario
from tests.closed_loop.flights import Fly, shortened

TICKS = 500
THRUSTER_CMD_A, GYRO = "081", "101"
"""Ids of the one module."""


def spoil(path: Path, frame_id: str, tick: int, change: int) -> None:
    """Changes bits of the first data byte of the frame with that id in the given tick."""
    lines = path.read_text().splitlines(True)
    at = [i for i, line in enumerate(lines) if f" {frame_id}#" in line][tick - 1]
    head, _, data = lines[at].partition("#")
    lines[at] = f"{head}#{int(data[:2], 16) ^ change:02X}{data[2:]}"
    path.write_text("".join(lines))


def test_flight_comes_out_to_the_byte(flown: Path) -> None:
    outcome = replay(flown)
    assert (outcome.first, outcome.ticks, outcome.torn) == (None, TICKS, "")
    assert outcome.seconds == pytest.approx(4.99)


def test_killed_process_goes_on_as_another_one(fly: Fly, tmp_path: Path) -> None:
    killed = Fault(kind="process_killed", at_s=3.0, until_s=3.5)
    scenario = dataclasses.replace(shortened("hover", duration_s=2.0, settle_s=4.0), fault=(killed,))
    fly(scenario)
    outcome = replay(tmp_path / "run")
    assert (outcome.first, outcome.ticks) == (None, 550)


@pytest.mark.slow
def test_dock_of_two_modules_comes_out_to_the_byte(fly: Fly, tmp_path: Path) -> None:
    fly(load_scenario("dock-undock-dock"))
    outcome = replay(tmp_path / "run")
    assert outcome.first is None
    assert outcome.ticks > 2000


def test_limiter_that_was_changed_is_named(flown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = Limiter.step

    def weaker(self: Limiter, wanted_n: np.ndarray, *rest: object) -> object:
        return step(self, wanted_n * 0.999, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(Limiter, "step", weaker)
    first = replay(flown).first
    assert first is not None
    assert first.signal.startswith("/firmware/body0 commanded_n[")
    assert float(first.replayed) == pytest.approx(0.999 * float(first.recorded))
    assert first.tick >= 100  # the body was not armed before


def test_estimator_that_was_changed_is_named(flown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = Estimator._process_noise
    monkeypatch.setattr(Estimator, "_process_noise", lambda self: noise(self) * 1.001)
    first = replay(flown).first
    assert first is not None
    assert "/firmware/body0" in first.signal


def test_command_that_is_not_the_recorded_one_is_named(log: Path) -> None:
    spoil(log / CAN_LOG, THRUSTER_CMD_A, 400, 0x01)
    first = replay(log).first
    assert first is not None
    assert first.tick == 400
    assert first.signal == "can0 THRUSTER_CMD_A Thruster1 of number 1"
    assert abs(int(first.recorded) - int(first.replayed)) == 1


def test_frame_that_came_otherwise_is_dropped_and_so_named(log: Path) -> None:
    spoil(log / CAN_LOG, GYRO, 300, 0x10)
    first = replay(log).first
    assert first is not None
    assert first.tick == 300
    assert first.signal == "/firmware/ticks dropped_frames"
    assert (first.recorded, first.replayed) == ("0", "1")


def test_tolerance_lets_pass_what_is_within_it(flown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = Estimator._process_noise
    monkeypatch.setattr(Estimator, "_process_noise", lambda self: noise(self) * (1.0 + 1e-9))
    assert replay(flown).first is not None
    assert replay(flown, 1e-5).first is None
    monkeypatch.setattr(Estimator, "_process_noise", lambda self: noise(self) * 1.01)
    assert replay(flown, 1e-5).first is not None


def test_replay_says_how_it_went_and_ends_with_that_status(log: Path) -> None:
    said: list[str] = []
    assert replay_and_say(log, 0.0, said.append) == 0
    assert said[0].startswith(f"{TICKS} ticks, 4.99 s, replayed in ")
    assert said[-1] == "every byte is the same"
    spoil(log / CAN_LOG, THRUSTER_CMD_A, 400, 0x01)
    assert replay_and_say(log, 0.0, said.append) == 1
    assert said[-1].startswith("differs first in tick ")


def test_folder_without_a_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"no can\.log there; give the folder that a run left"):
        replay(tmp_path)


def test_log_that_does_not_say_what_flew_is_refused(tmp_path: Path) -> None:
    Recorder(tmp_path, None).close()
    with pytest.raises(DescriptionError, match="does not say what flew"):
        replay(tmp_path)
    Recorder(tmp_path, {"rate_hz": 100}).close()
    with pytest.raises(DescriptionError, match="its configuration has no fleet, parameters, vehicles"):
        replay(tmp_path)


def test_logs_of_two_flights_are_not_taken_for_one(log: Path) -> None:
    lines = (log / CAN_LOG).read_text().splitlines(True)
    (log / CAN_LOG).write_text("".join(lines[100:]))
    with pytest.raises(DescriptionError, match=r"can\.log has frames of \(.*\) where signals\.mcap has tick 1$"):
        replay(log)
