"""Plots of a flight as PNG: truth, estimate, reference and command together. matplotlib is imported when needed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hil.metrics import errors, nis_mean, passive_words, refused, rms, rotation_vectors
from hil.path_plot import apart, path_3d
from hil.plot_style import AXIS_COLOURS, COMMAND, ESTIMATE, REFERENCE, STYLE, TRUTH
from hil.signals import Flight
from hil.thruster_plot import thrusters
from hil.time_plot import (
    NOT_JUDGED,
    Window,
    finish_time_axis,
    joins_s,
    judged_ticks,
    legends_below,
    limit_to_window,
    new_figure,
    say_none,
    say_unplaced,
    write_across,
)

PLOTS = ("overview", "position", "attitude", "estimate", "thrusters", "disturbance")
"""Names of the files, without .png."""
PARTING_S = 2.0
"""Time before and after a join or part in which plant and firmware may disagree on which modules form the body."""
def write_plots(
    flight: Flight,
    folder: Path,
    window: Window,
    tank_m: np.ndarray,
    force_limits_n: np.ndarray,
    paper_rmse_mm: float | None = None,
    numbers: Sequence[int] = (),
    tank: str = "box",
) -> list[Path]:
    """Write all plots of a flight into `folder`.

    Args:
        window: the judged part; the rest is shaded.
        tank_m: (2, 3) lowest and highest corner of the tank, world, m.
        force_limits_n: (2,) reverse and forward limit of each thruster, N.
        paper_rmse_mm: the paper's measurement in the same task, for comparison.
        numbers: module numbers in fleet order; 1, 2, ... by default.
        tank: `box` or `cylinder`.

    Returns:
        their paths, the overview first.
    """
    import matplotlib

    matplotlib.use("Agg")
    figures = {
        "overview": lambda: overview(flight, window, tank_m, paper_rmse_mm, tank),
        "position": lambda: position(flight, window),
        "attitude": lambda: attitude(flight, window),
        "estimate": lambda: estimate(flight, window),
        "thrusters": lambda: thrusters(flight, window, force_limits_n, numbers),
        "disturbance": lambda: disturbance(flight, window),
    }
    paths = []
    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        from matplotlib import pyplot

        for name in PLOTS:
            figure = figures[name]()
            if name not in ("overview", "thrusters") and len(flight.modules) > 1:
                leader = f"module {numbers[0] if numbers else 1}"
                text = f"The body that {leader} leads; truth of the other modules is dotted while they are apart"
                text = text if name == "position" else text.partition(";")[0]
                figure.suptitle(text, x=0.01, ha="left", fontsize=11)
            paths.append(folder / f"{name}.png")
            figure.savefig(paths[-1], metadata={"Software": None})
            pyplot.close(figure)
    return paths


def overview(flight: Flight, window: Window, tank_m: np.ndarray, paper_rmse_mm: float | None, tank: str = "box") -> Any:
    """3D path, with the size of position and attitude error beside it."""
    figure = new_figure(11.0, 5.5)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.05, 1.0))
    inside = judged_ticks(flight, window)
    path_3d(figure.add_subplot(grid[:, 0], projection="3d"), flight, tank_m, inside, tank)
    time_s = flight.time_s
    error_m, angle_rad = errors(flight)
    rows = ((1e3 * error_m, "mm", "Position", ""), (np.degrees(angle_rad), "deg", "Attitude", passive_words(flight)))
    for row, (values, unit, what, without) in enumerate(rows):
        axes = figure.add_subplot(grid[row, 1])
        steered = _once_steered(flight, values)
        axes.plot(time_s, steered, color=TRUTH, linewidth=1.0)
        if np.isfinite(steered[inside]).mean() > 0.5:
            rmse = rms(values[inside])
            axes.axhline(rmse, color=REFERENCE, linestyle="--", linewidth=1.2, label=f"RMSE {rmse:.2f} {unit}")
        elif flight.placed.any():
            write_across(axes, "hardly or never steered")
        if row == 0 and paper_rmse_mm is not None:
            paper = f"paper's robot, real tank: RMSE {paper_rmse_mm:g} mm"
            axes.axhline(paper_rmse_mm, color=AXIS_COLOURS[0], linestyle=":", linewidth=1.4, label=paper)
        axes.set(title=f"{what} error, truth against reference{without}", ylabel=unit)
        axes.set_ylim(0.0, 1.3 * max([float(values[inside].max()), *(line.get_ydata()[0] for line in axes.lines[1:])]))
        finish_time_axis(axes, flight, window, last=row == 1)
        named = {line.get_label(): line for line in axes.lines[1:]}  # modules may join and part several times
        if named:
            axes.legend(handles=list(named.values()), loc="upper right", ncols=2, fontsize=9)
        say_unplaced(axes, flight)
    bands = [patch for patch in figure.axes[-1].patches if patch.get_label() == NOT_JUDGED]
    if bands:
        figure.legend(handles=bands[:1], loc="outside lower right")
    return figure


def _once_placed(flight: Flight, values: np.ndarray) -> np.ndarray:
    """(k, ...) the values as floats, NaN before the firmware knows its pose."""
    return np.where(flight.placed.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)


def _once_steered(flight: Flight, values: np.ndarray) -> np.ndarray:
    """(k, ...) the values as floats, NaN before the firmware has a reference of its own: until it is armed, that is the estimate."""
    own = np.any(flight.firmware["setpoint_p_wb"] != flight.firmware["p_wb"], axis=1)
    steered = np.logical_or.accumulate(own & flight.placed) & flight.placed
    return np.where(steered.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)


def position(flight: Flight, window: Window) -> Any:
    """Position per axis, with its errors beside it."""
    figure = new_figure(11.0, 6.6)
    cells = figure.subplots(3, 2, sharex=True)
    truth = flight.p_wb
    wanted, believed = (_once_placed(flight, flight.firmware[name]) for name in ("setpoint_p_wb", "p_wb"))
    others = apart(flight)
    for axis, name in enumerate(("x (north)", "y (east)", "z (down)")):
        left, right = cells[axis]
        for path in others:
            left.plot(flight.time_s, path[:, axis], color=COMMAND, linestyle=":", label="truth, another module")
        left.plot(flight.time_s, believed[:, axis], color=ESTIMATE, linewidth=3.0, alpha=0.55, label="estimate")
        left.plot(flight.time_s, truth[:, axis], color=TRUTH, label="truth")
        left.plot(flight.time_s, wanted[:, axis], color=REFERENCE, linestyle="--", label="reference")
        left.set(ylabel=f"{name}, m")
        doubt_mm, error_mm = 1e3 * (believed - truth)[:, axis], _once_steered(flight, 1e3 * (truth - wanted)[:, axis])
        right.plot(flight.time_s, doubt_mm, color=ESTIMATE, linewidth=0.9, label="estimate - truth")
        right.plot(flight.time_s, error_mm, color=TRUTH, label="truth - reference")
        right.axhline(0.0, color=REFERENCE, linewidth=0.8)
        right.set(ylabel="mm")
        limit_to_window(right, flight, window, np.stack([doubt_mm, error_mm]))
        for cell in (left, right):
            finish_time_axis(cell, flight, window, last=axis == 2)
    cells[0, 0].set_title("Position")
    cells[0, 1].set_title("Errors")
    legends_below(figure, cells[0])
    return figure


def attitude(flight: Flight, window: Window) -> Any:
    """Attitude error about the body's axes, truth and estimate."""
    figure = new_figure(11.0, 5.6)
    cells = figure.subplots(3, 1, sharex=True)
    wanted = flight.firmware["setpoint_q_wb"]
    truth, believed = (
        _once_steered(flight, np.degrees(rotation_vectors(q_wb, wanted))) for q_wb in (flight.q_wb, flight.firmware["q_wb"])
    )
    for axis, name in enumerate(("roll x", "pitch y", "yaw z")):
        cells[axis].plot(flight.time_s, believed[:, axis], color=ESTIMATE, linewidth=0.9, label="estimate - reference")
        cells[axis].plot(flight.time_s, truth[:, axis], color=TRUTH, label="truth - reference")
        cells[axis].axhline(0.0, color=REFERENCE, linewidth=0.8)
        cells[axis].set(ylabel=f"{name}, deg")
        limit_to_window(cells[axis], flight, window, np.stack([truth, believed])[:, :, axis])
        finish_time_axis(cells[axis], flight, window, last=axis == 2)
    cells[0].set_title("Attitude error: rotation vector about the body axes")
    legends_below(figure, cells[:1])
    return figure


