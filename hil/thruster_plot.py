"""The forces of all thrusters of a flight, a panel each: commanded, and delivered by the plant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hil.plot_style import AXIS_COLOURS, COMMAND, TRUTH
from hil.signals import Flight
from hil.time_plot import Window, finish_time_axis, legends_below, new_figure

MODULE_COLUMNS = 4
"""Modules whose thrusters are plotted side by side."""


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
    figure = new_figure(11.0, 1.2 + (1.45 if len(names) == 1 else 1.05) * len(layout))
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
        finish_time_axis(cell, flight, window, last=row == len(layout) - 1)
    low, high = force_limits_n
    figure.suptitle(f"Thruster forces (limits {low:g} and {high:g} N)", x=0.01, ha="left", fontsize=11, fontweight="bold")
    legends_below(figure, cells[0, :1])
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
