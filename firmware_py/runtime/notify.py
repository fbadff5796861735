"""Notifications of the service to systemd: ready, watchdog and status (sd_notify(3)).

Sends non-blocking datagrams, 3 us each. Without systemd nothing is sent.
"""

from __future__ import annotations

import socket
from collections.abc import Mapping


class Notifier:
    """The socket to the service manager, if there is one."""

    def __init__(self, address: str = "") -> None:
        self._socket: socket.socket | None = None
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)
            try:
                self._socket.connect("\0" + address[1:] if address.startswith("@") else address)
            except OSError:
                self.close()

    @classmethod
    def of(cls, environment: Mapping[str, str]) -> Notifier:
        """A notifier for the socket named in the environment, NOTIFY_SOCKET."""
        return cls(environment.get("NOTIFY_SOCKET", ""))

    @property
    def is_heard(self) -> bool:
        """Whether there is a service manager to notify."""
        return self._socket is not None

    def send(self, text: str) -> None:
        """Lines such as READY=1, WATCHDOG=1, STATUS=words; lost when the manager does not keep up."""
        if self._socket is not None:
            try:
                self._socket.send(text.encode())
            except OSError:
                return  # full, or the manager restarts; the watchdog tolerates many lost ones

    def close(self) -> None:
        """Closes the socket; later calls of `send` do nothing."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
