"""A radio on a serial line that is slow, accepts nothing for a while, and is unplugged and plugged in again."""

import errno
import math
import os
import pty
import socket
import termios
import threading
from collections import Counter
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import serial
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.core.types import Action, Event
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.link import Links
from firmware_py.ground.link_address import LinkError
from firmware_py.ground.signing import Signing
from firmware_py.ground.telemetry import DEFAULT_HZ
from firmware_py.ground.wire import checksum
from tests.unit.ground_attack import KEY, NOW
from tests.unit.ground_sides import PATIENCE_S, free_port, heartbeat, pump, received, side_on
from tests.unit.ground_world import Robot, World


def test_radio_that_takes_nothing_holds_up_nobody() -> None:
    """pyserial's own write would spin."""
    ours, theirs = pty.openpty()
    port = free_port()
    with (
        closing(side_on(f"{os.ttyname(theirs)},57600", f"udpin:127.0.0.1:{port}")) as side,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as station,
    ):
        robot = Robot()
        done = threading.Thread(target=pump, args=(side, robot, 600), daemon=True)
        done.start()
        done.join(4 * PATIENCE_S)
        assert not done.is_alive(), "it hangs in the write"
        mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        stop = mavlink.MAVLink_command_long_message(1, 1, 31012, 0, 0, 0, 0, 0, 0, 0, 0).pack(mav)
        station.sendto(bytes(stop), ("127.0.0.1", port))
        assert Action.ESTOP in [request.action for request in pump(side, robot, 3)]
    os.close(ours)


def test_radio_status_makes_nobody_believed() -> None:
    """RADIO_STATUS is accepted unsigned from anybody."""
    station = World().station
    mav = mavlink.MAVLink(None, srcSystem=51, srcComponent=68)
    assert not station.take(3, bytes(mavlink.MAVLink_radio_status_message(0, 0, 0, 0, 0, 0, 0).pack(mav)), 0)
    assert station.take(3, heartbeat(), 0)


@pytest.mark.parametrize("noise", [b"\xfd", b"\xfe", b"\xfd\xfd", b"\xfe\xfe", b"\xfe\xfd", b"\xfd\x00\xfe"])
def test_stop_behind_noise_that_looks_like_the_start_of_a_frame_is_heard_at_once(noise: bytes) -> None:
    """Regression: the Framer waited for as many bytes as the length in the noise stated: ten seconds at a heartbeat a second."""
    world = World()
    client = world.client()
    stop = client.pack("COMMAND_LONG", 1, 1, 31012, 0, *[0] * 7)
    assert world.station.take(client.channel, noise + stop, world.time_ns, datagram=False)
    world.run(1)
    assert [request.action for request in world.robot.asked] == [Action.ESTOP]


@pytest.mark.parametrize("signing", [Signing(), Signing(key=KEY, timestamp=NOW)])
def test_stop_behind_a_byte_of_the_old_protocol_is_heard_at_once_whatever_its_number(signing: Signing) -> None:
    """Regression: for 3 of 256 sequence numbers the byte was taken for the start of one of the longest messages."""
    station = World(signing=signing).station
    client = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    client.signing.secret_key, client.signing.timestamp, client.signing.sign_outgoing = KEY, NOW, signing.key is not None
    for client.seq in range(256):
        stop = mavlink.MAVLink_command_long_message(1, 1, 31012, 0, *[0] * 7).pack(client)
        assert station.take(0, b"\xfe" + bytes(stop), 0, datagram=False), client.seq


TORN = bytes(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, [7] * 251).pack(mavlink.MAVLink(None, 255, 190)))[:20]
"""The first 20 bytes of a frame of 266 bytes."""


def test_stop_behind_a_torn_frame_is_heard_once_nothing_more_comes_of_it() -> None:
    """Regression: the Framer waited for the rest of the torn frame: ten seconds at a heartbeat a second."""
    world = World()
    client = world.client()
    stop = client.pack("COMMAND_LONG", 1, 1, 31012, 0, *[0] * 7)
    world.station.take(client.channel, TORN + stop, world.time_ns, datagram=False)
    world.run(52)
    assert [request.action for request in world.robot.asked] == [Action.ESTOP]


