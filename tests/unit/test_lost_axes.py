"""Axes that a body lacks or has lost with its thrusters: the part of a wrench that is kept, and what the body can still make."""

import dataclasses
import itertools

import numpy as np
import pytest

from firmware_py.core.body import Body
from firmware_py.core.faults import FaultDetector
from firmware_py.core.pipeline import BodyPipeline
from firmware_py.core.rotations import from_euler
from firmware_py.core.thruster_state import steered_rank, thruster_state
from firmware_py.core.types import EscFeedback, Estimate, Measured, ModuleInputs
from firmware_py.description.failsafe_parameters import Faults
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle
from tests.unit.robot_in_water import BODY, TICK_NS, ZERO, Water

LOST_AXES = {(4, 7): 1, (5, 6): 1, (2, 3): 1}
"""The paper's errata: pairs without which axes are lost, and the number of those axes."""


@pytest.mark.parametrize("pair", list(itertools.combinations(range(8), 2)), ids=str)
def test_axes_that_are_lost_with_a_pair_are_those_of_the_errata(pair: tuple[int, int]) -> None:
    water = Water()
    for thruster in pair:
        water.gain[thruster] = water.speed_factor[thruster] = 0.0
    water.run(0.6)
    now = water.detector.now
    assert now.dead == pair and now.lost_axes == LOST_AXES.get(pair, 0)
    matrix = BODY.thrusters.matrix * now.alive
    wrench = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    kept = now.keep @ wrench
    np.testing.assert_allclose(matrix @ np.linalg.pinv(matrix) @ kept, kept, atol=1e-9)
    np.testing.assert_allclose(kept[:3], wrench[:3], atol=1e-9, err_msg="the force, and so the place, is kept")
    assert np.linalg.matrix_rank(now.keep, tol=1e-6) == 6 - now.lost_axes


@pytest.mark.parametrize(("name", "offset_m"), [("bluerov2_heavy", 0.0), ("bluerov2_heavy", 0.001), ("modcube_sim", 0), ("chasing_m2", 0)])
def test_force_that_is_lost_whole_costs_no_moment(name: str, offset_m: float) -> None:
    """A diagonal horizontal pair. Regression: the pseudo-inverse of a rounding error asked for 1e16 N m, and the robot spun."""
    vehicle = load_vehicle(name)
    inertial = dataclasses.replace(vehicle.inertial, com_m=vehicle.inertial.com_m + np.array([0.0, offset_m, 0.0]))
    body = assemble_vehicle(dataclasses.replace(vehicle, inertial=inertial))
    detector = FaultDetector(body, Faults(), TICK_NS)
    failed = [EscFeedback(0, (0.0, 0.0), (0.0, 0.0), (1, 0)), EscFeedback(2, (0.0, 0.0), (0.0, 0.0), (0, 1))]
    nowhere = Estimate(ZERO, from_euler(0.0, 0.0, 0.0), np.zeros(6), ZERO, ZERO, ZERO, ZERO, 0, 1.0, 6, 0, False)
    for _ in range(10 * Faults().dead_count):  # one in `REPORT_NS` is judged
        now = detector.step([ModuleInputs(esc=failed)], Measured(None, None, None, []), nowhere, np.zeros(8), np.zeros(8), True, True)
    assert now.dead == (0, 3) and now.lost_axes == 1
    wanted = np.array([2.0, 1.0, 0.5, 0.1, 0.05, -0.1])
    kept = now.keep @ wanted
    np.testing.assert_allclose(kept[2:], wanted[2:], atol=0.01)
    assert 0.0 < np.linalg.norm(kept[:2]) <= np.linalg.norm(wanted[:2])


