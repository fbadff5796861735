"""Parameters of the simulated docking faces: magnets, funnel, contact and jamming. All synthetic unless marked otherwise."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_py.description.schema import quantity


@dataclass(frozen=True, slots=True, kw_only=True)
class DockSpec:
    """Probe and drogue of a pair of faces. The coil of each face acts on the armature magnet of the other: forward pulls, reverse
    pushes. Two forward coils pull with twice the force of one; a forward and a reverse coil cancel."""

    pull_n: float = quantity(40.0, unit="N", low=0, high=1e4, help="of both coils at no gap; also what holds a joint (synthetic)")
    magnet_gap_m: float = quantity(0.003, unit="m", low=1e-4, high=1, help="g0 of the pull 1/(gap + g0)^2 (synthetic)")
    coil_lag_s: float = quantity(0.03, unit="s", low=1e-3, high=10, help="rise of a coil's current (synthetic)")
    probe_m: float = quantity(0.015, unit="m", low=0, high=1, help="gap at which the probe meets the funnel (synthetic)")
    mouth_m: float = quantity(0.025, unit="m", low=0, high=1, help="lateral error beyond which the probe misses it (synthetic)")
    funnel_deg: float = quantity(50.0, unit="deg", low=0, high=90, help="tilt, and turn from the nearest of four, that it takes (paper)")
    lock_m: float = quantity(0.001, unit="m", low=1e-5, high=0.1, help="gap and lateral error at which the faces are one (synthetic)")
    lock_deg: float = quantity(1.0, unit="deg", low=0.01, high=45, help="tilt and turn likewise (synthetic)")
    rearm_m: float = quantity(0.02, unit="m", low=0, high=1, help="gap beyond which the faces have let go of each other (synthetic)")
    guide_n_m: float = quantity(2000.0, unit="N/m", low=0, high=1e6, help="funnel: lateral stiffness (synthetic)")
    guide_ns_m: float = quantity(80.0, unit="N s/m", low=0, high=1e5, help="funnel: lateral damping (synthetic)")
    turn_nm: float = quantity(15.0, unit="N m/rad", low=0, high=1e5, help="funnel and pins: turning stiffness (synthetic)")
    turn_nms: float = quantity(0.8, unit="N m s", low=0, high=1e4, help="funnel and pins: turning damping (synthetic)")
    stop_n_m: float = quantity(8e4, unit="N/m", low=0, high=1e6, help="a jammed probe in its funnel: stiffness (synthetic)")
    stop_ns_m: float = quantity(400.0, unit="N s/m", low=0, high=1e5, help="a jammed probe in its funnel: damping (synthetic)")
    contact_n_m3: float = quantity(3.6e6, unit="N/m^3", low=0, high=1e9, help="hull on hull: pressure per depth (synthetic)")
    contact_ns_m3: float = quantity(1.8e4, unit="N s/m^3", low=0, high=1e7, help="hull on hull: pressure per speed (synthetic)")
    idle_ma: float = quantity(40.0, unit="mA", low=0, high=8000, help="current of a coil with nothing before it (synthetic)")
    engaged_ma: float = quantity(70.0, unit="mA", low=0, high=8000, help="more when engaged; paper: beyond 70 in all (synthetic)")
    engage_m: float = quantity(0.020, unit="m", low=1e-4, high=1, help="gap over which that falls to a third (synthetic)")
    engage_side_m: float = quantity(0.025, unit="m", low=1e-4, high=1, help="lateral error likewise (synthetic)")
    surge_ma: float = quantity(150.0, unit="mA", low=0, high=8000, help="transient when a coil is switched (synthetic)")
    surge_s: float = quantity(0.05, unit="s", low=1e-3, high=10, help="its decay (synthetic)")


@dataclass(frozen=True, slots=True, kw_only=True)
class JamRule:
    """Probability that a contact jams: one value within all limits, another outside any of them (rule from the issue)."""

    lateral_m: float = quantity(0.004, unit="m", low=0, high=1, help="lateral error at contact")
    speed_m_s: float = quantity(0.060, unit="m/s", low=0, high=10, help="closing speed at contact")
    tilt_deg: float = quantity(5.0, unit="deg", low=0, high=90, help="tilt at contact")
    probability_outside: float = quantity(0.5, low=0, high=1, help="beyond any of these")
    probability_inside: float = quantity(0.02, low=0, high=1, help="within all of these")
    shallowest: float = quantity(0.3, low=0, high=1, help="a jam stops the probe at this share of its length at least (synthetic)")

    def probability(self, lateral_m: float, speed_m_s: float, tilt_deg: float) -> float:
        """Probability, 0 to 1, that a probe jams when it meets the funnel with these errors."""
        inside = lateral_m <= self.lateral_m and speed_m_s <= self.speed_m_s and tilt_deg <= self.tilt_deg
        return self.probability_inside if inside else self.probability_outside
