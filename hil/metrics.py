"""Metrics of a flight from its logs alone: truth against reference, estimate against truth. Every tick counts."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from firmware_py.description.signals import Columns
from hil.checks import UNBOUNDED, limit_text
from hil.signals import Flight

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
WARNING = 4
"""Syslog severity."""
PAPER_SPIRAL_RMSE_MM = 20.92
"""Position RMSE of the paper's robot on its spiral in a real tank (RS-ModCubes)."""


class Shown(NamedTuple):
    """How a metric is displayed: label, and a unit for which the value is multiplied by `scale`, or words indexed by the value."""

    label: str
    unit: str = ""
    scale: float = 1.0
    digits: int = 2
    words: tuple[str, ...] = ()
    low: float = 0.0
    """Smallest value that a flight can have, unscaled."""
    high: float = math.inf
    """Largest value that a flight can have, unscaled."""


PASSIVE = {axis: f"passive_{AXES[axis]}_max_rad" for axis in (3, 4, 5)}
"""Metrics by axis, 0 to 5, of a rotation that the vehicle leaves to buoyancy; only such a vehicle has them."""
OUTCOMES = ("as asked", "jammed", "unstable control", "refused", "gave up")
"""Outcomes of a run's docks, indexed by the metric `outcome`."""
SHOWN = {
    "position_rmse_m": Shown("Position RMSE, truth against reference", "mm", 1e3),
    "position_max_m": Shown("Position error, largest", "mm", 1e3),
    "attitude_rmse_rad": Shown("Attitude RMSE, truth against reference", "deg", math.degrees(1.0)),
    "attitude_max_rad": Shown("Attitude error, largest", "deg", math.degrees(1.0)),
    **{name: Shown(f"Passive {AXES[k]}, largest: not in the attitude errors", "deg", math.degrees(1.0)) for k, name in PASSIVE.items()},
    "estimate_position_rmse_m": Shown("Position RMSE, estimate against truth", "mm", 1e3),
    "estimate_attitude_rmse_rad": Shown("Attitude RMSE, estimate against truth", "deg", math.degrees(1.0)),
    "nis_mean": Shown("Tag NIS per degree of freedom (ideal: 1)"),
    "sigma3_share": Shown("Truth within 3 sigma, worst axis", "%", 100.0, 1, high=1.0),
    **{f"sigma3_share_{axis}": Shown(f"Truth within 3 sigma, {axis}", "%", 100.0, 1, high=1.0) for axis in AXES},
    "thrust_rms_n": Shown("Thruster command, RMS", "N"),
    "thrust_rate_rms_n_s": Shown("Thruster command, rate of change, RMS", "N/s"),
    "supply_power_w": Shown("Electrical power of all modules, mean", "W"),
    "wrench_margin_min": Shown("Thrust reserve, worst thruster and tick", "%", 100.0, 1, low=-math.inf),
    "tags_rejected": Shown("Tag observations refused by the estimator", digits=0),
    "armed_share": Shown("Time armed, share of the judged part", "%", 100.0, 1, high=1.0),
    "docked": Shown("Docked and undocked as asked", words=("no", "yes"), high=1.0),
    "gap_min_m": Shown("Gap between facing faces, smallest", "mm", 1e3, low=-math.inf),
    "tries": Shown("Contacts of a probe with a funnel", digits=0),
    "jams": Shown("Jammed contacts", digits=0),
    "outcome": Shown("Docking outcome", words=OUTCOMES, high=len(OUTCOMES) - 1),
    "false_declarations": Shown("False declarations of a dock", digits=0),
    "docked_rmse_m": Shown("Position RMSE of docked bodies", "mm", 1e3),
    "join_jump_n": Shown("Thruster step when bodies join, largest", "N"),
    "warnings": Shown("Firmware warnings, whole flight", digits=0),
    "duration_s": Shown("Duration of the judged part", "s"),
    "real_time_factor": Shown("Simulation speed over real time", "x", digits=1),
    "ticks": Shown("Ticks judged", digits=0),
    "unmatched_ticks": Shown("Ticks missing from a log", digits=0),
    "deadline_misses": Shown("Deadlines missed", digits=0),
}
"""Metrics in the order in which tables show them."""
DOCKING = ("docked", "gap_min_m", "tries", "jams", "outcome", "false_declarations", "docked_rmse_m", "join_jump_n")
"""Metrics that only a run with [[step]]s has."""
AS_ASKED = ("docked", "outcome")
"""Those of them that judge the docks and undocks of the [[step]]s."""
FORCE_METRIC = re.compile(r"force_(rmse|fit|difference)(\d?)_(?:(\w+)_)?(on|off)(?:_n)?")


def metric_order(names: Iterable[str]) -> list[str]:
    """Every name once: the names in `SHOWN`, in its order, then the others in the given order."""
    given = dict.fromkeys(names)
    return [name for name in SHOWN if name in given] + [name for name in given if name not in SHOWN]


