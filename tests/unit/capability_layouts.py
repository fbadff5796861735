"""Published layouts, read once for the tests of prepare.capability."""

import dataclasses
import functools
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.capability.layout import Layout, of_modules, of_rows, of_vehicle

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "tools" / "data"
SEVEN = ("modcube_sim", "double", "quad", "chasing_m2", "girona500", "bluerov2_heavy", "bluerov2")
FLU_TO_FRD = np.diag([1.0, -1.0, -1.0])
"""For positions and directions; symmetric, so that it may be multiplied from either side."""
LINE = [(0, 0, 0), (0, 1, 0)]
SQUARE = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]


@functools.cache
def published(name: str) -> dict[str, Any]:
    return tomllib.loads((DATA / "published_layouts.toml").read_text())[name]


def raw(name: str) -> Layout:
    entry = published(name)
    return of_rows(name, np.array(entry["thrusters"]), entry["f_min"], entry["f_max"], load_vehicle("modcube_sim"))


def without(layout: Layout, dead: Sequence[int]) -> Layout:
    """Returns the layout without the dead thrusters, which are numbered from 0."""
    alive = np.setdiff1d(np.arange(layout.count), dead)
    own = {name: getattr(layout, name)[alive] for name in ("f_min", "f_max", "power_forward", "power_reverse")}
    return dataclasses.replace(layout, matrix=layout.matrix[:, alive], **own)


def one_of_seven(name: str) -> Layout:
    cells = {"double": LINE, "quad": SQUARE}.get(name)
    if cells is None:
        return of_vehicle(load_vehicle(name))
    return of_modules(cells, [0] * len(cells), [load_vehicle("modcube_sim")] * len(cells))
