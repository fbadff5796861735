"""Plots of tune_gains: step responses, open-loop Bode plot with margins, history of the search and importance of the parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from loop_response import PERIOD_NS, STEP_TICKS, Response, margins, measure, step_responses
from margins import bode
from tune_objective import Objective

from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import AXES
from hil.workers import processes

SHOWN = (0, 2, 3, 5)
"""Axes of the plots: surge (sway is similar), heave, roll (pitch is similar), yaw."""
COLOURS = {"start": "#8c959f", "shipped": "#0072b2", "tuned": "#d55e00"}
LINES = {"start": {"linestyle": "--", "zorder": 3}, "shipped": {"linewidth": 3.5}, "tuned": {}}
"""Line styles that keep each curve visible where the others coincide with it."""
GREY = "#30363d"
JOBS = 2


def draw(out: Path, objective: Objective, study: optuna.Study, sets: Mapping[str, Parameters], vehicle: str) -> None:
    """Writes steps.png, bode.png and search.png into `out`; `sets` are parameters by name. One lone module, in small motions."""
    import matplotlib

    matplotlib.use("Agg")
    with processes(JOBS)() as pool:
        loops = {name: pool.submit(measure, 1, p, vehicle=vehicle) for name, p in sets.items() if name != "start"}
        steps = {name: pool.submit(step_responses, p, SHOWN, vehicle) for name, p in sets.items()}
        draw_bode(out / "bode.png", {name: job.result() for name, job in loops.items()})
        draw_steps(out / "steps.png", {name: job.result() for name, job in steps.items()})
    draw_search(out / "search.png", objective, study)
    print("\n".join(f"plot: {out / name}" for name in ("steps.png", "bode.png", "search.png")))


def _panels(rows: int, columns: int, size: tuple[float, float], **how: Any) -> tuple[Any, np.ndarray]:
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(rows, columns, figsize=size, squeeze=False, **how)
    for panel in panels.flat:
        panel.grid(color="#d8dee4", linewidth=0.6)
        panel.set_axisbelow(True)
    return figure, panels


def _save(figure: Any, path: Path, title: str) -> None:
    import matplotlib.pyplot as plt

    figure.suptitle(title)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_steps(path: Path, steps: Mapping[str, np.ndarray]) -> None:
    """Draws a panel for each axis: the completed share of a set-point step over time."""
    figure, panels = _panels(1, len(SHOWN), (13, 3.6), sharey=True)
    time_s = 1e-9 * PERIOD_NS * np.arange(1, STEP_TICKS + 1)
    for k, (axis, panel) in enumerate(zip(SHOWN, panels.flat, strict=True)):
        for name, moved in steps.items():
            panel.plot(time_s, np.clip(moved[k], -1.0, 3.0), color=COLOURS[name], label=name, **LINES[name])
        panel.axhline(1.0, color=GREY, linewidth=0.8)
        panel.set(title=AXES[axis], xlabel="time, s", ylim=steps_range(steps))
    panels[0, 0].set_ylabel("share of the step")
    panels[0, 0].legend(frameon=False, loc="lower right")
    _save(figure, path, "One module: step of the set-point, 50 mm and 5 deg, as estimated; no noise, with thruster lag, tick and tag delay")


def steps_range(steps: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """Lowest and highest share that the axes show: the range of all responses, limited to 0.2 below 0 and 0.8 above 1 for unstable ones."""
    made = np.array(list(steps.values()))
    return max(min(float(made.min()) - 0.05, -0.05), -0.2), min(max(float(made.max()) + 0.05, 1.1), 1.8)


def draw_bode(path: Path, loops: Mapping[str, list[Response]]) -> None:
    """Draws gain and phase of the loops broken at the plant's input, with their margins."""
    figure, panels = _panels(2, len(SHOWN), (13, 6), sharex=True, sharey="row")
    for axis, (gain, phase) in zip(SHOWN, panels.T, strict=True):
        for name, responses in loops.items():
            response = responses[axis]
            found = margins(response)
            label = f"{name}: {found.gain_db:.1f} dB, {found.phase_deg:.0f} deg" if math.isfinite(found.gain_db) else name
            for panel, values in zip((gain, phase), bode(response), strict=True):
                panel.plot(response.frequency, values, color=COLOURS[name], label=label, **LINES[name])
            for panel in (gain, phase):
                panel.axvline(found.crossover_rad_s, color=COLOURS[name], linewidth=0.8, linestyle=":")
        gain.axhline(0.0, color=GREY, linewidth=0.8)
        phase.axhline(-180.0, color=GREY, linewidth=0.8)
        title = {"title": AXES[axis], "title_fontsize": "large"}
        gain.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), borderaxespad=0.2, fontsize=8, **title)
        phase.set_xlabel("frequency, rad/s")
    panels[0, 0].set(xscale="log", ylabel="loop gain, dB", ylim=(-40, 50))
    panels[1, 0].set(ylabel="phase, deg", ylim=(-300, 100), yticks=range(-270, 91, 90))
    _save(figure, path, "One module: loops broken at the plant's input, gain and phase margin; dotted: crossover")


def draw_search(path: Path, objective: Objective, study: optuna.Study) -> None:
    """Draws the best objective from trial to trial, and the share of each parameter in the objective's variance."""
    figure, panels = _panels(1, 2, (13, 3.8), gridspec_kw={"width_ratios": (3, 2)})
    history, importance = panels.flat
    complete = [t for t in study.trials if t.state == optuna.trial.TrialState.COMPLETE]
    pruned = [t for t in study.trials if t.state == optuna.trial.TrialState.PRUNED]
    best = np.minimum.accumulate([float(t.value) for t in complete])
    top = 4.0 * best[-1]
    for trials, marker, label in ((complete, "o", "flown to the end"), (pruned, "x", "ended early")):
        if trials:
            values = np.minimum([float(t.value) for t in trials], top)
            history.plot([t.number + 1 for t in trials], values, marker, color=COLOURS["start"], markersize=4, label=label)
    history.step([t.number + 1 for t in complete], best, where="post", color=COLOURS["tuned"], label="best so far")
    history.xaxis.get_major_locator().set_params(integer=True)
    history.set(xlabel="trial", ylabel="objective", ylim=(0.0, 1.04 * top), title="search; four times the best and worse lie on top")
    history.legend(frameon=False, loc="center right")
    if len(complete) > len(objective.search):
        shares = optuna.importance.get_param_importances(study, evaluator=optuna.importance.PedAnovaImportanceEvaluator())
        importance.barh([name.partition(".")[2] for name in shares], list(shares.values()), color=COLOURS["shipped"])
        importance.invert_yaxis()
    importance.set(title="importance (PED-ANOVA, share of the variance)", xlabel="share")
    _save(figure, path, objective.help[:1].upper() + objective.help[1:])
