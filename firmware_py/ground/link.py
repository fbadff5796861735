"""Links to ground stations: udpout, udpin, tcpin and serial, several at once. Never blocks; the oldest frame gives way.

Everyone at the other end is a channel with a number of its own. Runs beside the tick, never in it.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import serial

LOOPBACK = "127.0.0.1"
TRUSTED = "+trusted"
"""Ending of an address whose link may set the signing key."""
_QUEUE_FRAMES = 256
_MOST_PEERS = 16
_DATAGRAM = 65536
_READ = 4096
_READS_AT_ONCE = 64
"""Datagrams taken from one socket before the next has its turn."""


class LinkError(Exception):
    """A link cannot be opened; one line."""


class Received(NamedTuple):
    """Bytes from one channel."""

    channel: int
    data: bytes
    datagram: bool
    """Frames do not go on in what comes next."""


@dataclass(slots=True)
class Channel:
    """Somebody at the other end of a link."""

    number: int
    link: Link
    peer: Any
    trusted: bool
    queue: deque[bytes] = field(default_factory=lambda: deque(maxlen=_QUEUE_FRAMES))
    dropped: int = 0
    """Frames that gave way to newer ones."""

    def put(self, frame: bytes) -> None:
        """Queue `frame`; the oldest goes when there is no room."""
        self.dropped += len(self.queue) == self.queue.maxlen
        self.queue.append(frame)


class Link(Protocol):
    """One address. `receive` and `send` never block; OSError means that it does not work now."""

    datagram: bool

    def sockets(self) -> Sequence[Any]:
        """What to wait for."""
        ...

    def receive(self) -> list[tuple[Any, bytes]]:
        """What came, with the peer it came from. An empty text ends a peer."""
        ...

    def send(self, peer: Any, frame: bytes) -> bool:
        """Whether the frame was taken; False: try again later."""
        ...

    def peers(self) -> Sequence[Any]:
        """Those who are there before they have said anything."""
        ...

    def close(self) -> None:
        """Give the port back."""
        ...


class UdpLink:
    """udpin: answers whoever writes. udpout: writes to one address from the start."""

    datagram = True

    def __init__(self, host: str, port: int, listen: bool) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._listen = listen
        try:
            if listen:
                self._socket.bind((host, port))
            else:
                self._socket.connect((host, port))
        except (OSError, OverflowError):
            self._socket.close()
            raise

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._socket.getsockname()[1])

    def sockets(self) -> Sequence[Any]:
        return [self._socket]

    def receive(self) -> list[tuple[Any, bytes]]:
        got: list[tuple[Any, bytes]] = []
        for _ in range(_READS_AT_ONCE):
            try:
                data, peer = self._socket.recvfrom(_DATAGRAM)
            except BlockingIOError:
                break
            except ConnectionError:
                continue  # nobody listens there yet
            got.append((peer if self._listen else None, data))
        return got

    def send(self, peer: Any, frame: bytes) -> bool:
        try:
            self._socket.sendto(frame, peer) if self._listen else self._socket.send(frame)
        except BlockingIOError:
            return False
        return True

    def peers(self) -> Sequence[Any]:
        return [] if self._listen else [None]

    def close(self) -> None:
        self._socket.close()


class TcpLink:
    """tcpin: everyone who connects is a peer."""

    datagram = False

    def __init__(self, host: str, port: int) -> None:
        self._server = socket.create_server((host, port))
        self._server.setblocking(False)
        self._left: dict[socket.socket, bytes] = {}

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._server.getsockname()[1])

    def sockets(self) -> Sequence[Any]:
        return [self._server, *self._left]

    def receive(self) -> list[tuple[Any, bytes]]:
        with contextlib.suppress(BlockingIOError, ConnectionError):
            peer, _ = self._server.accept()
            peer.setblocking(False)
            peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._left[peer] = b""
        got = [(peer, data) for peer in list(self._left) if (data := self._read(peer)) is not None]
        for peer, data in got:
            if not data:
                self._end(peer)
        return got

    def _read(self, peer: socket.socket) -> bytes | None:
        try:
            return peer.recv(_READ)
        except BlockingIOError:
            return None
        except OSError:
            return b""

    def send(self, peer: Any, frame: bytes) -> bool:
        """A frame that was begun is sent to its end before the next."""
        if peer not in self._left:
            return True
        try:
            if self._left[peer]:
                self._left[peer] = self._left[peer][peer.send(self._left[peer]) :]
            if self._left[peer]:
                return False
            self._left[peer] = frame[peer.send(frame) :]
        except BlockingIOError:
            return False
        except OSError:
            self._end(peer)
        return True

    def _end(self, peer: socket.socket) -> None:
        self._left.pop(peer, None)
        peer.close()

    def peers(self) -> Sequence[Any]:
        return list(self._left)

    def close(self) -> None:
        for peer in list(self._left):
            self._end(peer)
        self._server.close()


class SerialLink:
    """A radio or a UART of the vehicle's computer."""

    datagram = False

    def __init__(self, device: str, baud: int) -> None:
        self._serial = serial.Serial(device, baud, timeout=0, write_timeout=0)
        self._left = b""

    def sockets(self) -> Sequence[Any]:
        return [self._serial]

    def receive(self) -> list[tuple[Any, bytes]]:
        data = self._serial.read(_READ)
        return [(None, data)] if data else []

    def send(self, peer: Any, frame: bytes) -> bool:
        try:
            self._left = self._left[self._serial.write(self._left) :] if self._left else b""
            if self._left:
                return False
            self._left = frame[self._serial.write(frame) :]
        except serial.SerialTimeoutException:
            return False
        return True

    def peers(self) -> Sequence[Any]:
        return [None]

    def close(self) -> None:
        self._serial.close()


