"""The search of tune_gains: a sampler proposes, the bench flies, and every trial is on disk before the next one begins.

A trial's proposal depends only on the seed, its number and the trials before it. A search that was killed and is started again therefore
makes the same proposals, and ends in the same bytes as an uninterrupted one.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from optuna.distributions import FloatDistribution
from optuna.trial import TrialState, create_trial
from tune_objective import Objective, with_values
from tune_sampler import GaussianProcessSampler

from firmware_py.description.parameters import Parameters
from hil import campaign
from hil.campaign import code_digest, fly_trial
from hil.trial_file import TrialFile

TRIALS_FILE = "search.jsonl"
SOURCES = ("loop_response.py", "tune_objective.py", "tune_sampler.py", "tune_search.py")
"""Sources here on which a trial depends, besides the packages."""
FIRST_AT_RANDOM = 8
"""Trials, including the start, before the sampler uses its model."""


class Progress(NamedTuple):
    """Progress shown after every trial."""

    number: int
    value: float
    pruned: bool
    best: float


def identity(objective: Objective, start: Parameters, seed: int) -> str:
    """Hash of the search: with the same identity and number, a trial is the same. Covers the objective, the flights as they are in their
    files, which may lie in any folder, the start, the seed, and the code here and in the packages.
    """
    named = tuple(replace(spec, scenario=Path(spec.scenario).name, vehicle=Path(spec.vehicle).name) for spec in objective.flight)
    flights = [campaign.identity(spec.flown(), start) for spec in objective.flight]
    here = [(Path(__file__).parent / name).read_bytes() for name in SOURCES]
    parts = (flights, hashlib.sha256(b"".join(here)).hexdigest(), asdict(replace(objective, flight=named)), seed)
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def running_totals(objective: Objective, parameters: Parameters, pool: Executor) -> Iterator[float]:
    """Yields the objective over the search's seeds after each of its flights has been flown in all worlds.

    The margins are measured in this process while the first flight is flown.
    """
    costs: list[float] = []
    code, lacking = code_digest(), None
    for spec in objective.flight:
        jobs = [pool.submit(fly_trial, spec.flown(), parameters, seed, f"virtual:tune{seed}", code) for seed in objective.seeds]
        lacking = objective.shortfall(parameters) if lacking is None else lacking
        costs += [objective.cost(spec, job.result()["metrics"]) for job in jobs]
        yield lacking + objective.total(costs)


def search(
    objective: Objective,
    start: Parameters,
    trials: int,
    out: Path,
    pool: Executor,
    seed: int,
    tell: Callable[[Progress], None],
    end_s: float = float("inf"),
) -> optuna.Study:
    """Resumes in `out` until `trials` trials are done, or begins none after `end_s` of time.monotonic(); returns the study.

    Raises DescriptionError where `out` holds the trials of another search, which would be lost.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    bounds = {s.parameter: FloatDistribution(s.low, s.high, log=s.logarithmic) for s in objective.search}
    sampler = GaussianProcessSampler(bounds, seed, FIRST_AT_RANDOM)
    study = optuna.create_study(sampler=sampler, pruner=optuna.pruners.MedianPruner(n_startup_trials=4))
    owner_kinds = "objective, start, seed or code"
    with TrialFile(out / TRIALS_FILE, identity(objective, start, seed), key="number", owner_kinds=owner_kinds) as file:
        for number in sorted(file.trials):
            study.add_trial(_restored(file.trials[number], bounds))
        while len(file.trials) < trials and time.monotonic() < end_s:
            number = len(file.trials)
            if number == 0:
                study.enqueue_trial(objective.start(start))
            file.add(_flown(study, study.ask(bounds), objective, start, pool))
            last = study.trials[-1]
            tell(Progress(number, float(last.value), last.state == TrialState.PRUNED, study.best_value))
    return study


def _flown(study: optuna.Study, trial: optuna.Trial, objective: Objective, start: Parameters, pool: Executor) -> dict[str, Any]:
    """Flies one trial until it is complete or pruned; returns its line."""
    parameters, seen = with_values(start, trial.params), []
    pruned = False
    for step, value in enumerate(running_totals(objective, parameters, pool)):
        seen.append(value)
        trial.report(value, step)
        pruned = step + 1 < len(objective.flight) and bool(trial.should_prune())
        if pruned:
            break
    study.tell(trial, state=TrialState.PRUNED) if pruned else study.tell(trial, seen[-1])
    return {"number": trial.number, "parameters": trial.params, "totals": seen, "pruned": pruned}


def _restored(line: dict[str, Any], bounds: dict[str, FloatDistribution]) -> optuna.trial.FrozenTrial:
    totals, pruned = line["totals"], line["pruned"]
    return create_trial(
        state=TrialState.PRUNED if pruned else TrialState.COMPLETE, value=totals[-1], params=line["parameters"],
        distributions=bounds, intermediate_values=dict(enumerate(totals)),
    )  # fmt: skip
