"""Links to ground stations: udpout, udpin, tcpin and serial, several at once. Never blocks; the oldest frame gives way.

Everyone at the other end is a channel with a number of its own. Runs beside the tick, never in it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from firmware_py.ground.transport import Link, LinkError, open_link

TRUSTED = "+trusted"
"""Ending of an address whose link may set the signing key."""
_QUEUE_FRAMES = 256
_MOST_PEERS = 16
_BUSY_FRAMES = 4
"""More that wait: a link that takes what it is given has none left after a round."""


class Received(NamedTuple):
    """Bytes from one channel."""

    channel: int
    data: bytes
    datagram: bool
    """Frames do not go on in what comes next."""
    trusted: bool
    """Its link may set the signing key."""


@dataclass(slots=True)
class Channel:
    """Somebody at the other end of a link."""

    number: int
    link: Link
    peer: Any
    trusted: bool
    believed: bool = False
    """A frame of it was taken for true: strangers do not take its place."""
    queue: deque[bytes] = field(default_factory=lambda: deque(maxlen=_QUEUE_FRAMES))
    dropped: int = 0
    """Frames that gave way to newer ones."""

    def put(self, frame: bytes) -> None:
        """Queue `frame`; the oldest goes when there is no room."""
        self.dropped += len(self.queue) == self.queue.maxlen
        self.queue.append(frame)


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

    def receive(self) -> Iterator[Received]:
        """What came on all links, without waiting. Who is believed by what it sent keeps its place before the next stranger is met."""
        for index, link in enumerate(self.links):
            try:
                got = link.receive()
            except OSError:
                self.counts["receive"] += 1
                continue
            if not link.datagram:
                self._meet(index, link.peers())
            for peer, data in got:
                if data and (link.datagram or (index, peer) in self._by_peer):  # one that has left, or was one too many
                    yield Received(self._channel(index, peer), data, link.datagram, self._trusted[index])

    def believe(self, channel: int) -> None:
        """A frame that came on it was taken for true."""
        if channel in self.channels:
            self.channels[channel].believed = True

    def busy(self) -> set[int]:
        """Channels that take their time: what can wait is not sent to them now."""
        return {number for number, channel in self.channels.items() if len(channel.queue) > _BUSY_FRAMES}

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

    def _meet(self, index: int, there: Sequence[Any]) -> None:
        """Who has connected is a channel before it says anything, and who has left is none any more."""
        for key in [key for key in self._by_peer if key[0] == index and key[1] not in there]:
            self._forget(*key)
        for peer in there:
            if (index, peer) in self._by_peer:
                continue
            full = len(self._same(index)) >= _MOST_PEERS
            if full and not self._strangers(index):
                self.links[index].leave(peer)
            else:
                self._channel(index, peer)

    def _same(self, index: int) -> list[tuple[int, Any]]:
        """Who is at the other end of a link, who was silent longest first."""
        return [key for key in self._by_peer if key[0] == index]

    def _strangers(self, index: int) -> list[tuple[int, Any]]:
        return [key for key in self._same(index) if not self.channels[self._by_peer[key]].believed]

    def _channel(self, index: int, peer: Any) -> int:
        """Number of a peer; a new one takes the place of who was silent longest, a stranger before anybody who was believed."""
        key = (index, peer)
        if key in self._by_peer:
            self._by_peer[key] = self._by_peer.pop(key)
        else:
            same = self._same(index)
            if len(same) >= _MOST_PEERS:
                self._forget(*(self._strangers(index) or same)[0])
            self._by_peer[key] = self._next
            self.channels[self._next] = Channel(self._next, self.links[index], peer, self._trusted[index])
            self._next += 1
        return self._by_peer[key]

    def _forget(self, index: int, peer: Any) -> None:
        number = self._by_peer.pop((index, peer), None)
        if number is not None:
            self.counts["gone"] += 1
            self._gone.append(number)
            self.links[index].leave(peer)
            self.counts["dropped"] += self.channels.pop(number).dropped
