"""Tune controller and estimator parameters on the bench with Optuna. A killed run resumes when started again: no finished trial is lost.

.venv/bin/python tools/tune_gains.py tools/objectives/spiral-and-push.toml --trials 60 --out runs/tune
.venv/bin/python tools/tune_gains.py tools/objectives/spiral-and-push.toml --detune 1 --minutes 15   # from gains off by up to 3
.venv/bin/python tools/tune_gains.py tools/objectives/hover.toml --live mavlink:udpin:127.0.0.1:14550   # a vehicle that hovers

The objective is a file: which flights, which seeds, which parameters within which bounds, and the cost of each metric. In DIR: the best
parameters as a file for --controller, tuning.json with the figures on seeds unseen by the search beside those of the
shipped gains, and plots.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from concurrent.futures import BrokenExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

from command_line import INTERRUPTED, Parser, refuse, run_tool

from argument_types import check_results, folder_for_results, positive, whole
from tune_objective import Objective, detuned, load_objective, with_values

from firmware_py.description.parameters import Parameters, load_parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.description.toml_text import to_toml
from firmware_py.runtime.interrupts import interrupted_once
from hil.campaign import TRIALS_FILE, code_digest, identity, run_campaign
from hil.trial_file import TrialFile
from hil.workers import Pool, dask_cluster, processes, reused

DETUNED = 3.0
"""Largest factor by which --detune changes each gain."""
LOOK_S = 20.0
"""How long --live observes each step, unless --seconds is given."""


def unseen_costs(objective: Objective, parameters: Parameters, pool: Pool, folder: Path) -> list[float]:
    """Cost of every flight in the worlds of the comparison; each flight is a campaign of its own, which can resume."""
    costs = []
    for number, spec in enumerate(objective.flight):
        scenario = spec.flown()
        here = folder / f"{number}-{scenario.name}"
        run_campaign(scenario, parameters, objective.unseen_seeds, pool, here, anew=True)
        with TrialFile(here / TRIALS_FILE, identity(scenario, parameters)) as file:
            costs += [objective.cost(spec, file.trials[seed]["metrics"]) for seed in objective.unseen_seeds]
    return costs


def write_result(objective: Objective, best: Parameters, study: Any, out: Path, figures: dict[str, Any], seed: int) -> None:
    """Writes parameters.toml and tuning.json."""
    versions = {name: version(name) for name in ("modcube", "numpy", "optuna")} | {"python": platform.python_version()}
    pruned = sum(len(t.intermediate_values) < len(objective.flight) for t in study.trials)
    result = {
        "objective": objective.help,
        "trials": len(study.trials),
        "pruned": pruned,
        "search_seed": seed,
        "seeds": list(objective.seeds),
        "unseen_seeds": list(objective.unseen_seeds),
        "versions": versions | {"code": code_digest()},
        "start": study.trials[0].params,
        "start_value": study.trials[0].value,
        "best": study.best_params,
        "best_value": study.best_value,
        "unseen": figures,
    }
    (out / "tuning.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    said = [f"Tuned by tools/tune_gains.py: {objective.help}", f"{len(study.trials)} trials, {pruned} ended early, search seed {seed}"]
    said += [f"seeds {list(objective.seeds)}; unseen {list(objective.unseen_seeds)}"]
    said += [", ".join(f"{name} {value}" for name, value in versions.items()) + f", code {code_digest()[:12]}"]
    said += [f"objective on unseen seeds, {name}: {f['objective']:.4f}, worst flight {f['worst']:.4f}" for name, f in figures.items()]
    head = "".join(f"# {line}\n" for line in said)
    (out / "parameters.toml").write_text(head + to_toml(best).lstrip("\n"), encoding="utf-8")


def tune(objective: Objective, start: Parameters, given: argparse.Namespace, pool: Pool) -> None:
    """Searches, compares, writes and draws."""
    from optuna.trial import TrialState
    from tune_plots import draw
    from tune_search import Progress, search

    def tell(p: Progress) -> None:
        print(
            f"trial {p.number + 1:4d} of {given.trials}: {p.value:9.4f} {'ended early' if p.pruned else '           '}  best {p.best:9.4f}"
            f"  {time.monotonic() - began:6.0f} s", flush=True,
        )  # fmt: skip

    began = time.monotonic()
    figures = {}
    with reused(pool) as workers:
        with workers() as executor:
            study = search(objective, start, given.trials, given.out, executor, given.seed, tell, began + 60.0 * given.minutes)
        if not any(trial.state == TrialState.COMPLETE for trial in study.trials):
            raise DescriptionError(f"no trial was finished in {given.minutes:g} minutes; give more")
        best = with_values(start, study.best_params)
        first = with_values(start, objective.start(start))
        sets = {"start": first, "shipped": Parameters(), "tuned": best}
        for name, parameters in sets.items():
            costs = unseen_costs(objective, parameters, workers, given.out / "unseen" / name)
            total = objective.shortfall(parameters) + objective.total(costs)
            figures[name] = {"objective": total, "worst": max(costs), "flights": len(costs)}
            print(f"{name:8s} objective on unseen seeds {figures[name]['objective']:9.4f}, worst flight {max(costs):9.4f}", flush=True)
    write_result(objective, best, study, given.out, figures, given.seed)
    print(f"parameters: {given.out / 'parameters.toml'}  ({time.monotonic() - began:.0f} s)", flush=True)
    if not given.no_plots:
        draw(given.out, objective, study, sets, objective.vehicle)


def arguments() -> argparse.Namespace:
    """Parses and checks the command line."""
    parser = Parser(description=__doc__)
    parser.add_argument("objective", type=Path, help="objective file, such as tools/objectives/spiral.toml")
    parser.add_argument("--trials", type=whole(1), default=40, help="total number of trials, including earlier ones in the same folder")
    parser.add_argument("--minutes", type=positive, default=float("inf"), help="time after which no new trial starts")
    parser.add_argument("--jobs", type=whole(1), default=2, help="number of parallel processes")
    parser.add_argument(
        "--dask", metavar="ADDRESS", default="", help="scheduler of a dask cluster, tcp://HOST:PORT, in place of local processes"
    )
    parser.add_argument("--start", type=Path, help="parameter file to start from; default: the shipped gains")
    parser.add_argument(
        "--detune", type=whole(0), metavar="SEED", help=f"detune each gain of the start by a random factor of up to {DETUNED:g}"
    )
    parser.add_argument("--seed", type=whole(0), default=0, help="seed of the search")
    parser.add_argument("--no-plots", action="store_true", help="do not draw plots")
    parser.add_argument("--live", metavar="mavlink:ADDRESS", help="tune the vehicle at this address, step by step, in place of the bench")
    parser.add_argument(
        "--seconds", type=positive, metavar="SECONDS", help=f"--live: time for which each step is observed, {LOOK_S:g} by default"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/tune"), metavar="DIR", help="folder for trials, parameters.toml and tuning.json"
    )
    given = parser.parse_args()
    if given.seconds is not None and not given.live:
        parser.error("--seconds tells how long each step on a vehicle is looked at; give --live with it")
    return given


def begin(objective: Objective, start: Parameters, given: argparse.Namespace) -> int:
    """Tunes the vehicle, or on the bench; returns the exit status. Raises whatever ends the run early."""
    if given.live:
        from tune_live import tune_live

        return tune_live(objective, given.live, given.trials, given.seconds or LOOK_S, given.out)
    check_results(given.out, "search_seed", "tuning.json", "parameters.toml", "steps.png", "bode.png", "search.png")
    with interrupted_once():
        tune(objective, start, given, dask_cluster(given.dask) if given.dask else processes(given.jobs))
    return 0


def main() -> int:
    """Runs the tool; returns its exit status."""
    given = arguments()
    try:
        objective = load_objective(given.objective)
        start = load_parameters(given.start) if given.start else Parameters()
        if given.detune is not None:
            start = detuned(objective, start, DETUNED, given.detune)
        with folder_for_results(given.out):
            return begin(objective, start, given)
    except (DescriptionError, OSError) as error:
        return refuse("tune_gains", error)
    except BrokenExecutor:
        print(f"tune_gains: a worker died; the same command with --out {given.out} goes on where it was", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"tune_gains: interrupted; the same command with --out {given.out} goes on where it was", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    run_tool(main)
