"""Parameters stored by ground stations, laid over those that a process starts with: changed values persist, and no others."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

from firmware_py.app import ground_station
from firmware_py.app.vehicle_process import run_vehicle
from firmware_py.description.fleet import single
from firmware_py.description.parameters import Control, Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.description.toml_text import to_toml
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.parameters import ParameterStore
from firmware_py.ground.stored_parameters import stored_line, with_stored_values

SHIPPED = Parameters()
RELEASE = Parameters(control=Control(position_bandwidth=2.5, attitude_bandwidth=4.5))
"""A release with other gains."""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "parameters.toml"


def test_only_what_was_changed_is_stored(path: Path) -> None:
    store = ParameterStore(SHIPPED, path)
    store.set("POS_BW", 2.75)
    store.set("DOCK_TRIES", 7)
    assert tomllib.loads(store.to_toml()) == {"control": {"position_bandwidth": 2.75}, "docking": {"tries": 7}}
    store.set("DOCK_TRIES", SHIPPED.docking.tries)
    assert tomllib.loads(store.to_toml()) == {"control": {"position_bandwidth": 2.75}}


def test_gains_of_a_new_release_count_where_nobody_set_others(path: Path) -> None:
    before = ParameterStore(SHIPPED, path)
    before.set("POS_BW", 2.75)
    path.write_text(before.to_toml())
    store = ParameterStore(RELEASE, path)
    assert (store.get("POS_BW"), store.get("ATT_BW")) == (2.75, 4.5)
    store.set("DOCK_TRIES", 7)
    assert tomllib.loads(store.to_toml()) == {"control": {"position_bandwidth": 2.75}, "docking": {"tries": 7}}


def test_whole_file_of_an_earlier_release_loads_and_shrinks_to_what_differs(path: Path) -> None:
    path.write_text(to_toml(SHIPPED.replace("control.position_bandwidth", 2.75)))
    store = ParameterStore(SHIPPED, path)
    assert store.values == SHIPPED.replace("control.position_bandwidth", 2.75)
    store.set("DOCK_TRIES", 7)
    assert tomllib.loads(store.to_toml()) == {"control": {"position_bandwidth": 2.75}, "docking": {"tries": 7}}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[control]\nold_gain = 1.0\n", r"parameters\.toml:2: control\.old_gain: unknown key"),
        ("[gone]\nx = 1\n", r"parameters\.toml:1: gone: unknown key"),
        ("control = 1\n", r"parameters\.toml:1: control: must be a table"),
        ("[control]\nposition_bandwidth = 99.0\n", r"parameters\.toml:2: control\.position_bandwidth: 99\.0 is out of range"),
    ],
)
def test_store_that_is_wrong_is_refused_by_file_and_name(path: Path, text: str, words: str) -> None:
    path.write_text(text)
    with pytest.raises(DescriptionError, match=words) as error:
        with_stored_values(SHIPPED, path)
    assert "\n" not in str(error.value)


def test_line_counts_the_stored_values_and_names_a_few(path: Path) -> None:
    laid = SHIPPED.replace("control.position_bandwidth", 2.75)
    assert stored_line(SHIPPED, SHIPPED, path) == ""
    assert stored_line(SHIPPED, laid, path).endswith(f"1 of {path}: control.position_bandwidth")
    for name in ("tries", "align_s", "push_s", "release_s", "sigma_m", "timeout_s", "standoff_m", "align_m"):
        laid = laid.replace(f"docking.{name}", 5 if name == "tries" else 0.05 if name.endswith("_m") else 2.0)
    assert stored_line(SHIPPED, laid, path).endswith(f"9 of {path}")


def test_vehicle_lays_the_store_over_its_parameters_and_says_so(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path.write_text("[control]\nposition_bandwidth = 2.75\n")
    made: list[Any] = []

    def side(config: GroundConfig, firmware: Any, priority: int, started: Parameters) -> None:
        made.extend((firmware.parameters, started))
        raise DescriptionError("enough")

    monkeypatch.setattr(ground_station, "GroundSide", side)
    said: list[str] = []
    with pytest.raises(DescriptionError, match="enough"):
        run_vehicle(single(bus="virtual:stored"), RELEASE, say=said.append, ground=GroundConfig(store=str(path.parent)))
    assert made == [RELEASE.replace("control.position_bandwidth", 2.75), RELEASE]
    assert said == [f"stored parameters in place of shipped or given ones: 1 of {path}: control.position_bandwidth"]
