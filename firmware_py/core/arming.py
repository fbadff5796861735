"""Table of arming checks, each with its reason in words, and the check of what each mode needs. Only the supervisor uses them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from firmware_py.core.alignment import AGREE_S
from firmware_py.core.failsafes import Failsafes
from firmware_py.core.health import NEVER_S, Health
from firmware_py.core.names import list_thrusters, name_modules
from firmware_py.core.transitions import MODES, Need
from firmware_py.core.types import Mode
from firmware_py.description.parameter_rules import contradictions
from firmware_py.description.parameters import Parameters, invalid


class Question(NamedTuple):
    """Inputs of an arming check."""

    health: Health
    mode: Mode
    """Mode that the body would be armed in."""
    parameters: Parameters
    failsafes: Failsafes
    estop_age_ms: float


class Check(NamedTuple):
    """One arming check."""

    name: str
    reason: Callable[[Question], str | list[str]]
    """Returns why the check fails, in words; empty when it passes."""
    may_be_skipped: bool
    """Whether forced arming skips the check."""


def _estop(q: Question) -> str:
    """Fails while an e-stop is raised or still holds a module. A module releases once it hears, some time after the last ESTOP frame, that
    it is disarmed.
    """
    if q.estop_age_ms < q.parameters.supervision.estop_quiet_ms:
        return "e-stop raised"
    return f"an e-stop holds {name_modules(q.health.stopped)}" if q.health.stopped else ""


def _estop_box(q: Question) -> str:
    """Fails until an e-stop box that the robot should have is heard; its later silence is a fail-safe's."""
    return "no e-stop box was heard" if q.parameters.supervision.estop_box and math.isnan(q.health.estop_box_age_s) else ""


def _answers(q: Question) -> list[str]:
    late, mute = q.health.late, [m for m in q.health.silent if m not in q.health.late]
    kinds = (mute, "does not answer"), (late, "answers too late, or for another tick")
    return [f"{name_modules(which)} {what}" for which, what in kinds if which]


def _fit(q: Question) -> str:
    return f"{name_modules(q.health.unfit)} starts, hears no commands, or has a fault" if q.health.unfit else ""


def _needs(q: Question) -> list[str]:
    return missing(q.mode, q.health, q.parameters)


def _has_pose(q: Question) -> bool:
    """Whether the mode needs a pose and has one that can be judged; `_needs` reports a missing pose."""
    return Need.POSITION in MODES[q.mode].needs and not missing(q.mode, q.health, q.parameters)


def _pose_fresh(q: Question) -> str:
    fresh_ms, age_ms = q.parameters.supervision.tag_fresh_ms, q.health.tag_age_s * 1e3
    return f"pose is {age_ms:.0f} ms old, {fresh_ms:.0f} permitted" if _has_pose(q) and age_ms > fresh_ms else ""


def _pose_sure(q: Question) -> str:
    permitted, sigma = q.parameters.supervision.arm_sigma_m, q.health.sigma_m
    sure = sigma <= permitted  # a NaN is not
    return f"pose sigma {sigma * 1e3:.0f} mm, {permitted * 1e3:.0f} permitted" if _has_pose(q) and not sure else ""


def _pose_consistent(q: Question) -> list[str]:
    limits, health, reasons = q.parameters.failsafes, q.health, list[str]()
    if Need.POSITION not in MODES[q.mode].needs:
        return reasons
    if not health.nis_ratio <= limits.estimator_limit:
        reasons.append(f"sensors and model disagree: {health.nis_ratio:.1f} of the expected, {limits.estimator_limit:.1f} permitted")
    if health.rejected_share > limits.rejected_limit:
        reasons.append(f"tags refused: {health.rejected_share:.0%} of them, {limits.rejected_limit:.0%} permitted")
    return reasons


def _sticks(q: Question) -> str:
    steering, age_s = q.parameters.steering, q.health.pilot_age_s
    if age_s <= steering.stick_timeout_s and q.health.stick > steering.stick_dead:
        return "sticks are not neutral"
    return ""


def _escs(q: Question) -> list[str]:
    return [f"ESC {escs} does not answer" for escs in list_thrusters(q.health.esc_missing)]


def _unknown_escs(q: Question) -> list[str]:
    return [f"ESC {escs} answers, but the vehicle file has no thruster there" for escs in list_thrusters(q.health.esc_unknown)]


