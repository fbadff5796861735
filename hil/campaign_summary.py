"""Statistics of many trials: success and metrics with confidence intervals, worst seeds, and what each metric depends on."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
import scipy  # submodules load on first use; importing them takes a second, and the workers do not need them

CONFIDENCE = 0.95
WORST = 5
"""Number of seeds named as the worst, failed ones first."""
QUANTILES = {"min": 0.0, "q05": 0.05, "median": 0.5, "q95": 0.95, "max": 1.0}
LEAST_TRIALS = 10
"""Minimum number of trials for sensitivities."""
NEARLY_ONE = 1.0 - 1e-12
"""The largest correlation that Fisher's transform takes."""

Trial = Mapping[str, Any]
"""`seed`, `passed`, `outcome`, `metrics` and `world`. The last two map names to numbers, or None where there was none."""


def summarise(scenario: str, trials: Sequence[Trial]) -> dict[str, Any]:
    """The content of campaign.json, with Wilson's interval for success and an order-statistics interval for each median."""
    succeeded = sum(bool(trial["passed"]) for trial in trials)
    interval = scipy.stats.binomtest(succeeded, len(trials)).proportion_ci(CONFIDENCE, method="wilson")
    worst = sorted(trials, key=_goodness)[:WORST]
    return {
        "scenario": scenario,
        "trials": len(trials),
        "succeeded": succeeded,
        "outcomes": dict(Counter(trial["outcome"] for trial in trials)),
        "confidence_interval": [interval.low, interval.high],
        "metrics": {name: _spread(_known(trials, "metrics", name)) for name in _names(trials, "metrics")},
        "sensitivities": sensitivities(trials),
        "worst_seeds": [trial["seed"] for trial in worst],
        "seeds": [trial["seed"] for trial in trials],
    }


def _goodness(trial: Trial) -> tuple[bool, float]:
    """Sort key, worst first: failed trials before passed ones, then by falling position error; a trial without that metric is the worst."""
    error_m = trial["metrics"].get("position_rmse_m")
    return bool(trial["passed"]), -math.inf if error_m is None else -error_m


def _names(trials: Sequence[Trial], part: str) -> list[str]:
    return list(dict.fromkeys(name for trial in trials for name in trial.get(part, {})))


def _known(trials: Sequence[Trial], part: str, name: str) -> np.ndarray:
    """(k,) finite values of one metric or world parameter."""
    values = np.array([trial.get(part, {}).get(name) for trial in trials], dtype=float)
    return values[np.isfinite(values)]


def _spread(known: np.ndarray) -> dict[str, float | None]:
    low, high = median_interval(known)
    found = {name: float(np.quantile(known, q)) if known.size else None for name, q in QUANTILES.items()}
    return {**found, "median_low": low, "median_high": high}


def median_interval(values: np.ndarray) -> tuple[float | None, float | None]:
    """Distribution-free confidence interval of the median: order statistics that enclose it in at least 95 % of cases.

    None if there are too few values (David and Nagaraja, Order Statistics, 2003, section 7.1).
    """
    n, ordered = values.size, np.sort(values)
    below = int(scipy.stats.binom.ppf(0.5 * (1.0 - CONFIDENCE), n, 0.5)) - 1 if n else -1
    while below + 1 < n / 2 and scipy.stats.binom.cdf(below + 1, n, 0.5) <= 0.5 * (1.0 - CONFIDENCE):
        below += 1
    if below < 0:
        return None, None
    return float(ordered[below]), float(ordered[n - 1 - below])


def sensitivities(trials: Sequence[Trial]) -> dict[str, dict[str, dict[str, float]]]:
    """Spearman's rank correlation of each metric with each parameter of the world, with its 95 % interval.

    The interval is Fisher's, with Bonett and Wright's variance (Psychometrika 65, 2000). A pair in which either never changes is left out.
    """
    if len(trials) < LEAST_TRIALS:
        return {}
    found: dict[str, dict[str, dict[str, float]]] = {}
    for metric in _names(trials, "metrics"):
        for parameter in _names(trials, "world"):
            pairs = np.array([(t["metrics"].get(metric), t["world"].get(parameter)) for t in trials], dtype=float)
            pairs = pairs[np.isfinite(pairs).all(axis=1)]
            if len(pairs) >= LEAST_TRIALS and np.all(np.ptp(pairs, axis=0) > 0.0):
                found.setdefault(metric, {})[parameter] = _rank_correlation(pairs)
    return found


def _rank_correlation(pairs: np.ndarray) -> dict[str, float]:
    rho = float(scipy.stats.spearmanr(pairs[:, 0], pairs[:, 1]).statistic)
    half = _deviations(CONFIDENCE) * math.sqrt((1.0 + 0.5 * rho * rho) / (len(pairs) - 3))
    z = math.atanh(max(-NEARLY_ONE, min(NEARLY_ONE, rho)))
    return {"rho": rho, "low": math.tanh(z - half), "high": math.tanh(z + half)}


def surely_not_zero(correlation: Mapping[str, float], pairs: int) -> bool:
    """Whether a correlation of `sensitivities` differs significantly from zero when `pairs` of them are examined together.

    Among many pairs some lie outside their own 95 % interval by chance, so the interval is widened by Bonferroni's correction: it misses
    with 1/`pairs` of the probability.
    """
    rho = correlation["rho"]
    z, nearer = (math.atanh(max(-NEARLY_ONE, min(NEARLY_ONE, r))) for r in (rho, correlation["low" if rho > 0.0 else "high"]))
    wider = _deviations(1.0 - (1.0 - CONFIDENCE) / pairs) / _deviations(CONFIDENCE)
    return abs(z) > wider * abs(z - nearer)


def _deviations(confidence: float) -> float:
    """Half-width of the central interval that contains this share of a normal variable, in standard deviations."""
    return NormalDist().inv_cdf(0.5 + 0.5 * confidence)


def table_of(trials: Sequence[Trial]) -> str:
    """The content of trials.csv: a row per seed with the metrics, then the world parameters of the seed."""
    metrics, world = _names(trials, "metrics"), _names(trials, "world")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["seed", "passed", "outcome", *metrics, *(f"world.{name}" for name in world)])
    for t in trials:
        values = [*(t["metrics"].get(m) for m in metrics), *(t.get("world", {}).get(w) for w in world)]
        writer.writerow([t["seed"], int(t["passed"]), t["outcome"], *("" if v is None else repr(float(v)) for v in values)])
    return text.getvalue()
