"""The ground side beside the tick: who is trusted, what is handed over in time, and failures that do no harm."""

import os
import pty
import socket
import struct
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from queue import Queue

import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.app.ground_station import GroundSide
from firmware_py.core.types import Action
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.signing import load_signing
from tests.unit.ground_sides import PATIENCE_S, firmware_of, free_port, heartbeat, pump, side_on
from tests.unit.ground_world import Robot


def test_strangers_neither_end_the_ground_side_nor_take_the_place_of_a_station_that_is_believed() -> None:
    port = free_port()
    with closing(side_on(f"udpin:127.0.0.1:{port}")) as side, closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as station:
        robot = Robot()
        station.settimeout(PATIENCE_S)
        station.sendto(heartbeat(), ("127.0.0.1", port))
        while not any(channel.believed for channel in side.links.channels.values()):
            pump(side, robot)
        (known,) = side.links.channels
        strangers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(40)]
        for stranger in strangers:
            stranger.sendto(b"x", ("127.0.0.1", port))
            stranger.close()
        pump(side, robot, 3)
        assert known in side.links.channels and len(side.links.channels) == 16
        assert station.recv(300)


def test_tcp_client_is_spoken_to_before_it_has_said_anything() -> None:
    port = free_port()
    side = side_on(f"tcpin:127.0.0.1:{port}")
    with closing(side), closing(socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)) as client:
        pump(side, Robot(), 150)
        assert client.recv(300)[0] == 0xFD


def test_newcomer_to_a_full_tcp_link_ends_nobody_who_was_believed_and_one_stranger_at_the_most() -> None:
    port = free_port()
    with closing(side_on(f"tcpin:127.0.0.1:{port}")) as side, ExitStack() as stack:
        robot, clients = Robot(), []

        def connect(says: bytes) -> None:
            clients.append(stack.enter_context(closing(socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S))))
            clients[-1].sendall(says)
            pump(side, robot, 2)

        for _ in range(15):
            connect(heartbeat())
        believed = set(side.links.channels)
        connect(b"x")
        for _ in range(3):
            for client in clients[:16]:
                with suppress(OSError):
                    client.sendall(b"x")
            connect(heartbeat())
        assert believed < set(side.links.channels)
        assert len(side.links.channels) == 16
        assert all(channel.believed for channel in side.links.channels.values())


def test_tcp_client_that_breaks_off_is_no_channel_any_more() -> None:
    port = free_port()
    with closing(side_on(f"tcpin:127.0.0.1:{port}")) as side:
        client, robot = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S), Robot()
        pump(side, robot, 2)
        assert side.links.channels
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.close()
        side.links.send(None, b"x")
        side.links.flush()  # the loss is detected here
        pump(side, robot, 2)
        assert not side.links.channels


def test_stop_is_handed_over_however_much_else_is_asked() -> None:
    side = side_on(f"udpin:127.0.0.1:{free_port()}")
    with closing(side):
        pump(side, Robot())
        system = side.station.services[1].system
        for action in [*[Action.SET_POINT] * 300, Action.ESTOP, *[Action.SET_POINT] * 300]:
            system.ask(action)
        side.pump()
        asked = [request.action for request in side.requests()]
        assert Action.ESTOP in asked and len(asked) == 257


def test_parameters_that_come_at_once_all_reach_the_flight_of_a_fleet() -> None:
    """Regression: requested once per body, 36 of a hundred parameters with four bodies were echoed, announced to all, and never applied."""
    client = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    with closing(side_on("udpin:127.0.0.1:0", modules=4)) as side:
        pump(side, robot := Robot(4), 2)
        wanted = dict(list(side.station.store.names.items())[:100])
        for name in wanted:
            value = side.station.store.get(name)
            side.station.take(0, bytes(mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, 9).pack(client)), 0)
        asked = pump(side, robot)
    assert [request.argument[0] for request in asked] == [dotted for dotted, _ in wanted.values()]


def side_with_store(store: Path) -> GroundSide:
    config = GroundConfig(links=(f"udpin:127.0.0.1:{free_port()}",), store=str(store))
    return GroundSide(config, firmware_of(bodies=Robot().bodies), ThreadPoolExecutor(1))


@pytest.mark.parametrize("keys", [1, 2, 3])
def test_new_key_is_stored_at_once_for_the_robot_may_be_restarted_next(keys: int, tmp_path: Path) -> None:
    with closing(side_with_store(tmp_path)) as side:
        robot = Robot()
        pump(side, robot, 200)
        for key in (bytes(range(32)), bytes(range(1, 33)), bytes(32))[:keys]:
            side.station.signing.adopt(key, 0)
            pump(side, robot)
    assert load_signing(tmp_path / "signing.json").key == side.station.signing.key
    assert (tmp_path / "signing.json").stat().st_mode & 0o777 == 0o600


