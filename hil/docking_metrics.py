"""Outcome of the docks of a run, from its logs alone: which modules ended up joined, in how many tries, and how a dock failed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from firmware_py.core.rotations import conjugate, exp, multiply, rotate
from firmware_py.description.signals import Columns, read_signals
from firmware_py.description.vehicle import FACE_NAMES, FACE_NORMALS
from hil.dock_plot import STAGES
from hil.metrics import OUTCOMES
from hil.scenario import Scenario
from hil.signals import SIGNAL_LOG, by_number, rows_of
from hil.task import Step
from hil.truth_log import TRUTH_LOG

BELIEVED, TRUE = "/firmware/body", "/plant/body"
"""Prefixes of the body channels, before the leader's number: as the firmware believes, and as they really are."""
DOCKED, JAMMED, UNSTABLE, REFUSED, GAVE_UP = range(len(OUTCOMES))
DECLARED, FAILED = STAGES.index("docked"), STAGES.index("failed")
"""Stages of a dock in the ticks in which the firmware declares two bodies joined, or gives it up."""
FACING = math.cos(math.radians(30.0))
"""Least cosine between the normals of mated faces and the line from centre to centre: 30 deg, a third of a quarter turn."""
AS_TURNED = 0.1
"""Tolerance of the cosine of half an angle by which one of four seats counts as that of the least angle: a third of 0.29, by which that of
no angle and that of a quarter turn differ."""
UNSTABLE_RAD, KEPT_UP_TICKS = math.radians(30.0), 200
"""A body whose attitude stays this far from its set-point, for this many ticks, is out of control."""


def dock_steps_by_pair(scenario: Scenario) -> dict[tuple[int, int], list[Step]]:
    """Dock and undock steps of each pair of modules (fleet indices, the lower first), in order."""
    pairs: dict[tuple[int, int], list[Step]] = {}
    for step in scenario.step:
        if step.do in ("dock", "undock"):
            low, high = sorted(map(scenario.index_of, step.modules))
            pairs.setdefault((low, high), []).append(step)
    return pairs


def docking_metrics(scenario: Scenario, folder: Path) -> dict[str, float]:
    """Docking metrics of a run with [[step]]s.

    Returns:
        docked: whether modules joined and parted as the steps ask, and the firmware gave no dock up; gap_min_m: smallest distance between
        opposite faces, NaN if none came near; tries: contacts of a probe with a funnel; jams: jammed contacts; outcome: index into
        OUTCOMES; false_declarations: joins declared by the firmware that did not happen; join_jump_n: largest step of a thruster's
        commanded force in a tick in which bodies were joined, N; docked_rmse_m: RMSE of all joined bodies against their set-points.

    Raises:
        OSError: a log is missing. ValueError: the truth log has no docks.
    """
    truths, signals = read_signals(folder / TRUTH_LOG), read_signals(folder / SIGNAL_LOG)
    docks = truths.get("/plant/docks")
    if docks is None:
        raise ValueError(f"{folder}: no truth of docks in the logs")
    docked = is_as_asked(scenario, truths) and not _is_given_up(signals)
    outcome = DOCKED if docked else _failure(docks, signals)
    return {
        "docked": float(docked),
        "gap_min_m": float(np.fmin.reduce(docks["gap_m"])),
        "tries": float(docks["contacts"][-1]),
        "jams": float(docks["jams"][-1]),
        "outcome": float(outcome),
        "false_declarations": float(_false_declarations(truths, signals)),
        "join_jump_n": _join_jump_n(truths, signals),
        "docked_rmse_m": _docked_rmse_m(truths, signals),
    }


def _together(truths: Mapping[str, Columns], ticks: np.ndarray) -> np.ndarray:
    """(k, m, m) whether each two modules share a body in each of these ticks."""
    bodies = by_number(truths, TRUE).values()
    count = next(iter(bodies))["member"].shape[1]
    found = np.zeros((len(ticks), count, count), dtype=bool)
    for columns in bodies:
        inside = columns["member"] > 0.0
        found[np.searchsorted(ticks, columns["tick"])] |= inside[:, :, None] & inside[:, None, :]
    return found


def is_obeyed(wishes: Sequence[bool], together: np.ndarray) -> bool:
    """Whether two modules joined and parted in the order of the wishes, and end in the last wished state.

    Args:
        wishes: at least one; True to join, False to part.
        together: (k,) whether the two shared a body, over the run.
    """
    changes = iter(together[np.append(True, together[1:] != together[:-1])])
    return all(wish in changes for wish in wishes) and bool(together[-1]) == wishes[-1]


