#!/usr/bin/env python3
"""Tune controller and estimator parameters on the bench with Optuna. Killed and started again, it goes on: no finished trial is lost.

    .venv/bin/python tools/tune_gains.py tools/objectives/hover.toml --trials 12 --out runs/tune

The objective is a file: which flights, which seeds, which parameters within which bounds, and what each metric costs. The best
parameters are written as a file for `--controller`, with the figures on seeds that the search never saw beside the hand-set ones.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.description.parameters import Parameters, load_parameters
from firmware_py.description.schema import DescriptionError, build, quantity, read_toml, to_toml
from hil.flight import fly_and_judge
from hil.scenario import Scenario, load_scenario

FAILED_COST = 1e6
"""Cost of a flight that could not be judged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSpec:
    """One flight of the objective."""

    scenario: str = quantity(help="name of a scenario")
    settle_s: float = quantity(unit="s", low=1, high=60, help="held before the task")
    duration_s: float = quantity(unit="s", low=1, high=600, help="of the task")
    weight: float = quantity(1.0, low=0, high=1e3, help="share in the sum")


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """One parameter and its bounds."""

    parameter: str = quantity(help="as group.field")
    low: float = quantity(help="lowest tried")
    high: float = quantity(help="highest tried")
    logarithmic: bool = quantity(False, help="search on a logarithmic scale")


@dataclass(frozen=True, slots=True, kw_only=True)
class Term:
    """What a metric costs."""

    metric: str = quantity(help="name in result.json")
    per: float = quantity(low=1e-12, high=1e12, help="this much of the metric costs `weight`")
    weight: float = quantity(1.0, low=0, high=1e3, help="cost of `per`")


@dataclass(frozen=True, slots=True, kw_only=True)
class Objective:
    """What is to be made small."""

    help: str = quantity(help="one line")
    flight: tuple[FlightSpec, ...] = quantity(help="flights of each seed")
    search: tuple[Search, ...] = quantity(help="what may change")
    term: tuple[Term, ...] = quantity(help="what costs")
    seeds: tuple[int, ...] = quantity(low=0, high=2**31, help="worlds of the search")
    unseen_seeds: tuple[int, ...] = quantity(low=0, high=2**31, help="worlds of the comparison")
    worst_share: float = quantity(0.0, low=0, high=1, help="share of the worst flight in the objective")

    def __post_init__(self) -> None:
        if set(self.seeds) & set(self.unseen_seeds):
            raise DescriptionError("a seed is both in seeds and in unseen_seeds; the comparison needs worlds of its own")
        for search in self.search:
            Parameters().replace(search.parameter, search.low)
            Parameters().replace(search.parameter, search.high)


def cost_of_flight(objective: Objective, spec: FlightSpec, seed: int, parameters: Parameters) -> float:
    """Cost of one flight. A metric that is missing costs the most."""
    scenario = _shortened(load_scenario(spec.scenario), spec)
    with tempfile.TemporaryDirectory() as folder:
        metrics = fly_and_judge(scenario, seed, parameters, Path(folder), f"virtual:tune{seed}").metrics
    values = [term.weight * metrics.get(term.metric, np.nan) / term.per for term in objective.term]
    cost = spec.weight * float(np.sum(values))
    return cost if np.isfinite(cost) else FAILED_COST


def cost(objective: Objective, seeds: Sequence[int], parameters: Parameters, pool: Executor) -> tuple[float, list[float]]:
    """The objective over `seeds`, and the cost of each flight, in a fixed order."""
    jobs = [pool.submit(cost_of_flight, objective, spec, seed, parameters) for seed in seeds for spec in objective.flight]
    costs = [job.result() for job in jobs]
    return (1 - objective.worst_share) * float(np.mean(costs)) + objective.worst_share * max(costs), costs


def _shortened(scenario: Scenario, spec: FlightSpec) -> Scenario:
    task = dataclasses.replace(scenario.task, settle_s=spec.settle_s, duration_s=spec.duration_s)
    return dataclasses.replace(scenario, task=task)


