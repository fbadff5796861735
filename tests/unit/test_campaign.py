"""Many seeds of one scenario: each is flown once, and finished trials are kept."""

import dataclasses
import json
from importlib import resources
from pathlib import Path

import pytest

from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle_file import load_vehicle
from hil.campaign import SUMMARY_FILE, TABLE_FILE, TRIALS_FILE, fly_trial, identity, outcome_of, run_campaign
from hil.checks import Check, Result
from hil.plant.draw import draw_module
from hil.plant.spec import WorldSpec
from hil.plant.world_parameters import world_parameters
from hil.scenario import load_scenario
from hil.trial_file import TrialFile
from tests.unit.campaigns import Inline, PlugError, content, fly, flying


def test_dock_that_came_to_nothing_says_why() -> None:
    docked, fence = Check("docked", 0.0, 1.0, 1.0, False), Check("position_rmse_m", 0.1, 0.0, 0.01, False)
    assert outcome_of(Result("dock", 0, False, {"outcome": 1.0}, (docked, fence))) == "jammed"
    assert outcome_of(Result("dock", 0, False, {"outcome": 0.0}, (fence,))) == "position_rmse_m"
    assert outcome_of(Result("dock", 0, True, {"outcome": 0.0}, ())) == "passed"


def test_campaign_flies_every_seed_and_writes_what_it_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = flying(monkeypatch)
    counted: list[tuple[int, int]] = []

    def count(done: int, total: int) -> None:
        counted.append((done, total))

    summary = fly(tmp_path, range(5, 8), progress=count, unusual=["ideal"])
    assert sorted(seed for seed, _ in flown) == [5, 6, 7]
    assert len({bus for _, bus in flown}) == 3  # trials in one process must not hear each other
    assert counted == [(1, 3), (2, 3), (3, 3)]
    assert summary == json.loads((tmp_path / SUMMARY_FILE).read_text())
    assert summary["seeds"] == [5, 6, 7]
    assert (summary["controller"], summary["vehicles"], summary["unusual"]) == ("modcube", ["modcube"], ["ideal"])
    rows = (tmp_path / TABLE_FILE).read_text().splitlines()
    assert rows[0] == "seed,passed,outcome,position_rmse_m,nis_mean,duration_s,world.mass_factor"
    assert rows[1] == "5,1,passed,0.005,,40.0,1.05"


def test_interrupted_campaign_flies_what_is_missing_and_ends_in_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = flying(monkeypatch)
    fly(tmp_path / "whole", range(6))

    def stop(done: int, total: int) -> None:
        if done == 4:
            raise PlugError

    with pytest.raises(PlugError):
        fly(tmp_path / "torn", range(6), progress=stop)
    assert len((tmp_path / "torn" / TRIALS_FILE).read_text().splitlines()) == 1 + 4
    flown.clear()
    fly(tmp_path / "torn", range(6))
    assert len(flown) == 2
    assert content(tmp_path / "torn") == content(tmp_path / "whole")


def test_line_that_was_torn_off_is_flown_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = flying(monkeypatch)
    fly(tmp_path, range(3))
    before = content(tmp_path)
    path = tmp_path / TRIALS_FILE
    path.write_bytes(path.read_bytes()[:-20])
    flown.clear()
    fly(tmp_path, range(3))
    assert len(flown) == 1
    assert content(tmp_path) == before
    flown.clear()
    fly(tmp_path, range(5))
    assert [seed for seed, _ in flown] == [3, 4]


def test_trials_of_other_gains_are_thrown_away_only_when_told_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = flying(monkeypatch)
    fly(tmp_path, range(2))
    kept_bytes = (tmp_path / TRIALS_FILE).read_bytes()
    spiral, other = load_scenario("spiral"), Parameters().replace("control.position_bandwidth", 2.0)
    with pytest.raises(DescriptionError, match=r"trials.jsonl holds trials of another scenario, controller or code; give another --out"):
        run_campaign(spiral, other, range(2), Inline, tmp_path)
    assert (tmp_path / TRIALS_FILE).read_bytes() == kept_bytes
    fly(tmp_path, range(2))
    assert [seed for seed, _ in flown] == [0, 1]
    run_campaign(spiral, other, range(2), Inline, tmp_path, anew=True)
    assert [seed for seed, _ in flown] == [0, 1, 0, 1]
    run_campaign(spiral, other, range(2), Inline, tmp_path, anew=True)
    assert [seed for seed, _ in flown] == [0, 1, 0, 1]


