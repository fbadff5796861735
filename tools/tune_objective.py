"""The objective that tune_gains minimises: the flights and their worlds, the parameters and their bounds, and the cost of each metric."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path

import numpy as np
from loop_response import BODIES, Scale, body_of, margins, measure

from firmware_py.description.builder import build
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError, did_you_mean, quantity, read_toml, repeated
from firmware_py.description.vehicle_file import beside
from hil.campaign import WALL_CLOCK
from hil.metrics import SHOWN
from hil.scenario import Scenario, load_scenario
from hil.scenario_rules import metric_names, mistakes

FAILED_COST = 1e6
"""Cost of a flight that could not be judged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSpec:
    """One flight of the objective."""

    scenario: str = quantity(help="scenario name or file")
    vehicle: str = quantity("", help="vehicle name or file, in place of the scenario's")
    settle_s: float = quantity(0.0, unit="s", low=0, high=60, help="time that the robot holds its start before the task; 0: the scenario's")
    duration_s: float = quantity(0.0, unit="s", low=0, high=600, help="duration of the task; 0: the scenario's")
    weight: float = quantity(1.0, low=0, high=1e3, help="weight of the flight's cost in the objective")

    def flown(self) -> Scenario:
        """The scenario with its changes applied. Raises DescriptionError."""
        scenario = load_scenario(self.scenario)
        times = {name: value for name in ("settle_s", "duration_s") if (value := getattr(self, name)) > 0.0}
        scenario = dataclasses.replace(scenario, task=dataclasses.replace(scenario.task, **times))
        scenario = scenario.with_vehicle(self.vehicle) if self.vehicle else scenario
        for keys, what in mistakes(scenario):
            raise DescriptionError(f"{self.scenario} as flown here: {'.'.join(map(str, keys))}: {what}")
        return scenario


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """One parameter to search, and its bounds."""

    parameter: str = quantity(help="parameter name, group.field")
    low: float = quantity(help="lower bound of the search")
    high: float = quantity(help="upper bound of the search")
    logarithmic: bool = quantity(False, help="whether the parameter is searched on a logarithmic scale")


@dataclass(frozen=True, slots=True, kw_only=True)
class Term:
    """Cost of a metric."""

    metric: str = quantity(help="name of the metric in result.json")
    per: float = quantity(low=1e-12, high=1e12, help="amount of the metric that costs `weight`")
    weight: float = quantity(1.0, low=0, high=1e3, help="cost of an amount `per` of the metric")


@dataclass(frozen=True, slots=True, kw_only=True)
class Stability:
    """Margins that the loops broken at the plant's input should keep in one world; a shortfall has a cost."""

    modules: int = quantity(1, low=1, high=4, help="number of modules of the body: 1, 2 or 4")
    mass: float = quantity(1.0, low=0.5, high=2, help="mass in this world, as a factor of the controller's model")
    inertia: float = quantity(1.0, low=0.5, high=2, help="inertia in this world, as a factor of the controller's model")
    lag: float = quantity(1.0, low=0.5, high=2, help="thruster lag in this world, as a factor of the controller's model")
    gain_db: float = quantity(unit="dB", low=0, high=60, help="wanted gain margin of every axis")
    phase_deg: float = quantity(unit="deg", low=0, high=180, help="wanted phase margin of every axis")
    per_db: float = quantity(low=1e-3, high=60, help="shortfall of the gain margin, dB, that costs 1")
    per_deg: float = quantity(low=1e-3, high=180, help="shortfall of the phase margin, degrees, that costs 1")

    def cost(self, gain_db: float, phase_deg: float) -> float:
        """Cost of the margins, given the least gain margin and the least phase margin of all axes."""
        return max(0.0, self.gain_db - gain_db) / self.per_db + max(0.0, self.phase_deg - phase_deg) / self.per_deg


