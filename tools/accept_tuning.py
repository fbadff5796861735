"""For tools/accept.py: the figures of tuning and of campaigns on several workers."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

from accept_figures import Figure, Group
from accept_measures import Values, said_by_tests

from firmware_py.description.parameters import Parameters
from hil.campaign import SUMMARY_FILE, TABLE_FILE, run_campaign
from hil.scenario import load_scenario
from hil.workers import processes

TRIALS = range(16)
"""Trials of the timed campaign: enough to make the start-up of its processes negligible."""
REPETITIONS = 3
"""Runs with one worker and with two, alternating because this machine's speed drifts within minutes."""
WORKERS_TEST = "tests/closed_loop/test_campaign_workers.py"
TUNE = ["tools/objectives/spiral-and-push.toml", "--detune", "1", "--trials", "1000", "--minutes", "10"]


def speedup(folder: Path) -> Values:
    """Median speed-up of a campaign flown by two processes over one, and the number of runs whose files differ from the first run's."""
    took_s: dict[int, list[float]] = {1: [], 2: []}
    tables = []
    for jobs in REPETITIONS * (1, 2):
        out = folder / f"jobs-{jobs}"
        shutil.rmtree(out, ignore_errors=True)
        began_s = time.monotonic()
        run_campaign(load_scenario("spiral"), Parameters(), TRIALS, processes(jobs), out)
        took_s[jobs].append(time.monotonic() - began_s)
        tables.append([(out / name).read_bytes() for name in (SUMMARY_FILE, TABLE_FILE)])
    return {"speedup": median(took_s[1]) / median(took_s[2]), "different": sum(table != tables[0] for table in tables)}


def tuned(folder: Path) -> Values:
    """One search from detuned gains: tuned over shipped objective on unseen seeds, detuned over tuned objective, and minutes taken."""
    out = folder / "tune"
    shutil.rmtree(out, ignore_errors=True)
    began_s = time.monotonic()
    script = Path(__file__).with_name("tune_gains.py")
    subprocess.run([sys.executable, script, *TUNE, "--no-plots", "--out", out], check=True)
    minutes = (time.monotonic() - began_s) / 60.0
    found = json.loads((out / "tuning.json").read_text(encoding="utf-8"))
    start, shipped, best = (found["unseen"][name]["objective"] for name in ("start", "shipped", "tuned"))
    return {"ratio": best / shipped, "minutes": minutes, "start": start / best}


TUNING: tuple[Group, ...] = (
    Group(
        "workers", 9, "modcube hil campaign spiral --trials 16 --jobs 1, and --jobs 2", speedup,
        (
            Figure("campaign, 16 spirals: two workers faster than one by", "speedup", low=1.8, unit="times"),
            Figure("the same: tables of one and of two workers that differ, of six", "different", high=0.0),
        ),
    ),
    Group(
        "lost-workers", 9, f"pytest {WORKERS_TEST}", said_by_tests(WORKERS_TEST),
        (Figure("tests of a lost dask worker and of a campaign killed half-way that failed", "failed", high=0.0),),
    ),
    Group(
        "tuning", 9, f"python tools/tune_gains.py {' '.join(TUNE)}", tuned,
        (
            Figure(
                "tuned from gains off by a factor of up to 3: objective on 20 unseen seeds, relative to the shipped gains",
                "ratio", high=1.05,
            ),
            Figure("the same: search and comparison, two cores", "minutes", high=15.0, unit="min"),
            Figure("the same: objective of the detuned gains over that of the best", "start", low=1.0),
        ),
    ),
)  # fmt: skip
