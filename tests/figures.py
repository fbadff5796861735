"""Figures that tests measure: a line each, which `pytest -s` shows and tools/accept_measures.py reads."""


def figure(name: str, value: float, unit: str = "") -> None:
    """Says what was measured."""
    print(f"\nfigure: {name} = {value:.6g} {unit}".rstrip(), flush=True)
