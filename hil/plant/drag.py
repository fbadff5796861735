"""Drag of boxes in a flow, from their projected areas. Called at every stage of the integration.

F = -1/2 rho Cd(d) A(d) |v| v. The projected area of a box with edges a, b, c is A(d) = bc|dx| + ac|dy| + ab|dz| for flow from d. Cd
is a fourth-degree polynomial in d with the symmetry of a cube, fitted to the given values face-on and edge-on.
"""

from __future__ import annotations

import math

from hil.plant.vectors import inlined


@inlined
def translation(a, b, c, cd_face, cd_edge, vx, vy, vz):
    """Cd(d) A(d) |v|, m^3/s, of a box with edges a, b, c (m) moving at v (m/s, box frame) through the water.

    Cd = cd_edge + (cd_face - cd_edge)(2 s - 1), s = dx^4 + dy^4 + dz^4: s is 1 face-on and 1/2 edge-on.
    """
    x2, y2, z2 = vx * vx, vy * vy, vz * vz
    squared = x2 + y2 + z2
    if squared < 1e-18:
        return 0.0
    s = (x2 * x2 + y2 * y2 + z2 * z2) / (squared * squared)
    cd = cd_edge + (cd_face - cd_edge) * (2.0 * s - 1.0)
    return cd * (b * c * abs(vx) + a * c * abs(vy) + a * b * abs(vz))


@inlined
def strip(v, w, h):
    """Integral over y from -h to h of |v + w y| (v + w y) y dy, m^5/s^2 per metre: strip theory of a side in cross-flow.

    v is the flow across the side, m/s; w the angular rate, rad/s; h half the length, m. Exact, piecewise.
    """
    if abs(v) >= abs(w) * h:
        return 4.0 / 3.0 * abs(v) * w * h**3
    inner = v * v * h * h + 0.5 * w * w * h**4 - v**4 / (6.0 * w * w)
    return math.copysign(inner, w)


@inlined
def rotation(a, b, c, vx, vy, wz, open_x, open_y):
    """Integral, m^5/s^2, for a box with edges a, b and c along x, y, z; times 1/2 rho Cd: the moment that opposes the rate wz.

    open_x, open_y: shares of the sides across x and y that are exposed to the water.
    """
    return c * (open_y * strip(vy, wz, 0.5 * a) + open_x * strip(-vx, wz, 0.5 * b))


@inlined
def box(size, sides, turning, linear, quadratic, half_rho, factor, moment, v, w):
    """Force of the water on one hull, and its moment about the centre; all in the hull's frame.

    Args:
        size, sides, linear, quadratic: one row each of `bodies.Modules`. turning: rotational coefficients, part of its `drag`.
        half_rho: half the density of the water. factor: half_rho Cd(d) A(d) |v| of the part exposed to the flow, see `translation`.
        moment: moment of the drag on that part, whose centre is off the hull's centre.
        v, w: velocity relative to the water, m/s, and rate, rad/s.
    """
    (sx, sy, sz), (ox, oy, oz), c = size, sides, turning
    f = (
        -(factor + linear[0] + quadratic[0] * abs(v[0])) * v[0],
        -(factor + linear[1] + quadratic[1] * abs(v[1])) * v[1],
        -(factor + linear[2] + quadratic[2] * abs(v[2])) * v[2],
    )
    n = (
        moment[0] - half_rho * c[0] * rotation(sy, sz, sx, v[1], v[2], w[0], oy, oz) - (linear[3] + quadratic[3] * abs(w[0])) * w[0],
        moment[1] - half_rho * c[1] * rotation(sz, sx, sy, v[2], v[0], w[1], oz, ox) - (linear[4] + quadratic[4] * abs(w[1])) * w[1],
        moment[2] - half_rho * c[2] * rotation(sx, sy, sz, v[0], v[1], w[2], ox, oy) - (linear[5] + quadratic[5] * abs(w[2])) * w[2],
    )
    return f, n
