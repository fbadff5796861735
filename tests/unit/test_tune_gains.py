"""The gain search: the cost of a trial, early end of worse trials, resuming after a kill, and refusals."""

import itertools
import json
import os
import re
import signal
from collections.abc import Iterator
from concurrent.futures import Executor
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from hil.scenario import Scenario
from tests.unit.campaigns import Inline

ROOT = Path(__file__).resolve().parents[2]
BANDWIDTH, DAMPING = "control.position_bandwidth", "control.position_damping"
OBJECTIVE = """
help = "a valley"
seeds = [0, 1]
unseen_seeds = [7]
worst_share = 0.5
flight = [{ scenario = "hover", weight = 0.5 }, { scenario = "spiral" }]
search = [
    { parameter = "control.position_bandwidth", low = 0.5, high = 8.0, logarithmic = true },
    { parameter = "control.position_damping", low = 0.3, high = 3.0 },
]
term = [{ metric = "position_rmse_m", per = 0.001 }, { metric = "thrust_rms_n", per = 1.0, weight = 0.5 }]
"""
MARGINS = "gain_db = 8.0, phase_deg = 40.0, per_db = 0.5, per_deg = 4.0"
START = Parameters().replace(BANDWIDTH, 7.5).replace(DAMPING, 1.0)


@pytest.fixture
def tools(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Any, Any]]:
    """The modules tune_objective and tune_search; simulated flights take no time and are best at gains of 2 rad/s and 1."""
    import tune_objective
    import tune_search

    def fly(scenario: Scenario, parameters: Parameters, seed: int, bus: str, code: str) -> dict[str, Any]:
        c = parameters.control
        off = (c.position_bandwidth - 2.0) ** 2 + (c.position_damping - 1.0) ** 2
        return {"seed": seed, "metrics": {"position_rmse_m": 0.001 * (1.0 + 0.1 * seed + off), "thrust_rms_n": 1.0}}

    monkeypatch.setattr(tune_search, "fly_trial", fly)
    yield tune_objective, tune_search


def objective_of(tools: tuple[Any, Any], folder: Path, text: str = OBJECTIVE) -> Any:
    path = folder / "objective.toml"
    path.write_text(text)
    return tools[0].load_objective(path)


class PlugError(Exception):
    """A simulated loss of power."""


class Dying(Inline):
    """An executor that loses its power after `flights` flights."""

    def __init__(self, flights: int) -> None:
        self.left = flights

    def submit(self, *args: Any, **kwargs: Any) -> Any:
        if self.left == 0:
            raise PlugError
        self.left -= 1
        return super().submit(*args, **kwargs)


def search(tools: tuple[Any, Any], out: Path, trials: int, pool: Executor, seed: int = 0) -> Any:
    out.mkdir(exist_ok=True)
    return tools[1].search(objective_of(tools, out), START, trials, out, pool, seed, lambda progress: None)


def test_cost_is_the_mean_of_all_flights_and_the_worst_one_s_share(tools: tuple[Any, Any], tmp_path: Path) -> None:
    objective = objective_of(tools, tmp_path)
    costs = [objective.cost(spec, {"position_rmse_m": 0.003, "thrust_rms_n": 2.0}) for spec in objective.flight]
    assert costs == pytest.approx([0.5 * (3.0 + 1.0), 3.0 + 1.0])
    assert objective.total(costs) == pytest.approx(0.5 * 3.0 + 0.5 * 4.0)


@pytest.mark.parametrize("metrics", [{}, {"position_rmse_m": 0.003, "thrust_rms_n": None}, {"position_rmse_m": 1e9, "thrust_rms_n": 1.0}])
def test_flight_that_cannot_be_judged_costs_the_most(tools: tuple[Any, Any], tmp_path: Path, metrics: dict[str, float | None]) -> None:
    objective = objective_of(tools, tmp_path)
    assert objective.cost(objective.flight[1], metrics) == tools[0].FAILED_COST


