"""How far a position is beyond the fence: a figure of the health, and a test of every mission item. Keeps set-points inside it."""

from __future__ import annotations

import numpy as np

from firmware_py.description.failsafe_parameters import Fence


def beyond(p_w: np.ndarray, fence: Fence) -> dict[str, float]:
    """Returns how far a position (3,) is beyond each side of the fence, by the side's name, m; negative inside."""
    return dict(zip(("north_m", "east_m", "top_m", "bottom_m"), _beyond(p_w, fence), strict=True))


def _beyond(p_w: np.ndarray, fence: Fence) -> tuple[float, float, float, float]:
    north, east, down = p_w.tolist()
    return abs(north) - fence.north_m, abs(east) - fence.east_m, fence.top_m - down, down - fence.bottom_m


def outside(p_w: np.ndarray, fence: Fence) -> float:
    """Returns how far a position (3,) is beyond the fence, m; negative inside."""
    return max(_beyond(p_w, fence))


def nearest_inside(p_w: np.ndarray, fence: Fence) -> np.ndarray:
    """Returns the position (3,), or the nearest one inside the fence."""
    low = np.array([-fence.north_m, -fence.east_m, fence.top_m])
    return np.asarray(np.clip(p_w, low, np.array([fence.north_m, fence.east_m, fence.bottom_m])))


def velocity_within(p_w: np.ndarray, v_w: np.ndarray, fence: Fence) -> np.ndarray:
    """Returns the velocity (3,) at a position, without the components that would lead out of the fence, or farther out, within a second."""
    soon = p_w + v_w
    beyond_soon, beyond_now = (np.abs(nearest_inside(p, fence) - p) for p in (soon, p_w))
    return np.where(beyond_soon > beyond_now, 0.0, v_w)
