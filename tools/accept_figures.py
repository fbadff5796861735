"""Data types of `make accept`: a figure with its limits, and a group of figures that come from one measurement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from accept_measures import Values

from hil.checks import UNBOUNDED


@dataclass(frozen=True)
class Figure:
    """One number that must lie within low..high, both in `unit`, after the measured value is multiplied by `scale`."""

    name: str
    key: str
    low: float = -UNBOUNDED
    high: float = UNBOUNDED
    unit: str = ""
    scale: float = 1.0


@dataclass(frozen=True)
class Group:
    """Figures that come from one measurement."""

    name: str
    issue: int
    command: str
    measure: Callable[[Path], Values]
    figures: tuple[Figure, ...]


def reported_by_test(name: str, low: float = -UNBOUNDED, high: float = UNBOUNDED, unit: str = "") -> Figure:
    """A figure that a test reports by name."""
    return Figure(name, name, low, high, unit)