def estimate(flight: Flight, window: Window) -> Any:
    """Estimation errors inside three standard deviations, and the normalised innovation."""
    figure = new_figure(11.0, 7.6)
    cells = figure.subplots(4, 2, sharex=True, gridspec_kw={"height_ratios": (1, 1, 1, 0.9)})
    off_mm = _once_placed(flight, 1e3 * (flight.firmware["p_wb"] - flight.p_wb))
    off_deg = _once_placed(flight, np.degrees(rotation_vectors(flight.q_wb, flight.firmware["q_wb"])))
    sigmas = 1e3 * flight.firmware["sigma_p"], np.degrees(flight.firmware["sigma_q"])
    bands = tuple(_once_placed(flight, 3.0 * sigma) for sigma in sigmas)
    names = (("x, mm", "y, mm", "z, mm"), ("roll, deg", "pitch, deg", "yaw, deg"))
    whole = np.all(np.abs(flight.time_s[:, None] - np.array(joins_s(flight))) > PARTING_S, axis=1)
    for column, (error, band) in enumerate(zip((off_mm, off_deg), bands, strict=True)):
        for axis in range(3):
            cell, limit = cells[axis, column], band[:, axis]
            cell.fill_between(flight.time_s, -limit, limit, color=ESTIMATE, alpha=0.22, linewidth=0, label="3 sigma")
            cell.plot(flight.time_s, error[:, axis], color=TRUTH, linewidth=0.9, label="error of the estimate")
            cell.set(ylabel=names[column][axis])
            limit_to_window(cell, flight, window, np.where(whole, np.stack([error[:, axis], limit, -limit]), np.nan))
            finish_time_axis(cell, flight, window)
    cells[0, 0].set_title("Position: estimate against truth")
    cells[0, 1].set_title("Attitude: estimate against truth")
    _innovation(cells[3, 0], flight, window)
    _tag_age(cells[3, 1], flight, window)
    for cell in cells[3]:
        finish_time_axis(cell, flight, window, last=True)
    legends_below(figure, cells[0, :1])
    return figure


