"""One dock over time, like the paper's figure: both currents, the gap, the two conditions and the tries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.description.signals import Columns, read_signals
from hil.plot_style import STYLE
from hil.signals import SIGNAL_LOG, rows_of
from hil.truth_log import TRUTH_LOG

THRESHOLD_MA = 70.0
"""The paper's threshold; that of the flight may differ."""
FACES = ("#0b63b0", "#c0392b")
GAP, LATERAL = "#7b3294", "#e69f00"
HOLDS = "#2e8b57"
MARK = "#555f6b"
STAGES = ("pre-approach", "align", "approach", "push", "verify", "docked", "release", "back off", "aborted", "failed")
"""Names of the stages, indexed by the number in the log."""
DOCK_PLOT = "docking.png"
TRUE_GAP = "true gap (near by, until locked)"
"""Label of the plant's own gap, which does not exist for modules far from each other or of the same body."""
PAUSE_NS = 1_000_000_000
"""Pause between two rows of a pair above which the second belongs to another dock."""
LEGEND_SHARE = 0.2
"""Height added above the curves for the legend, as a share of theirs."""
LAST_SHARE = 0.08
"""Share of the time axis added after a dock's last tick, in which its last stage begins."""
LEAST_SHARE = 0.04
"""Share of the time axis above which a stage is labelled; the last stage always is."""


def write_dock_plot(folder: Path, start_ns: int) -> list[Path]:
    """Draws the first dock of the run in `folder`; nothing if there was none."""
    docks = read_signals(folder / SIGNAL_LOG).get("/firmware/docks")
    truth = read_signals(folder / TRUTH_LOG).get("/plant/docks")
    if docks is None or truth is None:
        return []
    import matplotlib

    matplotlib.use("Agg")
    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        from matplotlib import pyplot

        figure = docking(docks, truth, start_ns)
        path = folder / DOCK_PLOT
        figure.savefig(path, metadata={"Software": None})
        pyplot.close(figure)
    return [path]


def docking(docks: Columns, truth: Columns, start_ns: int) -> Any:
    """The figure of the first dock of a run.

    Args:
        docks: /firmware/docks. truth: /plant/docks. start_ns: time of the first tick of the run.
    """
    from matplotlib import pyplot

    pair = (docks["module_b"] == docks["module_b"][0]) & (docks["module_a"] == docks["module_a"][0])
    again = np.flatnonzero(np.diff(docks["time_ns"][pair]) > PAUSE_NS)  # the same pair, undocked and docked again
    rows = rows_of(docks, np.flatnonzero(pair)[: again[0] + 1 if again.size else None])
    time_s = 1e-9 * (rows["time_ns"] - start_ns)
    figure, (currents, gap, conditions) = pyplot.subplots(
        3, 1, figsize=(9.0, 7.0), sharex=True, layout="constrained", height_ratios=(2, 2, 1.2)
    )
    _currents(currents, time_s, rows["current_ma"])
    _gap(gap, time_s, rows, truth, start_ns)
    _conditions(conditions, time_s, rows)
    for axes in (currents, gap, conditions):
        for at_s in time_s[1:][np.diff(rows["stage"]) != 0]:
            axes.axvline(at_s, color=MARK, linewidth=0.6, alpha=0.5)
    return figure


def _currents(axes: Any, time_s: np.ndarray, current_ma: np.ndarray) -> None:
    for face, colour in enumerate(FACES):
        axes.plot(time_s, current_ma[:, face], color=colour, linewidth=1.1, label=("target's face", "active face")[face])
    for sign, label in ((1.0, f"threshold, {THRESHOLD_MA:g} mA"), (-1.0, None)):
        axes.axhline(sign * THRESHOLD_MA, color=MARK, linestyle="--", linewidth=0.9, label=label)
    axes.set(ylabel="mA", title="Relay currents of the two faces")
    _legend_above(axes)


def _gap(axes: Any, time_s: np.ndarray, rows: Columns, truth: Columns, start_ns: int) -> None:
    axes.plot(time_s, 1e3 * rows["gap_m"], color=GAP, linewidth=1.1, label="gap, estimated")
    axes.plot(time_s, 1e3 * rows["lateral_m"], color=LATERAL, linewidth=1.0, label="lateral offset, estimated")
    true_s = 1e-9 * (truth["time_ns"] - start_ns)
    under_way = (true_s >= time_s[0]) & (true_s <= time_s[-1])
    axes.plot(true_s[under_way], 1e3 * truth["gap_m"][under_way], color="black", linestyle=":", linewidth=1.2, label=TRUE_GAP)
    axes.set(ylabel="mm", title="Gap between the two faces, and lateral offset")
    _legend_above(axes)


def _legend_above(axes: Any) -> None:
    """Legend at the top, with room for it above the curves."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + LEGEND_SHARE * (high - low))
    axes.legend(loc="upper right", ncols=3, fontsize=9)


def _conditions(axes: Any, time_s: np.ndarray, rows: Columns) -> None:
    duration_s = max(time_s[-1] - time_s[0], 1e-9)
    end_s = time_s[-1] + LAST_SHARE * duration_s
    for level, name in enumerate(("current_holds", "position_holds")):
        holds = np.append(rows[name], rows[name][-1]).astype(float)
        axes.fill_between(np.append(time_s, end_s), level, level + 0.8 * holds, step="post", color=HOLDS, linewidth=0, zorder=2.1)
    axes.set_yticks([0.4, 1.4, 2.5], ["current", "position", "stage"])
    axes.grid(visible=False, axis="y")  # it would strike through the names of the stages
    axes.set(xlim=(time_s[0], end_s), ylim=(-0.1, 3.1), xlabel="time (s)", title="Conditions for a dock (green: holds), and its stages")
    starts = np.flatnonzero(np.diff(rows["stage"], prepend=-1))
    again = rows["tries"].max() > 1
    for k, (begin_s, till_s) in enumerate(zip(time_s[starts], [*time_s[starts[1:]], end_s], strict=True)):
        row = starts[k]
        name = STAGES[int(rows["stage"][row])] + (f"\ntry {rows['tries'][row]}" if again else "")
        if row == starts[-1] or till_s - begin_s > LEAST_SHARE * duration_s:
            at_s, ha = (0.5 * (begin_s + till_s), "center") if k else (begin_s, "left")  # centred, it may begin on the axis's own words
            axes.text(at_s, 2.5, name, ha=ha, va="center", fontsize=8)
