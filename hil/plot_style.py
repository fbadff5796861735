"""Colours and style of all plots of a flight."""

from __future__ import annotations

from typing import Any

TRUTH, ESTIMATE, REFERENCE, COMMAND = "#0072b2", "#e69f00", "#30363d", "#009e73"
"""One colour per kind of signal in every plot (Okabe and Ito's palette, safe for colour-blind readers)."""
GREY = "#e4e9ee"
AXIS_COLOURS = ("#cc3311", "#009988", "#0077bb")
STYLE: dict[str, Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "grid.color": "#d8dee4",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "figure.dpi": 110,
    "savefig.facecolor": "white",
}