def _meet(scenario: Scenario, step: Step, truths: Mapping[str, Columns]) -> bool:
    """Whether the faces that a dock step names face each other at the end of the run, turned as it says."""
    active, target = (truths[f"/plant/module{scenario.index_of(number)}"] for number in step.modules)
    way = target["p_wm"][-1] - active["p_wm"][-1]
    way = way / np.linalg.norm(way)
    return _is_turned(step, multiply(conjugate(target["q_wm"][-1]), active["q_wm"][-1])) and all(
        rotate(module["q_wm"][-1], FACE_NORMALS[FACE_NAMES.index(face)].astype(float)) @ along > FACING
        for module, face, along in ((active, step.face, way), (target, step.target_face, -way))
    )


def _is_turned(step: Step, q_ta: np.ndarray) -> bool:
    """Whether the active module, at the attitude q_ta (4,) in the target's frame, has made the step's quarter turns about the target
    face's normal: without them it would be in the seat, of four, that turns it least. Several seats may tie.
    """
    quarter = 0.5 * math.pi * FACE_NORMALS[FACE_NAMES.index(step.target_face)]
    cosines = [abs(multiply(exp(-turns * quarter), q_ta)[0]) for turns in range(4)]
    return bool(cosines[step.quarter_turns] > max(cosines) - AS_TURNED)


def _later_dock(scenario: Scenario, last: Step, together: np.ndarray) -> list[Step]:
    """The dock step after the undock `last` that rejoined its two modules by docking other modules of their bodies; empty if none."""
    low, high = map(scenario.index_of, last.modules)
    apart = np.flatnonzero(~together[:, low, high])
    if last.do == "dock" or not apart.size:
        return []
    hold = np.logical_and.reduce(together[apart[-1] :])
    begun = next(i for i, step in enumerate(scenario.step) if step is last)
    docks = [step for step in scenario.step[begun:] if step.do == "dock"]
    ends = [tuple(map(scenario.index_of, step.modules)) for step in docks]
    joins = [(hold[low, i] and hold[high, j]) or (hold[low, j] and hold[high, i]) for i, j in ends]
    return [step for step, joined in zip(docks, joins, strict=True) if joined][-1:]


def is_as_asked(scenario: Scenario, truths: Mapping[str, Columns]) -> bool:
    """Whether all docks and undocks happened in order, with the faces that they name; without any, whether nothing joined or parted."""
    together, pairs = _together(truths, truths["/plant/docks"]["tick"]), dock_steps_by_pair(scenario)
    if not pairs:
        return bool((together == together[0]).all())
    return all(
        is_obeyed([step.do == "dock" for step in (*steps, *_later_dock(scenario, steps[-1], together))], together[:, i, j])
        and (steps[-1].do == "undock" or _meet(scenario, steps[-1], truths))
        for (i, j), steps in pairs.items()
    )


def _bodies(channels: Mapping[str, Columns], prefix: str, ticks: np.ndarray) -> np.ndarray:
    """(k,) number of bodies in each tick."""
    there = (np.isin(ticks, columns["tick"]) for columns in by_number(channels, prefix).values())
    return sum(there, np.zeros(len(ticks), dtype=np.int64))


def _false_declarations(truths: Mapping[str, Columns], signals: Mapping[str, Columns]) -> int:
    """Number of joins that the firmware declared but that did not happen: the larger of two counts. One checks each declared pair against
    the true bodies; the other compares the numbers of bodies, which also catches joins that no dock declared.
    """
    ticks = truths["/plant/docks"]["tick"]
    believed, real = _bodies(signals, BELIEVED, ticks), _bodies(truths, TRUE, ticks)
    joined = np.diff(believed, prepend=believed[:1]) < 0
    too_few = int((joined & (believed > 0) & (believed < real)).sum())
    docks = signals.get("/firmware/docks")
    if docks is None:
        return too_few
    declared = (docks["stage"] == DECLARED) & np.isin(docks["tick"], ticks)
    at = np.searchsorted(ticks, docks["tick"][declared])
    true = _together(truths, ticks)[at, docks["module_a"][declared], docks["module_b"][declared]]
    return max(too_few, int((~true).sum()))


def _is_given_up(signals: Mapping[str, Columns]) -> bool:
    """Whether the firmware gave a dock up: hulls that it then let go have joined and parted without a dock and an undock."""
    docks = signals.get("/firmware/docks")
    return docks is not None and bool((docks["stage"] == FAILED).any())


def _failure(docks: Columns, signals: Mapping[str, Columns]) -> int:
    said: Sequence[str] = [str(text) for text in signals.get("/events", {}).get("text", np.zeros(0, str))]
    if _off_attitude(signals) > UNSTABLE_RAD:
        return UNSTABLE
    if docks["jams"][-1] > 0:
        return JAMMED
    return REFUSED if any("dock refused" in text.lower() or "-> ABORTED" in text for text in said) else GAVE_UP


