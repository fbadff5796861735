"""Access to a CAN bus: `open_port(address)` over python-can, for the firmware, the plant and the tools alike.

Once open, a port never raises on faults of the bus: an interface that is down, gone, full or recreated is counted, and it recovers by
itself.
"""

from __future__ import annotations

import errno
import threading
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Any

import can

from firmware_py.bus.codec import Frame
from firmware_py.bus.port.links import WAITING_FRAMES, FrameBus, Link, PortError, SocketcanLink, UdpLink, VirtualLink, error_number
from firmware_py.bus.port.slcan import SlcanLink

__all__ = ["Port", "PortError", "open_port"]

ADDRESSES = "virtual:NAME, udp:GROUP:PORT, socketcan:INTERFACE or slcan:DEVICE"
READ_TIMEOUT_S = 0.05
"""Longest sleep of the reader thread without a frame; also the longest time that closing takes."""
REOPEN_EVERY = 16
"""Reads skipped between two attempts to open an interface that is present but does not open."""
SILENCE_NS = 1_000_000_000
"""Silence on the port's clock after which the channel of an adapter is opened anew; half of the silence that disarms the modules."""
BUS_OFF = 0x40
"""CAN_ERR_BUSOFF of linux/can/error.h, in the id of an error frame."""
LARGEST_ID = 0x7FF
"""Largest id of a classic frame. A line of an slcan adapter may hold a larger one after a bit error; a datagram of udp: any number."""

_DOWN = {errno.ENETDOWN, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.EADDRNOTAVAIL}
_GONE = {errno.ENODEV, errno.ENXIO, errno.EBADF, errno.EIO}
_FULL = {errno.ENOBUFS, errno.EAGAIN}


