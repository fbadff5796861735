"""A mistake in a scenario's file is refused when it is loaded, with the file, the line, and what would be right."""

import dataclasses
import pickle
import re
import shutil
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from firmware_py.app.firmware import vehicles_of
from firmware_py.bus.mapping import STALE_NS
from firmware_py.core.history import WINDOW_NS
from firmware_py.core.types import Action, Outputs, Request, Setpoint
from firmware_py.description.fleet import Fleet
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError, limits_of
from hil.bench import fleet_of, script_of
from hil.campaign import identity
from hil.dock_script import AFTERWARDS_NS, DockScript
from hil.force_metrics import force_names
from hil.metrics import DOCKING, SHOWN
from hil.plant.spec import SensorSpec
from hil.scenario import Scenario, load_scenario, make_world
from hil.scenario_files import scenario_names
from hil.scenario_rules import metric_names
from hil.script import Script
from hil.starts import places_of
from hil.task import Step
from tests.unit.tanks import FaultyTank

FOLDER = Path(load_scenario.__code__.co_filename).parent / "scenarios"
Load = Callable[..., Scenario]
WHOLE_BUS = ("estop", "estop_box_silent", "foreign_sync", "foreign_command", "process_killed")
"""Kinds of faults that concern no single module."""
DOCK_STEP = '[[step]]\ndo = "dock"\nmodule = 2\nface = "-x"\ntarget_module = 1\ntarget_face = "+x"\n'
WAIT_STEP = '[[step]]\ndo = "wait"\n'
MOVE_STEP = '[[step]]\ndo = "move"\nmodule = 2\nposition_m = [0.078, 0.4, 0.38]\nduration_s = 20.0\n'
ASIDE = '[[module]]\nnumber = 2\nposition_m = [0.45, 0.45, 0.38]\n'
SECOND = '[[module]]              # the active one, on the right\nnumber = 2\nvehicle = "modcube"\nposition_m = [0.40, 0.0, 0.38]\n'