def _off_attitude(signals: Mapping[str, Columns]) -> float:
    """Largest angle between set-point and estimate that any body with a known pose sustains over KEPT_UP_TICKS, rad."""
    worst = 0.0
    for columns in by_number(signals, BELIEVED).values():
        if len(columns["tick"]) >= KEPT_UP_TICKS:
            cosine = np.abs(np.sum(columns["q_wb"] * columns["setpoint_q_wb"], axis=1))
            angle = np.where(columns["ready"], 2.0 * np.arccos(np.clip(cosine, 0.0, 1.0)), 0.0)
            worst = max(worst, float(np.lib.stride_tricks.sliding_window_view(angle, KEPT_UP_TICKS).min(axis=1).max()))
    return worst


def _join_jump_n(truths: Mapping[str, Columns], signals: Mapping[str, Columns]) -> float:
    """Largest step of a thruster's commanded force over all declared joins, N; NaN without any. A joined body lists the thrusters of the
    target first, then those of the active body.
    """
    bodies, docks, worst = by_number(signals, BELIEVED), signals.get("/firmware/docks"), math.nan
    if docks is None:
        return worst
    declared = docks["stage"] == DECLARED
    for tick, target, active in zip(*(docks[name][declared].tolist() for name in ("tick", "module_a", "module_b")), strict=True):
        before, after = ({n: force for n, c in bodies.items() if (force := _forces(c, at)) is not None} for at in (tick - 1, tick))
        members = {n: _members(truths, n, tick, len(force)) for n, force in before.items()}
        pair = [n for module in (target, active) for n in members if module in members[n]]
        both = np.concatenate([before[n] for n in pair] or [np.zeros(0)])
        for joined in (after[n] for n in pair if n in after and len(after[n]) == len(both)):
            worst = float(np.fmax(worst, np.abs(joined - both).max()))
    return worst


def _members(truths: Mapping[str, Columns], leader: int, tick: int, thrusters: int) -> np.ndarray:
    """Modules of a body that has this many thrusters in the firmware's view: the members of the true body when it last had as many, since
    the true body joins before the firmware's.
    """
    true = _body_with(truths, leader)
    alike = (true["tick"] < tick) & (_thrusters(truths, true) == thrusters)
    return np.flatnonzero(true["member"][alike][-1:].any(axis=0))


def _body_with(truths: Mapping[str, Columns], module: int) -> Columns:
    """The true body that contains `module`, tick by tick. True bodies carry the number of their lowest module, the firmware's that of
    their leader.
    """
    parts = [rows_of(columns, columns["member"][:, module] > 0.0) for columns in by_number(truths, TRUE).values()]
    found = {name: np.concatenate([part[name] for part in parts]) for name in ("tick", "member", "p_wb")}
    return rows_of(found, np.argsort(found["tick"]))


def _thrusters(truths: Mapping[str, Columns], true: Columns) -> np.ndarray:
    """(k,) number of thrusters of a true body, tick by tick; the modules of a fleet may be of several kinds."""
    each = [truths[f"/plant/module{m}"]["force_n"].shape[1] for m in range(true["member"].shape[1])]
    return np.asarray((true["member"] > 0.0) @ each)


def _docked_rmse_m(truths: Mapping[str, Columns], signals: Mapping[str, Columns]) -> float:
    """Position RMSE of the truth against the set-point, over the ticks in which both logs have the joined body and the firmware knows its
    pose; NaN without any.
    """
    squares = [np.zeros(0)]
    for leader, believed in by_number(signals, BELIEVED).items():
        true = _body_with(truths, leader)
        _, mine, theirs = np.intersect1d(true["tick"], believed["tick"], return_indices=True)
        forces = np.isfinite(believed["commanded_n"][theirs]).sum(axis=1)
        members = (true["member"][mine] > 0.0).sum(axis=1)
        joined = (members > 1) & (forces == _thrusters(truths, true)[mine]) & (believed["ready"][theirs] > 0)
        gap = true["p_wb"][mine][joined] - believed["setpoint_p_wb"][theirs][joined]
        squares.append(np.sum(gap**2, axis=1))
    everything = np.concatenate(squares)
    return float(np.sqrt(everything.mean())) if everything.size else math.nan


def _forces(columns: Columns, tick: int) -> np.ndarray | None:
    """Commanded forces (n,) of a body in a tick, N; None if the body did not exist then."""
    row = np.flatnonzero(columns["tick"] == tick)
    return columns["commanded_n"][row[0]][np.isfinite(columns["commanded_n"][row[0]])] if row.size else None
