"""Choice of shape: the list of shapes, tasks, ranking, and the command line of tools/characterise.py."""

import csv
import dataclasses
import importlib
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

from command_line import run_tool

import characterise_choose
import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console
from scipy.spatial.transform import Rotation

from firmware_py.core.body import Body
from firmware_py.core.setpoint import rest_at
from firmware_py.core.types import Setpoint
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.description.water import WATER_DENSITY
from firmware_py.prepare import paths
from firmware_py.prepare.assembly import assemble, assemble_vehicle
from firmware_py.prepare.capability import summary
from firmware_py.prepare.capability.choice import fitness, rank
from firmware_py.prepare.capability.layout import of_modules, of_vehicle
from firmware_py.prepare.capability.polycubes import canonical, polycubes, poses
from firmware_py.prepare.capability.programs import reach_by_programs
from firmware_py.prepare.capability.task import Task, load_task, wrenches_along
from firmware_py.prepare.capability.wrench import WrenchSpace
from firmware_py.prepare.snap_thrust import wrenches
from tests.unit.capability_layouts import ROOT, without

PUSH = np.array([[20.0, 0.0, 0.0, 0.0, 1.0, 0.0]])
UNDER_WATER = rest_at(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0]))
TABLE1_COLUMNS = "space,frame,metric,better"


def test_shapes_of_up_to_five_cubes_are_as_many_as_known() -> None:
    """OEIS A000162 (one-sided) and A001931 (fixed) polycubes."""
    assert [len(polycubes(n)) for n in range(1, 6)] == [1, 1, 2, 8, 29]
    assert [sum(len(poses(s)) for s in polycubes(n)) for n in range(1, 6)] == [1, 3, 15, 86, 534]
    with pytest.raises(DescriptionError, match="1 to 5"):
        polycubes(6)


def test_turned_shape_is_the_same_shape_and_its_mirror_image_is_not() -> None:
    screw = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1))
    mirrored = tuple((-x, y, z) for x, y, z in screw)
    assert {canonical(pose) for pose in poses(screw)} == {canonical(screw)}
    assert canonical(mirrored) != canonical(screw)


@pytest.mark.slow
def test_best_shape_has_the_margin_that_no_pose_beats() -> None:
    vehicle = load_vehicle("modcube")
    found = rank(Task(name="push", wrench=PUSH), 3, vehicle)
    every = [
        float(reach_by_programs(of_modules(cells, [0] * 3, [vehicle] * 3), PUSH)[0])
        for shape in polycubes(3)
        for cells in poses(shape)
    ]
    assert len(found) == 2 and sum(choice.poses for choice in found) == len(every)
    assert found[0].best.margin == pytest.approx(max(every))
    assert found[0].best.margin >= found[1].best.margin


@pytest.mark.slow
def test_ranking_follows_what_was_asked_for() -> None:
    vehicle = load_vehicle("modcube")
    for what in ("power", "variance"):
        found = rank(Task(name="push", wrench=PUSH, rank_by=what, dead=0), 3, vehicle)
        figures = [choice.best.power_w if what == "power" else choice.best.variance for choice in found]
        assert figures == sorted(figures)
        assert all(choice.guaranteed_n == choice.whole_n for choice in found)


@pytest.mark.slow
def test_shape_that_cannot_do_the_task_comes_last() -> None:
    vehicle = load_vehicle("modcube")
    alone = rank(Task(name="haul", wrench=2.0 * PUSH, rank_by="power"), 1, vehicle)[0]
    assert alone.best.margin < 1.0
    turn = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    margins = [c.best.margin for c in rank(Task(name="turn", wrench=turn), 3, vehicle)]
    between = Task(name="turn", wrench=float(np.sqrt(margins[0] * margins[1])) * turn, rank_by="power")
    first, second = rank(between, 3, vehicle)
    assert first.best.margin > 1.0 > second.best.margin


