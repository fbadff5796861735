"""The limiter's output never exceeds the limits, for any sequence of requests."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from firmware_py.core.limiter import Limiter
from firmware_py.core.thruster import total_power
from firmware_py.description import parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle

always = settings(derandomize=True, deadline=None, database=None, max_examples=60)
anything = st.floats(allow_nan=True, allow_infinity=True)
wanted = arrays(np.float64, 8, elements=anything | st.floats(-12.0, 12.0))
ticks = st.lists(st.tuples(wanted, st.booleans(), st.floats(0.0, 30.0) | st.floats(7.0, 17.0)), min_size=1, max_size=12)
BODY = assemble_vehicle(load_vehicle("modcube"))


@always
@given(ticks, st.floats(0.05, 1.0), st.floats(1.0, 1e4))
def test_no_history_of_requests_leads_beyond_the_limits(
    history: list[tuple[np.ndarray, bool, float]], share: float, slew: float
) -> None:
    limiter = Limiter(BODY, parameters.Limiter(force_share=share, slew_n_per_s=slew), 0.01)
    t = BODY.thrusters
    before = np.zeros(8)
    for asked, armed, volts in history:
        force, command = limiter.step(asked, armed, np.array([volts]))
        assert np.all(force <= t.f_max * share) and np.all(force >= t.f_min * share)
        scale = (volts / 12.0) ** 1.2 if 7.2 < volts < 16.8 else 1.0
        for i in np.flatnonzero(np.abs(command) >= 1.0):
            curve = t.forward[i] if force[i] > 0.0 else t.reverse[i]
            assert abs(force[i]) <= scale * curve.sum() * (1 + 1e-9)
        assert np.isfinite(command).all() and np.all(np.abs(command) <= 1.0)
        assert total_power(force, t.power_forward, t.power_reverse) <= BODY.supply_power_w[0] * (1 + 1e-12)
        if armed:
            farther = np.abs(force) > np.abs(before)
            assert np.all(np.abs(force - before)[farther] <= slew * 0.01 * (1 + 1e-9) + 1e-12)
        else:
            assert not force.any() and not command.any()
        assert np.all((command == 0.0) | (np.sign(command) == np.sign(force)))
        before = force
