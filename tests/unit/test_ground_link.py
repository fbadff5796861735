"""Links over loopback: several at once, routed by system, bounded, opened late, and refused in one line."""

import errno
import re
import socket
import threading
import time
from contextlib import closing, suppress
from typing import Any

import pytest

from firmware_py.ground.link import Channel, Links
from firmware_py.ground.link_address import LinkError, open_link
from tests.unit.ground_sides import PATIENCE_S, free_port, received
from tests.unit.ground_world import World


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
    link: Any = open_link(f"{kind}::0", pytest.fail)
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
    """Regression: a robot whose network gave it another address was mute until restarted."""
    station, stranger = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    station.bind(("127.0.0.1", 0))
    station.settimeout(PATIENCE_S)
    link: Any = open_link(f"udpout:127.0.0.1:{station.getsockname()[1]}", pytest.fail)
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


def test_queue_keeps_the_newest() -> None:
    channel = Channel(None, None)  # type: ignore[arg-type]
    for i in range(300):
        channel.put(bytes([i % 256]))
    assert channel.dropped == 44 and channel.queue[-1] == bytes([299 % 256]) and channel.queue[0] == bytes([44])


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
    [
        "nonsense", "udpin:127.0.0.1:no", "udpin:127.0.0.1:99999", "tcpin:256.0.0.1:5", "tcpin:10.0.0.300.:5", "udpout:255.255.255.255:5",
        "udpin:::1:14550", "udpout:[::1]:14550", "udpout:no name:14550", "udpout://127.0.0.1:14550",
    ],
)  # fmt: skip
def test_an_address_that_cannot_be_opened_is_refused_in_one_line(address: str) -> None:
    with pytest.raises(LinkError, match="link ") as error:
        open_link(address, pytest.fail)
    assert "\n" not in str(error.value) and "Errno" not in str(error.value)


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("/dev/null", "cannot be opened: is no serial device"),
        (f"udpout:{64 * 'a'}:14550", f"'{64 * 'a'}' is no name of a host"),
        ("tcpin:x..y:14550", "'x..y' is no name of a host"),
    ],
)
def test_what_can_be_no_host_and_no_radio_is_refused_in_words(address: str, words: str) -> None:
    with pytest.raises(LinkError) as error:
        open_link(address, pytest.fail)
    assert str(error.value) == f"link {address}: {words}"


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
        open_link(address, pytest.fail)
    assert right in str(error.value) and "invalid literal" not in str(error.value)


def test_port_that_another_process_has_is_refused() -> None:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as other:
        other.bind(("127.0.0.1", 0))
        with pytest.raises(LinkError, match="cannot be opened: Address already in use"):
            open_link(f"udpin:127.0.0.1:{other.getsockname()[1]}", pytest.fail)


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
def test_link_at_an_address_that_the_robot_does_not_have_yet_is_opened_when_it_has_it(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a robot that was restarted before its network was up did not start."""

    def bind(self: socket.socket, address: object) -> None:
        raise OSError(errno.EADDRNOTAVAIL, "as long as the network is down")

    address = f"{kind}:127.0.0.1:{free_port()}"
    with monkeypatch.context() as down:
        down.setattr(socket.socket, "bind", bind)
        links = Links([address])
        assert links.warnings == [f"link {address}: not there yet: Cannot assign requested address; it is opened when it is there"]
        assert list(links.receive()) == [] and not links.channels
    with closing(links), closing(socket.socket(type=socket.SOCK_DGRAM if kind == "udpin" else socket.SOCK_STREAM)) as client:
        assert list(links.receive()) == []  # opens it
        client.settimeout(PATIENCE_S)
        client.connect(("127.0.0.1", int(address.rpartition(":")[2])))
        client.sendall(b"hello")
        (got,) = received(links, 1)
        links.send(got.channel, b"answer")
        links.flush()
        assert client.recv(100) == b"answer"


def test_late_link_whose_port_is_taken_meanwhile_is_counted_as_failing(monkeypatch: pytest.MonkeyPatch) -> None:
    def bind(self: socket.socket, address: object) -> None:
        raise OSError(errno.EADDRNOTAVAIL, "as long as the network is down")

    with closing(socket.socket(type=socket.SOCK_DGRAM)) as other:
        other.bind(("127.0.0.1", 0))
        with monkeypatch.context() as down:
            down.setattr(socket.socket, "bind", bind)
            links = Links([f"udpin:127.0.0.1:{other.getsockname()[1]}"])
            assert list(links.receive()) == [] and not links.counts
        with closing(links):
            assert list(links.receive()) == [] and links.counts == {"receive": 1}


@pytest.mark.parametrize(("answers", "reason"), [(True, "Temporary failure in name resolution"), (False, "no name server answers")])
def test_station_whose_name_nobody_knows_yet_is_spoken_to_when_somebody_does_and_holds_up_nothing(
    answers: bool, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The resolver may take half a minute to say that the network is down: neither the start nor who hears stops waits for it."""
    asked, is_up, ours = [], threading.Event(), threading.current_thread()

    def resolve(name: str) -> str:
        assert threading.current_thread() is not ours
        asked.append(name)
        if answers and len(asked) == 1:
            raise socket.gaierror(socket.EAI_AGAIN, reason)
        assert is_up.wait(PATIENCE_S)
        return "127.0.0.1"

    if not answers:
        monkeypatch.setattr("firmware_py.ground.link_address._ANSWER_S", 0.0)
    monkeypatch.setattr("firmware_py.ground.link_address.socket.gethostbyname", resolve)
    monkeypatch.setattr("firmware_py.ground.link_address._RESOLVE_EVERY_S", 0.0)
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as station:
        station.bind(("127.0.0.1", 0))
        station.setblocking(False)
        address = f"udpout:station.local:{station.getsockname()[1]}"
        with closing(Links([address])) as links:
            assert links.warnings == [f"link {address}: not there yet: {reason}; it is opened when it is there"]
            end, got = time.monotonic() + PATIENCE_S, b""
            while not got and time.monotonic() < end:
                links.send(None, b"telemetry")
                links.flush()
                assert list(links.receive()) == []
                is_up.set()
                with suppress(BlockingIOError):
                    got = station.recv(100)
    assert got == b"telemetry" and asked == ["station.local"] * 2


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