def _innovation(axes: Any, flight: Flight, window: Window) -> None:
    title = "Tag NIS per degree of freedom"
    used = flight.firmware["nis_dof"] > 0
    if not used.any():
        say_none(axes, title, "this filter tells no innovations")
        return
    ratio = flight.firmware["nis"][used] / flight.firmware["nis_dof"][used]
    axes.plot(flight.time_s[used], ratio, ".", color=TRUTH, markersize=2.0, alpha=0.5)
    axes.axhline(1.0, color=REFERENCE, linestyle="--", linewidth=1.2)
    inside = judged_ticks(flight, window)
    axes.set_title(f"{title}: mean {nis_mean(flight.firmware['nis'][inside], flight.firmware['nis_dof'][inside]):.2f}")
    axes.set(ylabel="NIS / dof")
    axes.set_ylim(bottom=0.0)


def _tag_age(axes: Any, flight: Flight, window: Window) -> None:
    age_ms = flight.firmware["tag_age_ns"] / 1e6
    axes.plot(flight.time_s, np.where(age_ms < 1e4, age_ms, np.nan), color=COMMAND, linewidth=0.8)
    axes.set_title(f"Age of the last accepted tag; rejected: {refused(flight.firmware['rejected'][judged_ticks(flight, window)])}")
    axes.set(ylabel="ms")
    axes.set_ylim(bottom=0.0)


def disturbance(flight: Flight, window: Window) -> Any:
    """Estimated disturbance, commanded force and water velocity."""
    figure = new_figure(11.0, 6.6)
    cells = figure.subplots(2, 2, sharex=True)
    wrench = flight.firmware["wrench_wanted"]
    parts = (
        (flight.firmware["force_w"], "Estimated disturbance force, world", "N"),
        (flight.firmware["moment_b"], "Estimated disturbance moment, body", "N m"),
        (wrench[:, :3], "Commanded force, body", "N"),
        (flight.truth["water_w"], "Water velocity (truth), world", "m/s"),
    )
    for i, (cell, (values, title, unit)) in enumerate(zip(cells.flat, parts, strict=True)):
        finish_time_axis(cell, flight, window, last=i >= 2)
        if title.startswith("Estimated") and not values.any():
            say_none(cell, title, "this filter estimates no disturbance")
            continue
        for axis, name in enumerate("xyz"):
            cell.plot(flight.time_s, values[:, axis], color=AXIS_COLOURS[axis], linewidth=1.1, label=name)
        cell.set(title=title, ylabel=unit)
    legends_below(figure, cells[1, :1])
    return figure