@pytest.fixture
def load(tmp_path: Path) -> Load:
    """load(name, old, new): a shipped scenario with `new` in place of `old`, or appended if `old` is empty."""

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
        ("dock", 'do = "dock"', 'do = "undock"', "step[0].do: modules 2 and 1 are not docked: neither at the start nor by an earlier step"),
        (
            "dock-third", 'do = "dock"\nmodule = 3', 'do = "undock"\nmodule = 3',
            "step[0].do: modules 3 and 2 are not docked: neither at the start nor by an earlier step",
        ),
        ("dock-third", "body = 0\ncell = [1, 0, 0]", "cell = [1, 0, 0]", "module[1].cell: module 2 starts alone, in no lattice; give body"),
        ("dock", DOCK_STEP, '[[step]]\ndo = "move"\nmodule = 2\n', "step[0].position_m: a move needs it"),
        ("dock", 'do = "dock"', 'do = "move"\nposition_m = [0, 0, 0.38]', "step[0].face: a move has no face; leave it out"),
        ("dock", 'do = "dock"', 'do = "dock"\nduration_s = 3', "step[0].duration_s: a dock has no duration_s; leave it out"),
        ("dock", DOCK_STEP, "", "task.kind: dock runs the [[step]]s, and there are none"),
        ("dock", "target_module = 1", "target_module = 2", "step[0]: module and target_module are both 2"),
        ("dock", "target_module = 1", "target_module = 9", "step[0].target_module: no module has the number 9; there are 1, 2"),
        (
            "dock", 'face = "-x"', 'face = "+y"',
            "step[0].face: module 2 cannot dock to module 1: +y is a probe and +x a probe; a probe docks to a drogue",
        ),
        ("dock-undock-dock", 'do = "undock"\nmodule = 2', 'do = "undock"\nmodule = 7', "step[2].module: no module has the number 7"),
        (
            "dock-moving", "position_m = [-0.3, 0.25, 0.38]", "position_m = [-0.6, 0.25, 0.38]",
            "step[0].position_m: there the hull of module 1 is 0.055 m into the wall at -x of the tank",
        ),
        ("dock-moving", 'do = "move"\nmodule = 1', 'do = "move"\nmodule = 4', "step[0].module: no module has the number 4"),
        ("force-tracking", "body = 0\ncell = [1, 0, 0]", "position_m = [2, 0, 1]", "the bodies here have 1, 1, 1 modules"),
        ("force-tracking", "body = 0\ncell = [1, 0, 0]", "body = 0\ncell = [1, 0, 0]\n[[module]]\nnumber = 4\nposition_m = [2, 0, 1]",
         "module[0]: the body of module 1 has as many modules as another"),
        ("force-tracking", "clamped = true\nbody = 0", "body = 0", "module[1]: no load cell holds the body of module 2, whose"),
        *((name, "number = 1", "number = 1\nclamped = true", f"module[0].clamped: {kind} judges how the body of module 1 moves, and a load")
          for name, kind in (("hover", "hover"), ("polycube", "lissajous"), ("faults", "mode"))),
        *((name, "[task]", f"{ASIDE}\n[task]", f"task.kind: {kind} steers and judges one body, and there are 2, led by modules 1, 2; give")
          for name, kind in (("hover", "hover"), ("spiral", "spiral"), ("faults", "mode"))),
        (
            "hover", 'kind = "hover"\nsettle_s = 15.0\nduration_s = 60.0\ncentre_m = [0.0, 0.0, 0.38]',
            'kind = "force"\nsettle_s = 15.0\nduration_s = 60.0', "force compares a module alone with two docked ones",
        ),
        ("polycube", "number = 1", "number = 25", "module[0].number: 25 and 7 more go up to 32; the bus has numbers to 29, so it is 22"),
        ("polycube", "[polycube]", "[[module]]\nnumber = 9\n[polycube]", "module[1]: a [polycube] takes the place of all modules"),
        ("hover", "[0.0, 0.0, 0.38]", "[0.0, 0.61, 0.38]", "[0.0, 0.61, 0.38] m is outside the tank, a box of 1.3 x 1.2 x 0.76 m"),
        ("mobius-1", "[1.3, 0.0, 1.5]", "[2.5, 2.5, 1.5]", "is outside the tank, a cylinder of 3.5 m radius and 3 m depth"),
        ("dock-moving", "[-0.3, 0.25, 0.38]", "[-0.3, 0.25, 0.8]", "step[0].position_m: [-0.3, 0.25, 0.8] m is outside the tank"),
        ("hover", "[0.0, 0.0, 0.38]", "[0.0, 0.55, 0.38]", "module[0].position_m: the hull of module 1 is 0.055 m into the wall at +y of"),
        ("hover", "[0.0, 0.0, 0.38]", "[-0.6, 0.0, 0.38]", "the hull of module 1 is 0.055 m into the wall at -x of the tank, a box of 1.3"),
        ("hover", "[0.0, 0.0, 0.38]", "[0.0, 0.0, 0.7]", "the hull of module 1 is 0.045 m into the bottom of the tank"),
        ("hover", '"modcube"', '"girona500"', "m; girona500, 1.5 x 1 x 1 m as it starts, does not fit that tank: take a larger tank or"),
        ("hover", "[0.0, 0.0, 0.38]", "[0.0, 0.0, 0.7]", " m; move it in by that"),
        ("mobius-1", "[1.3, 0.0, 1.5]", "[2.4, 2.4, 1.5]", "the hull of module 1 is 0.0426 m into the wall of the tank, a cylinder"),
        ("mobius-2", "[1.3, 0.0, 1.5]", "[0.0, -3.3, 1.5]", "module[0].position_m: the hull of module 1 is 0.0116 m into the wall of the"),
        ("hover", "", "[start]\nposition_m = [0.0, 0.5, 0.0]", "start: a seed may start the hull of module 1 0.005 m into the wall at +y"),
        ("hover", "[0.0, 0.0, 0.38]", "[0.0, 0.48, 0.38]\n[start]\nyaw_deg = 45", "a seed may start the hull of module 1 0.0285 m into"),
        ("dock", "number = 2", "number = 1", "module[1].number: 1 is the number of another module too"),
        ("hover", "position_rmse_m", "position_rsme_m", "check[0].metric: 'position_rsme_m' is unknown; did you mean position_rmse_m? a"),
        ("hover", "position_rmse_m", "docked", "'docked' is unknown; a run of the kind hover has position_rmse_m, "),
        ("dock", DOCK_STEP, WAIT_STEP, "check[0].metric: docked says whether docks and undocks succeeded, and no [[step]] is one; "),
        ("dock-near-miss", "false_declarations", "outcome", "check[0].metric: outcome says whether docks and undocks succeeded, and no"),
        ("force-tracking", "force_difference_off", "force_rmse_three_on_n", "a run of the kind force has position_rmse_m, "),
        ("hover", "", '[[fault]]\nkind = "estop_box_silent"', "fault[0].kind: no e-stop box speaks here that could fall silent; give the"),
        ("hover", "low = 0.7\nhigh = 1.4", "low = 1.4\nhigh = 0.7", "check[3].low: 1.4 is above high, 0.7"),
        ("hover", "high = 0.005", "high = -0.05", "check[0].high: -0.05, and position_rmse_m is 0 or more; no value would pass"),
        ("hover", "low = 0.97", "low = 97.0", "low: 97, and sigma3_share is 1 or less; no value would pass"),
        ("dock", "low = 1.0", "low = 2.0", "low: 2, and docked is 1 or less; no value would pass"),
        ("hover", "high = 0.005", "high = nan", "check[0].high: nan is out of range"),
        ("hover", "", '[[fault]]\nkind = "thruster_dead"\nthruster = 7', "fault[0].thruster: unknown key; did you mean index? permitted"),
        ("hover", "", '[[fault]]\nkind = "leak"\nmodule = 9', "fault[0].module: no module has the number 9; there are 1"),
        ("polycube", "", '[[fault]]\nkind = "leak"\nmodule = 3', "no module has the number 3; in every seed there are 1, 2"),
        ("hover", "[[camera]]", "[[camera]]\nmodule = 3", "camera[0].module: no module has the number 3"),
        ("hover-blind", "until_s = 17.0", "until_s = 11.0", "fault[0].until_s: 11 s is not after at_s, 12 s"),
        ("hover-blind", 'vehicle = "modcube"', 'vehicle = "modcub"', "module[0].vehicle: vehicle 'modcub' is unknown"),
        ("hover", "high = 0.005", "", "check[0].metric: position_rmse_m has neither low nor high; every value would pass"),
        ("hover", "", '[[check]]\nmetric = "nis_mean"\nlow = 0.5', "metric: nis_mean is checked by another [[check]] already"),
        ("hover", "", "[start]\nposition_m = [0.0, 0.7, 0.0]", "start.position_m: a seed may start module 1 at [0.0, -0.7, 0.38] m"),
        ("dock-moving", "duration_s = 60.0", "duration_s = 0.0", "step[0].duration_s: 0 s; a move takes 0.1 s at least"),
        ("hover-blind", "until_s = 17.0", "until_s = 12.00000000001", "fault[0].until_s: 12 s is not after at_s, 12 s"),
        *(("hover", "", f"[[fault]]\nkind = {fault}", f"fault[0].{refusal}") for fault, refusal in (
            ('"leak"\nat_s = 75.1', "at_s: 75.1 s is after the end of the run, which lasts 75 s"),
            ('"thruster_dead"\nindex = 8', "index: 8 is beyond what the module has for thruster_dead; it takes 0 to 7, and -1 for all"),
            ('"magnet"\nindex = 6', "index: 6 is beyond what the module has for magnet; it takes 0 to 5, and -1 for all"),
            ('"magnet"\nvalue = 2', "value: 2 is not for magnet, which takes whole numbers from -1 to 1"),
            ('"magnet"\nvalue = 0.5', "value: 0.5 is not for magnet, which takes whole numbers from -1 to 1"),
            ('"frame_loss"', "value: 0 is not for frame_loss, which takes 0 to 1, except 0"),
            ('"frame_duplicate"\nvalue = 1.1', "value: 1.1 is not for frame_duplicate, which takes 0 to 1, except 0"),
            ('"frame_corrupt"\nvalue = -0.1', "value: -0.1 is not for frame_corrupt, which takes 0 to 1, except 0"),
            ('"tag_flip"\nvalue = 30.0', "value: 30 is not for tag_flip, which takes 0 to 1, except 0"),
            ('"frame_delay"', "value: 0 is not for frame_delay, which takes 0 to 1e+06, except 0"),
            ('"frame_delay"\nvalue = -20.0', "value: -20 is not for frame_delay"),
            ('"thruster_weak"\nvalue = 1.0', "value: 1 is not for thruster_weak, which takes 0 to 1, except 1"),
            ('"thruster_fake_rpm"\nvalue = -0.1', "value: -0.1 is not for thruster_fake_rpm, which takes 0 to 1, except 1"),
            ('"thruster_stuck"\nvalue = 1.5', "value: 1.5 is not for thruster_stuck, which takes -1 to 1"),
            ('"babble"\nvalue = 0.5', "value: 0.5 is not for babble, which takes whole numbers from 1 to 1e+06"),
            ('"babble"\nvalue = 5.0\ndirection = "to_plant"', "direction: babble does not go to_plant; it goes both, from_plant"),
            ('"push"', "value: 0 is not for push"), ('"tag_jump"', "value: 0 is not for tag_jump"),
            ('"camera_bias"', "value: 0 is not for camera_bias"), ('"battery_sag"', "value: 0 is not for battery_sag"),
            ('"jets"\nvalue = 0.5', "kind: jets disturb a neighbour, and there is one module alone"),
            ('"leak"\nindex = 2', "index: 2 is not for leak, which is of no thruster and no face; leave it out"),
            ('"frame_loss"\nvalue = 0.5\nindex = 0', "index: 0 is not for frame_loss"),
            ('"leak"\ndirection = "to_plant"', "direction: leak does not go to_plant; it goes both"),
            ('"tag_absent"\nvalue = 0.5', "value: 0.5 is not for tag_absent, which takes none"),
            ('"thruster_dead"\nvalue = 0.5', "value: 0.5 is not for thruster_dead, which takes none"),
            ('"babble"\nvalue = 5.0\nmodule = 1', "module: babble is not of one module, as of 1; leave it out"),
            *((f'"{kind}"\nmodule = 1', f"module: {kind} is not of one module") for kind in WHOLE_BUS),
        )),
        ("dock", "", '[[fault]]\nkind = "jets"\nvalue = 0.5\nmodule = 1', "fault[0].module: jets is not of one module, as of 1"),
        ("hover", "", "[sensors]\ntag_delay_ms = 500", "sensors.tag_delay_ms: 500 is out of range; permitted: 0 to 480 ms"),
        ("hover", "settle_s = 15.0", "settle_s = 1.0", "1 s; the robot is armed after 1 s, and the task needs it armed; 1.1"),
        ("faults", "settle_s = 3.0", "settle_s = 0.0", "task.settle_s: 0 s; the robot is armed after 1 s"),
        ("mobius-4", "cell = [1, 1, 0]", "cell = [1, 0, 0]", ":35: modules 2 and 4 overlap in cell (1, 0, 0)"),
        ("mobius-2", "cell = [1, 0, 0]", "cell = [1, 1, 0]", "modules 1, 2 share a body, but their cells are not connected; give"),
        ("hover", 'kind = "box"', 'kind = "cylinder"', "tank.size_m: a tank of the kind cylinder has no size_m; leave it out, or"),
        ("mobius-1", 'kind = "cylinder"', 'kind = "box"', "tank.radius_m: a tank of the kind box has no radius_m; leave it out, or"),
        ("mobius-2", "cell = [1, 0, 0]", "cell = [1, 0, 0]\neuler_deg = [0, 0, 90]", "module[1].euler_deg: module 2 is docked to module 1"),
        ("hover", "", '[[step]]\ndo = "wait"', "step[0]: a task of the kind hover runs no steps"),
        ("hover", 'kind = "hover"', 'kind = "hover"\nfile = "none.csv"', "task.file: a task of the kind hover has no file; leave it out"),
        ("hover", 'kind = "hover"', 'kind = "hover"\nclimb_m = 0.4', "task.climb_m: a task of the kind hover has no climb_m; leave"),
        ("dock", 'kind = "dock"', 'kind = "dock"\nturns = 2.0', "task.turns: a task of the kind dock has no turns"),
        ("dock-mobius", 'kind = "dock"', 'kind = "dock"\nstick = 0.5', "task.stick: a task of the kind dock has no stick"),
        ("waypoints", 'file = "waypoints.csv"', "", "task.kind: waypoints flies a file, and there is none"),
        ("waypoints", 'file = "', 'file = "no-', "no-waypoints.csv: cannot be read: No such file or directory"),
        ("waypoints", 'file = "waypoints.csv"', 'file = "."', "cannot be read: Is a directory"),
        ("waypoints", 'file = "', 'file_text = "x_m"\nfile = "', "task.file_text: unknown key; did you mean file? permitted here: "),
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


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("hover", '"leak"\nat_s = 75.0'), ("hover", '"thruster_dead"\nindex = 7'), ("polycube", '"thruster_dead"\nmodule = 2\nindex = 7'),
        ("hover", '"magnet"\nindex = 5'), ("hover", '"frame_loss"\nvalue = 1.0\nmodule = 1'), ("hover", '"thruster_weak"'),
        ("hover", '"babble"\nvalue = 1.0\ndirection = "from_plant"'), ("hover", '"thruster_stuck"\nvalue = -1.0'),
        ("dock", '"jets"'), ("hover", '"magnet"\nvalue = -1.0'), ("hover", '"tag_jump"\nvalue = -0.1'),
    ],
)  # fmt: skip
def test_fault_at_the_edge_of_what_it_takes_is_flown(load: Load, name: str, fault: str) -> None:
    assert len(load(name, "", f"[[fault]]\nkind = {fault}").fault) == 1


