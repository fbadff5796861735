"""Power space and thrust variance against ERRATA's figures."""

import dataclasses

import numpy as np
import pytest

from firmware_py.core.thruster import total_power
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.capability.layout import FRAMES, Layout, of_vehicle
from firmware_py.prepare.capability.power import electrical_power, least_squares_forces, power_space
from firmware_py.prepare.capability.sphere import fibonacci
from tests.unit.capability_layouts import one_of_seven, raw

AUTHORS = {"A_single": 1, "B_double_line": 2, "C_quad_2x2": 4}


def mean_square_effort(layout: Layout, frame: str) -> float:
    """Mean over unit directions of sum f^2, N^2 per N^2 or per (N m)^2."""
    return power_space(layout, frame, fibonacci(121)).variance * layout.count


@pytest.mark.parametrize(("name", "modules"), AUTHORS.items())
def test_unit_force_costs_five_twelfths_over_the_modules(name: str, modules: int) -> None:
    assert mean_square_effort(raw(name), "force") == pytest.approx(5 / 12 / modules, rel=1e-6)


@pytest.mark.parametrize(("name", "torque"), [("A_single", 41.100), ("B_double_line", 11.424), ("C_quad_2x2", 3.8615)])
def test_unit_torque_costs_what_is_known(name: str, torque: float) -> None:
    assert mean_square_effort(raw(name), "torque") == pytest.approx(torque, rel=2e-5)


def test_papers_own_thrusters_cost_what_is_known() -> None:
    assert mean_square_effort(raw("A45_single"), "force") == pytest.approx(0.4445, rel=3e-4)
    assert mean_square_effort(raw("A45_single"), "torque") == pytest.approx(96.4, rel=5e-4)


def test_thrust_variance_falls_as_sixteen_to_four_to_one() -> None:
    variance = [power_space(raw(name), "force", fibonacci(500)).variance for name in AUTHORS]
    assert np.array(variance) / variance[2] == pytest.approx([16.0, 4.0, 1.0], rel=1e-9)


def test_variance_in_closed_form_is_that_of_the_sampled_forces() -> None:
    for frame in FRAMES:
        space = power_space(one_of_seven("modcube_sim"), frame, fibonacci(4000), 2.5)
        assert space.forces.var() == pytest.approx(space.variance, rel=1e-3)


def test_degenerate_vehicle_shows_how_far_it_misses_the_wrench() -> None:
    layout = one_of_seven("bluerov2")
    missed = power_space(layout, "torque", fibonacci(500)).residual
    assert missed == pytest.approx(1.0, abs=1e-2)  # pure pitch cannot be produced at all
    assert power_space(layout.with_passive_declared(), "force", fibonacci(500)).residual < 1e-9
    assert power_space(one_of_seven("modcube_sim"), "torque", fibonacci(500)).residual < 1e-9


def test_power_is_that_of_the_thrusters_curves() -> None:
    vehicle = load_vehicle("bluerov2_heavy")
    layout = of_vehicle(vehicle)
    forces = np.random.default_rng(3).uniform(-40.0, 50.0, (20, 8))
    each = [np.ascontiguousarray(np.array(a)) for a in (layout.power_forward, layout.power_reverse)]
    assert electrical_power(layout, forces) == pytest.approx([total_power(f, *each) for f in forces])
    assert electrical_power(layout, np.zeros((1, 8)))[0] == 0.0


def test_thruster_without_a_power_curve_has_no_power_figure() -> None:
    layout = dataclasses.replace(raw("A_single"), power_forward=np.zeros((8, 0)), power_reverse=np.zeros((8, 0)))
    assert np.isnan(power_space(layout, "force", fibonacci(200)).power_w).all()


def test_wrench_beyond_the_thrusters_is_counted() -> None:
    assert power_space(one_of_seven("modcube_sim"), "force", fibonacci(300), 1.0).over_limit == 0.0
    assert power_space(one_of_seven("modcube_sim"), "force", fibonacci(300), 100.0).over_limit == 1.0


def test_saturated_wrench_is_met_within_limits() -> None:
    layout = of_vehicle(load_vehicle("modcube"))
    wrench = np.array([[20.0, 8.0, 0.0, 0.0, 1.0, 0.0]])
    naive = wrench @ np.linalg.pinv(layout.matrix).T
    forces = least_squares_forces(layout, wrench)
    assert np.any(naive < layout.f_min) or np.any(naive > layout.f_max)
    assert np.all(forces <= layout.f_max + 1e-9) and np.all(forces >= layout.f_min - 1e-9)
    assert forces @ layout.matrix.T == pytest.approx(wrench, abs=1e-6)
