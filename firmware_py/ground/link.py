"""Links to ground stations: udpout, udpin, tcpin and serial, several at once. Never blocks; a full queue drops its oldest frame.

Every peer is a channel with a number of its own. Runs beside the tick, never in it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from firmware_py.ground.link_address import LinkError, open_link
from firmware_py.ground.transport import Link

TRUSTED = "+trusted"
"""Suffix of an address whose link may set the signing key."""
_QUEUE_FRAMES = 256
_MOST_PEERS = 16
_BUSY_FRAMES = 4
"""A channel with more queued frames is busy: a link that keeps up has none left after a round."""


class Received(NamedTuple):
    """Bytes from one channel."""

    channel: int
    data: bytes
    datagram: bool
    """Whether frames end with the data: none continues in the next piece."""
    trusted: bool
    """Whether the link may set the signing key."""


@dataclass(slots=True)
class Channel:
    """A peer at the other end of a link."""

    link: Link
    peer: Any
    believed: bool = False
    """Whether a frame from the peer was believed; new peers displace unbelieved ones first."""
    queue: deque[bytes] = field(default_factory=lambda: deque(maxlen=_QUEUE_FRAMES))
    dropped: int = 0
    """Frames dropped in favour of newer ones."""

    def put(self, frame: bytes) -> None:
        """Queues `frame`; drops the oldest frame when the queue is full."""
        self.dropped += len(self.queue) == self.queue.maxlen
        self.queue.append(frame)


class Links:
    """All links of one process."""

    def __init__(self, addresses: Sequence[str]) -> None:
        """Opens every address, later if it is not there yet. Raises LinkError, and then leaves no link open."""
        self.warnings: list[str] = []
        """One line for each address that is not there yet."""
        self.opened: list[str] = []
        """One line for each of these once it is there."""
        self.counts: Counter[str] = Counter()
        self.channels: dict[int, Channel] = {}
        self.links: list[Link] = []
        self._trusted: list[bool] = []
        self._by_peer: dict[tuple[int, Any], int] = {}
        self._next = 0
        self._gone: list[int] = []
        self._late: dict[int, str] = {}
        """Address of each link, by its index, that is not there yet."""
        try:
            for address in addresses:
                self.links.append(open_link(address.removesuffix(TRUSTED), self.warnings.append))
                self._trusted.append(address.endswith(TRUSTED))
                if not self.links[-1].is_open:
                    self._late[len(self._trusted) - 1] = address.removesuffix(TRUSTED)
        except LinkError:
            self.close()
            raise
        for index, link in enumerate(self.links):
            for peer in link.peers():
                self._channel(index, peer)

    def receive(self) -> Iterator[Received]:
        """Yields what arrived on all links, without waiting. A caller can `believe` each peer before the next new one might displace it."""
        for index, link in enumerate(self.links):
            try:
                got = link.receive()
            except OSError:
                self.counts["receive"] += 1
                continue
            if link.is_open and index in self._late:
                self.opened.append(f"link {self._late.pop(index)}: is there now")
            if not link.datagram:
                self._sync_peers(index, link.peers())
            for peer, data in got:
                if data and (link.datagram or (index, peer) in self._by_peer):  # skips stream peers that left or were refused
                    yield Received(self._channel(index, peer), data, link.datagram, self._trusted[index])

    def believe(self, channel: int) -> None:
        """Marks a channel as one from which a frame was believed."""
        if channel in self.channels:
            self.channels[channel].believed = True

    def busy(self) -> set[int]:
        """Returns the channels under back-pressure: messages that can wait are not sent to them now."""
        return {number for number, channel in self.channels.items() if len(channel.queue) > _BUSY_FRAMES}

    def send(self, channel: int | None, frame: bytes) -> None:
        """Queues a frame for one channel, or for all channels with None."""
        for number in list(self.channels) if channel is None else [channel]:
            if number in self.channels:
                self.channels[number].put(frame)

    def flush(self) -> None:
        """Hands queued frames to the operating system, as many as it accepts."""
        for channel in self.channels.values():
            while channel.queue:
                try:
                    if not channel.link.send(channel.peer, channel.queue[0]):
                        break
                except OSError:
                    self.counts["send"] += 1
                channel.queue.popleft()

    def take_gone(self) -> list[int]:
        """Returns the channels removed since the last call."""
        gone, self._gone = self._gone, []
        return gone

    @property
    def dropped(self) -> int:
        """Frames dropped in favour of newer ones, over all present channels."""
        return sum(channel.dropped for channel in self.channels.values())

    def close(self) -> None:
        """Close every link."""
        for link in self.links:
            link.close()

    def _sync_peers(self, index: int, there: Sequence[Any]) -> None:
        """Makes a channel of every new connection before it sends anything, and removes the channels of peers that left."""
        for key in [key for key in self._by_peer if key[0] == index and key[1] not in there]:
            self._forget(*key)
        for peer in there:
            if (index, peer) in self._by_peer:
                continue
            full = len(self._peers_of(index)) >= _MOST_PEERS
            if full and not self._strangers(index):
                self.links[index].leave(peer)
            else:
                self._channel(index, peer)

    def _peers_of(self, index: int) -> list[tuple[int, Any]]:
        """Returns the keys of a link's peers, longest silent first."""
        return [key for key in self._by_peer if key[0] == index]

    def _strangers(self, index: int) -> list[tuple[int, Any]]:
        return [key for key in self._peers_of(index) if not self.channels[self._by_peer[key]].believed]

    def _channel(self, index: int, peer: Any) -> int:
        """Returns a peer's channel number. On a full link a new peer displaces the longest silent one, those never believed first."""
        key = (index, peer)
        if key in self._by_peer:
            self._by_peer[key] = self._by_peer.pop(key)
        else:
            same = self._peers_of(index)
            if len(same) >= _MOST_PEERS:
                self._forget(*(self._strangers(index) or same)[0])
            self._by_peer[key] = self._next
            self.channels[self._next] = Channel(self.links[index], peer)
            self._next += 1
        return self._by_peer[key]

    def _forget(self, index: int, peer: Any) -> None:
        number = self._by_peer.pop((index, peer), None)
        if number is not None:
            self.counts["gone"] += 1
            self._gone.append(number)
            self.links[index].leave(peer)
            self.counts["dropped"] += self.channels.pop(number).dropped
