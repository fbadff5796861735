"""For tools/bench.py: drag look-up, and building of the drag table, beside alternatives."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence

import numpy as np
from bench_entry import Entry, compare, each_us
from numba import njit

from firmware_py.core.body import DragTable
from firmware_py.core.drag_lookup import add_drag
from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.description.water import WATER_DENSITY
from firmware_py.prepare import alpha, drag_table
from firmware_py.prepare.capability.sphere import fibonacci
from firmware_py.prepare.joints import Placement
from firmware_py.prepare.projected_area import Solid, areas_and_centroids, box, plane_basis
from hil.metrics import rms

DIRECTIONS = 1000
"""Directions in the paper's drag table, and look-ups per repetition."""


@njit(cache=False)
def _look_up_all(nodes, rotational, linear, velocities, out):  # type: ignore[no-untyped-def]
    for i in range(velocities.shape[0]):
        out[i] = 0.0
        add_drag(nodes, rotational, linear, velocities[i], out[i])


@njit(cache=False)
def _nearest_all(directions, coefficients, velocities, out):  # type: ignore[no-untyped-def]
    for i in range(velocities.shape[0]):
        v = velocities[i]
        best, where = -2.0, 0
        for k in range(directions.shape[0]):
            cosine = directions[k, 0] * v[0] + directions[k, 1] * v[1] + directions[k, 2] * v[2]
            if cosine > best:
                best, where = cosine, k
        out[i, :3] = -coefficients[where] * np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2) * v[:3]


def drag_entries() -> list[Entry]:
    """Drag look-up, its error, and building the drag table."""
    vehicle = load_vehicle("modcube")
    return [*_look_up_entries(vehicle), *_build_entries(vehicle)]


def _look_up_entries(vehicle: Vehicle) -> list[Entry]:
    """Look-up in the drag table of a lone module, and among the paper's 1000 directions; both against the exact drag."""
    placements = [Placement(vehicle, (0, 0, 0), 0)]
    solids = [box(np.array(vehicle.hull.size_m))]

    def exact(directions: np.ndarray) -> np.ndarray:
        """Drag per squared speed along (n, 3) directions, N s^2/m^2."""
        area = areas_and_centroids(solids, directions)[0]
        return np.asarray(0.5 * WATER_DENSITY * drag_table.coefficient(placements, directions) * area)

    table = _table(vehicle, areas_and_centroids)
    drawn = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    velocities = np.hstack([drawn / np.linalg.norm(drawn, axis=1, keepdims=True), np.zeros((DIRECTIONS, 3))])
    grid = fibonacci(DIRECTIONS)
    ours, theirs = np.zeros((DIRECTIONS, 6)), np.zeros((DIRECTIONS, 6))
    look_up = (table.nodes, table.rotational, np.zeros(6), velocities, ours)
    nearest = (grid, exact(grid), velocities, theirs)
    _look_up_all(*look_up)
    _nearest_all(*nearest)
    truth = exact(velocities[:, :3])
    errors = [100.0 * rms(np.linalg.norm(each[:, :3], axis=1) / truth - 1.0) for each in (ours, theirs)]
    peer = "nearest of 1000 directions"
    peers = {peer: _per_direction(lambda: _nearest_all(*nearest))}
    return [
        *compare("drag look-up, compiled", "us", _per_direction(lambda: _look_up_all(*look_up)), peers),
        Entry("drag look-up, error", errors[0], "% rms", peer, errors[1], errors[1] / errors[0]),
    ]


def _build_entries(vehicle: Vehicle) -> list[Entry]:
    """Building the drag table of a lone module, beside two ways by alpha shapes."""

    def build(method: drag_table.Outlines) -> Callable[[], float]:
        return lambda: each_us(lambda: _table(vehicle, method), 1)() * 1e-6

    name, exact_s = "drag table of one module", build(areas_and_centroids)
    entries = compare(name, "s", exact_s, {"alpha shapes of 1000 points": build(alpha.lattice_method)})
    if importlib.util.find_spec("alphashape") is not None:  # takes minutes, so only once
        entries += compare(name, "s", exact_s, {"the alphashape package": build(_alphashape_package)}, repetitions=1)
    return entries


def _table(vehicle: Vehicle, method: drag_table.Outlines) -> DragTable:
    """Drag table of a lone module, with outlines found by `method`."""
    return drag_table.build([Placement(vehicle, (0, 0, 0), 0)], np.zeros(3), float(vehicle.hull.size_m[0]), method=method)


def _per_direction(function: Callable[[], object]) -> Callable[[], float]:
    run = each_us(function, 5)
    return lambda: run() / DIRECTIONS


def _alphashape_package(solids: Sequence[Solid], directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outlines as a user of the alphashape package would compute them; seconds per direction, so the package is not in the lock file."""
    import alphashape

    cloud = alpha.lattice_points(solids)
    shapes = [(alphashape.alphashape(cloud.points @ basis.T, 1.0 / cloud.radius), basis) for basis in plane_basis(directions)]
    centroids = [np.array([shape.centroid.x, shape.centroid.y]) @ basis for shape, basis in shapes]
    return np.array([shape.area for shape, _ in shapes]), np.array(centroids)
