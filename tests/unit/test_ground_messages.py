"""What a client hears and may ask, message by message, through pymavlink's own encoder and parser."""

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink
from pymavlink.generator import mavgen

from firmware_py.app.deadlines import times_of
from firmware_py.core.rotations import rotate
from firmware_py.core.types import Action, DockRequest, Event, Mode
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.dialect import load_dialect
from firmware_py.ground.identity import px4
from firmware_py.ground.telemetry import STREAMS
from firmware_py.ground.times import Times
from firmware_py.ground.wire import checksum
from firmware_py.runtime.clock import ManualClock
from firmware_py.runtime.rate_keeper import RateKeeper
from tests.unit.ground_world import Client, World

NAN = float("nan")


def acknowledged(world: World, client: Client, number: int) -> int:
    """The result of the last acknowledgement of a command, waited for."""
    world.run_until(lambda: any(a.command == number for a in client.all("COMMAND_ACK")))
    return int([a for a in client.all("COMMAND_ACK") if a.command == number][-1].result)


def ask(world: World, client: Client, number: int, *parameters: float) -> int:
    client.clear()
    client.command(number, *parameters)
    return acknowledged(world, client, number)


def actions(world: World) -> list[Action]:
    return [request.action for request in world.robot.asked if request.action != Action.GROUND_ALIVE]


# ---------------------------------------------------------------- telemetry


def test_every_streamed_message_arrives_with_the_robots_values(world: World, client: Client) -> None:
    world.run(450)
    p, v = world.robot.p_wb[0], rotate(world.robot.q_wb[0], np.ascontiguousarray(world.robot.nu[:3]))
    local = client.last("LOCAL_POSITION_NED")
    assert [local.x, local.y, local.z] == pytest.approx(p.tolist(), abs=1e-6)
    assert [local.vx, local.vy, local.vz] == pytest.approx(v.tolist(), abs=1e-6)
    quaternion = client.last("ATTITUDE_QUATERNION")
    assert [quaternion.q1, quaternion.q2, quaternion.q3, quaternion.q4] == pytest.approx(
        world.robot.q_wb[0].tolist(), abs=1e-6
    )
    odometry = client.last("ODOMETRY")
    assert (odometry.frame_id, odometry.child_frame_id) == (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD)
    assert odometry.pose_covariance[0] == pytest.approx(4e-6) and odometry.pose_covariance[20] == pytest.approx(1.6e-5)
    assert [odometry.vx, odometry.vz] == pytest.approx([0.05, -0.02])
    position = client.last("GLOBAL_POSITION_INT")
    assert (position.relative_alt, position.lat, position.lon) == (-500, 302084000, 1201614021)
    assert client.last("VFR_HUD").heading == round(math.degrees(0.3))
    battery = client.last("BATTERY_STATUS")
    assert (battery.voltages[0], battery.current_battery) == (12100, 250)
    assert client.last("SERVO_OUTPUT_RAW").servo1_raw == 1100 and client.last("SERVO_OUTPUT_RAW").servo8_raw == 1900
    assert client.last("SCALED_PRESSURE").press_abs == pytest.approx(1013.0)
    assert client.last("SCALED_PRESSURE2").press_abs == pytest.approx(1060.0)
    assert client.last("EXTENDED_SYS_STATE").landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND
    assert client.last("HOME_POSITION").latitude == 302084000
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_NO_MISSION
    named = {m.name: m.value for m in client.all("NAMED_VALUE_FLOAT")}
    assert named["DOCK0+X"] == pytest.approx(0.1) and named["WRENCH_MRG"] == 0.75
    assert client.last("CURRENT_MODE").custom_mode == px4(4, 3)
    assert client.all("DEBUG_FLOAT_ARRAY") == [] and client.last("SYS_STATUS").load == 0  # nobody is late in lockstep


def test_robot_on_a_clock_tells_how_its_ticks_keep_their_deadlines(world: World, client: Client) -> None:
    keeper = RateKeeper(10_000_000, ManualClock(), lambda deadline_ns: None)
    for duration_ns in (4_000, 150_000, 160_000):
        keeper.lateness.add(duration_ns)
        keeper.compute.add(10 * duration_ns)
    world.station.picture.times = times_of(keeper)
    world.run(550)
    told = {message.name: message.data for message in client.all("DEBUG_FLOAT_ARRAY")}
    assert told["LATENESS"] == [0, 0, 1, 0, 0, 0, 0, 2, *[0] * 50]
    assert told["COMPUTE"] == [0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 2, *[0] * 47]
    assert client.last("SYS_STATUS").load == 160


