"""Types of link to a ground station: udpin, udpout, tcpin, serial. None ever blocks once it is opened."""

from __future__ import annotations

import contextlib
import os
import socket
import termios
from collections.abc import Sequence
from typing import Any, Protocol

import serial

LOOPBACK = "127.0.0.1"
_DATAGRAM = 65536
_READ = 4096
_READS_AT_ONCE = 64
"""Most datagrams read from one socket before the next socket has its turn."""


class Link(Protocol):
    """A link at one address. `receive` and `send` never block; they raise OSError when the link fails for now."""

    datagram: bool

    @property
    def is_open(self) -> bool:
        """Whether its device or network is there; as long as it is not, `receive` tries to open it."""
        ...

    def receive(self) -> list[tuple[Any, bytes]]:
        """Returns the received data, each piece with its peer."""
        ...

    def send(self, peer: Any, frame: bytes) -> bool:
        """Sends a frame. Returns whether it was accepted; False: try again later."""
        ...

    def peers(self) -> Sequence[Any]:
        """Returns the peers that are known before they have sent anything."""
        ...

    def leave(self, peer: Any) -> None:
        """Ends communication with a peer."""
        ...

    def close(self) -> None:
        """Releases the port."""
        ...


class UdpLink:
    """udpin: answers every sender. udpout: sends to one address from the start, and accepts data from there only. Takes no host names.

    The socket is not connected: that would bind it to the machine's present address, and mute it once the machine gets another.
    """

    datagram = True
    is_open = True

    def __init__(self, address: tuple[str, int], listen: bool) -> None:
        self._to = None if listen else _who_answers(address)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            if listen:
                self._socket.bind(address)
        except (OSError, OverflowError):
            self._socket.close()
            raise

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._socket.getsockname()[1])

    def receive(self) -> list[tuple[Any, bytes]]:
        got: list[tuple[Any, bytes]] = []
        for _ in range(_READS_AT_ONCE):
            try:
                data, peer = self._socket.recvfrom(_DATAGRAM)
            except BlockingIOError:
                break
            if self._to is None or peer == self._to:
                got.append((None if self._to else peer, data))
        return got

    def send(self, peer: Any, frame: bytes) -> bool:
        try:
            self._socket.sendto(frame, self._to or peer)
        except BlockingIOError:
            return False
        return True

    def peers(self) -> Sequence[Any]:
        return [None] if self._to else []

    def leave(self, peer: Any) -> None:
        """Does nothing: no state is kept per peer."""

    def close(self) -> None:
        self._socket.close()


def _who_answers(address: tuple[str, int]) -> tuple[str, int]:
    """Returns the address from which `address` answers: 127.0.0.1 for 0.0.0.0. An unreachable network is accepted: it may come up.

    Raises PermissionError for a broadcast address, from which no answer comes.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(address)
            host, port = probe.getpeername()
        except PermissionError:
            raise
        except OSError:
            return address
    return host, port


class TcpLink:
    """tcpin: every connected client is a peer."""

    datagram = False
    is_open = True

    def __init__(self, address: tuple[str, int]) -> None:
        self._server = socket.create_server(address)
        self._server.setblocking(False)
        self._unsent: dict[socket.socket, bytes] = {}
        """Rest of the frame that each connected client has accepted in part only."""

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._server.getsockname()[1])

    def receive(self) -> list[tuple[Any, bytes]]:
        with contextlib.suppress(BlockingIOError, ConnectionError):
            peer, _ = self._server.accept()
            peer.setblocking(False)
            peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._unsent[peer] = b""
        got = [(peer, data) for peer in list(self._unsent) if (data := self._read(peer)) is not None]
        for peer, data in got:
            if not data:
                self.leave(peer)
        return got

    def _read(self, peer: socket.socket) -> bytes | None:
        try:
            return peer.recv(_READ)
        except BlockingIOError:
            return None
        except OSError:
            return b""

    def send(self, peer: Any, frame: bytes) -> bool:
        """Sends a frame, after the rest of the previous one if that was sent in part."""
        if peer not in self._unsent:
            return True
        try:
            if self._unsent[peer]:
                self._unsent[peer] = self._unsent[peer][peer.send(self._unsent[peer]) :]
            if self._unsent[peer]:
                return False
            self._unsent[peer] = frame[peer.send(frame) :]
        except BlockingIOError:
            return False
        except OSError:
            self.leave(peer)
        return True

    def leave(self, peer: socket.socket) -> None:
        self._unsent.pop(peer, None)
        peer.close()

    def peers(self) -> Sequence[Any]:
        return list(self._unsent)

    def close(self) -> None:
        for peer in list(self._unsent):
            self.leave(peer)
        self._server.close()


class SerialLink:
    """A radio or a UART of the vehicle's computer. A device that is not plugged in is opened when it is there, or is back."""

    datagram = False

    def __init__(self, device: str, baud: int) -> None:
        self._device, self._baud = device, baud
        self._serial: Any = None
        self._unsent = b""
        """Rest of the frame that the device has accepted in part only."""

    def open(self) -> None:
        """Opens the device. Raises OSError."""
        try:
            self._serial = serial.Serial(self._device, self._baud, timeout=0, write_timeout=0)
        except termios.error as error:  # unplugged meanwhile: not an OSError, and pyserial lets it through
            raise OSError(*error.args) from None
        except ValueError as error:  # a rate that the driver refuses
            raise OSError(str(error)) from None
        except serial.SerialException as error:
            if isinstance(error.__context__, termios.error):  # SerialException keeps neither its errno nor its text separately
                raise OSError(*error.__context__.args) from None
            raise

    @property
    def is_open(self) -> bool:
        return self._serial is not None

    def _is_plugged(self) -> bool:
        """Whether the device is open; opens it when it is there."""
        if self._serial is None and os.path.exists(self._device):
            with contextlib.suppress(OSError):  # udev has not granted access yet, or it was unplugged again
                self.open()
        return self._serial is not None

    def _pulled(self) -> None:
        self._serial.close()
        self._serial, self._unsent = None, b""

    def receive(self) -> list[tuple[Any, bytes]]:
        if not self._is_plugged():
            return []
        try:
            data = self._serial.read(_READ)
        except OSError:
            self._pulled()
            raise
        return [(None, data)] if data else []

    def send(self, peer: Any, frame: bytes) -> bool:
        """Sends a frame; discards it while the device is unplugged, since old telemetry is useless."""
        if self._serial is None:
            return True
        try:
            self._unsent = self._unsent[self._write(self._unsent) :] if self._unsent else b""
            if self._unsent:
                return False
            self._unsent = frame[self._write(frame) :]
        except BlockingIOError:
            return False
        except OSError:
            self._pulled()
            raise
        return True

    def _write(self, data: bytes) -> int:
        """Writes what the device accepts now; returns the number of bytes. Not pyserial's write, which busy-waits while it accepts none."""
        return os.write(self._serial.fileno(), data)

    def peers(self) -> Sequence[Any]:
        return [None]

    def leave(self, peer: Any) -> None:
        """The device stays open."""

    def close(self) -> None:
        if self._serial is not None:
            self._serial.close()
