"""Many seeds of one scenario: what campaign.json says of them, and what people see."""

import io
import json
import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import hil.campaign
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import load_vehicle
from hil.campaign import (
    SUMMARY_FILE,
    TABLE_FILE,
    TRIALS_FILE,
    fly_trial,
    outcome_of,
    run_campaign,
)
from hil.campaign_summary import Trial, median_interval, summarise
from hil.checks import Check, Result
from hil.console import campaign_progress, print_campaign
from hil.plant.world_parameters import world_parameters
from hil.scenario import Scenario, load_scenario
from hil.trial_file import TrialFile
from hil.workers import Pool, dask_cluster, kept


class Inline(Executor):
    """Does the work at once, in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def trial(seed: int, rmse_m: float, outcome: str = "passed") -> Trial:
    metrics = {"position_rmse_m": rmse_m, "nis_mean": None, "duration_s": 40.0}
    return {"seed": seed, "passed": outcome == "passed", "outcome": outcome, "metrics": metrics}


TRIALS = [trial(0, 0.003), trial(1, 0.011, "position_rmse_m"), trial(2, 0.004), trial(3, 0.005)]


def test_dock_that_came_to_nothing_says_why() -> None:
    docked, fence = Check("docked", 0.0, 1.0, 1.0, False), Check("position_rmse_m", 0.1, 0.0, 0.01, False)
    assert outcome_of(Result("dock", 0, False, {"outcome": 1.0}, (docked, fence))) == "jammed"
    assert outcome_of(Result("dock", 0, False, {"outcome": 0.0}, (fence,))) == "position_rmse_m"
    assert outcome_of(Result("dock", 0, True, {"outcome": 0.0}, ())) == "passed"


def test_seeds_that_failed_are_the_worst_however_near_they_flew() -> None:
    assert summarise("dock", [trial(0, 0.9), trial(1, 0.001, "jammed"), trial(2, 0.5)])["worst_seeds"] == [1, 0, 2]


def test_summary_counts_outcomes_and_names_the_worst_seeds_first() -> None:
    summary = summarise("spiral", TRIALS)
    assert (summary["trials"], summary["succeeded"]) == (4, 3)
    assert summary["outcomes"] == {"passed": 3, "position_rmse_m": 1}
    assert summary["worst_seeds"] == [1, 3, 2, 0]
    assert summary["seeds"] == [0, 1, 2, 3]


def test_quantiles_are_of_the_trials_and_a_metric_nobody_measured_has_none() -> None:
    metrics = summarise("spiral", TRIALS)["metrics"]
    assert metrics["position_rmse_m"]["median"] == pytest.approx(0.0045)
    assert metrics["position_rmse_m"]["max"] == 0.011
    assert metrics["position_rmse_m"]["min"] == 0.003
    assert metrics["nis_mean"]["median"] is None


def test_confidence_interval_is_wilsons() -> None:
    # 17 of 20, the paper's docking; by hand out of Wilson's formula, z = 1.96: 0.7936 +- 0.1540
    trials = [trial(seed, 0.001, "passed" if seed < 17 else "jammed") for seed in range(20)]
    assert summarise("dock", trials)["confidence_interval"] == pytest.approx([0.6396, 0.9476], abs=1e-4)


def flying(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, str]]:
    """Every flight takes no time; returns the (seed, bus) of those that will be flown."""
    flown: list[tuple[int, str]] = []

    def fly(scenario: Scenario, parameters: Parameters, seed: int, bus: str, code: str) -> Trial:
        flown.append((seed, bus))
        return {**trial(seed, 0.001 * seed), "world": {"mass_factor": 1.0 + 0.01 * seed}}

    monkeypatch.setattr(hil.campaign, "fly_trial", fly)
    return flown


def fly(out: Path, seeds: range, pool: Pool = Inline, **progress: Any) -> dict[str, Any]:
    return run_campaign(load_scenario("spiral"), Parameters(), seeds, pool, out, **progress)


def content(out: Path) -> list[bytes]:
    return [(out / name).read_bytes() for name in (SUMMARY_FILE, TABLE_FILE)]


def test_campaign_flies_every_seed_and_writes_what_it_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = flying(monkeypatch)
    counted: list[tuple[int, int]] = []

    def count(done: int, total: int) -> None:
        counted.append((done, total))

    summary = fly(tmp_path, range(5, 8), progress=count)
    assert sorted(seed for seed, _ in flown) == [5, 6, 7]
    assert len({bus for _, bus in flown}) == 3  # trials in one process must not hear each other
    assert counted == [(1, 3), (2, 3), (3, 3)]
    assert summary == json.loads((tmp_path / SUMMARY_FILE).read_text())
    assert summary["seeds"] == [5, 6, 7]
    rows = (tmp_path / TABLE_FILE).read_text().splitlines()
    assert rows[0] == "seed,passed,outcome,position_rmse_m,nis_mean,duration_s,world.mass_factor"
    assert rows[1] == "5,1,passed,0.005,,40.0,1.05"


class PlugError(Exception):
    """Somebody pulled the plug."""


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


def dying(after: int) -> Pool:
    """Executors whose worker dies after so many trials."""

    class Dying(Inline):
        left = after

        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            if self.left > 0:
                self.left -= 1
                return super().submit(fn, *args, **kwargs)
            future: Future[Any] = Future()
            future.set_exception(BrokenProcessPool("a worker died"))
            return future

    return Dying


def test_worker_that_dies_costs_the_trials_under_way_and_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = flying(monkeypatch)
    fly(tmp_path / "whole", range(5))
    flown.clear()
    fly(tmp_path / "dying", range(5), dying(after=2))
    assert content(tmp_path / "dying") == content(tmp_path / "whole")
    assert len(flown) <= 2 * 5


def test_workers_that_die_at_once_are_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flying(monkeypatch)
    with pytest.raises(DescriptionError, match="workers die before they finish a trial; 5 seeds are left, 0 the first"):
        fly(tmp_path, range(5), dying(after=0))


def deadly(*seeds: int) -> Pool:
    """Executors that break, as a pool of processes does, when one of these seeds is flown."""

    class Deadly(Inline):
        broken = False

        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            if self.broken:
                raise BrokenProcessPool("a worker died")
            if args[2] not in seeds:
                return super().submit(fn, *args, **kwargs)
            self.broken = True
            future: Future[Any] = Future()
            future.set_exception(BrokenProcessPool("a worker died"))
            return future

    return Deadly


@pytest.mark.parametrize(
    ("seeds", "words"),
    [
        ((0,), "workers die of these seeds, each flown alone: 0; all others are flown"),
        ((3, 4, 19), "each flown alone: 3, 4, 19; all others are flown"),
        (tuple(range(10)), "10 seeds are left, 0 the first"),
    ],
)
def test_seeds_that_kill_their_workers_are_named_when_all_others_are_flown(
    seeds: tuple[int, ...], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown = flying(monkeypatch)
    fly(tmp_path / "whole", range(20))
    with pytest.raises(DescriptionError, match=words):
        fly(tmp_path / "deadly", range(20), deadly(*seeds))
    flown.clear()
    fly(tmp_path / "deadly", range(20))
    assert [seed for seed, _ in flown] == list(seeds)
    assert content(tmp_path / "deadly") == content(tmp_path / "whole")


def test_few_trials_are_under_way_after_a_death(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown, under_way = flying(monkeypatch), []
    executors = iter([dying(after=0)(), Inline()])
    monkeypatch.setattr(hil.campaign, "FEW", 4)
    fly(tmp_path, range(20), lambda: next(executors), progress=lambda done, total: under_way.append(len(flown) - done + 1))
    assert max(under_way) == 4


def ending(end: Callable[[Future[Any]], object]) -> Pool:
    """An executor in which seed 2 ends otherwise, and then ones that do all."""

    class Ending(Inline):
        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            if args[2] != 2:
                return super().submit(fn, *args, **kwargs)
            future: Future[Any] = Future()
            end(future)
            return future

    left = [Ending]
    return lambda: left.pop()() if left else Inline()


def killed_on_dask(future: Future[Any]) -> None:
    distributed = pytest.importorskip("distributed")
    future.set_exception(distributed.KilledWorker("fly_trial", None, 3))


def cancelled_on_dask(future: Future[Any]) -> None:
    """As everything is when the scheduler is gone."""
    future.cancel()
    future.set_running_or_notify_cancel()


@pytest.mark.parametrize("end", [killed_on_dask, cancelled_on_dask])
def test_trial_that_a_cluster_loses_is_flown_again(
    end: Callable[[Future[Any]], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown = flying(monkeypatch)
    fly(tmp_path, range(5), ending(end))
    assert [seed for seed, _ in flown] == [0, 1, 3, 4, 2]


def test_trial_that_raises_takes_no_finished_one_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = flying(monkeypatch)
    with pytest.raises(PlugError):
        fly(tmp_path, range(20), ending(lambda future: future.set_exception(PlugError())))
    fly(tmp_path, range(20))
    assert [seed for seed, _ in flown] == [0, 1, *range(3, 20), 2]


def test_workers_that_are_kept_serve_every_campaign_until_one_dies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def pool() -> Executor:
        made.append(len(made))
        return dying(after=3)() if len(made) == 1 else Inline()

    flying(monkeypatch)
    with kept(pool) as workers:
        fly(tmp_path / "first", range(2), workers)
        assert made == [0]
        fly(tmp_path / "second", range(2), workers)
        fly(tmp_path / "third", range(2), workers)
    assert made == [0, 1]
    assert content(tmp_path / "first") == content(tmp_path / "second") == content(tmp_path / "third")


@pytest.mark.parametrize(
    ("address", "words"), [("nonsense", "is no address; it needs tcp://HOST:PORT"), ("tcp://127.0.0.1:1", "no dask scheduler at tcp")]
)
def test_cluster_that_is_not_there_is_said_in_one_line(address: str, words: str) -> None:
    with pytest.raises(DescriptionError, match=words):
        dask_cluster(address)


def test_worker_with_other_code_is_refused() -> None:
    with pytest.raises(DescriptionError, match="other code than this machine"):
        fly_trial(load_scenario("hover"), Parameters(), 0, "virtual:other", "not this code")


def test_median_lies_between_the_sixth_and_the_fifteenth_of_twenty() -> None:
    # Table of David and Nagaraja: 95.9 % for the 6th and 15th order statistics of 20; no interval of 5 values has 95 %
    assert median_interval(np.arange(1.0, 21.0)) == (6.0, 15.0)
    assert median_interval(np.arange(5.0)) == (None, None)
    assert median_interval(np.arange(6.0)) == (0.0, 5.0)


def worlds(count: int) -> list[Trial]:
    made = [{"mass_factor": i / count, "trim_m": (17 * i) % count / count, "still": 0.0} for i in range(count)]
    return [{**trial(i, 0.001 * math.exp(3.0 * world["mass_factor"])), "world": world} for i, world in enumerate(made)]


def test_metric_that_follows_a_parameter_of_the_world_shows_it_and_one_that_does_not_shows_none() -> None:
    found = summarise("spiral", worlds(40))["sensitivities"]["position_rmse_m"]
    assert found["mass_factor"]["rho"] == pytest.approx(1.0) and found["mass_factor"]["low"] > 0.99
    assert found["trim_m"]["low"] < 0.0 < found["trim_m"]["high"]
    assert "still" not in found
    assert not summarise("spiral", worlds(9))["sensitivities"]


def test_people_read_what_a_metric_goes_with() -> None:
    console = Console(file=io.StringIO(), width=160)
    print_campaign(summarise("spiral", worlds(40)), console)
    assert "Position RMSE, truth against reference goes with: mass_factor 1.00 (" in console.file.getvalue()  # type: ignore[attr-defined]


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


def test_table_of_a_campaign_shows_units_failures_and_worst_seeds() -> None:
    console = Console(file=io.StringIO(), width=120)
    print_campaign(summarise("spiral", TRIALS), console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "3 of 4 passed" in text
    assert "4.50 mm" in text
    assert "FAILED: position_rmse_m 1" in text
    assert "worst seeds: 1, 3, 2, 0" in text


def test_progress_of_a_campaign_leaves_no_trace_in_a_file() -> None:
    console = Console(file=io.StringIO(), force_terminal=False)
    with campaign_progress("spiral", 20, console) as count:
        count(1, 20)
    assert console.file.getvalue().strip() == ""  # type: ignore[attr-defined]