def test_system_status_tells_of_health_and_of_readiness_to_arm(world: World, client: Client) -> None:
    world.run(100)
    vision, prearm = mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION, mavlink.MAV_SYS_STATUS_PREARM_CHECK
    assert client.last("SYS_STATUS").onboard_control_sensors_health & vision
    assert client.last("SYS_STATUS").onboard_control_sensors_health & prearm
    world.robot.may_arm = False
    world.run(100)
    assert client.last("SYS_STATUS").onboard_control_sensors_health & (vision | prearm) == vision
    world.robot.tag_age_ns = 2_000_000_000
    world.run(100)
    assert not client.last("SYS_STATUS").onboard_control_sensors_health & (vision | prearm)


def test_esc_messages_decode_with_a_dialect_that_mavgen_made(world: World, client: Client, tmp_path: Path) -> None:
    """An independent reading: mavgen's own code, made from the XML that the repository keeps."""
    import importlib.util

    xml = Path(__file__).parents[2] / "firmware_py" / "ground" / "modcube.xml"
    made = tmp_path / "esc_dialect.py"
    options = mavgen.Opts(str(made), wire_protocol="2.0", language="Python3", validate=False)
    mavgen.mavgen(options, [str(xml)])
    spec = importlib.util.spec_from_file_location("esc_dialect", made)
    assert spec is not None and spec.loader is not None
    dialect = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(dialect)
    ours = load_dialect()
    status = dialect.mavlink_map[291]
    assert (status.crc_extra, dialect.mavlink_map[290].crc_extra) == (10, 251)  # as in MAVLink's own common.xml
    values = {"index": 4, "time_usec": 7, "rpm": [1, -2, 3, -4], "voltage": [12.5] * 4, "current": [0.5, 1, 1.5, 2]}
    payload = ours.by_name["ESC_STATUS"].encode(values)
    assert ours.by_name["ESC_STATUS"].crc_extra == status.crc_extra
    raw = status.unpacker.unpack(payload.ljust(status.unpacker.size, b"\0"))
    assert set(raw) == {4, 7, 1, -2, 3, -4, 12.5, 0.5, 1.5, 2.0}
    world.station.frames(world.time_ns)
    client.command(512, 290)
    client.command(512, 291)
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    sent = [m for _, frame in world.station.frames(world.time_ns) for m in parser.parse_buffer(frame) or []]
    info, statuses = ([m for m in sent if m.get_type() == name] for name in ("ESC_INFO", "ESC_STATUS"))
    assert [m.index for m in statuses] == [m.index for m in info] == [0, 4], "eight ESCs, four in a message"
    assert (statuses[0].rpm, statuses[0].current) == ([0, 0, 900, -450], [0.0, 0.0, 1.5, 0.5])
    assert statuses[0].voltage == pytest.approx([12.1] * 4)
    assert (info[0].count, info[0].info, info[0].connection_type, info[0].failure_flags) == (8, 15, 5, [0, 0, 0, 4])


def test_frames_carry_the_checksum_that_pymavlink_computes(client: Client) -> None:
    frame = client.pack("HEARTBEAT", 6, 8, 0, 0, 4, 3)
    assert checksum(frame[1:-2], mavlink.MAVLink_heartbeat_message.crc_extra) == int.from_bytes(frame[-2:], "little")


def test_every_definition_has_pymavlinks_layout() -> None:
    dialect = load_dialect()
    for number, cls in mavlink.mavlink_map.items():
        definition = dialect.by_number[number]
        assert (definition.name, definition.crc_extra, definition.struct.size) == (
            cls.msgname,
            cls.crc_extra,
            cls.unpacker.size,
        )


def test_refusals_and_failsafes_reach_the_client_as_text(world: World, client: Client) -> None:
    world.robot.refuse[Action.ARM] = "pose is 700 ms old, 500 permitted, and some more that makes it long"
    assert ask(world, client, 400, 1) == mavlink.MAV_RESULT_DENIED
    texts = client.all("STATUSTEXT")
    assert "".join(t.text for t in texts).startswith("ARM refused: pose is 700 ms old")
    assert texts[0].id == texts[1].id != 0 and [t.chunk_seq for t in texts] == [0, 1]


# ---------------------------------------------------------------- rates and requests


def sent(world: World, ticks: int = 1) -> Counter[int]:
    """How many frames of each message number went out."""
    counts: Counter[int] = Counter()
    for _ in range(ticks):
        inputs, outputs = world.robot.step(world.station.requests())
        world.station.observe(inputs, outputs, world.robot.bodies)
        counts.update(int.from_bytes(frame[7:10], "little") for _, frame in world.station.frames(outputs.time_ns))
    return counts