def test_guaranteed_margin_holds_whichever_thruster_dies() -> None:
    vehicle = load_vehicle("modcube")
    choice = rank(Task(name="push", wrench=PUSH, dead=1), 2, vehicle)[0]
    layout = of_modules(choice.best.cells, [0] * 2, [vehicle] * 2)
    worst = min(WrenchSpace(without(layout, [k])).reach(PUSH)[0] for k in range(16))
    assert choice.guaranteed_margin == pytest.approx(worst, rel=1e-9)


def wrench_of(body: Body, wanted: Setpoint) -> np.ndarray:
    """(6,) wrench that one motion takes."""
    return wrenches(body, np.concatenate(wanted)[None])[0]


def test_standing_still_needs_no_wrench_and_drag_needs_one() -> None:
    body = assemble_vehicle(load_vehicle("bluerov2_heavy"))
    assert wrench_of(body, UNDER_WATER) == pytest.approx(np.zeros(6))
    moving = UNDER_WATER._replace(v_w=np.array([0.5, 0.0, 0.0]))
    assert wrench_of(body, moving) == pytest.approx([13.7 * 0.5 + 141.0 * 0.25, 0, 0, 0, 0, 0])


def test_steady_circle_asks_for_the_pull_towards_its_middle_and_for_drag() -> None:
    """The pull is m v^2 / r with added mass; the robot turns with its path, so nothing else changes in its own frame."""
    body, attitude = assemble_vehicle(load_vehicle("modcube")), Rotation.from_euler("xyz", [0.4, -0.3, 1.1])
    body, v, w = dataclasses.replace(body, righting=np.zeros(3)), np.array([0.5, 0.0, 0.0]), np.array([0.0, 0.0, 0.8])
    circling = UNDER_WATER._replace(
        q_wb=attitude.as_quat()[[3, 0, 1, 2]], v_w=attitude.apply(v), w_b=w, a_w=attitude.apply(np.cross(w, v))
    )
    half_rho = 0.5 * WATER_DENSITY
    drag, damping = half_rho * 1.05 * 0.21**2 * 0.5**2, half_rho * 1.1 * 6.0 * 0.105**5 * 0.8**2
    pull = (2.6 + 6.7 + 6.2) * 0.5**2 / (0.5 / 0.8)
    np.testing.assert_allclose(wrench_of(body, circling), [drag, pull, 0.0, 0.0, 0.0, damping], rtol=2e-3, atol=1e-9)


def test_trajectory_asks_for_momentums_change() -> None:
    """The wrench makes up momentum and drag: from rest to rest the first half takes a push, the second half less, the ends none."""
    body = assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [load_vehicle("modcube")] * 2)
    line = paths.line(UNDER_WATER, UNDER_WATER._replace(p_wb=np.array([1.0, 0.5, 1.0])), 10.0)
    forces = wrenches_along(line, body, 201)
    first, last = forces[:100], forces[101:]
    assert first[:, 0].sum() > 0.0 > last[:, 0].sum() - first[:, 0].sum()
    assert np.abs(forces[[0, -1]]).max() == pytest.approx(0.0, abs=1e-9)


def test_trajectory_task_ranks_by_the_wrench_along_it(tmp_path: Path) -> None:
    path = tmp_path / "task.toml"
    path.write_text('name = "strip"\nrank_by = "power"\n[trajectory]\nkind = "moebius"\nsamples = 12\n')
    found = rank(load_task(path), 2, load_vehicle("modcube"))
    assert len(found) == 1 and found[0].poses == 3
    assert found[0].best.margin > found[0].guaranteed_margin > 1.0


