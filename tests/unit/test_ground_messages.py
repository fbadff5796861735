"""Telemetry as a client receives it, message by message, and the rates and messages it may request; through pymavlink's own parser."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink
from pymavlink.generator import mavgen

from firmware_py.app.deadlines import times_of
from firmware_py.core.failsafes import Level
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.rotations import rotate
from firmware_py.core.transitions import State
from firmware_py.core.types import NEVER_AGE_NS, Action, Mode
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.ground.dialect import load_dialect
from firmware_py.ground.identity import px4
from firmware_py.ground.picture import Picture
from firmware_py.ground.wire import checksum
from firmware_py.prepare.assembly import assemble_vehicle
from firmware_py.runtime.clock import MonotonicClock
from firmware_py.runtime.rate_keeper import RateKeeper
from tests.unit.ground_requests import ask
from tests.unit.ground_world import PERIOD_NS, Client, World
from tests.unit.module_at_rest import resting

# ---------------------------------------------------------------- telemetry


def test_every_streamed_message_arrives_with_the_robots_values(world: World, client: Client) -> None:
    world.run(450)
    p, v = world.robot.p_wb[0], rotate(world.robot.q_wb[0], np.ascontiguousarray(world.robot.nu[:3]))
    local = client.last("LOCAL_POSITION_NED")
    assert [local.x, local.y, local.z] == pytest.approx(p.tolist(), abs=1e-6)
    assert [local.vx, local.vy, local.vz] == pytest.approx(v.tolist(), abs=1e-6)
    quaternion = client.last("ATTITUDE_QUATERNION")
    assert [quaternion.q1, quaternion.q2, quaternion.q3, quaternion.q4] == pytest.approx(world.robot.q_wb[0].tolist(), abs=1e-6)
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
    assert (client.last("SCALED_PRESSURE").temperature, client.last("SCALED_PRESSURE2").temperature) == (2550, 1275)
    assert client.last("EXTENDED_SYS_STATE").landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND
    assert client.last("HOME_POSITION").latitude == 302084000
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_NO_MISSION
    named = {m.name: m.value for m in client.all("NAMED_VALUE_FLOAT")}
    assert named["DOCK0+X"] == pytest.approx(0.1) and named["WRENCH_MRG"] == 0.75
    assert client.last("CURRENT_MODE").custom_mode == px4(4, 3)
    assert client.all("DEBUG_FLOAT_ARRAY") == [] and client.last("SYS_STATUS").load == 0  # no tick is late in lockstep


ROLL, PITCH, YAW = 0.1, -0.2, 0.3
"""Attitude of the robot, which stands still. The rotation is written out here, so as not to use the firmware's."""


def told_of_motion() -> dict[tuple[str, str], float]:
    """Expected telemetry by message and field for an origin 12.5 m above the sea, in MAVLink's units: rad, cm/s, mm, deg and so on."""
    ahead, below = (
        np.array([[math.cos(YAW), -math.sin(YAW), 0], [math.sin(YAW), math.cos(YAW), 0], [0, 0, 1]])
        @ [[math.cos(PITCH), 0, math.sin(PITCH)], [0, 1, 0], [-math.sin(PITCH), 0, math.cos(PITCH)]]
        @ [[1, 0, 0], [0, math.cos(ROLL), -math.sin(ROLL)], [0, math.sin(ROLL), math.cos(ROLL)]]
    ).T[[0, 2]]
    north, east, down = 0.05 * ahead - 0.02 * below
    rates = {"rollspeed": 0.01, "pitchspeed": 0.02, "yawspeed": 0.03}
    told = {
        "ATTITUDE": {"roll": ROLL, "pitch": PITCH, "yaw": YAW, **rates},
        "ATTITUDE_QUATERNION": rates,
        "ODOMETRY": {"x": 0.0, "y": 0.2, "z": 0.5, "vy": 0.0, "quality": 100, **rates},
        "LOCAL_POSITION_NED": {"vx": north, "vy": east, "vz": down},
        "GLOBAL_POSITION_INT": {
            "vx": round(100 * north), "vy": round(100 * east), "vz": round(100 * down),
            "hdg": round(100 * math.degrees(YAW)), "alt": 12_000,
        },
        "VFR_HUD": {
            "groundspeed": math.hypot(north, east), "climb": -down, "alt": 12.0,
            "throttle": round(100 * np.abs(np.linspace(-1, 1, 8)).mean()),
        },
        "SYS_STATUS": {"voltage_battery": 12_100, "current_battery": 250, "battery_remaining": -1},
        "BATTERY_STATUS": {"temperature": 32767, "current_consumed": -1, "energy_consumed": -1, "battery_remaining": -1, "id": 0},
        "HOME_POSITION": {"longitude": 1201614000, "altitude": 12_500},
        "SERVO_OUTPUT_RAW": {"port": 0, "servo4_raw": round(1500 - 400 / 7), "servo9_raw": 0},
    }  # fmt: skip
    return {(message, field): value for message, fields in told.items() for field, value in fields.items()}