def test_stop_behind_a_torn_frame_in_one_datagram_is_heard_at_once() -> None:
    """Bridges from a radio to a network send such datagrams. Regression: the stop was discarded with the torn frame before it."""
    world = World()
    client = world.client()
    stop = client.pack("COMMAND_LONG", 1, 1, 31012, 0, *[0] * 7)
    assert world.station.take(client.channel, TORN + stop + TORN, world.time_ns)
    world.run(1)
    assert [request.action for request in world.robot.asked] == [Action.ESTOP]
    assert not any(world.station.take(client.channel, half, world.time_ns) for half in (stop[:20], stop[20:])), "a datagram is whole"


def test_torn_frame_of_a_link_that_is_gone_is_forgotten() -> None:
    world = World()
    client = world.client()
    world.station.take(client.channel, TORN, world.time_ns, datagram=False)
    world.station.leave(client.channel)
    world.run(60)


@pytest.mark.parametrize("trusted", [False, True])
def test_key_behind_a_torn_frame_is_taken_from_a_trusted_link_alone(trusted: bool, tmp_path: Path) -> None:
    world = World(config=GroundConfig(store=str(tmp_path)))
    client = world.client()
    setup = client.pack("SETUP_SIGNING", 1, 1, list(KEY), NOW)
    world.station.take(client.channel, TORN + setup, world.time_ns, datagram=False, trusted=trusted)
    world.run(52)
    assert (world.station.signing.key == KEY) == trusted


def test_frame_that_comes_in_parts_is_put_together_while_they_follow_each_other() -> None:
    world = World()
    client = world.client()
    stop = client.pack("COMMAND_LONG", 1, 1, 31012, 0, *[0] * 7)
    for part in (stop[:1], stop[1:15], stop[15:]):
        world.station.take(client.channel, part, world.time_ns, datagram=False)
        world.run(40)
    assert [request.action for request in world.robot.asked] == [Action.ESTOP]


def test_frame_of_the_old_protocol_is_no_longer_than_its_message_and_one_of_the_new_may_have_grown() -> None:
    station = World().station
    heartbeat_1 = b"\xfe\x0a\x00\xff\xbe\x00" + bytes(8)  # ten payload bytes; HEARTBEAT has nine
    assert not station.take(0, heartbeat_1, 0, datagram=False) and station.counts["length"] == 1
    grown = bytes([10, *heartbeat()[2:10], *bytes(9), 7])
    frame = b"\xfd" + grown + checksum(grown, mavlink.MAVLink_heartbeat_message.crc_extra).to_bytes(2, "little")
    assert station.take(0, frame, 0, datagram=False)


def test_frame_with_a_flag_that_nobody_here_knows_is_not_believed() -> None:
    """MAVLink: such a flag may mean anything, even another payload."""
    station = World().station
    unknown = bytes([9, 0x02, *heartbeat()[3:-2]])
    frame = b"\xfd" + unknown + checksum(unknown, mavlink.MAVLink_heartbeat_message.crc_extra).to_bytes(2, "little")
    assert not station.take(0, frame, 0, datagram=False) and station.counts["flags"] == 1
    assert station.take(0, heartbeat(), 0, datagram=False)


class SlowLink:
    """A radio that carries a limited number of bytes a tick."""

    datagram, is_open = False, True

    def __init__(self, bytes_per_tick: float) -> None:
        self.bytes_per_tick, self.room, self.frames = bytes_per_tick, 0.0, list[bytes]()

    def receive(self) -> list[tuple[Any, bytes]]:
        """Adds one tick's bytes to the budget; called once a tick."""
        self.room = min(self.room + self.bytes_per_tick, 300.0)
        return []

    def send(self, peer: Any, frame: bytes) -> bool:
        if self.room < len(frame):
            return False
        self.room -= len(frame)
        self.frames.append(frame)
        return True

    def peers(self) -> list[None]:
        return [None]

    def close(self) -> None:
        """Does nothing: there is nothing to release."""