def open_link(address: str) -> Link:
    """The link at `address`, without its ending `+trusted`.

    Raises:
        LinkError: no such kind of address, or it cannot be opened.
    """
    try:
        if address.startswith("/"):
            device, _, baud = address.partition(",")
            return SerialLink(device, int(baud or 921600))
        kind, _, rest = address.partition(":")
        host, _, port = rest.rpartition(":")
        if kind in ("udpin", "udpout"):
            return UdpLink(host or LOOPBACK, int(port), kind == "udpin")
        if kind == "tcpin":
            return TcpLink(host or LOOPBACK, int(port))
    except (OSError, ValueError, OverflowError) as error:
        raise LinkError(f"link {address}: cannot be opened: {error}") from None
    raise LinkError(f"link {address}: unknown; there are udpin:, udpout:, tcpin:HOST:PORT and /dev/NAME,BAUD")


class Links:
    """All links of one process."""

    def __init__(self, addresses: Sequence[str]) -> None:
        """Opens every address. Raises LinkError, and leaves none open."""
        self.counts: Counter[str] = Counter()
        self.channels: dict[int, Channel] = {}
        self.links: list[Link] = []
        self._trusted: list[bool] = []
        self._by_peer: dict[tuple[int, Any], int] = {}
        self._next = 0
        self._gone: list[int] = []
        try:
            for address in addresses:
                self.links.append(open_link(address.removesuffix(TRUSTED)))
                self._trusted.append(address.endswith(TRUSTED))
        except LinkError:
            self.close()
            raise
        for index, link in enumerate(self.links):
            for peer in link.peers():
                self._channel(index, peer)

    def wait(self, timeout_s: float) -> None:
        """Until something came, or the time is over."""
        with selectors.DefaultSelector() as selector:
            for link in self.links:
                for each in link.sockets():
                    selector.register(each, selectors.EVENT_READ)
            selector.select(timeout_s)

    def receive(self) -> list[Received]:
        """What came on all links, without waiting."""
        received = []
        for index, link in enumerate(self.links):
            try:
                got = link.receive()
            except OSError:
                self.counts["receive"] += 1
                continue
            for peer, data in got:
                if data:
                    received.append(Received(self._channel(index, peer), data, link.datagram))
                elif not link.datagram:
                    self._forget(index, peer)
        return received

    def send(self, channel: int | None, frame: bytes) -> None:
        """Queue a frame for one channel, or for all of them with None."""
        for number in list(self.channels) if channel is None else [channel]:
            if number in self.channels:
                self.channels[number].put(frame)

    def flush(self) -> None:
        """Hand to the system what it takes."""
        for channel in self.channels.values():
            while channel.queue:
                try:
                    if not channel.link.send(channel.peer, channel.queue[0]):
                        break
                except OSError:
                    self.counts["send"] += 1
                channel.queue.popleft()

    def take_gone(self) -> list[int]:
        """Channels that are no more, since the last call."""
        gone, self._gone = self._gone, []
        return gone

    @property
    def dropped(self) -> int:
        """Frames that gave way to newer ones, all channels that are there."""
        return sum(channel.dropped for channel in self.channels.values())

    def close(self) -> None:
        """Close every link."""
        for link in self.links:
            link.close()

    def _channel(self, index: int, peer: Any) -> int:
        """Number of a peer; the one that was silent longest gives way to a new one."""
        key = (index, peer)
        if key in self._by_peer:
            self._by_peer[key] = self._by_peer.pop(key)
        else:
            same = [k for k in self._by_peer if k[0] == index]
            if len(same) >= _MOST_PEERS:
                self._forget(*same[0])
            self._by_peer[key] = self._next
            self.channels[self._next] = Channel(self._next, self.links[index], peer, self._trusted[index])
            self._next += 1
        return self._by_peer[key]

    def _forget(self, index: int, peer: Any) -> None:
        number = self._by_peer.pop((index, peer), None)
        if number is not None:
            self.counts["gone"] += 1
            self._gone.append(number)
            self.counts["dropped"] += self.channels.pop(number).dropped