def test_margin_that_nothing_limits_is_none_in_the_json_of_a_choice(tmp_path: Path) -> None:
    """A balanced robot at rest asks its thrusters for nothing."""
    path = tmp_path / "task.toml"
    path.write_text('name = "rest"\n[trajectory]\nkind = "circle"\nradius_m = 0.0\nsamples = 3\n')
    with (tmp_path / "said").open("w") as file:
        characterise_choose.choose(1, path, tmp_path, Console(file=file), Console(file=file))
    text = (tmp_path / "choice.json").read_text()
    (shape,) = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))["shapes"]
    assert shape["margin"] is None and shape["guaranteed_n"] > 0.0


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ('name = "x"\n', "either `wrench` rows or a [trajectory] table"),
        ('name = "x"\nwrench = [[0, 0, 0, 0, 0, 0]]\n', "row 0 is zero"),
        ('name = "x"\nwrench = [[1, 0, 0]]\n', "has 1 row of 3 numbers; needs rows of 6 numbers"),
        ('name = "x"\nrank_by = "luck"\nwrench = [[1, 0, 0, 0, 0, 0]]\n', "margin, power, variance"),
    ],
)
def test_wrong_task_file_is_refused_in_one_line(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "task.toml"
    path.write_text(text)
    with pytest.raises(DescriptionError) as refused:
        load_task(path)
    assert str(refused.value).startswith(f"{path}:") and what in str(refused.value)
    assert "\n" not in str(refused.value)


def test_power_of_a_held_wrench_is_that_of_its_forces() -> None:
    vehicle = load_vehicle("modcube")
    layout = of_modules([(0, 0, 0)], [0], [vehicle])
    part = fitness(((0, 0, 0),), layout, np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [5.0, 0.0, 0.0, 0.0, 0.0, 0.0]]))
    assert part.power_w > 0.0 and part.margin == pytest.approx(25.4558 / 5.0, rel=1e-4)


@pytest.fixture
def characterise(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """characterise(*arguments): returns what the tool prints."""

    def run(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["characterise.py", *arguments])
        assert importlib.import_module("characterise").main() == 0
        return capsys.readouterr().out

    return run


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("modcube", "--table1"),
        ("no_such_vehicle",),
        ("no_such_file.toml",),
        ("--assembly", "2x0x1"),
        ("--assembly", "0,0,0 2,0,0"),
        ("modcube", "modcube"),
        ("modcube", "--directions", "many"),
        ("--choose", "3"),
        ("--choose", "9", "--task", "no_such_file.toml"),
    ],
)
def test_wrong_command_line_is_answered_in_one_line(
    arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["characterise.py", *arguments])
    with pytest.raises(SystemExit) as stopped:
        run_tool(importlib.import_module("characterise").main)
    shown = capsys.readouterr()
    assert stopped.value.code == 2
    assert shown.out == "" and shown.err.count("\n") == 1, shown.err


@pytest.mark.slow
def test_table_has_labels_with_units_and_no_keys_of_the_json(characterise: Callable[..., str]) -> None:
    shown = characterise("bluerov2", "--directions", "121", "--force", "2")
    assert re.findall(r"\w+_\w+|\w+\[", shown) == []
    for label in (
        "surge, most + / -, N", "power of 2 N in any direction", "power above idle, mean, W", "Dirichlet energy, W^2", "passive axes",
        "reachable torques, N m", "volume of the inscribed ellipsoid, (N m)^3", "reach in the worst direction, N",
    ):  # fmt: skip
        assert f" {label} " in shown
    table = importlib.import_module("characterise_table")
    layout = of_modules([(0, 0, 0)], [0], [load_vehicle("modcube")])
    every = {row.metric for row in table.rows_of({"one": summary.characterise(layout, count=121, programs=False)})}
    assert every | {"price_usd", "depth_m", "size_cm"} == set(table.LABELS)


