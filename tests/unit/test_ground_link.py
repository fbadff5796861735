"""Links over loopback: several at once, routed by system, bounded, and never in the way of a tick."""

import multiprocessing
import os
import pty
import re
import socket
import struct
import termios
import threading
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from queue import Queue
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.app.ground_station import _NOTHING, GroundSide
from firmware_py.core.types import Action, Event, Request
from firmware_py.description.parameters import Parameters
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.link import Channel, Links
from firmware_py.ground.logs import LogService
from firmware_py.ground.mission_flight import Plan, PlanJob
from firmware_py.ground.signing import load_signing
from firmware_py.ground.telemetry import DEFAULT_HZ
from firmware_py.ground.transport import LinkError, open_link
from tests.unit.ground_world import Robot, World, fleet_of
from tests.unit.test_ground_walk import free_port

PATIENCE_S = 5.0


def received(links: Links, count: int) -> list[Any]:
    """What came, waited for."""
    got: list[Any] = []
    end = time.monotonic() + PATIENCE_S
    while len(got) < count and time.monotonic() < end:
        got += links.receive()
    return got


def heartbeat(system: int = 255) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=190)
    return bytes(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mav))


def test_udpin_answers_each_client_on_its_own_channel() -> None:
    port = free_port()
    links = Links([f"udpin:127.0.0.1:{port}"])
    with closing(links):
        clients = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
        for client in clients:
            client.settimeout(PATIENCE_S)
            client.sendto(b"hello", ("127.0.0.1", port))
        got = received(links, 2)
        assert len({r.channel for r in got}) == 2
        links.send(got[1].channel, b"for the second")
        links.send(None, b"for all")
        links.flush()
        assert clients[1].recv(100) == b"for the second"
        assert clients[0].recv(100) == b"for all"
        for client in clients:
            client.close()


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
def test_an_address_without_a_host_is_this_machines_alone(kind: str) -> None:
    link: Any = open_link(f"{kind}::0")
    with closing(link):
        assert (link._socket if kind == "udpin" else link._server).getsockname()[0] == "127.0.0.1"


def test_udpout_speaks_first_and_survives_that_nobody_listens() -> None:
    port = free_port()
    links = Links([f"udpout:127.0.0.1:{port}"])
    with closing(links):
        for _ in range(5):
            links.send(None, b"anybody?")
            links.flush()
            list(links.receive())
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as client:
            client.bind(("127.0.0.1", port))
            client.settimeout(PATIENCE_S)
            links.send(None, b"now")
            links.flush()
            if links.channels[0].queue or links.counts["send"]:
                links.send(None, b"now")
                links.flush()
            assert client.recv(100) == b"now"


def test_robot_on_udpout_is_tied_to_no_address_of_its_own_and_hears_nobody_but_its_station() -> None:
    """One that was given another address by its network was mute until it was started anew."""
    station, stranger = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    station.bind(("127.0.0.1", 0))
    station.settimeout(PATIENCE_S)
    link: Any = open_link(f"udpout:127.0.0.1:{station.getsockname()[1]}")
    with closing(link), closing(station), closing(stranger):
        assert link.send(None, b"anybody?")
        _, robot = station.recvfrom(100)
        assert link._socket.getsockname()[0] == "0.0.0.0"
        stranger.sendto(b"take me", robot)
        station.sendto(b"here", robot)
        assert link.receive() == [(None, b"here")]


def test_tcp_clients_come_and_go() -> None:
    port = free_port()
    links = Links([f"tcpin:127.0.0.1:{port}"])
    with closing(links):
        client = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        client.sendall(b"hello")
        (got,) = received(links, 1)
        assert not got.datagram
        links.send(got.channel, b"x" * 1000)
        links.flush()
        assert client.recv(1000, socket.MSG_WAITALL) == b"x" * 1000
        client.close()
        end = time.monotonic() + PATIENCE_S
        while links.channels and time.monotonic() < end:
            list(links.receive())
        assert links.take_gone() == [got.channel] and not links.channels