@pytest.mark.slow
def test_radio_slower_than_what_streams_gets_less_of_everything_and_every_heartbeat_and_text(monkeypatch: pytest.MonkeyPatch) -> None:
    radio, robot = SlowLink(57.6), Robot(modules=4)  # 57,600 Bd at 100 Hz
    monkeypatch.setattr("firmware_py.ground.link.open_link", lambda address, warn: radio)
    with closing(side_on("radio", modules=4)) as side:
        for second in range(20):
            pump(side, robot, 99)
            robot.events.append(Event(6, f"second {second}", 0))
            pump(side, robot, 1)
            side.station.services[1].parameters._list(SimpleNamespace(channel=0))  # type: ignore[arg-type]
        pump(side, robot, 300)
        assert not side.links.dropped
    parser = mavlink.MAVLink(None)
    got = Counter((m.get_srcSystem(), m.get_type()) for frame in radio.frames for m in parser.parse_buffer(frame))
    names = {name for name, hz in DEFAULT_HZ.items() if hz >= 1} - {"ESC_STATUS"}  # pymavlink does not know it here
    for system in (1, 2, 3, 4):
        assert 21 <= got[system, "HEARTBEAT"] <= 24
        assert all(got[system, name] >= 3 for name in names)
        assert got[system, "ATTITUDE"] < 100  # of the 230 due
    assert got[1, "STATUSTEXT"] == 20
    assert got[1, "PARAM_VALUE"] >= 20


def test_what_a_companion_computer_streams_to_all_leaves_a_radio_its_telemetry_and_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a hundred estimates a second filled the radio's queue; the station got one message of each kind, and answers 4 s late."""
    radio, cable, robot = SlowLink(57.6), SlowLink(math.inf), Robot()
    links = iter((radio, cable))
    monkeypatch.setattr("firmware_py.ground.link.open_link", lambda address, warn: next(links))
    companion = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    estimate = bytes(mavlink.MAVLink_vision_position_estimate_message(0, 1, 2, 3, 0.1, 0.2, 0.3, [0.1] * 21).pack(companion))
    seldom = (mavlink.MAVLink_param_value_message(b"EXPOSURE", 1.0, 9, 1, 0), mavlink.MAVLink_message_interval_message(30, 100_000))
    often = (
        mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4, 3),
        mavlink.MAVLink_statustext_message(6, b"seen"),
        mavlink.MAVLink_command_long_message(0, 0, 400, 0, 0, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_manual_control_message(255, 0, 0, 0, 0, 0),
    )
    said = {30: (*seldom, *often), 60: often}
    """Messages by tick within each second."""
    with closing(side_on("radio", "cable")) as side:
        side.station.take(0, heartbeat(), 0)
        for second in range(10):
            robot.events.append(Event(6, f"second {second}", 0))
            for tick in range(100):
                side.station.take(1, estimate, robot.tick * 10_000_000)
                side.station.take(1, b"".join(bytes(m.pack(companion)) for m in said.get(tick, ())), robot.tick * 10_000_000)
                pump(side, robot)
        assert not side.links.dropped
    parser = mavlink.MAVLink(None)
    got = Counter((m.get_srcComponent(), m.get_type()) for frame in radio.frames for m in parser.parse_buffer(frame))
    assert got[1, "STATUSTEXT"] == 10 and got[1, "HEARTBEAT"] >= 10
    assert [got[191, message.get_type()] for message in often] == [20] * len(often)
    assert [got[191, message.get_type()] for message in seldom] == [10] * len(seldom), "answers that name nobody"
    assert got[1, "ATTITUDE"] > 20 and got[191, "VISION_POSITION_ESTIMATE"] > 20


