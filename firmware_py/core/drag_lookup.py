"""Drag of a body from its table, for every tick and prediction: bilinear interpolation on the six sides of a cube map.

Side k is the face k of description.vehicle.FACE_NAMES (+x, -x, +y, -y, +z, -z). On the side of axis a the grid runs over
u = d[(a + 1) % 3] / |d[a]| and v = d[(a + 2) % 3] / |d[a]|, both from -1 to 1, nodes on the rims included.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from firmware_py.core.rotations import V

NODES = "float64[:,:,:,::1]"
STILL = 1e-12
"""Speed, m/s, at or below which direction and drag are zero."""


@njit(cache=True, error_model="numpy", inline="always")
def _interpolate(nodes, x, y, z):  # type: ignore[no-untyped-def]
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        side, major, u, v = (0 if x >= 0.0 else 1), ax, y, z
    elif ay >= az:
        side, major, u, v = (2 if y >= 0.0 else 3), ay, z, x
    else:
        side, major, u, v = (4 if z >= 0.0 else 5), az, x, y
    if not major > STILL:
        return 0.0, 0.0, 0.0, 0.0
    last = nodes.shape[1] - 1
    half = 0.5 * last
    s, t = half * (u / major + 1.0), half * (v / major + 1.0)
    i, j = min(max(int(s), 0), last - 1), min(max(int(t), 0), last - 1)
    s -= i
    t -= j
    w00, w01, w10, w11 = (1.0 - s) * (1.0 - t), (1.0 - s) * t, s * (1.0 - t), s * t
    a, b, c, d = nodes[side, i, j], nodes[side, i, j + 1], nodes[side, i + 1, j], nodes[side, i + 1, j + 1]
    return (
        w00 * a[0] + w01 * b[0] + w10 * c[0] + w11 * d[0],
        w00 * a[1] + w01 * b[1] + w10 * c[1] + w11 * d[1],
        w00 * a[2] + w01 * b[2] + w10 * c[2] + w11 * d[2],
        w00 * a[3] + w01 * b[3] + w10 * c[3] + w11 * d[3],
    )


@njit(cache=True, error_model="numpy")
def look_up(nodes, direction):  # type: ignore[no-untyped-def]
    """Returns coefficient and centre of pressure for flow along one direction.

    Args:
        nodes: (6, n, n, 4) of core.body.DragTable.
        direction: (3,) velocity of the body through the water, body frame; any length.

    Returns:
        (4,) force per squared speed, N s^2/m^2, and centre of pressure from the centre of mass, m; zero without motion.
    """
    return np.array(_interpolate(nodes, direction[0], direction[1], direction[2]))


@njit(cache=True, error_model="numpy")
def add_drag(nodes, rotational, linear, nu, out):  # type: ignore[no-untyped-def]
    """Adds the wrench of the water on the body to `out` (6,). Arguments as `drag_wrench`; allocates nothing."""
    k, rx, ry, rz = _interpolate(nodes, nu[0], nu[1], nu[2])
    c = -k * math.sqrt(nu[0] * nu[0] + nu[1] * nu[1] + nu[2] * nu[2])
    fx, fy, fz = c * nu[0], c * nu[1], c * nu[2]
    w = math.sqrt(nu[3] * nu[3] + nu[4] * nu[4] + nu[5] * nu[5])
    out[0] += fx - linear[0] * nu[0]
    out[1] += fy - linear[1] * nu[1]
    out[2] += fz - linear[2] * nu[2]
    out[3] += ry * fz - rz * fy - (rotational[0] * w + linear[3]) * nu[3]
    out[4] += rz * fx - rx * fz - (rotational[1] * w + linear[4]) * nu[4]
    out[5] += rx * fy - ry * fx - (rotational[2] * w + linear[5]) * nu[5]


@njit(f"{V}({NODES}, {V}, {V}, {V})", cache=True, error_model="numpy")
def drag_wrench(nodes, rotational, linear, nu):  # type: ignore[no-untyped-def]
    """Wrench of the water on the body about its centre of mass, body frame, (6,) N and N m.

    F = -c(d) |v| v, the paper's -1/2 rho Cd A |v| v with c = 1/2 rho Cd A from the table; the moment is r_cp x F (the
    paper's Algorithm 1 has no lever arm; see its errata) minus rotational |w| w; linear damping acts on all six.

    Args:
        nodes, rotational, linear: core.body.DragTable.
        nu: (6,) velocity through the water and angular rate, body frame.
    """
    out = np.zeros(6)
    add_drag(nodes, rotational, linear, nu, out)
    return out


def node_directions(n: int) -> np.ndarray:
    """(6, n, n, 3) unit vectors to the nodes of a cube map with n nodes along each edge."""
    grid = np.linspace(-1.0, 1.0, n)
    u, v = np.meshgrid(grid, grid, indexing="ij")
    directions = np.empty((6, n, n, 3))
    for side in range(6):
        axis = side // 2
        directions[side, :, :, axis] = 1.0 if side % 2 == 0 else -1.0
        directions[side, :, :, (axis + 1) % 3] = u
        directions[side, :, :, (axis + 2) % 3] = v
    return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))
