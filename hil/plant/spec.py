"""Magnitudes of all simulated errors and disturbances: water, body, thrusters, sensors.

Read once from a scenario file. A magnitude of zero switches an error off. Values without a measured source are marked
(synthetic) in their help.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from firmware_py.description.schema import DescriptionError, quantity, refuse_other_length


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WorldSpec:
    """Water, tank walls and the deviations of the robot from its vehicle file."""

    density: float = quantity(998.2, unit="kg/m^3", low=900, high=1100, help="density of the water; default: fresh water at 20 degC")
    gravity: float = quantity(9.81, unit="m/s^2", low=9, high=10, help="gravitational acceleration")
    atmosphere_pa: float = quantity(101325.0, unit="Pa", low=8e4, high=1.2e5, help="air pressure at the surface")
    temperature_c: float = quantity(20.0, unit="degC", low=-2, high=40, help="temperature of the water")
    current_m_s: float = quantity(
        0.05, unit="m/s", low=0, high=2, help="mean horizontal current, its direction drawn per seed (synthetic)"
    )
    gust_m_s: float = quantity(
        0.015, unit="m/s", low=0, high=1, help="standard deviation of the gusts along each axis: 30 % of the mean current (synthetic)"
    )
    gust_time_s: float = quantity(5.0, unit="s", low=0.1, high=1000, help="correlation time of the gusts (synthetic)")
    gust_smoothing_s: float = quantity(
        1.0, unit="s", low=0.05, high=100, help="time constant of a second lag of the gusts, for the inertia of water (synthetic)"
    )
    buoyancy_error_n: float = quantity(
        0.5, unit="N", low=0, high=1000, help="magnitude of the net buoyancy, its sign drawn per seed (synthetic)"
    )
    righting_spread_m: float = quantity(
        0.005, unit="m", low=0, high=0.5, help="largest random deviation of the righting arm from the vehicle file (synthetic)"
    )
    trim_m: float = quantity(
        0.003, unit="m", low=0, high=0.5, help="largest random lateral shift of the dry mass along each axis (synthetic)"
    )
    mass_spread: float = quantity(
        0.15, low=0, high=0.8, help="largest relative error of the rigid mass, and of the added mass along each axis (synthetic)"
    )
    inertia_spread: float = quantity(
        0.15, low=0, high=0.3, help="largest relative error of the inertia about each axis, rigid and added (synthetic)"
    )
    drag_spread: float = quantity(
        0.20, low=0, high=0.9, help="largest relative error of face-on, edge-on and rotational drag, published damping included (synthetic)"
    )
    gain_spread: float = quantity(0.05, low=0, high=0.9, help="largest relative error of the force of each thruster (synthetic)")
    thruster_lag_s: float = quantity(
        0.08, unit="s", low=0, high=2, help="time constant of the first-order lag of thruster force (synthetic)"
    )
    deadband_low_n: float = quantity(0.10, unit="N", low=0, high=10, help="lower bound of the random thruster deadband (synthetic)")
    deadband_high_n: float = quantity(0.25, unit="N", low=0, high=10, help="upper bound of the random thruster deadband (synthetic)")
    supply_resistance_ohm: float = quantity(
        0.10, unit="ohm", low=0, high=10, help="internal resistance of the supply, which makes the voltage sag (synthetic)"
    )
    supply_limit: bool = quantity(True, help="whether the current of the supply is limited, as in the vehicle file")
    jet_strength: float = quantity(
        0.3, low=0, high=1, help="share of a jet's thrust that pushes a module in its path (synthetic)"
    )
    jet_length_m: float = quantity(0.5, unit="m", low=0.01, high=100, help="length over which the push of a jet falls to half (synthetic)")
    jet_radius_m: float = quantity(
        0.06, unit="m", low=0.001, high=10, help="radius of a jet at its thruster; grows by 0.1 per length (synthetic)"
    )
    wall_stiffness: float = quantity(2000.0, unit="N/m", low=0, high=1e6, help="contact stiffness of one hull corner at a wall (synthetic)")
    wall_damping: float = quantity(
        60.0, unit="N s/m", low=0, high=1e5, help="contact damping of one hull corner across and along a wall (synthetic)"
    )

    def __post_init__(self) -> None:
        if self.deadband_low_n > self.deadband_high_n:
            raise DescriptionError("deadband_low_n is above deadband_high_n")


WATER = (
    "density", "gravity", "atmosphere_pa", "temperature_c", "gust_time_s", "gust_smoothing_s", "jet_length_m", "jet_radius_m",
    "wall_stiffness", "wall_damping",
)  # fmt: skip
"""Values of a world that are no errors."""
CALM: dict[str, float] = {field.name: 0 for field in fields(WorldSpec) if field.name not in WATER}
"""Overrides that switch every error of the world off."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SensorSpec:
    """Measurement errors; sigma is a standard deviation. Quantisation comes from encoding into the real frames."""

    gyro_sigma: float = quantity(0.002, unit="rad/s", low=0, high=1, help="gyro noise per sample: consumer MEMS (synthetic)")
    gyro_bias: float = quantity(
        0.005, unit="rad/s", low=0, high=1, help="standard deviation of the random gyro bias, each axis (synthetic)"
    )
    gyro_walk: float = quantity(2e-5, unit="rad/s/sqrt(s)", low=0, high=1, help="random walk of the gyro bias (synthetic)")
    accel_sigma: float = quantity(
        0.03, unit="m/s^2", low=0, high=10, help="accelerometer noise per sample: consumer MEMS (synthetic)"
    )
    accel_bias: float = quantity(
        0.05, unit="m/s^2", low=0, high=10, help="standard deviation of the random accelerometer bias, each axis (synthetic)"
    )
    accel_walk: float = quantity(1e-4, unit="m/s^2/sqrt(s)", low=0, high=1, help="random walk of the accelerometer bias (synthetic)")
    depth_sigma_m: float = quantity(0.002, unit="m", low=0, high=1, help="depth noise per sample (synthetic)")
    depth_bias_m: float = quantity(
        0.02, unit="m", low=0, high=10, help="standard deviation of the random depth bias, from weather and datum (synthetic)"
    )
    depth_walk: float = quantity(2e-4, unit="m/sqrt(s)", low=0, high=1, help="random walk of the depth bias (synthetic)")
    tag_rate_hz: float = quantity(60.0, unit="Hz", low=0.1, high=400, help="frame rate of the free-running tag cameras (paper)")
    tag_phase: float = quantity(1.0, low=0, high=1, help="share of the picture period within which the phase of a camera is drawn")
    tag_delay_ms: float = quantity(
        40.0, unit="ms", low=0, high=480,
        help="delay from the picture to its CAN frames (synthetic); the firmware takes no picture that is older than 500 ms in its tick",
    )
    tag_sigma_m: float = quantity(0.002, unit="m", low=0, high=1, help="tag position noise across the camera axis (synthetic)")
    tag_sigma_axis_m: float = quantity(0.004, unit="m", low=0, high=1, help="tag position noise along the camera axis (synthetic)")
    tag_sigma_deg: float = quantity(0.5, unit="deg", low=0, high=90, help="tag attitude noise, each axis (synthetic)")
    tag_dropped: float = quantity(0.02, low=0, high=1, help="share of tag sightings that are lost (synthetic)")
    tag_flipped: float = quantity(
        0.005, low=0, high=1, help="share of tag sightings with the ambiguous second pose of a planar tag (synthetic)"
    )
    tag_incidence_deg: float = quantity(
        65.0, unit="deg", low=1, high=90, help="largest angle of incidence at which a tag can be read (synthetic)"
    )
    tag_all: bool = quantity(False, help="whether every readable tag in a picture is reported, not only the best one of each module")
    voltage_sigma_v: float = quantity(0.01, unit="V", low=0, high=10, help="noise of the battery voltage (synthetic)")
    current_sigma_a: float = quantity(0.02, unit="A", low=0, high=10, help="noise of the battery current (synthetic)")
    rpm_sigma: float = quantity(5.0, unit="1/min", low=0, high=1000, help="noise of the propeller speeds (synthetic)")
    dock_sigma_ma: float = quantity(4.0, unit="mA", low=0, high=1000, help="noise of the magnet currents (synthetic)")