@pytest.mark.parametrize(("wanted", "made"), [([200.0, 200.0, 0, 0, 0, 0], [64.84, 64.84]), ([60.0, 60.0, 0, 0, 0.5, 0], [60.0, 60.0])])
def test_healthy_robot_that_lacks_an_axis_makes_the_force_that_it_can(wanted: list[float], made: list[float]) -> None:
    """BlueROV2 cannot pitch, and its surge pitches it a little. Regression: in saturation nothing was left of the force."""
    body = assemble_vehicle(load_vehicle("bluerov2"))
    pipeline = BodyPipeline(body, Parameters(), TICK_NS)
    assert pipeline.faults.now.lost_axes == 0 and np.linalg.matrix_rank(body.thrusters.matrix) == 5
    thrust = pipeline._allocate(np.array(wanted, dtype=np.float64), 0)
    np.testing.assert_allclose(thrust.achieved[:2], np.array(made), rtol=0.02)
    assert np.abs(thrust.achieved[3:]).max() < 0.02 * made[0]


def test_robot_of_five_thrusters_makes_the_force_that_it_can() -> None:
    """Girona 500 cannot roll, and its sway rolls it a little. Regression: in saturation nothing was left of the force."""
    pipeline = BodyPipeline(assemble_vehicle(load_vehicle("girona500")), Parameters(), TICK_NS)
    thrust = pipeline._allocate(np.array([600.0, 100.0, 0.0, 0.0, 0.0, 0.0]), 0)
    np.testing.assert_allclose(thrust.achieved[:3], [269.1, 44.85, 0.0], atol=0.5)
    assert np.abs(thrust.achieved[3:]).max() < 1.0


def leaving(name: str, *axes: str) -> Body:
    """A shipped vehicle that leaves these axes to buoyancy."""
    return assemble_vehicle(dataclasses.replace(load_vehicle(name), passive_dof=axes))


def test_no_thruster_is_asked_for_a_moment_about_a_passive_axis() -> None:
    """BlueROV2 Heavy could roll and pitch. The rest of the wrench stays as it is."""
    pipeline = BodyPipeline(leaving("bluerov2_heavy", "roll", "pitch"), Parameters(), TICK_NS)
    thrust = pipeline._allocate(np.array([3.0, 2.0, 1.0, 0.4, -0.5, 0.6]), 0)
    np.testing.assert_allclose(thrust.achieved, [3.0, 2.0, 1.0, 0.0, 0.0, 0.6], atol=1e-9)
    assert thrust.scale == (1.0, 1.0)


@pytest.mark.parametrize(("name", "axis"), [("bluerov2", 4), ("girona500", 3)])
def test_passive_axis_that_cannot_be_made_follows_from_the_others(name: str, axis: int) -> None:
    body = assemble_vehicle(load_vehicle(name))
    assert body.passive == (axis,)
    keep = FaultDetector(body, Faults(), TICK_NS).now.keep
    wanted = np.array([3.0, 2.0, 1.0, 0.4, -0.5, 0.6])
    others = [k for k in range(6) if k != axis]
    kept = keep @ wanted
    np.testing.assert_allclose(kept[others], wanted[others], atol=1e-9)
    np.testing.assert_allclose(body.thrusters.matrix @ body.thrusters.pinv @ kept, kept, atol=1e-9)
    assert not keep[:, axis].any()
    np.testing.assert_array_equal(body.steered_matrix, body.thrusters.matrix)


@pytest.mark.parametrize(("passive", "lost"), [((), 1), (("sway",), 0)])
def test_passive_axis_is_not_lost_with_a_thruster(passive: tuple[str, ...], lost: int) -> None:
    """A diagonal horizontal pair of a BlueROV2 Heavy: what is left pushes surge and sway together, so one of them is lost."""
    usable = np.ones(8, dtype=bool)
    usable[[0, 3]] = False
    body = leaving("bluerov2_heavy", *passive)
    assert thruster_state(body, usable, steered_rank(body.thrusters.matrix, body.passive)).lost_axes == lost


def test_mission_is_planned_without_moment_about_a_passive_axis() -> None:
    np.testing.assert_array_equal(leaving("bluerov2_heavy", "roll").steered_matrix[3], 0.0)
    assert np.linalg.matrix_rank(leaving("bluerov2_heavy", "roll").steered_matrix) == 5
