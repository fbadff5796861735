"""The one way to a CAN bus: `open_port(address)` over python-can, for the firmware, the plant and the tools alike.

Once open a port never raises: an interface that is down, gone, full or made again is a counted fault and recovers by itself.
"""

from __future__ import annotations

import errno
import ipaddress
import os
import socket
import threading
import uuid
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any

import can
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.virtual import VirtualBus, channels_lock

from firmware_py.bus.codec import Frame

ADDRESSES = "virtual:NAME, udp:GROUP:PORT, socketcan:INTERFACE or slcan:DEVICE"
BIT_RATE = 1_000_000
"""bit/s, of every bus of the robot; an slcan adapter is set to it."""
WAITING_FRAMES = 4096
"""Most frames that wait unread in a virtual bus or behind a reader; half a second of a full bus."""
SOCKET_BUFFER_BYTES = 1 << 20
"""Asked for; the kernel's default keeps 256 to 278 unread frames (measured), and gives twice that at most."""
READ_TIMEOUT_S = 0.05
"""How long the reader thread sleeps without a frame; also how long it takes to close."""
REOPEN_EVERY = 16
"""An interface that is there but does not open is tried again at every so-manieth read."""
BUS_OFF = 0x40
"""CAN_ERR_BUSOFF of linux/can/error.h, in the id of an error frame."""

_DOWN = {errno.ENETDOWN, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.EADDRNOTAVAIL}
_GONE = {errno.ENODEV, errno.ENXIO, errno.EBADF, errno.EIO}
_FULL = {errno.ENOBUFS, errno.EAGAIN}


class PortError(Exception):
    """A bus cannot be opened, or is used after it was closed; one line that says what would be right."""


class Link(ABC):
    """One kind of bus: how to open it, and how one frame passes."""

    send_timeout_s: float = 0.0

    def __init__(self, address: str) -> None:
        self.address = address

    @abstractmethod
    def open(self) -> can.BusABC:
        """A fresh python-can bus. Raises PortError."""

    def is_present(self) -> bool:
        """Whether opening it again is worth a try."""
        return True

    def is_same(self) -> bool:
        """Whether the open interface is still the one of that name."""
        return True

    def send(self, bus: Any, frame: Frame) -> None:
        """Hands one frame to `bus`; raises what python-can raises."""
        message = can.Message(arbitration_id=frame[0], is_extended_id=False, data=frame[1])
        bus.send(message, self.send_timeout_s)

    def read(self, bus: Any, timeout_s: float) -> Frame | can.Message | None:
        """One frame from `bus`, or None when there is none."""
        message: can.Message | None = bus.recv(timeout_s)
        return message


class _FrameQueue(SimpleQueue[Any]):
    """What waits for one virtual port; `lost` counts what found it full."""

    lost = 0


class FrameBus(VirtualBus):
    """python-can's virtual bus without its copies: ports hand each other the Frame itself.

    Measured per frame, send and receive together: python-can 20 us (it deep-copies a Message for each listener and locks a
    queue.Queue), this 1 us. Plain python-can buses on the same channel still hear it and are heard.
    """

    def __init__(self, channel: str) -> None:
        super().__init__(channel=channel)
        with channels_lock:
            place = self.channel.index(self.queue)
            self.queue: Any = _FrameQueue()
            self.channel[place] = self.queue

    def send_frame(self, frame: Frame) -> None:
        """Gives `frame` to everyone else on the channel."""
        for queue in tuple(self.channel):
            if queue is self.queue:
                continue
            if type(queue) is not _FrameQueue:
                queue.put(can.Message(arbitration_id=frame[0], is_extended_id=False, data=frame[1]))
            elif queue.qsize() < WAITING_FRAMES:
                queue.put(frame)
            else:
                queue.lost += 1

    def read_frame(self, timeout_s: float) -> Frame | can.Message | None:
        """The next frame, or None."""
        try:
            item: Frame | can.Message = self.queue.get(timeout_s > 0.0, timeout_s)
        except Empty:
            return None
        return item


class VirtualLink(Link):
    """virtual:NAME, between ports of one process."""

    def open(self) -> can.BusABC:
        if not self.address:
            raise PortError("virtual: needs a name: virtual:NAME")
        return FrameBus(self.address)

    def send(self, bus: Any, frame: Frame) -> None:
        bus.send_frame(frame)

    def read(self, bus: Any, timeout_s: float) -> Frame | can.Message | None:
        item: Frame | can.Message | None = bus.read_frame(timeout_s)
        return item


