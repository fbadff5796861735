"""Trajectories: the figures of the issues, derivatives against finite differences, rest at both ends, and waypoint files."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from firmware_py.core import rotations
from firmware_py.core.setpoint import Trajectory, rest_at
from firmware_py.description.schema import DescriptionError
from firmware_py.prepare import paths
from firmware_py.prepare.waypoints import read_mission

TILTED = np.array([0.5, 0.5, -0.5, 0.5])
START = rest_at(np.zeros(3), TILTED)
END = rest_at(np.array([1.0, 2.0, 3.0]), rotations.normalise(np.array([-0.1, 0.2, 0.7, 0.4])))
MAKERS: dict[str, Callable[[], Trajectory]] = {
    "spiral": lambda: paths.spiral((0.65, 0.6, 0.55), 0.3, 0.4, 2.0, 40.0, TILTED),
    "circle": lambda: paths.circle((1.0, 2.0, 0.5), 0.8, 1.5, 30.0),
    "moebius": lambda: paths.moebius((0.0, 0.0, 1.5)),
    "moebius, long cruise": lambda: paths.moebius((0.0, 0.0, 1.5), ramp_share=0.1),
    "lissajous": lambda: paths.lissajous((0, 0, 1), (1, 0.5, 0.3), (1, 2, 3), 30.0, attitude=TILTED, turning=(1, 0.5)),
    "line": lambda: paths.line(START, END, 5.0),
}


@pytest.fixture(scope="module", params=MAKERS)
def trajectory(request: pytest.FixtureRequest) -> Trajectory:
    return MAKERS[request.param]()


def test_wanted_rates_are_the_derivatives_of_the_wanted_pose(trajectory: Trajectory) -> None:
    h = 1e-4
    for t in np.linspace(0.013, 0.987, 23) * trajectory.duration_s:
        before, now, after = (trajectory.sample(t + k * h) for k in (-1, 0, 1))
        np.testing.assert_allclose((after.p_wb - before.p_wb) / (2 * h), now.v_w, atol=1e-6)
        np.testing.assert_allclose((after.v_w - before.v_w) / (2 * h), now.a_w, atol=1e-6)
        turn = rotations.difference(after.q_wb.copy(), before.q_wb.copy()) / (2 * h)
        np.testing.assert_allclose(turn, now.w_b, atol=1e-6)
        np.testing.assert_allclose((after.w_b - before.w_b) / (2 * h), now.alpha_b, atol=1e-6)
        assert np.linalg.norm(now.q_wb) == pytest.approx(1.0, abs=1e-12)


def test_robot_starts_and_ends_at_rest_without_a_jerk(trajectory: Trajectory) -> None:
    end, h = trajectory.duration_s, 1e-4 * trajectory.duration_s
    for t in (-1.0, 0.0, end, end + 1.0):
        for value in trajectory.sample(t)[2:]:
            np.testing.assert_allclose(value, 0.0, atol=1e-12)
    for near, far in ((h, 2 * h), (end - h, end - 2 * h)):
        # With zero jerk at the ends, acceleration grows with the square of time there.
        a, b = (float(np.linalg.norm(trajectory.sample(t).a_w)) for t in (near, far))
        assert b / a == pytest.approx(4.0, rel=0.01)


def test_ends_are_held_for_ever(trajectory: Trajectory) -> None:
    for t, beyond in ((0.0, -50.0), (trajectory.duration_s, 1e6)):
        np.testing.assert_array_equal(trajectory.sample(t).p_wb, trajectory.sample(beyond).p_wb)
        np.testing.assert_array_equal(trajectory.sample(t).q_wb, trajectory.sample(beyond).q_wb)


def test_speed_does_not_jump_where_the_ramp_meets_the_cruise() -> None:
    moebius = paths.moebius((0, 0, 1.5), ramp_share=0.2)
    for t in (12.0, 48.0):
        before, after = moebius.sample(t - 1e-9), moebius.sample(t + 1e-9)
        np.testing.assert_allclose(before.v_w, after.v_w, atol=1e-8)
        np.testing.assert_allclose(before.a_w, after.a_w, atol=1e-8)


def test_spiral_climbs_two_turns_on_its_cylinder_and_keeps_its_attitude() -> None:
    spiral = paths.spiral((0.65, 0.6, 0.55), 0.30, 0.40, 2.0, 40.0)
    points = np.array([spiral.sample(t).p_wb for t in np.linspace(0.0, 40.0, 401)])
    np.testing.assert_allclose(np.linalg.norm(points[:, :2] - [0.65, 0.6], axis=1), 0.30, atol=1e-12)
    np.testing.assert_allclose(points[[0, -1]], [[0.95, 0.6, 0.55], [0.95, 0.6, 0.15]], atol=1e-12)
    assert np.all(np.diff(points[:, 2]) <= 0.0)
    turned = np.unwrap(np.arctan2(points[:, 1] - 0.6, points[:, 0] - 0.65))
    assert turned[-1] - turned[0] == pytest.approx(4.0 * math.pi)
    np.testing.assert_allclose(spiral.sample(20.0).q_wb, [1, 0, 0, 0], atol=1e-15)


def test_moebius_path_lies_on_the_strip_and_closes_after_two_laps() -> None:
    moebius = paths.moebius((0.2, -0.1, 1.5), 60.0, radius_m=1.0, half_width_m=0.3, laps=2.0)
    start, end = moebius.sample(0.0), moebius.sample(60.0)
    np.testing.assert_allclose(start.p_wb, end.p_wb, atol=1e-12)
    assert abs(start.q_wb @ end.q_wb) == pytest.approx(1.0)
    rolled = 0.0
    for t in np.linspace(0.0, 60.0, 301):
        now = moebius.sample(t)
        p, r = now.p_wb - [0.2, -0.1, 1.5], rotations.to_matrix(now.q_wb.copy())
        outward = np.array([*p[:2], 0.0]) / np.linalg.norm(p[:2])
        across = p - outward
        assert np.linalg.norm(across) == pytest.approx(0.3, abs=1e-12)
        np.testing.assert_allclose(r[:, 0], np.cross([0, 0, 1], outward), atol=1e-12)
        np.testing.assert_allclose(r[:, 1], -across / 0.3, atol=1e-12)
        rolled += abs(now.w_b[0]) * 60.0 / 300
    assert rolled == pytest.approx(2.0 * math.pi, rel=1e-3)


def test_middle_of_the_strip_is_a_level_circle() -> None:
    middle = paths.moebius((0, 0, 1.5), half_width_m=0.0)
    points = np.array([middle.sample(t).p_wb for t in np.linspace(0.0, 60.0, 61)])
    np.testing.assert_allclose(np.linalg.norm(points[:, :2], axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(points[:, 2], 1.5, atol=1e-12)


def test_line_arrives_at_its_pose_on_the_shortest_way() -> None:
    line = paths.line(START, END, 5.0)
    arrived = line.sample(5.0)
    np.testing.assert_allclose(arrived.p_wb, END.p_wb, atol=1e-12)
    np.testing.assert_allclose(rotations.difference(arrived.q_wb.copy(), END.q_wb), 0.0, atol=1e-12)
    turned = rotations.difference(line.sample(2.5).q_wb.copy(), START.q_wb)
    np.testing.assert_allclose(turned, 0.5 * rotations.difference(END.q_wb, START.q_wb), atol=1e-12)
    np.testing.assert_allclose(paths.line(START, START, 1.0).sample(0.5).q_wb, START.q_wb, atol=1e-12)


@pytest.mark.parametrize("ramp", [0.0, 0.6, -1.0])
def test_ramp_that_is_no_share_is_refused(ramp: float) -> None:
    with pytest.raises(ValueError, match="ramp"):
        paths.moebius((0, 0, 0), ramp_share=ramp)


def test_duration_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="duration"):
        paths.spiral((0, 0, 0), 0.3, 0.4, 2.0, 0.0)


# ---------------------------------------------------------------- waypoint files


CSV = """x_m, y_m, z_m, qw, qx, qy, qz, stop
0, 0, 1, 1, 0, 0, 0,
1, 0, 1, , , , , 1
1, 1, 0.5, 0.7071068, 0, 0, 0.7071068,
"""

TOML = """
duration_s = 12.0
[limits]
velocity_m_s = [0.5, 0.5, 0.5]
[[waypoint]]
position_m = [0.0, 0.0, 1.0]
quaternion = [1.0, 0.0, 0.0, 0.0]
[[waypoint]]
position_m = [1.0, 0.0, 1.0]
stop = true
[[waypoint]]
position_m = [1.0, 1.0, 0.5]
quaternion = [0.7071068, 0.0, 0.0, 0.7071068]
"""


def test_spreadsheet_and_toml_of_the_same_waypoints_give_the_same_points() -> None:
    table, text = read_mission(CSV, "a.csv"), read_mission(TOML, "a.toml")
    for a, b in zip(table.waypoint, text.waypoint, strict=True):
        np.testing.assert_array_equal(a.position_m, b.position_m)
        np.testing.assert_array_equal(a.quaternion, b.quaternion)
        assert a.stop == b.stop
    flown = text.plan()
    assert flown.duration_s == pytest.approx(12.0)
    np.testing.assert_allclose(flown.sample(0.0).p_wb, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(flown.sample(float(flown.breaks[1])).p_wb, [1, 0, 1], atol=1e-9)
    np.testing.assert_allclose(flown.sample(float(flown.breaks[1])).v_w, 0.0, atol=1e-9)
    np.testing.assert_allclose(flown.sample(99.0).q_wb, [math.sqrt(0.5), 0, 0, math.sqrt(0.5)], atol=1e-9)


def test_durations_in_a_spreadsheet_are_those_of_the_pieces() -> None:
    mission = read_mission("x_m,y_m,z_m,duration_s\n0,0,0,\n1,0,0,4\n1,1,0,6\n", "a.csv")
    np.testing.assert_allclose(mission.plan().breaks, [0.0, 4.0, 10.0])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "x_m,y_m\n0,0\n", r"a.csv:1: column 'z_m' is missing"),
        ("a.csv", "x_m,y_m,z_m,speed\n0,0,0,1\n", r"a.csv:1: column 'speed' is unknown"),
        ("a.csv", "x_m,y_m,z_m\n0,0,0\n1,one,0\n", r"a.csv:3: y_m: 'one' is not a number"),
        ("a.csv", "x_m,y_m,z_m,stop\n0,0,0,0\n1,1,0,2\n", r"a.csv:3: stop: 2 is neither 0 nor 1"),
        ("a.csv", "x_m,y_m,z_m\n0,0,0\n1,,0\n", r"a.csv:3: give all of x_m, y_m, z_m$"),
        ("a.csv", "x_m,y_m,z_m\n0,0,0\n1,nan,0\n", r"a.csv:3.*finite"),
        ("a.csv", "x_m,y_m,z_m\n0,0,0\n1,2e6,0\n", r"a.csv:3: position_m: .*out of range"),
        ("a.csv", "x_m,y_m,z_m,x_m\n0,0,0,1\n1,1,0,1\n", r"a.csv:1: column 'x_m' is there twice"),
        ("a.csv", "x_m;y_m;z_m\n0;0;0\n", r"a.csv:1: column 'x_m;y_m;z_m' is unknown; .* commas between them"),
        ("a.csv", "x_m,y_m,z\n0,0,0\n", r"a.csv:1: column 'z' is unknown; did you mean z_m\? columns are x_m"),
        ("a.csv", f"x_m,y_m,z_m\n{'1' * 200_000},0,0\n", r"a.csv:2: not valid CSV: field larger than field limit"),
        ("a.csv", f"{'x' * 5000}\n", r"a.csv:1: column 'x{60}' is unknown; columns"),
        ("a.toml", "[[waypoint]]\nposition_m = [0.0,\n", r"a.toml:\d: not valid TOML"),
        ("a.toml", "duration_s = 1.0\n", r"a.toml:1: waypoint: missing key; it needs tables, each \[\[waypoint\]\]"),
        ("a.csv", "x_m,y_m,z_m\n0,0,0\n", r"two waypoints, not 1"),
        ("a.csv", "x_m,y_m,z_m,duration_s\n0,0,0,\n1,0,0,1\n2,0,0,\n", r"waypoint 2 lacks duration_s"),
        ("a.csv", "x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,1,1,0,0\n1,0,0,,,,\n", r"a.csv:2.*has length 1.414, not 1; give"),
        ("a.toml", "[[waypoint]]\nposition_m = [0.0, 0.0, 0.0]\nspeed = 1.0\n", r"a.toml:3.*speed"),
        ("a.txt", "", r"ends in .csv or .toml"),
    ],
)
def test_wrong_waypoint_file_is_refused_in_one_line(name: str, text: str, message: str) -> None:
    with pytest.raises(DescriptionError, match=message) as raised:
        read_mission(text, name)
    assert "\n" not in str(raised.value)
