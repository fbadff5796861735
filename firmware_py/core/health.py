"""Health of a body: one row of figures per tick. `health_monitor` keeps them; supervisor and fail-safes judge them.

Unknown figures are NaN, so that no comparison with them holds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from firmware_py.core.module_reports import ModuleReports
from firmware_py.core.names import Place, name_pair
from firmware_py.core.types import DockRequest

NEVER_S = 1e9
"""Ages at or above this mean that nothing ever came."""
UNSEEN_S = 0.5
"""Time without a tag after which the effect of a push counts as unobserved. Longer than the gaps that ordinary frame loss makes."""


class Health(NamedTuple):
    """Health figures of one tick. Ages in s."""

    time_ns: int
    ready: bool
    """Whether an attitude has been found."""
    tag_age_s: float
    sigma_m: float
    """Largest standard deviation of the position, m."""
    nis_ratio: float
    """NIS of tags over its expectation, mean of a second; ideally 1."""
    rejected_share: float
    """Share of tag observations that the gate refused, mean of a second."""
    depth_age_s: float
    """Counts from the start until a pressure reading is heard."""
    depth_heard: bool
    """Whether a pressure reading was ever heard."""
    imu_age_s: float
    """Since the last sample of any module's IMU that is trusted."""
    voltage_share: float
    """Lowest supply voltage of a module over its nominal one; NaN before the first reading."""
    leak: bool
    cabin_c: float
    """Temperature of the hottest cabin; NaN before the first reading."""
    cabin_change_pa: float
    """Largest change of a cabin's pressure since its first reading."""
    stopped: tuple[int, ...]
    """Fleet indices of modules that report being held by an e-stop: those of every body, because an e-stop is meant for all."""
    silent: tuple[int, ...]
    """Fleet indices of modules without a recent answer."""
    silent_s: float
    """Longest present silence of any module; one that reports that it obeys no commands (MCU_UNFIT) counts as silent."""
    bus_silent_s: float
    """Shortest present silence of any module, or the time without a tick before this one if that is longer: a process that was stopped has
    heard nobody meanwhile, whatever it finds when it goes on."""
    esc_missing: tuple[Place, ...]
    """Places of thrusters whose ESC does not answer, or reports a fault."""
    frame_errors_per_s: float
    bus_load: float
    """Share of the fullest bus in use, mean of a second, or of the time since the start."""
    missed_percent: float
    """Share of the ticks that were missed, mean of a second, %."""
    foreign_sync: bool
    foreign_command: bool
    """Whether another node sent SYNC (or commanded modules) in the last second."""
    ground_age_s: float
    """NaN before a ground station was heard."""
    pilot_age_s: float
    """NaN before a pilot was heard."""
    stick: float
    """Largest deflection of any stick axis, 0 to 1."""
    outside_m: float
    """How far the body is beyond the fence; negative inside; NaN without a pose."""
    dead: tuple[int, ...]
    """Indices of thrusters that count as dead or lying."""
    lost_axes: int
    """Rank lost from the thruster matrix because of unusable thrusters."""
    warm: bool
    """Whether every stage has run at least once."""
    tag_gap_s: float = math.nan
    """Time between the last two tag pictures, accepted or not; NaN while none come."""
    battery_age_s: float = 0.0
    """Age of the latest supply reading, for the module where it is oldest. The figures above keep their last values meanwhile."""
    cabin_age_s: float = 0.0
    """The same for cabin readings, whose frame carries the leak sensor too."""
    unfit: tuple[int, ...] = ()
    """Fleet indices of modules that report starting up, hearing no commands, or a fault."""
    open_joints: tuple[DockRequest, ...] = ()
    """Joints that are open although they should hold."""
    push_m_s: float = 0.0
    """Speed of the current that would explain the estimated horizontal disturbance force; RMS over a second."""
    esc_unknown: tuple[Place, ...] = ()
    """Places without a thruster by the vehicle file from which an ESC answers."""
    collision_s: float = math.nan
    """Time after which the body must brake to stop before another that it moves towards (core.collision), s; NaN if there is none."""
    unready_s: float = 0.0
    """Time since an attitude was last known; counts from the start until one is."""
    without_thrust: tuple[str, ...] = ()
    """Axes that no thruster of the body can push although the vehicle does not declare them passive."""
    late: tuple[int, ...] = ()
    """Those of `silent` from which an MCU_STATUS came lately, but of another tick than the one in which it came."""
    still_s: float = 0.0
    """How long every module has reported that it obeys no commands, so that all thrusters stand still. One that is only silent may obey."""
    sensor_age_s: float = math.nan
    """Age of the latest trusted IMU sample, or pressure where a sensor was heard, of the module where it is oldest; NaN for a body of one
    module, whose ages are those above.
    """
    estop_box_age_s: float = math.nan
    """NaN before an e-stop box was heard."""
    attitude_off_deg: float = 0.0
    """Angle between the body and its set-point, about axes that its thrusters can turn, deg; RMS over a second, because a body that swings
    passes its set-point again and again."""
    place_off_m: float = 0.0
    """Distance of the body from its set-point, m; RMS over a second."""
    reports: ModuleReports = ModuleReports([0])
    """Of every module, the last ones: they go on changing. They name the modules behind the figures above."""

    @property
    def unseen_push_m_s(self) -> float:
        """`push_m_s` while no tag is seen, else 0. Without tags the estimator cannot tell an unmodelled push (a wall, a hand) from a
        velocity: both look the same to the accelerometer, and both estimates run away together.
        """
        return self.push_m_s if self.tag_age_s > UNSEEN_S else 0.0

    @property
    def placed(self) -> bool:
        """Whether tags have given heading and position."""
        return self.ready and self.tag_age_s < NEVER_S

    @property
    def depth_unknown_s(self) -> float:
        """Age of the newest depth information, from pressure or tag; at least the time without an estimate, which alone makes use of it."""
        return max(min(self.depth_age_s, self.tag_age_s), self.unready_s)

    @property
    def partner_lost(self) -> bool:
        """Whether a docked partner is lost."""
        return len(self.open_joints) > 0

    @property
    def open_joint_words(self) -> str:
        """Names the first open joint and counts the others, for people; empty if there is none."""
        if not self.open_joints:
            return ""
        first, more = self.open_joints[0], len(self.open_joints) - 1
        others = f", and {more} more pairs" if more else ""
        return f"{name_pair(first.target_module, first.module)} do not hold together{others}"

    @property
    def any_late(self) -> bool:
        """Whether any module answers too late, or for another tick."""
        return len(self.late) > 0

    @property
    def thruster_lost(self) -> bool:
        """Whether any thruster counts as dead or lying."""
        return len(self.dead) > 0
