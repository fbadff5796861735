"""The mode SURFACE: a body goes up and is kept at the surface, whatever of its pose is known. Part of `guidance_modes`."""

from __future__ import annotations

import math

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.failsafes import Level
from firmware_py.core.health import Health
from firmware_py.core.rotations import heading, rotate, rotate_back
from firmware_py.core.setpoint import Wish
from firmware_py.core.types import Estimate, Setpoint
from firmware_py.description.parameters import Parameters

LEAST_LIFT = 0.5
"""Share of `surface_n_per_kg` with which SURFACE lifts a body that believes to be at the surface: a depth sensor that reads too shallow
must not keep a robot down. The 1.55 N of a module are three times the buoyancy that it may lack on the bench, and lift its hull 3 mm
farther out of the water."""
SURFACE_MARGIN_M = 0.02
"""Depth below that of the surface at which the body counts as there."""


class Surfacing:
    """Set-points and wrenches with which one body surfaces."""

    def __init__(self, body: Body, parameters: Parameters) -> None:
        self._body = body
        self.retune(parameters)

    def retune(self, parameters: Parameters) -> None:
        """Applies new parameters from this tick on."""
        p, f = parameters.steering, parameters.failsafes
        self._speed_m_s = p.surface_speed_m_s
        self._no_place_s, self._no_depth_s = f.tag_lost_limit, f.depth_unknown_limit
        self._most_push_m_s = f.pushed_limit if f.pushed_action > Level.WARN else math.inf
        self._lift_n = p.surface_n_per_kg * float(self._body.mass[2, 2])
        depth_m = self._body.r_bm[:, 2]
        at_surface_m = p.surface_depth_m + float(depth_m.mean() - depth_m.min())  # the highest module is to be at the surface
        self._surface_m = max(at_surface_m, float((0.5 * self._body.hull_m[:, 2] - depth_m).max()))  # with its hull in the water

    def is_placed(self, health: Health) -> bool:
        """Whether tags tell the position, or did lately and nothing pushes the body out of sight: the believed position would run away, and
        a body that surfaces swim after it (the fail-safe `pushed` lets go in other modes).
        """
        return health.ready and health.tag_age_s <= self._no_place_s and health.unseen_push_m_s <= self._most_push_m_s

    def wish(self, at: Setpoint) -> Wish:
        """Returns where the set-point `at` glides to: up, upright, and to the surface."""
        still = np.zeros(3)
        if at.p_wb[2] > self._surface_m:
            return Wish(np.array([0.0, 0.0, -self._speed_m_s]), still, None, heading(at.q_wb))
        return Wish(still, still, np.array([math.nan, math.nan, self._surface_m]), heading(at.q_wb))

    def wrench(self, wrench: np.ndarray, estimate: Estimate, health: Health) -> np.ndarray:
        """Returns the wrench (6,) from that of the controller, body frame: upward by the controller, or by a constant force if depth is
        unknown; horizontal only if position is known.

        At the surface it lifts with at least LEAST_LIFT, and below it pushes down with no more: the believed depth may be wrong.
        """
        if not health.ready:
            return np.asarray(np.r_[0.0, 0.0, -self._lift_n, 0.0, 0.0, 0.0])
        out = wrench.copy()
        force_w = np.asarray(rotate(estimate.q_wb, wrench[:3].copy()))
        if not self.is_placed(health):
            force_w[:2] = 0.0
        is_up = estimate.p_wb[2] <= self._surface_m + SURFACE_MARGIN_M
        if health.depth_unknown_s > self._no_depth_s:
            force_w[2] = -self._lift_n
        else:
            force_w[2] = min(force_w[2], (-LEAST_LIFT if is_up else LEAST_LIFT) * self._lift_n)
        out[:3] = rotate_back(estimate.q_wb, force_w)
        return np.asarray(out)
