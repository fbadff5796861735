"""Figures that tests measure: a line each, which `make test-vcan` shows and `make accept` reads."""

import re

_LINE = re.compile(r"^figure: (?P<name>.+) = (?P<value>\S+)", re.MULTILINE)


def figure(name: str, value: float, unit: str = "") -> None:
    """Says what was measured."""
    print(f"\nfigure: {name} = {value:.6g} {unit}".rstrip(), flush=True)


def read_figures(text: str) -> dict[str, list[float]]:
    """All values by name, in order of appearance."""
    found: dict[str, list[float]] = {}
    for line in _LINE.finditer(text):
        found.setdefault(line["name"], []).append(float(line["value"]))
    return found
