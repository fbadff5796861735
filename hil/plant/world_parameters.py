"""The random draws of one seed as named numbers, which a campaign compares with its metrics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from firmware_py.description.vehicle import Vehicle
from hil.plant.draw import draw_module, stream
from hil.plant.spec import WorldSpec
from hil.plant.water import Gusts


def world_parameters(vehicles: Sequence[Vehicle], spec: WorldSpec, seed: int) -> dict[str, float]:
    """Means over the modules of the drawn parameters, and the mean current; factors are relative to the vehicle file."""
    modules = [_module_parameters(vehicle, spec, seed, m) for m, vehicle in enumerate(vehicles)]
    current = Gusts(spec, stream(seed, "gusts"), 1.0).mean
    means = {name: float(np.mean([module[name] for module in modules])) for name in modules[0]}
    return {**means, "current_north_m_s": float(current[0]), "current_east_m_s": float(current[1])}


def _module_parameters(vehicle: Vehicle, spec: WorldSpec, seed: int, module: int) -> dict[str, float]:
    draw, nominal = draw_module(vehicle, spec, seed, module), vehicle.inertial
    drag = vehicle.drag
    published = drag.quadratic[:3]
    return {
        "mass_factor": draw.dry_kg / nominal.dry_kg,
        "added_mass_factor": _factor(draw.added[:3], nominal.added[:3]),
        "inertia_factor": _factor(np.diag(draw.inertia), np.diag(nominal.inertia)),
        "drag_face_factor": _factor(
            np.r_[draw.drag[0], draw.linear[:3], draw.quadratic[: published.size]], np.r_[drag.cd_face, drag.linear[:3], published]
        ),
        "drag_edge_factor": 1.0 if published.size else _factor(draw.drag[1:2], np.array([drag.cd_edge])),
        "thruster_gain_mean": float(draw.gain.mean()),
        "thruster_gain_spread": float(draw.gain.std()),
        "deadband_n": float(draw.deadband_n.mean()),
        "net_buoyancy_n": draw.buoyancy_n - draw.mass * spec.gravity,
        "righting_arm_m": float(draw.com[2] - draw.buoyancy_at[2]),
        "trim_m": float(np.hypot(*(draw.com - nominal.com_m)[:2])) * draw.mass / draw.dry_kg,
    }


def _factor(drawn: np.ndarray, nominal: np.ndarray) -> float:
    """Mean ratio of drawn to nominal values, without the nominal zeros; 1 where all nominal values are zero."""
    return float(np.mean(drawn[nominal != 0.0] / nominal[nominal != 0.0])) if np.any(nominal) else 1.0
