"""Random waypoints for tests of minimum snap, and the extremes of the planned trajectories."""

import numpy as np
from scipy.spatial.transform import Rotation

from firmware_py.prepare.minimum_snap import Waypoint
from firmware_py.prepare.piecewise import Piecewise


def walk(n: int, seed: int = 0) -> np.ndarray:
    return np.cumsum(0.5 * np.random.default_rng(seed).normal(size=(n, 3)), axis=0)


def durations(points: np.ndarray, seed: int = 1) -> np.ndarray:
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.asarray(2.0 + 3.0 * lengths + np.random.default_rng(seed).uniform(0.0, 2.0, len(lengths)))


def poses(n: int, seed: int = 2) -> list[Waypoint]:
    turns = Rotation.random(n, rng=np.random.default_rng(seed)).as_quat(scalar_first=True)
    return [Waypoint(p, q) for p, q in zip(walk(n), turns, strict=True)]


def extremes(found: Piecewise) -> tuple[np.ndarray, np.ndarray]:
    grid = found.grid(200)
    return np.abs(grid[..., 7:10]).max(axis=(0, 1)), np.abs(grid[..., 13:16]).max(axis=(0, 1))