def test_client_that_asks_in_a_loop_for_what_is_refused_leaves_a_radio_its_telemetry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each refusal was said to all, at the rate of the loop; nothing else fitted through the radio."""
    radio, cable, robot = SlowLink(57.6), SlowLink(math.inf), Robot()
    robot.refuse[Action.ARM] = "the pose is 1.2 s old; the battery of module 1 is not known; every axis needs thrust, and there is none"
    links = iter((radio, cable))
    monkeypatch.setattr("firmware_py.ground.link.open_link", lambda address, warn: next(links))
    program = mavlink.MAVLink(None, srcSystem=250, srcComponent=1)
    arm = bytes(mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0).pack(program))
    with closing(side_on("radio", "cable")) as side:
        for _ in range(250):
            side.station.take(1, arm, robot.tick * 10_000_000)
            pump(side, robot, 4)
        assert not side.links.dropped
    parser = mavlink.MAVLink(None)
    got = Counter(m.get_type() for frame in radio.frames for m in parser.parse_buffer(frame))
    assert 9 * 3 <= got["STATUSTEXT"] <= 11 * 3, "in three pieces, once in a second"
    assert got["ATTITUDE"] > 50


def test_serial_link_carries_frames_both_ways() -> None:
    ours, theirs = pty.openpty()
    links = Links([f"{os.ttyname(theirs)},115200"])
    with closing(links):
        os.write(ours, heartbeat())
        assert b"".join(r.data for r in received(links, 1))[:1] == b"\xfd"
        links.send(None, b"answer")
        links.flush()
        assert os.read(ours, 100) == b"answer"
    os.close(ours)
    os.close(theirs)


class Radio:
    """A serial device behind a symbolic link, as udev names it: plugged in until it is pulled."""

    def __init__(self, name: Path) -> None:
        self.ours, self._theirs = pty.openpty()
        self._name = name
        name.symlink_to(os.ttyname(self._theirs))

    def pull(self) -> None:
        self._name.unlink()
        os.close(self.ours)
        os.close(self._theirs)


def _talks(links: Links, radio: Radio) -> None:
    """Asserts that the link is opened at the next look, and then carries bytes both ways."""
    assert list(links.receive()) == []  # opens it
    os.write(radio.ours, heartbeat())
    assert b"".join(r.data for r in received(links, 1)) == heartbeat()
    links.send(None, b"answer")
    links.flush()
    assert os.read(radio.ours, 100) == b"answer"


def test_radio_that_is_pulled_and_plugged_in_again_is_taken_up_again(tmp_path: Path) -> None:
    name = tmp_path / "radio"
    radio = Radio(name)
    with closing(Links([f"{name},115200"])) as links:
        radio.pull()
        for _ in range(3):  # the first pass detects it
            links.send(None, b"to nobody")
            links.flush()
            assert list(links.receive()) == []
        assert links.counts["send"] + links.counts["receive"] == 1
        radio = Radio(name)
        _talks(links, radio)
    radio.pull()


def test_radio_that_is_not_plugged_in_yet_is_warned_of_and_taken_up_when_it_is(tmp_path: Path) -> None:
    """Regression: a robot that was restarted after its radio had come loose did not start."""
    name = tmp_path / "radio"
    with closing(Links([f"{name},115200"])) as links:
        assert links.warnings == [f"link {name},115200: not there yet: No such file or directory; it is opened when it is there"]
        links.send(None, b"to nobody")
        links.flush()
        assert list(links.receive()) == [] and not links.opened
        radio = Radio(name)
        _talks(links, radio)
        radio.pull()
        links.send(None, b"to nobody")
        links.flush()
        radio = Radio(name)
        _talks(links, radio)
        assert links.opened == [f"link {name},115200: is there now"]
    radio.pull()


def test_radio_that_refuses_its_rate_once_it_is_there_makes_no_other_link_deaf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pyserial raises ValueError, which is no OSError."""
    def refuse(*_: object, **__: object) -> None:
        raise ValueError("Failed to set custom baud rate (250001): [Errno 22] Invalid argument")

    name = tmp_path / "radio"
    with closing(Links([f"{name},250001"])) as links:
        name.write_text("")
        monkeypatch.setattr("firmware_py.ground.transport.serial.Serial", refuse)
        assert list(links.receive()) == []
        with pytest.raises(LinkError, match="cannot be opened: Failed to set custom baud rate"):
            Links([f"{name},250001"])


def test_radio_that_nobody_may_use_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object, **more: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(LinkError, match="cannot be opened: Permission denied"):
        Links([f"{tmp_path / 'radio'},115200"])


def test_radio_that_is_pulled_while_it_is_taken_up_again_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = tmp_path / "radio"
    radio = Radio(name)
    with closing(Links([f"{name},115200"])) as links:
        radio.pull()
        assert list(links.receive()) == []
        radio = Radio(name)
        with monkeypatch.context() as pulled:
            pulled.setattr(termios, "tcflush", broken)
            assert list(links.receive()) == []
        assert list(links.receive()) == []  # reopens it
        os.write(radio.ours, heartbeat())
        assert b"".join(r.data for r in received(links, 1)) == heartbeat()
    radio.pull()


def broken(descriptor: int, queue: int) -> None:
    """Fails as a device that is gone does."""
    raise termios.error(5, "Input/output error")
