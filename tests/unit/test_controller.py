"""The inverse-dynamics control law: in the equations of motion, its wrench must produce the wanted motion."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.core import propagation
from firmware_py.core.body import Body
from firmware_py.core.controller import LAWS, Controller
from firmware_py.core.propagation import STATES
from firmware_py.core.rotations import difference, exp, from_euler, multiply, rotate
from firmware_py.core.setpoint import rest_at
from firmware_py.core.types import Estimate, Setpoint
from firmware_py.description.parameters import Control
from firmware_py.description.schema import limits_of
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
ATTITUDES = {
    "level": LEVEL,
    "rolled": from_euler(1.0, 0.0, 0.3),
    "pitch 90": from_euler(0.0, 0.5 * math.pi, 0.0),
    "on its head": from_euler(math.pi, 0.2, -2.0),
}


@pytest.fixture(scope="module", params=[1, 3], ids=["one module", "L of three"])
def body(request: pytest.FixtureRequest) -> Body:
    cells = [(0, 0, 0), (1, 0, 0), (1, 1, 0)][: request.param]
    return assemble(cells, [0, 4, 12][: request.param], [load_vehicle("modcube")] * request.param)


def believed(p_wb: np.ndarray, q_wb: np.ndarray, nu: np.ndarray, disturbance: np.ndarray | None = None) -> Estimate:
    """Returns an estimate. disturbance: (6,) force in the world frame, moment in the body frame."""
    zero, d = np.zeros(3), np.zeros(6) if disturbance is None else disturbance
    return Estimate(p_wb, q_wb, nu, d[:3].copy(), d[3:].copy(), zero, zero, 0, math.nan, 0, 0, True)


def moving(q_wb: np.ndarray, seed: int = 0) -> Setpoint:
    """A set-point in full motion: velocities and accelerations in all six axes."""
    p, v, w, a, alpha = np.random.default_rng(seed).normal(scale=0.4, size=(5, 3))
    return Setpoint(p, q_wb, v, w, a, alpha)


def velocity_of(setpoint: Setpoint) -> np.ndarray:
    turn = Rotation.from_quat(setpoint.q_wb[[1, 2, 3, 0]])
    return np.r_[turn.inv().apply(setpoint.v_w), setpoint.w_b]


def acceleration_of(setpoint: Setpoint) -> np.ndarray:
    """(6,) dnu/dt in the rotating body frame that the set-point asks for."""
    turn = Rotation.from_quat(setpoint.q_wb[[1, 2, 3, 0]])
    nu = velocity_of(setpoint)
    return np.r_[turn.inv().apply(setpoint.a_w) - np.cross(nu[3:], nu[:3]), setpoint.alpha_b]


# ---------------------------------------------------------------- feed-forward


def surprise(body: Body, parameters: Control, q_wb: np.ndarray) -> float:
    """Largest difference between the acceleration that the wrench produces and the wanted one, at zero tracking error."""
    setpoint = moving(q_wb)
    disturbance = np.array([2.0, -1.0, 0.5, 0.1, 0.2, -0.1])
    nu = velocity_of(setpoint)
    estimate = believed(setpoint.p_wb, q_wb, nu, disturbance)
    wrench = LAWS[parameters.law](body, parameters).step(setpoint, setpoint, estimate)
    turn = Rotation.from_quat(q_wb[[1, 2, 3, 0]])
    external = wrench + np.r_[turn.inv().apply(disturbance[:3]), disturbance[3:]]
    return float(np.abs(propagation.acceleration(nu, q_wb, external, *body.plant) - acceleration_of(setpoint)).max())


def test_every_law_that_may_be_chosen_is_known_to_the_controller() -> None:
    """Regression: any other choice flew as the paper's."""
    assert set(limits_of(Control, "law").choices) == set(LAWS)


@pytest.mark.parametrize("q_wb", ATTITUDES.values(), ids=ATTITUDES.keys())
@pytest.mark.parametrize("law", ["model", "paper"])
def test_robot_on_its_path_accelerates_as_the_path_does(body: Body, law: str, q_wb: np.ndarray) -> None:
    if law == "paper":  # the paper's g(eta) is zero by design of its robot
        body = replace(body, righting=np.zeros(3))
    assert surprise(body, Control(law=law), q_wb) < 1e-12


