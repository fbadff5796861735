"""Measurements of `make accept`: each takes a folder and returns figures by name. The limits are in accept.py."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median

import identify_plants
import near_miss

from firmware_py.description.parameters import CONTROLLERS
from hil.campaign import run_campaign
from hil.console import campaign_progress
from hil.flight import LOGS
from hil.scenario import load_scenario
from hil.workers import processes

FEWER = range(8)
JOBS = 2
PLANTS = 10
PASSES, CHUNK = 10_000, 250
"""Near misses in total, and per task of a worker process."""

FIGURE = re.compile(r"^figure: (?P<name>.+) = (?P<value>\S+)", re.MULTILINE)
"""Matches a line that tests/figures.py prints."""

Values = Mapping[str, float]


def campaign_of(scenario: str, controller: str = "modcube", trials: int = 20, sensors: str = "real") -> Callable[[Path], Values]:
    """Flies `trials` seeds of a scenario.

    Keys are `metric.quantile`; `passed`, the share of flights that passed every check; `passed.low`, its lower 95 % bound; and
    `failed.OUTCOME`, the share of each outcome among the failed flights.
    """

    def measure(folder: Path) -> Values:
        chosen, parameters = load_scenario(scenario), CONTROLLERS[controller]
        if sensors == "ideal":
            chosen = chosen.with_ideal_sensors()
        with campaign_progress(f"{scenario}, {controller}, {sensors} sensors", trials) as progress:
            summary = run_campaign(chosen, parameters, range(trials), processes(JOBS), folder, progress, anew=True)
        values = {f"{m}.{q}": v for m, each in summary["metrics"].items() for q, v in each.items() if v is not None}
        failed = {name: count / (trials - summary["succeeded"]) for name, count in summary["outcomes"].items() if name != "passed"}
        values |= {f"failed.{name}": share for name, share in failed.items()}
        return values | {"passed": summary["succeeded"] / trials, "passed.low": summary["confidence_interval"][0]}

    return measure


def saved_by_least_power(folder: Path) -> Values:
    """Flies the Moebius strip in both allocation modes: share of supply power saved, and ratio of the position errors."""
    found = {}
    for name in ("modcube", "least_power"):
        with campaign_progress(f"mobius-1, {name}", len(FEWER)) as progress:
            summary = run_campaign(load_scenario("mobius-1"), CONTROLLERS[name], FEWER, processes(JOBS), folder / name, progress, anew=True)
        found[name] = summary["metrics"]
    both = ("supply_power_w", "position_rmse_m")
    power, error = (found["least_power"][m]["median"] / found["modcube"][m]["median"] for m in both)
    return {"saved": 1.0 - power, "error": error}


def loop_margins(folder: Path) -> Values:
    """Least margins over all axes of bodies of 1, 2 and 4 modules, nominal and in the worst corner; keys such as `nominal.gain_db`."""
    command, out = [sys.executable, Path(__file__).with_name("margins.py"), "--jobs", str(JOBS), "--out", folder], folder / "margins.json"
    out.unlink(missing_ok=True)  # from an earlier run: if this one failed, its figures would pass for new ones
    subprocess.run(command, stdout=subprocess.DEVNULL)
    found = json.loads(out.read_text(encoding="utf-8"))
    kinds, keys = ("nominal", "worst"), ("gain_db", "phase_deg")
    return {f"{kind}.{key}": min(row[key] for row in found if row["kind"] == kind) for kind in kinds for key in keys}


def characterised(folder: Path) -> Values:
    """Wall time of tools/characterise.py for one module, and for Table I with figure and report, s. Each is the median of 3 runs in
    processes of their own, imports included.
    """
    program, took = Path(__file__).with_name("characterise.py"), {}
    for name, words in (("module", ["modcube"]), ("table1", ["--table1", "--out", folder])):
        runs = []
        for _ in range(3):
            began = time.perf_counter()
            subprocess.run([sys.executable, program, *words], check=True, capture_output=True)
            runs.append(time.perf_counter() - began)
        took[name] = median(runs)
    return took


def identified_plants(folder: Path) -> Values:
    """Identifies ten robots that differ from their vehicle file, each from a three-minute log with a load cell within 2 %."""
    return identify_plants.examine_all(range(PLANTS), JOBS, folder)


def near_miss_passes(folder: Path) -> Values:
    """Counts the docks that the docking detector declares in ten thousand near misses, seen through real frames."""
    chunks = [range(first, first + CHUNK) for first in range(0, PASSES, CHUNK)]
    total: dict[str, int] = {}
    with processes(JOBS)() as pool:
        for found in pool.map(near_miss.count, chunks):
            total = {key: total.get(key, 0) + value for key, value in found.items()}
    (folder / "passes.json").write_text(json.dumps(total, indent=2) + "\n", encoding="utf-8")
    return total


def printed_by(program: str) -> Callable[[Path], Values]:
    """Runs one of the `make bench` programs that print JSON; returns its figures by name."""

    def measure(folder: Path) -> Values:
        command = [sys.executable, Path(__file__).with_name(program)]
        printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        (folder / "bench.json").write_text(printed, encoding="utf-8")
        return {entry["name"]: entry["value"] for entry in json.loads(printed)}

    return measure


def said_by_tests(*arguments: str) -> Callable[[Path], Values]:
    """Runs the tests selected by pytest's `arguments` at full length. Returns the largest value of each figure that they report, its sum as
    `NAME, sum`, and pytest's exit status as `failed`.
    """

    def measure(folder: Path) -> Values:
        command = [sys.executable, "-m", "pytest", "--capture=no", "-rs", *arguments]
        environment = {**os.environ, "MODCUBE_FULL": "1"}
        with (folder / "pytest.log").open("w+", encoding="utf-8") as log:
            status = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=environment).returncode
            log.seek(0)
            said: dict[str, list[float]] = {}
            for line in FIGURE.finditer(log.read()):
                said.setdefault(line["name"], []).append(float(line["value"]))
        sums = {f"{name}, sum": sum(values) for name, values in said.items()}
        return {name: max(values) for name, values in said.items()} | sums | {"failed": status}

    return measure


def repeated(folder: Path) -> Values:
    """Flies one seed twice and another seed once: logs that differ between the twins, and logs of the other seed that equal the first's."""
    for name, seed in (("first", 0), ("second", 0), ("other", 1)):
        command = [Path(sys.executable).with_name("modcube"), "hil", "run", "spiral", "--no-plots"]
        shutil.rmtree(folder / name, ignore_errors=True)  # logs of an earlier run, which would remain if the flight cannot run
        subprocess.run([*command, "--seed", str(seed), "--out", folder / name], capture_output=True)
    logs = {run: [(folder / run / log).read_bytes() for log in LOGS] for run in ("first", "second", "other")}
    pairs = [zip(logs["first"], logs[run], strict=True) for run in ("second", "other")]
    different, same = (sum(a != b for a, b in pairs[0]), sum(a == b for a, b in pairs[1]))
    return {"different": different, "same": same}


def timed(folder: Path) -> Values:
    """Lockstep speed on one core, measured as in `make bench`, and the speed of that core meanwhile."""
    code = (
        "from bench_flight import measure_flight, time_additions, time_load\n"
        "for _ in range(5): print(measure_flight(0).speed, time_additions(), time_load())"
    )
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    core = min(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    pinned = f"import os; os.sched_setaffinity(0, {{{core}}})\n" if core is not None else ""
    done = subprocess.run(
        [sys.executable, "-c", pinned + code], check=True, capture_output=True, text=True, env=environment,
        cwd=Path(__file__).parent,
    )  # fmt: skip
    speeds, additions, loads = zip(*([float(word) for word in line.split()] for line in done.stdout.splitlines()), strict=True)
    return {"speed": median(speeds), "additions": median(additions), "load": median(loads)}
