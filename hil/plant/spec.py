"""Magnitudes of all simulated errors and disturbances: water, body, thrusters, sensors.

Read once from a scenario file. A magnitude of zero switches an error off. Values without a measured source are marked
(synthetic) in their help.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from firmware_py.description.schema import DescriptionError, quantity


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WorldSpec:
    """Water, tank walls and the deviations of the robot from its vehicle file."""

    density: float = quantity(998.2, unit="kg/m^3", low=900, high=1100, help="of fresh water at 20 degC")
    gravity: float = quantity(9.81, unit="m/s^2", low=9, high=10, help="downwards")
    atmosphere_pa: float = quantity(101325.0, unit="Pa", low=8e4, high=1.2e5, help="pressure at the surface")
    temperature_c: float = quantity(20.0, unit="degC", low=-2, high=40, help="of the water")
    current_m_s: float = quantity(
        0.05, unit="m/s", low=0, high=2, help="mean horizontal current, direction per seed (synthetic)"
    )
    gust_m_s: float = quantity(
        0.015, unit="m/s", low=0, high=1, help="gusts per axis, standard deviation: 30 % of the mean (synthetic)"
    )
    gust_time_s: float = quantity(5.0, unit="s", low=0.1, high=1000, help="correlation time of the gusts (synthetic)")
    gust_smoothing_s: float = quantity(
        1.0, unit="s", low=0.05, high=100, help="second lag: water has inertia (synthetic)"
    )
    buoyancy_error_n: float = quantity(0.5, unit="N", low=0, high=1000, help="net buoyancy, sign per seed (synthetic)")
    righting_spread_m: float = quantity(
        0.005, unit="m", low=0, high=0.5, help="righting arm drawn this far around the vehicle file's (synthetic)"
    )
    trim_m: float = quantity(
        0.003, unit="m", low=0, high=0.5, help="lateral shift of the dry mass, each axis drawn up to this (synthetic)"
    )
    mass_spread: float = quantity(0.15, low=0, high=0.8, help="share: rigid mass; added mass of each axis (synthetic)")
    inertia_spread: float = quantity(
        0.15, low=0, high=0.3, help="share: inertia of each axis, rigid and added (synthetic)"
    )
    drag_spread: float = quantity(
        0.20, low=0, high=0.9, help="share: coefficients face-on, edge-on, of rotation (synthetic)"
    )
    gain_spread: float = quantity(0.05, low=0, high=0.9, help="share: force of each thruster (synthetic)")
    thruster_lag_s: float = quantity(0.08, unit="s", low=0, high=2, help="first-order lag of the force (synthetic)")
    deadband_low_n: float = quantity(0.10, unit="N", low=0, high=10, help="smallest deadband drawn (synthetic)")
    deadband_high_n: float = quantity(0.25, unit="N", low=0, high=10, help="largest deadband drawn (synthetic)")
    supply_resistance_ohm: float = quantity(0.10, unit="ohm", low=0, high=10, help="makes the voltage sag (synthetic)")
    supply_limit: bool = quantity(True, help="the supply gives no more than its current")
    jet_strength: float = quantity(
        0.3, low=0, high=1, help="share of a jet's thrust that pushes a module in its way (synthetic)"
    )
    jet_length_m: float = quantity(0.5, unit="m", low=0.01, high=100, help="length over which a jet halves (synthetic)")
    jet_radius_m: float = quantity(
        0.06, unit="m", low=0.001, high=10, help="of a jet at its thruster; opens by 0.1 (synthetic)"
    )
    wall_stiffness: float = quantity(2000.0, unit="N/m", low=0, high=1e6, help="of one corner on a wall (synthetic)")
    wall_damping: float = quantity(60.0, unit="N s/m", low=0, high=1e5, help="across and along the wall (synthetic)")

    def __post_init__(self) -> None:
        if self.deadband_low_n > self.deadband_high_n:
            raise DescriptionError("deadband_low_n is above deadband_high_n")


CALM: dict[str, float] = dict.fromkeys(
    (
        "current_m_s", "gust_m_s", "buoyancy_error_n", "righting_spread_m", "trim_m", "mass_spread", "inertia_spread",
        "drag_spread", "gain_spread", "thruster_lag_s", "deadband_low_n", "deadband_high_n", "supply_resistance_ohm",
        "supply_limit", "jet_strength",
    ),
    0,
)  # fmt: skip
"""Overrides that switch every error of the world off."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SensorSpec:
    """Measurement errors; sigma is a standard deviation. Quantisation comes from encoding into the real frames."""

    gyro_sigma: float = quantity(0.002, unit="rad/s", low=0, high=1, help="noise per sample: consumer MEMS (synthetic)")
    gyro_bias: float = quantity(0.005, unit="rad/s", low=0, high=1, help="bias drawn per axis, sigma (synthetic)")
    gyro_walk: float = quantity(2e-5, unit="rad/s/sqrt(s)", low=0, high=1, help="random walk of the bias (synthetic)")
    accel_sigma: float = quantity(
        0.03, unit="m/s^2", low=0, high=10, help="noise per sample: consumer MEMS (synthetic)"
    )
    accel_bias: float = quantity(0.05, unit="m/s^2", low=0, high=10, help="bias drawn per axis, sigma (synthetic)")
    accel_walk: float = quantity(1e-4, unit="m/s^2/sqrt(s)", low=0, high=1, help="random walk of the bias (synthetic)")
    depth_sigma_m: float = quantity(0.002, unit="m", low=0, high=1, help="noise (synthetic)")
    depth_bias_m: float = quantity(
        0.02, unit="m", low=0, high=10, help="bias drawn, sigma: weather and datum (synthetic)"
    )
    depth_walk: float = quantity(2e-4, unit="m/sqrt(s)", low=0, high=1, help="random walk of the bias (synthetic)")
    tag_rate_hz: float = quantity(60.0, unit="Hz", low=0.1, high=400, help="pictures a second, free-running (paper)")
    tag_phase: float = quantity(1.0, low=0, high=1, help="share of a picture's period over which its phase is drawn")
    tag_delay_ms: float = quantity(40.0, unit="ms", low=0, high=500, help="from the picture to its frames (synthetic)")
    tag_sigma_m: float = quantity(0.002, unit="m", low=0, high=1, help="noise across the camera axis (synthetic)")
    tag_sigma_axis_m: float = quantity(0.004, unit="m", low=0, high=1, help="noise along the camera axis (synthetic)")
    tag_sigma_deg: float = quantity(0.5, unit="deg", low=0, high=90, help="attitude noise, each axis (synthetic)")
    tag_dropped: float = quantity(0.02, low=0, high=1, help="share of pictures without a pose (synthetic)")
    tag_flipped: float = quantity(0.005, low=0, high=1, help="share with the planar tag's second pose (synthetic)")
    tag_incidence_deg: float = quantity(
        65.0, unit="deg", low=1, high=90, help="a tag seen more obliquely is not read (synthetic)"
    )
    tag_all: bool = quantity(False, help="report every readable tag of a picture, in place of each module's best")
    voltage_sigma_v: float = quantity(0.01, unit="V", low=0, high=10, help="noise of the battery voltage (synthetic)")
    current_sigma_a: float = quantity(0.02, unit="A", low=0, high=10, help="noise of the battery current (synthetic)")
    rpm_sigma: float = quantity(5.0, unit="1/min", low=0, high=1000, help="noise of the propeller speeds (synthetic)")
    dock_sigma_ma: float = quantity(4.0, unit="mA", low=0, high=1000, help="noise of the magnet currents (synthetic)")


