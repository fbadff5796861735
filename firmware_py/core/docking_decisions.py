"""What docking is told and what it wants, as values: the worker's answers, and the joins, parts and set-points of a tick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.docking_sequence import DockPlan, UndockPlan
from firmware_py.core.setpoint import Wish
from firmware_py.core.types import DockRequest, Estimate, Setpoint

Estimated = Mapping[int, tuple[Body, Estimate]]
"""The bodies of a tick, each with its estimate, by their numbers."""


class Prepared(NamedTuple):
    """An answer of the worker."""

    request: DockRequest
    plan: DockPlan | UndockPlan | None
    chains: tuple[Any, ...]
    """The pipelines of the bodies that there will be, ready to take over."""
    refusal: str = ""
    """Why there is no plan."""


class Join(NamedTuple):
    """Two bodies become one, in this tick."""

    target: int
    """Numbers of the bodies."""
    active: int
    chain: Any


class Part(NamedTuple):
    """One body becomes two, in this tick; the leaving one then glides away along `away_w` (3,), m."""

    whole: int
    stays: Any
    leaves: Any
    away_w: np.ndarray


@dataclass(frozen=True, slots=True)
class Decisions:
    """What the stage wants of the pipeline; nothing at first."""

    setpoints: dict[int, Setpoint | Wish] = field(default_factory=dict)
    """By body: steers it in this tick."""
    joins: list[Join] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    ended: list[int] = field(default_factory=list)
    """Bodies whose dock is over without a join: they hold where they are."""
    meets: dict[int, np.ndarray] = field(default_factory=dict)
    """By body: (3,) how far it comes to meet the other, world, m, from where it holds."""
    returning: list[int] = field(default_factory=list)
    """Bodies that came to meet one whose dock is called off."""

    @property
    def joining(self) -> set[int]:
        """Bodies that take part in a join of this tick."""
        return {body for join in self.joins for body in (join.active, join.target)}