def test_a_client_that_does_not_read_loses_the_oldest_and_delays_nobody() -> None:
    port = free_port()
    links = Links([f"tcpin:127.0.0.1:{port}"])
    with closing(links), closing(socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)) as client:
        client.sendall(b"hello")
        (got,) = received(links, 1)
        start = time.monotonic()
        for _ in range(30_000):
            links.send(got.channel, bytes(280))
            links.flush()
        assert links.dropped > 1000
        assert time.monotonic() - start < PATIENCE_S
        assert len(links.channels[got.channel].queue) <= 256


def side_on(*links: str, modules: int = 1) -> GroundSide:
    """A ground side without a thread: the test pumps."""
    pipeline = SimpleNamespace(bodies=Robot(modules).bodies)
    firmware: Any = SimpleNamespace(pipeline=pipeline, fleet=fleet_of(modules), parameters=Parameters())
    return GroundSide(GroundConfig(links=links), firmware, ThreadPoolExecutor(1))


def pump(side: GroundSide, robot: Robot, ticks: int = 1) -> list[Request]:
    """What is asked meanwhile."""
    asked = []
    for _ in range(ticks):
        requests = side.requests()
        side.observe([], [], *robot.step(requests))
        side.pump()
        asked += requests
    return asked + side.requests()


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


def test_radio_that_takes_nothing_holds_up_nobody() -> None:
    """pyserial's own write would turn in a loop."""
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


def test_radio_status_makes_nobody_believed() -> None:
    """It is taken unsigned from everybody."""
    station = World().station
    mav = mavlink.MAVLink(None, srcSystem=51, srcComponent=68)
    assert not station.take(3, bytes(mavlink.MAVLink_radio_status_message(0, 0, 0, 0, 0, 0, 0).pack(mav)), 0)
    assert station.take(3, heartbeat(), 0)


def test_each_of_two_clients_has_its_list_of_logs(tmp_path: Path) -> None:
    for number in range(25):
        (tmp_path / f"{number}.log").touch()
    world = World(config=GroundConfig(logs=str(tmp_path)))
    clients = [world.client(), world.client(200)]
    for client in clients:
        client.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(5)
    assert [len(client.all("LOG_ENTRY")) for client in clients] == [25, 25]


def test_tcp_client_that_breaks_off_is_no_channel_any_more() -> None:
    port = free_port()
    with closing(side_on(f"tcpin:127.0.0.1:{port}")) as side:
        client, robot = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S), Robot()
        pump(side, robot, 2)
        assert side.links.channels
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.close()
        side.links.send(None, b"x")
        side.links.flush()  # it is found here to be gone
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


def test_answers_find_their_way_while_a_log_is_fetched_over_a_radio(tmp_path: Path) -> None:
    (tmp_path / "can.log").write_bytes(bytes(1_000_000))
    world = World(config=GroundConfig(logs=str(tmp_path)))
    client = world.client()
    client.send("LOG_REQUEST_DATA", 1, 1, 0, 0, 0xFFFFFFFF)
    world.station.spare({client.channel})
    world.run(50)
    assert not client.all("LOG_DATA") and client.all("HEARTBEAT")
    world.station.spare(set())
    world.run(2)
    assert len(client.all("LOG_DATA")) == 40


def test_client_that_leaves_with_an_answer_to_come_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "can.log").write_bytes(bytes(1_000_000))
    world = World(config=GroundConfig(logs=str(tmp_path)))
    client = world.client()
    client.send("LOG_REQUEST_DATA", 1, 1, 0, 0, 0xFFFFFFFF)
    client.command(400, 1)
    world.station.leave(client.channel)
    world.run(3)
    services = world.station.services[1]
    assert not services.system.outbox._encoders and services.logs._transfer is None


def test_new_key_is_stored_at_once_for_the_robot_may_be_restarted_next(tmp_path: Path) -> None:
    firmware: Any = SimpleNamespace(pipeline=SimpleNamespace(bodies=Robot().bodies), fleet=fleet_of(1), parameters=Parameters())
    config = GroundConfig(links=(f"udpin:127.0.0.1:{free_port()}",), store=str(tmp_path))
    with closing(GroundSide(config, firmware, ThreadPoolExecutor(1))) as side:
        robot = Robot()
        pump(side, robot, 200)
        for key in (bytes(range(32)), bytes(range(1, 33)), bytes(32)):
            side.station.signing.adopt(key, 0)
            pump(side, robot)
            assert load_signing(tmp_path / "signing.json").key == side.station.signing.key


