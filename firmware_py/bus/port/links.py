"""Types of bus behind a port: how each is opened over python-can, and how it sends and reads a frame."""

from __future__ import annotations

import errno
import ipaddress
import os
import select
import socket
import struct
import uuid
from abc import ABC, abstractmethod
from collections.abc import Iterable
from queue import Empty, SimpleQueue
from typing import Any, cast

import can
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.virtual import VirtualBus, channels_lock

from firmware_py.bus.codec import Frame

WAITING_FRAMES = 4096
"""Most unread frames in a virtual bus or behind a reader; half a second of a full bus."""
SOCKET_BUFFER_BYTES = 1 << 20
"""Requested receive buffer. The kernel's default holds 256 to 278 unread frames (measured); it grants at most twice that."""

_CAN_FRAME = struct.Struct("=IB3x8s")
"""struct can_frame of linux/can.h: id and flags, length, payload."""
_EXTENDED, _REMOTE, _ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
"""CAN_EFF_FLAG, CAN_RTR_FLAG and CAN_ERR_FLAG, in the id word."""
_FLAGS = _EXTENDED | _REMOTE | _ERROR


class PortError(Exception):
    """A bus cannot be opened, or a port is misused, such as after it was closed; the message is one line that says what is expected."""


class Link(ABC):
    """One type of bus: opens it, and sends and reads its frames."""

    def __init__(self, address: str) -> None:
        self.address = address

    @abstractmethod
    def open(self) -> can.BusABC:
        """Opens a new python-can bus. Raises PortError."""

    def is_present(self) -> bool:
        """Whether the interface is there, so that reopening is worth a try."""
        return True

    def is_same(self) -> bool:
        """Whether the open interface is still the one that has the name now."""
        return True

    def revive(self, bus: Any) -> None:  # noqa: B027
        """Makes a silent bus work again whose interface may have lost its settings without an error."""

    def close(self, bus: Any) -> None:
        """Closes a bus from `open`, even if its interface is gone."""
        bus.shutdown()

    def send(self, bus: Any, frame: Frame) -> None:
        """Hands one frame to `bus`; lets python-can's exceptions through."""
        message = can.Message(arbitration_id=frame[0], is_extended_id=False, data=frame[1])
        bus.send(message, 0.0)

    def read(self, bus: Any, timeout_s: float) -> Frame | can.Message | None:
        """Reads one frame from `bus`; returns None when there is none."""
        message: can.Message | None = bus.recv(timeout_s)
        return message

    def waiting(self, bus: Any, timeout_s: float) -> Iterable[Frame | can.Message]:
        """Yields the available frames, after waiting up to `timeout_s` for the first; at most WAITING_FRAMES, if the bus never pauses."""
        for _ in range(WAITING_FRAMES):
            item = self.read(bus, timeout_s)
            if item is None:
                return
            yield item
            timeout_s = 0.0


class _FrameQueue(SimpleQueue[Any]):
    """Frames that wait for one virtual port; `lost` counts those that found it full."""

    lost = 0


class FrameBus(VirtualBus):
    """python-can's virtual bus without its copies: ports hand each other the Frame itself.

    Measured per frame, send and receive together: python-can 6.4 us (it deep-copies a Message for each listener and
    locks a queue.Queue), this 0.4 us. It still exchanges frames with plain python-can buses on the same channel.
    """

    def __init__(self, channel: str) -> None:
        super().__init__(channel=channel)
        self.listeners = cast(list[Any], self.channel)
        with channels_lock:
            place = self.listeners.index(self.queue)
            self.queue: Any = _FrameQueue()
            self.listeners[place] = self.queue


class VirtualLink(Link):
    """virtual:NAME, between ports of one process."""

    def open(self) -> can.BusABC:
        if not self.address:
            raise PortError("virtual: needs a name: virtual:NAME")
        return FrameBus(self.address)

    def send(self, bus: Any, frame: Frame) -> None:
        for queue in tuple(bus.listeners):
            if queue is bus.queue:
                continue
            if type(queue) is not _FrameQueue:
                queue.put(can.Message(arbitration_id=frame[0], is_extended_id=False, data=frame[1]))
            elif queue.qsize() < WAITING_FRAMES:
                queue.put(frame)
            else:
                queue.lost += 1

    def read(self, bus: Any, timeout_s: float) -> Frame | can.Message | None:
        try:
            item: Frame | can.Message = bus.queue.get(timeout_s > 0.0, timeout_s)
        except Empty:
            return None
        return item

    def waiting(self, bus: Any, timeout_s: float) -> Iterable[Frame | can.Message]:
        first = self.read(bus, timeout_s) if timeout_s > 0.0 else None
        rest = [bus.queue.get(False) for _ in range(bus.queue.qsize())]  # there is no other consumer
        return rest if first is None else [first, *rest]


