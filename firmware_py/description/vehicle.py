"""One module (or any other thruster vehicle) as a frozen description, read from `vehicles/NAME.toml`.

Positions and directions are in the module frame: FRD, origin at the hull's centre, metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from firmware_py.description.schema import (
    DescriptionError,
    frozen_array,
    quantity,
    refuse_other_length,
    repeated,
)
from firmware_py.description.water import WATER_DENSITY

FACE_NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")
"""Faces A..F of the bus, in order; the index is also the id of a tag on that face."""
FACE_KINDS = {"P": "a probe", "D": "a drogue", "-": "no docking face"}
"""Letters of `Vehicle.faces`, in words."""

AXES = ("surge", "sway", "heave", "roll", "pitch", "yaw")
"""Degrees of freedom, in the order of a wrench and of every array of six here."""

MOST_OVER_HULL = 1.1
"""Largest mass, entrained water included, over that of the water in the hull's box: sea water, and parts that stick out of the box."""
MOST_THRUSTERS = 8
"""Thrusters of one module for which its CAN frames have commands."""

FACE_NORMALS = frozen_array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
"""(6, 3) outward normals of the faces, module frame."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hull:
    """The outer shape."""

    size_m: np.ndarray = quantity(unit="m", low=0.01, high=10.0, shape=(3,), help="edges of the box along x, y, z")
    mesh: str = quantity("", help="file of a closed mesh (module frame, m) beside the vehicle file, used in place of the box")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Inertial:
    """Mass properties. A free-flooding module moves entrained and added water besides its own mass."""

    dry_kg: float = quantity(unit="kg", low=0.01, high=5000.0, help="mass in air")
    entrained_kg: float = quantity(0.0, unit="kg", low=0.0, high=5000.0, help="mass of the water that moves with the hull")
    com_m: np.ndarray = quantity([0, 0, 0], unit="m", low=-5, high=5, shape=(3,), help="centre of mass, entrained water included")
    inertia: np.ndarray = quantity(
        unit="kg m^2", low=-1e4, high=1e4, shape=(3, 3), help="inertia tensor about the centre of mass, entrained water included"
    )
    added: np.ndarray = quantity(
        [0, 0, 0, 0, 0, 0], unit="kg, kg m^2", low=0, high=1e4, shape=(6,), help=f"diagonal added mass and inertia: {', '.join(AXES)}"
    )
    righting_arm_m: float = quantity(
        0.0, unit="m", low=-0.5, high=0.5,
        help="height of the centre of buoyancy above the centre of mass, entrained water included in both"
    )

    @property
    def wet_kg(self) -> float:
        """Mass with the entrained water, kg."""
        return self.dry_kg + self.entrained_kg

    def __post_init__(self) -> None:
        least, middle, most = np.linalg.eigvalsh(self.inertia)
        if not np.array_equal(self.inertia, self.inertia.T) or least <= 0.0 or most > (least + middle) * (1.0 + 1e-9):
            raise DescriptionError(
                f"inertia {self.inertia.tolist()} is not physical: "
                "it must be symmetric and positive, no principal moment above the sum of the others",
                "inertia",
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Payload:
    """A tool or cargo carried by the module: a solid box, trimmed to be neutrally buoyant with no righting moment."""

    name: str = quantity(help="name for display")
    dry_kg: float = quantity(unit="kg", low=0.0, high=1000.0, help="mass in air, trim included")
    entrained_kg: float = quantity(0.0, unit="kg", low=0.0, high=1000.0, help="mass of the water that moves with the payload")
    size_m: np.ndarray = quantity(unit="m", low=0.001, high=10.0, shape=(3,), help="edges of the payload's box along x, y, z")
    position_m: np.ndarray = quantity(unit="m", low=-10, high=10, shape=(3,), help="centre of the payload's box and of its mass")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drag:
    """Coefficients of the drag table: F = -1/2 rho Cd(d) A(d) |v| v."""

    cd_face: float = quantity(unit="", low=0.0, high=5.0, help="drag coefficient for flow normal to a face")
    cd_edge: float = quantity(unit="", low=0.0, high=5.0, help="drag coefficient for flow onto an edge")
    rotational_cd: float = quantity(1.1, low=0.0, high=10.0, help="coefficient of the rotational damping integral")
    linear: np.ndarray = quantity(
        [0, 0, 0, 0, 0, 0], unit="N s/m, N m s", low=0, high=1e4, shape=(6,), help=f"linear damping, diagonal: {', '.join(AXES)}"
    )
    quadratic: np.ndarray = quantity(
        [],
        unit="N s^2/m^2, N m s^2",
        low=0,
        high=1e5,
        shape=(-1,),
        help=f"published quadratic damping, used in place of projected areas: {', '.join(AXES)}",
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ThrusterCurve:
    """Force and power of one thruster at `voltage_v`, as the paper's fifth-order polynomials, one per direction.

    force(u) = sum forward[i] u^(i+1) for u > 0, reverse likewise in |u|; power(f) = sum power_w[i] |f|^(i+1).
    """

    voltage_v: float = quantity(unit="V", low=1.0, high=100.0, help="supply voltage at which the curve was measured")
    forward: np.ndarray = quantity(unit="N", low=-1e4, high=1e4, shape=(5,), help="polynomial coefficients of force over command, 0 to 1")
    reverse: np.ndarray = quantity(
        unit="N", low=-1e4, high=1e4, shape=(5,), help="polynomial coefficients of the magnitude of force over command, 0 to -1"
    )
    power_forward: np.ndarray = quantity(
        unit="W", low=-1e6, high=1e6, shape=(5,), help="polynomial coefficients of power over forward force"
    )
    power_reverse: np.ndarray = quantity(
        unit="W", low=-1e6, high=1e6, shape=(5,), help="polynomial coefficients of power over the magnitude of reverse force"
    )
    deadband_n: float = quantity(0.0, unit="N", low=0.0, high=10.0, help="deadband: a smaller demanded force gives none")
    lag_s: float = quantity(unit="s", low=0.0, high=2.0, help="time constant of the first-order lag of the force")
    rpm_at_full: float = quantity(3000.0, unit="1/min", low=1.0, high=1e5, help="propeller speed at command 1")

    def __post_init__(self) -> None:
        for name in ("forward", "reverse"):
            if not _rises(getattr(self, name), 1.0):
                what = f"{name} {getattr(self, name).tolist()} falls somewhere in 0..1; force must rise with the command"
                raise DescriptionError(what, name)


def _rises(coefficients: np.ndarray, end: float) -> bool:
    """Whether c[0] x + ... + c[4] x^5 rises throughout 0..end."""
    x = np.linspace(0.0, end, 401)
    return bool(np.all(np.diff(x[:, None] ** np.arange(1, coefficients.size + 1) @ coefficients) > 0.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Thruster:
    """Position of a thruster, and the direction in which it pushes the vehicle at a positive command."""

    position_m: np.ndarray = quantity(unit="m", low=-10, high=10, shape=(3,), help="centre of the propeller")
    direction: np.ndarray = quantity(
        low=-1.001, high=1.001, shape=(3,), help="unit vector of the force on the vehicle at a positive command"
    )

    def __post_init__(self) -> None:
        refuse_other_length("direction", self.direction)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tag:
    """A fiducial tag. Its frame: z into the face (away from the camera), x and y in the face."""

    id: int = quantity(low=0, high=15, help="number in the TAG frames; for a tag on a face, the number of the face")
    position_m: np.ndarray = quantity(unit="m", low=-10, high=10, shape=(3,), help="centre of the tag")
    quaternion: np.ndarray = quantity(low=-1, high=1, shape=(4,), help="attitude quaternion, scalar first, tag frame to module frame")

    def __post_init__(self) -> None:
        refuse_other_length("quaternion", self.quaternion, 1e-3)

    @property
    def outward(self) -> np.ndarray:
        """(3,) unit vector towards who sees the tag, opposite to its z, module frame."""
        w, x, y, z = self.quaternion
        return np.array([-2.0 * (x * z + w * y), -2.0 * (y * z - w * x), 2.0 * (x * x + y * y) - 1.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Supply:
    """Battery or tether."""

    voltage_v: float = quantity(12.0, unit="V", low=1.0, high=400.0, help="nominal voltage")
    current_a: float = quantity(10.0, unit="A", low=0.1, high=1000.0, help="largest current of the supply")
    idle_w: float = quantity(8.0, unit="W", low=0.0, high=1000.0, help="power drawn by the electronics")
    magnet_w: float = quantity(
        6.0, unit="W", low=0.0, high=500.0,
        help="power drawn by one energised docking magnet; simulated only, the controller goes by LIM_MAG_W",
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vehicle:
    """One module: everything that the controller assumes about it."""

    name: str = quantity(help="short name")
    source: str = quantity(help="source of the figures")
    hull: Hull = quantity()
    inertial: Inertial = quantity()
    drag: Drag = quantity()
    curve: ThrusterCurve = quantity()
    thruster: tuple[Thruster, ...] = quantity()
    tag: tuple[Tag, ...] = quantity(())
    supply: Supply = quantity(Supply())
    payload: tuple[Payload, ...] = quantity(())
    assumption: str = quantity("", help="what was assumed, not measured; shown wherever the vehicle is shown")
    faces: str = quantity("PDPDPD", help="type of each face, A to F; P: probe, D: drogue, -: none")
    force_max_n: float = quantity(unit="N", low=0.1, high=1e4, help="forward force limit of each thruster")
    force_min_n: float = quantity(unit="N", low=-1e4, high=-0.1, help="reverse force limit of each thruster")
    passive_dof: tuple[str, ...] = quantity((), choices=AXES, help="degrees of freedom that are left to buoyancy, not controlled")
    depth_rating_m: float = quantity(50.0, unit="m", low=0.1, high=11000, help="largest permitted depth")

    def __post_init__(self) -> None:
        if not self.thruster:
            raise DescriptionError("has no [[thruster]] table; a vehicle needs at least one", "thruster")
        if len(self.faces) != 6 or set(self.faces) - set("PD-"):
            raise DescriptionError(f"faces {self.faces!r} needs six letters out of P, D and -", "faces")
        for i in repeated([tag.id for tag in self.tag]):
            raise DescriptionError("two [[tag]] tables have the same id", "tag", i, "id")
        sides = (("forward", "force_max_n", self.force_max_n), ("reverse", "force_min_n", -self.force_min_n))
        for name, limit, full in sides:
            side = getattr(self.curve, name)
            if full > float(np.sum(side)) * (1.0 + 1e-9):
                what = f"the {name} limit of {full:g} N is above the {np.sum(side):g} N of curve.{name} at full command"
                raise DescriptionError(what, limit)
            if not _rises(getattr(self.curve, f"power_{name}"), full):
                what = f"curve.power_{name} falls somewhere in 0..{full:g} N; power must rise with the force"
                raise DescriptionError(what, "curve", f"power_{name}")

    @property
    def positions(self) -> np.ndarray:
        """(n, 3) thruster positions, module frame, m."""
        return np.array([t.position_m for t in self.thruster])

    @property
    def directions(self) -> np.ndarray:
        """(n, 3) unit directions of positive thrust, module frame."""
        return np.array([t.direction / np.linalg.norm(t.direction) for t in self.thruster])

    @property
    def most_wet_kg(self) -> float:
        """Largest mass, kg, entrained water included, that the water in the hull's box can carry; infinite for a mesh."""
        return math.inf if self.hull.mesh else MOST_OVER_HULL * WATER_DENSITY * float(np.prod(self.hull.size_m))

    @property
    def docking_edges_m(self) -> set[float]:
        """Edges of the hull, m, along the axes on which it has docking faces."""
        return {float(edge) for axis, edge in enumerate(self.hull.size_m) if set(self.faces[2 * axis : 2 * axis + 2]) & set("PD")}

    @property
    def cd_corner(self) -> float:
        """Drag coefficient along a space diagonal, from the face and edge values (quartic cubic harmonic)."""
        return (4.0 * self.drag.cd_edge - self.drag.cd_face) / 3.0


def face_mismatch(faces: str, face: int, target_faces: str, target_face: int) -> str:
    """Why a face of one vehicle cannot dock to a face of another, in words; empty where it can. Takes each vehicle's `faces`."""
    kinds = faces[face], target_faces[target_face]
    if set(kinds) == {"P", "D"}:
        return ""
    return f"{FACE_NAMES[face]} is {FACE_KINDS[kinds[0]]} and {FACE_NAMES[target_face]} {FACE_KINDS[kinds[1]]}; a probe docks to a drogue"


def too_many_thrusters() -> str:
    """What is wrong with a vehicle of more than MOST_THRUSTERS thrusters, and the remedy."""
    return f"a module's frames carry {MOST_THRUSTERS}: leave some out, or divide the vehicle into docked modules"
