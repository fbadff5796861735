"""The attitude of TAG_ATTITUDE: a unit quaternion in 2 + 27 bits, smallest three."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np


def pack_quaternion(q: Sequence[float]) -> tuple[int, int, int, int]:
    """A unit quaternion (w, x, y, z) as TAG_ATTITUDE carries it: index of the largest component, the other three raw.

    Smallest three: the largest is made positive and left out, the others lie in +-1/sqrt(2), raw 0..510, 255 for zero.
    The attitude that arrives is off by 0.0031 rad rms over all attitudes, 0.0096 rad at worst.
    """
    w, x, y, z = (float(c) for c in q)
    components = [w, x, y, z]
    largest = max(range(4), key=lambda i: abs(components[i]))
    scale = math.copysign(255.0 * math.sqrt(2.0), components[largest])
    del components[largest]
    a, b, c = (min(510, max(0, round(255.0 + scale * value))) for value in components)
    return largest, a, b, c


def unpack_quaternion(largest: int, a: int, b: int, c: int) -> np.ndarray:
    """(4,) unit quaternion of the four raw values of TAG_ATTITUDE; the component left out is not negative."""
    scale = 1.0 / (255.0 * math.sqrt(2.0))
    components = [(a - 255) * scale, (b - 255) * scale, (c - 255) * scale]
    square = sum(value * value for value in components)
    components.insert(largest, math.sqrt(max(0.0, 1.0 - square)))
    q = np.array(components)
    return q / math.sqrt(square) if square > 1.0 else q
