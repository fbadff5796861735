"""Vehicle files: found by name or path, read, and checked beyond the range of each value."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from firmware_py.description.builder import build
from firmware_py.description.schema import (
    DescriptionError,
    Source,
    is_file_name,
    is_there,
    limits_of,
    parse_toml,
    read_text,
    repeated,
    unknown_name,
)
from firmware_py.description.vehicle import AXES, MOST_OVER_HULL, MOST_THRUSTERS, Drag, Vehicle, too_many_thrusters

_Module = TypeVar("_Module", bound=Any)

MOST_DAMPING_PER_S = 50.0
"""Largest linear damping over mass or inertia, 1/s: half of that at which the firmware's midpoint rule is unstable at 50 Hz."""
ON_FACE_M = 0.001
"""Distance from a face of the hull's box within which a tag lies on it."""
LOOKS_INTO = -0.5
"""Cosine, to the outward normal of the face that it lies on, below which a tag looks into the hull: by more than 30 deg. One that stands
upright on a face looks along it, to either side by the rounding of its quaternion."""


def vehicle_names() -> list[str]:
    """Names of the vehicle files in the package."""
    folder = resources.files("firmware_py") / "vehicles"
    return sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".toml"))


def load_vehicle(name: str, folder: Path | None = None) -> Vehicle:
    """Loads the vehicle called `name`, or the file at the path `name`, relative to `folder` if given, when it ends in `.toml`.

    Raises:
        DescriptionError: no such vehicle, or its file is invalid; one line.
    """
    if name.endswith(".toml"):
        path = Path(name) if folder is None else folder / name
    elif name in vehicle_names():
        path = Path(str(resources.files("firmware_py") / "vehicles" / f"{name}.toml"))
    else:
        raise unknown_name("vehicle", name, vehicle_names())
    source = Source(str(path), read_text(path))
    vehicle = _vehicle_of(source)
    if vehicle.hull.mesh:
        mesh = (path.parent / vehicle.hull.mesh).absolute()  # for logs, and for printing the vehicle as a file elsewhere
        if not is_there(mesh, Path.is_file):
            raise source.error(("hull", "mesh"), f"{mesh}: there is no such mesh")
        vehicle = dataclasses.replace(vehicle, hull=dataclasses.replace(vehicle.hull, mesh=str(mesh)))
    return vehicle


@functools.lru_cache(maxsize=64)
def _vehicle_of(source: Source) -> Vehicle:
    """The vehicle in the text of `source`, checked; remembered, because a scenario asks for each of its vehicles a dozen times."""
    vehicle: Vehicle = build(Vehicle, parse_toml(source.text, source.path), source)
    _check_body(vehicle, source)
    _check_drag(vehicle.drag, source)
    _check_damping(vehicle, source)
    return vehicle


def find_vehicles(modules: Sequence[_Module], source: Source) -> tuple[_Module, ...]:
    """The [[module]] tables of `source` with each `vehicle` resolved, as load_vehicle takes it without a folder.

    A vehicle file is looked up beside the file of `source`, then in the working directory.

    Raises:
        DescriptionError: a vehicle cannot be loaded; names its line.
    """
    names: list[str] = [module.vehicle for module in modules]
    found = {name: beside(Path(source.path).parent, name) for name in names}
    for name, path in found.items():
        try:
            load_vehicle(path)
        except DescriptionError as error:
            raise source.error(("module", names.index(name), "vehicle"), str(error)) from None
    return tuple(dataclasses.replace(module, vehicle=found[module.vehicle]) for module in modules)


def beside(folder: Path, name: str) -> str:
    """A vehicle's or scenario's `name`; that of a file is prefixed with `folder`, unless it exists in the working directory only."""
    path = folder / name
    return str(path) if name.endswith(".toml") and (is_there(path) or not is_there(Path(name))) else name