@pytest.mark.slow
def test_margins_that_lack_cost_on_top_and_those_that_suffice_cost_nothing(
    tools: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Any, ...]] = []

    def measured(modules: int, parameters: Parameters, scale: tuple[float, ...], vehicle: str) -> list[Any]:
        asked.append((modules, tuple(scale), vehicle))
        return [(10.0, 50.0, 3.0), (7.0, 38.0, 3.0)]

    monkeypatch.setattr(tools[0], "measure", measured)
    monkeypatch.setattr(tools[0], "margins", lambda response: response)
    light = f"modules = 2, mass = 0.85, lag = 1.15, {MARGINS.replace('8.0', '6.0').replace('40.0', '30.0')}"
    text = f"{OBJECTIVE}stability = [{{ {MARGINS} }}, {{ {light} }}]\n"
    objective = objective_of(tools, tmp_path, text)
    assert objective.shortfall(START) == pytest.approx(1.0 / 0.5 + 2.0 / 4.0)
    assert asked == [(1, (1.0, 1.0, 1.0), "modcube"), (2, (0.85, 1.0, 1.15), "modcube")]
    flights, lacking = (list(tools[1].running_totals(objective_of(tools, tmp_path, t), START, Inline())) for t in (OBJECTIVE, text))
    assert lacking == pytest.approx([value + 2.5 for value in flights])


@pytest.mark.slow
def test_search_finds_the_valley_and_ends_early_what_lies_above_it(tools: tuple[Any, Any], tmp_path: Path) -> None:
    study = search(tools, tmp_path, 25, Inline())
    assert study.trials[0].params == {BANDWIDTH: 7.5, DAMPING: 1.0}
    assert study.best_params == pytest.approx({BANDWIDTH: 2.0, DAMPING: 1.0}, abs=0.1)
    pruned = [t for t in study.trials if len(t.intermediate_values) == 1]
    assert 1 <= len(pruned) < 20
    assert min(t.intermediate_values[0] for t in pruned) > study.best_trial.intermediate_values[0]


@pytest.mark.slow
@pytest.mark.parametrize("flights", [1, 17, 40])
def test_search_that_was_killed_loses_no_trial_and_ends_in_the_same_bytes(tools: tuple[Any, Any], tmp_path: Path, flights: int) -> None:
    search(tools, tmp_path / "whole", 14, Inline())
    with pytest.raises(PlugError):
        search(tools, tmp_path / "torn", 14, Dying(flights))
    path = tmp_path / "torn" / "search.jsonl"
    kept = path.read_bytes()
    path.write_bytes(kept + b'{"number": 1, "param')  # the line that was being written
    search(tools, tmp_path / "torn", 14, Inline())
    assert path.read_bytes().startswith(kept)
    assert path.read_bytes() == (tmp_path / "whole" / "search.jsonl").read_bytes()


