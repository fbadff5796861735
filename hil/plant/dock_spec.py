"""Parameters of the simulated docking faces: magnets, funnel, contact and jamming. All synthetic unless marked otherwise."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_py.description.schema import quantity


@dataclass(frozen=True, slots=True, kw_only=True)
class DockSpec:
    """Probe and drogue of a pair of faces. The coil of each face acts on the armature magnet of the other: forward pulls, reverse
    pushes. Two forward coils pull with twice the force of one; a forward and a reverse coil cancel."""

    pull_n: float = quantity(
        40.0, unit="N", low=0, high=1e4, help="pull of both coils at zero gap, and holding force of a joint (synthetic)"
    )
    magnet_gap_m: float = quantity(
        0.003, unit="m", low=1e-4, high=1, help="g0 in the decrease of the pull with the gap, 1/(gap + g0)^2 (synthetic)"
    )
    coil_lag_s: float = quantity(0.03, unit="s", low=1e-3, high=10, help="time constant of the coil current (synthetic)")
    probe_m: float = quantity(0.015, unit="m", low=0, high=1, help="gap at which the probe meets the funnel (synthetic)")
    mouth_m: float = quantity(0.025, unit="m", low=0, high=1, help="lateral error above which the probe misses the funnel (synthetic)")
    funnel_deg: float = quantity(50.0, unit="deg", low=0, high=90, help="largest tilt at which the probe enters the funnel (paper)")
    lock_m: float = quantity(0.001, unit="m", low=1e-5, high=0.1, help="gap and lateral error up to which the faces lock (synthetic)")
    lock_deg: float = quantity(1.0, unit="deg", low=0.01, high=45, help="tilt and turn up to which the faces lock (synthetic)")
    rearm_m: float = quantity(0.02, unit="m", low=0, high=1, help="gap above which the probe has left the funnel (synthetic)")
    guide_n_m: float = quantity(2000.0, unit="N/m", low=0, high=1e6, help="lateral stiffness of the funnel (synthetic)")
    guide_ns_m: float = quantity(80.0, unit="N s/m", low=0, high=1e5, help="lateral damping of the funnel (synthetic)")
    turn_nm: float = quantity(15.0, unit="N m/rad", low=0, high=1e5, help="turning stiffness of funnel and pins (synthetic)")
    turn_nms: float = quantity(0.8, unit="N m s", low=0, high=1e4, help="turning damping of funnel and pins (synthetic)")
    stop_n_m: float = quantity(8e4, unit="N/m", low=0, high=1e6, help="stiffness of a probe that is jammed in its funnel (synthetic)")
    stop_ns_m: float = quantity(400.0, unit="N s/m", low=0, high=1e5, help="damping of a probe that is jammed in its funnel (synthetic)")
    contact_n_m3: float = quantity(3.6e6, unit="N/m^3", low=0, high=1e9, help="hull contact: pressure per depth of overlap (synthetic)")
    contact_ns_m3: float = quantity(1.8e4, unit="N s/m^3", low=0, high=1e7, help="hull contact: pressure per closing speed (synthetic)")
    idle_ma: float = quantity(40.0, unit="mA", low=0, high=8000, help="current of an energised coil that is not engaged (synthetic)")
    engaged_ma: float = quantity(
        70.0, unit="mA", low=0, high=8000, help="additional current of a coil when engaged; paper: above 70 mA in total (synthetic)"
    )
    engage_m: float = quantity(
        0.020, unit="m", low=1e-4, high=1, help="gap over which the additional engaged current falls to a third (synthetic)"
    )
    engage_side_m: float = quantity(
        0.025, unit="m", low=1e-4, high=1, help="lateral error over which the additional engaged current falls to a third (synthetic)"
    )
    surge_ma: float = quantity(150.0, unit="mA", low=0, high=8000, help="transient of the current when a coil is switched (synthetic)")
    surge_s: float = quantity(0.05, unit="s", low=1e-3, high=10, help="decay time constant of the switching transient (synthetic)")


@dataclass(frozen=True, slots=True, kw_only=True)
class JamRule:
    """Probability that a contact jams: one value within all limits, another outside any of them (rule from the issue)."""

    lateral_m: float = quantity(0.004, unit="m", low=0, high=1, help="largest lateral error at contact without increased risk of a jam")
    speed_m_s: float = quantity(0.060, unit="m/s", low=0, high=10, help="largest closing speed at contact without increased risk of a jam")
    tilt_deg: float = quantity(5.0, unit="deg", low=0, high=90, help="largest tilt at contact without increased risk of a jam")
    probability_outside: float = quantity(
        0.5, low=0, high=1, help="probability of a jam above any of the limits of lateral error, speed and tilt"
    )
    probability_inside: float = quantity(
        0.02, low=0, high=1, help="probability of a jam within all limits of lateral error, speed and tilt"
    )
    shallowest: float = quantity(0.3, low=0, high=1, help="smallest gap at which a jam stops the probe, as a share of probe_m (synthetic)")

    def probability(self, lateral_m: float, speed_m_s: float, tilt_deg: float) -> float:
        """Probability, 0 to 1, that a probe jams when it meets the funnel with these errors."""
        inside = lateral_m <= self.lateral_m and speed_m_s <= self.speed_m_s and tilt_deg <= self.tilt_deg
        return self.probability_inside if inside else self.probability_outside
