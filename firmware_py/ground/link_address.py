"""Addresses of links to a ground station: opens each now, or later when its device, network or host is there."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

from firmware_py.ground.transport import LOOPBACK, Link, SerialLink, TcpLink, UdpLink

_LAST_PORT, _FASTEST_BAUD = 65535, 12_000_000
"""Largest 16-bit port number; fastest rate of common USB adapters (FT232H)."""
_NO_DEVICE = (errno.ENOENT, errno.ENODEV, errno.ENXIO)
"""Errors of a serial device that is not plugged in."""
_RESOLVE_EVERY_S = 2.0
"""Interval between attempts to resolve the name of a host."""
_ANSWER_S = 1.0
"""How long the start waits for the address of a name. Without a network the resolver takes ten seconds and more to give up."""


class LinkError(Exception):
    """A link cannot be opened; the message is one line."""


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
