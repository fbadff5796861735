"""A flight read back: the firmware's and the plant's signals joined by tick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from firmware_py.description.schema import DescriptionError
from firmware_py.description.signals import Columns, read_signals
from hil.truth_log import TRUTH_LOG

SIGNAL_LOG = "signals.mcap"
REGULAR_TICKS = 50
"""Ticks at the start of a log from which its period is derived."""
NO_TAG_NS = 1 << 60
"""Age of the last tag in the firmware's log from which on there was none yet."""


@dataclass(frozen=True, slots=True)
class Flight:
    """One body over the ticks that both logs hold, row by row; `lost_ns` are the times of ticks missing from one of them.

    `truth` has the columns of the body's leading module (but `force_n` and `power_w` of all its modules), and in addition
    `member`, `p_wb`, `q_wb`, `v_wb`, `w_bb` of the body. `modules` has `p_wm`, `q_wm`, `force_n` and
    `power_w` of every module, in fleet order, whichever body it is in.
    """

    firmware: Columns
    truth: Columns
    events: Columns
    ticks: Columns
    lost_ns: np.ndarray
    modules: tuple[Columns, ...] = ()
    passive: tuple[int, ...] = ()
    """Axes of the body, 0 to 5, that it leaves to buoyancy; rotations about them do not count as attitude error."""

    @property
    def time_s(self) -> np.ndarray:
        """(k,) firmware time since the first joined tick, s."""
        time_ns = self.firmware["time_ns"]
        return (time_ns - time_ns[0]) / 1e9

    @property
    def p_wb(self) -> np.ndarray:
        """(k, 3) true position of the point that the firmware steers, the body's nominal centre of mass, world, m."""
        return self.truth["p_wb"]

    @property
    def q_wb(self) -> np.ndarray:
        """(k, 4) true attitude of the body."""
        return self.truth["q_wb"]

    @property
    def placed(self) -> np.ndarray:
        """(k,) whether tags have given heading and position by then. Before that, also of a firmware that was restarted in flight, its
        estimate and set-point are not a pose.
        """
        seen = self.firmware["tag_age_ns"] < NO_TAG_NS
        return np.logical_or.accumulate(self.firmware["ready"] & seen) & seen

    def between(self, start_ns: int, end_ns: int) -> Flight:
        """The ticks with start <= time <= end."""
        time_ns = self.firmware["time_ns"]
        keep = (time_ns >= start_ns) & (time_ns <= end_ns)
        modules = tuple(rows_of(module, keep) for module in self.modules)
        lost_ns = self.lost_ns[(self.lost_ns >= start_ns) & (self.lost_ns <= end_ns)]
        return replace(self, firmware=rows_of(self.firmware, keep), truth=rows_of(self.truth, keep), lost_ns=lost_ns, modules=modules)


def rows_of(columns: Columns, which: np.ndarray) -> Columns:
    """The same columns with some of the rows, given by a mask (k,) or by indices in the wanted order."""
    return {name: column[which] for name, column in columns.items()}


def by_number(channels: Mapping[str, Columns], prefix: str) -> dict[int, Columns]:
    """The channels `prefix`0, `prefix`1, ... of a log by number, which is that of a module or of a body's leader."""
    return {int(name.removeprefix(prefix)): columns for name, columns in channels.items() if name.startswith(prefix)}


def read_flight(folder: Path) -> Flight:
    """The flight of the body that module 0 leads, from the logs in `folder`.

    Raises:
        OSError: a log is missing. DescriptionError: a log lacks the body, or the logs share no tick.
    """
    signals, truths = read_signals(folder / SIGNAL_LOG), read_signals(folder / TRUTH_LOG)
    if "/firmware/body0" not in signals or "/plant/body0" not in truths:
        raise DescriptionError(f"{folder}: no signals or no truth of the first body in the logs; was the firmware killed all the time?")
    firmware, thrusters = signals["/firmware/body0"], truths["/plant/module0"]["force_n"].shape[1]
    truth = _joined(truths)
    _, mine, theirs = np.intersect1d(firmware["tick"], truth["tick"], return_indices=True)
    if not len(mine):
        raise DescriptionError(f"{folder}: the logs of firmware and plant share no tick, so there is nothing to judge")
    nothing: Columns = {name: np.zeros(0, np.int64) for name in ("tick", "severity", "log_time")} | {"text": np.zeros(0, str)}
    believed, true = rows_of(firmware, mine), rows_of(truth, theirs)
    _use_pose_of_steered_body(believed, true, thrusters)
    ticks = signals["/firmware/ticks"]
    untold = np.concatenate([np.setdiff1d(firmware["tick"], truth["tick"]), np.setdiff1d(truth["tick"], ticks["tick"])])
    lost_ns = ticks["time_ns"][0] + period_of(ticks) * (untold - ticks["tick"][0])
    return Flight(believed, true, signals.get("/events", nothing), ticks, lost_ns, _fleet(truths, true["tick"]))