CAMERA = ("tag_rate_hz", "tag_incidence_deg", "tag_all")
"""Values of the sensors that are no errors."""
IDEAL: dict[str, float] = {field.name: 0 for field in fields(SensorSpec) if field.name not in CAMERA}
"""Overrides for perfect sensors: no noise, no bias, no delay."""
HALF_A_COUNT = {"gyro_sigma": 0.00025, "accel_sigma": 0.001, "depth_sigma_m": 0.00005, "tag_sigma_deg": 0.09}
"""Noise that remains with ideal sensors: half a count of the frames. An IMU or pressure reading that repeats to the last bit counts as
frozen, and a tilt of a tenth of a degree would be lost within one count of the tags' attitude."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tank:
    """Shape and size of the tank. Origin at the centre of the surface, z down."""

    kind: str = quantity("box", choices=("box", "cylinder"), help="shape of the tank")
    size_m: np.ndarray = quantity(
        [1.3, 1.2, 0.76], unit="m", low=0.1, high=1000, shape=(3,), help="box: length, width, depth of the tank"
    )
    radius_m: float = quantity(3.5, unit="m", low=0.1, high=1000, help="cylinder: radius of the tank")
    depth_m: float = quantity(3.0, unit="m", low=0.1, high=1000, help="cylinder: depth of the tank")

    def holds(self, p_wm: np.ndarray) -> bool:
        """Whether the point p_wm (3,), world, m, lies between walls, surface and bottom."""
        x, y, z = p_wm.tolist()
        if self.kind == "box":
            length, width, depth = self.size_m.tolist()
            return abs(x) <= 0.5 * length and abs(y) <= 0.5 * width and 0.0 <= z <= depth
        return math.hypot(x, y) <= self.radius_m and 0.0 <= z <= self.depth_m

    def __str__(self) -> str:
        if self.kind == "box":
            return "box of {:g} x {:g} x {:g} m".format(*self.size_m)
        return f"cylinder of {self.radius_m:g} m radius and {self.depth_m:g} m depth"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraPose:
    """A tag camera, fixed in the world or carried by a module; position and axis of a carried one are in the module's frame."""

    module: int = quantity(0, low=0, high=29, help="number of the module that carries the camera; 0: fixed in the world")
    position_m: np.ndarray = quantity(
        [0.0, 0.0, -1.2], unit="m", low=-100, high=100, shape=(3,), help="position of the camera's lens"
    )
    axis: np.ndarray = quantity([0.0, 0.0, 1.0], low=-1.001, high=1.001, shape=(3,), help="unit vector of the optical axis")
    half_view_deg: float = quantity(60.0, unit="deg", low=1, high=89, help="half the opening angle of the camera's conical field of view")

    def __post_init__(self) -> None:
        refuse_other_length("axis", self.axis)
