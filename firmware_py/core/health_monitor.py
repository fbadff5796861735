"""Keeps the health of a body from tick to tick: ages, running means and last reports, from module reports and the estimate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from firmware_py.core.body import Body, axes_without_thrust
from firmware_py.core.esc_feedback import ESC_DOWN
from firmware_py.core.faults import by_channel
from firmware_py.core.fence import outside
from firmware_py.core.health import Health
from firmware_py.core.module_reports import ModuleReports
from firmware_py.core.names import Place, places_of
from firmware_py.core.rotations import difference, rotate
from firmware_py.core.thruster_state import ThrusterFaults
from firmware_py.core.types import (
    MCU_ESTOP,
    MCU_UNFIT,
    NEVER_NS,
    Action,
    DockRequest,
    EscFeedback,
    Estimate,
    Inputs,
    ModuleInputs,
    Request,
    Setpoint,
)  # fmt: skip
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import AXES

MEAN_S = 1.0
"""Time over which rates and shares are averaged."""
DRY_NS = 3_000_000_000
"""How long a leak sensor must read dry, after two wet readings in a row, until the cabin counts as dry: water in it moves about. ArduSub
waits as long."""
FOREIGN_NS = 1_000_000_000
"""How long a foreign frame is remembered. A sender as slow as once a second still counts as present throughout."""
TAG_SHARE = 1.0 / 60.0
"""Weight of one tag observation in a one-second mean: tags come at 60 Hz."""
MOST_CURRENT_M_S = 10.0
"""A faster current is no push but a false estimate, and leaves the mean as it is: with one NaN in it, no push would be noticed any more.
Upon a module it would push with 2 kN; a hand or a wall does with 140 N, as 2.5 m/s would."""
VOLTAGE_SHARE = 0.2
"""Weight of one supply voltage reading; they come at 10 Hz, which makes it a half-second mean."""


@dataclass(slots=True)
class _Latest:
    """State that a new body inherits from the bodies it was made of: the largest of each figure, which is the latest or the worst."""

    time_ns: int = NEVER_NS
    """Time of the last tick."""
    start_ns: int = NEVER_NS
    """Time of the first tick."""
    ready_ns: int = NEVER_NS
    """When an attitude was last known."""
    foreign_sync_ns: int = NEVER_NS
    foreign_command_ns: int = NEVER_NS
    estop_box_ns: int = NEVER_NS
    ground_ns: int = NEVER_NS
    pilot_ns: int = NEVER_NS
    stick: float = 0.0
    dropped_frames: int = 0
    error_rate: float = 0.0
    bus_load: float = 0.0
    missed_percent: float = 0.0
    push_m2_s2: float = 0.0
    off_rad2: float = 0.0
    off_m2: float = 0.0


class HealthMonitor:
    """Keeps the ages and running means of one body."""

    def __init__(self, body: Body, parameters: Parameters, period_ns: int) -> None:
        self._period_ns = period_ns
        self._nominal_v = dict(zip(body.modules, body.nominal_v.tolist(), strict=True))
        self._drag = body.drag.mean, float(body.drag.linear[:3].mean())
        self._thruster_at = dict(zip(body.modules, by_channel(body), strict=True))
        self._without_thrust = tuple(AXES[axis] for axis in axes_without_thrust(body.thrusters.matrix, body.passive))
        self._places = places_of(body)
        self._esc_ns = [NEVER_NS] * len(self._places)
        self._unknown_esc_ns: dict[Place, int] = {}
        """When an ESC was last heard that belongs to no thruster, by its place."""
        self._reports = ModuleReports(body.modules)
        self._stopped_ns: dict[int, int] = {}
        """By fleet index: when a module last reported being held by an e-stop. A module that reports otherwise is removed."""
        self._latest = _Latest()
        self._nis_ratio, self._rejected_share = 1.0, 0.0
        self._rejected, self._tag_ns = 0, NEVER_NS
        self._pictures_ns = (NEVER_NS, NEVER_NS)
        self.now: Health
        self.believed: Sequence[ModuleInputs] = ()
        """Inputs of the fleet's modules in this tick, without samples that are not trusted; set by the code that watches the sensors."""
        self.open_joints: tuple[DockRequest, ...] = ()
        """Set by the code that watches the docked faces."""
        self.collision_s = math.nan
        """Set by the code that compares the motions of all bodies."""
        self.warm = False
        """Set by the pipeline once every stage has run: from then on nothing is compiled or read from disk in a tick."""
        self.retune(parameters)

    def retune(self, parameters: Parameters) -> None:
        """Applies new limits from this tick on."""
        self._fence = parameters.fence
        self._answer_ns = round(parameters.supervision.answer_ms * 1e6)
        self._esc_fresh_ns = round(parameters.supervision.esc_fresh_ms * 1e6)

    def take_over(self, before: Sequence[HealthMonitor]) -> None:
        """Inherits from the bodies that this one is made of, or was part of: the last reports of each module, what was believed of it in
        this tick, and `_Latest`.
        """
        believed = {m: said for other in before for m, said in enumerate(other.believed) if m in other._reports.heard_ns}
        self.believed = [believed.get(module, said) for module, said in enumerate(before[0].believed)]
        for other in before:
            self._stopped_ns |= other._stopped_ns
            self._unknown_esc_ns |= {at: ns for at, ns in other._unknown_esc_ns.items() if at.module in self._thruster_at}
            self._reports.take_over(other._reports)
            for module, thrusters in self._thruster_at.items():
                for channel, thruster in other._thruster_at.get(module, {}).items():
                    self._esc_ns[thrusters[channel]] = other._esc_ns[thruster]
        self._latest = _Latest(*map(max, zip(*(astuple(other._latest) for other in before), strict=True)))

    def step(self, inputs: Inputs, estimate: Estimate, requests: list[Request], faults: ThrusterFaults) -> Health:
        """Returns the figures of this tick, and stores them in `now`."""
        now, latest = inputs.time_ns, self._latest
        if latest.time_ns == NEVER_NS:  # first tick: silence counts from here
            latest.time_ns = latest.start_ns = latest.ready_ns = now
            for heard_ns in (self._reports.heard_ns, self._reports.hears_ns, self._reports.imu_ns):
                heard_ns.update(dict.fromkeys(heard_ns, now))
        self._listen(inputs.modules, now)
        self._hear_stops(inputs.modules, now)
        if estimate.ready:
            latest.ready_ns = now
        if inputs.foreign_sync:
            latest.foreign_sync_ns = now
        if inputs.foreign_command:
            latest.foreign_command_ns = now
        if inputs.estop_box:
            latest.estop_box_ns = now
        self._hear_operators(requests, now)
        self._rates(inputs, estimate, (now - latest.time_ns) * 1e-9)
        self._judge_tags(estimate, now)
        stopped_ns = now - latest.time_ns - self._period_ns
        latest.time_ns = now
        self.now = self._figures(estimate, faults, stopped_ns)
        return self.now

    def _figures(self, estimate: Estimate, faults: ThrusterFaults, stopped_ns: int) -> Health:
        """Returns all figures at the end of the tick. `stopped_ns`: by how much the tick began later than a period after the last one."""
        now, latest = self._latest.time_ns, self._latest
        silent = tuple([m for m, at in self._reports.answered_ns.items() if now - at > self._answer_ns])
        return Health(
            time_ns=now,
            ready=estimate.ready,
            tag_age_s=estimate.tag_age_ns * 1e-9,
            sigma_m=max(estimate.sigma_p.tolist()),
            nis_ratio=self._nis_ratio,
            rejected_share=self._rejected_share,
            depth_age_s=(now - max(self._reports.pressure_ns.values(), default=latest.start_ns)) * 1e-9,
            depth_heard=len(self._reports.pressure_ns) > 0,
            imu_age_s=(now - max(self._reports.imu_ns.values())) * 1e-9,
            sensor_age_s=self._sensor_age_s(now),
            voltage_share=min(self._reports.voltage_share.values(), default=math.nan),
            leak=any(self._reports.leak.values()),
            cabin_c=max(self._reports.cabin_c.values(), default=math.nan),
            cabin_change_pa=max(self._reports.cabin_change_pa.values(), default=math.nan),
            stopped=tuple([m for m, at in self._stopped_ns.items() if m in self._reports.heard_ns or now - at <= self._answer_ns]),
            silent=silent,
            silent_s=(now - min(self._reports.hears_ns.values())) * 1e-9,
            bus_silent_s=max(now - max(self._reports.heard_ns.values()), stopped_ns) * 1e-9,
            esc_missing=tuple([self._places[i] for i in _older(self._esc_ns, now - self._esc_fresh_ns)]),
            frame_errors_per_s=latest.error_rate,
            bus_load=latest.bus_load / -math.expm1((latest.start_ns - now - self._period_ns) * 1e-9 / MEAN_S),
            missed_percent=latest.missed_percent,
            foreign_sync=now - latest.foreign_sync_ns <= FOREIGN_NS,
            foreign_command=now - latest.foreign_command_ns <= FOREIGN_NS,
            ground_age_s=_age_s(latest.ground_ns, now),
            pilot_age_s=_age_s(latest.pilot_ns, now),
            stick=latest.stick,
            outside_m=outside(estimate.p_wb, self._fence) if estimate.placed else math.nan,
            dead=faults.dead,
            lost_axes=faults.lost_axes,
            warm=self.warm,
            open_joints=self.open_joints,
            tag_gap_s=self._tag_gap_s(now),
            unfit=tuple([m for m, unfit in self._reports.unfit.items() if unfit]),
            battery_age_s=(now - min(self._reports.battery_ns.values())) * 1e-9,
            cabin_age_s=(now - min(self._reports.cabin_ns.values())) * 1e-9,
            push_m_s=math.sqrt(latest.push_m2_s2),
            esc_unknown=tuple([at for at, ns in self._unknown_esc_ns.items() if now - ns <= self._esc_fresh_ns]),
            collision_s=self.collision_s,
            unready_s=(now - latest.ready_ns) * 1e-9,
            without_thrust=self._without_thrust,
            late=tuple([m for m in silent if now - self._reports.late_ns[m] <= self._answer_ns]),
            still_s=min(at - self._reports.hears_ns[m] for m, at in self._reports.heard_ns.items()) * 1e-9,
            estop_box_age_s=_age_s(latest.estop_box_ns, now),
            attitude_off_deg=math.degrees(math.sqrt(latest.off_rad2)),
            place_off_m=math.sqrt(latest.off_m2),
            reports=self._reports,
        )

    def compare(self, setpoint: Setpoint, estimate: Estimate, keep: np.ndarray) -> None:
        """Notes how far the body is from its set-point and turned from it, while that is known. `keep`: (6, 6) ThrusterFaults.keep."""
        if not estimate.ready:
            return
        latest, share = self._latest, 1e-9 * self._period_ns / MEAN_S
        off_m, off_rad = setpoint.p_wb - estimate.p_wb, keep[3:, 3:] @ difference(setpoint.q_wb, estimate.q_wb)
        latest.off_m2 += share * (off_m.dot(off_m) - latest.off_m2)
        latest.off_rad2 += share * (off_rad.dot(off_rad) - latest.off_rad2)

    def _listen(self, modules: Sequence[ModuleInputs], now: int) -> None:
        for index in self._reports.heard_ns:
            module = modules[index]
            if module.answered:
                self._reports.heard_ns[index] = self._reports.answered_ns[index] = now
            elif module.heard:
                self._reports.heard_ns[index] = now
            if module.mcu_state is not None:
                self._reports.unfit[index] = module.mcu_state in MCU_UNFIT
                if not module.answered:
                    self._reports.late_ns[index] = now
            if self._reports.heard_ns[index] == now and not self._reports.unfit[index]:
                self._reports.hears_ns[index] = now
            believed = self.believed[index]
            if believed.gyro is not None and believed.accel is not None:
                self._reports.imu_ns[index] = now
            if believed.pressure_pa is not None:
                self._reports.pressure_ns[index] = now
            for tag in module.tags:
                if tag.capture_ns > self._pictures_ns[1]:
                    self._pictures_ns = self._pictures_ns[1], tag.capture_ns
            if module.leak is not None:
                self._reports.wet_ns[index] = now if module.leak and self._reports.wet[index] else self._reports.wet_ns[index]
                self._reports.leak[index] = module.leak or now - self._reports.wet_ns[index] < DRY_NS
                self._reports.wet[index] = module.leak
            if module.voltage_v is not None and math.isfinite(module.voltage_v):
                self._reports.battery_ns[index] = now
                share = module.voltage_v / self._nominal_v[index]
                before = self._reports.voltage_share.get(index, share)
                self._reports.voltage_share[index] = before + VOLTAGE_SHARE * (share - before)
            if module.cabin_temperature_c is not None and math.isfinite(module.cabin_temperature_c):
                self._reports.cabin_ns[index] = now
                self._reports.cabin_c[index] = module.cabin_temperature_c
            if module.cabin_pressure_pa is not None and math.isfinite(module.cabin_pressure_pa):
                start = self._reports.cabin_start_pa.setdefault(index, module.cabin_pressure_pa)
                self._reports.cabin_change_pa[index] = abs(module.cabin_pressure_pa - start)
            if module.esc:
                self._hear_escs(index, module.esc, now)

    def _hear_stops(self, modules: Sequence[ModuleInputs], now: int) -> None:
        """Notes e-stop reports of the whole fleet: an ESTOP on one bus stops bodies on the others too, even if only a module heard it."""
        for index, module in enumerate(modules):
            if module.mcu_state == MCU_ESTOP:
                self._stopped_ns[index] = now
            elif module.mcu_state is not None:
                self._stopped_ns.pop(index, None)

    def _sensor_age_s(self, now: int) -> float:
        imu_ns, pressure_ns = self._reports.imu_ns, self._reports.pressure_ns
        return (now - min(*imu_ns.values(), *pressure_ns.values())) * 1e-9 if len(imu_ns) > 1 else math.nan

    def _tag_gap_s(self, now: int) -> float:
        """Returns the time between the last two tag pictures; NaN once the next one is overdue (twice that time)."""
        before_ns, last_ns = self._pictures_ns
        gap_ns = last_ns - before_ns
        return gap_ns * 1e-9 if before_ns != NEVER_NS and now - last_ns <= 2 * gap_ns else math.nan

    def _hear_escs(self, module: int, escs: list[EscFeedback], now: int) -> None:
        thruster_at = self._thruster_at[module]
        for esc in escs:
            for channel, status in enumerate(esc.status, esc.first):
                if status in ESC_DOWN:
                    continue
                if channel in thruster_at:
                    self._esc_ns[thruster_at[channel]] = now
                else:
                    self._unknown_esc_ns[Place(module, channel)] = now

    def _hear_operators(self, requests: list[Request], now: int) -> None:
        for request in requests:
            if request.action == Action.GROUND_ALIVE:
                self._latest.ground_ns = now
            elif request.action == Action.STICKS:
                self._latest.pilot_ns = now
                self._latest.stick = max(abs(value) for group in request.argument for value in group)

    def _rates(self, inputs: Inputs, estimate: Estimate, dt_s: float) -> None:
        """Updates the one-second means: bad frames, bus load, missed ticks, and the push as an equivalent current."""
        latest, keep = self._latest, math.exp(-dt_s / MEAN_S)
        errors, latest.dropped_frames = inputs.dropped_frames - latest.dropped_frames, inputs.dropped_frames
        latest.error_rate = keep * latest.error_rate + errors / MEAN_S
        latest.bus_load = keep * latest.bus_load + inputs.busy_s / MEAN_S
        missed = max(0, round(dt_s * 1e9 / self._period_ns) - 1)
        latest.missed_percent = keep * latest.missed_percent + 1e-7 * missed * self._period_ns / MEAN_S
        current_m_s = _current_m_s(*_pushed(estimate), *self._drag)
        if abs(current_m_s) <= MOST_CURRENT_M_S:  # not where it is NaN
            latest.push_m2_s2 += (1.0 - keep) * (current_m_s**2 - latest.push_m2_s2)

    def _judge_tags(self, estimate: Estimate, now: int) -> None:
        """Updates the means over the tags of about a second: NIS ratio, and share of refused tags."""
        refused, self._rejected = estimate.rejected - self._rejected, estimate.rejected
        before_ns, self._tag_ns = self._tag_ns, now - estimate.tag_age_ns
        taken = estimate.ready and refused == 0 and self._tag_ns > before_ns  # the paper's estimator reports no NIS
        if estimate.nis_dof:
            self._nis_ratio += TAG_SHARE * (estimate.nis / estimate.nis_dof - self._nis_ratio)
        if estimate.nis_dof or taken:
            self._rejected_share -= TAG_SHARE * self._rejected_share
        if refused > 0:
            self._rejected_share += TAG_SHARE * (1.0 - self._rejected_share)


