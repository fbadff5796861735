"""Sticks, set-points and missions from a client, and their effect."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.core.rotations import difference, from_euler, multiply
from firmware_py.core.setpoint import LEASH_RAD
from firmware_py.core.types import Action, DockRequest, Mode
from firmware_py.ground.config import GroundConfig
from tests.unit.ground_requests import NAN, ask
from tests.unit.ground_world import Client, World


def test_manual_control_gives_six_axes(world: World, client: Client) -> None:
    client.send("MANUAL_CONTROL", 1, 1000, -500, 750, 250, 0, 0, 3, 100, -200)
    world.run(1)
    sticks = world.robot.asked[-1].argument
    assert sticks.force == pytest.approx((1.0, -0.5, -0.5)) and sticks.moment == pytest.approx((-0.2, 0.1, 0.25))
    client.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, 0)
    world.run(1)
    assert max(map(abs, (*world.robot.asked[-1].argument.force, *world.robot.asked[-1].argument.moment))) == 0


def test_sticks_for_all_steer_nobody_and_their_stop_is_for_all() -> None:
    world = World(2)
    client = world.client()
    client.send("MANUAL_CONTROL", 0, 500, 0, 500, 0, 1 << 6 | 1 << 7)  # arm, e-stop
    world.run(1)
    assert [(r.action, r.body) for r in world.robot.asked] == [(Action.ESTOP, 0), (Action.ESTOP, 1)]
    client.send("MANUAL_CONTROL", 2, 500, 0, 500, 0, 0)
    world.run(1)
    assert [(r.action, r.body) for r in world.robot.asked[2:]] == [(Action.STICKS, 1)]


def test_stick_z_convention_is_a_parameter(world: World, client: Client) -> None:
    client.send("PARAM_SET", 1, 1, b"STICK_Z", 1.0, 9)
    client.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, 0)
    world.run(1)
    assert world.robot.asked[-1].argument.force == pytest.approx((0, 0, -0.5))


def test_held_sticks_show_as_not_ready_to_arm(world: World, client: Client) -> None:
    for _ in range(60):
        client.send("MANUAL_CONTROL", 1, 800, 0, 500, 0, 0)
        world.run(1)
    assert not client.last("SYS_STATUS").onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK
    world.run(120)
    assert client.last("SYS_STATUS").onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK


def test_buttons_act_when_they_are_pressed_not_while_they_are_held(world: World, client: Client) -> None:
    for _ in range(5):
        client.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, 1 << 7)
    client.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, 1 << 1)
    client.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, 1 << 9)
    world.run(2)
    pressed = [r.action for r in world.robot.asked if r.action != Action.STICKS]
    assert pressed == [Action.ESTOP, Action.SET_MODE]
    assert "dock refused: no faces" in client.texts


def test_dock_button_asks_for_the_configured_faces() -> None:
    world = World(modules=2, config=GroundConfig(dock_button=(1, 0, 2, 1)))
    client = world.client()
    client.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, 1 << 9)
    world.run(1)
    assert world.robot.asked[-1].argument == DockRequest(0, 0, 1, 1)


def test_rc_override_has_ardusubs_channels(world: World, client: Client) -> None:
    client.send("RC_CHANNELS_OVERRIDE", 1, 1, 1500, 1700, 1900, 1300, 1600, 65535, 0, 0)
    world.run(1)
    sticks = world.robot.asked[-1].argument
    assert sticks.force == pytest.approx((0.25, 0, -1.0)) and sticks.moment == pytest.approx((0.5, 0, -0.5))


def test_rc_channel_beyond_its_ends_is_a_full_stick(world: World, client: Client) -> None:
    client.send("RC_CHANNELS_OVERRIDE", 1, 1, 1500, 1500, 2200, 1500, 2200, 800, 0, 0)
    world.run(1)
    sticks = world.robot.asked[-1].argument
    assert tuple(sticks.force) == (1.0, -1.0, -1.0) and tuple(sticks.moment) == (0.0, 0.0, 0.0)


def test_rc_channel_that_is_left_out_stays_until_it_is_let_go_or_old(world: World, client: Client) -> None:
    """A script may send one channel at a time: UINT16_MAX ignores, 0 releases (MAVLink, RC_CHANNELS_OVERRIDE)."""

    def force(channel: int, pwm: int) -> tuple[float, ...]:
        channels = [65535] * 8
        channels[channel - 1] = pwm
        client.send("RC_CHANNELS_OVERRIDE", 1, 1, *channels)
        world.run(10)
        return tuple(world.robot.asked[-1].argument.force)

    assert force(5, 1700) == (0.5, 0, 0)
    assert force(3, 1600) == (0.5, 0, -0.25)
    assert force(5, 0) == (0, 0, -0.25)
    world.run(round(100 * world.parameters.steering.stick_timeout_s) - 25)
    assert force(6, 1900) == (0, 1, -0.25)
    world.run(20)
    assert force(6, 1900) == (0, 1, 0)


def send_target(client: Client, mask: int, frame: int = 1, **values: float) -> None:
    names = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
    client.send("SET_POSITION_TARGET_LOCAL_NED", 0, 1, 1, frame, mask, *(values.get(name, 0.0) for name in names))


def fly_by_velocity(world: World, client: Client) -> None:
    """Arms, sends a first set-point and enters GUIDED."""
    ask(world, client, 400, 1)
    send_target(client, 0xDC7, vx=0.1)
    ask(world, client, 176, 1, 6)


def test_guided_mode_needs_a_setpoint_first_and_ends_when_they_stay_away(world: World, client: Client) -> None:
    ask(world, client, 400, 1)
    assert ask(world, client, 176, 1, 6) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    send_target(client, 0xDF8, x=0.2, y=0.1, z=0.4)
    assert ask(world, client, 176, 1, 6) == mavlink.MAV_RESULT_ACCEPTED
    assert world.robot.mode[0] == Mode.GUIDED
    for _ in range(20):
        send_target(client, 0x9F8, x=0.2, y=0.1, z=0.4, yaw=0.5)
        world.run(10)
    assert world.robot.mode[0] == Mode.GUIDED
    setpoint = next(r.argument for r in reversed(world.robot.asked) if r.action == Action.SET_POINT)
    assert setpoint.p_wb == pytest.approx([0.2, 0.1, 0.4])
    world.run(60)
    assert world.robot.mode[0] == Mode.POSHOLD
    assert "set-points stay away" in client.last("STATUSTEXT").text


def test_velocities_move_no_place_before_guided_mode_is_entered(world: World, client: Client) -> None:
    for _ in range(10):
        send_target(client, 0xDC7, vx=0.5)
        world.run(10)
    assert world.robot.asked[-1].argument.p_wb == pytest.approx(world.robot.p_wb[0])


def test_set_point_that_comes_just_after_they_stayed_away_begins_where_the_robot_is(world: World, client: Client) -> None:
    """The hold has been requested, but the mode is still the old one."""
    fly_by_velocity(world, client)
    world.robot.refuse[Action.SET_MODE] = "not now"
    for gap in (51, 60):
        world.run(gap)
        send_target(client, 0xDC7, vx=0.5)
        world.run(2)
        assert world.robot.asked[-1].argument.p_wb == pytest.approx(world.robot.p_wb[0])


def test_velocity_setpoints_move_the_place_along(world: World, client: Client) -> None:
    fly_by_velocity(world, client)
    for _ in range(10):
        send_target(client, 0xDC7, vx=0.1)
        world.run(10)
    setpoints = [r.argument for r in world.robot.asked if r.action == Action.SET_POINT]
    assert setpoints[-1].v_w == pytest.approx([0.1, 0, 0])
    assert setpoints[-1].p_wb[0] - world.robot.p_wb[0][0] == pytest.approx(0.09, abs=0.02)


@pytest.mark.parametrize("stop", ["velocity of zero", "no velocity", "attitude"])
def test_body_that_could_not_follow_a_velocity_stops_where_it_was_to_be(world: World, client: Client, stop: str) -> None:
    """Regression: the place had run ahead by a metre, and a body that the fence had held drifted there when the fence was widened."""
    record, held = world.robot._record, world.robot.p_wb[0] + np.array([0.05, 0.0, 0.0])
    world.robot._record = lambda body: (r := record(body))._replace(setpoint=r.setpoint._replace(p_wb=held))  # type: ignore[method-assign]
    fly_by_velocity(world, client)
    for vx in (2.0,) * 50:
        send_target(client, 0xDC7, vx=vx, vy=0.1)
        world.run(10)
    ahead = world.robot.asked[-1].argument.p_wb
    assert 0.5 < ahead[0] - world.robot.p_wb[0][0] <= 1.0 + 2.0 * 0.1 + 1e-6
    for _ in range(2):
        if stop == "attitude":
            client.send("SET_ATTITUDE_TARGET", 0, 1, 1, 0x7, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0.0)
        else:
            send_target(client, 0xDC7 if stop == "velocity of zero" else 0xDF8 | 3, z=held[2])
        world.run(10)
        stopped = world.robot.asked[-1].argument
        assert stopped.v_w == pytest.approx([0.0, 0.0, 0.0]) and stopped.p_wb == pytest.approx(held, abs=1e-6)


def test_axis_of_a_velocity_that_goes_on_keeps_its_place(world: World, client: Client) -> None:
    fly_by_velocity(world, client)
    for vx in (*[0.1] * 30, 0.0):
        send_target(client, 0xDC7, vx=vx, vy=0.1)
        world.run(10)
    ahead = world.robot.asked[-1].argument.p_wb - world.robot.p_wb[0]
    assert ahead[0] == pytest.approx(0.0, abs=1e-9) and ahead[1] > 0.25


def test_velocity_back_is_obeyed_at_once_by_a_body_that_could_not_follow(world: World, client: Client) -> None:
    """A robot that was steered against the fence stood there for as long as its place took to come back by a metre."""
    fly_by_velocity(world, client)
    for vx in (*[0.2] * 60, -0.1):
        send_target(client, 0xDC7, vx=vx, vy=0.2)
        world.run(10)
    ahead = [r.argument for r in world.robot.asked if r.action == Action.SET_POINT][-1].p_wb - world.robot.p_wb[0]
    assert ahead[0] == pytest.approx(0.09, abs=0.01) and ahead[1] > 0.9


def test_robot_that_is_held_while_a_rate_streams_is_turned_that_way_and_never_back(world: World, client: Client) -> None:
    fly_by_velocity(world, client)
    for _ in range(100):
        send_target(client, 0x5C7, yaw_rate=0.6)
        world.run(10)
        turn = difference(world.robot.asked[-1].argument.q_wb, world.robot.q_wb[0])
        assert turn[2] > -1e-9 and np.linalg.norm(turn) < LEASH_RAD + 0.1


def test_setpoints_that_are_no_numbers_are_ignored(world: World, client: Client) -> None:
    send_target(client, 0xDF8, x=NAN)
    send_target(client, 0x9F8, x=0.1, yaw=NAN)
    send_target(client, 0xDF8, frame=99, x=0.1)
    world.run(2)
    assert not world.robot.asked


@pytest.mark.parametrize("values", [{"x": 5.3e6}, {"vx": 3e38}, {"yaw_rate": -1e30}, {"afz": 1e9}])
def test_set_points_beyond_all_sense_are_ignored_and_do_not_lead_into_guided_mode(
    world: World, client: Client, values: dict[str, float]
) -> None:
    """Each was refused in a text of its own, at the rate of the stream, and guided mode was granted without a set-point."""
    send_target(client, 0x400, **values)
    assert ask(world, client, 176, 1, 6) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert not world.robot.asked


@pytest.mark.parametrize(("mask", "followed"), [(0xC38, True), (0xC38 | 0x200, False), (0xDF8 | 0x200, True)])
def test_force_is_not_taken_for_an_acceleration(world: World, client: Client, mask: int, followed: bool) -> None:
    send_target(client, mask, x=0.1)
    world.run(1)
    assert [request.action for request in world.robot.asked] == [Action.SET_POINT] * followed


def test_body_frame_setpoints_turn_with_the_body(world: World, client: Client) -> None:
    send_target(client, 0xDF8, frame=9, x=0.1)
    world.run(1)
    p = world.robot.asked[-1].argument.p_wb - world.robot.p_wb[0]
    assert p == pytest.approx([0.1 * math.cos(0.3), 0.1 * math.sin(0.3), 0], abs=1e-6)


@pytest.mark.parametrize("roll", [-1e-3, 1e-3])
@pytest.mark.parametrize("pitch", [-1.570, -1.572])
def test_robot_that_looks_straight_down_goes_ahead_where_its_top_looks(world: World, client: Client, roll: float, pitch: float) -> None:
    """A milliradian of attitude makes no difference, although the Euler angles flip there."""
    world.robot.q_wb[0] = np.asarray(multiply(from_euler(0.0, pitch, 0.3), from_euler(0.0, 0.0, roll)))
    world.run(1)
    send_target(client, 0xDC7, frame=8, vx=0.2)
    world.run(1)
    assert world.robot.asked[-1].argument.v_w == pytest.approx([0.2 * math.cos(0.3), 0.2 * math.sin(0.3), 0.0], abs=2e-3)


@pytest.mark.parametrize("frame", [8, 9, 12])
def test_offsets_from_the_body_are_added_to_its_place_in_every_body_frame(world: World, client: Client, frame: int) -> None:
    send_target(client, 0xDF8, frame=frame, x=0.1)
    world.run(1)
    assert world.robot.asked[-1].argument.p_wb[2] == pytest.approx(world.robot.p_wb[0][2])
    assert np.linalg.norm(world.robot.asked[-1].argument.p_wb - world.robot.p_wb[0]) == pytest.approx(0.1)


@pytest.mark.parametrize("frame", [7, 8, 9, 12])
def test_offsets_count_from_where_the_body_is_and_not_from_where_it_should_be(world: World, client: Client, frame: int) -> None:
    record, wanted = world.robot._record, world.robot.p_wb[0] + np.array([1.0, 0.0, 0.0])
    world.robot._record = lambda body: (r := record(body))._replace(setpoint=r.setpoint._replace(p_wb=wanted))  # type: ignore[method-assign]
    world.run(1)
    send_target(client, 0xDF8, frame=frame, x=0.1)
    world.run(1)
    assert np.linalg.norm(world.robot.asked[-1].argument.p_wb - world.robot.p_wb[0]) == pytest.approx(0.1)


@pytest.mark.parametrize(("frame", "mask", "place"), [
    (1, 0xDF8 | 4, [0.5, 0.3, 0.5]), (1, 0xDF8 | 3, [0.0, 0.2, 0.1]), (1, 0xDF8 | 1, [0.0, 0.3, 0.1]),
    (7, 0xDF8 | 4, [0.5, 0.5, 0.5]), (9, 0xDF8 | 7 - 4, [0.0, 0.2, 0.6]),
])  # fmt: skip
def test_axes_that_are_left_out_of_a_set_point_stay(world: World, client: Client, frame: int, mask: int, place: list[float]) -> None:
    send_target(client, mask, frame=frame, x=0.5, y=0.3, z=0.1)
    world.run(1)
    assert world.robot.asked[-1].argument.p_wb == pytest.approx(place)


def test_axis_without_a_place_goes_on_at_its_speed(world: World, client: Client) -> None:
    ask(world, client, 400, 1)
    mask = 0xC00 | 0x1C0 | 0x18 | 0x4  # x, y and the vertical speed are given
    send_target(client, mask, x=0.2, y=0.1, vz=-0.1)
    ask(world, client, 176, 1, 6)
    for _ in range(10):
        send_target(client, mask, x=0.2, y=0.1, vz=-0.1)
        world.run(10)
    p_wb = next(r.argument for r in reversed(world.robot.asked) if r.action == Action.SET_POINT).p_wb
    assert p_wb[:2] == pytest.approx([0.2, 0.1])
    assert p_wb[2] - world.robot.p_wb[0][2] == pytest.approx(-0.09, abs=0.02)


def test_attitude_target_holds_any_attitude(world: World, client: Client) -> None:
    client.send("SET_ATTITUDE_TARGET", 0, 1, 1, 7, [0.7071, 0, 0.7071, 0], 0, 0, 0, 0)
    world.run(1)
    assert world.robot.asked[-1].argument.q_wb == pytest.approx([0.7071, 0, 0.7071, 0], abs=1e-3)
