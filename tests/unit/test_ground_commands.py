"""Commands: the effect of each, refusals and their wording; through pymavlink's own encoder and parser."""

import math

import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.core.transitions import State
from firmware_py.core.types import Action, DockRequest, Event, Mode
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.identity import px4
from tests.unit.ground_requests import NAN, acknowledged, actions, ask
from tests.unit.ground_world import Client, World
from tests.unit.supervisors import GOOD, supervisor_in


def test_arm_is_acknowledged_when_the_supervisor_has_granted_it(world: World, client: Client) -> None:
    client.command(400, 1)
    assert not client.all("COMMAND_ACK")
    assert acknowledged(world, client, 400) == mavlink.MAV_RESULT_ACCEPTED
    world.run(100)
    assert client.last("HEARTBEAT").base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    assert ask(world, client, 400, 0, 21196) == mavlink.MAV_RESULT_ACCEPTED
    forced = [(r.action, r.argument) for r in world.robot.asked]
    assert forced == [(Action.ARM, False), (Action.DISARM, True)]


def test_unknown_command_is_unsupported_at_once(world: World, client: Client) -> None:
    client.clear()
    client.command(2000, *[NAN] * 7)
    world.run(1)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_UNSUPPORTED


def test_every_command_is_acknowledged_when_all_its_parameters_are_left_out() -> None:
    for number in World().station.services[1].commands._table:
        world = World()
        client = world.client()
        client.command(number, *[NAN] * 7)
        assert acknowledged(world, client, number) in (*range(mavlink.MAV_RESULT_FAILED + 1), mavlink.MAV_RESULT_COMMAND_INT_ONLY)


@pytest.mark.parametrize("number", [185, 209, 224, 400, 31010, 31011])
@pytest.mark.parametrize("nothing", [NAN, math.inf])
def test_command_that_does_not_say_what_is_denied(world: World, client: Client, number: int, nothing: float) -> None:
    """Regression: a command that named neither 0 nor 1 disarmed the robot, or cleared its e-stop."""
    ask(world, client, 400, 1)
    ask(world, client, 185, 1)
    before = len(world.robot.asked)
    assert ask(world, client, number, nothing, 0, 1, 1) == mavlink.MAV_RESULT_DENIED
    assert len(world.robot.asked) == before


@pytest.mark.parametrize(("number", "value"), [(400, 2.0), (400, -1.0), (400, 0.4), (185, 0.4), (185, -1.0)])
def test_number_other_than_nought_and_one_neither_arms_nor_disarms_nor_clears(
    world: World, client: Client, number: int, value: float
) -> None:
    before = len(world.robot.asked)
    assert ask(world, client, number, value) == mavlink.MAV_RESULT_DENIED
    assert len(world.robot.asked) == before
    told = "".join(message.text for message in client.all("STATUSTEXT"))
    assert f"command {number} refused: its parameter 1 is {value:g}; it needs 0 or 1" in told


@pytest.mark.parametrize(("speed", "answer"), [(0.0, 2), (0.009, 2), (0.02, 0), (2.0, 0), (2.1, 2), (-1.0, 0), (-2.0, 0), (-0.5, 2)])
def test_speed_that_would_never_arrive_is_denied(world: World, client: Client, speed: float, answer: int) -> None:
    assert ask(world, client, 178, 1, speed) == answer


@pytest.mark.parametrize("kind", [mavlink.SPEED_TYPE_CLIMB_SPEED, mavlink.SPEED_TYPE_DESCENT_SPEED])
def test_speed_of_climbing_or_descending_alone_is_denied(world: World, client: Client, kind: int) -> None:
    assert ask(world, client, 178, kind, 1.5) == mavlink.MAV_RESULT_DENIED