@pytest.mark.parametrize(("message", "field"), told_of_motion())
def test_number_that_is_told_is_in_the_unit_of_its_field(message: str, field: str) -> None:
    world = World(altitude_m=12.5)
    client = world.client()
    client.command(512, getattr(mavlink, f"MAVLINK_MSG_ID_{message}"))
    world.run(2)
    assert getattr(client.last(message), field) == pytest.approx(told_of_motion()[message, field], abs=1e-6)


def test_time_of_each_message_is_that_of_its_tick(world: World, client: Client) -> None:
    world.run(400)
    for message in client.inbox[-60:]:
        for field, per_second in (("time_boot_ms", 1_000), ("time_usec", 1_000_000)):
            if hasattr(message, field):
                told = getattr(message, field) / per_second
                assert round(told * 100) == pytest.approx(told * 100) and 3.0 < told <= world.time_ns / 1e9


def test_all_that_dronekit_waits_for_comes_by_itself(world: World, client: Client) -> None:
    """By default DroneKit waits for parameters, gps_0, armed, mode and attitude. It requests the parameters itself."""
    world.run(200)
    assert client.all("HEARTBEAT") and client.all("ATTITUDE")
    gps = client.last("GPS_RAW_INT")
    assert (gps.fix_type, gps.satellites_visible) == (mavlink.GPS_FIX_TYPE_NO_GPS, 0)
    assert (gps.eph, gps.epv, gps.vel, gps.cog) == (65535, 65535, 65535, 65535), "unknown"


def test_odometry_counts_how_often_the_estimate_began_anew() -> None:
    world = World(2)
    client = world.client()

    def counted(**changed: object) -> int:
        for name, value in changed.items():
            setattr(world.robot, name, value)
        world.run(20)
        return int(client.last("ODOMETRY").reset_counter)

    assert counted() == 0
    assert counted(ready=False) == 0 and counted(ready=True) == 1
    assert counted(tag_age_ns=11_000_000_000) == counted(tag_age_ns=30_000_000) == 1, "a coasted estimate goes on"
    assert counted(starts=2) == 2, "one that starts anew is elsewhere, and may stay ready"
    world.robot.dock()
    assert counted() == 3, "the middle of two modules is elsewhere"
    world.station.picture.restarts[0] = 257
    assert counted() == 1


def test_first_pose_is_no_restart() -> None:
    world = World()
    world.robot.ready, world.station.picture.restarts, world.station.picture.records = False, {}, {}
    client = world.client()
    world.run(20)
    world.robot.ready = True
    world.run(20)
    assert client.last("ODOMETRY").reset_counter == 0


@pytest.mark.slow
@pytest.mark.parametrize(("jump_m", "blind_ticks", "counted"), [(0.0, 0, 0), (1.0, 0, 1), (0.0, 900, 0), (0.0, 1100, 1)])
def test_estimate_that_is_thrown_away_for_what_tags_say_is_counted(jump_m: float, blind_ticks: int, counted: int) -> None:
    """Where tags contradict it, or give a place to one that was adrift, without tags for more than ten seconds."""
    pipeline = Pipeline([assemble_vehicle(load_vehicle("modcube"))], Parameters(), PERIOD_NS)
    picture = Picture(1, lambda: Parameters().supervision)
    for tick in range(1, 300 + blind_ticks):
        inputs = resting(tick, [])
        tag = inputs.modules[0].tags.pop()
        if not 150 <= tick < 150 + blind_ticks:
            inputs.modules[0].tags = [tag._replace(p_wt=np.add(tag.p_wt, [jump_m if tick > 150 else 0.0, 0.0, 0.0]))]
        picture.observe(inputs, pipeline.step(inputs), pipeline.bodies)
    assert picture.records[0].estimate.p_wb[0] == pytest.approx(0.1 + jump_m, abs=0.01)
    assert picture.restarts == {0: counted}


def test_robot_on_a_clock_tells_how_its_ticks_keep_their_deadlines(world: World, client: Client) -> None:
    keeper = RateKeeper(10_000_000, MonotonicClock(), lambda deadline_ns: None)
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
    client.send("PARAM_SET", 1, 1, b"TAG_FRESH_MS", 3000.0, 9)
    world.run(100)
    assert client.last("SYS_STATUS").onboard_control_sensors_health & vision, "as old as arming permits from now on"


