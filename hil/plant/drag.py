"""Drag of boxes in flow, from their own projected areas. Called at every stage of the integration.

F = -1/2 rho Cd(d) A(d) |v| v. A box of edges a, b, c shows A(d) = bc|dx| + ac|dy| + ab|dz| to flow from d. Cd is the
polynomial of fourth degree in d, with the symmetry of a cube, that takes the given values face-on and edge-on.
"""

from __future__ import annotations

import math

from hil.plant.vectors import F8, compiled


@compiled(F8(F8, F8, F8, F8, F8, F8, F8, F8))
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


@compiled(F8(F8, F8, F8))
def strip(v, w, h):
    """Integral over y from -h to h of |v + w y| (v + w y) y dy, m^5/s^2 per metre: strips of a side in cross-flow.

    v is the flow across the side, m/s; w the turning rate, rad/s; h half the length, m. Exact, by parts.
    """
    if abs(v) >= abs(w) * h:
        return 4.0 / 3.0 * abs(v) * w * h**3
    inner = v * v * h * h + 0.5 * w * w * h**4 - v**4 / (6.0 * w * w)
    return math.copysign(inner, w)


@compiled(F8(F8, F8, F8, F8, F8, F8, F8, F8))
def rotation(a, b, c, vx, vy, wz, open_x, open_y):
    """Integral, m^5/s^2, of a box with edges a, b and c along z: times 1/2 rho Cd the moment against its rate wz.

    open_x, open_y: shares of the sides across x and y that the water reaches.
    """
    return c * (open_y * strip(vy, wz, 0.5 * a) + open_x * strip(-vx, wz, 0.5 * b))
