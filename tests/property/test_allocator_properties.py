"""For any wrench and any dead thruster, the allocator stays within limits and keeps the directions of force and moment."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from firmware_py.core.allocator import Allocator
from firmware_py.description.parameters import Allocation
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle

always = settings(derandomize=True, deadline=None, database=None, max_examples=100)
BODY = assemble_vehicle(load_vehicle("modcube"))
forces = arrays(np.float64, 3, elements=st.floats(-200.0, 200.0))
moments = arrays(np.float64, 3, elements=st.floats(-10.0, 10.0))
dead = st.none() | st.integers(0, 7)


@always
@given(forces, moments, dead)
def test_no_wrench_leads_beyond_limits_or_off_its_directions(force: np.ndarray, moment: np.ndarray, lost: int) -> None:
    allocator = Allocator(BODY, Allocation())
    if lost is not None:
        allocator.set_alive(np.arange(8) != lost)
    wrench = np.r_[force, moment]
    thrust = allocator.step(wrench)
    t = BODY.thrusters
    assert np.all(thrust.force_n <= t.f_max) and np.all(thrust.force_n >= t.f_min)
    assert lost is None or thrust.force_n[lost] == 0.0
    assert all(-1e-9 <= share <= 1.0 + 1e-5 for share in thrust.scale)
    np.testing.assert_allclose(thrust.achieved, t.matrix @ thrust.force_n, atol=1e-9)
    expected = np.r_[thrust.scale[0] * force, thrust.scale[1] * moment]
    np.testing.assert_allclose(thrust.achieved, expected, atol=1e-5)


@always
@given(forces, moments)
def test_same_wrench_gets_the_same_forces_whatever_came_before(force: np.ndarray, moment: np.ndarray) -> None:
    allocator, fresh = Allocator(BODY, Allocation()), Allocator(BODY, Allocation())
    allocator.step(np.r_[-force, moment])
    wrench = np.r_[force, moment]
    assert allocator.step(wrench).force_n.tobytes() == fresh.step(wrench).force_n.tobytes()