def shown(metric: str) -> Shown:
    """How `metric` is displayed; a metric without an entry is shown by its own name, unscaled."""
    return SHOWN.get(metric) or _force_shown(metric) or Shown(metric, digits=4)


def _force_shown(metric: str) -> Shown | None:
    """Display of a force-tracking metric (hil.force_metrics), whose names depend on the bodies; None for any other metric."""
    if (match := FORCE_METRIC.fullmatch(metric)) is None:
        return None
    what, degree, body, phase = match.groups()
    jets = f"interference {phase}"
    if what == "difference":
        return Shown(f"Force RMSE, difference of two modules from one, {jets}", "%", 100.0)
    of = f"{body} module{'' if body == 'one' else 's'}, {jets}"
    if what == "rmse":
        return Shown(f"Force RMSE per module, {of}", "N")
    return Shown(f"Force fit, degree {degree}, {of}", digits=4, low=-math.inf)


def shown_value(metric: str, value: float) -> str:
    """The value as displayed: `2.72 mm`."""
    how = shown(metric)
    if not math.isfinite(value):
        return "none"
    if how.words:
        return how.words[round(value)]
    rounded = round(value * how.scale, how.digits) + 0.0  # without the sign of a negative zero
    return f"{rounded:.{how.digits}f} {how.unit}".rstrip()


def shown_limit(metric: str, low: float, high: float) -> str:
    """The bounds of a check as displayed: `<= 5 mm`, or the words that pass."""
    how = shown(metric)
    if how.words:
        return " or ".join(word for number, word in enumerate(how.words) if low <= number <= high)
    low, high = (bound * how.scale if abs(bound) < UNBOUNDED else bound for bound in (low, high))
    return f"{limit_text(low, high)} {how.unit}".rstrip()