def period_of(ticks: Columns) -> int:
    """Period of the firmware's ticks from their numbers and times, ns; 1 for a single tick, which has no period."""
    numbers, times = ticks["tick"][:REGULAR_TICKS], ticks["time_ns"][:REGULAR_TICKS]
    return int(np.min(np.diff(times) // np.diff(numbers))) if len(numbers) > 1 else 1


def _fleet(truths: Mapping[str, Columns], ticks: np.ndarray) -> tuple[Columns, ...]:
    """Pose, forces and power of every module at these ticks, in the order of the fleet."""
    modules = sorted(by_number(truths, "/plant/module").items())
    return tuple({name: _at(module, ticks, name) for name in ("p_wm", "q_wm", "force_n", "power_w")} for _, module in modules)


def _joined(truths: Mapping[str, Columns]) -> Columns:
    """The truth of module 0 together with that of the body it leads, over their common ticks."""
    module, body = truths["/plant/module0"], truths["/plant/body0"]
    _, mine, theirs = np.intersect1d(module["tick"], body["tick"], return_indices=True)
    joined = rows_of(module, mine)
    joined |= {name: body[name][theirs] for name in ("member", "p_wb", "q_wb")}
    joined |= {"v_wb": body["v_w"][theirs], "w_bb": body["w_b"][theirs]}
    members = np.flatnonzero(joined["member"].any(axis=0))
    if len(members) > 1:
        others = [truths[f"/plant/module{m}"] for m in members]
        for name in ("force_n", "power_w"):
            joined[name] = np.hstack([
                np.where(joined["member"][:, [m]] > 0.0, _at(other, joined["tick"], name), np.nan)
                for m, other in zip(members, others, strict=True)
            ])  # fmt: skip
    return joined


def _at(columns: Columns, ticks: np.ndarray, name: str) -> np.ndarray:
    """Rows of a column at these ticks; the truth has all modules in every tick, so the ticks exist."""
    return columns[name][np.searchsorted(columns["tick"], ticks)]


def _use_pose_of_steered_body(firmware: Columns, truth: Columns, thrusters: int) -> None:
    """Replaces the true pose in ticks in which truth and firmware disagree about the modules of the body: between the tick in which faces
    lock or open and the one in which the firmware notices. The new pose is that of the body that the firmware still steers: its leading
    module's, with the rigid offset from the last (else the next) tick in which both saw that number of modules.
    """
    believed = np.isfinite(firmware["commanded_n"]).sum(axis=1) // thrusters
    actual = (truth["member"] > 0.0).sum(axis=1)
    for count in np.unique(believed[believed != actual]):
        unknown = np.flatnonzero((believed == count) & (actual != count))
        known = np.flatnonzero((believed == count) & (actual == count))
        if not len(known):
            continue
        then = known[np.maximum(np.searchsorted(known, unknown) - 1, 0)]
        attitudes = (truth["q_wm"][then], truth["q_wm"][unknown], truth["q_wb"][then])
        hull_then, hull, body_then = (Rotation.from_quat(q, scalar_first=True) for q in attitudes)
        lever_m = hull_then.inv().apply(truth["p_wb"][then] - truth["p_wm"][then])
        body = hull * hull_then.inv() * body_then
        truth["p_wb"][unknown] = truth["p_wm"][unknown] + hull.apply(lever_m)
        truth["q_wb"][unknown] = body.as_quat(scalar_first=True)
