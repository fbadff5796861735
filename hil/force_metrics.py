"""Force tracking: force measured by the load cells against force requested by the firmware, with and without jet interference."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from firmware_py.description.signals import Columns, read_signals
from hil.metrics import rms
from hil.signals import SIGNAL_LOG
from hil.truth_log import TRUTH_LOG

if TYPE_CHECKING:
    from hil.scenario import Scenario

DEGREE = 3
"""Degree of the polynomial fitted to measured force over wanted force."""
NAMES = {1: "one", 2: "two"}
PHASES = ("off", "on")
"""Before and after the jets interfere."""


def force_names(counts: Iterable[int]) -> list[str]:
    """Metric names for bodies with these numbers of modules."""
    names = [NAMES.get(count, str(count)) for count in counts]
    rmse = [f"force_rmse_{name}_{phase}_n" for phase in PHASES for name in names]
    fits = [f"force_fit{k}_{name}_{phase}" for phase in PHASES for name in names for k in range(DEGREE + 1)]
    return [f"force_difference_{phase}" for phase in PHASES] + rmse + fits


def force_metrics(scenario: Scenario, folder: Path, begin_ns: int) -> dict[str, float]:
    """RMSE per module of each body, their difference, and the fits; `off` and `on`: before and after the jets interfere.

    Forces are along the body's x axis, per module, N. The difference is that of the two RMSE, relative to that of one module.

    Raises:
        OSError: a log is missing. KeyError: a body is not in it.
    """
    truths, signals = read_signals(folder / TRUTH_LOG), read_signals(folder / SIGNAL_LOG)
    half_ns = round(0.5e9 * scenario.task.duration_s)
    metrics: dict[str, float] = {}
    for phase, start_ns in zip(PHASES, (begin_ns, begin_ns + half_ns), strict=True):
        rmse = {}
        for members in scenario.groups:
            leader, count = members[0], len(members)
            firmware, truth = signals[f"/firmware/body{leader}"], truths[f"/plant/body{leader}"]
            wanted, measured = _forces(firmware, truth, start_ns, start_ns + half_ns)
            name = NAMES.get(count, str(count))
            rmse[name] = rms(measured - wanted) / count
            metrics[f"force_rmse_{name}_{phase}_n"] = rmse[name]
            metrics |= {f"force_fit{k}_{name}_{phase}": c for k, c in enumerate(_fit(wanted / count, measured / count))}
        metrics[f"force_difference_{phase}"] = abs(rmse["two"] - rmse["one"]) / rmse["one"] if rmse["one"] > 0.0 else math.nan
    return metrics


def _fit(wanted: np.ndarray, measured: np.ndarray) -> list[float]:
    """Coefficients of the polynomial, from degree 0 up; NaN if the wanted force never changes."""
    if np.ptp(wanted) == 0.0:
        return [math.nan] * (DEGREE + 1)
    fitted: list[float] = np.polynomial.polynomial.polyfit(wanted, measured, DEGREE).tolist()
    return fitted


def _forces(firmware: Columns, truth: Columns, start_ns: int, end_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """(k,) wanted and (k,) measured force along x of the body."""
    _, mine, theirs = np.intersect1d(firmware["tick"], truth["tick"], return_indices=True)
    keep = (firmware["time_ns"][mine] >= start_ns) & (firmware["time_ns"][mine] < end_ns)
    return firmware["wrench_wanted"][mine][keep, 0], truth["load"][theirs][keep, 0]
