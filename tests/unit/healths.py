"""The health of a body without faults, in which the tests of supervisor and fail-safes change single figures."""

import math

from firmware_py.core.health import NEVER_S, Health

GOOD = Health(
    time_ns=100_000_000_000,
    ready=True,
    tag_age_s=0.02,
    sigma_m=0.002,
    nis_ratio=1.0,
    rejected_share=0.01,
    depth_age_s=0.02,
    depth_heard=True,
    imu_age_s=0.01,
    voltage_share=1.0,
    leak=False,
    cabin_c=30.0,
    cabin_change_pa=0.0,
    stopped=(),
    silent=(),
    silent_s=0.0,
    bus_silent_s=0.0,
    esc_missing=(),
    frame_errors_per_s=0.0,
    bus_load=0.2,
    missed_percent=0.0,
    foreign_sync=False,
    foreign_command=False,
    ground_age_s=math.nan,
    pilot_age_s=0.1,
    stick=0.0,
    outside_m=-50.0,
    dead=(),
    lost_axes=0,
    warm=True,
)

BLIND = GOOD._replace(ready=False, tag_age_s=NEVER_S, sigma_m=1e3, outside_m=math.nan)
"""No tag was ever seen, and gravity has not given the attitude yet."""
UPRIGHT = BLIND._replace(ready=True)
"""No tag was ever seen; the attitude is known from gravity."""


def at(health: Health, seconds: float) -> Health:
    """Returns the same health, `seconds` after `GOOD`."""
    return health._replace(time_ns=GOOD.time_ns + round(seconds * 1e9))