def test_two_vehicles_of_one_name_are_not_one_column(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "lighter.toml"
    copy.write_text((ROOT / "firmware_py" / "vehicles" / "modcube.toml").read_text().replace("dry_kg = 2.6", "dry_kg = 2.5"))
    monkeypatch.setattr(sys, "argv", ["characterise.py", "modcube", str(copy)])
    assert importlib.import_module("characterise").main() == 2
    assert capsys.readouterr().err == "characterise: 2 vehicles have the name 'modcube'; give each file another `name`\n"


def test_space_that_rounding_left_of_none_is_called_degenerate_and_has_no_ticks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three thrusters whose axes miss the centre of mass by a tenth of a nanometre: all force, no torque."""
    drawing = importlib.import_module("characterise_draw")
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path: drawn.append(figure))
    three = without(of_modules([(0, 0, 0)], [0], [load_vehicle("modcube")]), range(3, 8))
    layout = dataclasses.replace(three, matrix=np.vstack([np.eye(3), 1e-10 * np.eye(3)[::-1]]))
    drawing.draw(tmp_path / "three.png", {"three": summary.characterise(layout, count=121)}, {"three": "three"})
    panels = drawn[0].axes
    written = ["degenerate" in [text.get_text() for text in panel.texts] for panel in panels]
    assert written == [False, True, True, True, False, True]  # power and wrench, each by force and torque; forces for both
    assert [panel.get_yticks().size == 0 for panel in panels] == written


@pytest.mark.slow
def test_figure_counts_thrusters_from_one_and_its_legend_has_the_colours_that_are_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawing = importlib.import_module("characterise_draw")
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path: drawn.append(figure))
    layouts = {name: of_vehicle(load_vehicle(name)) for name in ("modcube", "bluerov2")}
    found = {name: summary.characterise(layout, count=121) for name, layout in layouts.items()}
    for names in (["modcube"], ["modcube", "bluerov2"]):
        drawing.draw(tmp_path / "found.png", {name: found[name] for name in names}, {name: name for name in names})
    alone, both = ([text.get_text() for text in figure.legends[0].get_texts()] for figure in drawn)
    assert [text for text in both if text not in alone] == ["reachable wrench, the passive degree of freedom declared"]
    assert [axes.get_xticks().tolist() for axes in drawn[0].axes if axes.get_xlabel() == "thruster"] == [list(range(1, 9))] * 2


@pytest.mark.slow
def test_characterising_writes_table_figure_and_report(characterise: Callable[..., str], tmp_path: Path) -> None:
    characterise("bluerov2", "--directions", "300", "--out", str(tmp_path))
    text = (tmp_path / "capability.csv").read_text()
    assert text.startswith(f"{TABLE1_COLUMNS},bluerov2\n")
    rows = {(r["space"], r["frame"], r["metric"]): r["bluerov2"] for r in csv.DictReader(text.splitlines())}
    assert rows["wrench", "force", "max_inscribed_ellipsoid_volume"] == "degenerate"
    assert json.loads((tmp_path / "capability.json").read_text())["vehicles"]["bluerov2"]["rank"] == 5
    assert (tmp_path / "capability.png").read_bytes()[:4] == b"\x89PNG"
    page = (tmp_path / "capability.html").read_text()
    assert "degenerate" in page and not re.search("(src|href)=.(?!data:)", page)
    characterise("bluerov2", "--directions", "300", "--out", str(tmp_path / "again"))
    assert (tmp_path / "again" / "capability.csv").read_text() == text


@pytest.mark.slow
def test_papers_table_is_printed_beside_ours_with_a_word_on_each_cell(characterise: Callable[..., str], tmp_path: Path) -> None:
    shown = characterise("--table1", "--directions", "200", "--out", str(tmp_path))
    for word in ("agrees", "differs by", "inconsistent in"):
        assert word in shown
    assert "authors' files 16 : 4 : 1" in shown
    with (tmp_path / "table1.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    with (ROOT / "tools" / "data" / "table1.csv").open(newline="") as file:
        paper = list(csv.DictReader(file))
    assert list(rows[0])[: len(paper[0])] == list(paper[0])
    ours = [(r["space"], r["frame"], r["metric"]) for r in rows]
    assert set(ours) >= {(r["space"], r["frame"], r["metric"]) for r in paper}
