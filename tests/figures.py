"""Figures that tests measure: a line each, which `pytest -s` shows and tools/accept_measures.py reads."""

import os


def figure(name: str, value: float, unit: str = "") -> None:
    """Says what was measured."""
    print(f"\nfigure: {name} = {value:.6g} {unit}".rstrip(), flush=True)


def at_length(full: int, reduced: int) -> int:
    """How much of it: `full` with MODCUBE_FULL=1, as `make accept` has it; `reduced` in the suite."""
    return full if "MODCUBE_FULL" in os.environ else reduced
