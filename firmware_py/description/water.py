"""The water that the robot assumes: one density for drag and for depth from pressure."""

WATER_DENSITY = 998.2
"""kg/m^3, fresh water at 20 degC (IAPWS)."""
