"""Stage 6 of a tick: PD with model feed-forward (paper, Eq. 3), attitude error on SO(3), gains times the body's mass
matrix.

tau = M (Kp e + Kd de/dt + dnu_d/dt) + C(nu) nu + D(nu) nu + g - disturbance. K_P = M w^2, K_D = 2 z w M.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from firmware_py.core.body import Body
from firmware_py.core.drag_lookup import drag_wrench
from firmware_py.core.propagation import PLANT
from firmware_py.core.rigid_body import coriolis_wrench, restoring_moment
from firmware_py.core.rotations import V, cross, difference, rotate, rotate_back
from firmware_py.core.types import Estimate, Setpoint
from firmware_py.description.parameters import Control

SETPOINT = f"{V},{V},{V},{V},{V},{V}"
"""Types of a Setpoint's fields."""


class Controller:
    """Stateless control law. All gains are computed at construction; other gains, a dock or an undock make a new object.

    Attributes:
        is_model: whether C and D are those of the wanted motion, and g is counteracted; else C and D are those of the present one.
    """

    is_model = True

    def __init__(self, body: Body, parameters: Control) -> None:
        p = parameters
        self._plant = body.plant
        self._kp = np.repeat([p.position_bandwidth**2, p.attitude_bandwidth**2], 3)
        self._kd = np.repeat(
            [2 * p.position_damping * p.position_bandwidth, 2 * p.attitude_damping * p.attitude_bandwidth], 3
        )
        self._law = self.is_model, p.drag_feedforward, p.disturbance_feedforward

    def step(self, now: Setpoint, ahead: Setpoint, estimate: Estimate) -> np.ndarray:
        """Returns the wanted wrench, (6,), body frame.

        Args:
            now: set-point of this tick, for the errors.
            ahead: set-point `lead_s` (thruster lag and bus delay) later, for the feed-forward.
            estimate: estimate of this tick.
        """
        e = estimate
        return np.asarray(
            _wrench(
                *now, *ahead, e.p_wb, e.q_wb, e.nu, e.force_w, e.moment_b, self._kp, self._kd, *self._law, *self._plant
            )
        )


class PaperController(Controller):
    """The paper's control law (Eq. 3)."""

    is_model = False


LAWS: dict[str, type[Controller]] = {"model": Controller, "paper": PaperController}
"""By `control.law`: the class that computes the wrench in `step`."""


@njit(cache=True)
def _body_velocity(q_set, v_w, w_b, q):  # type: ignore[no-untyped-def]
    """(6,) wanted velocity in the present body frame."""
    out = np.empty(6)
    out[:3] = rotate_back(q, v_w)
    out[3:] = rotate_back(q, rotate(q_set, w_b))
    return out


@njit(f"{V}({SETPOINT},{SETPOINT},{V},{V},{V},{V},{V},{V},{V},boolean,float64,float64,{PLANT})", cache=True)
def _wrench(  # type: ignore[no-untyped-def]
    p0, q0, v0, w0, a0, alpha0, p1, q1, v1, w1, a1, alpha1, p, q, nu, force_w, moment_b, kp, kd, is_model, drag_share, disturbance_share,
    mass, mass_inv, righting, nodes, rotational, linear,
):  # fmt: skip
    """Returns the wanted wrench (6,), body frame.

    Args:
        p0 to alpha0, p1 to alpha1: set-points of this tick and ahead. p to moment_b: estimate. kp, kd: (6,) gains, before the mass matrix.
        is_model: C and D are those of the wanted motion; else, by the paper's law, those of the present one, and g is zero.
        drag_share, disturbance_share: shares of drag and disturbance that are fed forward.
    """
    error = np.empty(6)
    error[:3] = rotate_back(q, p0 - p)
    error[3:] = difference(q0, q)
    ahead = _body_velocity(q1, v1, w1, q)
    rate = kp * error + kd * (_body_velocity(q0, v0, w0, q) - nu)
    # w x v is subtracted because the Coriolis term contains it
    rate[:3] += rotate_back(q, a1) - cross(ahead[3:], ahead[:3])
    rate[3:] += rotate_back(q, rotate(q1, alpha1))
    modelled = ahead if is_model else nu
    tau = mass @ rate + coriolis_wrench(mass, modelled) - drag_share * drag_wrench(nodes, rotational, linear, modelled)
    tau[:3] -= disturbance_share * rotate_back(q, force_w)
    tau[3:] -= disturbance_share * moment_b
    if is_model:
        tau[3:] -= restoring_moment(righting, q)
    return tau