IDEAL: dict[str, float] = dict.fromkeys(
    (
        "gyro_sigma", "gyro_bias", "gyro_walk", "accel_sigma", "accel_bias", "accel_walk", "depth_sigma_m",
        "depth_bias_m", "depth_walk", "tag_phase", "tag_delay_ms", "tag_sigma_m", "tag_sigma_axis_m", "tag_sigma_deg",
        "tag_dropped", "tag_flipped", "voltage_sigma_v", "current_sigma_a", "rpm_sigma", "dock_sigma_ma",
    ),
    0,
)  # fmt: skip
"""Overrides for perfect sensors: no noise, no bias, no delay."""
HALF_A_COUNT = {"gyro_sigma": 0.00025, "accel_sigma": 0.001, "depth_sigma_m": 0.00005, "tag_sigma_deg": 0.09}
"""Noise that remains with ideal sensors: half a count of the frames. An IMU or pressure reading that repeats to the last bit counts as
frozen, and a tilt of a tenth of a degree would be lost within one count of the tags' attitude."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tank:
    """Shape and size of the tank. Origin at the centre of the surface, z down."""

    kind: str = quantity("box", choices=("box", "cylinder"), help="shape")
    size_m: np.ndarray = quantity(
        [1.3, 1.2, 0.76], unit="m", low=0.1, high=1000, shape=(3,), help="box: length, width, depth"
    )
    radius_m: float = quantity(3.5, unit="m", low=0.1, high=1000, help="cylinder: radius")
    depth_m: float = quantity(3.0, unit="m", low=0.1, high=1000, help="cylinder: depth")

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

    module: int = quantity(0, low=0, high=29, help="number of the module that carries it; 0: fixed in the world")
    position_m: np.ndarray = quantity(
        [0.0, 0.0, -1.2], unit="m", low=-100, high=100, shape=(3,), help="of its lens"
    )
    axis: np.ndarray = quantity([0.0, 0.0, 1.0], low=-1.001, high=1.001, shape=(3,), help="optical axis")
    half_view_deg: float = quantity(60.0, unit="deg", low=1, high=89, help="half the cone in which it sees")

    def __post_init__(self) -> None:
        if abs(float(np.linalg.norm(self.axis)) - 1.0) > 0.01:
            raise DescriptionError(f"axis {self.axis.tolist()} has not length 1")
