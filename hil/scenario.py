"""A scenario: tank, robot, world, task and checks, read from scenarios/NAME.toml. Controller code never reads it."""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_py.core import rotations
from firmware_py.description.builder import build
from firmware_py.description.fleet import check_cell, overlaps
from firmware_py.description.schema import (
    DescriptionError,
    Source,
    frozen_array,
    quantity,
    read_text,
    read_toml,
    unknown_name,
)
from firmware_py.description.vehicle_file import find_vehicles, load_vehicle
from hil.checks import UNBOUNDED
from hil.plant.dock_spec import DockSpec, JamRule
from hil.plant.draw import stream
from hil.plant.fault_spec import Fault
from hil.plant.lattice import is_connected
from hil.plant.polycube import grow
from hil.plant.spec import CALM, HALF_A_COUNT, IDEAL, CameraPose, SensorSpec, Tank, WorldSpec
from hil.plant.world import Start, World
from hil.scenario_files import scenario_file, scenario_names
from hil.scenario_keys import idle_keys
from hil.scenario_rules import mistakes
from hil.starts import places_of, refuse_in_walls, refuse_overlap, starts_of
from hil.task import Step, Task


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModuleStart:
    """One module: its vehicle and its initial pose."""

    number: int = quantity(low=1, high=29, help="number on the bus")
    vehicle: str = quantity("modcube", help="vehicle name, or vehicle file beside the scenario file")
    position_m: np.ndarray = quantity(
        [0, 0, 0], unit="m", low=-1000, high=1000, shape=(3,),
        help="world position of the hull centre of a lone module; of docked modules: centre of mass, given with the first",
    )  # fmt: skip
    euler_deg: np.ndarray = quantity(
        [0, 0, 0], unit="deg", low=-360, high=360, shape=(3,), help="roll, pitch, yaw of the body, given with its first module"
    )
    body: int = quantity(-1, low=-1, high=63, help="number shared by modules that start docked together; -1: alone")
    cell: np.ndarray = quantity([0, 0, 0], unit="lattice", low=-64, high=64, shape=(3,), help="lattice cell of the module in its body")
    rotation: int = quantity(0, low=0, high=23, help="index of the module's rotation in its body, one of the 24 rotations of the cube")

    clamped: bool = quantity(False, help="whether a load cell holds the module's body in place")

    def __post_init__(self) -> None:
        check_cell(self.cell)

    @property
    def start(self) -> Start:
        """Initial pose of a lone module, or of the body that the module leads."""
        return Start(np.array(self.position_m), rotations.from_euler(*np.radians(self.euler_deg)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RandomStart:
    """Random offset of every body's initial pose, drawn per seed, uniform within these bounds."""

    position_m: np.ndarray = quantity([0, 0, 0], unit="m", low=0, high=100, shape=(3,), help="largest random offset along each world axis")
    yaw_deg: float = quantity(0.0, unit="deg", low=0, high=180, help="largest random turn about the vertical")

    def shifted(self, start: Start, seed: int, leader: int) -> Start:
        """Returns the initial pose of the body led by the module with index `leader`, in the run `seed`."""
        drawn = stream(seed, "start", leader).uniform(-1.0, 1.0, 4)
        turn = rotations.from_euler(0.0, 0.0, math.radians(self.yaw_deg) * float(drawn[3]))
        return Start(start.p_wm + self.position_m * drawn[:3], rotations.multiply(turn, start.q_wm))


@dataclass(frozen=True, slots=True, kw_only=True)
class Polycube:
    """A random shape in place of the first module, drawn per seed."""

    fewest: int = quantity(2, low=1, high=29, help="smallest number of modules")
    most: int = quantity(8, low=1, high=29, help="largest number of modules")

    def __post_init__(self) -> None:
        if self.fewest > self.most:
            raise DescriptionError("fewest is above most", "fewest")


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """A metric that a run must keep within bounds."""

    metric: str = quantity(help="name of the metric in result.json")
    low: float = quantity(-UNBOUNDED, help="smallest value that passes")
    high: float = quantity(UNBOUNDED, help="largest value that passes")
    ideal: bool = quantity(True, help="whether the check also applies with ideal sensors, which beat the assumed noise of the estimator")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenario:
    """One scenario."""

    name: str = quantity(help="name of the scenario, same as that of its file")
    help: str = quantity(help="one-line description for `modcube hil list`")
    tank: Tank = quantity()
    module: tuple[ModuleStart, ...] = quantity()
    tags: tuple[int, ...] = quantity((5,), low=0, high=15, help="ids of the tags that modules carry; 5 is the top face")
    camera: tuple[CameraPose, ...] = quantity(())
    polycube: Polycube | None = quantity(None)
    start: RandomStart = quantity(RandomStart())
    estop_box: bool = quantity(False, help="whether an e-stop box sends its HEARTBEAT; false where a real one is on the same bus")
    dock: DockSpec = quantity(DockSpec())
    jam: JamRule = quantity(JamRule())
    step: tuple[Step, ...] = quantity(())
    fault: tuple[Fault, ...] = quantity(())
    task: Task = quantity()
    world: WorldSpec = quantity(WorldSpec())
    sensors: SensorSpec = quantity(SensorSpec())
    check: tuple[Check, ...] = quantity(())

    def __post_init__(self) -> None:
        if not self.module:
            raise DescriptionError("has no [[module]] table; a scenario needs at least one", "module")
        for members in self.groups:
            cells = [tuple(int(c) for c in self.module[m].cell) for m in members]
            numbers = [self.module[m].number for m in members]
            for i, what in overlaps(cells, numbers):
                raise DescriptionError(what, "module", members[i], "cell")
            if not is_connected(np.array(cells)):
                what = f"modules {', '.join(map(str, numbers))} share a body, but their cells are not connected; give cells side by side"
                raise DescriptionError(what, "module", members[0], "cell")

    @property
    def groups(self) -> list[tuple[int, ...]]:
        """Modules of each body at the start, by index, the leader first."""
        found: dict[tuple[str, int], list[int]] = {}
        for index, module in enumerate(self.module):
            key = ("body", module.body) if module.body >= 0 else ("alone", index)
            found.setdefault(key, []).append(index)
        return [tuple(members) for members in found.values()]

    def index_of(self, number: int) -> int:
        """Index of the module with that number. Raises DescriptionError."""
        for index, module in enumerate(self.module):
            if module.number == number:
                return index
        raise DescriptionError(f"no module has the number {number}")

    @property
    def duration_s(self) -> float:
        """Length of the run."""
        return self.task.settle_s + self.task.duration_s

    def for_seed(self, seed: int) -> Scenario:
        """Returns the scenario of one seed, with the modules of a polycube written out."""
        if self.polycube is None:
            return self
        rng, first = stream(seed, "shape"), self.module[0]
        count = int(rng.integers(self.polycube.fewest, self.polycube.most + 1))
        seats = grow(rng, count, load_vehicle(first.vehicle).faces)
        modules = tuple(
            dataclasses.replace(
                first, number=first.number + i, body=0, cell=frozen_array(seat.cell), rotation=seat.rotation
            )
            for i, seat in enumerate(seats)
        )
        return dataclasses.replace(self, module=modules, polycube=None)

    def with_ideal_sensors(self) -> Scenario:
        """Returns the scenario with perfect sensors.

        Quantisation by the frames remains, as does half a count of noise on IMU, depth and the tags' attitude. Checks that do not
        apply to ideal sensors (`Check.ideal`) are left out.
        """
        check = tuple(check for check in self.check if check.ideal)
        return dataclasses.replace(self, check=check, sensors=dataclasses.replace(self.sensors, **(IDEAL | HALF_A_COUNT)))  # type: ignore[arg-type]

    def with_vehicle(self, vehicle: str) -> Scenario:
        """Returns the scenario with `vehicle`, a name or a file, for every module."""
        return dataclasses.replace(self, module=tuple(dataclasses.replace(m, vehicle=vehicle) for m in self.module))

    def with_calm_world(self) -> Scenario:
        """Returns the scenario in still water, with a robot that matches its vehicle file."""
        return dataclasses.replace(self, world=dataclasses.replace(self.world, **CALM))  # type: ignore[arg-type]


def make_world(scenario: Scenario, seed: int, period_ns: int) -> World:
    """Creates the world of a scenario at time 0. Raises DescriptionError."""
    _refuse_unmet_faults(scenario, period_ns)
    vehicles = [load_vehicle(m.vehicle) for m in scenario.module]
    groups = scenario.groups
    bodies = [scenario.start.shifted(scenario.module[members[0]].start, seed, members[0]) for members in groups]
    starts = starts_of(scenario, vehicles, bodies)
    refuse_in_walls(scenario, vehicles, starts, seed)
    refuse_overlap(scenario, vehicles, starts, seed)
    spec = (scenario.world, scenario.tank, vehicles, starts, seed, period_ns)
    world = World(*spec, groups=groups, places=places_of(scenario), dock=scenario.dock, jam=scenario.jam)
    for body, members in enumerate(world.bodies):
        if any(scenario.module[m].clamped for m in members):
            world.clamp(body)
    return world


def _refuse_unmet_faults(scenario: Scenario, period_ns: int) -> None:
    """Raises DescriptionError when a fault ends before a tick meets it."""
    for i, fault in enumerate(scenario.fault):
        if not fault.meets_a_tick(period_ns):
            what = f"from {fault.at_s:g} to {fault.until_s:g} s is between two ticks, {1e-6 * period_ns:g} ms apart"
            raise DescriptionError(f"{scenario.name}: fault[{i}], {fault.kind}, {what}; it would never begin")


def load_scenario(name: str) -> Scenario:
    """Loads the scenario called `name`, or the .toml file at the path `name`. Raises DescriptionError with a one-line message."""
    if name.endswith(".toml"):
        path = Path(name)
    elif name in scenario_names():
        path = scenario_file(name)
    else:
        raise unknown_name("scenario", name, scenario_names())
    table, source = read_toml(path)
    scenario: Scenario = build(Scenario, table, source)
    scenario = dataclasses.replace(scenario, module=find_vehicles(scenario.module, source))
    if (mistake := next(itertools.chain(idle_keys(scenario, table), mistakes(scenario)), None)) is not None:
        raise source.error(*mistake)
    return _with_file_text(scenario, path.parent, source)


def _with_file_text(scenario: Scenario, folder: Path, source: Source) -> Scenario:
    """Returns the scenario with the text of the task's file read in. Raises DescriptionError."""
    if not scenario.task.file:
        return scenario
    path = folder / scenario.task.file
    try:
        text = read_text(path)
    except DescriptionError as error:
        raise source.error(("task", "file"), str(error)) from None
    return dataclasses.replace(scenario, task=dataclasses.replace(scenario.task, file=str(path), file_text=text))
