"""Panels over time: their axis, the part that is judged, modules that join, panels without data, and the legend below all."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hil.plot_style import GREY, REFERENCE
from hil.signals import Flight

NOT_JUDGED = "before or after the task, not judged"
"""Meaning of grey in every plot over time."""
JOINED = "modules join or part: the origin moves"
"""Meaning of a vertical line in every plot over time."""
ROUNDING_S = 1e-6


class Window(NamedTuple):
    """The part of a flight that is judged, s since its first tick."""

    start_s: float
    end_s: float


def say_none(axes: Any, title: str, why: str) -> None:
    """Marks a panel as empty and writes the reason in it."""
    axes.set(title=f"{title}: none", yticks=[])
    write_across(axes, why)


def say_unplaced(axes: Any, flight: Flight) -> None:
    """Writes in a panel that the firmware never knew its pose, if so."""
    if not flight.placed.any():
        write_across(axes, "the firmware never knew its pose")


def write_across(axes: Any, text: str) -> None:
    """Writes a text across a panel."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center")


def new_figure(width: float, height: float) -> Any:
    """Returns an empty figure, in inches, that arranges its panels itself."""
    from matplotlib import pyplot

    return pyplot.figure(figsize=(width, height), layout="constrained")


def judged_ticks(flight: Flight, window: Window) -> np.ndarray:
    """(k,) judged ticks. The margin absorbs rounding of the seconds and is far shorter than a tick."""
    return (flight.time_s >= window.start_s - ROUNDING_S) & (flight.time_s <= window.end_s + ROUNDING_S)


def limit_to_window(axes: Any, flight: Flight, window: Window, values: np.ndarray) -> None:
    """Scales an axis to the judged part; the take-off would flatten everything else."""
    judged = values[:, judged_ticks(flight, window)]
    low, high = (float(end(judged, initial=0.0, where=np.isfinite(judged))) for end in (np.min, np.max))
    margin = 0.08 * max(high - low, 1e-9)
    axes.set_ylim(low - margin, high + margin)
    say_unplaced(axes, flight)


def finish_time_axis(axes: Any, flight: Flight, window: Window, last: bool = False) -> None:
    """Limits a panel to the flight, shades what is not judged, and marks joins; the `last` panel of a column names the axis."""
    end_s = float(flight.time_s[-1])
    axes.set_xlim(0.0, end_s)
    for low, high in ((0.0, window.start_s), (window.end_s, end_s)):
        if high - low > 0.05:
            axes.axvspan(low, high, color=GREY, zorder=0, linewidth=0, label=NOT_JUDGED)
    for at_s in joins_s(flight):
        axes.axvline(at_s, color=REFERENCE, linestyle="-.", linewidth=0.8, label=JOINED)
    if last:
        axes.set_xlabel("time (s)")


def joins_s(flight: Flight) -> list[float]:
    """Times at which the firmware steers another number of thrusters than before, s."""
    count = np.isfinite(flight.firmware["commanded_n"]).sum(axis=1)
    return [float(at_s) for at_s in flight.time_s[1:][np.diff(count) != 0]]


def legends_below(figure: Any, cells: Any) -> None:
    """One legend for the whole figure, below it, with grey last; many entries take two rows."""
    handles = {label: handle for cell in cells for handle, label in zip(*cell.get_legend_handles_labels(), strict=True)}
    handles = dict(sorted(handles.items(), key=lambda item: item[0] == NOT_JUDGED))
    columns = len(handles) if len(handles) < 6 else -(-len(handles) // 2)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)