class UdpLink(Link):
    """udp:GROUP:PORT, between processes of one machine: hop limit 0 keeps the frames on that machine."""

    def __init__(self, address: str) -> None:
        super().__init__(address)
        group, _, port = address.rpartition(":")
        try:
            self.group = ipaddress.ip_address(group.strip("[]"))
            self.port = int(port)
        except ValueError:
            self.group, self.port = ipaddress.ip_address("0.0.0.0"), 0
        if not self.group.is_multicast or not 1 <= self.port <= 65535:
            raise PortError(f"udp:{address}: needs a multicast group and a port, udp:239.74.163.2:43113")
        # A sender hears its own frames, and all senders of a machine share address and port: the token tells them apart.
        self.token = uuid.uuid4().hex[:12]

    def open(self) -> can.BusABC:
        try:
            bus = UdpMulticastBus(channel=str(self.group), port=self.port, hop_limit=0)
        except (OSError, can.CanError) as error:
            raise PortError(
                f"udp:{self.address}: {reason_of(error)}; without a default route: ip route add 224.0.0.0/4 dev lo"
            ) from None
        _enlarge_buffer(bus)
        return bus

    def send(self, bus: Any, frame: Frame) -> None:
        message = can.Message(arbitration_id=frame[0], is_extended_id=False, data=frame[1], channel=self.token)
        bus.send(message, 0.0)

    def read(self, bus: Any, timeout_s: float) -> Frame | can.Message | None:
        while True:
            message: can.Message | None = bus.recv(timeout_s)
            if message is None or message.channel != self.token:
                return message
            timeout_s = 0.0


class SocketcanLink(Link):
    """socketcan:INTERFACE, a CAN interface of the kernel. A controller in bus-off recovers by itself if `restart-ms` is set.

    Frames pass through python-can's socket without its messages. Thousands of instructions per frame, measured in
    hil/guest: 9 to send instead of python-can's 46, 9 to receive instead of 55.
    """

    def __init__(self, address: str) -> None:
        super().__init__(address)
        self._index = 0

    def open(self) -> can.BusABC:
        try:
            self._index = socket.if_nametoindex(self.address)
        except (OSError, ValueError):
            names = [name for _, name in socket.if_nameindex() if "can" in name]
            there = f"there are {', '.join(names)}" if names else "this machine has none with can in its name"
            raise PortError(f"socketcan:{self.address}: there is no such interface; {there}") from None
        try:
            # python-can leaks the socket of an interface that it cannot bind, so a probe goes first.
            with socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
                probe.bind((self.address,))
            bus = can.Bus(interface="socketcan", channel=self.address, ignore_config=True)
        except (OSError, can.CanError) as error:
            hint = "not a CAN interface" if error_number(error) == errno.ENODEV else reason_of(error)
            raise PortError(f"socketcan:{self.address}: {hint}; it takes can0, vcan0 or the like") from None
        _enlarge_buffer(bus)
        return bus

    def send(self, bus: Any, frame: Frame) -> None:
        bus.socket.send(_CAN_FRAME.pack(frame[0], len(frame[1]), frame[1]), socket.MSG_DONTWAIT)

    def read(self, bus: Any, timeout_s: float) -> Frame | can.Message | None:
        if timeout_s > 0.0 and not select.select((bus.socket,), (), (), timeout_s)[0]:
            return None
        try:
            word, length, payload = _CAN_FRAME.unpack(bus.socket.recv(_CAN_FRAME.size, socket.MSG_DONTWAIT))
        except BlockingIOError:
            return None
        if word & _FLAGS:
            return can.Message(
                arbitration_id=word & ~_FLAGS, data=payload[:length], is_extended_id=bool(word & _EXTENDED),
                is_remote_frame=bool(word & _REMOTE), is_error_frame=bool(word & _ERROR),
            )  # fmt: skip
        return Frame(word, payload[:length])

    def is_present(self) -> bool:
        return self._current_index() != 0

    def is_same(self) -> bool:
        """Whether the interface was not recreated since it was opened: the socket of the old one would stay silent without an error."""
        return self._current_index() == self._index

    def _current_index(self) -> int:
        try:
            return socket.if_nametoindex(self.address)
        except OSError:
            return 0


def error_number(error: BaseException) -> int | None:
    """Returns the errno behind an exception of python-can, which keeps it in one of three places."""
    for each in (error, error.__cause__):
        number = getattr(each, "error_code", None) or getattr(each, "errno", None)
        if isinstance(number, int):
            return number
    return None


def reason_of(error: BaseException) -> str:
    """Returns why an exception of python-can was raised, in one line."""
    number = error_number(error)
    return os.strerror(number) if number else str(error).splitlines()[0] if str(error) else type(error).__name__


def _enlarge_buffer(bus: can.BusABC) -> None:
    with socket.socket(fileno=os.dup(bus.fileno())) as same:
        same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER_BYTES)