@pytest.mark.parametrize(
    "spoilt", [Control(drag_feedforward=-1.0), Control(drag_feedforward=0.0), Control(disturbance_feedforward=0.0)]
)
def test_feed_forward_of_the_wrong_sign_or_none_would_be_noticed(body: Body, spoilt: Control) -> None:
    assert surprise(body, spoilt, LEVEL) > 0.01


@pytest.mark.parametrize("term", ["mass", "righting", "drag"])
def test_model_that_is_not_the_robots_would_be_noticed(body: Body, term: str) -> None:
    """The controller's model has one term of the wrong sign or size; the robot is the right one."""
    spoilt = {
        "mass": replace(body, mass=1.1 * body.mass),
        "righting": replace(body, righting=-body.righting),
        "drag": replace(body, drag=replace(body.drag, rotational=-body.drag.rotational)),
    }[term]
    setpoint = moving(ATTITUDES["rolled"])
    nu = velocity_of(setpoint)
    wrench = Controller(spoilt, Control()).step(setpoint, setpoint, believed(setpoint.p_wb, setpoint.q_wb, nu))
    got = propagation.acceleration(nu, setpoint.q_wb, wrench, *body.plant)
    assert np.abs(got - acceleration_of(setpoint)).max() > 0.01


def test_robot_at_rest_is_only_held_upright(body: Body) -> None:
    for q_wb in ATTITUDES.values():
        setpoint = rest_at(np.ones(3), q_wb)
        wrench = Controller(body, Control()).step(setpoint, setpoint, believed(np.ones(3), q_wb, np.zeros(6)))
        up = Rotation.from_quat(q_wb[[1, 2, 3, 0]]).inv().apply([0.0, 0.0, -1.0])
        np.testing.assert_allclose(wrench, np.r_[0.0, 0.0, 0.0, -np.cross(body.righting, up)], atol=1e-12)


# ---------------------------------------------------------------- feedback


@pytest.mark.parametrize("q_wb", ATTITUDES.values(), ids=ATTITUDES.keys())
@pytest.mark.parametrize("axis", range(6))
def test_error_along_one_axis_is_answered_along_it_by_mass_times_bandwidth_squared(
    body: Body, axis: int, q_wb: np.ndarray
) -> None:
    c = Control()
    error = 0.01 * np.eye(6)[axis]
    aim = rest_at(rotate(q_wb, error[:3].copy()), multiply(q_wb, exp(error[3:].copy())))
    controller = Controller(body, c)
    still = believed(np.zeros(3), q_wb, np.zeros(6))
    at_rest = controller.step(rest_at(np.zeros(3), q_wb), rest_at(np.zeros(3), q_wb), still)
    stiffness = np.repeat([c.position_bandwidth**2, c.attitude_bandwidth**2], 3)
    np.testing.assert_allclose(controller.step(aim, aim, still) - at_rest, body.mass @ (stiffness * error), atol=1e-9)


def test_position_error_is_turned_by_the_attitude_that_is_and_not_the_one_that_is_wanted(body: Body) -> None:
    q_wb, aside = ATTITUDES["rolled"], np.array([0.1, -0.2, 0.05])
    near, far = rest_at(np.zeros(3), ATTITUDES["pitch 90"]), rest_at(aside, ATTITUDES["pitch 90"])
    still = believed(np.zeros(3), q_wb, np.zeros(6))
    controller = Controller(body, Control())
    pull = np.r_[Rotation.from_quat(q_wb[[1, 2, 3, 0]]).inv().apply(aside), np.zeros(3)]
    extra = controller.step(far, far, still) - controller.step(near, near, still)
    np.testing.assert_allclose(extra, body.mass @ (Control().position_bandwidth ** 2 * pull), atol=1e-9)


def test_quaternion_of_either_sign_is_the_same_attitude(body: Body) -> None:
    estimate = believed(np.zeros(3), from_euler(0.3, 0.2, 0.1), np.zeros(6))
    aim = rest_at(np.zeros(3), from_euler(-0.2, 0.4, 1.0))
    negative = aim._replace(q_wb=-aim.q_wb)
    controller = Controller(body, Control())
    np.testing.assert_allclose(
        controller.step(aim, aim, estimate), controller.step(negative, negative, estimate), atol=1e-12
    )


