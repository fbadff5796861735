"""Many seeds of one scenario on any concurrent.futures executor: processes here, or a dask cluster.

Every trial goes to trials.jsonl as soon as it is flown. Started again in the same folder, a campaign flies the missing seeds; since a seed
always gives the same flight, the files end up with the same bytes as without an interruption. campaign.json and trials.csv summarise it.
When a worker dies, the trials under way are lost and flown again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import suppress
from functools import cache, partial
from importlib import resources
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.runtime.disk import writing_to
from hil.campaign_summary import Trial, summarise, table_of
from hil.checks import Result
from hil.flight import LOGS, flown_of, fly_and_judge
from hil.metrics import OUTCOMES
from hil.plant.world_parameters import world_parameters
from hil.replaceable import check_replaceable, created_folder, is_json_with
from hil.scenario import Scenario
from hil.trial_file import OWNER, TrialFile
from hil.workers import Pool, worker_death_exceptions

SUMMARY_FILE, TABLE_FILE, TRIALS_FILE = "campaign.json", "trials.csv", "trials.jsonl"
WALL_CLOCK = ("real_time_factor", "deadline_misses")
"""Metrics of the machine rather than the flight, left out because they differ from campaign to campaign."""
PACKAGES = ("firmware_py", "hil", "can_dbc")
SOURCES = (".py", ".toml", ".dbc")
TRIALS_AFTER_A_DEATH = max(8, 2 * (os.cpu_count() or 1))
"""Limit of trials under way after a worker has died: enough to keep this machine busy, and the most that the next death can cost."""
MAX_DEATHS_IN_A_ROW = 12
"""Consecutive worker deaths without a finished trial after which the campaign gives up: no single seed is to blame."""


@cache
def code_digest() -> str:
    """SHA-256 digest of all code and data of the robot and the bench."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        root = Path(str(resources.files(package)))
        for path in sorted(p for p in root.rglob("*") if p.suffix in SOURCES):
            digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


def identity(scenario: Scenario, parameters: Parameters) -> str:
    """Digest of everything that determines a trial, apart from its seed. Of waypoint and vehicle files the text counts, not the folder."""
    task = dataclasses.replace(scenario.task, file=Path(scenario.task.file).name)
    vehicles = [load_vehicle(m.vehicle) for m in scenario.module]
    modules = tuple(dataclasses.replace(m, vehicle=Path(m.vehicle).name) for m in scenario.module)
    scenario = dataclasses.replace(scenario, task=task, module=modules)
    meshes = [hashlib.sha256(Path(v.hull.mesh).read_bytes()).hexdigest() if v.hull.mesh else "" for v in vehicles]
    parts = (code_digest(), dataclasses.asdict(scenario), list(map(dataclasses.asdict, vehicles)), meshes, dataclasses.asdict(parameters))
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def fly_trial(scenario: Scenario, parameters: Parameters, seed: int, bus: str, code: str) -> Trial:
    """Flies one trial and discards its logs. Raises DescriptionError if the digest of this machine's code is not `code`."""
    if code_digest() != code:
        raise DescriptionError("a worker runs other code than this machine; install the same version there")
    with tempfile.TemporaryDirectory() as folder:
        result = fly_and_judge(scenario, seed, parameters, Path(folder), bus)
    flown = scenario.for_seed(seed)
    return {
        "seed": seed,
        "passed": result.passed,
        "outcome": outcome_of(result),
        "metrics": _numbers({name: value for name, value in result.metrics.items() if name not in WALL_CLOCK}),
        "world": _numbers(world_parameters([load_vehicle(m.vehicle) for m in flown.module], flown.world, seed)),
    }


def outcome_of(result: Result) -> str:
    """Outcome in words: passed, why a dock failed, or the first check that failed."""
    failed = [check.name for check in result.checks if not check.passed]
    if failed[:1] == ["docked"]:
        return OUTCOMES[int(result.metrics["outcome"])]
    return "passed" if result.passed else failed[0] if failed else "not checked"


