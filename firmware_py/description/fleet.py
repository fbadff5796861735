"""The fleet: the modules that one firmware process controls, their buses, and how they are docked at the start."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_py.description.builder import build
from firmware_py.description.schema import DescriptionError, frozen_array, quantity, read_toml, repeated
from firmware_py.description.vehicle_file import find_vehicles


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Module:
    """One module: its number on its bus, and its place in its body at the start."""

    number: int = quantity(low=1, high=29, help="number on the bus")
    bus: int = quantity(0, low=0, high=15, help="index of the module's bus in `buses`")
    vehicle: str = quantity("modcube", help="vehicle name, or vehicle file beside the fleet file")
    body: int = quantity(-1, low=-1, high=63, help="number shared by modules that start docked together; -1: alone")
    cell: np.ndarray = quantity([0, 0, 0], unit="lattice", low=-64, high=64, shape=(3,), help="lattice cell of the module in its body")
    rotation: int = quantity(
        0, low=0, high=23, help="index of the module's rotation, one of the 24 rotations of the cube (prepare.lattice)"
    )

    def __post_init__(self) -> None:
        check_cell(self.cell)


def check_cell(cell: np.ndarray) -> None:
    """Raises DescriptionError if a cell (3,) is not made of whole numbers."""
    if not np.array_equal(cell, np.round(cell)):
        raise DescriptionError(f"cell {cell.tolist()} is between places of the lattice; it needs whole numbers", "cell")


def overlaps(cells: Sequence[tuple[int, ...]], modules: Sequence[object]) -> Iterator[tuple[int, str]]:
    """Index of each cell that an earlier module occupies already, with the error text; `modules`: names of the modules in that text."""
    return ((i, f"modules {modules[cells.index(cells[i])]} and {modules[i]} overlap in cell {cells[i]}") for i in repeated(cells))


def module_number(module: int) -> int:
    """Returns the number by which people call the module with this fleet index."""
    return module + 1


def module_index(number: int) -> int:
    """Returns the fleet index of the module that people call by this number."""
    return number - 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fleet:
    """All modules of one process, in fleet index order."""

    module: tuple[Module, ...] = quantity()
    buses: tuple[str, ...] = quantity(("virtual:modcube",), help="CAN buses, in index order")
    rate_hz: int = quantity(100, unit="Hz", low=50, high=400, help="tick rate")
    pitch_m: float = quantity(0.21, unit="m", low=0.01, high=2.0, help="lattice pitch: distance between the centres of docked modules")
    latitude_deg: float = quantity(30.2084, unit="deg", low=-90, high=90, help="geodetic latitude of the tank's origin")
    longitude_deg: float = quantity(120.1614, unit="deg", low=-180, high=180, help="geodetic longitude of the tank's origin")
    altitude_m: float = quantity(0.0, unit="m", low=-500, high=9000, help="altitude of the tank's origin")

    def __post_init__(self) -> None:
        if not self.module:
            raise DescriptionError("has no [[module]] table; a fleet needs at least one", "module")
        for i in repeated(self.buses):
            what = f"buses has {self.buses[i]} twice; each bus stands there once, and modules share it by its index"
            raise DescriptionError(what, "buses")
        for i, module in enumerate(self.module):
            if module.bus >= len(self.buses):
                what = f"module number {module.number} is on bus {module.bus}; `buses` has {len(self.buses)}, from 0 on"
                raise DescriptionError(what, "module", i, "bus")
        for i in repeated([(m.bus, m.number) for m in self.module]):
            what = f"two modules have the number {self.module[i].number} on {self.buses[self.module[i].bus]}"
            raise DescriptionError(f"{what}; each needs one of its own there", "module", i, "number")

    @property
    def period_ns(self) -> int:
        """Length of a tick, ns."""
        return 1_000_000_000 // self.rate_hz

    def label(self, index: int) -> str:
        """Number of a module in the fleet, with that on its bus where it is another or there are several buses: "1 (number 7)"."""
        module, number = self.module[index], module_number(index)
        if len(self.buses) > 1:
            return f"{number} (number {module.number} on {self.buses[module.bus]})"
        return f"{number}" if module.number == number else f"{number} (number {module.number})"


def load_fleet(path: Path) -> Fleet:
    """Loads the fleet in `path`, which must name its buses. Raises DescriptionError, one line."""
    table, source = read_toml(path)
    if "buses" not in table:
        raise source.error(("buses",), 'missing key; it needs the bus of each index, such as ["socketcan:can0"]')
    fleet: Fleet = build(Fleet, table, source)
    for i, module in enumerate(fleet.module):
        if module.body < 0 and module.cell.any():  # with its body forgotten, a docked module would be flown as one alone
            what = f"module number {module.number} starts alone, in no lattice; give body, or leave cell out"
            raise DescriptionError(f"{path}:{source.line_of(('module', i, 'cell'))}: {what}")
    return dataclasses.replace(fleet, module=find_vehicles(fleet.module, source))


def single(vehicle: str = "modcube", bus: str = "virtual:modcube", rate_hz: int = 100) -> Fleet:
    """A fleet of one module, number 1."""
    return Fleet(
        module=(Module(number=1, vehicle=vehicle, cell=frozen_array([0, 0, 0])),), buses=(bus,), rate_hz=rate_hz
    )