def _check_body(vehicle: Vehicle, source: Source) -> None:
    """Raises DescriptionError, which names the line, if the body is impossible, or its name cannot be a file name."""
    passive = vehicle.passive_dof
    if not is_file_name(vehicle.name):
        raise source.error(("name",), f"{vehicle.name!r} cannot be the name of a file; give one without separators")
    for i in repeated(passive):
        raise source.error(("passive_dof",), f"{passive[i]} is there twice; name each degree of freedom once")
    if len(passive) == len(limits_of(Vehicle, "passive_dof").choices):
        raise source.error(("passive_dof",), "all six are left to buoyancy; a vehicle steers one at least")
    if len(vehicle.thruster) > MOST_THRUSTERS:
        what = f"{len(vehicle.thruster)} thrusters; {too_many_thrusters()}"
        raise source.error(("thruster", MOST_THRUSTERS), what)
    tips = [name for name in passive if name in ("roll", "pitch")]
    if tips and vehicle.inertial.righting_arm_m <= 0.0:
        what = f"with {vehicle.inertial.righting_arm_m:g} m buoyancy does not right the vehicle, which leaves {' and '.join(tips)} to it"
        raise source.error(("inertial", "righting_arm_m"), f"{what} (passive_dof); it must be above 0")
    if not vehicle.hull.mesh:
        _check_box(vehicle, source)


def _check_box(vehicle: Vehicle, source: Source) -> None:
    """Raises DescriptionError, which names the line, if mass, centre of mass or a tag does not fit the hull, a box."""
    half, com, wet_kg = 0.5 * vehicle.hull.size_m, vehicle.inertial.com_m, vehicle.inertial.wet_kg
    box = f"the hull, a box of {' x '.join(f'{edge:g}' for edge in vehicle.hull.size_m)} m"
    if np.any(np.abs(com) > half):
        raise source.error(("inertial", "com_m"), f"{com.tolist()} m is outside {box} about [0, 0, 0]")
    if wet_kg > vehicle.most_wet_kg * (1.0 + 1e-9):  # identify.py writes the limit itself, as the sum of a dry and an entrained mass
        water_kg = vehicle.most_wet_kg / MOST_OVER_HULL
        what = f"{wet_kg:g} kg, entrained water included, cannot float: {box}, displaces {water_kg:.3g} kg of water"
        raise source.error(("inertial", "dry_kg"), f"{what}; hull.size_m is that of the box around all parts, foam and frame too")
    for i, tag in enumerate(vehicle.tag):
        on = np.abs(np.abs(tag.position_m) - half) < ON_FACE_M
        if on.any() and np.max((tag.outward * np.sign(tag.position_m))[on]) < LOOKS_INTO:
            what = "looks into the hull from the face that the tag lies on; its z must point into the hull, away from who sees it"
            raise source.error(("tag", i, "quaternion"), what)


def _check_drag(drag: Drag, source: Source) -> None:
    """Raises DescriptionError, which names the line, if the drag is physically impossible.

    The drag table's coefficient is linear in the cubic harmonic from cd_face to cd_corner, so checking those two covers all directions.
    """
    if drag.quadratic.size not in (0, 6):
        what = f"has {drag.quadratic.size} numbers; it needs six, {', '.join(AXES)}, or none: leave it out"
        raise source.error(("drag", "quadratic"), what)
    if not drag.quadratic.size and 0.0 < drag.cd_face >= 4.0 * drag.cd_edge:
        what = f"{drag.cd_edge:g} is too small for drag.cd_face, {drag.cd_face:g}: along a space diagonal the coefficient, "
        what += "(4 cd_edge - cd_face) / 3, would not be above 0"
        raise source.error(("drag", "cd_edge"), f"{what}; cd_edge must be above cd_face / 4, here {drag.cd_face / 4.0:g}")


def _check_damping(vehicle: Vehicle, source: Source) -> None:
    """Raises DescriptionError, which names the line, if linear damping would stop the vehicle within a tick or two."""
    inertial, damping = vehicle.inertial, vehicle.drag.linear
    rates_per_s = damping / (np.r_[np.full(3, inertial.wet_kg), np.diag(inertial.inertia)] + inertial.added)
    worst = int(np.argmax(rates_per_s))
    if rates_per_s[worst] > MOST_DAMPING_PER_S:
        most = damping[worst] * MOST_DAMPING_PER_S / rates_per_s[worst]
        what = f"{damping[worst]:g} in {AXES[worst]} stops this vehicle within {1e3 / rates_per_s[worst]:.3g} ms, too fast for the ticks"
        raise source.error(("drag", "linear"), f"{what}; with its mass and added mass at most {most:.3g}")