def _age_s(at_ns: int, now_ns: int) -> float:
    return math.nan if at_ns == NEVER_NS else (now_ns - at_ns) * 1e-9


def _pushed(estimate: Estimate) -> tuple[float, float]:
    """Returns the horizontal disturbance force, N, and the speed over ground along it, m/s."""
    (north_n, east_n, _), v_w = estimate.force_w.tolist(), rotate(estimate.q_wb, estimate.nu[:3].copy()).tolist()
    push_n = math.hypot(north_n, east_n)
    return push_n, (north_n * v_w[0] + east_n * v_w[1]) / push_n if push_n > 0.0 else 0.0


def _current_m_s(push_n: float, speed_m_s: float, squared: float, linear: float) -> float:
    """Returns the speed of the current that exerts `push_n` on a body that moves along it at `speed_m_s`; 0 without drag.

    Args:
        squared, linear: N s^2/m^2 and N s/m: the drag at v through the water is `squared` v |v| + `linear` v.
    """
    drag_n = (squared * abs(speed_m_s) + linear) * speed_m_s - push_n
    slope = linear + math.sqrt(linear**2 + 4.0 * squared * abs(drag_n))
    return speed_m_s - 2.0 * drag_n / slope if slope > 0.0 else 0.0


def _older(times_ns: list[int], oldest_ns: int) -> tuple[int, ...]:
    """Returns the indices of the times before `oldest_ns`."""
    if min(times_ns) >= oldest_ns:
        return ()
    return tuple(i for i, time_ns in enumerate(times_ns) if time_ns < oldest_ns)