@pytest.mark.parametrize(("at_s", "until_s", "period_ns", "is_met"), [
    (6.001, 6.009, 10_000_000, False), (6.001, 6.009, 2_500_000, True), (6.001, 6.01, 10_000_000, False), (6.001, 6.011, 10_000_000, True),
    (6.01, 6.011, 10_000_000, True), (0.0, 0.01, 10_000_000, False), (0.0, 0.011, 10_000_000, True),
])  # fmt: skip
def test_fault_that_no_tick_meets_is_refused(load: Load, at_s: float, until_s: float, period_ns: int, is_met: bool) -> None:
    scenario = load("hover", "", f'[[fault]]\nkind = "leak"\nat_s = {at_s}\nuntil_s = {until_s}')
    if is_met:
        make_world(scenario, 0, period_ns)
        return
    with pytest.raises(DescriptionError, match=r"^hover: fault\[0\], leak, from .* s is between two ticks, 10 ms apart; it"):
        make_world(scenario, 0, period_ns)


def test_longest_delay_of_a_tag_leaves_it_young_enough_for_the_firmware_at_every_rate() -> None:
    longest_period_ms = 1e3 / limits_of(Fleet, "rate_hz").low
    assert limits_of(SensorSpec, "tag_delay_ms").high + longest_period_ms == 1e-6 * min(STALE_NS, WINDOW_NS)


