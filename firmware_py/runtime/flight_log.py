"""A recorded flight read back tick by tick: what each tick took, sent and thought. Reads a torn log up to the tear."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from firmware_py.description.schema import DescriptionError
from firmware_py.description.signals import Layout, TextLayout, is_closed, read_attachment, read_messages
from firmware_py.runtime.recorder import CAN_LOG, CONFIGURATION, SIGNAL_LOG, candump_stamp
from firmware_py.runtime.tick_messages import REQUESTS, TICK_SIGNALS, TICKS, TIMES


class LogError(DescriptionError):
    """A log cannot be read; one line."""


class LoggedFrame(NamedTuple):
    """One frame that came."""

    bus: int
    id: int
    data: bytes


@dataclass(slots=True)
class LoggedTick:
    """One tick as the log has it."""

    tick: int
    time_ns: int
    prepared: int
    """Results of the worker that it took."""
    messages: list[tuple[str, bytes]] = field(default_factory=list)
    """Topic and message of everything that it thought, in order."""
    requests: list[str] = field(default_factory=list)
    """As `request_text` wrote them."""
    received: list[LoggedFrame] = field(default_factory=list)
    sent: list[str] = field(default_factory=list)
    """Lines of can.log."""


class FlightLog:
    """The log in one folder.

    Attributes:
        configuration: what the firmware was made of; None where the log holds none.
        torn: where the log ends too early, in words; empty for a whole one. Known once `ticks` has come to its end.
    """

    def __init__(self, folder: Path) -> None:
        """Raises LogError when there is no log, and OSError when it cannot be read."""
        self.folder = folder
        for name in (CAN_LOG, SIGNAL_LOG):
            if not (folder / name).is_file():
                raise LogError(f"{folder}: no {name} there; give the folder that a run left")
        text = read_attachment(folder / SIGNAL_LOG, CONFIGURATION)
        self.configuration: dict[str, Any] | None = json.loads(text) if text is not None else None
        self.torn = "" if is_closed(folder / SIGNAL_LOG) else f"{SIGNAL_LOG} was not closed"

    def ticks(self) -> Iterator[LoggedTick]:
        """Every tick that both files hold whole, in order. Raises LogError where they do not belong together.

        The last tick of a can.log that ends too early is left out: frames that it sent may be missing.
        """
        groups, thoughts = self._frames(), self._thoughts()
        for logged in thoughts:
            group = next(groups, None)
            if group is None:
                self.torn = self.torn or f"{CAN_LOG} ends before tick {logged.tick}"
                return
            if group.stamp != candump_stamp(logged.time_ns):
                raise LogError(f"{self.folder}: {CAN_LOG} has frames of {group.stamp} where {SIGNAL_LOG} has tick {logged.tick}")
            _sort_lines(group.lines, logged)
            wanted, came = _received_frames(logged), len(logged.received)
            if group.is_last and (self.torn or came != wanted or next(thoughts, None) is not None):
                self.torn = self.torn or f"{CAN_LOG} ends with tick {logged.tick}"
                return
            if came != wanted:
                raise LogError(f"{self.folder}: {CAN_LOG} has {came} frames for tick {logged.tick}, which took {wanted}")
            yield logged
        if next(groups, None) is not None:
            self.torn = self.torn or f"{SIGNAL_LOG} ends before {CAN_LOG}"

    def _thoughts(self) -> Iterator[LoggedTick]:
        """The ticks of the signal log, without their frames."""
        now: LoggedTick | None = None
        for message in read_messages(self.folder / SIGNAL_LOG):
            if message.topic == TICKS:
                if now is not None:
                    yield now
                tick, time_ns, *_, prepared = _TICK.values(message.data)
                now = LoggedTick(int(tick), int(time_ns), int(prepared))
            if now is None or message.topic == TIMES:
                continue
            now.messages.append((message.topic, message.data))
            if message.topic == REQUESTS:
                now.requests.append(_REQUEST.values(message.data)[1])
        if now is not None:
            yield now

    def _frames(self) -> Iterator[_Group]:
        """The lines of can.log tick by tick; half a line at the end is left out."""
        with (self.folder / CAN_LOG).open(encoding="ascii", errors="replace") as file:
            before: _Group | None = None
            for stamp, lines in groupby((line for line in file if line.endswith("\n")), key=_stamp):
                if before is not None:
                    yield before
                before = _Group(stamp, list(lines), False)
            if before is not None:
                yield before._replace(is_last=True)


class _Group(NamedTuple):
    """The lines of can.log with one stamp."""

    stamp: str
    lines: list[str]
    is_last: bool


_TICK = Layout("Tick", TICK_SIGNALS)
_REQUEST = TextLayout("Request", ["tick"], "request")


def _received_frames(logged: LoggedTick) -> int:
    return int(_TICK.values(logged.messages[0][1])[2])


def _stamp(line: str) -> str:
    return line.partition(" ")[0]


def _sort_lines(lines: list[str], logged: LoggedTick) -> None:
    """Puts the frames of one tick where they belong. Raises LogError."""
    for line in lines:
        if line.endswith(" T\n"):
            logged.sent.append(line)
            continue
        try:
            _, channel, frame, _ = line.split(" ")
            number, _, data = frame.partition("#")
            logged.received.append(LoggedFrame(int(channel[3:]), int(number, 16), bytes.fromhex(data)))
        except ValueError:
            raise LogError(f"{CAN_LOG}: {line.strip()!r} is no frame as `candump -L -x` writes it") from None
