"""Inputs and outputs of the docking stage as values: bodies, the worker's answers, and the joins, parts and set-points of a tick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.docking_plan import DockPlan, UndockPlan
from firmware_py.core.setpoint import Wish
from firmware_py.core.types import DockRequest, Estimate, Setpoint

Estimated = Mapping[int, tuple[Body, Estimate]]
"""The bodies of a tick, each with its estimate, by number."""


class Prepared(NamedTuple):
    """The worker's answer to a request."""

    request: DockRequest
    plan: DockPlan | UndockPlan | None
    pipelines: tuple[Any, ...]
    """Pipelines of the resulting bodies, ready to take over."""
    refusal: str = ""
    """Why there is no plan."""


class Join(NamedTuple):
    """Two bodies become one in this tick."""

    target: int
    """Number of the target body; `active` likewise."""
    active: int
    pipeline: Any


class Part(NamedTuple):
    """One body becomes two in this tick. The body of `leaves` then glides away by `away_w` (3,), world, m; zero: it stays."""

    whole: int
    stays: Any
    leaves: Any
    away_w: np.ndarray


@dataclass(frozen=True, slots=True)
class Decisions:
    """Decisions of the docking stage for the pipeline to carry out; empty at first."""

    setpoints: dict[int, Setpoint | Wish] = field(default_factory=dict)
    """By body: what steers it in this tick."""
    joins: list[Join] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    ended: list[int] = field(default_factory=list)
    """Bodies whose dock ended without a join: they hold where they are."""
    meets: dict[int, np.ndarray] = field(default_factory=dict)
    """By body: (3,) displacement from where it holds to where it meets the other body, world, m."""
    returning: list[int] = field(default_factory=list)
    """Bodies that came to meet another whose dock was called off."""

    @property
    def joining(self) -> set[int]:
        """Bodies that take part in a join of this tick."""
        return {body for join in self.joins for body in (join.active, join.target)}


def fits(plan: DockPlan | UndockPlan, estimates: Estimated) -> bool:
    """Whether the bodies are still those that the plan was made for."""
    bodies = {frozenset(body.modules) for body, _ in estimates.values()}
    if isinstance(plan, UndockPlan):
        return frozenset((*plan.stays.modules, *plan.leaves.modules)) in bodies
    request, merged = plan.request, frozenset(plan.merged.modules)
    mine = {module: body for body in bodies for module in body}
    active, target = mine[request.module], mine[request.target_module]
    return active != target and active | target == merged


def body_of(module: int, estimates: Estimated) -> int:
    """Number of the body that contains a module."""
    return next(number for number, (body, _) in estimates.items() if module in body.modules)
