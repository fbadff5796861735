"""Shared by the flight tests: scenarios of another length, and the types of the fixtures in conftest.py."""

import dataclasses
from collections.abc import Callable

from firmware_py.bus.codec import Frame
from firmware_py.description.vehicle import Vehicle
from hil.checks import Result
from hil.scenario import Scenario, load_scenario

Fly = Callable[..., Result]
"""fly(scenario, seed=0, parameters=None, folder="run")"""
Rebuild = Callable[[Callable[[Vehicle], Vehicle]], None]
Corrupt = Callable[[Callable[[Frame], Frame], bool], None]


def shortened(name: str, duration_s: float | None = None, settle_s: float | None = None) -> Scenario:
    """Scenario `name` with another duration of its task or of the time before it, s."""
    scenario = load_scenario(name)
    times = {"duration_s": duration_s, "settle_s": settle_s}
    task = dataclasses.replace(scenario.task, **{key: value for key, value in times.items() if value is not None})
    return dataclasses.replace(scenario, task=task)