@pytest.fixture
def lone_tag(tmp_path: Path) -> str:
    """A vehicle whose only tag is on its front."""
    vehicle = (FOLDER.parents[1] / "firmware_py" / "vehicles" / "modcube.toml").read_text(encoding="utf-8")
    first, second = (part.start() for part in list(re.finditer(r"^\[\[tag\]\]", vehicle, re.MULTILINE))[:2])
    assert first < second
    (tmp_path / "octo.toml").write_text(vehicle[:second], encoding="utf-8")
    return str(tmp_path / "octo.toml")


def test_tags_that_a_module_does_not_carry_are_refused(load: Load, lone_tag: str) -> None:
    with pytest.raises(DescriptionError, match=r"module\[1\]\.vehicle: .*octo\.toml has no tag of tags = \[5\]; it has 0$"):
        load("dock", SECOND, SECOND.replace("modcube", lone_tag))


@pytest.mark.parametrize(("old", "new"), [
    ("[tank]", "tags = [0, 5]\n[tank]"), ("[tank]", "tags = []\n[tank]"),
    ("[[camera]]              # above the tank, looking down\nposition_m = [0.0, 0.0, -1.2]\naxis = [0.0, 0.0, 1.0]\n", ""),
], ids=["carried", "none", "no_camera"])  # fmt: skip
def test_robot_that_is_not_to_be_seen_is_flown(load: Load, lone_tag: str, tmp_path: Path, old: str, new: str) -> None:
    load("hover", old, new)
    (tmp_path / "hover.toml").write_text((tmp_path / "hover.toml").read_text().replace('"modcube"', f'"{lone_tag}"'))
    assert load_scenario(str(tmp_path / "hover.toml")).module[0].vehicle == lone_tag


