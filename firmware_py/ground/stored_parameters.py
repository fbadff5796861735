"""The file of parameters changed by ground stations. It holds only values that differ from those at start: new defaults take effect.

Read at start before the parameters are used, and rewritten at every change.
"""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path

from firmware_py.description.builder import build
from firmware_py.description.parameters import Parameters, registry
from firmware_py.description.schema import read_toml
from firmware_py.description.toml_text import to_plain, to_toml

_FEW = 8
"""Most stored parameters that `stored_line` lists by name."""


def with_stored_values(parameters: Parameters, path: Path | None) -> Parameters:
    """Returns `parameters` overlaid with the values stored in `path`, if the file exists. Raises DescriptionError."""
    if path is None or not path.exists():
        return parameters
    table, source = read_toml(path)
    build(Parameters, table, source)  # refuses invalid entries
    merged = {group: values | table.get(group, {}) for group, values in to_plain(parameters).items()}
    laid: Parameters = build(Parameters, merged, source)
    return laid


def differing(parameters: Parameters, others: Parameters) -> list[str]:
    """Returns the names of the parameters whose value differs in `others`."""
    return [name for name, _ in registry() if attrgetter(name)(parameters) != attrgetter(name)(others)]


def stored_line(started: Parameters, laid: Parameters, path: Path | None) -> str:
    """Returns one line on how many stored values replace those at start; empty when none does."""
    names = differing(laid, started)
    which = f": {', '.join(names)}" if len(names) <= _FEW else ""
    return f"stored parameters in place of shipped or given ones: {len(names)} of {path}{which}" if names else ""


def differences_toml(parameters: Parameters, others: Parameters) -> str:
    """Returns as TOML those `parameters` whose value differs in `others`."""
    kept = {name.partition(".")[::2] for name in differing(parameters, others)}
    text = ""
    for group in dict.fromkeys(name.partition(".")[0] for name, _ in registry()):
        lines = to_toml(getattr(parameters, group)).splitlines()
        chosen = [line for line in lines if (group, line.partition(" =")[0]) in kept]
        text += "\n".join([f"[{group}]", *chosen, "", ""]) if chosen else ""
    return text
