"""can-utils as test instruments: candump listens, cansend and cangen send, canplayer plays a log back."""

import select
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

RECEIVE_LISTS = Path("/proc/net/can")
POLL_MS = 5
TIMEOUT_S = 30.0
"""Longest wait for another process; the guest is some 20 times slower than a machine."""


class LoggedFrame(NamedTuple):
    """One line of a candump log: seconds, interface, 11-bit id, payload."""

    time_s: float
    interface: str
    identifier: int
    data: bytes

    @classmethod
    def parse(cls, line: str) -> "LoggedFrame":
        """Parses `(1700000000.000000) vcan0 123#0011`."""
        stamp, interface, frame = line.split()[:3]
        identifier, _, data = frame.partition("#")
        return cls(float(stamp.strip("()")), interface, int(identifier, 16), bytes.fromhex(data))

    def line(self) -> str:
        return f"({self.time_s:017.6f}) {self.interface} {self.identifier:03X}#{self.data.hex().upper()}"


def read_log(path: Path) -> list[LoggedFrame]:
    return [LoggedFrame.parse(line) for line in path.read_text().splitlines() if line.startswith("(")]


def write_log(path: Path, frames: list[LoggedFrame]) -> None:
    path.write_text("".join(frame.line() + "\n" for frame in frames))


def _listeners(interface: str) -> int:
    """Number of sockets that read everything on the interface."""
    rows = (RECEIVE_LISTS / "rcvlist_all").read_text().splitlines()
    return sum(row.split()[:1] == [interface] for row in rows)


class Candump:
    """A running candump; `take` returns the received frames in order."""

    def __init__(self, interface: str, buffer_bytes: int = 1 << 20) -> None:
        listening = _listeners(interface)
        command = ["candump", "-L", "-r", str(buffer_bytes), interface]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0)
        assert self._process.stdout is not None
        self._out = self._process.stdout
        self._ready = select.poll()
        self._ready.register(self._out, select.POLLIN)
        self._text = b""
        deadline = time.monotonic() + TIMEOUT_S
        while _listeners(interface) == listening:
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise OSError(f"candump does not listen on {interface}")
            self._ready.poll(POLL_MS)

    def take(self, count: int, timeout_s: float = TIMEOUT_S) -> list[LoggedFrame]:
        """The next `count` frames, or fewer if they do not arrive in time."""
        deadline = time.monotonic() + timeout_s
        while self._text.count(b"\n") < count and (left_s := deadline - time.monotonic()) > 0:
            if not self._ready.poll(left_s * 1e3) or not (read := self._out.read(1 << 16)):
                break
            self._text += read
        lines = self._text.split(b"\n", count)
        taken = lines[:count] if len(lines) > count else lines[:-1]
        self._text = lines[-1]
        return [LoggedFrame.parse(line.decode()) for line in taken]

    def close(self) -> None:
        self._process.terminate()
        self._process.wait()
        self._out.close()


@contextmanager
def candump(interface: str) -> Iterator[Candump]:
    """A candump that is listening when the block begins, and ends with the block."""
    listener = Candump(interface)
    try:
        yield listener
    finally:
        listener.close()


def cansend(interface: str, identifier: int, data: bytes) -> None:
    subprocess.run(["cansend", interface, f"{identifier:03X}#{data.hex()}"], check=True)


def canplayer(log: Path, interface: str, logged: str | None = None, *, as_recorded: bool = False) -> None:
    """Plays the log's frames of interface `logged` (default: the same) to `interface`, at once or at the recorded pace."""
    pace = [] if as_recorded else ["-t"]
    subprocess.run(["canplayer", "-I", log, *pace, f"{interface}={logged or interface}"], check=True)


def cangen_command(interface: str, gap_ms: float, *options: str) -> list[str]:
    """Command line of an endless cangen of eight-byte frames."""
    # cangen waits when the buffer is full, and the payload counts up, so that a run can be checked frame by frame
    return ["cangen", interface, "-g", str(gap_ms), "-p", "1000", "-L", "8", "-D", "i", *options]


def cangen(interface: str, count: int, identifier: int, gap_ms: float = 0.0) -> None:
    """Sends `count` frames of eight bytes whose payload counts up, little-endian; returns when they are sent."""
    subprocess.run(cangen_command(interface, gap_ms, "-I", f"{identifier:X}", "-n", str(count)), check=True)


@contextmanager
def cangen_flood(interface: str, identifier: int | None = None, gap_ms: float = 0.0) -> Iterator[None]:
    """Floods the interface during the block, with one identifier or with all of them in turn."""
    options = ["-I", "i" if identifier is None else f"{identifier:X}"]
    flood = subprocess.Popen(cangen_command(interface, gap_ms, *options), stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        flood.terminate()
        flood.wait()
