"""The water that the robot assumes, at rest under the atmosphere: one density for drag, and for depth from pressure."""

GRAVITY = 9.80665
"""m/s^2, standard gravity."""
WATER_DENSITY = 998.2
"""kg/m^3, fresh water at 20 degC (IAPWS)."""
ATMOSPHERE_PA = 101_325.0
"""Standard atmosphere; the estimator's depth bias takes up changes by the weather."""
PA_PER_M = WATER_DENSITY * GRAVITY
"""Rise of pressure with depth."""
