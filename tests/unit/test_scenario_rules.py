"""A mistake in a scenario's file is refused when it is loaded, with the file, the line, and what would be right."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from firmware_py.core.types import Outputs
from firmware_py.description.schema import DescriptionError
from hil.bench import fleet_of
from hil.dock_script import AFTERWARDS_NS, DockScript
from hil.force_metrics import force_names
from hil.metrics import DOCKING, SHOWN
from hil.scenario import Scenario, load_scenario, scenario_names
from hil.scenario_rules import metric_names

FOLDER = Path(load_scenario.__code__.co_filename).parent / "scenarios"
Load = Callable[..., Scenario]
DOCK_STEP = '[[step]]\ndo = "dock"\nmodule = 2\nface = "-x"\ntarget_module = 1\ntarget_face = "+x"\n'
SECOND = '[[module]]              # the active one, on the right\nnumber = 2\nvehicle = "modcube"\nposition_m = [0.40, 0.0, 0.38]\n'


@pytest.fixture
def load(tmp_path: Path) -> Load:
    """load(name, old, new): a shipped scenario with `new` in place of `old`, or `new` at its end."""

    def load_it(name: str, old: str, new: str) -> Scenario:
        text = (FOLDER / f"{name}.toml").read_text(encoding="utf-8")
        assert old in text
        path = tmp_path / f"{name}.toml"
        path.write_text(text.replace(old, new, 1) if old else f"{text}\n{new}\n", encoding="utf-8")
        return load_scenario(str(path))

    return load_it


@pytest.mark.parametrize(
    ("name", "old", "new", "refusal"),
    [
        ("dock", SECOND, "", "task.kind: dock needs two modules at least"),
        ("dock", DOCK_STEP, "", "task.kind: dock runs the [[step]]s, and there are none"),
        ("dock", "target_module = 1", "target_module = 2", "step[0]: module and target_module are both 2"),
        ("dock", "target_module = 1", "target_module = 9", "step[0].target_module: no module has the number 9; there are 1, 2"),
        ("dock-undock-dock", 'do = "undock"\nmodule = 2', 'do = "undock"\nmodule = 7', "step[2].module: no module has the number 7"),
        ("dock-moving", 'do = "move"\nmodule = 1', 'do = "move"\nmodule = 4', "step[0].module: no module has the number 4"),
        ("force-tracking", "body = 0\ncell = [1, 0, 0]", "position_m = [2, 0, 1]", "the bodies here have 1, 1, 1 modules"),
        ("hover", 'kind = "hover"', 'kind = "force"', "force compares a module alone with two docked ones"),
        ("polycube", "number = 1", "number = 25", "module[0].number: 25 and 7 more go up to 32; the bus has numbers to 29, so it is 22"),
        ("polycube", "[polycube]", "[[module]]\nnumber = 9\n[polycube]", "module[1]: a [polycube] takes the place of all modules"),
        ("dock", "number = 2", "number = 1", "module[1].number: 1 is the number of another module too"),
        ("hover", "position_rmse_m", "position_rsme_m", "check[0].metric: 'position_rsme_m' is unknown; a run of the kind hover has pos"),
        ("hover", "position_rmse_m", "docked", "'docked' is unknown; a run of the kind hover has position_rmse_m, "),
        ("force-tracking", "force_difference_off", "force_rmse_three_on_n", "is unknown; a run of the kind force has position_rmse_m, "),
        ("hover", "low = 0.7\nhigh = 1.4", "low = 1.4\nhigh = 0.7", "check[3].low: 1.4 is above high, 0.7"),
        ("hover", "", '[[fault]]\nkind = "leak"\nmodule = 9', "fault[0].module: no module has the number 9; there are 1"),
        ("polycube", "", '[[fault]]\nkind = "leak"\nmodule = 3', "no module has the number 3; in every seed there are 1, 2"),
        ("hover", "[[camera]]", "[[camera]]\nmodule = 3", "camera[0].module: no module has the number 3"),
        ("hover-blind", "until_s = 17.0", "until_s = 11.0", "fault[0].until_s: 11 s is not after at_s, 12 s"),
        ("hover", "", '[[step]]\ndo = "wait"', "step[0]: a task of the kind hover runs no steps"),
        ("hover", 'name = "hover"', 'name = "../hover"', "name: '../hover' cannot be the name of a folder"),
        ("hover", 'name = "hover"', 'name = ""', "name: '' cannot be the name of a folder"),
        ("hover", 'name = "hover"', 'name = ".."', "name: '..' cannot be the name of a folder"),
    ],
)
def test_mistake_is_refused_before_the_flight(load: Load, tmp_path: Path, name: str, old: str, new: str, refusal: str) -> None:
    with pytest.raises(DescriptionError) as refused:
        load(name, old, new)
    line = str(refused.value)
    assert refusal in line
    assert line.startswith(f"{tmp_path / name}.toml:")
    assert "\n" not in line


def test_line_of_the_mistake_is_named(load: Load, tmp_path: Path) -> None:
    with pytest.raises(DescriptionError) as refused:
        load("hover", "position_rmse_m", "position_rsme_m")
    text = (tmp_path / "hover.toml").read_text(encoding="utf-8").splitlines()
    assert "position_rsme_m" in text[int(str(refused.value).split(":")[1]) - 1]


@pytest.mark.parametrize("name", scenario_names())
def test_scenario_of_the_package_has_no_mistake(name: str) -> None:
    assert load_scenario(name).name == name


def test_wait_is_about_no_module(load: Load) -> None:
    """Its defaults name modules that need not be there."""
    scenario = load("dock", DOCK_STEP, '[[step]]\ndo = "wait"\n')
    renumbered = dataclasses.replace(scenario, module=tuple(dataclasses.replace(m, number=m.number + 2) for m in scenario.module))
    script = DockScript(renumbered, fleet_of(renumbered, "virtual:wait", 100))
    nothing = Outputs(tick=1, time_ns=0, modules=[], estop=False, events=[], records=[])
    begin_ns = script.begin_ns
    ends_ns = begin_ns + round(1e9 * scenario.step[0].duration_s)
    for time_ns in (begin_ns, ends_ns, ends_ns + AFTERWARDS_NS):
        assert script.requests(time_ns, nothing) == []
    assert script.is_over(ends_ns + AFTERWARDS_NS)


def test_every_kind_of_run_has_metrics_of_its_own() -> None:
    assert metric_names(load_scenario("dock")) == list(SHOWN)
    assert not set(DOCKING) & set(metric_names(load_scenario("hover")))
    assert set(force_names([1, 2])) < set(metric_names(load_scenario("force-tracking")))
