"""Many seeds of one scenario on any concurrent.futures executor: processes here, or a dask cluster.

Every trial goes to trials.jsonl the moment it is flown. Started again in the same folder, a campaign flies what is missing; since a seed
always gives the same flight, it ends in the same bytes as one that was never interrupted. campaign.json and trials.csv say what came of it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import re
import socket
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from functools import cache
from importlib import resources
from multiprocessing import get_context
from pathlib import Path
from types import TracebackType
from typing import Any

from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import load_vehicle
from hil.campaign_summary import Trial, summarise, table_of
from hil.checks import Result
from hil.docking_metrics import OUTCOMES
from hil.flight import fly_and_judge
from hil.plant.world_parameters import world_parameters
from hil.scenario import Scenario

SUMMARY_FILE, TABLE_FILE, TRIALS_FILE = "campaign.json", "trials.csv", "trials.jsonl"
WALL_CLOCK = ("real_time_factor", "deadline_misses")
"""Metrics of the machine and not of the flight: no two campaigns would agree on them."""
PACKAGES = ("firmware_py", "hil", "can_dbc")
SOURCES = (".py", ".toml", ".dbc")

Pool = Callable[[], AbstractContextManager[Executor]]


@cache
def code_digest() -> str:
    """What all code and data of the robot and the bench come to."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        root = Path(str(resources.files(package)))
        for path in sorted(p for p in root.rglob("*") if p.suffix in SOURCES):
            digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


def identity(scenario: Scenario, parameters: Parameters) -> str:
    """Same identity and same seed, same trial."""
    vehicles = [dataclasses.asdict(load_vehicle(m.vehicle)) for m in scenario.module]
    parts = (code_digest(), dataclasses.asdict(scenario), vehicles, dataclasses.asdict(parameters))
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def fly_trial(scenario: Scenario, parameters: Parameters, seed: int, bus: str, code: str) -> Trial:
    """One trial, logs thrown away. Raises DescriptionError where this machine's code is not `code`."""
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
    """In words: passed, why a dock came to nothing, or the first check that failed."""
    failed = [check.name for check in result.checks if not check.passed]
    if failed[:1] == ["docked"]:
        return OUTCOMES[int(result.metrics["outcome"])]
    return "passed" if result.passed else failed[0] if failed else "not checked"


def _numbers(values: dict[str, float]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


class TrialFile:
    """trials.jsonl: who it belongs to, then a line for each trial, with the disk before the next one is waited for."""

    def __init__(self, path: Path, owner: str, key: str = "seed") -> None:
        """Goes on in `path` if it is `owner`'s, else begins it anew. A line that was torn is flown again; `key` tells trials apart."""
        self.trials: dict[int, Trial] = {}
        self._key = key
        kept = self._read(path, owner) if path.exists() else 0
        self._file = path.open("r+b" if kept else "wb")
        self._file.truncate(kept)
        self._file.seek(kept)
        if not kept:
            self._write({"campaign": owner})

    def _read(self, path: Path, owner: str) -> int:
        """Bytes that stand."""
        kept = 0
        for line in path.read_bytes().splitlines(keepends=True):
            try:
                entry = json.loads(line) if line.endswith(b"\n") else None
            except ValueError:
                entry = None
            if not isinstance(entry, dict) or (kept == 0 and entry != {"campaign": owner}):
                break
            if kept:
                self.trials[int(entry[self._key])] = entry
            kept += len(line)
        return kept

    def add(self, trial: Trial) -> None:
        """One more trial, on the disk when this returns."""
        self.trials[int(trial[self._key])] = trial
        self._write(trial)

    def _write(self, entry: Trial) -> None:
        self._file.write(json.dumps(entry).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def __enter__(self) -> TrialFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._file.close()


def processes(jobs: int) -> Pool:
    """So many processes of this machine."""
    return lambda: ProcessPoolExecutor(jobs, mp_context=get_context("spawn"))


@contextmanager
def kept(pool: Pool) -> Iterator[Pool]:
    """The pool, whose workers stay from one use to the next: to start them takes longer than a flight. A broken one is made anew."""
    with ExitStack() as stack:
        executors: list[Executor] = []

        @contextmanager
        def use() -> Iterator[Executor]:
            if not executors:
                executors.append(stack.enter_context(pool()))
            try:
                yield executors[0]
            except BrokenExecutor:
                executors.clear()
                raise

        yield use


def dask_cluster(address: str) -> Pool:
    """The workers of the dask scheduler at `address`, such as tcp://host:8786. Raises DescriptionError when none answers."""
    found = re.fullmatch(r"t(?:cp|ls)://(.+):(\d+)", address)
    if not found:
        raise DescriptionError(f"--dask {address!r} is no address; it needs tcp://HOST:PORT, as `dask scheduler` prints it")
    try:
        socket.create_connection((found[1], int(found[2])), timeout=10).close()
    except (OSError, OverflowError) as error:
        raise DescriptionError(f"no dask scheduler at {address}: {error}; start one with `dask scheduler`") from None
    from distributed import Client

    client = Client(address, timeout=10, set_as_default=False)
    return lambda: client.get_executor(pure=False)


def run_campaign(
    scenario: Scenario,
    parameters: Parameters,
    seeds: Sequence[int],
    pool: Pool,
    out: Path,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Flies every seed that `out` does not hold yet; writes campaign.json and trials.csv there; returns what the first holds."""
    out.mkdir(parents=True, exist_ok=True)
    with TrialFile(out / TRIALS_FILE, identity(scenario, parameters)) as file:
        missing = [seed for seed in seeds if seed not in file.trials]
        for trial in _flown(scenario, parameters, missing, pool):
            file.add(trial)
            if progress is not None:
                progress(sum(seed in file.trials for seed in seeds), len(seeds))
        trials = [file.trials[seed] for seed in sorted(seeds)]
    summary = summarise(scenario.name, trials)
    (out / SUMMARY_FILE).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    (out / TABLE_FILE).write_text(table_of(trials), encoding="utf-8")
    return summary


def _flown(scenario: Scenario, parameters: Parameters, seeds: Sequence[int], pool: Pool) -> Iterator[Trial]:
    """Trials as they come. A worker that dies costs the trials under way; without any trial between two deaths it is given up."""
    left, code, in_vain = set(seeds), code_digest(), 0
    while left:
        before = len(left)
        with suppress(BrokenExecutor), pool() as executor:
            futures = [executor.submit(fly_trial, scenario, parameters, s, f"virtual:trial{s}", code) for s in sorted(left)]
            try:
                for future in as_completed(futures):
                    if not isinstance(future.exception(), BrokenExecutor):
                        trial = future.result()
                        left.discard(int(trial["seed"]))
                        yield trial
            finally:
                for future in futures:
                    future.cancel()
            if left:
                raise BrokenExecutor  # told to a pool that is kept
        in_vain = in_vain + 1 if len(left) == before else 0
        if in_vain == 2:
            raise DescriptionError(f"workers die before they finish a trial; {len(left)} seeds are left, {min(left)} the first")