def test_vehicle_without_tags_is_flown(load: Load) -> None:
    assert load("mobius-1", '"modcube"', '"girona500"').module[0].vehicle == "girona500"


def test_line_of_the_mistake_is_named(load: Load, tmp_path: Path) -> None:
    with pytest.raises(DescriptionError) as refused:
        load("hover", "position_rmse_m", "position_rsme_m")
    text = (tmp_path / "hover.toml").read_text(encoding="utf-8").splitlines()
    assert "position_rsme_m" in text[int(str(refused.value).split(":")[1]) - 1]


@pytest.mark.parametrize("name", scenario_names())
def test_scenario_of_the_package_has_no_mistake(name: str) -> None:
    assert load_scenario(name).name == name


def test_wait_is_about_no_module(load: Load) -> None:
    """The modules that a `wait` step names by default need not exist."""
    scenario = load("dock-near-miss", MOVE_STEP, WAIT_STEP)
    renumbered = dataclasses.replace(scenario, module=tuple(dataclasses.replace(m, number=m.number + 2) for m in scenario.module))
    script = DockScript(renumbered, fleet_of(renumbered, "virtual:wait", 100))
    nothing = Outputs(tick=1, time_ns=0, modules=[], estop=False, events=[], records=[])
    begin_ns = scenario.task.begin_ns
    ends_ns = begin_ns + round(1e9 * scenario.step[0].duration_s)
    for time_ns in (begin_ns, ends_ns, ends_ns + AFTERWARDS_NS):
        assert script.requests(time_ns, nothing) == []
    assert script.is_over(ends_ns + AFTERWARDS_NS)


