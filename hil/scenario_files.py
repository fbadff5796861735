"""The scenario files that come with the package. Imports nothing slow: `modcube hil list` needs no more of the bench."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

_FOLDER = resources.files("hil") / "scenarios"


def scenario_names() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(f.name[:-5] for f in _FOLDER.iterdir() if f.name.endswith(".toml"))


def scenario_file(name: str) -> Path:
    """Path of the file of the scenario `name`, one of `scenario_names`."""
    return Path(str(_FOLDER / f"{name}.toml"))