def tune(objective: Objective, start: Parameters, trials: int, out: Path, pool: Executor, seed: int) -> Any:
    """Runs the search until `trials` trials are done, counting those of earlier runs in the same folder."""
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    storage = JournalStorage(JournalFileBackend(str(out / "trials.log")))
    sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=max(4, len(objective.search)))
    study = optuna.create_study(study_name="gains", storage=storage, sampler=sampler, load_if_exists=True)
    if not study.trials:
        study.enqueue_trial({s.parameter: _get(start, s.parameter) for s in objective.search})

    def evaluate(trial: Any) -> float:
        chosen = start
        for s in objective.search:
            chosen = chosen.replace(s.parameter, trial.suggest_float(s.parameter, s.low, s.high, log=s.logarithmic))
        value, _ = cost(objective, objective.seeds, chosen, pool)
        return value

    def tell(study: Any, trial: Any) -> None:
        print(f"trial {trial.number + 1:4d} of {trials}: {trial.value:9.4f}   best {study.best_value:9.4f}", flush=True)

    done = sum(t.state == optuna.trial.TrialState.COMPLETE for t in study.trials)
    study.optimize(evaluate, n_trials=max(0, trials - done), callbacks=[tell])
    return study


def _get(parameters: Parameters, dotted: str) -> float:
    group, _, name = dotted.partition(".")
    return float(getattr(getattr(parameters, group), name))


def write_result(objective: Objective, start: Parameters, best: Parameters, study: Any, out: Path, pool: Executor) -> dict[str, Any]:
    """Compares start, shipped and best on unseen seeds; writes parameters.toml and tuning.json."""
    compared = {"start": start, "shipped": Parameters(), "tuned": best}
    figures = {}
    for name, parameters in compared.items():
        value, costs = cost(objective, objective.unseen_seeds, parameters, pool)
        figures[name] = {"objective": value, "worst": max(costs), "flights": len(costs)}
    result = {
        "objective": objective.help,
        "trials": len(study.trials),
        "seeds": list(objective.seeds),
        "unseen_seeds": list(objective.unseen_seeds),
        "versions": {name: version(name) for name in ("modcube", "numpy", "optuna")},
        "best": study.best_params,
        "unseen": figures,
    }
    (out / "tuning.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    head = f"# Tuned by tools/tune_gains.py: {objective.help}\n# seeds {list(objective.seeds)}, {len(study.trials)} trials\n"
    (out / "parameters.toml").write_text(head + to_toml(best).lstrip("\n"), encoding="utf-8")
    return result


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("objective", type=Path, help="objective file, such as tools/objectives/spiral.toml")
    parser.add_argument("--trials", type=int, default=40, help="trials in all, earlier ones in the same folder counted")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--start", type=Path, help="parameter file to start from; the shipped gains without it")
    parser.add_argument("--seed", type=int, default=0, help="of the search itself")
    parser.add_argument("--out", type=Path, default=Path("runs/tune"), help="folder for trials, parameters.toml and tuning.json")
    arguments = parser.parse_args()
    try:
        table, source = read_toml(arguments.objective)
        objective: Objective = build(Objective, table, source)
        start = load_parameters(arguments.start) if arguments.start else Parameters()
        for spec in objective.flight:
            load_scenario(spec.scenario)
    except DescriptionError as error:
        print(f"tune_gains: {error}", file=sys.stderr)
        return 2
    arguments.out.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(arguments.jobs, mp_context=get_context("spawn")) as pool:
        study = tune(objective, start, arguments.trials, arguments.out, pool, arguments.seed)
        best = start
        for name, value in study.best_params.items():
            best = best.replace(name, value)
        result = write_result(objective, start, best, study, arguments.out, pool)
    for name, figures in result["unseen"].items():
        print(f"{name:8s} objective on unseen seeds {figures['objective']:9.4f}, worst flight {figures['worst']:9.4f}")
    print(f"parameters: {arguments.out / 'parameters.toml'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