@pytest.mark.slow
def test_objective_that_reaches_zero_is_searched_on(tools: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fly(scenario: Scenario, parameters: Parameters, seed: int, bus: str, code: str) -> dict[str, Any]:
        return {"seed": seed, "metrics": {"position_rmse_m": 0.0, "thrust_rms_n": max(0.0, parameters.control.position_bandwidth - 2.0)}}

    monkeypatch.setattr(tools[1], "fly_trial", fly)
    study = search(tools, tmp_path, 14, Inline())
    assert study.best_value == 0.0 and len(study.trials) == 14


@pytest.mark.slow
def test_gains_that_are_best_at_their_bounds_are_not_flown_twice(
    tools: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fly(scenario: Scenario, parameters: Parameters, seed: int, bus: str, code: str) -> dict[str, Any]:
        return {"seed": seed, "metrics": {"position_rmse_m": 0.001, "thrust_rms_n": 20.0 - parameters.control.position_bandwidth}}

    monkeypatch.setattr(tools[1], "fly_trial", fly)
    start, searched = OBJECTIVE.index("    { parameter"), OBJECTIVE.index("]\nterm")
    objective = OBJECTIVE[:start] + f'{{ parameter = "{BANDWIDTH}", low = 0.5, high = 8.0 }}' + OBJECTIVE[searched:]
    study = tools[1].search(objective_of(tools, tmp_path, objective), START, 14, tmp_path, Inline(), 0, lambda progress: None)
    assert study.best_params == {BANDWIDTH: 8.0}
    assert len({trial.params[BANDWIDTH] for trial in study.trials}) == 14


@pytest.mark.slow
def test_other_seed_searches_elsewhere(tools: tuple[Any, Any], tmp_path: Path) -> None:
    first, second = (search(tools, tmp_path / str(seed), 5, Inline(), seed) for seed in (0, 1))
    assert first.trials[0].params == second.trials[0].params and first.trials[1].params != second.trials[1].params


@pytest.mark.slow
def test_folder_of_another_search_is_not_thrown_away(tools: tuple[Any, Any], tmp_path: Path) -> None:
    search(tools, tmp_path, 2, Inline())
    objective = objective_of(tools, tmp_path)
    search(tools, tmp_path, 2, Inline())
    with pytest.raises(DescriptionError, match=r"search.jsonl holds trials of another objective.*give another --out"):
        tools[1].search(objective, Parameters(), 2, tmp_path, Inline(), 0, lambda progress: None)
    assert json.loads((tmp_path / "search.jsonl").read_text().splitlines()[-1])["number"] == 1


@pytest.mark.slow
def test_folder_is_of_another_search_when_its_scenario_was_edited(tools: tuple[Any, Any], tmp_path: Path) -> None:
    scenario = tmp_path / "mine.toml"
    scenario.write_bytes((ROOT / "hil" / "scenarios" / "hover.toml").read_bytes())
    text = OBJECTIVE.replace('"hover"', f'"{scenario}"')
    before = tools[1].identity(objective_of(tools, tmp_path, text), START, 0)
    assert tools[1].identity(objective_of(tools, tmp_path, text), START, 0) == before
    scenario.write_text(scenario.read_text().replace("duration_s = 60.0", "duration_s = 50.0"))
    assert tools[1].identity(objective_of(tools, tmp_path, text), START, 0) != before


@pytest.mark.parametrize("words", ["--trials 0", "--jobs 0", "--seed -1", "--detune -1", "--minutes -1", "--minutes nan", "--seconds nan"])
def test_number_that_makes_no_sense_is_refused_in_one_line(
    tools: tuple[Any, Any], words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import tune_gains

    monkeypatch.setattr("sys.argv", ["tune_gains.py", "tools/objectives/hover.toml", *words.split()])
    with pytest.raises(SystemExit) as refusal:
        tune_gains.main()
    assert refusal.value.code == 2
    assert "is not a" in capsys.readouterr().err.splitlines()[-1]


def test_search_that_is_terminated_from_elsewhere_says_that_it_goes_on(
    tools: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import tune_gains

    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    monkeypatch.setattr(tune_gains, "tune", lambda *_: signal.raise_signal(signal.SIGTERM))
    monkeypatch.setattr("sys.argv", ["tune_gains.py", str(ROOT / "tools" / "objectives" / "hover.toml"), "--out", str(tmp_path)])
    assert tune_gains.main() == tune_gains.INTERRUPTED
    signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err == f"tune_gains: interrupted; the same command with --out {tmp_path} goes on where it was\n"


def test_flight_through_the_points_of_a_file_is_flown_with_them(tools: tuple[Any, Any], tmp_path: Path) -> None:
    flown = objective_of(tools, tmp_path, OBJECTIVE.replace('"spiral"', '"waypoints", settle_s = 8.0')).flight[1].flown()
    assert flown.task.settle_s == 8.0 and flown.task.file_text.startswith("x_m")



@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("unseen_seeds = [7]", "unseen_seeds = [1]", "a seed is both in seeds and in unseen_seeds"),
        ("high = 8.0", "high = 80.0", "position_bandwidth: 80.0 is out of range"),
        ("control.position_damping", "control.position_dampin", r"toml:7: .* unknown; did you mean control\.position_damping\? `mod"),
        ("high = 8.0", "high = 0.4", "low 0.5 is not below high 0.4"),
        ('scenario = "hover"', 'scenario = "hoover"', r"objective\.toml:\d+: flight\[0\]: scenario 'hoover' is unknown"),
        ('"spiral"', '"spiral", settle_s = 0.5', r"flight\[1\]: spiral as flown here: task\.settle_s: 0\.5 s; the robot"),
        ("unseen_seeds = [7]", "unseen_seeds = []", "unseen_seeds is empty; an objective needs one at least"),
        ("help = \"a valley\"", "help = \"\"\"a\nvalley\"\"\"", "help has more than one line"),
        ("control.position_damping", "control.position_bandwidth", "position_bandwidth is searched twice"),
        ("position_rmse_m", "position_rmse", r"objective\.toml:11: metric 'position_rmse' is unknown; did you mean position_rmse_m\?$"),
        ("thrust_rms_n", "docked_rmse_m", r"flight\[0\]: a trial of hover has no docked_rmse_m, which a term asks of every flight"),
        ("thrust_rms_n", "real_time_factor", r"flight\[0\]: a trial of hover has no real_time_factor"),
        ("term = [", f"stability = [{{ modules = 3, {MARGINS} }}]\nterm = [", "stability of 3 modules; there are bodies of 1, 2, 4"),
    ],
)
def test_objective_that_makes_no_sense_is_refused(tools: tuple[Any, Any], tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(DescriptionError, match=words) as refusal:
        objective_of(tools, tmp_path, OBJECTIVE.replace(old, new))
    assert "\n" not in str(refusal.value)


def test_files_that_an_objective_names_lie_beside_it(tools: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever the search is started, as those of a scenario and of a fleet do."""
    (tmp_path / "mine.toml").write_text((ROOT / "firmware_py" / "vehicles" / "bluerov2.toml").read_text())
    (tmp_path / "still.toml").write_text((ROOT / "hil" / "scenarios" / "hover.toml").read_text())
    named = re.sub('scenario = "[a-z-]+"', 'scenario = "still.toml", vehicle = "mine.toml"', OBJECTIVE)
    monkeypatch.chdir(ROOT)
    objective = objective_of(tools, tmp_path, named)
    assert objective.vehicle == str(tmp_path / "mine.toml") and objective.flight[0].flown().name == "hover"


def test_search_is_the_same_in_whatever_folder_its_files_are_named(
    tools: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: one that was killed was refused as another where its objective was named by a longer path."""
    (tmp_path / "mine.toml").write_text((ROOT / "firmware_py" / "vehicles" / "bluerov2.toml").read_text())
    named = re.sub('scenario = "[a-z-]+"', 'scenario = "hover", vehicle = "mine.toml"', OBJECTIVE)
    there = objective_of(tools, tmp_path, named)
    monkeypatch.chdir(tmp_path)
    here = objective_of(tools, Path(), named)
    assert here.vehicle != there.vehicle
    assert tools[1].identity(here, START, 0) == tools[1].identity(there, START, 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hover", "shipped", "spiral", "spiral-and-push"])
def test_objectives_that_are_shipped_can_be_flown(tools: tuple[Any, Any], name: str) -> None:
    objective = tools[0].load_objective(ROOT / "tools" / "objectives" / f"{name}.toml")
    assert set(objective.start(Parameters())) == {s.parameter for s in objective.search}


def test_detuned_gains_are_off_by_up_to_three_and_within_the_bounds(tools: tuple[Any, Any]) -> None:
    objective = tools[0].load_objective(ROOT / "tools" / "objectives" / "spiral-and-push.toml")
    factors = []
    for seed in range(50):
        wrong = tools[0].detuned(objective, Parameters(), 3.0, seed)
        values = {s.parameter: attrgetter(s.parameter)(wrong) for s in objective.search}
        assert objective.start(wrong) == values
        factors += [value / attrgetter(name)(Parameters()) for name, value in values.items()]
    assert 1 / 3 <= min(factors) < 0.4 and 2.5 < max(factors) <= 3.0


@pytest.fixture
def drawn(tools: tuple[Any, Any], monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The figures that tune_plots would save, laid out and drawn."""
    import matplotlib
    import tune_plots

    figures: list[Any] = []

    def keep(figure: Any, path: Path, title: str) -> None:
        figure.suptitle(title)
        figure.tight_layout()
        figure.canvas.draw()
        figures.append(figure)

    matplotlib.use("Agg")
    monkeypatch.setattr(tune_plots, "_save", keep)
    return figures


@pytest.mark.slow
def test_legends_of_the_bode_plot_stand_where_no_line_runs(drawn: list[Any]) -> None:
    from loop_response import Response
    from tune_plots import draw_bode

    w = np.geomspace(0.1, 100.0, 50)
    draw_bode(Path(), {name: [Response(w, gain * np.exp(-0.1j * w) / (1j * w))] * 6 for name, gain in (("shipped", 2.0), ("tuned", 4.0))})
    legends = [(panel, panel.get_legend()) for panel in drawn[0].axes if panel.get_legend() is not None]
    assert len(legends) == 4
    assert all(legend.get_window_extent().y0 >= panel.get_window_extent().y1 - 0.5 for panel, legend in legends)


@pytest.mark.slow
def test_bode_plot_shows_the_whole_phase_of_a_loop_that_rights_itself(drawn: list[Any]) -> None:
    from loop_response import Response
    from tune_plots import draw_bode

    w = np.geomspace(0.3, 30.0, 50)
    draw_bode(Path(), {"shipped": [Response(w, 20.0 * np.exp(1j * np.linspace(0.7, -4.0, 50)) / (1.0 + w**2))] * 6})
    phase = drawn[0].axes[-1]
    assert phase.get_ylim()[0] < phase.dataLim.ymin and phase.dataLim.ymax < phase.get_ylim()[1]


@pytest.mark.slow
@pytest.mark.parametrize(("most", "top"), [(1.0, 1.1), (1.3, 1.35), (9.0, 1.8)])
def test_steps_fill_their_plot_and_each_is_seen_where_the_others_agree_with_it(drawn: list[Any], most: float, top: float) -> None:
    from loop_response import STEP_TICKS
    from tune_plots import SHOWN, draw_steps

    draw_steps(Path(), dict.fromkeys(("start", "shipped", "tuned"), np.tile(np.linspace(0.0, most, STEP_TICKS), (len(SHOWN), 1))))
    panel = drawn[0].axes[0]
    assert panel.get_ylim() == pytest.approx((-0.05, top))
    lines = {line.get_label(): line for line in panel.get_lines()}
    assert lines["start"].get_linestyle() == "--" and lines["start"].get_zorder() > lines["tuned"].get_zorder()
    assert lines["shipped"].get_linewidth() > 2.0 * lines["tuned"].get_linewidth()


@pytest.mark.slow
def test_plots_of_a_search_are_of_the_vehicle_that_it_flies(
    drawn: list[Any], tools: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import loop_response
    import optuna
    import tune_plots

    shaken: list[str] = []

    class Still:
        """A vehicle that stays where it is."""

        def __init__(self, modules: int, parameters: Parameters, vehicle: str = "modcube") -> None:
            shaken.append(vehicle)
            self.pose = np.zeros(6)

        def step(self, shake: np.ndarray) -> None:
            pass

    def measured(modules: int, parameters: Parameters, vehicle: str) -> list[Any]:
        shaken.append(vehicle)
        return [loop_response.Response(np.array([1.0, 2.0, 3.0]), np.array([2.0, 1.0, 0.5]) * -1j)] * 6

    monkeypatch.setattr(loop_response, "Loop", Still)
    monkeypatch.setattr(tune_plots, "measure", measured)
    monkeypatch.setattr(tune_plots, "processes", lambda jobs: Inline)
    study = optuna.create_study()
    study.add_trial(optuna.trial.create_trial(value=2.0))
    sets = dict.fromkeys(("start", "shipped", "tuned"), Parameters())
    tune_plots.draw(tmp_path, objective_of(tools, tmp_path), study, sets, "bluerov2_heavy")
    assert len(drawn) == 3 and shaken == ["bluerov2_heavy"] * 5


@pytest.mark.parametrize("before", [0.5, 1.5, 1.6, 2.5, 4.4, 4.5, 9.0])
def test_refused_live_step_does_not_come_twice(tools: tuple[Any, Any], before: float) -> None:
    import tune_live

    steps = [value for _, value in tune_live.proposals({"POS_BW": before}, {"POS_BW": (1.5, 4.5)})]
    assert steps and len(set(steps)) == len(steps) and before not in steps
    assert before / 1.25 - 1e-6 <= min(steps) and max(steps) <= before * 1.25 + 1e-6


@pytest.mark.parametrize("before", [0.5, 9.0])
def test_live_value_outside_the_bounds_comes_back_to_them_without_a_leap(tools: tuple[Any, Any], before: float) -> None:
    import tune_live

    now, way = {"POS_BW": before}, [before]
    for name, value in itertools.islice(tune_live.proposals(now, {"POS_BW": (1.5, 4.5)}), 30):
        if not 1.5 <= now[name] <= 4.5:
            now[name] = value
            way.append(value)
    factors = np.array(way[1:]) / way[:-1]
    assert np.all(factors == pytest.approx(1.25)) or np.all(factors == pytest.approx(0.8))
    assert 1.5 <= way[-1] <= 4.5


def test_live_step_of_single_precision_is_not_the_value_it_has(tools: tuple[Any, Any]) -> None:
    import tune_live

    here = float(np.float32(0.1))
    steps = [value for _, value in tune_live.proposals({"POS_BW": here}, {"POS_BW": (0.05, 0.1)})]
    assert steps == pytest.approx([here / 1.25, here / 1.25**0.5, here / 1.25**0.25])
    assert not list(tune_live.proposals({"POS_BW": 0.0}, {"POS_BW": (0.05, 0.1)}))


def test_detuned_gains_are_set_against_the_tuned_on_seeds_that_neither_saw(
    tools: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import accept_tuning

    def tune(command: list[Any], **_: Any) -> None:
        out = Path(command[-1])
        out.mkdir(parents=True)
        unseen = {name: {"objective": value} for name, value in (("start", 12.0), ("shipped", 4.0), ("tuned", 3.0))}
        (out / "tuning.json").write_text(json.dumps({"start_value": 9.0, "best_value": 1.0, "unseen": unseen}))

    monkeypatch.setattr(accept_tuning.subprocess, "run", tune)
    found = accept_tuning.tuned(tmp_path)
    assert (found["ratio"], found["start"]) == (0.75, 4.0)


def test_answers_typed_at_once_are_taken_one_by_one_and_the_end_of_the_input_ends_it(tools: tuple[Any, Any]) -> None:
    import tune_live

    class Listening:
        heard = 0

        def listen(self, seconds: float) -> None:
            self.heard += 1
            os.write(end, b"Yes\n\nq\n")
            os.close(end)

    mine, end = os.pipe()
    vehicle = Listening()
    with open(mine, "rb", buffering=0) as stream:
        person = tune_live.Typist(vehicle, stream)
        assert [person.answer("?") for _ in range(4)] == ["y", "n", "q", "q"]
    assert vehicle.heard == 1


@pytest.mark.parametrize("address", ["udpin:127.0.0.1:99999", "udpout:127.0.0.1:99999", "tcp:127.0.0.1:5760x", "udpin:14550+trusted"])
def test_live_address_whose_port_is_none_is_refused_in_one_line(tools: tuple[Any, Any], address: str) -> None:
    from tune_vehicle import connect

    with pytest.raises(DescriptionError, match=f"--live mavlink:{re.escape(address)}: .* is no port, 0 to 65535; it needs an address"):
        connect(address)


def test_trials_of_the_picture_are_whole_numbers(tools: tuple[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import optuna
    import tune_plots

    drawn: list[Any] = []
    monkeypatch.setattr(tune_plots, "_save", lambda figure, path, title: drawn.append(figure))
    study = optuna.create_study()
    study.add_trials([optuna.trial.create_trial(value=value) for value in (3.0, 2.0, 2.5)])
    tune_plots.draw_search(tmp_path / "search.png", objective_of(tools, tmp_path), study)
    ticks = drawn[0].axes[0].get_xticks()
    assert [tick for tick in ticks if tick != round(tick)] == []
