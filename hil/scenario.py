"""A scenario: tank, robot, world, task and checks, read from scenarios/NAME.toml. Controller code never reads it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.schema import DescriptionError, build, quantity, read_toml
from firmware_py.description.vehicle import load_vehicle
from hil.plant.spec import CALM, IDEAL, CameraPose, SensorSpec, Tank, WorldSpec
from hil.plant.world import Start, World


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModuleStart:
    """One module: what it is and where it is put into the water."""

    number: int = quantity(low=1, high=29, help="number on the bus")
    vehicle: str = quantity("modcube", help="vehicle name or file")
    position_m: np.ndarray = quantity(unit="m", low=-1000, high=1000, shape=(3,), help="hull centre, world")
    euler_deg: np.ndarray = quantity([0, 0, 0], unit="deg", low=-360, high=360, shape=(3,), help="roll, pitch, yaw")

    @property
    def start(self) -> Start:
        """Pose at time 0."""
        return Start(np.array(self.position_m), rotations.from_euler(*np.radians(self.euler_deg)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Task:
    """What the robot is to do."""

    kind: str = quantity(choices=("hover", "spiral"), help="hover: hold the place; spiral: climb on a cylinder")
    settle_s: float = quantity(15.0, unit="s", low=0, high=600, help="held at the start before the task begins")
    duration_s: float = quantity(unit="s", low=0.1, high=7200, help="of the task itself, rest to rest")
    radius_m: float = quantity(0.30, unit="m", low=0.01, high=100, help="spiral: radius")
    climb_m: float = quantity(0.40, unit="m", low=-100, high=100, help="spiral: height gained")
    turns: float = quantity(2.0, low=0.01, high=1000, help="spiral: turns, seen from above clockwise")
    centre_m: np.ndarray = quantity(
        [0, 0, 0], unit="m", low=-1000, high=1000, shape=(3,), help="hover: place; spiral: bottom of its axis"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """A metric that a run must keep within bounds."""

    metric: str = quantity(help="name of the metric in result.json")
    low: float = quantity(-1e9, help="smallest value that passes")
    high: float = quantity(1e9, help="largest value that passes")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenario:
    """One scenario."""

    name: str = quantity(help="as in the file's name")
    help: str = quantity(help="one line for `modcube hil list`")
    tank: Tank = quantity()
    module: tuple[ModuleStart, ...] = quantity()
    tags: tuple[int, ...] = quantity((5,), low=0, high=15, help="tags that the modules carry; 5 is the top face")
    camera: tuple[CameraPose, ...] = quantity(())
    task: Task = quantity()
    world: WorldSpec = quantity(WorldSpec())
    sensors: SensorSpec = quantity(SensorSpec())
    check: tuple[Check, ...] = quantity(())

    def __post_init__(self) -> None:
        if not self.module:
            raise DescriptionError("has no [[module]] table; a scenario needs at least one")

    @property
    def duration_s(self) -> float:
        """Length of the run."""
        return self.task.settle_s + self.task.duration_s

    @property
    def checks(self) -> tuple[Check, ...]:
        """What the run must keep."""
        return self.check

    def with_ideal_sensors(self) -> Scenario:
        """The same with perfect sensors; quantisation by the frames stays."""
        return dataclasses.replace(self, sensors=dataclasses.replace(self.sensors, **IDEAL))

    def with_vehicle(self, vehicle: str) -> Scenario:
        """The same with every module of the kind `vehicle`, a name or a file."""
        return dataclasses.replace(self, module=tuple(dataclasses.replace(m, vehicle=vehicle) for m in self.module))

    def with_calm_world(self) -> Scenario:
        """The same in still water, with a robot that is what its vehicle file says."""
        return dataclasses.replace(self, world=dataclasses.replace(self.world, **CALM))  # type: ignore[arg-type]


def make_world(scenario: Scenario, seed: int, period_ns: int) -> World:
    """The world of a scenario at time 0. Raises DescriptionError."""
    vehicles = [load_vehicle(m.vehicle) for m in scenario.module]
    return World(scenario.world, scenario.tank, vehicles, [m.start for m in scenario.module], seed, period_ns)


def scenario_names() -> list[str]:
    """Names of the scenarios that the package carries."""
    folder = resources.files("hil") / "scenarios"
    return sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".toml"))


def load_scenario(name: str) -> Scenario:
    """The scenario called `name`, or the file at the path `name`. Raises DescriptionError, one line."""
    if name.endswith(".toml"):
        path = Path(name)
    elif name in scenario_names():
        path = Path(str(resources.files("hil") / "scenarios" / f"{name}.toml"))
    else:
        raise DescriptionError(
            f"scenario {name!r} is unknown; there are {', '.join(scenario_names())}, or give a .toml file"
        )
    table, source = read_toml(path)
    scenario: Scenario = build(Scenario, table, source)
    return scenario