def test_paper_law_feeds_measured_velocity_into_drag_and_the_default_does_not(body: Body) -> None:
    """With the set-point at rest the default compensates no drag; the paper's law cancels the water's damping of a push at 0.5 m/s."""
    nu = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    hold = rest_at(np.zeros(3), LEVEL)
    pushed = believed(np.zeros(3), LEVEL, nu)
    model, paper = (LAWS[law](body, Control()).step(hold, hold, pushed) for law in ("model", "paper"))
    damping = -2.0 * Control().position_damping * Control().position_bandwidth * body.mass[:, 0] * 0.5
    np.testing.assert_allclose(model[:3], damping[:3], atol=1e-9)
    assert paper[0] > model[0] + 1.0


def test_feed_forward_looks_ahead_and_the_error_does_not(body: Body) -> None:
    now, ahead = rest_at(np.zeros(3), LEVEL), rest_at(np.ones(3), LEVEL)._replace(a_w=np.array([0.1, 0.0, 0.0]))
    still = believed(np.zeros(3), LEVEL, np.zeros(6))
    controller = Controller(body, Control())
    extra = controller.step(now, ahead, still) - controller.step(now, now, still)
    np.testing.assert_allclose(extra, 0.1 * body.mass[:, 0], atol=1e-12)


def test_damping_is_against_the_velocity_wanted_now_and_not_ahead(body: Body) -> None:
    dry = replace(body, drag=replace(body.drag, nodes=0.0 * body.drag.nodes))
    controller, still = Controller(dry, Control()), believed(np.zeros(3), LEVEL, np.zeros(6))
    rest = rest_at(np.zeros(3), LEVEL)
    moving_on = rest._replace(v_w=np.array([0.3, 0.0, 0.0]))
    np.testing.assert_allclose(controller.step(rest, moving_on, still), controller.step(rest, rest, still), atol=1e-12)
    damping = 2.0 * Control().position_damping * Control().position_bandwidth * 0.3
    extra = controller.step(moving_on, rest, still) - controller.step(rest, rest, still)
    np.testing.assert_allclose(extra, damping * body.mass[:, 0], atol=1e-9)


def without_drag(body: Body) -> Body:
    return replace(body, drag=replace(body.drag, nodes=0.0 * body.drag.nodes, rotational=np.zeros(3)))


@pytest.mark.parametrize("q_wb", ATTITUDES.values(), ids=ATTITUDES.keys())
def test_wanted_rates_are_turned_from_the_attitude_that_is_wanted_into_the_one_that_is(body: Body, q_wb: np.ndarray) -> None:
    """A quarter turn off its set-point, the robot must still turn about the same world axes."""
    aim = rest_at(np.zeros(3), multiply(q_wb, from_euler(0.0, 0.0, 0.5 * math.pi)))
    turning = aim._replace(w_b=np.array([0.3, -0.2, 0.5]))
    still, c = believed(np.zeros(3), q_wb, np.zeros(6)), Control()
    controller = Controller(without_drag(body), c)
    extra = controller.step(turning, aim, still) - controller.step(aim, aim, still)
    damping = 2.0 * c.attitude_damping * c.attitude_bandwidth * np.array([0.2, 0.3, 0.5])  # set-point x is robot y, its y robot -x
    np.testing.assert_allclose(extra, body.mass @ np.r_[np.zeros(3), damping], atol=1e-9)


@pytest.mark.parametrize("q_wb", ATTITUDES.values(), ids=ATTITUDES.keys())
def test_feed_forward_of_a_turn_is_told_in_the_attitude_that_is(body: Body, q_wb: np.ndarray) -> None:
    """Against Euler's equations of the wanted turn about the centre of mass, in numpy; the robot is a quarter turn off its set-point."""
    aim = rest_at(np.zeros(3), multiply(q_wb, from_euler(0.0, 0.0, 0.5 * math.pi)))
    turning = aim._replace(w_b=np.array([0.3, -0.2, 0.5]), alpha_b=np.array([-0.7, 0.4, 0.9]))
    controller, still = Controller(without_drag(body), Control()), believed(np.zeros(3), q_wb, np.zeros(6))
    extra = controller.step(aim, turning, still) - controller.step(aim, aim, still)
    w, alpha = np.array([0.2, 0.3, 0.5]), np.array([-0.4, -0.7, 0.9])  # set-point x is robot y, its y robot -x
    momentum = body.mass[:, 3:] @ w
    euler = body.mass[:, 3:] @ alpha + np.r_[np.cross(w, momentum[:3]), np.cross(w, momentum[3:])]
    np.testing.assert_allclose(extra, euler, atol=1e-12)


