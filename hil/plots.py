"""Plots of a flight as PNG: truth, estimate, reference and command together. matplotlib is imported when needed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hil.metrics import errors, nis_mean, passive_words, refused, rms, rotation_vectors
from hil.path_plot import apart, path_3d
from hil.plot_style import AXIS_COLOURS, COMMAND, ESTIMATE, GREY, REFERENCE, STYLE, TRUTH
from hil.signals import Flight

PLOTS = ("overview", "position", "attitude", "estimate", "thrusters", "disturbance")
"""Names of the files, without .png."""
NOT_JUDGED = "before or after the task, not judged"
"""Meaning of grey in every plot over time."""
JOINED = "modules join or part: the origin moves"
"""Meaning of a vertical line in every plot over time."""
ROUNDING_S = 1e-6
PARTING_S = 2.0
"""Time before and after a join or part in which plant and firmware may disagree on which modules form the body."""
MODULE_COLUMNS = 4
"""Modules whose thrusters are plotted side by side."""


class Window(NamedTuple):
    """The part of a flight that is judged, s since its first tick."""

    start_s: float
    end_s: float


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
    figure = _figure(11.0, 5.5)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.05, 1.0))
    inside = _inside(flight, window)
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
            _write_across(axes, "hardly or never steered")
        if row == 0 and paper_rmse_mm is not None:
            paper = f"paper's robot, real tank: RMSE {paper_rmse_mm:g} mm"
            axes.axhline(paper_rmse_mm, color=AXIS_COLOURS[0], linestyle=":", linewidth=1.4, label=paper)
        axes.set(title=f"{what} error, truth against reference{without}", ylabel=unit)
        axes.set_ylim(0.0, 1.3 * max([float(values[inside].max()), *(line.get_ydata()[0] for line in axes.lines[1:])]))
        _finish_time_axis(axes, flight, window, last=row == 1)
        named = {line.get_label(): line for line in axes.lines[1:]}  # modules may join and part several times
        if named:
            axes.legend(handles=list(named.values()), loc="upper right", ncols=2, fontsize=9)
        _say_unplaced(axes, flight)
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
    figure = _figure(11.0, 6.6)
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
        _limit_to_window(right, flight, window, np.stack([doubt_mm, error_mm]))
        for cell in (left, right):
            _finish_time_axis(cell, flight, window, last=axis == 2)
    cells[0, 0].set_title("Position")
    cells[0, 1].set_title("Errors")
    _legends_below(figure, cells[0])
    return figure


def attitude(flight: Flight, window: Window) -> Any:
    """Attitude error about the body's axes, truth and estimate."""
    figure = _figure(11.0, 5.6)
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
        _limit_to_window(cells[axis], flight, window, np.stack([truth, believed])[:, :, axis])
        _finish_time_axis(cells[axis], flight, window, last=axis == 2)
    cells[0].set_title("Attitude error: rotation vector about the body axes")
    _legends_below(figure, cells[:1])
    return figure


def estimate(flight: Flight, window: Window) -> Any:
    """Estimation errors inside three standard deviations, and the normalised innovation."""
    figure = _figure(11.0, 7.6)
    cells = figure.subplots(4, 2, sharex=True, gridspec_kw={"height_ratios": (1, 1, 1, 0.9)})
    off_mm = _once_placed(flight, 1e3 * (flight.firmware["p_wb"] - flight.p_wb))
    off_deg = _once_placed(flight, np.degrees(rotation_vectors(flight.q_wb, flight.firmware["q_wb"])))
    sigmas = 1e3 * flight.firmware["sigma_p"], np.degrees(flight.firmware["sigma_q"])
    bands = tuple(_once_placed(flight, 3.0 * sigma) for sigma in sigmas)
    names = (("x, mm", "y, mm", "z, mm"), ("roll, deg", "pitch, deg", "yaw, deg"))
    whole = np.all(np.abs(flight.time_s[:, None] - np.array(_joins_s(flight))) > PARTING_S, axis=1)
    for column, (error, band) in enumerate(zip((off_mm, off_deg), bands, strict=True)):
        for axis in range(3):
            cell, limit = cells[axis, column], band[:, axis]
            cell.fill_between(flight.time_s, -limit, limit, color=ESTIMATE, alpha=0.22, linewidth=0, label="3 sigma")
            cell.plot(flight.time_s, error[:, axis], color=TRUTH, linewidth=0.9, label="error of the estimate")
            cell.set(ylabel=names[column][axis])
            _limit_to_window(cell, flight, window, np.where(whole, np.stack([error[:, axis], limit, -limit]), np.nan))
            _finish_time_axis(cell, flight, window)
    cells[0, 0].set_title("Position: estimate against truth")
    cells[0, 1].set_title("Attitude: estimate against truth")
    _innovation(cells[3, 0], flight, window)
    _tag_age(cells[3, 1], flight, window)
    for cell in cells[3]:
        _finish_time_axis(cell, flight, window, last=True)
    _legends_below(figure, cells[0, :1])
    return figure