class SlowLink:
    """A radio that carries so many bytes a tick."""

    datagram = False

    def __init__(self, bytes_per_tick: float) -> None:
        self.bytes_per_tick, self.room, self.frames = bytes_per_tick, 0.0, list[bytes]()

    def receive(self) -> list[tuple[Any, bytes]]:
        """Once in a tick."""
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
        """Nothing to give back."""


def test_radio_slower_than_what_streams_gets_less_of_everything_and_every_heartbeat_and_text(monkeypatch: pytest.MonkeyPatch) -> None:
    radio, robot = SlowLink(57.6), Robot(modules=4)  # 57,600 Bd at 100 Hz
    monkeypatch.setattr("firmware_py.ground.link.open_link", lambda address: radio)
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
    names = {name for name, hz in DEFAULT_HZ.items() if hz >= 1} - {"ESC_STATUS"}  # pymavlink here knows none
    for system in (1, 2, 3, 4):
        assert 21 <= got[system, "HEARTBEAT"] <= 24
        assert all(got[system, name] >= 3 for name in names)
        assert got[system, "ATTITUDE"] < 100  # of 230
    assert got[1, "STATUSTEXT"] == 20
    assert got[1, "PARAM_VALUE"] >= 20


def test_flood_of_requests_for_the_list_of_logs_looks_at_the_folder_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(config=GroundConfig(logs=str(tmp_path)))
    client, looks = world.client(), []
    monkeypatch.setattr(LogService, "_find", lambda service: looks.append(1) or [])
    for _ in range(100):
        client.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(2)
    assert len(looks) == 1


def test_queue_keeps_the_newest() -> None:
    channel = Channel(0, None, None, False)  # type: ignore[arg-type]
    for i in range(300):
        channel.put(bytes([i % 256]))
    assert channel.dropped == 44 and channel.queue[-1] == bytes([299 % 256]) and channel.queue[0] == bytes([44])


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
    """A serial device behind a link, as udev names one: plugged in until it is pulled."""

    def __init__(self, name: Path) -> None:
        self.ours, self._theirs = pty.openpty()
        self._name = name
        name.symlink_to(os.ttyname(self._theirs))

    def pull(self) -> None:
        self._name.unlink()
        os.close(self.ours)
        os.close(self._theirs)


def test_radio_that_is_pulled_and_plugged_in_again_is_taken_up_again(tmp_path: Path) -> None:
    name = tmp_path / "radio"
    radio = Radio(name)
    with closing(Links([f"{name},115200"])) as links:
        radio.pull()
        for _ in range(3):  # the first finds out
            links.send(None, b"to nobody")
            links.flush()
            assert list(links.receive()) == []
        assert links.counts["send"] + links.counts["receive"] == 1
        radio = Radio(name)
        assert list(links.receive()) == []  # opens it
        os.write(radio.ours, heartbeat())
        assert b"".join(r.data for r in received(links, 1)) == heartbeat()
        links.send(None, b"answer")
        links.flush()
        assert os.read(radio.ours, 100) == b"answer"
    radio.pull()


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
        assert list(links.receive()) == []  # opens it
        os.write(radio.ours, heartbeat())
        assert b"".join(r.data for r in received(links, 1)) == heartbeat()
    radio.pull()


def broken(descriptor: int, queue: int) -> None:
    """As a device answers that is no more."""
    raise termios.error(5, "Input/output error")


def test_station_on_the_robots_own_machine_is_heard_by_whatever_name_of_it() -> None:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(PATIENCE_S)
        for host in ("127.0.0.1", "localhost", "0.0.0.0"):
            links = Links([f"udpout:{host}:{station.getsockname()[1]}"])
            with closing(links):
                links.send(None, b"telemetry")
                links.flush()
                robot = station.recvfrom(100)[1]
                station.sendto(b"stop", robot)
                assert [got.data for got in received(links, 1)] == [b"stop"], host


