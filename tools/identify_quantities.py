"""For tools/identify.py: the result of a fit as numbers for people: absolute ones where a reference allows them, ratios otherwise."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from identify_fit import Fit

from firmware_py.description.schema import frozen_array
from firmware_py.description.vehicle import ThrusterCurve, Vehicle
from firmware_py.description.water import GRAVITY
from firmware_py.prepare.assembly import assemble_vehicle

AXES = "xyz"
SIDES = ("face-on", "edge-on")
GOOD = 0.10
"""Half-width of an interval, as a share of the value, above which the motion was not excited enough."""
NO_SCALE = (
    "no absolute reference: masses, drag and thrust have one factor in common that no motion shows, so only ratios are given and no mass "
    "is stated; give --curve (tools/fit_thruster.py) or --weight"
)


class Quantity(NamedTuple):
    """One function of the unknowns x; `motion` (of identify_excitation) makes it observable, empty where no motion is asked for."""

    name: str
    unit: str
    function: Callable[[np.ndarray], float]
    motion: str = ""
    of: Callable[[np.ndarray], float] | None = None
    """Value to which its interval is compared; None: the quantity itself."""


class Finding(NamedTuple):
    """A quantity with its 95 % interval."""

    name: str
    unit: str
    value: float
    half_width: float
    share: float
    """Half-width as a share of the value."""
    motion: str


def absolute(fit: Fit, vehicle: Vehicle) -> list[Quantity]:
    """Quantities that need a known scale."""
    at = fit.slices
    mass, inertia, drag, arm = (at[name].start for name in ("mass", "inertia", "drag", "arm"))
    rotational = assemble_vehicle(vehicle).drag.rotational
    found = [Quantity(f"total mass along {a}", "kg", _exponential(mass + i), f"along {a}") for i, a in enumerate(AXES)]
    found += [Quantity(f"total inertia about {a}", "kg m^2", _exponential(inertia + i), "turning") for i, a in enumerate(AXES)]
    found += [Quantity(f"drag coefficient, {side}", "", _number(drag + i), f"fast {side}") for i, side in enumerate(SIDES)]
    if rotational.all():
        cd = vehicle.drag.rotational_cd
        found.append(Quantity("rotational_cd", "", lambda x: cd * float(np.mean(x[at["rotational"]] / rotational))))
    found += [Quantity(f"righting moment, {a}", "N m", _number(arm + i), "turning", _length(at["arm"])) for i, a in enumerate(AXES)]
    found.append(Quantity("weight less buoyancy", "N", _number(at["weight"].start)))
    found.append(Quantity("deadband, mean", "N", lambda x: float(np.mean(x[at["deadband"]]))))
    gains = range(at["gain"].start, at["gain"].stop)
    return found + [Quantity(f"gain of thruster {k + 1}", "", _number(i), "turning") for k, i in enumerate(gains)]


def ratios(fit: Fit) -> list[Quantity]:
    """Quantities that every log gives: the common factor cancels."""
    at = fit.slices
    mass, gains = at["mass"].start, at["gain"]

    def per_mass(name: str, i: int) -> Callable[[np.ndarray], float]:
        return lambda x: float(x[at[name]][i] / np.exp(x[mass]))

    def exponential_per_mass(name: str, i: int) -> Callable[[np.ndarray], float]:
        return lambda x: float(np.exp(x[at[name]][i] - x[mass]))

    found = [
        Quantity(f"total mass along {AXES[i]} over that along x", "", exponential_per_mass("mass", i), f"along {AXES[i]}") for i in (1, 2)
    ]
    found += [
        Quantity(f"total inertia about {a} over total mass along x", "m^2", exponential_per_mass("inertia", i), "turning")
        for i, a in enumerate(AXES)
    ]
    found += [
        Quantity(f"drag coefficient, {side}, over total mass along x", "1/kg", per_mass("drag", i), f"fast {side}")
        for i, side in enumerate(SIDES)
    ]
    found += [
        Quantity(f"righting moment, {a}, over total mass along x", "m^2/s^2", per_mass("arm", i), "turning",
                 lambda x: _length(at["arm"])(x) / float(np.exp(x[mass])))
        for i, a in enumerate(AXES)
    ]  # fmt: skip
    found += [
        Quantity(f"gain of thruster {k + 1} over the mean", "", lambda x, k=k: float(x[gains][k] / np.mean(x[gains])), "turning")
        for k in range(gains.stop - gains.start)
    ]
    found.append(Quantity("force in reverse over that forwards, against the curve's", "", lambda x: 1.0 + float(x[at["shape"]][0])))
    return [*found, Quantity("thruster lag", "s", _number(at["lag"].start), "along x")]


def findings(fit: Fit, vehicle: Vehicle) -> list[Finding]:
    """All findings of a fit: absolute quantities where the scale is known, and ratios."""
    quantities = (absolute(fit, vehicle) if fit.has_scale else []) + ratios(fit)
    found = []
    for quantity in quantities:
        value, half_width = fit.interval(quantity.function)
        share = half_width / max(abs(quantity.of(fit.x) if quantity.of else value), 1e-12)
        found.append(Finding(quantity.name, quantity.unit, value, half_width, share, quantity.motion))
    return found


def missing(found: list[Finding]) -> dict[str, list[str]]:
    """Motions that were missing or too small, and the quantities that need them."""
    wanted: dict[str, list[str]] = {}
    for each in found:
        if each.motion and each.share > GOOD:
            wanted.setdefault(each.motion, []).append(f"{each.name} (+-{min(each.share, 9.99):.0%})")
    return wanted


def fitted_vehicle(fit: Fit, vehicle: Vehicle, curve: ThrusterCurve, logs: str) -> Vehicle:
    """The vehicle file with the fitted values. The payload stays as described.

    The dry mass stays as weighed. Only the sum of rigid and added mass is observable: it is divided as in the file, with the same factor on
    the rigid part along all axes, up to what the hull can carry. The drag coefficients hold all of the drag, so no linear damping is left.
    Quantities without a field (trim, individual gains) stay in the report.
    """
    old, body = vehicle.inertial, assemble_vehicle(vehicle)
    whole, own = np.diag(body.mass), np.diag(assemble_vehicle(dataclasses.replace(vehicle, payload=())).mass)
    total, before = np.exp(np.concatenate([fit.value("mass"), fit.value("inertia")])) - (whole - own), own
    rigid = max(old.dry_kg, min(old.wet_kg * float(np.mean(total[:3] / before[:3])), float(total[:3].min()), vehicle.most_wet_kg))
    turn = min(float(np.mean(total[3:] / before[3:])), float(np.min(total[3:] / np.diag(old.inertia))))
    inertia, gain = old.inertia * turn, float(np.mean(fit.value("gain")))
    inertial = dataclasses.replace(
        old,
        entrained_kg=rigid - old.dry_kg,
        inertia=frozen_array(inertia),
        added=frozen_array(total - np.concatenate([np.full(3, rigid), np.diag(inertia)])),
        righting_arm_m=float(-fit.value("arm")[2] / (rigid * GRAVITY)),
    )
    face, edge = fit.value("drag")
    spun = float(np.mean(fit.value("rotational") / body.drag.rotational)) if body.drag.rotational.all() else 1.0
    drag = dataclasses.replace(
        vehicle.drag, cd_face=float(face), cd_edge=float(edge), rotational_cd=max(0.0, vehicle.drag.rotational_cd * spun),
        linear=np.zeros(6),
    )  # fmt: skip
    curve = dataclasses.replace(
        curve,
        forward=frozen_array(curve.forward * gain),
        reverse=frozen_array(curve.reverse * gain),
        deadband_n=max(0.0, float(np.mean(fit.value("deadband")))),
        lag_s=float(fit.value("lag")[0]),
    )
    return dataclasses.replace(
        vehicle, inertial=inertial, drag=drag, curve=curve, source=f"tools/identify.py on {logs}; before: {vehicle.source}",
        force_max_n=min(vehicle.force_max_n, float(np.sum(curve.forward))),
        force_min_n=max(vehicle.force_min_n, -float(np.sum(curve.reverse))),
    )  # fmt: skip


def _number(i: int) -> Callable[[np.ndarray], float]:
    """Function that returns one unknown."""
    return lambda x: float(x[i])


def _exponential(i: int) -> Callable[[np.ndarray], float]:
    """Function that returns one unknown which is searched by its logarithm."""
    return lambda x: float(np.exp(x[i]))


def _length(at: slice) -> Callable[[np.ndarray], float]:
    return lambda x: float(np.linalg.norm(x[at]))