def _innovation(axes: Any, flight: Flight, window: Window) -> None:
    title = "Tag NIS per degree of freedom"
    used = flight.firmware["nis_dof"] > 0
    if not used.any():
        _say_none(axes, title, "this filter tells no innovations")
        return
    ratio = flight.firmware["nis"][used] / flight.firmware["nis_dof"][used]
    axes.plot(flight.time_s[used], ratio, ".", color=TRUTH, markersize=2.0, alpha=0.5)
    axes.axhline(1.0, color=REFERENCE, linestyle="--", linewidth=1.2)
    inside = _inside(flight, window)
    axes.set_title(f"{title}: mean {nis_mean(flight.firmware['nis'][inside], flight.firmware['nis_dof'][inside]):.2f}")
    axes.set(ylabel="NIS / dof")
    axes.set_ylim(bottom=0.0)


def _tag_age(axes: Any, flight: Flight, window: Window) -> None:
    age_ms = flight.firmware["tag_age_ns"] / 1e6
    axes.plot(flight.time_s, np.where(age_ms < 1e4, age_ms, np.nan), color=COMMAND, linewidth=0.8)
    axes.set_title(f"Age of the last accepted tag; rejected: {refused(flight.firmware['rejected'][_inside(flight, window)])}")
    axes.set(ylabel="ms")
    axes.set_ylim(bottom=0.0)