@dataclass(frozen=True, slots=True, kw_only=True)
class Objective:
    """The objective to minimise."""

    help: str = quantity(help="one-line description")
    flight: tuple[FlightSpec, ...] = quantity(help="flights of each seed, the cheapest first, so that a bad trial ends early")
    search: tuple[Search, ...] = quantity(help="parameters to search")
    term: tuple[Term, ...] = quantity(help="metrics that have a cost")
    seeds: tuple[int, ...] = quantity(low=0, high=2**31, help="seeds of the worlds used by the search")
    unseen_seeds: tuple[int, ...] = quantity(low=0, high=2**31, help="seeds of the worlds used for the comparison only")
    worst_share: float = quantity(0.0, low=0, high=1, help="weight of the worst flight in the objective, 0 to 1; the rest is the mean")
    stability: tuple[Stability, ...] = quantity((), help="gain and phase margins to keep")

    def __post_init__(self) -> None:
        for name in ("flight", "search", "term", "seeds", "unseen_seeds"):
            if not getattr(self, name):
                raise DescriptionError(f"{name} is empty; an objective needs one at least", name)
        if "\n" in self.help:
            raise DescriptionError("help has more than one line", "help")
        for i in repeated([search.parameter for search in self.search]):
            raise DescriptionError(f"parameter {self.search[i].parameter} is searched twice", "search", i, "parameter")
        for i, term in enumerate(self.term):
            if term.metric not in SHOWN:
                known = did_you_mean(term.metric, SHOWN).rstrip() or f"there are {', '.join(SHOWN)}"
                raise DescriptionError(f"metric '{term.metric}' is unknown; {known}", "term", i, "metric")
        if set(self.seeds) & set(self.unseen_seeds):
            raise DescriptionError("a seed is both in seeds and in unseen_seeds; the comparison needs worlds of its own", "unseen_seeds")
        for i, search in enumerate(self.search):
            if not search.low < search.high:
                what = f"parameter {search.parameter}: low {search.low:g} is not below high {search.high:g}"
                raise DescriptionError(what, "search", i, "low")
            for bound in (search.low, search.high):
                try:
                    Parameters().replace(search.parameter, bound)
                except DescriptionError as error:
                    raise DescriptionError(str(error), "search", i, "parameter") from None
        for i, wanted in enumerate(self.stability):
            if wanted.modules not in BODIES:
                what = f"stability of {wanted.modules} modules; there are bodies of {', '.join(map(str, BODIES))}"
                raise DescriptionError(what, "stability", i, "modules")

    def cost(self, spec: FlightSpec, metrics: Mapping[str, float | None]) -> float:
        """Cost of one flight. A missing metric costs FAILED_COST."""
        values = [metrics.get(term.metric) for term in self.term]
        costs = [term.weight * value / term.per for term, value in zip(self.term, values, strict=True) if value is not None]
        total = spec.weight * math.fsum(costs)
        return min(total, FAILED_COST) if len(costs) == len(self.term) and math.isfinite(total) else FAILED_COST

    def total(self, costs: Sequence[float]) -> float:
        """The objective from the costs of all flights: their mean, and `worst_share` of the worst one."""
        return (1.0 - self.worst_share) * float(np.mean(costs)) + self.worst_share * max(costs)

    @property
    def vehicle(self) -> str:
        """The vehicle whose margins are measured and drawn: that of the first flight."""
        return self.flight[0].flown().module[0].vehicle

    def shortfall(self, parameters: Parameters) -> float:
        """Cost of missing margins, added to that of the flights."""
        costs = []
        for wanted in self.stability:
            responses = measure(wanted.modules, parameters, Scale(wanted.mass, wanted.inertia, wanted.lag), self.vehicle)
            gains, phases, _ = zip(*map(margins, responses), strict=True)
            costs.append(wanted.cost(min(gains), min(phases)))
        return math.fsum(costs)

    def start(self, parameters: Parameters) -> dict[str, float]:
        """Start of the search: the values in `parameters`, clamped to the bounds."""
        return {s.parameter: min(max(float(attrgetter(s.parameter)(parameters)), s.low), s.high) for s in self.search}


def with_values(parameters: Parameters, values: Mapping[str, float]) -> Parameters:
    """A copy with these values of `group.field`. Raises DescriptionError."""
    for dotted, value in values.items():
        parameters = parameters.replace(dotted, value)
    return parameters


def detuned(objective: Objective, parameters: Parameters, factor: float, seed: int) -> Parameters:
    """A copy in which every searched parameter is off by a random factor, log-uniform from 1/factor to factor, clamped to its bounds."""
    factors = factor ** np.random.default_rng(seed).uniform(-1.0, 1.0, len(objective.search))
    off = [(s, attrgetter(s.parameter)(parameters) * float(f)) for s, f in zip(objective.search, factors, strict=True)]
    return with_values(parameters, {s.parameter: min(max(value, s.low), s.high) for s, value in off})


def check_terms(spec: FlightSpec, terms: Sequence[Term]) -> None:
    """Raises DescriptionError for a flight that cannot be flown or lacks the metric of a term, so that all trials had the top cost."""
    had = set(metric_names(spec.flown())) - set(WALL_CLOCK)
    if lacking := next((term.metric for term in terms if term.metric not in had), ""):
        raise DescriptionError(f"a trial of {spec.scenario} has no {lacking}, which a term asks of every flight")


def load_objective(path: Path) -> Objective:
    """Loads the objective from a file and checks its scenarios; their files and those of vehicles are looked up beside it, then in the
    working directory. Raises DescriptionError, one line.
    """
    table, source = read_toml(path)
    objective: Objective = build(Objective, table, source)
    files = [{name: beside(path.parent, getattr(spec, name)) for name in ("scenario", "vehicle")} for spec in objective.flight]
    flights = tuple(dataclasses.replace(spec, **names) for spec, names in zip(objective.flight, files, strict=True))
    objective = dataclasses.replace(objective, flight=flights)
    checks = [("flight", i, partial(check_terms, spec, objective.term)) for i, spec in enumerate(objective.flight)]
    checks += [("stability", i, partial(body_of, each.modules, objective.vehicle)) for i, each in enumerate(objective.stability)]
    for table_name, i, check in checks:
        try:
            check()
        except DescriptionError as error:
            raise source.error([table_name, i], str(error)) from None
    return objective
