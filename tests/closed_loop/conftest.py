"""Whole flights for tests: the real firmware against the plant in lockstep, judged by the scenario's own checks.

The fixtures here break the plant's side; the firmware flies unchanged.
"""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import hil.scenario
from firmware_py.bus.codec import Frame
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from hil.bench import fly_scenario
from hil.checks import Result
from hil.flight import fly_and_judge
from hil.nodes import Nodes
from hil.scenario import Scenario
from tests.closed_loop.flights import Corrupt, Fly, Rebuild, shortened


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of five seconds, 500 ticks, in which the robot arms, holds, and begins to climb."""
    folder = tmp_path_factory.mktemp("flown")
    fly_scenario(shortened("spiral", duration_s=2.0, settle_s=3.0), 0, Parameters(), folder, "virtual:flown")
    return folder


@pytest.fixture
def log(flown: Path, tmp_path: Path) -> Path:
    """A copy of that log for the test to damage."""
    return Path(shutil.copytree(flown, tmp_path / "log"))


@pytest.fixture
def fly(tmp_path: Path) -> Fly:
    """Flies a scenario on a separate bus; the logs are in the test's folder."""

    def fly_it(scenario: Scenario, seed: int = 0, parameters: Parameters | None = None, folder: str = "run") -> Result:
        return fly_and_judge(scenario, seed, parameters or Parameters(), tmp_path / folder, f"virtual:{tmp_path.name}")

    return fly_it


@pytest.fixture
def rebuild(monkeypatch: pytest.MonkeyPatch) -> Rebuild:
    """rebuild(change): applies `change` to the vehicle in the water; the firmware knows only the unchanged file."""

    def rebuild_it(change: Callable[[Vehicle], Vehicle]) -> None:
        monkeypatch.setattr(hil.scenario, "load_vehicle", lambda name: change(load_vehicle(name)))

    return rebuild_it


@pytest.fixture
def corrupt(monkeypatch: pytest.MonkeyPatch) -> Corrupt:
    """corrupt(change, to_plant): every frame to the plant, or from it, passes through `change`."""

    def corrupt_it(change: Callable[[Frame], Frame], to_plant: bool) -> None:
        step = Nodes.step

        def changed_step(nodes: Nodes, frames: list[Frame]) -> list[Frame]:
            if to_plant:
                return step(nodes, [change(frame) for frame in frames])
            return [change(frame) for frame in step(nodes, frames)]

        monkeypatch.setattr(Nodes, "step", changed_step)

    return corrupt_it