class Port:
    """An open bus. Use it in a `with` statement, or close it.

    Attributes:
        address: as given to open_port.
        faults: counts by kind. Frames not sent: `down`, `full`, `gone`, `send`. Frames not passed on: `foreign` (not a
            classic frame with 11-bit id), `overrun`. Events: `error_frame`, `bus_off`, `receive`, `reopened`.
    """

    def __init__(
        self, address: str, link: Link, reader: bool, now_ns: Callable[[], int] | None, arrival: threading.Event
    ) -> None:
        self.address = address
        kinds = ("down", "full", "gone", "send", "foreign", "overrun", "error_frame", "bus_off", "receive", "reopened")
        self.faults: dict[str, int] = dict.fromkeys(kinds, 0)
        self._link = link
        self._bus: can.BusABC | None = link.open()
        self._closed = False
        self._is_lost = False
        self._skip_reopen = 0
        self._silent_since_ns: int | None = None
        self._now_ns = now_ns
        self._arrival = arrival
        self._waiting: deque[Frame] = deque()
        self._thread: threading.Thread | None = None
        if reader:
            self._thread = threading.Thread(target=self._read_for_ever, name=f"reader of {address}", daemon=True)
            self._thread.start()

    def send(self, frame: Frame) -> bool:
        """Sends one frame, or counts why not. Returns whether the bus accepted it. Never waits for the bus."""
        bus = self._bus
        if bus is None:
            self._refuse_if_closed()
            self.faults["gone"] += 1
            return False
        try:
            self._link.send(bus, frame)
        except Exception as error:  # by back end: OSError, SerialException or python-can's own
            self._failed("send", error)
            return False
        return True

    def receive(self) -> list[Frame]:
        """Returns all available frames in order; without a reader this also reopens an interface that came back."""
        self._refuse_if_closed()
        if self._thread is None:
            return self._drain(0.0)
        waiting, frames = self._waiting, []
        while waiting:
            frames.append(waiting.popleft())
        return frames

    def wait(self, deadline_ns: int, ready: Callable[[], bool] | None = None) -> bool:
        """Blocks until `ready()` (by default: a frame waits here) or until `deadline_ns` on the port's clock.

        `ready` is called again whenever a frame arrives at any port that shares the arrival event.

        Returns:
            Whether it became ready before the deadline.

        Raises:
            PortError: the port has no reader or no clock, so nothing could wake it.
        """
        if self._thread is None or self._now_ns is None:
            raise PortError(f"{self.address}: wait needs a reader and a clock")
        is_ready = ready or self.has_frames
        while True:
            self._arrival.clear()
            if is_ready():
                return True
            left_ns = deadline_ns - self._now_ns()
            if left_ns <= 0:
                return False
            self._arrival.wait(left_ns * 1e-9)

    def has_frames(self) -> bool:
        """Whether frames from the reader are waiting."""
        return bool(self._waiting)

    def close(self) -> None:
        """Closes the bus; may be called repeatedly."""
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
            if self._is_lost:  # noticed by send; only the reader may close the bus that it reads
                self._is_lost = False
                self._let_go()
            frames = self._drain(READ_TIMEOUT_S)
            room = WAITING_FRAMES - len(self._waiting)
            self.faults["overrun"] += max(0, len(frames) - room)
            self._waiting.extend(frames[:room])
            if frames:
                self._arrival.set()
            elif self._bus is None:
                pause.wait(READ_TIMEOUT_S)

    def _drain(self, timeout_s: float) -> list[Frame]:
        """Returns the available frames, after waiting up to `timeout_s` for the first."""
        frames: list[Frame] = []
        bus = self._bus
        if bus is None:
            self._reopen()  # even while `close` waits for the reader: it then closes what was opened
            return frames
        try:
            for item in self._link.waiting(bus, timeout_s):
                frame = item if type(item) is Frame else self._classic(item)
                if frame is None:
                    continue
                if type(frame[0]) is int and 0 <= frame[0] <= LARGEST_ID:
                    frames.append(frame)
                else:
                    self.faults["foreign"] += 1
        except Exception as error:  # as in send; also errors of a back end on garbage
            self._failed("receive", error)
        if frames:
            self._silent_since_ns = None
        else:
            self._look_after(bus)
        return frames

    def _classic(self, message: Any) -> Frame | None:
        if message.is_error_frame:
            self.faults["bus_off" if message.arbitration_id & BUS_OFF else "error_frame"] += 1
            return None
        if message.is_extended_id or message.is_remote_frame or message.is_fd:
            self.faults["foreign"] += 1
            return None
        if message.dlc != len(message.data):  # a torn line of an slcan adapter
            self.faults["receive"] += 1
            return None
        return Frame(message.arbitration_id, bytes(message.data))

    def _look_after(self, bus: Any) -> None:
        if isinstance(bus, FrameBus):
            self.faults["overrun"] += bus.queue.lost
            bus.queue.lost = 0
        elif self._bus is not None and not self._link.is_same():
            self._let_go()
        elif self._bus is not None and self._now_ns is not None:
            now_ns = self._now_ns()
            if self._silent_since_ns is None:
                self._silent_since_ns = now_ns
            elif now_ns - self._silent_since_ns >= SILENCE_NS:
                self._silent_since_ns = now_ns
                self._link.revive(bus)

    def _failed(self, direction: str, error: Exception) -> None:
        number = error_number(error)
        if number in _GONE:
            self.faults["gone"] += 1
            if self._thread is None or self._thread is threading.current_thread():
                self._let_go()
            else:
                self._is_lost = True
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
                self._link.close(bus)
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


LINKS: dict[str, type[Link]] = {"virtual": VirtualLink, "udp": UdpLink, "socketcan": SocketcanLink, "slcan": SlcanLink}
"""Link of each kind of bus, the first word of its address."""


def check_kind(address: str) -> None:
    """Raises PortError if `address` is of no known kind of bus; nothing is opened."""
    if address.partition(":")[0] not in LINKS:
        raise PortError(f"{address!r}: no such kind of bus; it takes {ADDRESSES}")


def open_port(
    address: str,
    *,
    reader: bool = False,
    now_ns: Callable[[], int] | None = None,
    arrival: threading.Event | None = None,
) -> Port:
    """Opens the bus at `address`.

    Args:
        address: virtual:NAME, udp:GROUP:PORT, socketcan:INTERFACE or slcan:DEVICE.
        reader: whether a thread drains the bus continuously (real time); without it `receive` reads (lockstep).
        now_ns: the clock that deadlines of `wait` are on, nanoseconds.
        arrival: with a reader, the event set whenever a frame arrives; share one among ports to wait for all of them.

    Raises:
        PortError: the address is wrong or the bus cannot be opened.
    """
    check_kind(address)
    kind, _, rest = address.partition(":")
    return Port(address, LINKS[kind](rest), reader, now_ns, arrival or threading.Event())