# ---------------------------------------------------------------- closed loop


def fly(body: Body, x: np.ndarray, aim: Setpoint, seconds: float, parameters: Control) -> np.ndarray:
    """(n, 32) states of an ideal robot (no lag, no limits, state known) under the controller, every 10 ms."""
    controller, states = Controller(body, parameters), [x]
    for _ in range(round(seconds / 0.01)):
        x = states[-1]
        wrench = controller.step(aim, aim, believed(x[:3].copy(), x[3:7].copy(), x[7:13].copy()))
        states.append(propagation.step(x, wrench, 0.01, *body.plant))
    return np.array(states)


def displaced(error: np.ndarray) -> np.ndarray:
    x = np.zeros(STATES)
    x[:3], x[3:7] = error[:3], exp(error[3:].copy())
    return x


@pytest.mark.parametrize("axis", range(6))
def test_error_decays_by_the_bandwidth_that_was_asked_for(body: Body, axis: int) -> None:
    """Critically damped, an error falls as (1 + w t) exp(-w t): the same for every shape and axis."""
    dry = replace(body, drag=replace(body.drag, nodes=0.0 * body.drag.nodes, rotational=np.zeros(3)))
    c = Control(position_bandwidth=1.5, position_damping=1.0, attitude_bandwidth=2.5, attitude_damping=1.0)
    states = fly(dry, displaced(0.02 * np.eye(6)[axis]), rest_at(np.zeros(3), LEVEL), 2.0, c)
    errors = [np.r_[x[:3], difference(x[3:7].copy(), LEVEL)][axis] for x in states]
    wt = (1.5 if axis < 3 else 2.5) * 0.01 * np.arange(len(states))
    np.testing.assert_allclose(errors, 0.02 * (1.0 + wt) * np.exp(-wt), atol=0.02 * 0.02)


@pytest.mark.parametrize("start", [e for k, e in ATTITUDES.items() if k != "level"], ids=lambda q: str(np.round(q, 2)))
def test_robot_comes_home_from_far_away_and_any_attitude(body: Body, start: np.ndarray) -> None:
    x = np.zeros(STATES)
    x[:3], x[3:7], x[7:13] = [1.5, -1.0, 0.7], start, [0.3, -0.2, 0.1, 0.5, -0.5, 0.8]
    end = fly(body, x, rest_at(np.zeros(3), LEVEL), 8.0, Control())[-1]
    np.testing.assert_allclose(end[:3], 0.0, atol=2e-3)
    np.testing.assert_allclose(difference(end[3:7].copy(), LEVEL), 0.0, atol=1e-3)


def test_steady_run_with_current_is_followed_without_error(body: Body) -> None:
    """At 0.3 m/s through the water, against a known disturbance, nothing is left for the feedback to correct."""
    setpoint = Setpoint(np.zeros(3), LEVEL, np.array([0.3, 0.1, 0.0]), np.zeros(3), np.zeros(3), np.zeros(3))
    disturbance = np.array([1.0, 0.0, -0.5, 0.0, 0.0, 0.0])
    x = np.zeros(STATES)
    x[3:7], x[7:10], x[19:25] = LEVEL, setpoint.v_w, disturbance
    controller = Controller(body, Control())
    for k in range(200):
        aim = setpoint._replace(p_wb=setpoint.v_w * 0.01 * k)
        wrench = controller.step(aim, aim, believed(x[:3].copy(), x[3:7].copy(), x[7:13].copy(), disturbance))
        x = propagation.step(x, wrench, 0.01, *body.plant)
    np.testing.assert_allclose(x[:3], setpoint.v_w * 2.0, atol=1e-9)
