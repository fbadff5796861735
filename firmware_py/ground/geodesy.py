"""Conversion between the tank's frame and latitude, longitude, altitude: tangent plane of WGS 84 at the configured origin.

Good to 1 mm within 100 m of the origin; the wire's 1e-7 degrees are 11 mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

EQUATOR_M = 6_378_137.0
FLATTENING = 1 / 298.257223563
"""WGS 84, NIMA TR8350.2."""
_E2 = FLATTENING * (2 - FLATTENING)


@dataclass(frozen=True, slots=True)
class Origin:
    """Geodetic position of the tank's reference point."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def _radii(self) -> tuple[float, float]:
        """Metres per radian of latitude and of longitude, at the origin's altitude."""
        latitude = math.radians(self.latitude_deg)
        root = math.sqrt(1 - _E2 * math.sin(latitude) ** 2)
        north = EQUATOR_M * (1 - _E2) / root**3 + self.altitude_m
        east = (EQUATOR_M / root + self.altitude_m) * math.cos(latitude)
        return north, max(east, 1.0)  # longitude is undefined at a pole

    def geodetic(self, p_w: np.ndarray) -> tuple[float, float, float]:
        """Latitude and longitude, deg, and altitude, m, of a point (3,) NED, m."""
        north, east = self._radii()
        latitude = self.latitude_deg + math.degrees(p_w[0] / north)
        longitude = math.remainder(self.longitude_deg + math.degrees(p_w[1] / east), 360.0)
        return latitude, longitude, self.altitude_m - float(p_w[2])

    def local(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> np.ndarray:
        """(3,) NED, m, of a place."""
        north, east = self._radii()
        turn = (longitude_deg - self.longitude_deg + 180.0) % 360.0 - 180.0
        return np.array(
            [
                math.radians(latitude_deg - self.latitude_deg) * north,
                math.radians(turn) * east,
                self.altitude_m - altitude_m,
            ]
        )