@pytest.mark.parametrize(
    ("number", "parameters", "why"),
    [
        (178, (1, 5.0), "speed refused: a speed of 5 m/s; it needs 0.01 to 2"),
        (178, (2, 1.0), "speed refused: there is none of climbing or descending alone"),
        (209, (9, 0, 20, 1), "motor test refused: motor 9; it needs 1 to 8"),
        (209, (1, 0, 120, 1), "motor test refused: throttle 120; it needs -100 to 100"),
        (209, (1, 1, 1000, 1), "motor test refused: throttle 1000; it needs 1100 to 1900"),
        (209, (1, 2, 0, 1), "motor test refused: throttle type 2; it needs 0 to 1"),
        (209, (1, 0, NAN, 1), "command 209 refused: its parameter 3 is no number"),
        (31010, (1, 0, 2, 1), "dock refused: target module 2; it needs 1 to 1"),
        (31010, (0, 0, 1, 1), "dock refused: module 0; it needs 1 to 1"),
        (31011, (1, 0, 1, 1), "undock refused: module 1 and itself"),
    ],
)
def test_command_that_makes_no_sense_is_denied_in_words(
    world: World, client: Client, number: int, parameters: tuple[float, ...], why: str
) -> None:
    assert ask(world, client, number, *parameters) == mavlink.MAV_RESULT_DENIED
    assert client.texts == why and not world.robot.asked


@pytest.mark.parametrize("number", [20, 21])
def test_return_and_land_both_surface(world: World, client: Client, number: int) -> None:
    assert ask(world, client, number) == mavlink.MAV_RESULT_ACCEPTED
    assert world.robot.mode[0] == Mode.SURFACE


def test_loiter_holds_the_place(world: World, client: Client) -> None:
    """MAVProxy's `loiter`, handled as ArduSub does."""
    world.robot.mode[0] = Mode.MANUAL
    assert ask(world, client, mavlink.MAV_CMD_NAV_LOITER_UNLIM) == mavlink.MAV_RESULT_ACCEPTED
    assert world.robot.mode[0] == Mode.POSHOLD


@pytest.mark.parametrize(("component", "is_heard"), [(191, True), (1, False)])
def test_companion_computer_of_the_same_system_is_heard_and_an_echo_is_not(world: World, component: int, is_heard: bool) -> None:
    """MAVLink gives a vehicle's computers its system id, and each computer its own component id."""
    companion = world.client(system=1, component=component)
    companion.command(400, 1)
    world.run(3)
    assert [(ack.target_system, ack.target_component, ack.result) for ack in companion.all("COMMAND_ACK")] == [(1, 191, 0)] * is_heard
    assert bool(world.robot.asked) == is_heard