@pytest.mark.slow
@pytest.mark.parametrize(("leaves", "goes", "number"), [(3, 4, 2), (1, 3, 1)], ids=["middle", "leader"])
def test_steps_after_an_undock_are_for_the_body_that_their_module_is_of_now(leaves: int, goes: int, number: int) -> None:
    third = load_scenario("dock-third")
    modules = tuple(dataclasses.replace(third.module[0], number=n, cell=np.array([n - 1, 0, 0])) for n in (1, 2, 3, 4))
    steps = Step(do="undock", module=leaves, target_module=2), Step(do="move", module=goes, duration_s=9.0)
    scenario = dataclasses.replace(third, module=modules, step=steps, task=dataclasses.replace(third.task, settle_s=2.0))
    script, tank = DockScript(scenario, fleet_of(scenario, "virtual:chain", 100)), FaultyTank([(n, 0, 0) for n in range(4)])
    tank.run(0.5)
    asked: list[Request] = []
    while not any(request.action == Action.TRACK for request in asked):
        asked = list(script.requests(len(tank.outputs) * 10_000_000, tank.outputs[-1]))
        assert len(tank.shape) == 1 or all(request.action != Action.HOLD for request in asked), "the piece that leaves is not held back"
        tank.run(0.01, *asked)
    assert len(tank.shape) == 2 and [request.body for request in asked] == [number]


def test_every_kind_of_run_has_metrics_of_its_own() -> None:
    assert metric_names(load_scenario("dock")) == list(SHOWN)
    assert not set(DOCKING) & set(metric_names(load_scenario("hover")))
    assert set(force_names([1, 2])) < set(metric_names(load_scenario("force-tracking")))


# ---------------------------------------------------------------- a path from a file

PATH = "x_m,y_m,z_m,qw,qx,qy,qz,duration_s\n-0.3,-0.25,0.55,,,,,\n0.1,-0.2,0.5,,,,,20\n0.2,0.1,0.4,0.7071068,0,0,0.7071068,24\n"
PATH_TOML = """
[limits]
velocity_m_s = [0.05, 0.05, 0.05]
[[waypoint]]
position_m = [-0.3, -0.25, 0.55]
[[waypoint]]
position_m = [0.2, 0.1, 0.4]
"""


def waypoints(folder: Path, text: str, name: str = "path.csv", euler_deg: str = "[0, 0, 0]") -> Scenario:
    """The shipped scenario, loaded from `folder` with `text` as its waypoint file and its module turned by `euler_deg`."""
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(text, encoding="utf-8")
    scenario = (FOLDER / "waypoints.toml").read_text(encoding="utf-8").replace("waypoints.csv", name)
    (folder / "waypoints.toml").write_text(scenario.replace("[[module]]", f"[[module]]\neuler_deg = {euler_deg}"), encoding="utf-8")
    return load_scenario(str(folder / "waypoints.toml"))


def flown(scenario: Scenario) -> Script:
    script = script_of(scenario, fleet_of(scenario, "virtual:waypoints", 100))
    assert isinstance(script, Script)
    return script


def sampled(scenario: Scenario) -> list[Setpoint]:
    return [flown(scenario).trajectory.sample(t) for t in np.linspace(0.0, scenario.task.duration_s, 12)]


