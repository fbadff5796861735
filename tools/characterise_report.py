"""report.html of characterise.py: one self-contained file in which every surface can be turned with the mouse."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from characterise_surfaces import SPACES, Picture, pictures

from firmware_py.description.vehicle import AXES
from firmware_py.prepare.capability.layout import FRAMES, UNITS
from firmware_py.prepare.capability.summary import Capability

_DIGITS = 4


def write_report(path: Path, found: Mapping[str, Capability], titles: Mapping[str, str], tables: str = "") -> None:
    """Writes the page.

    Args:
        found: by vehicle; `titles` by the same names.
        tables: HTML that follows the surfaces.
    """
    template = Path(__file__).with_name("characterise_report.html").read_text(encoding="utf-8")
    rows = []
    shown = {name: pictures(result) for name, result in found.items()}
    for key in SPACES:
        parts = {name: by[key] for name, by in shown.items()}
        rows.append(
            {
                "title": next(iter(parts.values())).title,
                "axes": [AXES[component] for component in FRAMES[key[1]]],
                "limit": max(part.limit for part in parts.values()) or 1.0,  # where all are degenerate
                "kind": key[0],
                "unit": "W" if key[0] == "power" else UNITS[key[1]],
                "panels": [_panel(titles[name], part) for name, part in parts.items()],
            }
        )
    notes = [f"{titles[name]}: {note}" for name, result in found.items() for note in result.notes]
    figure = path.with_suffix(".png")
    picture = base64.b64encode(figure.read_bytes()).decode() if figure.exists() else ""
    page = template.replace("/*DATA*/", json.dumps({"rows": rows}, separators=(",", ":")))
    page = page.replace("<!--NOTES-->", "".join(f"<li>{html.escape(note)}</li>" for note in notes))
    page = page.replace("<!--TABLES-->", tables)
    page = page.replace(
        "<!--FIGURE-->", f'<img src="data:image/png;base64,{picture}" alt="capability figure">' if picture else ""
    )
    path.write_text(page, encoding="utf-8")


def _panel(title: str, picture: Picture) -> dict[str, object]:
    return {
        "title": title,
        "caption": picture.caption.replace("$^", "^").replace("$", ""),
        "declared": picture.declared,
        "surface": _points(picture.polygons),
        "ellipsoid": _points(picture.ellipsoid),
    }


def _points(polygons: list[np.ndarray]) -> list[object]:
    """Polygons rounded to four digits of the largest coordinate."""
    if not polygons:
        return []
    largest = max(float(np.abs(polygon).max()) for polygon in polygons)
    decimals = int(_DIGITS - np.ceil(np.log10(max(largest, 1e-12))))
    return [np.round(polygon, decimals).tolist() for polygon in polygons]
