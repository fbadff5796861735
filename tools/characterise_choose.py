"""`--choose N --task FILE` of characterise.py: ranks all shapes of N modules for a task, best first."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.capability.choice import Choice, rank
from firmware_py.prepare.capability.polycubes import Cells
from firmware_py.prepare.capability.task import Task, load_task
from firmware_py.prepare.drag_cache import DragCache, default_folder

_COLUMNS = (
    "rank", "cells", "box", "poses", "margin", "power_w", "variance_n2", "guaranteed_margin", "guaranteed_n",
    "guaranteed_nm", "worst_n", "worst_nm",
)  # fmt: skip


def choose(count: int, path: Path, out: Path | None, console: Console, progress: Console) -> None:
    """Prints the ranking; with `out` also writes choice.csv and choice.json. Raises DescriptionError."""
    task = load_task(path)
    vehicle = load_vehicle(task.vehicle, None if not task.vehicle.endswith(".toml") else path.parent)
    cache = DragCache(default_folder(os.environ, Path.home()))
    bars = (TextColumn("shapes"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*bars, console=progress, transient=True, disable=not progress.is_terminal) as bar:
        mark = bar.add_task("shapes", total=None)

        def done(now: int, total: int) -> None:
            bar.update(mark, completed=now, total=total)
            if not progress.is_terminal:
                progress.print(f"{now}/{total} shapes", highlight=False)

        found = rank(task, count, vehicle, cache, progress=done)
    _show(console, task, count, found, vehicle.assumption)
    if out:
        _write(out, task, found)


def _show(console: Console, task: Task, count: int, found: Sequence[Choice], assumption: str) -> None:
    what = f"{len(found)} shapes of {count} x {task.vehicle}"
    title = f"{task.name}: {what}, by {task.rank_by}; guaranteed: with any {task.dead} dead"
    shown = Table(title=title, title_justify="left")
    heads = (
        "rank", "cells", "box", "poses", "margin", "power, W", "variance, N^2", "margin\nguaranteed",
        "worst force\nguaranteed, N", "worst moment\nguaranteed, N m", "worst force, N", "worst moment, N m",
    )  # fmt: skip
    for head in heads:
        shown.add_column(head, justify="left" if head in ("cells", "box") else "right", overflow="fold")
    for place, choice in enumerate(found, 1):
        row = _row(place, choice)
        shown.add_row(*(f"{row[c]:.4g}" if isinstance(row[c], float) else str(row[c]) for c in _COLUMNS))
    console.print(shown)
    console.print(
        "margin: factor by which the whole task can be multiplied; below 1 the shape cannot do it", highlight=False
    )
    if assumption:
        console.print(f"assumption: {assumption}", markup=False, highlight=False)


def _row(place: int, choice: Choice) -> dict[str, Any]:
    best = choice.best
    box = "x".join(str(int(edge)) for edge in np.array(best.cells).max(axis=0) + 1)
    values = (
        place, cells_text(best.cells), box, choice.poses,
        best.margin, best.power_w, best.variance, choice.guaranteed_margin, choice.guaranteed_n, choice.guaranteed_nm,
        choice.whole_n, choice.whole_nm,
    )  # fmt: skip
    return dict(zip(_COLUMNS, values, strict=True))


def cells_text(cells: Cells) -> str:
    """Cells in the notation of --assembly."""
    return " ".join(",".join(str(c) for c in cell) for cell in cells)


def _write(out: Path, task: Task, found: Sequence[Choice]) -> None:
    rows = [_row(place, choice) for place, choice in enumerate(found, 1)]
    try:
        out.mkdir(parents=True, exist_ok=True)
        with (out / "choice.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, _COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows({k: f"{v:.6e}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
        content = {
            "task": task.name,
            "vehicle": task.vehicle,
            "rank_by": task.rank_by,
            "dead": task.dead,
            "shapes": [{k: v if not isinstance(v, float) or math.isfinite(v) else None for k, v in row.items()} for row in rows],
        }
        (out / "choice.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise DescriptionError(f"{error.filename}: cannot be written: {error.strerror}") from None
    print(out / "choice.csv")
    print(out / "choice.json")
