"""slcan behind a port: an adapter on a serial port, locked for one process and never waited for."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
from typing import Any

import can
from can.interfaces.slcan import slcanBus

from firmware_py.bus.codec import Frame
from firmware_py.bus.load import BIT_RATE
from firmware_py.bus.port.links import Link, PortError, error_number, reason_of


class _SlcanBus(slcanBus):
    """python-can's bus, but its lines are written only as far as the device accepts them at once.

    python-can waits without end for a device that accepts nothing, deaf to Ctrl-C: while a port opens, also in its reader.
    """

    def _write(self, string: str) -> None:
        line = string.encode() + self.LINE_TERMINATOR
        try:
            written = os.write(self.serialPortOrig.fileno(), line)
        except OSError as error:
            raise can.CanOperationError(str(error), error.errno) from error
        if written < len(line):
            raise can.CanOperationError(f"{string!r} was cut short", errno.EAGAIN)


class SlcanLink(Link):
    """slcan:DEVICE, an adapter on a serial port."""

    def __init__(self, address: str) -> None:
        super().__init__(address)
        self._rest = b""
        """Rest of the last line that the device has not accepted yet: no other line may begin before it is through."""
        self._lock: int | None = None
        """Descriptor that locks the device for this process: a second process would switch the channel off, and hear no foreign SYNC."""

    def open(self) -> can.BusABC:
        self._rest = b""
        try:
            self._take()
            return _SlcanBus(channel=self.address, bitrate=BIT_RATE, sleep_after_open=0.0, timeout=0.0)
        except Exception as error:
            if isinstance(error, BlockingIOError) and self._lock is None:
                raise PortError(f"slcan:{self.address}: another process uses it; one adapter serves one process") from None
            self._give_back()
            if not isinstance(error, (OSError, ValueError, can.CanError)):
                raise
            if error_number(error) == errno.EAGAIN:
                raise PortError(f"slcan:{self.address}: the adapter accepts nothing; unplug it and plug it in again") from None
            hint = "it takes a serial device, slcan:/dev/ttyACM0"
            raise PortError(f"slcan:{self.address}: {reason_of(error)}; {hint}") from None

    def revive(self, bus: Any) -> None:
        """Opens the channel anew: an adapter that was reset closes it, and says nothing any more.

        Not within a line that is still to be accepted; the next silence is waited for then.
        """
        if not self._rest:
            with contextlib.suppress(can.CanError):
                bus.set_bitrate(BIT_RATE)

    def _take(self) -> None:
        """Locks the device. Raises BlockingIOError if another process holds it, before anything is sent to it."""
        lock = os.open(self.address, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            if not os.isatty(lock):
                raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            raise
        self._give_back()
        self._lock = lock

    def _give_back(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def close(self, bus: Any) -> None:
        """Switches the channel off, as far as the device accepts that at once, and closes bus and device.

        python-can waits without end for a device that accepts nothing, so the device is closed before python-can could write to it.
        """
        try:
            os.write(bus.fileno(), self._rest + b"C\r")
        finally:
            try:
                bus.serialPortOrig.close()
            finally:
                self._give_back()
                with contextlib.suppress(can.CanError):
                    bus.shutdown()

    def send(self, bus: Any, frame: Frame) -> None:
        """Writes what the device accepts at once.

        python-can waits until the frame is transmitted, and reports it as lost if the process was interrupted for longer than its timeout.
        """
        device = bus.fileno()
        if self._rest:
            self._rest = self._rest[os.write(device, self._rest) :]
        if self._rest:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        line = f"t{frame[0]:03X}{len(frame[1])}{frame[1].hex().upper()}\r".encode()
        self._rest = line[os.write(device, line) :]

    def read(self, bus: Any, timeout_s: float) -> Frame | can.Message | None:
        """Reads one frame; discards a line that is not text. python-can busy-waits, and keeps such a line: all later reads would fail."""
        if timeout_s > 0.0 and not select.select((bus.fileno(),), (), (), timeout_s)[0]:
            return None
        try:
            return super().read(bus, 0.0)
        except can.CanOperationError as error:
            if isinstance(error.__cause__, UnicodeDecodeError):
                bus.flush()
            raise

    def is_present(self) -> bool:
        return os.path.exists(self.address)

    def is_same(self) -> bool:
        """Whether the name still leads to the device that was opened: another one under it, plugged in meanwhile, would not be heard."""
        try:
            return self._lock is not None and os.path.samestat(os.fstat(self._lock), os.stat(self.address))
        except OSError:
            return False