def test_heartbeat_tells_at_once_of_another_mode_of_arming_and_of_an_emergency_stop(world: World, client: Client) -> None:
    """Regression: a pilot saw each change up to a second later. ArduSub sends one extra heartbeat too."""
    world.run(130)
    for number, *parameters in ((400, 1), (176, 1, 1), (31012,)):
        client.clear()
        client.command(number, *parameters)
        world.run(2)
        told = [(m.base_mode, m.custom_mode, m.system_status) for m in client.all("HEARTBEAT")]
        assert len(told) == 1, "once"
        world.run(50)
    assert told[0][2] == mavlink.MAV_STATE_EMERGENCY
    client.clear()
    world.run(300)
    assert len(client.all("HEARTBEAT")) == 3


def test_heartbeat_of_what_changes_in_every_tick_leaves_room_on_a_radio(world: World, client: Client) -> None:
    """Regression: two stations that fought over the mode filled the radio with a hundred heartbeats a second, which take precedence."""
    client.clear()
    for tick in range(200):
        world.robot.mode[0] = (Mode.POSHOLD, Mode.MANUAL)[tick % 2]
        world.run(1)
    assert 18 <= len(client.all("HEARTBEAT")) <= 20
    world.robot.mode[0] = Mode.STABILIZE
    world.run(11)
    modes = [m.custom_mode for m in client.all("HEARTBEAT")]
    assert modes[-1] not in modes[:-1], "the last is told soon"


def test_heartbeat_is_critical_while_a_fail_safe_flies(world: World, client: Client) -> None:
    world.robot.level = Level.SURFACE
    world.run(100)
    assert client.last("HEARTBEAT").system_status == mavlink.MAV_STATE_STANDBY
    world.robot.state[0] = State.ARMED
    world.run(100)
    assert client.last("HEARTBEAT").system_status == mavlink.MAV_STATE_CRITICAL
    world.robot.level = Level.NONE
    world.run(100)
    assert client.last("HEARTBEAT").system_status == mavlink.MAV_STATE_ACTIVE


def test_battery_of_which_nothing_is_heard_any_more_is_not_well(world: World, client: Client) -> None:
    hears = world.robot._inputs
    world.run(100)
    assert client.last("SYS_STATUS").onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    world.robot._inputs = lambda: replace(hears(), voltage_v=None, current_a=None)  # type: ignore[method-assign]
    world.run(200)
    assert not client.last("SYS_STATUS").onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_BATTERY


def test_robot_that_no_camera_has_seen_knows_its_attitude_and_depth_and_no_heading(world: World, client: Client) -> None:
    world.robot.tag_age_ns = NEVER_AGE_NS
    world.run(200)
    health = client.last("SYS_STATUS").onboard_control_sensors_health
    assert health & mavlink.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION and health & mavlink.MAV_SYS_STATUS_SENSOR_Z_ALTITUDE_CONTROL
    assert not health & (mavlink.MAV_SYS_STATUS_SENSOR_YAW_POSITION | mavlink.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL)
    assert client.last("GLOBAL_POSITION_INT").hdg == 65535


def test_esc_messages_decode_with_a_dialect_that_mavgen_made(world: World, client: Client, tmp_path: Path) -> None:
    """An independent decoder: mavgen's own code, generated from the XML in the repository."""
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
    over_temperature, generic, can = 4, 64, 4  # ESC_FAILURE_FLAGS and ESC_CONNECTION_TYPE of MAVLink's own common.xml
    assert [(m.count, m.info, m.connection_type) for m in info] == [(8, 0b1100, can), (8, 0b0001, can)], "the others are silent"
    assert [m.failure_flags for m in info] == [[0, 0, 0, over_temperature], [generic, 0, 0, 0]]


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


def test_no_message_of_the_old_protocol_is_as_long_as_the_first_byte_of_the_new_one_says() -> None:
    """A length byte of 253 is therefore the start of the next frame, where the Framer resumes."""
    assert 0xFD not in {d.struct.size for d in load_dialect().by_number.values() if d.number < 256}


def test_refusals_and_failsafes_reach_the_client_as_text(world: World, client: Client) -> None:
    world.robot.refuse[Action.ARM] = "pose is 700 ms old, 500 permitted, and some more that makes it long"
    assert ask(world, client, 400, 1) == mavlink.MAV_RESULT_DENIED
    texts = client.all("STATUSTEXT")
    assert "".join(t.text for t in texts).startswith("ARM refused: pose is 700 ms old")
    assert texts[0].id == texts[1].id != 0 and [t.chunk_seq for t in texts] == [0, 1]