def test_robot_whose_hull_has_another_mesh_is_another_robot(tmp_path: Path) -> None:
    vehicle, mesh = tmp_path / "robot.toml", tmp_path / "hull.stl"
    text = (Path(str(resources.files("firmware_py"))) / "vehicles" / "modcube.toml").read_text()
    vehicle.write_text(text.replace("[hull]", f'[hull]\nmesh = "{mesh}"'))
    scenario, known = load_scenario("hover").with_vehicle(str(vehicle)), set()
    for triangles in ("first", "second", "first"):
        mesh.write_text(triangles)
        known.add(identity(scenario, Parameters()))
    assert len(known) == 2


@pytest.mark.parametrize("begun", [b"", b'{"campaign": "other"}\n', b'{"campa'])
def test_campaign_begins_where_another_has_left_no_trial(begun: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = flying(monkeypatch)
    (tmp_path / TRIALS_FILE).write_bytes(begun)
    fly(tmp_path, range(2))
    fly(tmp_path, range(2))
    assert [seed for seed, _ in flown] == [0, 1]


def test_two_campaigns_in_one_folder_do_not_fly_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flying(monkeypatch)

    def meddle(done: int, total: int) -> None:
        before = (tmp_path / TRIALS_FILE).read_bytes()
        with pytest.raises(DescriptionError, match=r"trials.jsonl is being written by another campaign"):
            fly(tmp_path, range(2))
        assert (tmp_path / TRIALS_FILE).read_bytes() == before

    fly(tmp_path, range(2), progress=meddle)
    with TrialFile(tmp_path / TRIALS_FILE, "another", anew=True) as file:
        assert not file.trials


def test_order_in_which_trials_end_does_not_matter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flying(monkeypatch)
    fly(tmp_path / "forwards", range(6))
    for last in (range(3, 6), range(6)):
        fly(tmp_path / "backwards", last)
    assert content(tmp_path / "backwards") == content(tmp_path / "forwards")


def test_worker_with_other_code_is_refused() -> None:
    with pytest.raises(DescriptionError, match="other code than this machine"):
        fly_trial(load_scenario("hover"), Parameters(), 0, "virtual:other", "not this code")


def test_world_of_a_seed_is_named_in_numbers_and_a_calm_one_is_what_the_file_says() -> None:
    scenario = load_scenario("hover")
    vehicles = [load_vehicle("modcube")] * 2
    windy, calm = scenario.world, scenario.with_calm_world().world
    assert world_parameters(vehicles, windy, 1) != world_parameters(vehicles, windy, 2)
    assert 0.85 <= world_parameters(vehicles, windy, 1)["mass_factor"] <= 1.15
    quiet = world_parameters(vehicles, calm, 1)
    assert {name: value for name, value in quiet.items() if name.endswith("_factor")} == dict.fromkeys(
        ("mass_factor", "added_mass_factor", "inertia_factor", "drag_face_factor", "drag_edge_factor"), pytest.approx(1.0)
    )
    assert quiet["trim_m"] == quiet["current_north_m_s"] == quiet["net_buoyancy_n"] == 0.0
    assert quiet["righting_arm_m"] == pytest.approx(0.005)


def test_drag_drawn_for_a_vehicle_with_published_damping_is_named_whatever_its_idle_coefficients() -> None:
    vehicle = load_vehicle("bluerov2")
    idle = dataclasses.replace(vehicle, drag=dataclasses.replace(vehicle.drag, cd_face=0.0, cd_edge=0.0))
    drawn = draw_module(vehicle, WorldSpec(), 1, 0).quadratic[0] / vehicle.drag.quadratic[0]
    for each in (vehicle, idle):
        named = world_parameters([each], WorldSpec(), 1)
        assert named["drag_face_factor"] == pytest.approx(drawn) and named["drag_edge_factor"] == 1.0
