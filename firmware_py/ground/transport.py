"""Types of link to a ground station: udpin, udpout, tcpin, serial. None ever blocks once it is opened."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
import termios
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, Protocol

import serial

LOOPBACK = "127.0.0.1"
_DATAGRAM = 65536
_READ = 4096
_LAST_PORT, _FASTEST_BAUD = 65535, 12_000_000
"""Largest 16-bit port number; fastest rate of common USB adapters (FT232H)."""
_READS_AT_ONCE = 64
"""Most datagrams read from one socket before the next socket has its turn."""
_NO_DEVICE = (errno.ENOENT, errno.ENODEV, errno.ENXIO)
"""Errors of a serial device that is not plugged in."""
_RESOLVE_EVERY_S = 2.0
"""Interval between attempts to resolve the name of a host."""
_ANSWER_S = 1.0
"""How long the start waits for the address of a name. Without a network the resolver takes ten seconds and more to give up."""


class LinkError(Exception):
    """A link cannot be opened; the message is one line."""


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


class LateLink:
    """A network link that could not be opened at the start. It is opened once its host has an address that this machine can use.

    Each `receive` tries to open it, which takes microseconds. Only a name is resolved in a thread of its own, which may wait for seconds.
    """

    def __init__(self, kind: str, host: str, port: int, resolved: bool) -> None:
        self.datagram = kind != "tcpin"
        self._kind, self._port = kind, port
        self._host = host if resolved else ""
        """Numeric address; empty while the name is not resolved."""
        self._link: Link | None = None
        self._closed = threading.Event()
        if not resolved:
            threading.Thread(target=self._resolve, args=(host,), name="resolver", daemon=True).start()

    @property
    def is_open(self) -> bool:
        return self._link is not None

    def _resolve(self, name: str) -> None:
        while not self._host and not self._closed.wait(_RESOLVE_EVERY_S):
            with contextlib.suppress(OSError):
                self._host = socket.gethostbyname(name)

    def receive(self) -> list[tuple[Any, bytes]]:
        """Raises OSError for an address that cannot be opened although its network is there, as one in use."""
        if self._link is None and self._host:
            try:
                self._link = _open_network(self._kind, self._host, self._port)
            except OSError as error:
                if error.errno != errno.EADDRNOTAVAIL:
                    raise
        return self._link.receive() if self._link is not None else []

    def send(self, peer: Any, frame: bytes) -> bool:
        """Sends a frame; discards it while the link is not open, since old telemetry is useless."""
        return self._link is None or self._link.send(peer, frame)

    def peers(self) -> Sequence[Any]:
        if self._link is None:
            return [None] if self._kind == "udpout" else []
        return self._link.peers()

    def leave(self, peer: Any) -> None:
        if self._link is not None:
            self._link.leave(peer)

    def close(self) -> None:
        self._closed.set()
        if self._link is not None:
            self._link.close()


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


def open_link(address: str, warn: Callable[[str], None]) -> Link:
    """Opens the link at `address`, which comes without the suffix `+trusted`.

    Where a device, a network or the name of a host is not there yet, `warn` receives one line, and the link opens itself later.

    Raises:
        LinkError: the kind of address is unknown, or it cannot be opened.
    """

    def put_off(error: OSError) -> None:
        warn(f"link {address}: not there yet: {_reason(error)}; it is opened when it is there")

    try:
        if address.startswith("/"):
            device, _, baud = address.partition(",")
            rate = _number(address, baud or "921600", _FASTEST_BAUD, "/dev/NAME,BAUD, as /dev/ttyTHS1,921600")
            return _serial_link(device, rate, put_off)
        kind, _, rest = address.partition(":")
        host, _, port = rest.rpartition(":")
        if kind in ("udpin", "udpout", "tcpin"):
            number = _number(address, port, _LAST_PORT, f"{kind}:HOST:PORT, as {kind}:{LOOPBACK}:14550, and behind it at most one +trusted")
            return _network_link(kind, _host(address, host or LOOPBACK), number, put_off)
    except (OSError, ValueError, OverflowError) as error:
        raise LinkError(f"link {address}: cannot be opened: {_reason(error)}") from None
    raise LinkError(f"link {address}: unknown; there are udpin:, udpout:, tcpin:HOST:PORT and /dev/NAME,BAUD")


def _serial_link(device: str, baud: int, put_off: Callable[[OSError], None]) -> Link:
    link = SerialLink(device, baud)
    try:
        link.open()
    except OSError as error:
        if error.errno not in _NO_DEVICE:
            raise
        put_off(error)
    return link


def _network_link(kind: str, host: str, port: int, put_off: Callable[[OSError], None]) -> Link:
    numeric = ""
    try:
        numeric = _address_of(host)
        return _open_network(kind, numeric, port)
    except OSError as error:
        is_late = error.errno == errno.EADDRNOTAVAIL if numeric else _is_name(host)
        if not is_late:
            raise
        put_off(error)
    return LateLink(kind, numeric or host, port, bool(numeric))


def _open_network(kind: str, host: str, port: int) -> Link:
    """Opens a network link at a numeric address. Raises OSError."""
    return TcpLink((host, port)) if kind == "tcpin" else UdpLink((host, port), kind == "udpin")


def _address_of(host: str) -> str:
    """Returns the numeric address of a host. Raises OSError, also when there is no answer within _ANSWER_S."""
    answer: Future[str] = Future()

    def ask() -> None:
        try:
            answer.set_result(socket.gethostbyname(host))
        except (OSError, ValueError) as error:
            answer.set_exception(error)

    threading.Thread(target=ask, name="resolver", daemon=True).start()
    try:
        return answer.result(_ANSWER_S)
    except TimeoutError:
        raise socket.gaierror(socket.EAI_AGAIN, "no name server answers") from None


def _is_name(host: str) -> bool:
    """Whether a resolver may come to know `host`: an address that is wrong, as 10.0.0.256 or ::1, is none."""
    last = host.removesuffix(".").rpartition(".")[2]
    return not last.isdecimal() and re.fullmatch(r"[\w.-]+", host) is not None


def _reason(error: Exception) -> str:
    """Returns the cause in the operating system's words. Name resolution errors have negative numbers, and their text in the error."""
    number = getattr(error, "errno", None) or 0
    if number == errno.ENOTTY:
        return "is no serial device"
    return os.strerror(number) if number > 0 else getattr(error, "strerror", None) or str(error)


def _host(address: str, text: str) -> str:
    """Returns `text`, a host name or IP address. Raises LinkError when it can be neither."""
    try:
        text.encode("idna")
    except UnicodeError:
        raise LinkError(f"link {address}: {text!r} is no name of a host") from None
    return text


def _number(address: str, text: str, most: int, right: str) -> int:
    """Parses a port or a baud rate. Raises LinkError, which says what is expected."""
    if not (text.isascii() and text.isdecimal() and len(text) <= len(str(most)) and int(text) <= most):
        raise LinkError(f"link {address}: {text!r} is no whole number up to {most}; it needs {right}")
    return int(text)
