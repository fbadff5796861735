"""Signing: with a key set only its holder can act; the two defects of pymavlink's parser are absent."""

import hashlib
from pathlib import Path

import pytest

from firmware_py.core.types import Action
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.files import write_atomically
from firmware_py.ground.signing import FILE_MODE, Signing, load_signing, units_of
from tests.unit.ground_world import Client, World

KEY = bytes(range(1, 33))
NOW_NS = 1_800_000_000 * 1_000_000_000
NOW = units_of(NOW_NS)


def keyed_world(floor: int = 0) -> World:
    signing = Signing(key=KEY, floor=floor)
    signing.advance(NOW_NS)
    return World(signing=signing)


def with_key(client: Client, key: bytes = KEY, at: int = NOW, link: int = 0) -> Client:
    signing = client.mav.signing
    signing.secret_key, signing.timestamp, signing.link_id, signing.sign_outgoing = key, at, link, True
    return client


def armed(world: World, client: Client) -> bool:
    client.command(400, 1)
    world.run(3)
    return any(r.action == Action.ARM for r in world.robot.asked)


def test_signed_commands_act_and_what_we_send_is_signed() -> None:
    world = keyed_world()
    client = with_key(world.client())
    client.mav.signing.allow_unsigned_callback = None
    assert armed(world, client)
    assert client.last("COMMAND_ACK").get_signed()
    assert client.mav.signing.badsig_count == 0 and client.mav.signing.goodsig_count > 0


def test_signature_is_that_of_the_specification() -> None:
    signing = Signing(key=KEY, timestamp=41)
    tail = signing.sign(b"frame", 3)
    assert tail[:7] == bytes([3]) + (42).to_bytes(6, "little")
    assert tail[7:] == hashlib.sha256(KEY + b"frame" + tail[:7]).digest()[:6]


def test_unsigned_frames_do_nothing_once_keyed() -> None:
    world = keyed_world()
    client = world.client()
    client.heartbeat()
    assert not armed(world, client)
    assert not world.robot.asked, "an unsigned heartbeat is no ground station either"


def test_radio_status_is_the_one_message_that_is_believed_unsigned() -> None:
    world = keyed_world()
    client = world.client()
    before = world.station.counts["good"]
    client.send("RADIO_STATUS", 1, 1, 1, 1, 1, 1, 1)
    assert world.station.counts["good"] == before + 1


def test_wrong_key_is_refused_and_is_not_passed_as_unsigned() -> None:
    world = keyed_world()
    client = with_key(world.client(), key=bytes(32))
    client.send("RADIO_STATUS", 1, 1, 1, 1, 1, 1, 1)
    assert not armed(world, client)
    assert world.station.counts["good"] == 0 and world.station.signing.counts["bad"] == 2


def test_replayed_frames_are_refused() -> None:
    world = keyed_world()
    client = with_key(world.client())
    frame = client.pack("COMMAND_LONG", 1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    client.send_raw(frame)
    world.run(1)
    asked = len(world.robot.asked)
    for _ in range(5):
        client.send_raw(frame)
    world.run(2)
    assert len(world.robot.asked) == asked == 1


def test_one_forged_frame_from_the_future_does_not_lock_the_station_out() -> None:
    world = keyed_world()
    real = with_key(world.client())
    forger = with_key(world.client(), key=bytes(31) + b"x", at=2**47)
    forger.heartbeat()
    assert armed(world, real)


def test_a_stream_older_than_a_minute_or_than_the_last_start_is_refused() -> None:
    world = keyed_world()
    assert not armed(world, with_key(world.client(), at=NOW - 61 * 100_000))
    assert armed(world, with_key(world.client(), at=NOW - 59 * 100_000, link=1))
    world = keyed_world(floor=NOW)
    assert not armed(world, with_key(world.client(), at=NOW - 100))
    assert armed(world, with_key(world.client(), at=NOW + 100, link=1))


def setup(client: Client, key: bytes = KEY) -> None:
    client.send("SETUP_SIGNING", 1, 1, list(key), NOW)


def test_key_is_taken_only_disarmed_and_on_a_trusted_link(tmp_path: Path) -> None:
    config = GroundConfig(store=str(tmp_path))
    world = World(config=config)
    client = world.client()
    setup(client)
    assert world.station.signing.key is None
    world = World(config=config, trusted=True)
    client = world.client()
    client.command(400, 1)
    world.run(3)
    setup(client)
    assert world.station.signing.key is None
    client.command(400, 0)
    world.run(3)
    setup(client)
    assert world.station.signing.key == KEY
    assert "signing refused" in client.texts


def test_key_that_nothing_would_keep_is_refused_and_signing_may_still_be_ended() -> None:
    """Regression: a robot without a store took the key, and after a restart believed unsigned frames again."""
    world = World(trusted=True)
    client = world.client()
    setup(client)
    world.run(1)
    assert world.station.signing.key is None and client.texts == "signing refused: no --store to keep the key in"
    world.station.signing.adopt(KEY, NOW)
    setup(with_key(client), bytes(32))
    assert world.station.signing.key is None


def test_a_new_key_must_come_under_the_old_one_and_zeros_end_signing(tmp_path: Path) -> None:
    signing = Signing(key=KEY)
    signing.advance(NOW_NS)
    world = World(config=GroundConfig(store=str(tmp_path)), signing=signing, trusted=True)
    client = world.client()
    setup(client, bytes(range(2, 34)))
    assert world.station.signing.key == KEY
    setup(with_key(client), bytes(32))
    assert world.station.signing.key is None


def test_key_file_is_the_owners_alone_and_its_time_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "store" / "signing.json"
    signing = Signing()
    signing.adopt(KEY, NOW)
    signing.streams[(0, 255, 190)] = NOW + 500
    write_atomically(path, signing.to_json().encode(), FILE_MODE)
    assert path.stat().st_mode & 0o777 == 0o600
    again = load_signing(path)
    assert again.key == KEY and again.floor > NOW + 500 and again.timestamp == again.floor


def test_a_key_file_that_is_open_or_broken_is_no_reason_to_fly_without_key(tmp_path: Path) -> None:
    path = tmp_path / "signing.json"
    path.write_text(Signing(key=KEY).to_json())
    path.chmod(0o640)
    with pytest.raises(ValueError, match="chmod 600"):
        load_signing(path)
    path.chmod(0o600)
    for text in ("", "{}", '{"key": "12", "timestamp": 0}', '{"key": 5, "timestamp": 0}'):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"signing\.json"):
            load_signing(path)