def test_what_is_for_a_companion_computer_goes_where_it_was_heard(world: World, client: Client) -> None:
    companion = world.client(system=1, component=191)
    companion.heartbeat(mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
    client.command(400, 1, component=191)
    world.run(3)
    assert [m.target_component for m in companion.all("COMMAND_LONG")] == [191]
    assert not world.robot.asked and not client.all("COMMAND_ACK")


def test_what_is_for_all_of_a_system_reaches_its_companion_computer_too(world: World, client: Client) -> None:
    """MAVLink's routing rule; another system's computer does not receive the command."""
    companion, other = world.client(system=1, component=191), world.client(system=7, component=191)
    for each in (companion, other):
        each.heartbeat(mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
    client.command(400, 1, component=0)
    world.run(3)
    assert [len(each.all("COMMAND_LONG")) for each in (companion, other)] == [1, 0]
    assert [request.action for request in world.robot.asked] == [Action.ARM]


def test_each_companion_computer_and_each_station_of_one_system_hears_what_is_for_it(world: World, client: Client) -> None:
    stations = [client, world.client(component=230)]
    companions = [world.client(system=1, component=component) for component in (191, 100)]
    stranger = world.client(system=7)
    for stranger.mav.srcComponent in range(1, 256):  # however many component ids one sender uses
        stranger.heartbeat()
    for each in (*stations, *companions):
        each.heartbeat(mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
    for companion in companions:
        client.command(512, 259, component=companion.mav.srcComponent)
        companion.send("COMMAND_ACK", 512, 0, target_system=255, target_component=190)
    world.run(2)
    assert [[m.target_component for m in companion.all("COMMAND_LONG")] for companion in companions] == [[191], [100]]
    assert [m.get_srcComponent() for m in client.all("COMMAND_ACK")] == [191, 100]


def test_component_zero_and_system_zero_are_accepted(world: World, client: Client) -> None:
    client.command(410, component=0)
    assert acknowledged(world, client, 410) == mavlink.MAV_RESULT_ACCEPTED
    client.clear()
    client.command(410, target=0, component=0)
    assert acknowledged(world, client, 410) == mavlink.MAV_RESULT_ACCEPTED
    client.clear()
    for target in (1, 0):
        client.command(410, target=target, component=154)
    world.run(3)
    assert not client.all("COMMAND_ACK"), "another component's command is not ours"


def test_what_is_for_a_camera_of_every_system_neither_arms_nor_reboots_a_robot(client: Client, world: World) -> None:
    other = world.client(system=7)
    other.heartbeat(mavlink.MAV_TYPE_CAMERA)
    for number in (246, 400):
        client.command(number, 1, target=0, component=mavlink.MAV_COMP_ID_CAMERA)
    world.run(3)
    assert not world.robot.asked and not world.station.reboot_asked
    assert [m.command for m in other.all("COMMAND_LONG")] == [246, 400], "they are passed on"


@pytest.mark.parametrize(
    ("main", "sub", "mode"),
    [
        (1, 0, Mode.MANUAL),
        (2, NAN, Mode.ALT_HOLD),
        (3, 0, Mode.POSHOLD),
        (4, 3, Mode.POSHOLD),
        (7, 0, Mode.STABILIZE),
        (4, 6, Mode.SURFACE),
    ],
)
def test_generic_identity_takes_px4s_mode_pairs(world: World, client: Client, main: float, sub: float, mode: Mode) -> None:
    assert ask(world, client, 176, 1, main, sub) == mavlink.MAV_RESULT_ACCEPTED
    assert world.robot.mode[0] == mode
    world.run(100)
    assert client.last("HEARTBEAT").custom_mode == px4(int(main), 0 if math.isnan(sub) else int(sub))


def test_ardusub_identity_takes_ardusubs_numbers_by_command_and_by_message() -> None:
    world = World(config=GroundConfig(identity="ardusub"))
    client = world.client()
    assert ask(world, client, 176, 1, 19) == mavlink.MAV_RESULT_ACCEPTED
    assert world.robot.mode[0] == Mode.MANUAL
    client.clear()
    client.send("SET_MODE", 1, 1, 2)
    assert acknowledged(world, client, 176) == mavlink.MAV_RESULT_ACCEPTED
    world.run(100)
    heartbeat = client.last("HEARTBEAT")
    assert (heartbeat.autopilot, heartbeat.custom_mode) == (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 2)


@pytest.mark.parametrize("flags", [mavlink.MAV_MODE_GUIDED_ARMED, mavlink.MAV_MODE_FLAG_SAFETY_ARMED])
def test_flags_of_a_mode_do_not_put_an_ardusub_into_the_mode_of_number_zero(flags: int) -> None:
    world = World(config=GroundConfig(identity="ardusub"))
    client = world.client()
    assert ask(world, client, 176, flags, 0) == mavlink.MAV_RESULT_UNSUPPORTED
    client.clear()
    client.send("SET_MODE", 1, flags, 0)
    assert acknowledged(world, client, 176) == mavlink.MAV_RESULT_UNSUPPORTED
    assert not world.robot.asked


def test_a_number_of_the_other_encoding_is_no_mode() -> None:
    world = World()
    client = world.client()
    assert ask(world, client, 176, 1, 19) == mavlink.MAV_RESULT_UNSUPPORTED
    assert ask(world, client, 176, 1, NAN) == mavlink.MAV_RESULT_UNSUPPORTED


def test_estop_and_its_clearing(world: World, client: Client) -> None:
    assert ask(world, client, 185, 1) == mavlink.MAV_RESULT_ACCEPTED
    world.run(100)
    assert client.last("HEARTBEAT").system_status == mavlink.MAV_STATE_EMERGENCY
    assert ask(world, client, 31012) == mavlink.MAV_RESULT_ACCEPTED
    assert ask(world, client, 31013) == mavlink.MAV_RESULT_ACCEPTED
    assert actions(world) == [Action.ESTOP, Action.ESTOP, Action.CLEAR_ESTOP]


def test_reboot_only_while_disarmed(world: World, client: Client) -> None:
    ask(world, client, 400, 1)
    assert ask(world, client, 246, 1) == mavlink.MAV_RESULT_DENIED
    ask(world, client, 400, 0)
    assert not world.station.reboot_asked
    assert ask(world, client, 246, 1) == mavlink.MAV_RESULT_ACCEPTED
    assert world.station.reboot_asked


def test_reboot_is_denied_while_any_body_of_the_process_is_armed() -> None:
    world = World(modules=2)
    client = world.client()
    client.command(400, 1, target=1)
    world.run(3)
    client.clear()
    client.command(246, 1, target=2)
    world.run(3)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_DENIED and not world.station.reboot_asked


def test_reboot_is_denied_while_an_emergency_stop_stands(world: World, client: Client) -> None:
    ask(world, client, 31012)
    assert ask(world, client, 246, 1) == mavlink.MAV_RESULT_DENIED and not world.station.reboot_asked
    assert "reboot refused: the e-stop is not cleared" in client.texts
    ask(world, client, 31013)
    assert ask(world, client, 246, 1) == mavlink.MAV_RESULT_ACCEPTED


def test_forced_arming_that_the_supervisor_refuses_is_denied_at_once(world: World, client: Client) -> None:
    client.command(400, 1, 21196)
    (forced,) = world.station.requests()
    supervisor = supervisor_in(State.DISARMED)
    supervisor.step(False, GOOD._replace(silent=(0,)), [forced])
    world.robot.events = supervisor.events
    world.run(2)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_DENIED


def test_one_refusal_answers_one_command(world: World, client: Client) -> None:
    other = world.client(system=200)
    client.command(176, 1, 1)
    other.command(176, 1, 7)
    world.robot.mode[0] = Mode.MANUAL
    world.robot.refuse[Action.SET_MODE] = "no"
    world.station.services[1].system.requests.clear()
    world.robot.events = [Event(4, "SET_MODE refused: no", 0)]
    world.run(3)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_ACCEPTED
    assert other.last("COMMAND_ACK").result == mavlink.MAV_RESULT_DENIED


def test_parameters_of_a_command_without_a_place_are_plain_in_command_int() -> None:
    world = World(modules=2)
    client = world.client()
    client.send("COMMAND_INT", 1, 1, 0, 31010, 0, 0, 1, 0, 2, 1, 2, 1, 0)
    world.run(2)
    assert world.robot.asked[-1].argument == DockRequest(0, 0, 1, 1, 2, True)


def test_parameters_that_a_command_int_leaves_out_are_none() -> None:
    """INT32_MAX marks an omitted value (MAVLink, COMMAND_INT). Regression: it was taken for a value, and both bodies moved unasked."""
    world = World(modules=2)
    client = world.client()
    client.send("COMMAND_INT", 1, 1, 0, 31010, 0, 0, 1, 0, 2, 1, 2**31 - 1, 2**31 - 1, NAN)
    world.run(2)
    assert world.robot.asked[-1].argument == DockRequest(0, 0, 1, 1)


@pytest.mark.parametrize("text", ["x" * length for length in (1, 49, 50, 51, 99, 100, 150)])
def test_client_knows_where_a_text_ends(world: World, client: Client, text: str) -> None:
    """MAVLink: the last chunk of a text is one that is not full."""
    world.station.say(text)
    world.run(1)
    chunks = [m for m in client.all("STATUSTEXT") if m.text.startswith("x") or m.id]
    assert "".join(m.text for m in chunks) == text
    assert len(chunks) == 1 if len(text) <= 50 else (len(chunks[-1].text) < 50 and [m.chunk_seq for m in chunks] == [*range(len(chunks))])


def test_time_since_boot_begins_anew_after_49_days(world: World, client: Client) -> None:
    world.robot.tick += (2**32 + 5_000) // 10
    world.run(2)
    assert world.station.services[1].system.subject.time_ms < 6_000


def test_motor_test_asks_for_one_thruster(world: World, client: Client) -> None:
    client.command(209, 3, 0, 20, 2.0)
    world.run(2)
    assert world.robot.asked[-1].argument == (2, 0.2, 2.0)
    assert ask(world, client, 209, 9, 0, 20, 2.0) == mavlink.MAV_RESULT_DENIED
    assert ask(world, client, 209, 1, 0, 120, 2.0) == mavlink.MAV_RESULT_DENIED


@pytest.mark.parametrize(
    ("kind", "throttle", "share"), [(0, -30, -0.3), (0, 100, 1.0), (1, 1500, 0.0), (1, 1700, 0.5), (1, 1100, -1.0), (1, 1900, 1.0)]
)
def test_throttle_of_a_motor_test_is_a_share_or_a_pulse_about_its_middle(
    world: World, client: Client, kind: int, throttle: float, share: float
) -> None:
    client.command(209, 8, kind, throttle, 50.0)
    world.run(1)
    assert world.robot.asked[-1].argument == (7, pytest.approx(share), 10.0)


@pytest.mark.parametrize("parameters", [(0, 0, 10), (9, 0, 10), (1, 0, 101), (1, 1, 1050), (1, 1, 1950), (1, 2, 10)])
def test_motor_test_of_no_thruster_or_beyond_full_throttle_is_denied(world: World, client: Client, parameters: tuple[float, ...]) -> None:
    assert ask(world, client, 209, *parameters, 1.0) == mavlink.MAV_RESULT_DENIED
    assert not world.robot.asked


@pytest.mark.parametrize(
    ("kind", "throttle", "share"), [(0, 50, 0.0), (0, 60, 0.2), (0, 100, 1.0), (0, 0, -1.0), (1, 1500, 0.0), (1, 1700, 0.5)]
)
def test_ardusub_identity_counts_motors_from_0_and_its_middle_is_50_percent(kind: int, throttle: float, share: float) -> None:
    """As in ArduSub and the motor pages of QGroundControl and BlueOS. Regression: the thruster next to the intended one turned."""
    world = World(config=GroundConfig(identity="ardusub"))
    client = world.client()
    client.command(209, 0, kind, throttle, 1.0, 1, 2)
    world.run(1)
    assert world.robot.asked[-1].argument == (0, pytest.approx(share), 1.0)
    for motor, throttle in ((8, 50), (-1, 50), (0, -20), (0, NAN), (NAN, 50)):
        assert ask(world, client, 209, motor, 0, throttle, 1.0, 1, 2) == mavlink.MAV_RESULT_DENIED


def test_dock_and_undock_are_user_commands() -> None:
    world = World(modules=2)
    client = world.client()
    client.command(31010, 1, 0, 2, 1, 2, 1)
    client.command(31011, 1, 0, 2, 1)
    world.run(2)
    wanted = [(Action.DOCK, DockRequest(0, 0, 1, 1, 2, True)), (Action.UNDOCK, DockRequest(0, 0, 1, 1))]
    assert [(r.action, r.argument) for r in world.robot.asked] == wanted
    assert ask(world, client, 31010, 1, 0, 1, 1) == mavlink.MAV_RESULT_DENIED


@pytest.mark.parametrize(
    "parameters",
    [
        (1, 6, 2, 1), (1, 0, 2, 6), (1, -1, 2, 1), (1, 0, 3, 1), (3, 0, 2, 1), (2, 0, 2, 1), (0, 0, 2, 1), (1, 0, 0, 1), (1, 0, 2, 1, 4),
    ],
)  # fmt: skip
def test_dock_of_faces_or_modules_that_there_are_not_is_denied(parameters: tuple[float, ...]) -> None:
    world = World(modules=2)
    assert ask(world, world.client(), 31010, *parameters) == mavlink.MAV_RESULT_DENIED
    assert not world.robot.asked


def test_each_body_is_a_system_and_commands_reach_the_right_one() -> None:
    world = World(modules=2)
    client = world.client()
    world.run(100)
    assert {m.get_srcSystem() for m in client.all("HEARTBEAT")} == {1, 2}
    client.command(400, 1, target=2)
    world.run(3)
    assert [(r.action, r.body) for r in world.robot.asked] == [(Action.ARM, 1)]


def test_timesync_and_ping_are_answered(world: World, client: Client) -> None:
    client.send("TIMESYNC", 0, 123)
    client.send("PING", 5, 6, 0, 0)
    world.run(1)
    assert (client.last("TIMESYNC").ts1, client.last("TIMESYNC").tc1 > 0) == (123, True)
    assert (client.last("PING").seq, client.last("PING").target_system) == (6, 255)