@pytest.mark.parametrize("name", sorted(STREAMS.keys() - {"HEARTBEAT"}))
def test_every_message_stops_comes_once_and_streams_as_it_is_asked_to(world: World, client: Client, name: str) -> None:
    world.station.picture.times = Times(0.1, (1,) * 20, (1,) * 20)  # of a loop on a clock; in lockstep nobody is late
    number = load_dialect().by_name[name].number
    client.command(511, number, -1)
    assert not sent(world, 210)[number]
    client.command(512, number)
    once = sent(world)[number]
    assert once > 0
    client.command(511, number, 250_000)
    assert sent(world, 100)[number] == 5 * once, "at once, and every 250 ms"


def test_message_interval_sets_the_rate_of_this_link_alone(world: World, client: Client) -> None:
    other = world.client(254)
    assert ask(world, client, 511, mavlink.MAVLINK_MSG_ID_ATTITUDE, 20_000) == mavlink.MAV_RESULT_ACCEPTED
    client.clear()
    other.clear()
    world.run(100)
    assert (len(client.all("ATTITUDE")), len(other.all("ATTITUDE"))) == (50, 10)
    ask(world, client, 511, mavlink.MAVLINK_MSG_ID_ATTITUDE, -1)
    client.clear()
    world.run(100)
    assert not client.all("ATTITUDE")
    assert ask(world, client, 510, mavlink.MAVLINK_MSG_ID_ATTITUDE) == mavlink.MAV_RESULT_ACCEPTED
    assert client.last("MESSAGE_INTERVAL").interval_us == -1


def test_heartbeat_cannot_be_switched_off(world: World, client: Client) -> None:
    assert ask(world, client, 511, mavlink.MAVLINK_MSG_ID_HEARTBEAT, -1) == mavlink.MAV_RESULT_DENIED


