"""Terminal output of `modcube hil campaign faults`."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hil.fault_campaign import Cell

WIDTH = 170
"""Columns of the output where it is no terminal: no word of the matrix is folded."""


def print_faults(cells: Sequence[Cell]) -> None:
    """Prints the matrix of faults and modes (what happened, and what was promised), then every broken promise."""
    console = Console()
    console = console if console.is_terminal else Console(width=WIDTH)
    modes = list(dict.fromkeys(cell.mode for cell in cells))
    promises = {cell.fault: cell.promise for cell in cells}
    table = Table(title="faults: what happened in each mode", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, leading=1)
    for column in ("fault", "promised", *modes):
        table.add_column(column, overflow="fold")
    for name, promise in promises.items():
        row = [Text(cell.happened, style="bold red" if cell.broken else "green") for cell in cells if cell.fault == name]
        table.add_row(name, promise, *row)
    console.print(table)
    broken = [cell for cell in cells if cell.broken]
    for cell in broken:
        console.print(f"FAILED: {cell.fault}, {cell.mode}: {'; '.join(cell.broken)}", style="bold red", highlight=False, soft_wrap=True)
    verdict = f"{len(cells) - len(broken)} of {len(cells)} cells kept their promise"
    console.print(verdict, style="bold red" if broken else "green", highlight=False)
