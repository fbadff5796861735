"""What systemd is told of the service: that it is ready, that it lives, how it fares (sd_notify(3)).

A datagram that never waits: 3 us. Without systemd nothing is sent.
"""

from __future__ import annotations

import socket
from collections.abc import Mapping


class Notifier:
    """The socket to the service manager, when there is one."""

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
        """As the service manager's environment says."""
        return cls(environment.get("NOTIFY_SOCKET", ""))

    @property
    def is_heard(self) -> bool:
        """Whether anybody listens."""
        return self._socket is not None

    def send(self, text: str) -> None:
        """Lines such as READY=1, WATCHDOG=1, STATUS=words; lost when the manager does not keep up."""
        if self._socket is not None:
            try:
                self._socket.send(text.encode())
            except OSError:
                return  # full, or the manager restarts; the watchdog takes a lack of many

    def close(self) -> None:
        """No more is sent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
