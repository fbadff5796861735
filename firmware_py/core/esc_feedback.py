"""What the feedback of an ESC shows: that the ESC failed, that its propeller stands still or turns wrongly. Part of `faults`."""

from __future__ import annotations

import math

from numba import njit

from firmware_py.core.rotations import M, V

ESC_DOWN = (1, 3)
"""EscStatus FAULT and SILENT."""
WHY = ("has an ESC that failed", "stands still", "does not obey")
ESC_FAILED, STALLED, WRONG_SPEED = range(len(WHY))
"""Faults that enough ESC feedbacks in a row may show, gravest first."""
FAST_SHARE = 2.0
"""A propeller does not obey if it turns faster than this multiple of its believed speed plus `FAST_MARGIN`."""
FAST_MARGIN = 0.25
"""Margin for a speed that is too high or of the wrong sign, as a share of full speed: deadband and lag explain smaller deviations."""
EXCESS = 2.5
"""A propeller does not obey either if the force that belongs to its speed exceeds this multiple of the believed one, both now and in the
running mean, in which a deadband or a lag counts for little. On the bench the mean of a healthy one is at most 1.1 with sticks thrown
about, at 50 to 400 Hz and with frames 40 ms late, and 1.3 with 60 % of them lost; that of a girona500, whose deadband the bench does
not know, is 2.3."""
CLEAR = 4.0
"""A repeated standstill counts twice where the believed force is at least this many times the least judged force: the propeller is not
just about to start."""
FEEDBACK_WEIGHT = 0.3
"""Weight of one ESC feedback in the running share of force that a thruster reports. Ten to thirteen are judged per second
(`faults.REPORT_NS`), which gives a memory of 0.3 s: less than the half second of motion that core.missing_thrust judges."""


@njit(f"float64(float64,{V},float64)", cache=True)
def believed_rpm(force_n, full_n, rpm_at_full):  # type: ignore[no-untyped-def]
    """Returns the speed of a thruster at a force, 1/min; thrust grows with its square. full_n: (2,) full force forward, reverse."""
    return math.copysign(rpm_at_full * math.sqrt(abs(force_n) / full_n[0 if force_n > 0.0 else 1]), force_n)


@njit(f"boolean(float64[:,:,::1],{V},boolean[::1],{M},{V},{V},float64,int64[::1],int64[:,::1],{M},{V})", cache=True)
def count_feedback(feedback, force_n, alive, full_n, rpm_at_full, least_n, dead_share, needed, counts, means, share):  # type: ignore[no-untyped-def]
    """Updates fault counts and force shares from ESC feedback; returns whether any thruster has shown a fault often enough.

    Args:
        feedback: (k, 3, 2) per frame the indices (-1: none), speeds 1/min and EscStatus of its two thrusters.
        force_n, alive, full_n, rpm_at_full: per thruster believed force, whether usable, full forces (n, 2), full speed.
        least_n: (n,) smallest believed force at which a standstill or an excess is judged, N; dead_share: the parameter.
        needed: (3,) feedbacks in a row that suffice for ESC_FAILED, STALLED, WRONG_SPEED.
        counts: (n, 3) feedbacks in a row that showed ESC_FAILED, STALLED, WRONG_SPEED; a clear STALLED after another one counts twice.
        means: (n, 2) running means of reported times believed force, and of believed force squared, any unit.
        share: (n,) share of the believed force that the speeds report, 0 to 1: a thruster whose ESC reports it as weak is not a liar.
    """
    found = False
    for k in range(feedback.shape[0]):
        for side in range(2):
            i, rpm, status = int(feedback[k, 0, side]), feedback[k, 1, side], int(feedback[k, 2, side])
            if i < 0 or not alive[i]:
                continue
            believed = believed_rpm(force_n[i], full_n[i], rpm_at_full[i])
            count, margin = counts[i], FAST_MARGIN * rpm_at_full[i]
            asked, given = believed * abs(believed), rpm * abs(rpm)  # as believed_rpm: force goes with the square of the speed
            means[i, 0] += FEEDBACK_WEIGHT * (given * asked - means[i, 0])
            means[i, 1] += FEEDBACK_WEIGHT * (asked * asked - means[i, 1])
            share[i] = min(1.0, max(0.0, means[i, 0] / means[i, 1])) if means[i, 1] > 0.0 else 1.0
            failed = status in ESC_DOWN  # which explains any speed
            stands = abs(rpm) < dead_share * abs(believed) and not failed
            wrong_way = rpm * believed < 0.0 and not stands and abs(rpm - believed) > margin
            too_fast = abs(rpm) > FAST_SHARE * abs(believed) + margin
            is_judged = abs(force_n[i]) >= least_n[i]
            exceeds = is_judged and given * asked > EXCESS * asked * asked and means[i, 0] > EXCESS * means[i, 1]
            count[ESC_FAILED] = count[ESC_FAILED] + 1 if failed else 0
            if is_judged:
                step = 2 if count[STALLED] > 0 and abs(force_n[i]) >= CLEAR * least_n[i] else 1
                count[STALLED] = count[STALLED] + step if stands else 0
            count[WRONG_SPEED] = count[WRONG_SPEED] + 1 if (wrong_way or too_fast or exceeds) and not failed else 0
            for kind in range(len(WHY)):
                found = found or count[kind] >= needed[kind]
    return found