def _thrusters(q: Question) -> list[str]:
    reasons = [f"{axis} has no thrust: declare it in passive_dof of the vehicle file, or add thrusters" for axis in q.health.without_thrust]
    return reasons + (["the thrusters left cannot make every wrench"] if q.health.lost_axes else [])


def _failsafes(q: Question) -> list[str]:
    return q.failsafes.active(q.health)


def _readings(q: Question) -> list[str]:
    limits, health = q.parameters.failsafes, q.health
    kinds = (
        ("battery", health.battery_age_s, limits.battery_unknown_limit, "battery_ns"),
        ("cabin", health.cabin_age_s, limits.cabin_unknown_limit, "cabin_ns"),
    )
    return [f"{name}{_of_older(health, table, most_s)} was not heard of lately" for name, age_s, most_s, table in kinds if age_s > most_s]


def _of_older(health: Health, table: str, most_s: float) -> str:
    """Returns, in a body of several, which modules have an older report in this table of ModuleReports: " of module 2"."""
    older = sorted(module for module, age_s in health.reports.ages_s(health.time_ns, table).items() if age_s > most_s)
    return f" of {name_modules(older)}" if health.reports.is_of_several else ""


def _frames(q: Question) -> str:
    permitted, rate = q.parameters.supervision.frame_errors_per_s, q.health.frame_errors_per_s
    return f"{rate:.0f} bad frames a second, {permitted:.0f} permitted" if rate > permitted else ""


def _load(q: Question) -> str:
    permitted, load = q.parameters.supervision.bus_load, q.health.bus_load
    return f"bus is {load:.0%} full, {permitted:.0%} permitted" if load > permitted else ""


def _parameters(q: Question) -> list[str]:
    return invalid(q.parameters) + contradictions(q.parameters)


def _warm(q: Question) -> str:
    return "" if q.health.warm else "compiled code is not warm yet"


def _joints(q: Question) -> str:
    return q.health.open_joint_words


CHECKS = (
    Check("e-stop clear", _estop, False),
    Check("e-stop box heard", _estop_box, True),
    Check("modules answer", _answers, False),
    Check("mode has what it needs", _needs, False),
    Check("sticks neutral", _sticks, False),
    Check("parameters valid", _parameters, False),
    Check("compiled code warm", _warm, False),
    Check("pose fresh", _pose_fresh, True),
    Check("pose sure", _pose_sure, True),
    Check("pose consistent", _pose_consistent, True),
    Check("battery and cabin known", _readings, True),
    Check("modules fit", _fit, True),
    Check("every ESC answers", _escs, True),
    Check("no ESC without a thruster", _unknown_escs, True),
    Check("every axis has thrust", _thrusters, True),
    Check("no fail-safe on", _failsafes, True),
    Check("few bad frames", _frames, True),
    Check("bus not full", _load, True),
    Check("topology as configured", _joints, True),
)


def against_arming(question: Question, forced: bool) -> list[str]:
    """Returns the reasons against arming, in words; empty when the body may be armed."""
    reasons: list[str] = []
    for check in CHECKS:
        found = [] if forced and check.may_be_skipped else check.reason(question)
        reasons += [found] if isinstance(found, str) else found
    return [reason for reason in dict.fromkeys(reasons) if reason]


def _seldom(health: Health) -> str:
    """Returns words to add when tags do come, but too far apart to find an unknown position; else empty."""
    return f": tags come {health.tag_gap_s:.2f} s apart, {AGREE_S:.2f} s permitted to tell a place" if health.tag_gap_s > AGREE_S else ""


def missing(mode: Mode, health: Health, parameters: Parameters) -> list[str]:
    """Returns what `mode` needs and does not have, in words."""
    limits, needs = parameters.failsafes, MODES[mode].needs
    reasons = []
    if (Need.ATTITUDE in needs and not health.ready) or (Need.POSITION in needs and not health.placed):
        reasons.append(f"no pose yet{_seldom(health)}")
    elif Need.POSITION in needs and health.tag_age_s > limits.tag_lost_limit:
        reasons.append(f"no tag for {health.tag_age_s:.1f} s{_seldom(health)}")
    depth_age_s = min(health.depth_age_s if health.depth_heard else NEVER_S, health.tag_age_s)
    if Need.DEPTH in needs and depth_age_s > limits.depth_unknown_limit:
        reasons.append("depth unknown")
    if Need.PILOT in needs and health.pilot_age_s > limits.pilot_lost_limit:  # NaN, a pilot never heard, passes: sticks are neutral
        reasons.append("pilot input lost")
    return reasons
