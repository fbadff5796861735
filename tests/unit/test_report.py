"""Output of a run for people: plots, a report that opens without a network, and the table in the terminal."""

import base64
import dataclasses
import io
import json
import math
import re
from importlib.metadata import version
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure
from rich.console import Console

from firmware_py.core.types import NEVER_AGE_NS
from firmware_py.description.parameters import CONTROLLERS
from firmware_py.description.vehicle_file import load_vehicle
from hil.checks import UNBOUNDED, Limit, Result, judge
from hil.console import flight_progress, print_result
from hil.flight import _scene, as_wanted, flown_of, wanted_in
from hil.force_metrics import force_names
from hil.metrics import SHOWN, flight_metrics, metric_order, shown, shown_limit, shown_value, warning_lines
from hil.plot_style import GREY, STYLE
from hil.plots import attitude, disturbance, estimate, overview, position, write_plots
from hil.report import CAPTIONS, Scene, animation, write_report
from hil.scenario import load_scenario
from hil.signals import Flight, read_flight
from hil.thruster_plot import _columns_of, thrusters
from hil.time_plot import JOINED, NOT_JUDGED, Window
from tests.unit.flights import START_NS, write_flight, write_pair

TANK_M = np.array([[-0.65, -0.60, 0.0], [0.65, 0.60, 0.76]])
WINDOW = Window(4.0, 8.0)
LIMITS = (Limit("position_rmse_m", high=0.008), Limit("nis_mean", 0.7, 1.4))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    folder = tmp_path_factory.mktemp("flight")
    write_flight(folder, duration_s=4.0)
    return read_flight(folder)


@pytest.fixture(scope="module")
def result(flight: Flight) -> Result:
    return judge("spiral", 7, flight_metrics(flight.between(START_NS, START_NS + 4_000_000_000)), LIMITS)


