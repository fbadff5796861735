"""What `make accept` holds against what is measured: a figure with its limits, and the group that one measurement gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from accept_measures import Values

from hil.checks import UNBOUNDED


@dataclass(frozen=True)
class Figure:
    """One number that must be within low..high, both in `unit`, after `scale` was applied to what was measured."""

    name: str
    key: str
    low: float = -UNBOUNDED
    high: float = UNBOUNDED
    unit: str = ""
    scale: float = 1.0


@dataclass(frozen=True)
class Group:
    """Figures that one measurement gives."""

    name: str
    issue: int
    command: str
    measure: Callable[[Path], Values]
    figures: tuple[Figure, ...]


def said(name: str, low: float = -UNBOUNDED, high: float = UNBOUNDED, unit: str = "") -> Figure:
    """A figure that a test says by name."""
    return Figure(name, name, low, high, unit)