@pytest.mark.parametrize(
    "address",
    ["nonsense", "udpin:127.0.0.1:no", "udpin:127.0.0.1:99999", "/dev/no-such-port,9600", "tcpin:256.0.0.1:5", "udpout:255.255.255.255:5"],
)
def test_an_address_that_cannot_be_opened_is_refused_in_one_line(address: str) -> None:
    with pytest.raises(LinkError, match="link ") as error:
        open_link(address)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("address", "right"),
    [
        ("udpin:127.0.0.1:14550+trusted,1", "it needs udpin:HOST:PORT"),
        ("tcpin:5760x", "it needs tcpin:HOST:PORT"),
        ("udpout:127.0.0.1:99999", "no whole number up to 65535"),
        ("/dev/ttyX,abc", "it needs /dev/NAME,BAUD"),
    ],
)
def test_a_port_or_rate_that_is_none_is_refused_with_what_would_be_right(address: str, right: str) -> None:
    with pytest.raises(LinkError, match=f"^link {re.escape(address)}: ") as error:
        open_link(address)
    assert right in str(error.value) and "invalid literal" not in str(error.value)


def test_messages_for_others_are_passed_on_to_where_they_were_heard() -> None:
    world = World()
    first, second, third = world.client(255), world.client(201), world.client(202)
    for client in (first, second, third):
        client.heartbeat()
    world.run(1)
    for client in (first, second, third):
        client.clear()
    first.send("COMMAND_LONG", 201, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    world.run(1)
    assert second.all("COMMAND_LONG") and not third.all("COMMAND_LONG") and not world.robot.asked[3:]
    first.heartbeat()
    world.run(1)
    assert [m.get_srcSystem() for m in third.all("HEARTBEAT") if m.get_srcSystem() != 1] == [255]


def test_a_tick_only_hands_over_its_results() -> None:
    """Observer and requests cost microseconds, whatever the link does."""
    firmware: Any = SimpleNamespace(pipeline=SimpleNamespace(bodies=[]), fleet=fleet_of(1), parameters=Parameters())
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
    """In one round, on one link."""
    firmware: Any = SimpleNamespace(pipeline=SimpleNamespace(bodies=[]), fleet=fleet_of(1), parameters=Parameters())
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
    firmware: Any = SimpleNamespace(pipeline=SimpleNamespace(bodies=[]), fleet=fleet_of(1), parameters=Parameters())
    said: Queue[str] = Queue()
    port = free_port()
    side = GroundSide(GroundConfig(links=(f"udpin:127.0.0.1:{port}",)), firmware, ThreadPoolExecutor(1), say=said.put)
    monkeypatch.setattr(side.station, what, None)  # whatever is done with it fails, in every round
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


def test_planning_process_that_was_killed_is_replaced_and_no_station_is_lost_by_it(monkeypatch: pytest.MonkeyPatch) -> None:
    killed = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
    assert isinstance(killed.submit(os._exit, 9).exception(), BrokenProcessPool)
    monkeypatch.setattr("firmware_py.app.ground_station._planner", lambda: ThreadPoolExecutor(1))
    monkeypatch.setattr("firmware_py.app.ground_station._plan_mission", lambda job, body: Plan(job.serial, None, ()))
    plans: Queue[Plan] = Queue()
    with closing(side_on(f"udpin:127.0.0.1:{free_port()}")) as side:
        monkeypatch.setattr(side.station, "planned", lambda body, plan: plans.put(plan))
        side._executor = killed
        for _ in range(2):  # the second finds the new one
            side.station.services[1].flight.jobs.append(_NOTHING)
            side.pump()
        wait([future for _, future in side._plans], PATIENCE_S)
        side.pump()
    assert plans.qsize() == 2


def test_plans_that_nobody_waits_for_any_more_are_not_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that moves the robot's goal on five times a second waited minutes for the last one."""
    may_end, planned = threading.Event(), list[tuple[int, int]]()

    def plan(job: PlanJob, body: object) -> Plan:
        may_end.wait(PATIENCE_S)
        planned.append((job.body, job.serial))
        return Plan(job.serial, None, ())

    monkeypatch.setattr("firmware_py.app.ground_station._plan_mission", plan)
    firmware: Any = SimpleNamespace(pipeline=SimpleNamespace(bodies=[]), fleet=fleet_of(2), parameters=Parameters())
    config = GroundConfig(links=(f"udpin:127.0.0.1:{free_port()}",))
    with ThreadPoolExecutor(1) as executor, closing(GroundSide(config, firmware, executor)) as side:
        side.station.services[2].flight.jobs.append(_NOTHING._replace(body=1))
        side.pump()
        for serial in range(100):
            side.station.services[1].flight.jobs.append(_NOTHING._replace(serial=serial))
            side.pump()
        may_end.set()
        wait([future for _, future in side._plans], PATIENCE_S)
        side.pump()
        assert side._plans == [] and planned == [(1, 0), (0, 99)]


def test_robot_that_is_stopped_waits_for_no_plan_that_is_being_made() -> None:
    """The service manager gives it five seconds, and kills what is not through: its log is torn then."""
    firmware: Any = SimpleNamespace(pipeline=SimpleNamespace(bodies=[]), fleet=fleet_of(1), parameters=Parameters())
    with GroundSide(GroundConfig(links=(f"udpin:127.0.0.1:{free_port()}",)), firmware) as side:
        while not isinstance(side._executor, ProcessPoolExecutor):
            time.sleep(0.01)
        side._executor.submit(os.getpid).result()  # it is there
        side._executor.submit(time.sleep, 60.0)
        start = time.monotonic()
    assert time.monotonic() - start < PATIENCE_S


@pytest.mark.parametrize(("identity", "first"), [("generic", 0), ("ardusub", 1)])
def test_logs_are_listed_and_fetched(identity: str, first: int, tmp_path: Path) -> None:
    """QGroundControl finds no log whose number is that of their count, unless the autopilot is ArduPilot: it missed the newest."""
    (tmp_path / "flight1").mkdir()
    data = bytes(i % 251 for i in range(9_999))
    (tmp_path / "flight1" / "signals.mcap").write_bytes(data)
    os.utime(tmp_path / "flight1" / "signals.mcap", (1_000_000, 1_000_000))
    (tmp_path / "can.log").write_bytes(b"frames")
    world = World(config=GroundConfig(logs=str(tmp_path), identity=identity))
    client = world.client()
    client.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(1)
    entries = [(e.id - first, e.size, e.num_logs, e.last_log_num - first) for e in client.all("LOG_ENTRY")]
    assert entries == [(0, 9_999, 2, 1), (1, 6, 2, 1)]
    client.send("LOG_REQUEST_DATA", 1, 1, first, 0, 0xFFFFFFFF)
    world.run(20)
    pieces = {m.ofs: bytes(m.data[: m.count]) for m in client.all("LOG_DATA")}
    assert b"".join(pieces[at] for at in sorted(pieces)) == data
    assert client.last("LOG_DATA").count == 0 or sum(map(len, pieces.values())) == len(data)
    client.clear()
    client.send("LOG_REQUEST_DATA", 1, 1, first, 90, 180)
    world.run(5)
    assert b"".join(bytes(m.data[: m.count]) for m in client.all("LOG_DATA")) == data[90:270]
    client.send("LOG_ERASE", 1, 1)
    world.run(1)
    assert "logs are not erased" in client.texts and (tmp_path / "can.log").exists()


def test_logs_of_all_runs_are_listed_oldest_first(tmp_path: Path) -> None:
    """The first run logs into the folder itself, later ones into numbered folders in it."""
    for size, name in enumerate((".", "0002", "0003", "0010"), 1):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "can.log").write_bytes(bytes(size))
        os.utime(tmp_path / name / "can.log", (1_000_000 + size, 1_000_000 + size))
    client = (world := World(config=GroundConfig(logs=str(tmp_path)))).client()
    client.send("LOG_REQUEST_LIST", 1, 1, 0, 0xFFFF)
    world.run(1)
    assert [(e.id, e.size) for e in client.all("LOG_ENTRY")] == [(0, 1), (1, 2), (2, 3), (3, 4)]
