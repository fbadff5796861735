"""Parameters that are in range one by one but not together: no robot is armed with them, and none is given them in flight."""

from __future__ import annotations

from collections.abc import Iterator

from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError

LEAST_DAMPING_S, MOST_RATE_GAIN = 0.06, 50.0
"""Damping ratio over bandwidth, s, below which lag makes a loop swing, and rate gain, 2 * damping * bandwidth, 1/s, above which it does, as
measured in a hover: a damping of 0.3 swings at 7 rad/s and holds at 5, that of 0.5 swings at 10 and holds at 8; rate gains of 70 swing."""
LEAST_SLEW_N = 5.0
"""Slew rate over bandwidth, N, below which a body swings or tumbles: at 12 rad/s 40 N/s do, and 60 hold; at 10 rad/s 20 do, and 30 hold."""


def contradictions(parameters: Parameters) -> list[str]:
    """Reports, in words, parameters that are in range one by one but not together; empty if there are none."""
    return [words for rule in RULES for words in rule(parameters)]


def changed(parameters: Parameters, dotted: str, value: float | str, is_armed: bool) -> Parameters:
    """Returns a copy with `group.field` set. Raises DescriptionError as `Parameters.replace` does, and in flight (`is_armed`) if the copy
    would contradict itself.
    """
    after = parameters.replace(dotted, value)
    if is_armed and (reasons := contradictions(after)):
        raise DescriptionError(f"parameter {dotted} stays while a vehicle is armed: {'; '.join(reasons)}")
    return after


def _fence(parameters: Parameters) -> Iterator[str]:
    fence = parameters.fence
    if fence.top_m >= fence.bottom_m:
        yield f"fence.top_m is {fence.top_m:g}, fence.bottom_m {fence.bottom_m:g}: the top must be at less depth"


def _gains(parameters: Parameters) -> Iterator[str]:
    control = parameters.control
    loops = {
        "position": (control.position_bandwidth, control.position_damping),
        "attitude": (control.attitude_bandwidth, control.attitude_damping),
    }
    for loop, (bandwidth, damping) in loops.items():
        low, high = LEAST_DAMPING_S * bandwidth, MOST_RATE_GAIN / (2.0 * bandwidth)
        if not low <= damping <= high:
            words = f"control.{loop}_damping is {damping:g}, control.{loop}_bandwidth {bandwidth:g} rad/s: the {loop} loop would swing"
            yield f"{words}; damping permitted at this bandwidth: {low:.2g} to {high:.2g}"


def _slew(parameters: Parameters) -> Iterator[str]:
    slew_n_per_s = parameters.limiter.slew_n_per_s
    fastest = max(parameters.control.position_bandwidth, parameters.control.attitude_bandwidth)
    if slew_n_per_s < LEAST_SLEW_N * fastest:
        words = f"limiter.slew_n_per_s is {slew_n_per_s:g} N/s, the larger bandwidth {fastest:g} rad/s: the body would swing or tumble"
        yield f"{words}; at least {LEAST_SLEW_N * fastest:.3g} N/s permitted"


def _hysteresis(parameters: Parameters) -> Iterator[str]:
    threshold_ma, hysteresis_ma = parameters.docking.current_threshold_ma, parameters.docking.current_hysteresis_ma
    if hysteresis_ma >= threshold_ma:
        words = f"docking.current_hysteresis_ma is {hysteresis_ma:g} mA, docking.current_threshold_ma {threshold_ma:g} mA"
        yield f"{words}: the hysteresis must be smaller, or no current would tell that a joint opens"


RULES = (_fence, _gains, _slew, _hysteresis)