def test_the_watched_station_is_exactly_one() -> None:
    """Its loss is not hidden by another system, another component or another type."""
    world = World()
    pilot, other = world.client(255, 190), world.client(254, 190)
    pilot.heartbeat()
    world.run(1)
    for stranger, kind in ((other, 6), (world.client(255, 191), 6), (pilot, 27)):
        stranger.heartbeat(kind)
        world.run(1)
    alive = [r for r in world.robot.asked if r.action == Action.GROUND_ALIVE]
    assert len(alive) == 1
    world.run(600)
    other.heartbeat()
    world.run(1)
    assert world.station.watch.station == (254, 190)


LAST = 2**48 - 1
MINUTE = 60 * 100_000


def test_the_last_time_stamp_is_the_last_one() -> None:
    signing = Signing(key=KEY, timestamp=LAST)
    assert [signing.sign(b"frame", 0)[1:7] for _ in range(2)] == [b"\xff" * 6] * 2
    signing.adopt(KEY, 2**64 - 1)
    assert signing.timestamp == LAST


@pytest.mark.parametrize(("stamp", "is_taken"), [(NOW + MINUTE, True), (NOW + MINUTE + 1, False), (LAST, False), (2**64 - 1, False)])
def test_key_from_more_than_a_minute_ahead_is_refused(stamp: int, is_taken: bool, tmp_path: Path) -> None:
    signing = Signing()
    signing.advance(NOW_NS)
    world = World(config=GroundConfig(store=str(tmp_path)), trusted=True, signing=signing)
    client = world.client()
    client.send("SETUP_SIGNING", 1, 1, list(KEY), stamp)
    world.run(1)
    assert (signing.key == KEY, signing.timestamp < NOW + 2 * MINUTE) == (is_taken, True)
    assert ("more than a minute ahead" in client.texts) == (not is_taken)


@pytest.mark.parametrize("stamp", [NOW + MINUTE + 1000, LAST - 10])
def test_signed_frames_from_more_than_a_minute_ahead_are_refused_and_the_station_goes_on(stamp: int) -> None:
    world = keyed_world()
    real, ahead = with_key(world.client()), with_key(world.client(), at=stamp, link=1)
    assert not armed(world, ahead)
    assert world.station.signing.counts["ahead"] == 1 and world.station.signing.timestamp < NOW + MINUTE
    assert armed(world, real)


def test_a_stream_that_is_known_does_not_leap_ahead_either() -> None:
    world = keyed_world()
    client = with_key(world.client())
    client.heartbeat()
    assert not armed(world, with_key(client, at=NOW + 2 * MINUTE))


def test_a_clock_that_is_behind_what_is_stored_locks_nobody_out() -> None:
    signing = Signing(key=KEY, timestamp=NOW, floor=NOW)
    signing.advance(NOW_NS - 3_600 * 1_000_000_000)
    world = World(signing=signing)
    assert armed(world, with_key(world.client(), at=NOW + 10 * MINUTE))


def test_station_that_followed_a_clock_which_was_ahead_may_stop_the_robot_when_that_is_set_right() -> None:
    """A time server corrects the robot's clock in flight; the station continues from the newest time stamp it heard."""
    signing = Signing(key=KEY)
    signing.advance(NOW_NS + 3_600 * 1_000_000_000)
    world = World(signing=signing)
    client = with_key(world.client())
    world.run(100)
    assert client.mav.signing.timestamp > NOW + 59 * MINUTE and armed(world, client)
    signing.advance(NOW_NS)
    client.command(31012)
    world.run(2)
    assert Action.ESTOP in [request.action for request in world.robot.asked]