@pytest.fixture(scope="module")
def dock(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Two modules that lock in tick 100."""
    folder = tmp_path_factory.mktemp("dock")
    write_pair(folder, ticks=200, joined_from=100, known_from=112, offset_m=(0.003, 0.0, -0.004))
    return read_flight(folder)


def scene(title: str = "Spiral", modules: int = 1) -> Scene:
    vehicle = load_vehicle("modcube")
    return Scene(
        title=title,
        tank_m=TANK_M,
        modules=(vehicle,) * modules,
        force_limits_n=np.array([vehicle.force_min_n, vehicle.force_max_n]),
        window=WINDOW,
        paper_rmse_mm=20.92,
        notes=("the thruster curve is synthetic",),
    )


@pytest.mark.slow
def test_every_plot_is_written_and_has_a_caption(flight: Flight, tmp_path: Path) -> None:
    paths = write_plots(flight, tmp_path, WINDOW, TANK_M, np.array([-8.0, 10.0]), 20.92)
    assert [*(path.stem for path in paths), "docking"] == list(CAPTIONS)
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


@pytest.mark.slow
def test_grey_of_every_plot_over_time_is_in_its_legend(flight: Flight) -> None:
    figures = overview(flight, WINDOW, TANK_M, 20.92), thrusters(flight, WINDOW, np.array([-8.0, 10.0]))
    for figure in (*figures, *(draw(flight, WINDOW) for draw in (position, attitude, estimate, disturbance))):
        (legend,) = figure.legends
        (at,) = (i for i, text in enumerate(legend.get_texts()) if text.get_text() == "before or after the task, not judged")
        assert legend.legend_handles[at].get_facecolor() == matplotlib.colors.to_rgba(GREY)
        assert all(NOT_JUDGED in axes.get_legend_handles_labels()[1] for axes in figure.axes if axes.name != "3d")
        pyplot.close(figure)


@pytest.mark.slow
def test_panel_says_why_it_is_empty_where_the_filter_has_nothing_to_show(flight: Flight) -> None:
    """The paper's filter reports no innovations and estimates no disturbance."""
    silent = {name: np.zeros_like(flight.firmware[name]) for name in ("nis", "nis_dof", "force_w", "moment_b")}
    for draw, titles, why in (
        (estimate, ["Tag NIS per degree of freedom: none"], "this filter tells no innovations"),
        (
            disturbance,
            ["Estimated disturbance force, world: none", "Estimated disturbance moment, body: none"],
            "this filter estimates no disturbance",
        ),
    ):
        figure = draw(dataclasses.replace(flight, firmware=flight.firmware | silent), WINDOW)
        empty = [axes for axes in figure.axes if why in [text.get_text() for text in axes.texts]]
        assert [axes.get_title(loc="left") or axes.get_title() for axes in empty] == titles
        assert all(not axes.get_yticks().size for axes in empty)
        assert figure.legends[0].get_texts()
        spoken = draw(flight, WINDOW)
        assert not [text for axes in spoken.axes for text in axes.texts]
        pyplot.close("all")


def test_report_needs_no_network_and_carries_its_plots(flight: Flight, result: Result, tmp_path: Path) -> None:
    plot = tmp_path / "overview.png"
    plot.write_bytes(b"\x89PNG of a flight")
    page = write_report(tmp_path, result, flight, scene(), [plot]).read_text()
    assert not re.search(r"https?://|<link|@import|url\(|fetch\(|XMLHttpRequest", page)
    sources = re.findall(r'src="([^"]*)"', page)
    assert sources == ["data:image/png;base64," + base64.b64encode(plot.read_bytes()).decode()]
    assert "<!--" not in page.replace("<!DOCTYPE", "")


def test_only_the_papers_vehicle_is_shown_beside_the_paper(flight: Flight) -> None:
    spiral = load_scenario("spiral")
    assert _scene(spiral, flight).paper_rmse_mm == 20.92
    assert _scene(spiral.with_vehicle("bluerov2"), flight).paper_rmse_mm is None


def test_report_names_what_flew(flight: Flight, result: Result, tmp_path: Path) -> None:
    flown = result._replace(flown=flown_of(load_scenario("hover"), CONTROLLERS["least_power"]))
    page = write_report(tmp_path, flown, flight, scene(), []).read_text()
    assert f"<p>Flown: modcube {version('modcube')}, controller least_power, vehicle modcube.</p>" in page


def test_report_shows_our_figure_beside_the_papers(flight: Flight, result: Result, tmp_path: Path) -> None:
    page = write_report(tmp_path, result, flight, scene(), []).read_text()
    assert f"{1e3 * result.metrics['position_rmse_m']:.2f} mm" in page
    assert "paper, real tank" in page
    assert "20.92 mm" in page
    assert "Nothing of it was measured on hardware" in page
    assert "the thruster curve is synthetic" in page


def test_report_of_a_failed_flight_says_so(flight: Flight, result: Result, tmp_path: Path) -> None:
    failed = judge("spiral", 7, result.metrics, [Limit("position_rmse_m", high=1e-6)])
    page = write_report(tmp_path, failed, flight, scene(), []).read_text()
    assert "A check failed" in page
    assert "All checks passed" not in page


def test_report_of_a_dock_has_its_outcome_as_headline_and_no_rmse_that_nobody_asked_for(
    flight: Flight, result: Result, tmp_path: Path
) -> None:
    asked, near, false = Limit("docked", low=1.0), Limit("gap_min_m", high=0.03), Limit("false_declarations", high=0.0)
    metrics = result.metrics | {"docked": 1.0, "outcome": 0.0, "gap_min_m": 0.0179, "false_declarations": 2.0}
    for limit, changed, value, label in (
        (asked, {}, "as asked<span></span>", "Docking outcome"),
        (asked, {"docked": 0.0, "outcome": 1.0}, "jammed<span></span>", "Docking outcome"),
        (near, {}, "17.90<span>mm</span>", "Gap between facing faces, smallest"),
        (near, {"gap_min_m": math.nan}, "none<span></span>", "Gap between facing faces, smallest"),
        (false, {}, "2<span></span>", "False declarations of a dock"),
    ):
        page = write_report(tmp_path, judge("dock", 7, metrics | changed, [limit]), flight, scene(), []).read_text()
        assert f'<p class="big">{value}</p><p class="under">{label}</p>' in page
        assert "paper, real tank" not in page
        assert ("<b>2</b><span>False declarations of a dock</span>" in page) == (limit is not false)
        assert ("<b>17.90 mm</b>" in page) == (limit is not near)


@pytest.mark.slow
def test_what_the_firmware_believes_before_it_knows_its_pose_is_no_error(flight: Flight) -> None:
    ticks = np.arange(len(flight.firmware["tick"]))
    restarted = (ticks >= 800) & (ticks < 820)
    unknown = {"ready": ticks >= 30, "tag_age_ns": np.where((ticks < 50) | restarted, NEVER_AGE_NS, 0)}  # by gravity, then placed by tags
    nowhere = {name: np.where(ticks[:, None] < 50, 0.0, flight.firmware[name]) for name in ("p_wb", "setpoint_p_wb")}
    lost = {"ready": unknown["ready"] & (ticks != 700)}
    late = dataclasses.replace(flight, firmware=flight.firmware | unknown | nowhere | lost)
    assert late.placed.tolist() == ((ticks >= 50) & ~restarted).tolist()
    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        figures = overview(late, WINDOW, TANK_M, None), *(draw(late, WINDOW) for draw in (position, attitude, estimate))
    flat = [line for figure in figures for axes in figure.axes if axes.name != "3d" for line in axes.lines]
    believed = [line.get_ydata() for line in flat if line.get_label() != "truth" and len(line.get_xdata()) == len(ticks)]
    assert [np.isfinite(values).tolist() for values in believed] == [late.placed.tolist()] * 27
    pyplot.close("all")
    shown = animation(late, scene())
    for error in (shown["error_mm"], shown["angle_deg"]):
        assert [value is None for value in error] == (~late.placed[::4]).tolist()
    json.dumps(shown, allow_nan=False)


@pytest.mark.slow
def test_plots_of_a_robot_that_never_knew_its_pose_say_so(flight: Flight) -> None:
    blind = dataclasses.replace(flight, firmware=flight.firmware | {"ready": np.zeros(len(flight.time_s), bool)})
    for figure, panels in ((overview(blind, WINDOW, TANK_M, None), 2), (position(blind, WINDOW), 3), (attitude(blind, WINDOW), 3)):
        said = [text.get_text() for axes in figure.axes for text in axes.texts]
        assert said == ["the firmware never knew its pose"] * panels
        pyplot.close(figure)
    assert set(animation(blind, scene())["error_mm"]) == {None}


def test_overview_of_a_robot_that_was_hardly_steered_has_no_rmse_line(flight: Flight) -> None:
    """Its reference was its estimate. The panels were empty but for the line and its number."""
    believed = flight.firmware["p_wb"]
    setpoint = np.concatenate([believed[:-1], believed[-1:] + 0.1])
    drifting = dataclasses.replace(flight, firmware=flight.firmware | {"setpoint_p_wb": setpoint})
    figure = overview(drifting, WINDOW, TANK_M, None)
    panels = figure.axes[1:]
    assert [text.get_text() for axes in panels for text in axes.texts] == ["hardly or never steered"] * 2
    assert [axes.get_legend() for axes in panels] == [None] * 2
    pyplot.close(figure)


def test_markup_in_a_title_stays_text(flight: Flight, result: Result, tmp_path: Path) -> None:
    page = write_report(tmp_path, result, flight, scene("<script>alert(1)</script>"), []).read_text()
    assert "<script>alert" not in page


def test_plots_judge_a_robot_that_does_not_follow_as_the_table_does(flight: Flight) -> None:
    """By the same reference, which the robot was never given, and over the same ticks."""
    hover = load_scenario("hover")
    task = dataclasses.replace(hover.task, settle_s=START_NS / 1e9, duration_s=WINDOW.end_s - WINDOW.start_s)
    scenario = dataclasses.replace(hover, task=task)
    before = flight.firmware["time_ns"] < START_NS
    strays = {"rejected": np.where(before, 7 * np.arange(len(before)), 10_000), "nis": np.where(before, 50.0, flight.firmware["nis"])}
    strays["rejected"][-100:] += 3
    whole = dataclasses.replace(flight, firmware=flight.firmware | strays)
    judged = whole.between(START_NS, START_NS + round(task.duration_s * 1e9))
    metrics = flight_metrics(judged, wanted=wanted_in(scenario, judged, START_NS))
    shown = as_wanted(scenario, whole)
    labels = [text.get_text() for axes in overview(shown, WINDOW, TANK_M, None).axes[1:] for text in axes.get_legend().get_texts()]
    assert labels == [f"RMSE {shown_value(name, metrics[name])}" for name in ("position_rmse_m", "attitude_rmse_rad")]
    np.testing.assert_array_equal(shown.firmware["setpoint_p_wb"][before], flight.firmware["setpoint_p_wb"][before])
    titles = [axes.get_title(loc="left") or axes.get_title() for axes in estimate(shown, WINDOW).axes]
    assert f"Tag NIS per degree of freedom: mean {metrics['nis_mean']:.2f}" in titles
    assert metrics["tags_rejected"] == 3.0 and "Age of the last accepted tag; rejected: 3" in titles
    pyplot.close("all")


def test_animation_follows_the_true_robot(flight: Flight) -> None:
    shown = animation(flight, scene())
    (module,) = shown["modules"]
    assert len(shown["t"]) == len(shown["p"]) == len(module["p"]) == len(module["force"]) == 201
    np.testing.assert_allclose(shown["p"], flight.truth["p_wm"][::4], atol=6e-6)
    assert (module["p"], module["q"], set(module["member"]), shown["cuts"]) == (shown["p"], shown["q"], {1}, [])
    np.testing.assert_allclose(np.diff(shown["t"]), 0.04, atol=1e-9)
    json.dumps(shown, allow_nan=False)


def test_animation_of_two_docked_modules_is_as_far_off_its_reference_as_the_metric_says(tmp_path: Path) -> None:
    write_pair(tmp_path, ticks=200, joined_from=0, known_from=0, offset_m=(0.003, 0.0, -0.004))
    flight = read_flight(tmp_path)
    shown = animation(flight, scene(modules=2))
    off_m = np.linalg.norm(np.subtract(shown["p"], shown["ref_p"]), axis=1)
    np.testing.assert_allclose(off_m, flight_metrics(flight)["position_rmse_m"], atol=2e-5)
    np.testing.assert_allclose(off_m, 0.005, atol=2e-5)
    for module in shown["modules"]:
        np.testing.assert_allclose(np.linalg.norm(np.subtract(module["p"], shown["p"]), axis=1), 0.105, atol=2e-5)
        assert np.shape(module["force"]) == (50, len(module["thrusters"]["p"])) == (50, 8)
    assert [module["force"][0][0] for module in shown["modules"]] == [2.0, 3.0]


def test_animation_of_a_dock_has_both_modules_and_neither_jumps_when_they_join(dock: Flight) -> None:
    shown = animation(dock, scene(modules=2))
    json.dumps(shown, allow_nan=False)  # the page's parser takes no NaN
    leader, other = (np.array(module["p"]) for module in shown["modules"])
    gap_m = np.linalg.norm(leader - other, axis=1)
    np.testing.assert_allclose([gap_m[0], gap_m[-1]], [0.22, 0.21], atol=2e-5)
    assert np.abs(np.diff(gap_m)).max() < 5e-4
    off_m = np.linalg.norm(np.subtract(shown["p"], shown["ref_p"]), axis=1)
    np.testing.assert_allclose(off_m, 0.005, atol=2e-5)
    assert shown["modules"][1]["member"] == [0] * 25 + [1] * 25
    assert shown["cuts"] == [28]  # the firmware knows of the joint three frames after the faces locked


def test_overview_of_a_dock_shows_the_other_module_until_it_joins(dock: Flight) -> None:
    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        figure = overview(dock, Window(0.0, 2.0), TANK_M, None)
    (line,) = (line for line in figure.axes[0].lines if line.get_label() == "truth, another module")
    seen = np.isfinite(line.get_data_3d()[0])
    assert seen.tolist() == [True] * 100 + [False] * 100
    pyplot.close(figure)


def test_position_of_a_dock_shows_the_other_module_and_when_the_origin_moves(dock: Flight) -> None:
    figure = position(dock, Window(0.0, 2.0))
    lines = {line.get_label(): line for line in figure.axes[0].lines}
    assert np.isfinite(lines["truth, another module"].get_ydata()).sum() == 100
    assert lines[JOINED].get_xdata() == pytest.approx([1.12, 1.12])
    assert {JOINED, "truth, another module"} <= {text.get_text() for text in figure.legends[0].get_texts()}
    pyplot.close(figure)


def parted_again(dock: Flight) -> Flight:
    """The dock, after which the firmware takes the body apart; for ten ticks it has taken it for a whole one, 0.1 m off."""
    commanded, p_wb = dock.firmware["commanded_n"].copy(), dock.firmware["p_wb"].copy()
    commanded[-50:] = commanded[0]
    p_wb[-60:-50] += 0.1
    return dataclasses.replace(dock, firmware=dock.firmware | {"commanded_n": commanded, "p_wb": p_wb})


def test_legend_names_joins_once_however_many_there_are(dock: Flight) -> None:
    figure = overview(parted_again(dock), Window(0.0, 2.0), TANK_M, None)
    for axes in figure.axes[1:]:
        assert len([line for line in axes.lines if line.get_label() == JOINED]) == 2
        assert [text.get_text() for text in axes.get_legend().get_texts()].count(JOINED) == 1
    pyplot.close(figure)


@pytest.mark.slow
def test_errors_of_a_body_that_comes_apart_do_not_flatten_those_of_the_estimate(dock: Flight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.plots.PARTING_S", 0.2)
    figures = [estimate(each, Window(0.0, 2.0)) for each in (dock, parted_again(dock))]
    before, after = (figure.axes[0].get_ylim() for figure in figures)
    assert after == pytest.approx(before, rel=0.2)
    for figure in figures:
        pyplot.close(figure)


@pytest.mark.slow
def test_plots_of_a_dock_say_whose_body_they_show(dock: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **_: said.append(f"{path.stem}: {figure.get_suptitle()}"))
    write_plots(dock, tmp_path, Window(0.0, 2.0), TANK_M, np.array([-8.0, 10.0]), numbers=(3, 7))
    for name in ("position", "attitude", "estimate", "disturbance"):
        assert any(each.startswith(f"{name}: The body that module 3 leads") for each in said)


def test_overview_draws_the_reference_over_the_truth_and_a_round_tank_round(flight: Flight) -> None:
    figure = overview(flight, WINDOW, TANK_M, None, "cylinder")
    axes = figure.axes[0]
    labels = [line.get_label() for line in axes.lines]
    assert not axes.computed_zorder and labels.index("reference") > labels.index("truth")
    rim = np.array(axes.lines[0].get_data_3d())
    np.testing.assert_allclose(np.hypot(rim[0], rim[1] - rim[1].mean()), 0.65, atol=0.01)
    pyplot.close(figure)


def test_overview_of_a_short_path_is_enlarged_to_it(flight: Flight) -> None:
    figure = overview(flight, WINDOW, 20.0 * TANK_M, None)
    axes = figure.axes[0]
    assert axes.get_title() == "Path, enlarged: the tank is left out"
    assert axes.get_xlim()[1] - axes.get_xlim()[0] < 1.0
    pyplot.close(figure)


def test_errors_are_not_drawn_while_the_reference_is_the_estimate(flight: Flight) -> None:
    setpoint = flight.firmware["setpoint_p_wb"].copy()
    setpoint[:100] = flight.firmware["p_wb"][:100]
    early = dataclasses.replace(flight, firmware=flight.firmware | {"setpoint_p_wb": setpoint})
    for draw, at in ((position, 1), (attitude, 0)):
        figure = draw(early, WINDOW)
        (line,) = (line for line in figure.axes[at].lines if line.get_label() == "truth - reference")
        assert np.isfinite(line.get_ydata()).tolist() == [False] * 100 + [True] * (len(setpoint) - 100)
        pyplot.close(figure)


@pytest.mark.slow
def test_thrusters_that_joined_later_stay_inside_their_axes(dock: Flight) -> None:
    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        figure = thrusters(dock, Window(0.0, 2.0), np.array([-8.0, 10.0]))
    assert all(axes.get_ylim() == pytest.approx((-3.45, 3.45)) for axes in figure.axes)
    pyplot.close(figure)


def test_thrusters_of_each_module_stand_in_a_column_under_its_name(dock: Flight) -> None:
    figure = thrusters(dock, Window(0.0, 2.0), np.array([-8.0, 10.0]), numbers=(3, 7))
    columns = {number: [axes for axes in figure.axes if axes.get_subplotspec().colspan.start == number] for number in range(2)}
    for column, (name, newton) in enumerate((("Module 3", 2.0), ("Module 7, commands while docked", 3.0))):
        titles = [axes.get_title(loc="left") or axes.get_title() for axes in columns[column]]
        assert titles == [name] + [""] * 7
        assert [axes.get_ylabel() for axes in columns[column]] == [f"T{i}, N" for i in range(1, 9)]
        for axes in columns[column]:
            (truth,) = (line.get_ydata() for line in axes.lines if line.get_label() == "truth")
            assert np.max(truth) == np.min(truth) == newton, "also while the module was apart"
    pyplot.close(figure)


@pytest.mark.parametrize(("modules", "shape", "empty"), [(1, (4, 2), 0), (2, (8, 2), 0), (4, (8, 4), 0), (5, (16, 3), 8), (8, (16, 4), 0)])
def test_every_thruster_has_a_panel_of_its_own(modules: int, shape: tuple[int, int], empty: int) -> None:
    layout = _columns_of(modules, 8)
    assert layout.shape == shape
    assert sorted(layout.flat) == [-1] * empty + list(range(8 * modules))
    if modules > 1:
        columns = [column for block in np.split(layout, len(layout) // 8) for column in block.T if column.max() >= 0]
        assert [column.tolist() for column in columns] == np.arange(8 * modules).reshape(modules, 8).tolist()


def test_values_are_shown_in_units_that_people_read() -> None:
    assert shown_value("position_rmse_m", 0.00272) == "2.72 mm"
    assert shown_value("attitude_rmse_rad", math.radians(1.5)) == "1.50 deg"
    assert shown_value("sigma3_share", 0.97) == "97.0 %"
    assert shown_value("nis_mean", math.nan) == "none"
    assert shown_value("gap_min_m", -1e-7) == "0.00 mm"
    assert shown_value("docking_tries", 3.0) == "3.0000"
    assert shown_limit("position_rmse_m", -1e9, 0.005) == "<= 5 mm"
    assert shown_limit("sigma3_share", 0.97, math.inf) == ">= 97 %"
    assert shown_limit("nis_mean", 0.7, 1.4) == "0.7 to 1.4"


def test_outcome_of_a_dock_is_shown_in_words_and_so_is_its_limit() -> None:
    assert [shown_value("outcome", number) for number in range(5)] == ["as asked", "jammed", "unstable control", "refused", "gave up"]
    assert (shown_value("docked", 0.0), shown_value("docked", 1.0), shown_value("outcome", math.nan)) == ("no", "yes", "none")
    assert (shown_limit("docked", 1.0, UNBOUNDED), shown_limit("outcome", 3.0, 3.0)) == ("yes", "refused")
    assert shown_limit("outcome", 0.0, 1.0) == "as asked or jammed"


def test_metrics_of_force_tracking_have_names_for_people() -> None:
    labels = [shown(name).label for name in force_names([1, 2])]
    assert len(set(labels)) == len(labels)
    assert labels[:2] == [f"Force RMSE, difference of two modules from one, interference {w}" for w in ("off", "on")]
    assert "Force RMSE per module, one module, interference on" in labels
    assert "Force fit, degree 3, two modules, interference off" in labels
    assert (shown_value("force_difference_off", 0.021), shown_value("force_rmse_two_on_n", 0.25)) == ("2.10 %", "0.25 N")


def test_every_metric_of_a_flight_has_a_name_for_people(result: Result) -> None:
    assert set(result.metrics) <= set(SHOWN)
    names = ["unheard_of", "ticks", "position_rmse_m", "ticks"]
    assert metric_order(names) == ["position_rmse_m", "ticks", "unheard_of"]


def test_terminal_table_names_the_check_that_failed(result: Result) -> None:
    console = Console(file=io.StringIO(), width=80)
    limits = [Limit("position_rmse_m", high=1e-6), Limit("attitude_rmse_rad", high=1e-6), Limit("attitude_max_rad", high=1.0)]
    print_result(judge("spiral", 7, result.metrics, limits), Path("out") / "report.html", console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "FAILED: Position RMSE, truth against reference; Attitude RMSE, truth against reference\n" in text  # longer than a line
    assert "spiral, seed 7" in text
    assert "report: out/report.html" in text


def test_table_and_report_say_what_the_firmware_warned_of(flight: Flight, result: Result, tmp_path: Path) -> None:
    texts = ["ARM refused: no pose yet", "armed", "ARM refused: no pose yet", *(f"thruster {i} <weak>" for i in range(7))]
    severity, times = np.array([4, 6, 4] + [3] * 7), START_NS + 500_000_000 * np.arange(2, 12)
    lines = warning_lines({"severity": severity, "text": np.array(texts), "log_time": times}, START_NS)
    assert lines[:2] == ("1.0 s: ARM refused: no pose yet (2 x)", "2.5 s: thruster 0 <weak>") and len(lines) == 8
    warned, console = result._replace(warnings=lines), Console(file=io.StringIO(), width=100)
    print_result(warned, None, console)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert "Warnings of the firmware:\n  1.0 s: ARM refused: no pose yet (2 x)\n" in shown
    assert "thruster 4" in shown and "thruster 5" not in shown and "and 2 more" in shown
    page = write_report(tmp_path, warned, flight, scene(), []).read_text()
    assert "<h3>Warnings of the firmware</h3>" in page
    assert "<li>5.5 s: thruster 6 &lt;weak&gt;</li>" in page
    assert "<p>no tag &lt;5&gt;</p>" in write_report(tmp_path, result._replace(no_tag_reason="no tag <5>"), flight, scene(), []).read_text()
    assert "Warnings of the firmware</h3>" not in write_report(tmp_path, result, flight, scene(), []).read_text()


def test_progress_is_silent_where_nobody_looks() -> None:
    console = Console(file=io.StringIO(), force_terminal=False)
    with flight_progress("spiral", 40.0, console) as advance:
        advance(20.0)
    assert console.file.getvalue().strip() == ""  # type: ignore[attr-defined]
