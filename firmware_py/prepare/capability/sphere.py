"""Directions spread evenly over the sphere: the paper's Algorithm 1, corrected at the south pole."""

from __future__ import annotations

import numpy as np


def fibonacci(n: int) -> np.ndarray:
    """(n, 3) unit vectors: polar angle arccos(1 - (2 i + 1) / n), golden angle in azimuth."""
    i = np.arange(n)
    z = 1.0 - (2 * i + 1) / n
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * i
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)


def angles(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Polar angle from +z and azimuth from +x of (n, 3) unit vectors, rad."""
    polar = np.arccos(np.clip(directions[:, 2], -1.0, 1.0))
    return polar, np.arctan2(directions[:, 1], directions[:, 0])


def grid(polar_count: int, azimuth_count: int) -> np.ndarray:
    """(polar_count, azimuth_count, 3) unit vectors of a closed mesh for drawing; poles and seam are duplicated."""
    polar = np.linspace(0.0, np.pi, polar_count)[:, None]
    azimuth = np.linspace(0.0, 2.0 * np.pi, azimuth_count)[None]
    parts = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar) * np.ones_like(azimuth)
    return np.stack(parts, axis=-1)
