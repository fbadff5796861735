"""Flights to be planned, and the plans that come back. The planner (`firmware_py.app.mission_plan`) takes the jobs, a second each."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from firmware_py.core.setpoint import Trajectory
from firmware_py.core.types import Setpoint
from firmware_py.description.parameters import Parameters
from firmware_py.ground.mission_legs import Leg


class PlanJob(NamedTuple):
    """A flight to be planned."""

    body: int
    serial: int
    p_wb: np.ndarray
    q_wb: np.ndarray
    legs: tuple[Leg, ...]
    acceleration: float
    corridor_m: float


class Plan(NamedTuple):
    """A planned flight; `arrivals_s` are the times from its start at which the legs' places are to be reached."""

    serial: int
    trajectory: Trajectory | None
    arrivals_s: tuple[float, ...]
    reason: str = ""
    """Why there is no trajectory."""


class PlanJobs:
    """The jobs of one body, made from legs and the present parameters."""

    def __init__(self, parameters: Callable[[], Parameters]) -> None:
        self._parameters = parameters
        self.waiting: list[PlanJob] = []
        """Flights to be planned; the planner takes them."""
        self._so_far = 0
        self.speed_m_s: float | None = None
        """Speed of legs that have none of their own; None: the parameter's."""

    @property
    def cruise_m_s(self) -> float:
        """Speed of legs that have none of their own."""
        return self._parameters().ground.mission_speed_m_s if self.speed_m_s is None else self.speed_m_s

    def add(self, body: int, at: Setpoint, legs: Sequence[Leg]) -> int:
        """Adds the job to plan a flight of `body` along `legs` from the pose of `at`; returns its serial number."""
        self._so_far += 1
        ground = self._parameters().ground
        job = PlanJob(
            body, self._so_far, at.p_wb, at.q_wb, self._with_speeds(legs), ground.mission_acceleration, ground.mission_corridor_m
        )
        self.waiting.append(job)
        return job.serial

    def inputs(self, legs: Sequence[Leg]) -> tuple[Any, ...]:
        """All inputs of a plan along `legs` at present, except body and start pose: the same ones give the same plan."""
        ground = self._parameters().ground
        places = (None if leg.p_wb is None else tuple(leg.p_wb) for leg in legs)
        rest = (leg._replace(p_wb=None) for leg in self._with_speeds(legs))
        return ground.mission_acceleration, ground.mission_corridor_m, *places, *rest

    def _with_speeds(self, legs: Sequence[Leg]) -> tuple[Leg, ...]:
        cruise = self.cruise_m_s
        return tuple(leg._replace(speed_m_s=cruise) if math.isnan(leg.speed_m_s) else leg for leg in legs)