def _numbers(values: dict[str, float]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def run_campaign(
    scenario: Scenario,
    parameters: Parameters,
    seeds: Sequence[int],
    pool: Pool,
    out: Path,
    progress: Callable[[int, int], None] | None = None,
    anew: bool = False,
    unusual: Sequence[str] = (),
) -> dict[str, Any]:
    """Flies every seed that `out` does not hold yet; writes campaign.json and trials.csv there; returns the content of campaign.json.

    `unusual`: options that differ from the scenario or the defaults, for campaign.json.

    Raises DescriptionError if `out` holds another campaign (which `anew` discards instead), a flight, or files of another origin, and for
    seeds that kill their workers; OSError if the disk is full.
    """
    with created_folder(out), writing_to(out):
        check_replaceable(out, (SUMMARY_FILE, TABLE_FILE, *LOGS), is_json_with(out / TRIALS_FILE, OWNER), "campaign")
        with TrialFile(out / TRIALS_FILE, identity(scenario, parameters), anew=anew) as file:
            missing = [seed for seed in seeds if seed not in file.trials]
            for trial in _flown(scenario, parameters, missing, pool):
                file.add(trial)
                if progress is not None:
                    progress(sum(seed in file.trials for seed in seeds), len(seeds))
            trials = [file.trials[seed] for seed in sorted(seeds)]
        flown = flown_of(scenario, parameters)
        summary = summarise(scenario.name, trials) | flown._asdict() | {"vehicles": list(flown.vehicles), "unusual": list(unusual)}
        (out / SUMMARY_FILE).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        (out / TABLE_FILE).write_text(table_of(trials), encoding="utf-8")
    return summary


def _flown(scenario: Scenario, parameters: Parameters, seeds: Sequence[int], pool: Pool) -> Iterator[Trial]:
    """Yields trials as they finish. Those under way when a worker dies are flown again after the others: TRIALS_AFTER_A_DEATH at a
    time, then one at a time, twice.
    """
    left, code, in_vain = set(seeds), code_digest(), 0

    def begin(executor: Executor, seed: int) -> Future[Trial]:
        return executor.submit(fly_trial, scenario, parameters, seed, f"virtual:trial{seed}", code)

    for at_once in (len(left), TRIALS_AFTER_A_DEATH, 1, 1):
        waiting = deque(sorted(left))
        while waiting:
            in_vain += 1
            with suppress(BrokenExecutor), pool() as executor:
                for trial in _together(partial(begin, executor), waiting, at_once):
                    left.discard(int(trial["seed"]))
                    in_vain = 0
                    yield trial
            if in_vain == MAX_DEATHS_IN_A_ROW:
                raise DescriptionError(f"workers die before they finish a trial; {len(left)} seeds are left, {min(left)} the first")
    if left:
        named = ", ".join(map(str, sorted(left)))
        raise DescriptionError(f"workers die of these seeds, each flown alone: {named}; all others are flown")


def _together(begin: Callable[[int], Future[Trial]], waiting: deque[int], at_once: int) -> Iterator[Trial]:
    """Flies the seeds in `waiting`. After a worker dies no more are started, and BrokenExecutor is raised once none is under way."""
    under_way: set[Future[Trial]] = set()
    ended: SimpleQueue[Future[Trial]] = SimpleQueue()
    died = False
    try:
        while under_way or (waiting and not died):
            try:
                while waiting and not died and len(under_way) < at_once:
                    under_way.add(future := begin(waiting[0]))
                    waiting.popleft()
                    future.add_done_callback(ended.put)
                future = ended.get()
                under_way.remove(future)
                trial = future.result()
            except worker_death_exceptions():
                died = True
            else:
                yield trial
    except Exception:
        yield from (f.result() for f in under_way if f.done() and not f.cancelled() and not f.exception())
        raise
    finally:
        for future in under_way:
            future.cancel()
    if died:
        raise BrokenExecutor  # makes a kept pool replace its workers
