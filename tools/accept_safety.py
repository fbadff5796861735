"""For tools/accept.py: flights with faults (hil/safety.py, hil/fuzz.py, hil/random_operator.py), over all seeds."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from accept_figures import Figure, Group
from accept_measures import JOBS, Values
from blind_floor import EXACT_N_M, UNFORESEEN_N_M, floor
from identify_excitation import MOTIONS, excitation

from firmware_py.app.replay import replay
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle
from hil.bench import fly_scenario
from hil.flight import fly_and_judge
from hil.fuzz import fuzz_flight
from hil.random_operator import fly_with_random_operator
from hil.safety import (
    ICM_20602,
    Imu,
    command_outlives_frames_ms,
    fly_to_estop,
    hover_blind,
    spiral_through_loss,
    spiral_with,
)  # fmt: skip
from hil.scenario import load_scenario
from hil.workers import processes

HEALTHY, SHAKEN, STOPPED, BLIND, LOSSY, OPERATED = range(100), range(40), range(1000), range(50), range(5), range(200)
"""Seeds, as many as the issue asks for; of lossy spirals as many as fit into a minute."""
FUZZED_FRAMES = 1_000_000
OPERATED_S = 30.0
"""Length of each flight with a random operator."""
LOGGED_S = 600.0
"""Length of the log to replay."""
MOST_SIGMAS, MEAN_SQUARE_LIMITS = 4.0, (0.5, 2.0)
"""Limits on the normalised errors. Of 100 standard normal numbers, the largest exceeds 4 in one set of 160, and their mean square lies
outside 0.7 to 1.3 in one set of 30, so a factor of two is no coincidence.
"""

LEAST = tuple(
    Figure(f"the same: optimal filter that knows moments to {1e3 * known_n_m:g} mN m, {name}", key, unit="mm", scale=1e3)
    for known_n_m, keys in ((UNFORESEEN_N_M, ("least median", "least p95")), (EXACT_N_M, ("exact median", "exact p95")))
    for name, key in zip(("median", "95 %"), keys, strict=True)
)
"""The optimal filter's errors (tools/blind_floor.py), shown beside the robot's errors without tags."""


def _all(work: Callable[[Any], Any], inputs: Iterable[Any]) -> list[Any]:
    with processes(JOBS)() as pool:
        return list(pool.map(work, inputs))


def _shaken(seed: int, scenario: Path) -> float:
    with TemporaryDirectory(dir=scenario.parent) as folder:
        flown = fly_and_judge(load_scenario(str(scenario)), seed, Parameters(), Path(folder), f"virtual:shaken-{seed}")
    return flown.metrics["warnings"]


def thrusters_out(folder: Path) -> Values:
    """Spirals with each thruster dead, each pair dead, each thruster lying, and none failed; and healthy flights with strong excitation."""
    matrix = assemble_vehicle(load_vehicle("modcube")).thrusters.matrix
    alone, pairs = (list(itertools.combinations(range(matrix.shape[1]), broken)) for broken in (1, 2))
    whole = {pair: bool(np.linalg.matrix_rank(np.delete(matrix, pair, axis=1)) == 6) for pair in pairs}
    singles, liars = _all(spiral_with, alone), _all(functools.partial(spiral_with, kind="thruster_fake_rpm"), alone)
    healthy = _all(functools.partial(spiral_with, (), "thruster_dead"), HEALTHY)
    found = dict(zip(pairs, _all(spiral_with, pairs), strict=True))
    flown_on, given_up = ([found[pair] for pair in pairs if whole[pair] == is_whole] for is_whole in (True, False))
    every = [*singles, *found.values(), *liars, *healthy]
    shake = folder / "shake.toml"
    shake.write_text(excitation(list(MOTIONS), "modcube"), encoding="utf-8")
    return {
        "single rmse": max(f.rmse_m for f in singles), "single peak": max(f.peak_m for f in singles),
        "single angle": max(f.angle_peak_deg for f in singles), "single found": max(f.found_s[0] for f in singles),
        "pairs": len(flown_on), "pair rmse": max(f.rmse_m for f in flown_on), "pair angle": max(f.angle_peak_deg for f in flown_on),
        "lost rmse": max(f.rmse_m for f in given_up), "lost surfaced": sum(f.ends_in == "SURFACE" for f in given_up) / len(given_up),
        "lying found": max(f.found_s[0] for f in liars), "blamed": sum(len(f.blamed) for f in every),
        "shaken": sum(_all(functools.partial(_shaken, scenario=shake), SHAKEN)),
    }  # fmt: skip


def frames_lost(folder: Path) -> Values:
    """Spirals through frame loss, and how long a command outlives the last frame."""
    return {"rmse": max(_all(spiral_through_loss, LOSSY)), "outlives": command_outlives_frames_ms()}


def stopped(folder: Path) -> Values:
    """E-stops at random ticks."""
    flights = _all(fly_to_estop, STOPPED)
    return {"violations": sum(f.violations for f in flights), "armed": sum(f.was_armed for f in flights)}


def operated(folder: Path) -> Values:
    """Flights with random requests from the operator and random faults."""
    flights = _all(functools.partial(fly_with_random_operator, duration_s=OPERATED_S), OPERATED)
    modes = sum((flight.modes for flight in flights), Counter[str]())
    return {"broken": sum(flight.broken.total() for flight in flights), "modes": len(modes), "armed": modes.total() / 100.0}


def blind(folder: Path, imu: Imu | None = None, rate_hz: int = 100) -> Values:
    """Five seconds without tags."""
    flights = _all(functools.partial(hover_blind, imu=imu, rate_hz=rate_hz), BLIND)
    errors, rmse, normalised = (np.array(values) for values in zip(*flights, strict=True))
    (least_median, least_p95), (exact_median, exact_p95) = (floor(imu, known_n_m, rate_hz) for known_n_m in (UNFORESEEN_N_M, EXACT_N_M))
    return {
        "median": float(np.median(errors)), "p95": float(np.quantile(errors, 0.95)), "rmse_median": float(np.median(rmse)),
        "rmse_p95": float(np.quantile(rmse, 0.95)), "sigmas": float(np.abs(normalised).max()), "square": float(np.mean(normalised**2)),
        "least median": least_median, "least p95": least_p95, "exact median": exact_median, "exact p95": exact_p95,
    }  # fmt: skip


def fuzzed(folder: Path) -> Values:
    """Sends fuzzed frames to an armed robot."""
    result = fuzz_flight(FUZZED_FRAMES)
    return {"beyond": result.beyond, "unaccounted": abs(result.accepted + sum(result.dropped.values()) - result.frames)}


def fault_matrix(folder: Path) -> Values:
    """Runs every fault in every mode against the promises of the fault table."""
    command = [Path(sys.executable).with_name("modcube"), "hil", "campaign", "faults", "--out", folder / "faults"]
    with (folder / "faults.log").open("w", encoding="utf-8") as log:
        return {"failed": subprocess.run(command, stdout=log, stderr=subprocess.STDOUT).returncode}


def replayed(folder: Path) -> Values:
    """Records a ten-minute hover and replays its log through the same code."""
    base = load_scenario("hover")
    task = dataclasses.replace(base.task, duration_s=LOGGED_S - base.task.settle_s)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    fly_scenario(dataclasses.replace(base, task=task), 0, Parameters(), folder, "virtual:replayed")
    began_s = time.perf_counter()
    outcome = replay(folder)
    return {"differs": outcome.first is not None, "speed": outcome.seconds / (time.perf_counter() - began_s), "seconds": outcome.seconds}


SAFETY: tuple[Group, ...] = (
    Group(
        "faults", 7, "modcube hil campaign faults", fault_matrix,
        (Figure("faults by modes: status of the campaign, 0 if every outcome is as the table specifies", "failed", high=0.0),),
    ),
    Group(
        "thrusters", 7, "make accept ONLY=thrusters", thrusters_out,
        (
            Figure("one thruster dead on the spiral, worst of 8: position RMSE", "single rmse", high=12.0, unit="mm", scale=1e3),
            Figure("the same: largest position error", "single peak", high=60.0, unit="mm", scale=1e3),
            Figure("the same: largest attitude error", "single angle", high=15.0, unit="deg"),
            Figure("the same: found after", "single found", high=0.5, unit="s"),
            Figure("pairs of dead thrusters that leave all six axes", "pairs", low=25.0, high=25.0),
            Figure("two thrusters dead, worst of those: position RMSE", "pair rmse", high=25.0, unit="mm", scale=1e3),
            Figure("the same: largest attitude error", "pair angle", high=30.0, unit="deg"),
            Figure("pairs that lose an axis: position RMSE until SURFACE, worst", "lost rmse", high=25.0, unit="mm", scale=1e3),
            Figure("pairs that lose an axis: share that ends in SURFACE", "lost surfaced", low=1.0),
            Figure("a thruster that lies, worst of 8: found after", "lying found", high=2.0, unit="s"),
            Figure("healthy thrusters left out, in all of these and 100 healthy spirals", "blamed", high=0.0),
            Figure("warnings in 40 healthy flights as tools/identify.py asks for them", "shaken", high=0.0),
        ),
    ),
    Group(
        "frame-loss", 7, "make accept ONLY=frame-loss", frames_lost,
        (
            Figure("spiral through 30 % lost frames, 5 seeds: position RMSE, worst", "rmse", high=8.0, unit="mm", scale=1e3),
            Figure("all frames lost: a command acts after the last frame for", "outlives", high=110.0, unit="ms"),
        ),
    ),
    Group(
        "estop", 7, "make accept ONLY=estop", stopped,
        (
            Figure("1000 e-stops: ticks afterwards with a command, or without the frames that command zero", "violations", high=0.0),
            Figure("the same: flights that were armed at the e-stop", "armed", low=500.0),
        ),
    ),
    Group(
        "operator", 7, "make accept ONLY=operator", operated,
        (
            Figure("200 flights with a random operator and anything broken: rules broken", "broken", high=0.0),
            Figure("the same: modes flown", "modes", low=9.0),
            Figure("the same: time armed, all modules", "armed", low=1000.0, unit="s"),
        ),
    ),
    Group(
        "blind", 7, "make accept ONLY=blind", blind,
        (
            Figure("hover, 5 s without tags, 50 seeds: largest horizontal error, median", "median", high=30.0, unit="mm", scale=1e3),
            Figure("the same: 95 %", "p95", high=70.0, unit="mm", scale=1e3),
            *LEAST,
            Figure("the same: RMSE over the five seconds, median", "rmse_median", unit="mm", scale=1e3),
            Figure("the same: RMSE, 95 %", "rmse_p95", unit="mm", scale=1e3),
            Figure("the same: error of the estimate, worst, in its own sigmas", "sigmas", high=MOST_SIGMAS),
            Figure("the same: mean square, in sigmas (1: consistent)", "square", low=MEAN_SQUARE_LIMITS[0], high=MEAN_SQUARE_LIMITS[1]),
        ),
    ),
    Group(
        "blind-400-hz", 7, "make accept ONLY=blind-400-hz", functools.partial(blind, rate_hz=400),
        (
            Figure("hover, 5 s without tags at 400 Hz, 50 seeds: largest horizontal error, median", "median", unit="mm", scale=1e3),
            Figure("the same: 95 %", "p95", unit="mm", scale=1e3),
            *LEAST,
            Figure("the same: error of the estimate, worst, in its own sigmas", "sigmas", high=MOST_SIGMAS),
            Figure("the same: mean square, in sigmas (1: consistent)", "square", low=MEAN_SQUARE_LIMITS[0], high=MEAN_SQUARE_LIMITS[1]),
        ),
    ),
    Group(
        "blind-quiet-imu", 7, "make accept ONLY=blind-quiet-imu", functools.partial(blind, imu=ICM_20602),
        (
            Figure("hover, 5 s without tags, an ICM-20602, 50 seeds: largest horizontal error, median", "median", unit="mm", scale=1e3),
            Figure("the same: 95 %", "p95", unit="mm", scale=1e3),
            *LEAST,
            Figure("the same: error of the estimate, worst, in its own sigmas", "sigmas", high=MOST_SIGMAS),
        ),
    ),
    Group(
        "fuzz", 7, "make accept ONLY=fuzz", fuzzed,
        (
            Figure("a million fuzzed frames: commands beyond their limits", "beyond", high=0.0),
            Figure("the same: frames that no counter has counted", "unaccounted", high=0.0),
        ),
    ),
    Group(
        "replay", 7, "make accept ONLY=replay", replayed,
        (
            Figure("replay of a log: length", "seconds", low=LOGGED_S - 1.0, unit="s"),
            Figure("the same: bytes that differ (0: none)", "differs", high=0.0),
            Figure("the same: faster than real time by", "speed", low=25.0, unit="times"),
        ),
    ),
)  # fmt: skip