class UdpLink(Link):
    """udp:GROUP:PORT, between processes of one machine: hop limit 0 keeps the frames on it."""

    def __init__(self, address: str) -> None:
        super().__init__(address)
        group, _, port = address.rpartition(":")
        try:
            self.group = ipaddress.ip_address(group.strip("[]"))
            self.port = int(port)
        except ValueError:
            self.group, self.port = ipaddress.ip_address("0.0.0.0"), 0
        if not self.group.is_multicast or not 1 <= self.port <= 65535:
            raise PortError(f"udp:{address}: needs udp:GROUP:PORT, such as udp:239.74.163.2:43113 (multicast, 1..65535)")
        # A sender hears its own frames, and all senders of a machine have the same address and port: this tells them apart.
        self.token = uuid.uuid4().hex[:12]

    def open(self) -> can.BusABC:
        try:
            bus = UdpMulticastBus(channel=str(self.group), port=self.port, hop_limit=0)
        except (OSError, can.CanError) as error:
            raise PortError(
                f"udp:{self.address}: {_reason(error)}; without a default route: ip route add 224.0.0.0/4 dev lo"
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
    """socketcan:INTERFACE, the kernel's. A controller that went bus-off comes back by itself with `restart-ms` set."""

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
            bus = can.Bus(interface="socketcan", channel=self.address)
        except (OSError, can.CanError) as error:
            hint = "not a CAN interface" if _number(error) == errno.ENODEV else _reason(error)
            raise PortError(f"socketcan:{self.address}: {hint}; it takes can0, vcan0 or the like") from None
        _enlarge_buffer(bus)
        return bus

    def is_present(self) -> bool:
        return self._current_index() != 0

    def is_same(self) -> bool:
        """A socket of an interface that was deleted and made again stays silent for ever without an error."""
        return self._current_index() == self._index

    def _current_index(self) -> int:
        try:
            return socket.if_nametoindex(self.address)
        except OSError:
            return 0


class SlcanLink(Link):
    """slcan:DEVICE, an adapter on a serial port."""

    send_timeout_s = 0.01

    def open(self) -> can.BusABC:
        try:
            return can.Bus(interface="slcan", channel=self.address, bitrate=BIT_RATE, sleep_after_open=0.0, timeout=0.0)
        except (OSError, ValueError, can.CanError) as error:
            raise PortError(f"slcan:{self.address}: {_reason(error)}; it takes a serial device, slcan:/dev/ttyACM0") from None

    def is_present(self) -> bool:
        return os.path.exists(self.address)


class Port:
    """An open bus. Use it in a `with` statement, or close it.

    Attributes:
        address: as given to open_port.
        faults: counts by kind. Frames not sent: `down`, `full`, `gone`, `send`. Frames not passed on: `foreign` (not a
            classic frame with 11-bit id), `overrun`. Events: `error_frame`, `bus_off`, `receive`, `reopened`.
    """

    def __init__(self, address: str, link: Link, reader: bool, arrival: threading.Event) -> None:
        self.address = address
        kinds = ("down", "full", "gone", "send", "foreign", "overrun", "error_frame", "bus_off", "receive", "reopened")
        self.faults: dict[str, int] = dict.fromkeys(kinds, 0)
        self._link = link
        self._bus: can.BusABC | None = link.open()
        self._closed = False
        self._skip_reopen = 0
        self._arrival = arrival
        self._waiting: deque[Frame] = deque()
        self._thread: threading.Thread | None = None
        if reader:
            self._thread = threading.Thread(target=self._read_for_ever, name=f"reader of {address}", daemon=True)
            self._thread.start()

    def send(self, frame: Frame) -> None:
        """Sends one frame, or counts why not. Never waits for the bus."""
        bus = self._bus
        if bus is None:
            self._refuse_if_closed()
            self.faults["gone"] += 1
            return
        try:
            self._link.send(bus, frame)
        except Exception as error:  # python-can lets OSError, SerialException and its own through, by back end
            self._failed("send", bus, error)

    def receive(self) -> list[Frame]:
        """Every frame that is there, in order; without a reader this also reopens an interface that came back."""
        if self._thread is None:
            return self._drain(0.0)
        self._refuse_if_closed()
        waiting, frames = self._waiting, []
        while waiting:
            frames.append(waiting.popleft())
        return frames

    def wait(self, deadline_ns: int, now_ns: Callable[[], int], ready: Callable[[], bool] | None = None) -> bool:
        """Blocks until `ready()` (by default: a frame waits here) or until `deadline_ns` on the clock `now_ns`.

        For real time, with a reader. `ready` is asked again whenever a frame arrives at any port with the same arrival.

        Returns:
            Whether it became ready before the deadline.
        """
        is_ready = ready or (lambda: bool(self._waiting))
        while True:
            self._arrival.clear()
            if is_ready():
                return True
            left_ns = deadline_ns - now_ns()
            if left_ns <= 0:
                return False
            self._arrival.wait(left_ns * 1e-9)

    def close(self) -> None:
        """Closes the bus; may be called again."""
        self._closed = True
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._let_go()

    def __enter__(self) -> Port:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _read_for_ever(self) -> None:
        pause = threading.Event()
        while not self._closed:
            frames = self._drain(READ_TIMEOUT_S)
            room = WAITING_FRAMES - len(self._waiting)
            self.faults["overrun"] += max(0, len(frames) - room)
            self._waiting.extend(frames[:room])
            if frames:
                self._arrival.set()
            elif self._bus is None:
                pause.wait(READ_TIMEOUT_S)

    def _drain(self, timeout_s: float) -> list[Frame]:
        """What is there now, after waiting up to `timeout_s` for the first."""
        frames: list[Frame] = []
        bus, read = self._bus, self._link.read
        if bus is None:
            self._refuse_if_closed()
            self._reopen()
            return frames
        try:
            for _ in range(WAITING_FRAMES):
                item = read(bus, timeout_s)
                if item is None:
                    break
                timeout_s = 0.0
                if type(item) is Frame:
                    frames.append(item)
                elif (frame := self._classic(item)) is not None:
                    frames.append(frame)
        except Exception as error:  # as in send; also what a back end makes of garbage
            self._failed("receive", bus, error)
        if not frames:
            self._look_after(bus)
        return frames

    def _classic(self, message: Any) -> Frame | None:
        if message.is_error_frame:
            self.faults["bus_off" if message.arbitration_id & BUS_OFF else "error_frame"] += 1
            return None
        if message.is_extended_id or message.is_remote_frame or message.is_fd:
            self.faults["foreign"] += 1
            return None
        return Frame(message.arbitration_id, bytes(message.data))

    def _look_after(self, bus: Any) -> None:
        if isinstance(bus, FrameBus):
            self.faults["overrun"] += bus.queue.lost
            bus.queue.lost = 0
        elif self._bus is not None and not self._link.is_same():
            self._let_go()

    def _failed(self, direction: str, bus: Any, error: Exception) -> None:
        number = _number(error)
        if number in _GONE:
            self.faults["gone"] += 1
            self._let_go()
        elif number in _DOWN:
            self.faults["down"] += 1
        elif number in _FULL or isinstance(error, can.CanTimeoutError) or "buffer full" in str(error):
            self.faults["full"] += 1
        else:
            self.faults[direction] += 1

    def _let_go(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            try:
                bus.shutdown()
            except Exception:  # slcan writes a last command to a device that may be gone
                self.faults["gone"] += 1

    def _reopen(self) -> None:
        if self._skip_reopen > 0:
            self._skip_reopen -= 1
        elif self._link.is_present():
            try:
                self._bus = self._link.open()
                self.faults["reopened"] += 1
            except PortError:
                self._skip_reopen = REOPEN_EVERY

    def _refuse_if_closed(self) -> None:
        if self._closed:
            raise PortError(f"{self.address}: is closed")


def open_port(address: str, *, reader: bool = False, arrival: threading.Event | None = None) -> Port:
    """Opens the bus at `address`.

    Args:
        address: virtual:NAME, udp:GROUP:PORT, socketcan:INTERFACE or slcan:DEVICE.
        reader: a thread drains the bus all the time (real time); without it `receive` reads (lockstep).
        arrival: set whenever a frame arrives, with a reader; share one among ports to wait for all of them.

    Raises:
        PortError: the address is wrong or the bus cannot be opened.
    """
    kind, _, rest = address.partition(":")
    links: dict[str, type[Link]] = {
        "virtual": VirtualLink, "udp": UdpLink, "socketcan": SocketcanLink, "slcan": SlcanLink
    }
    if kind not in links:
        raise PortError(f"{address!r}: no such kind of bus; it takes {ADDRESSES}")
    return Port(address, links[kind](rest), reader, arrival or threading.Event())


def _number(error: BaseException) -> int | None:
    """errno behind an exception of python-can, which keeps it in one of three places."""
    for each in (error, error.__cause__):
        number = getattr(each, "error_code", None) or getattr(each, "errno", None)
        if isinstance(number, int):
            return number
    return None


def _reason(error: BaseException) -> str:
    number = _number(error)
    return os.strerror(number) if number else str(error).splitlines()[0] if str(error) else type(error).__name__


def _enlarge_buffer(bus: can.BusABC) -> None:
    with socket.socket(fileno=os.dup(bus.fileno())) as same:
        same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER_BYTES)