def rotation_vectors(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(k, 3) rotation vectors, in frame b, that turn attitudes b into a: log(b^-1 a), angle at most pi, rad.

    Args:
        a, b: (k, 4) unit quaternions, scalar first.
    """
    w = np.sum(a * b, axis=1)
    v = b[:, :1] * a[:, 1:] - a[:, :1] * b[:, 1:] - np.cross(b[:, 1:], a[:, 1:])
    sign = np.where(w < 0, -1.0, 1.0)
    sine = np.linalg.norm(v, axis=1)
    angle = 2.0 * np.arctan2(sine, np.abs(w))
    factor = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    return (sign * factor)[:, None] * v


class Poses(NamedTuple):
    """Actual or wanted poses of a body in k ticks: centre of mass and attitude in the world."""

    p_wb: np.ndarray
    """(k, 3) m."""
    q_wb: np.ndarray
    """(k, 4)."""


def errors(flight: Flight, wanted: Poses | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(k,) distance, m, and (k,) angle, rad, of the truth from `wanted`, by default from the firmware's own set-points.

    The angle leaves out rotations that the body leaves to buoyancy (`Flight.passive`).
    """
    off_m, off_rad = _offsets(flight, wanted)
    off_rad[:, _passive_rotations(flight)] = 0.0
    return np.linalg.norm(off_m, axis=1), np.linalg.norm(off_rad, axis=1)


def _offsets(flight: Flight, wanted: Poses | None) -> tuple[np.ndarray, np.ndarray]:
    """(k, 3) offset, world, m, and (k, 3) rotation vector, body, rad, of the truth from `wanted`, as in `errors`."""
    wanted = wanted or Poses(flight.firmware["setpoint_p_wb"], flight.firmware["setpoint_q_wb"])
    return flight.p_wb - wanted.p_wb, rotation_vectors(flight.q_wb, wanted.q_wb)


def _passive_rotations(flight: Flight) -> list[int]:
    """Components of a rotation vector that the body leaves to buoyancy."""
    return [axis - 3 for axis in flight.passive if axis in PASSIVE]


def passive_words(flight: Flight) -> str:
    """A line to end a title of attitude errors: `without passive pitch`; empty where all rotations count."""
    names = [AXES[axis] for axis in flight.passive if axis in PASSIVE]
    return f"\nwithout passive {' and '.join(names)}" if names else ""


def flight_metrics(
    flight: Flight,
    *,
    wanted: Poses | None = None,
    wall_s: float = 0.0,
    deadline_misses: int = 0,
) -> dict[str, float]:
    """All metrics in result.json for a flight of one body.

    Args:
        flight: the ticks of the trajectory, from its start to its end (`Flight.between`). Without any tick all metrics are NaN.
        wanted: reference pose of the task in each of them; by default the firmware's own set-point, which may be anything.
        wall_s: wall time that the same ticks took, s; 0 if unknown, which gives a real-time factor of 0.
        deadline_misses: ticks that began late; 0 in lockstep.
    """
    firmware = flight.firmware
    if not len(firmware["tick"]):
        return dict.fromkeys((name for name in SHOWN if name not in (*DOCKING, *PASSIVE.values())), math.nan)
    time_s = flight.time_s
    period_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    return _tracking(flight, wanted) | _estimation(flight) | {
        "thrust_rms_n": float(np.sqrt(np.nanmean(np.square(firmware["commanded_n"])))),
        "thrust_rate_rms_n_s": rate_rms(firmware["commanded_n"], period_s),
        "supply_power_w": float(np.sum([module["power_w"] for module in flight.modules], axis=0).mean()),
        "wrench_margin_min": float(np.fmin.reduce(firmware["wrench_margin"])),
        "tags_rejected": float(refused(firmware["rejected"])),
        "warnings": float(warnings(flight.events["severity"], flight.events["text"])),
        "duration_s": float(time_s[-1]),  # from start to end, both ticks included
        "real_time_factor": len(time_s) * period_s / wall_s if wall_s > 0.0 else 0.0,
        "ticks": float(len(time_s)),
        "unmatched_ticks": float(len(flight.lost_ns)),
        "deadline_misses": float(deadline_misses),
    }  # fmt: skip


def _tracking(flight: Flight, wanted: Poses | None) -> dict[str, float]:
    """Errors of the truth against the reference."""
    error, angle = errors(flight, wanted)
    return {
        "position_rmse_m": rms(error),
        "position_max_m": float(error.max()),
        "attitude_rmse_rad": rms(angle),
        "attitude_max_rad": float(angle.max()),
        **{PASSIVE[i + 3]: float(np.abs(_offsets(flight, wanted)[1][:, i]).max()) for i in _passive_rotations(flight)},
    }


def _estimation(flight: Flight) -> dict[str, float]:
    """Errors of the estimate against the truth, and whether they agree with the filter's covariance."""
    firmware = flight.firmware
    off_m, off_rad = firmware["p_wb"] - flight.p_wb, rotation_vectors(flight.q_wb, firmware["q_wb"])
    within = np.abs(np.hstack([off_m, off_rad])) <= 3.0 * np.hstack([firmware["sigma_p"], firmware["sigma_q"]])
    shares = within.mean(axis=0).tolist()
    return {
        "estimate_position_rmse_m": rms(np.linalg.norm(off_m, axis=1)),
        "estimate_attitude_rmse_rad": rms(np.linalg.norm(off_rad, axis=1)),
        "nis_mean": nis_mean(firmware["nis"], firmware["nis_dof"]),
        **{f"sigma3_share_{axis}": share for axis, share in zip(AXES, shares, strict=True)},
        "sigma3_share": min(shares),
    }


def rms(values: np.ndarray) -> float:
    """Root mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))


def rate_rms(values: np.ndarray, period_s: float) -> float:
    """RMS of the rate of change of (n, k) values sampled every `period_s` seconds, per second; NaN for fewer than two samples."""
    return float(np.sqrt(np.nanmean(np.square(np.diff(values, axis=0) / period_s)))) if len(values) > 1 else math.nan


def warnings(severity: np.ndarray, text: np.ndarray) -> int:
    """Events of syslog severity warning or worse in the whole flight, except `ARM refused`, which is normal until the first tags."""
    waiting = np.char.startswith(text, "ARM refused") if text.size else np.zeros(0, bool)
    return int(np.count_nonzero((severity <= WARNING) & ~waiting))


def warning_lines(events: Columns, start_ns: int) -> tuple[str, ...]:
    """Events of syslog severity warning or worse, each text once, in order: `1.0 s: ARM refused: no pose yet (12 x)`.

    Args:
        events: of the whole flight. start_ns: time zero of the displayed times.
    """
    grave = events["severity"] <= WARNING
    texts, first, counts = np.unique(events["text"][grave], return_index=True, return_counts=True)
    at_s = 1e-9 * (events["log_time"][grave][first] - start_ns)
    times = [f" ({count} x)" if count > 1 else "" for count in counts]
    return tuple(f"{at_s[i]:.1f} s: {texts[i]}{times[i]}" for i in np.argsort(first))


def refused(rejected: np.ndarray) -> int:
    """Tag observations rejected by the gate over these ticks, from the filter's counter, which restarts when its body joins or parts."""
    return int(np.maximum(np.diff(rejected), 0).sum())


def nis_mean(nis: np.ndarray, dof: np.ndarray) -> float:
    """NIS of the accepted tag updates over its expectation (1 for a consistent filter).

    (k,) per tick, summed over the updates of the tick; ticks without one are NaN or have dof 0. NaN without any.
    """
    used = (dof > 0) & np.isfinite(nis)
    return float(nis[used].sum() / dof[used].sum()) if used.any() else float("nan")