def test_stop_is_heard_while_the_disk_stands_still(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: the thread that hears stops waited for the disk at each PARAM_SET, for seconds on a bad memory card."""
    client, disk, written = mavlink.MAVLink(None, srcSystem=255, srcComponent=190), threading.Event(), threading.Event()
    fsync = os.fsync

    def stand_still(descriptor: int) -> None:
        written.set()
        assert disk.wait(60.0)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", stand_still)
    with closing(side_with_store(tmp_path)) as side:
        pump(side, robot := Robot(), 2)
        for message in (
            mavlink.MAVLink_param_set_message(1, 1, b"POS_BW", 2.5, 9),
            mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_DO_FLIGHTTERMINATION, 0, 1.0, 0, 0, 0, 0, 0, 0),
        ):
            side.station.take(0, bytes(message.pack(client)), 0)
            asked = pump(side, robot)
        assert written.wait(60.0), "the disk has work"
        assert Action.ESTOP in [request.action for request in asked]
        disk.set()
    assert "position_bandwidth = 2.5" in (tmp_path / "parameters.toml").read_text()


def test_store_that_is_gone_is_reported_once_and_the_parameter_applies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    client, said = mavlink.MAVLink(None, srcSystem=255, srcComponent=190), []
    with closing(side_with_store(tmp_path / "store")) as side:
        monkeypatch.setattr(side.station, "say", said.append)
        (tmp_path / "store").write_text("")
        pump(side, robot := Robot(), 2)
        side.station.take(0, bytes(mavlink.MAVLink_param_set_message(1, 1, b"POS_BW", 2.5, 9).pack(client)), 0)
        (request,) = pump(side, robot)
        side._writer.close()
        pump(side, robot)
    assert request.argument == ("control.position_bandwidth", 2.5)
    assert said == ["the next start will not know what was changed: parameters.toml is not stored: File exists"]


def test_a_tick_only_hands_over_its_results() -> None:
    """Observer and requests cost microseconds, whatever the link does."""
    firmware = firmware_of()
    side = GroundSide(GroundConfig(links=(f"udpin:127.0.0.1:{free_port()}",)), firmware)
    with closing(side):
        robot = Robot()
        inputs, outputs = robot.step([])
        start = time.perf_counter()
        for _ in range(10_000):
            side.observe([], [], inputs, outputs)
            side.requests()
        assert (time.perf_counter() - start) / 10_000 < 50e-6
        assert len(side._ticks) == 200


def test_stop_that_comes_behind_something_that_fails_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both arrive in one round, on one link."""
    firmware = firmware_of()
    port = free_port()
    side = GroundSide(GroundConfig(links=(f"udpin:127.0.0.1:{port}",)), firmware, ThreadPoolExecutor(1))
    take = side.station.take
    monkeypatch.setattr(side.station, "take", lambda channel, data, *more: 1 // 0 if data == b"bad" else take(channel, data, *more))
    estop = mavlink.MAVLink_command_long_message(1, 1, 31012, 0, 1, 0, 0, 0, 0, 0, 0).pack(mavlink.MAVLink(None, srcSystem=255))
    side.observe([], [], *Robot().step([]))
    with closing(side.links), closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as client:
        for data in (b"bad", estop):
            client.sendto(data, ("127.0.0.1", port))
        with pytest.raises(ZeroDivisionError):
            side.pump()
        side.pump()
    assert [request.action for request in side.requests()] == [Action.ESTOP]


@pytest.mark.parametrize("what", ["observe", "jobs", "frames"])
def test_ground_side_in_which_something_fails_says_so_once_and_goes_on_to_hear_a_stop(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    firmware = firmware_of()
    said: Queue[str] = Queue()
    port = free_port()
    side = GroundSide(GroundConfig(links=(f"udpin:127.0.0.1:{port}",)), firmware, ThreadPoolExecutor(1), say=said.put)
    monkeypatch.setattr(side.station, what, None)  # every use of it fails, in every round
    estop = mavlink.MAVLink_command_long_message(1, 1, 31012, 0, 1, 0, 0, 0, 0, 0, 0).pack(mavlink.MAVLink(None, srcSystem=255))
    end, asked = time.monotonic() + PATIENCE_S, []
    with side, closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as client:
        while Action.ESTOP not in asked and time.monotonic() < end:
            side.observe([], [], *Robot().step([]))
            client.sendto(estop, ("127.0.0.1", port))
            time.sleep(0.01)
            asked = [request.action for request in side.requests()]
    assert Action.ESTOP in asked and side.error is not None
    assert type(side.error).__name__ in said.get_nowait() and said.empty()


@pytest.mark.slow
def test_link_that_is_not_there_yet_is_said_and_keeps_no_other_from_its_work_and_is_said_once_it_is(tmp_path: Path) -> None:
    said: Queue[str] = Queue()
    config, (ours, theirs) = GroundConfig(links=(f"{tmp_path}/radio,57600", "udpin:127.0.0.1:0")), pty.openpty()
    with GroundSide(config, firmware_of(), ThreadPoolExecutor(1), say=said.put) as side:
        warning = said.get(timeout=PATIENCE_S)
        (tmp_path / "radio").symlink_to(os.ttyname(theirs))
        assert said.get(timeout=PATIENCE_S) == f"link {tmp_path}/radio,57600: is there now"
        assert side.error is None
    assert said.empty()
    assert warning == f"warning: link {tmp_path}/radio,57600: not there yet: No such file or directory; it is opened when it is there"
    os.close(ours)
    os.close(theirs)