def test_request_message_sends_it_once(world: World, client: Client) -> None:
    ask(world, client, 511, mavlink.MAVLINK_MSG_ID_ATTITUDE, -1)
    assert ask(world, client, 512, mavlink.MAVLINK_MSG_ID_ATTITUDE) == mavlink.MAV_RESULT_ACCEPTED
    assert len(client.all("ATTITUDE")) == 1
    assert ask(world, client, 512, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == mavlink.MAV_RESULT_ACCEPTED
    assert client.last("AUTOPILOT_VERSION").capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    assert ask(world, client, 512, mavlink.MAVLINK_MSG_ID_VIBRATION) == mavlink.MAV_RESULT_UNSUPPORTED


def test_available_modes_are_told_one_by_one(world: World, client: Client) -> None:
    ask(world, client, 512, mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES, 0)
    modes = client.all("AVAILABLE_MODES")
    assert len(modes) == modes[0].number_modes and modes[0].mode_name == "Manual"
    ask(world, client, 512, mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES, 4)
    assert (client.last("AVAILABLE_MODES").custom_mode, client.last("AVAILABLE_MODES").mode_name) == (px4(4, 3), "Position Hold")
    assert ask(world, client, 512, mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES, 9) == mavlink.MAV_RESULT_DENIED


def test_home_position_can_be_asked_for(world: World, client: Client) -> None:
    assert ask(world, client, 410) == mavlink.MAV_RESULT_ACCEPTED
    assert client.all("HOME_POSITION")


# ---------------------------------------------------------------- commands


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
        assert acknowledged(world, client, number) <= mavlink.MAV_RESULT_FAILED


@pytest.mark.parametrize(("speed", "answer"), [(0.0, 2), (0.009, 2), (0.02, 0), (2.0, 0), (2.1, 2), (-1.0, 0), (-0.5, 2)])
def test_speed_that_would_never_arrive_is_denied(world: World, client: Client, speed: float, answer: int) -> None:
    assert ask(world, client, 178, 1, speed) == answer


@pytest.mark.parametrize("number", [20, 21])
def test_return_and_land_both_surface(world: World, client: Client, number: int) -> None:
    assert ask(world, client, number) == mavlink.MAV_RESULT_ACCEPTED
    assert world.robot.mode[0] == Mode.SURFACE


def test_component_zero_and_system_zero_are_accepted(world: World, client: Client) -> None:
    client.command(410, component=0)
    assert acknowledged(world, client, 410) == mavlink.MAV_RESULT_ACCEPTED
    client.clear()
    client.command(410, target=0, component=0)
    assert acknowledged(world, client, 410) == mavlink.MAV_RESULT_ACCEPTED
    client.clear()
    client.command(410, component=154)
    world.run(3)
    assert not client.all("COMMAND_ACK"), "another component's command is not ours"


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
def test_generic_identity_takes_px4s_mode_pairs(
    world: World, client: Client, main: float, sub: float, mode: Mode
) -> None:
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
    client.send("COMMAND_INT", 1, 1, 0, 31010, 0, 0, 0, 0, 1, 1, 2, 1, 0)
    world.run(2)
    assert world.robot.asked[-1].argument == DockRequest(0, 0, 1, 1, 2, True)


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


def test_dock_and_undock_are_user_commands() -> None:
    world = World(modules=2)
    client = world.client()
    client.command(31010, 0, 0, 1, 1, 2, 1)
    client.command(31011, 0, 0, 1, 1)
    world.run(2)
    wanted = [(Action.DOCK, DockRequest(0, 0, 1, 1, 2, True)), (Action.UNDOCK, DockRequest(0, 0, 1, 1))]
    assert [(r.action, r.argument) for r in world.robot.asked] == wanted
    assert ask(world, client, 31010, 0, 0, 0, 1) == mavlink.MAV_RESULT_DENIED


@pytest.mark.parametrize(
    "parameters", [(0, 6, 1, 1), (0, 0, 1, 6), (0, -1, 1, 1), (0, 0, 2, 1), (2, 0, 1, 1), (1, 0, 1, 1), (0, 0, 1, 1, 4)]
)
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


# ---------------------------------------------------------------- pilot and program


def test_manual_control_gives_six_axes(world: World, client: Client) -> None:
    client.send("MANUAL_CONTROL", 1, 1000, -500, 750, 250, 0, 0, 3, 100, -200)
    world.run(1)
    sticks = world.robot.asked[-1].argument
    assert sticks.force == pytest.approx((1.0, -0.5, -0.5)) and sticks.moment == pytest.approx((-0.2, 0.1, 0.25))
    client.send("MANUAL_CONTROL", 1, 0, 0, 500, 0, 0)
    world.run(1)
    assert max(map(abs, (*world.robot.asked[-1].argument.force, *world.robot.asked[-1].argument.moment))) == 0


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
    world = World(modules=2, config=GroundConfig(dock_button=(0, 0, 1, 1)))
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
    """As a script does that sends one channel at a time: UINT16_MAX ignores, 0 releases (MAVLink, RC_CHANNELS_OVERRIDE)."""

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
    """The hold is asked for, and the mode is still the old one."""
    ask(world, client, 400, 1)
    send_target(client, 0xDC7, vx=0.1)
    ask(world, client, 176, 1, 6)
    world.robot.refuse[Action.SET_MODE] = "not now"
    for gap in (51, 60):
        world.run(gap)
        send_target(client, 0xDC7, vx=0.5)
        world.run(2)
        assert world.robot.asked[-1].argument.p_wb == pytest.approx(world.robot.p_wb[0])


def test_velocity_setpoints_move_the_place_along(world: World, client: Client) -> None:
    ask(world, client, 400, 1)
    send_target(client, 0xDC7, vx=0.1)
    ask(world, client, 176, 1, 6)
    for _ in range(10):
        send_target(client, 0xDC7, vx=0.1)
        world.run(10)
    setpoints = [r.argument for r in world.robot.asked if r.action == Action.SET_POINT]
    assert setpoints[-1].v_w == pytest.approx([0.1, 0, 0])
    assert setpoints[-1].p_wb[0] - world.robot.p_wb[0][0] == pytest.approx(0.09, abs=0.02)


def test_setpoints_that_are_no_numbers_are_ignored(world: World, client: Client) -> None:
    send_target(client, 0xDF8, x=NAN)
    send_target(client, 0x9F8, x=0.1, yaw=NAN)
    send_target(client, 0xDF8, frame=99, x=0.1)
    world.run(2)
    assert not world.robot.asked


def test_body_frame_setpoints_turn_with_the_body(world: World, client: Client) -> None:
    send_target(client, 0xDF8, frame=9, x=0.1)
    world.run(1)
    p = world.robot.asked[-1].argument.p_wb - world.robot.p_wb[0]
    assert p == pytest.approx([0.1 * math.cos(0.3), 0.1 * math.sin(0.3), 0], abs=1e-6)


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
def test_axes_that_are_left_out_of_a_set_point_stay(
    world: World, client: Client, frame: int, mask: int, place: list[float]
) -> None:
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
