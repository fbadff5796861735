"""Golden logs: short flights that the code must reproduce, on any machine. `pytest tests/golden --update-golden` flies them again.

A change of behaviour shows here first, with the tick and the signal in which it begins. Update the logs only if the change is intended.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from firmware_py.app.replay import replay
from firmware_py.description.parameters import CONTROLLERS
from hil.bench import fly_scenario
from hil.plant.fault_spec import Fault
from hil.scenario import Scenario, load_scenario
from tests.golden.packed import pack, unpack

FOLDER = Path(__file__).parent
TOLERANCE = 1e-6
"""Relative deviation of a signal allowed for another processor's rounding; frames may differ by one count."""
MOST_BYTES = 450_000
"""Maximum size of all golden logs together."""


def flight(name: str, settle_s: float, duration_s: float, *faults: Fault) -> Scenario:
    """A scenario with other times and these faults."""
    scenario = load_scenario(name)
    task = dataclasses.replace(scenario.task, settle_s=settle_s, duration_s=duration_s)
    return dataclasses.replace(scenario, task=task, fault=faults)


GOLDEN: dict[str, Callable[[], tuple[Scenario, str, int]]] = {
    "spiral": lambda: (flight("spiral", 3.0, 6.0), "modcube", 100),
    "paper": lambda: (flight("spiral", 3.0, 3.0), "paper", 100),
    "faults": lambda: (
        flight(
            "hover", 3.0, 9.0,
            Fault(kind="frame_loss", at_s=3.0, until_s=5.0, value=0.3),
            Fault(kind="tag_absent", at_s=5.0, until_s=6.5),
            Fault(kind="thruster_dead", at_s=7.0, index=2),
            Fault(kind="leak", at_s=9.0),
        ),
        "modcube", 100,
    ),
    "docking": lambda: (load_scenario("dock"), "modcube", 50),
}  # fmt: skip
"""Scenario, controller and tick rate of each flight."""


@pytest.mark.parametrize("name", GOLDEN)
def test_code_reproduces_the_golden_flight(name: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    if request.config.getoption("--update-golden"):
        update(name, tmp_path)
    unpack(FOLDER / name, tmp_path)
    outcome = replay(tmp_path, TOLERANCE)
    assert outcome.first is None, f"{name} differs first in {outcome.first}; see the top of {Path(__file__).name}"
    assert outcome.ticks > 500


def update(name: str, folder: Path) -> None:
    """Flies a golden flight and replaces its log."""
    scenario, controller, rate_hz = GOLDEN[name]()
    fly_scenario(scenario, 0, CONTROLLERS[controller], folder, f"virtual:golden-{name}", rate_hz)
    pack(folder, FOLDER / name, 1_000_000_000 // rate_hz)


def test_golden_logs_stay_small() -> None:
    assert sum(path.stat().st_size for path in FOLDER.rglob("*.xz")) <= MOST_BYTES