def test_path_of_a_file_leads_from_the_start_through_its_points_and_rests_at_the_last(tmp_path: Path) -> None:
    path = flown(waypoints(tmp_path, PATH)).trajectory
    assert path.duration_s == 44.0
    for t, place in ((0.0, [-0.3, -0.25, 0.55]), (20.0, [0.1, -0.2, 0.5]), (44.0, [0.2, 0.1, 0.4]), (50.0, [0.2, 0.1, 0.4])):
        np.testing.assert_allclose(path.sample(t).p_wb, place, atol=1e-9)
    np.testing.assert_allclose(path.sample(20.0).q_wb, [1, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(path.sample(44.0).q_wb, np.array([1, 0, 0, 1]) / np.sqrt(2.0), atol=1e-6)


@pytest.mark.slow
def test_path_without_an_attitude_keeps_that_of_the_start(tmp_path: Path) -> None:
    turned = waypoints(tmp_path, PATH_TOML, "path.toml", "[0, 0, 90]")
    for point in sampled(turned):
        np.testing.assert_allclose(point.q_wb, np.array([1, 0, 0, 1]) / np.sqrt(2.0), atol=1e-9)


@pytest.mark.slow
def test_free_durations_are_as_short_as_the_limits_allow_and_the_rest_of_the_task_is_held(tmp_path: Path) -> None:
    path = flown(waypoints(tmp_path, PATH_TOML, "path.toml")).trajectory
    assert 10.0 < path.duration_s < 44.0
    fastest = max(float(np.abs(path.sample(t).v_w).max()) for t in np.linspace(0.0, path.duration_s, 400))
    assert fastest == pytest.approx(0.05, rel=0.01)


@pytest.mark.slow
def test_scenario_flies_the_same_path_where_its_file_is_not(tmp_path: Path) -> None:
    """As on the workers of a cluster. A campaign is resumed only with the same waypoints."""
    here, parameters = waypoints(tmp_path / "here", PATH), Parameters()
    there = waypoints(tmp_path / "there", PATH)
    assert identity(here, parameters) == identity(there, parameters)
    assert identity(waypoints(tmp_path / "there", PATH.replace("0.4,", "0.41,")), parameters) != identity(here, parameters)
    shutil.rmtree(tmp_path / "here")
    for sent, known in zip(sampled(pickle.loads(pickle.dumps(here))), sampled(there), strict=True):
        np.testing.assert_array_equal(np.concatenate(list(sent)), np.concatenate(list(known)))


@pytest.mark.parametrize(
    ("name", "old", "new", "refusal"),
    [
        ("path.csv", "-0.3,", "-0.28,", "path.csv: the path begins 0.02 m and 0 deg away from the robot's start at [-0.3, -0.25, 0.55] m"),
        ("path.csv", "0.55,,,,,", "0.55,0.9990482,0,0,0.0436194,", "the path begins 0 m and 5 deg away"),
        ("path.csv", "0.2,0.1,0.4", "0.2,0.7,0.4", "path.csv:4: waypoint 2, at [0.2, 0.7, 0.4] m, is outside the tank, a box of 1.3 x"),
        ("path.csv", "0.1,-0.2", "36,-0.2", "path.csv:3: waypoint 1, at [36.0, -0.2, 0.5] m, is outside the tank, a box"),
        ("path.toml", "[0.2, 0.1", "[0.2, 1.1", "path.toml:6: waypoint 1, at [0.2, 1.1, 0.4] m, is outside the tank"),
        ("path.csv", "0.2,0.1,0.4", "0.2,0.51,0.4", "m into the wall at +y of the tank, a box of 1.3 x 1.2 x 0.76 m; keep it inside"),
        ("path.csv", ",24", ",24.1", "path.csv: the path takes 44.1 s, longer than task.duration_s, 44 s"),
        ("path.csv", ",20", ",0.9", "path.csv:3: the thrusters would be used to more than 1000 % of their range, of at most 80 %, "),
        ("path.csv", ",20", ",2.5", " between waypoints 1 and 2, at 6.00 s; allow more time between waypoints 0 and 1"),
        ("path.csv", "0.1,-0.2", "0.1,north", "path.csv:3: y_m: 'north' is not a number"),
        ("path.csv", ",20", ",", "path.csv:3: waypoint 1 lacks duration_s"),
        ("path.csv", "0.5,,,,,20", "0.5,,,,,20,3", "path.csv:3: has more columns than the header"),
        ("path.toml", "[limits]\nvelocity_m_s = [0.05, 0.05, 0.05]", "", "path.toml: has no durations; add duration_s, or [limits] with v"),
        ("path.toml", "velocity_m_s = [0.05, 0.05, 0.05]", "angular_rate_rad_s = 1.0", "limit that this path meets, on velocity or "),
        ("path.toml", "\n[limits]", "duration_s = 9.0\n[limits]", ": no trajectory in 9.00 s keeps the velocity along x within"),
        ("path.toml", "0.05]", "0.05", "path.toml:4: not valid TOML: "),
        ("path.toml", "position_m = [0.2", "place_m = [0.2", "path.toml:7: waypoint[1].place_m: unknown key"),
        ("path.txt", "x", "x", "path.txt: a waypoint file ends in .csv or .toml"),
    ],
)
def test_path_that_does_not_fit_is_refused_before_the_flight(tmp_path: Path, name: str, old: str, new: str, refusal: str) -> None:
    text = PATH_TOML if name.endswith("toml") else PATH
    assert old in text
    scenario = waypoints(tmp_path, text.replace(old, new, 1), name)
    with pytest.raises(DescriptionError) as refused:
        flown(scenario)
    assert refusal in str(refused.value)
    assert str(refused.value).startswith(f"{tmp_path / name}:")
    assert "\n" not in str(refused.value)


def test_refusal_names_the_line_of_a_waypoint_behind_one_that_is_there_twice(tmp_path: Path) -> None:
    text = PATH_TOML.replace("\n[limits]", "duration_s = 9.0\n[limits]", 1)
    first = "[[waypoint]]" + text.split("[[waypoint]]")[1]
    lines = []
    for written in (text, text.replace(first, first + first, 1)):
        with pytest.raises(DescriptionError, match=r"no trajectory in 9\.00 s") as refused:
            flown(waypoints(tmp_path, written, "path.toml"))
        lines.append(int(str(refused.value).split("path.toml:")[1].split(":")[0]))
    assert lines[1] - lines[0] == first.count("\n")


def test_points_without_durations_are_refused_with_what_their_file_can_give(tmp_path: Path) -> None:
    text = "x_m,y_m,z_m\n-0.3,-0.25,0.55\n0.1,-0.2,0.5\n"
    with pytest.raises(DescriptionError, match=r"path\.csv: has no durations; add the column duration_s, or write a \.toml with"):
        flown(waypoints(tmp_path, text))


def test_bodies_that_would_start_one_inside_the_other_are_refused() -> None:
    scenario = load_scenario("dock")
    near = dataclasses.replace(scenario.module[1], position_m=scenario.module[0].position_m)
    with pytest.raises(DescriptionError, match=r"modules 1 and 2 start 0\.\d+ m apart, one inside the other; 0\.2"):
        make_world(dataclasses.replace(scenario, module=(scenario.module[0], near)), 0, 10_000_000)


@pytest.mark.parametrize("place", ["[0.545, -0.495, 0.655]", "[0.0, 0.0, 0.0]"], ids=["touches_three_walls", "floats"])
def test_hull_that_touches_a_wall_or_floats_is_put_into_the_water(load: Load, place: str) -> None:
    make_world(load("hover", "[0.0, 0.0, 0.38]", place), 0, 10_000_000)


def test_vehicle_that_does_not_fit_the_tank_is_not_asked_to_be_moved() -> None:
    with pytest.raises(DescriptionError, match=r"girona500, 1\.5 x 1 x 1 m as it starts, does not fit that tank: take a larger tank or"):
        make_world(load_scenario("hover").with_vehicle("girona500"), 0, 10_000_000)


@pytest.mark.slow
def test_no_shape_that_a_seed_draws_starts_in_a_wall(load: Load) -> None:
    polycube = load_scenario("polycube")
    for seed in range(20):
        make_world(polycube.for_seed(seed), seed, 10_000_000)
    low = load("polycube", "[0.0, 0.0, 1.5]", "[0.0, 0.0, 2.85]")
    with pytest.raises(DescriptionError, match=r"polycube: in seed 1 the hull of module 1 starts 0\.\d+ m into the bottom of the tank"):
        make_world(low.for_seed(1), 1, 10_000_000)


def test_vehicle_file_is_looked_up_beside_the_scenario_s(load: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (resources.files("firmware_py") / "vehicles" / "modcube.toml").read_text(encoding="utf-8")
    (tmp_path / "own.toml").write_text(text.replace("dry_kg = 2.6", "dry_kg = 2.5"), encoding="utf-8")
    monkeypatch.chdir("/")
    scenario = load("hover", 'vehicle = "modcube"', 'vehicle = "own.toml"')
    world = make_world(scenario, 0, 10_000_000)
    assert world.vehicles[0].inertial.dry_kg == 2.5
    assert vehicles_of(fleet_of(scenario, "virtual:own", 100)).popitem()[1].inertial.dry_kg == 2.5
    assert identity(scenario, Parameters())


@pytest.mark.parametrize("name", ["dock", "mobius-2"])
def test_modules_of_another_size_dock_on_the_bench_where_their_hulls_touch(name: str, tmp_path: Path) -> None:
    """Cubes of 200 mm gave up after four tries, "jam": the firmware looked for each other's centres a module's 210 mm apart."""
    text = (resources.files("firmware_py") / "vehicles" / "modcube.toml").read_text(encoding="utf-8")
    for old, new in (("size_m = [0.21, 0.21, 0.21]", "size_m = [0.2, 0.2, 0.2]"), ("entrained_kg = 6.7", "entrained_kg = 5.0")):
        text = text.replace(old, new)
    (tmp_path / "small.toml").write_text(text, encoding="utf-8")
    scenario = load_scenario(name).with_vehicle(str(tmp_path / "small.toml"))
    assert fleet_of(scenario).pitch_m == 0.2 and fleet_of(load_scenario(name)).pitch_m == 0.21
    seats = [place.position for place in places_of(scenario)]
    assert np.linalg.norm(seats[1] - seats[0]) == pytest.approx(0.2 if name == "mobius-2" else 0.0)


def test_modules_that_no_one_lattice_holds_are_refused(load: Load, tmp_path: Path) -> None:
    text = (resources.files("firmware_py") / "vehicles" / "modcube.toml").read_text(encoding="utf-8")
    (tmp_path / "long.toml").write_text(text.replace("size_m = [0.21, 0.21, 0.21]", "size_m = [0.25, 0.21, 0.21]"), encoding="utf-8")
    with pytest.raises(DescriptionError, match=r"docking faces are 0\.21 and 0\.25 m apart across the hulls; a lattice has one pitch"):
        load("dock", 'vehicle = "modcube"', 'vehicle = "long.toml"')
    assert load("hover", 'vehicle = "modcube"', 'vehicle = "long.toml"')