def thrusters(flight: Flight, window: Window, force_limits_n: np.ndarray, numbers: Sequence[int] = ()) -> Any:
    """Force of each thruster: commanded after the limiter, and delivered by the plant. Several modules get a column each.

    Args:
        numbers: module numbers in fleet order; 1, 2, ... by default.
    """
    commanded, given = flight.firmware["commanded_n"], _forces(flight)
    names = _module_names(flight, numbers)
    per = given.shape[1] // len(names)
    names += ["Docked for the firmware alone"] * (commanded.shape[1] // per - len(names))
    layout = _columns_of(len(names), per)
    figure = _figure(11.0, 1.2 + (1.45 if len(names) == 1 else 1.05) * len(layout))
    cells = figure.subplots(*layout.shape, sharex=True, sharey=True, squeeze=False)
    widest = 1.15 * max(1.0, *(float(np.nanmax(np.abs(force))) for force in (commanded, given)))  # NaN: not in this body in that tick
    for (row, column), i in np.ndenumerate(layout):
        cell = cells[row, column]
        if i < 0:
            cell.set_axis_off()
            continue
        if i < commanded.shape[1]:
            cell.plot(flight.time_s, commanded[:, i], color=COMMAND, linewidth=2.4, alpha=0.6, label="command")
        if i < given.shape[1]:
            cell.plot(flight.time_s, given[:, i], color=TRUTH, linewidth=1.0, label="truth")
        for limit in force_limits_n:
            cell.axhline(limit, color=AXIS_COLOURS[0], linestyle=":", linewidth=1.0)
        cell.set(ylabel=f"T{i % per + 1}, N", ylim=(-widest, widest))
        if len(names) > 1 and i % per == 0:
            cell.set_title(names[i // per])
        _finish_time_axis(cell, flight, window, last=row == len(layout) - 1)
    low, high = force_limits_n
    figure.suptitle(f"Thruster forces (limits {low:g} and {high:g} N)", x=0.01, ha="left", fontsize=11, fontweight="bold")
    _legends_below(figure, cells[0, :1])
    return figure


def _forces(flight: Flight) -> np.ndarray:
    """(k, n) true forces of all thrusters of the modules that were in the body, also while a module was apart."""
    ever = np.flatnonzero((flight.truth["member"] > 0.0).any(axis=0))
    if len(flight.modules) < 2:
        return flight.truth["force_n"]
    return np.hstack([flight.modules[m]["force_n"] for m in ever])


def _module_names(flight: Flight, numbers: Sequence[int]) -> list[str]:
    """Names of the modules that were in the body, in the order of its true forces."""
    member = flight.truth["member"] > 0.0
    every = [f"Module {number}" for number in numbers or range(1, 1 + member.shape[1])]
    return [every[m] + ("" if member[:, m].all() else ", commands while docked") for m in np.flatnonzero(member.any(axis=0))]


def _columns_of(modules: int, per: int) -> np.ndarray:
    """(rows, columns) thruster of each panel, -1 if empty: a single module takes two columns, several take a column each."""
    if modules == 1:
        layout = np.full((-(-per // 2), 2), -1)
        layout.flat[:per] = range(per)
        return layout
    blocks = -(-modules // MODULE_COLUMNS)
    columns = -(-modules // blocks)
    index = np.full((blocks * columns, per), -1)
    index[:modules] = np.arange(modules * per).reshape(modules, per)
    return index.reshape(blocks, columns, per).swapaxes(1, 2).reshape(-1, columns)


def disturbance(flight: Flight, window: Window) -> Any:
    """Estimated disturbance, commanded force and water velocity."""
    figure = _figure(11.0, 6.6)
    cells = figure.subplots(2, 2, sharex=True)
    wrench = flight.firmware["wrench_wanted"]
    parts = (
        (flight.firmware["force_w"], "Estimated disturbance force, world", "N"),
        (flight.firmware["moment_b"], "Estimated disturbance moment, body", "N m"),
        (wrench[:, :3], "Commanded force, body", "N"),
        (flight.truth["water_w"], "Water velocity (truth), world", "m/s"),
    )
    for i, (cell, (values, title, unit)) in enumerate(zip(cells.flat, parts, strict=True)):
        _finish_time_axis(cell, flight, window, last=i >= 2)
        if title.startswith("Estimated") and not values.any():
            _say_none(cell, title, "this filter estimates no disturbance")
            continue
        for axis, name in enumerate("xyz"):
            cell.plot(flight.time_s, values[:, axis], color=AXIS_COLOURS[axis], linewidth=1.1, label=name)
        cell.set(title=title, ylabel=unit)
    _legends_below(figure, cells[1, :1])
    return figure


def _say_none(axes: Any, title: str, why: str) -> None:
    """Marks a panel as empty and writes the reason in it."""
    axes.set(title=f"{title}: none", yticks=[])
    _write_across(axes, why)


def _say_unplaced(axes: Any, flight: Flight) -> None:
    if not flight.placed.any():
        _write_across(axes, "the firmware never knew its pose")


def _write_across(axes: Any, text: str) -> None:
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center")


def _figure(width: float, height: float) -> Any:
    from matplotlib import pyplot

    return pyplot.figure(figsize=(width, height), layout="constrained")


def _inside(flight: Flight, window: Window) -> np.ndarray:
    """(k,) judged ticks. The margin absorbs rounding of the seconds and is far shorter than a tick."""
    return (flight.time_s >= window.start_s - ROUNDING_S) & (flight.time_s <= window.end_s + ROUNDING_S)


def _limit_to_window(axes: Any, flight: Flight, window: Window, values: np.ndarray) -> None:
    """Scales an axis to the judged part; the take-off would flatten everything else."""
    judged = values[:, _inside(flight, window)]
    low, high = (float(end(judged, initial=0.0, where=np.isfinite(judged))) for end in (np.min, np.max))
    margin = 0.08 * max(high - low, 1e-9)
    axes.set_ylim(low - margin, high + margin)
    _say_unplaced(axes, flight)


def _finish_time_axis(axes: Any, flight: Flight, window: Window, last: bool = False) -> None:
    end_s = float(flight.time_s[-1])
    axes.set_xlim(0.0, end_s)
    for low, high in ((0.0, window.start_s), (window.end_s, end_s)):
        if high - low > 0.05:
            axes.axvspan(low, high, color=GREY, zorder=0, linewidth=0, label=NOT_JUDGED)
    for at_s in _joins_s(flight):
        axes.axvline(at_s, color=REFERENCE, linestyle="-.", linewidth=0.8, label=JOINED)
    if last:
        axes.set_xlabel("time (s)")


def _joins_s(flight: Flight) -> list[float]:
    """Times at which the firmware steers another number of thrusters than before, s."""
    count = np.isfinite(flight.firmware["commanded_n"]).sum(axis=1)
    return [float(at_s) for at_s in flight.time_s[1:][np.diff(count) != 0]]


def _legends_below(figure: Any, cells: Any) -> None:
    """One legend for the whole figure, below it, with grey last; many entries take two rows."""
    handles = {label: handle for cell in cells for handle, label in zip(*cell.get_legend_handles_labels(), strict=True)}
    handles = dict(sorted(handles.items(), key=lambda item: item[0] == NOT_JUDGED))
    columns = len(handles) if len(handles) < 6 else -(-len(handles) // 2)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)
