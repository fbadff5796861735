"""Reads a recorded flight tick by tick: inputs, frames sent and signals of each tick. Reads a torn or damaged log up to the damage."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import groupby, islice
from pathlib import Path
from typing import Any, NamedTuple

from google.protobuf.message import DecodeError

from firmware_py.description.schema import SHOWN_CHARACTERS, DescriptionError
from firmware_py.description.signals import MCAP_MAGIC, Layout, LogMessage, TextLayout, is_closed, read_attachment, read_messages
from firmware_py.runtime.log_damage import damaged_at, is_stamp
from firmware_py.runtime.recorder import CAN_LOG, CONFIGURATION, SIGNAL_LOG, candump_stamp
from firmware_py.runtime.tick_messages import REQUESTS, TICK_SIGNALS, TICKS, is_of_the_machine

HIGHEST_ID, LONGEST_DATA = 0x1FFF_FFFF, 64
"""Limits of any frame: an id of 29 bits, and the data bytes of CAN FD."""


class LogError(DescriptionError):
    """A log cannot be read; the text is one line."""


class LoggedFrame(NamedTuple):
    """One frame that was received or sent."""

    bus: int
    id: int
    data: bytes


def shown(text: str) -> str:
    """A piece of a log for use in a message: quoted, in printable characters, cut to SHOWN_CHARACTERS."""
    quoted = ascii(text.strip())
    return quoted if len(quoted) <= SHOWN_CHARACTERS else f"{quoted[: SHOWN_CHARACTERS - 3]}..."


def parts_of(line: str) -> tuple[str, int, bytes]:
    """Channel, id and data of a line of can.log. Raises ValueError where it is not of that form."""
    _, channel, frame, _ = line.split(" ")
    number, _, data = frame.partition("#")
    return channel, int(number, 16), bytes.fromhex(data)


def frame_of(line: str) -> LoggedFrame:
    """The frame of a line of can.log. Raises ValueError where it holds none that a bus could carry."""
    channel, number, data = parts_of(line)
    logged = LoggedFrame(int(channel[3:]), number, data)
    if logged.bus < 0 or not 0 <= logged.id <= HIGHEST_ID or len(logged.data) > LONGEST_DATA:
        raise ValueError(f"{line.strip()} is no frame of a bus")
    return logged


@dataclass(slots=True)
class LoggedTick:
    """One tick as recorded in the log."""

    tick: int
    time_ns: int
    taken: int
    """Number of frames that the tick took."""
    prepared: int
    """Number of worker results that the tick took."""
    messages: list[tuple[str, bytes]] = field(default_factory=list)
    """Topic and data of each signal message of the tick, in order."""
    requests: list[str] = field(default_factory=list)
    """Requests, as `request_text` wrote them."""
    received: list[LoggedFrame] = field(default_factory=list)
    sent: list[str] = field(default_factory=list)
    """Lines of can.log."""


class FlightLog:
    """The log in one folder.

    Attributes:
        configuration: from which the firmware was built; None where the log holds none.
        torn: describes where the log ends too early or is damaged; empty for a whole log. Complete once `ticks` is exhausted.
        is_damaged: whether more data follows the place at which reading stopped, which a log that only ends too early lacks; likewise.
    """

    def __init__(self, folder: Path) -> None:
        """Raises LogError when there is no log, and OSError when it cannot be read."""
        self.folder = folder
        if folder.is_file():
            here = f", here {folder.parent}" if (folder.parent / CAN_LOG).is_file() else ", with can.log and signals.mcap"
            raise LogError(f"{folder}: is a file; give the folder that a run left{here}")
        for name in (CAN_LOG, SIGNAL_LOG):
            if not (folder / name).is_file():
                raise LogError(f"{folder}: no {name} there; give the folder that a run left")
        _check_mcap(folder / SIGNAL_LOG)
        text = read_attachment(folder / SIGNAL_LOG, CONFIGURATION)
        self.configuration: dict[str, Any] | None = self._configuration(text) if text is not None else None
        self.torn = "" if is_closed(folder / SIGNAL_LOG) else f"{SIGNAL_LOG} was not closed"
        self.is_damaged = False

    def _configuration(self, text: bytes) -> dict[str, Any]:
        try:
            configuration = json.loads(text)
        except ValueError as error:
            raise LogError(f"{self.folder}: {CONFIGURATION} in {SIGNAL_LOG} is no JSON: {error}") from None
        if not isinstance(configuration, dict):
            raise LogError(f"{self.folder}: {CONFIGURATION} in {SIGNAL_LOG} is no table")
        return configuration

    def ticks(self) -> Iterator[LoggedTick]:
        """Every tick that both files hold whole, in order, up to any damage in can.log. Raises LogError if its first tick is damaged.

        The last tick before the damage, or of a can.log that ends too early, is left out, because frames that it sent may be missing.
        """
        groups, ticks = self._frames(), self._signal_ticks()
        held: LoggedTick | None = None
        first = 1
        for logged in ticks:
            group = next(groups, None)
            if group is None:
                self._tear(f"{CAN_LOG} ends {'before' if held is None else 'with'} tick {(held or logged).tick}")
                return
            try:
                is_whole = self._take_lines(group, logged, groups)
            except LogError as damage:
                if held is None:
                    raise
                not_closed = f"{self.torn}; " if self.torn else ""
                self.torn = f"{not_closed}{self._damaged_from(held, first, damage)}"
                self.is_damaged = any(is_stamp(behind.stamp) for behind in groups)
                return
            if held is not None:
                yield held
            if not is_whole:
                self._tear(f"{CAN_LOG} ends with tick {logged.tick}")
                return
            held, first = logged, group.first
        goes_on = next(groups, None) is not None
        if held is not None and (goes_on or not self.torn):
            yield held
        if goes_on:
            self._tear_signals()

    def _tear_signals(self) -> None:
        """Describes a signal log that ends, or is damaged, before can.log ends."""
        if (at := damaged_at(self.folder / SIGNAL_LOG)) is None:
            self._tear(f"{SIGNAL_LOG} ends before {CAN_LOG}")
            return
        self.is_damaged = True
        self.torn = f"{f'{self.torn}; ' if self.torn else ''}{SIGNAL_LOG} is damaged at byte {at}"

    def _tear(self, where: str) -> None:
        self.torn = self.torn or where

    def _damaged_from(self, tick: LoggedTick, first: int, damage: LogError) -> str:
        """Describes the damage after `tick`, whose lines start at line number `first`: from where on can.log is not trusted, and why."""
        with (self.folder / CAN_LOG).open("rb") as file:
            at = sum(map(len, islice(file, first - 1)))
        what = str(damage).removeprefix(f"{self.folder}/")
        return f"{CAN_LOG} is damaged from tick {tick.tick} on, time {candump_stamp(tick.time_ns)}, byte {at} ({what})"

    def _signal_ticks(self) -> Iterator[LoggedTick]:
        """The ticks of the signal log, without their frames."""
        now: LoggedTick | None = None
        for message in read_messages(self.folder / SIGNAL_LOG):
            if message.topic == TICKS:
                if now is not None:
                    yield now
                tick, time_ns, taken, *_, prepared = self._values(message)
                now = LoggedTick(int(tick), int(time_ns), int(taken), int(prepared))
            if now is None or is_of_the_machine(message.topic):
                continue
            now.messages.append((message.topic, message.data))
            if message.topic == REQUESTS:
                now.requests.append(self._values(message)[1])
        if now is not None:
            yield now

    def _values(self, message: LogMessage) -> tuple[Any, ...]:
        """Decoded values of a message of a tick or a request. Raises LogError."""
        try:
            return (_TICK if message.topic == TICKS else _REQUEST).values(message.data)
        except (ValueError, IndexError, DecodeError):
            what = f"a message of {message.topic} that this version does not write"
            raise LogError(f"{self.folder}: {SIGNAL_LOG} has {what}; it is spoilt or another version's") from None

    def _frames(self) -> Iterator[_Group]:
        """The lines of can.log grouped by tick; a partial line at the end is left out."""
        with (self.folder / CAN_LOG).open(encoding="ascii", errors="replace") as file:
            before: _Group | None = None
            first = 1
            for stamp, lines in groupby((line for line in file if line.endswith("\n")), key=_stamp):
                if before is not None:
                    yield before
                    first += len(before.lines)
                before = _Group(stamp, list(lines), False, first)
            if before is not None:
                yield before._replace(is_last=True)

    def _take_lines(self, group: _Group, logged: LoggedTick, groups: Iterator[_Group]) -> bool:
        """Sorts the frames of one tick into `logged`; False where frames are missing at the end of the file. Raises LogError on damage."""
        if group.stamp != candump_stamp(logged.time_ns):
            here = f"{self.folder / CAN_LOG}:{group.first}"
            raise LogError(f"{here}: frames of {shown(group.stamp)} where {SIGNAL_LOG} has tick {logged.tick}")
        self._sort_lines(group, logged)
        came = len(logged.received)
        if came != logged.taken and not group.is_last:
            after = next(groups)
            here = f"{self.folder / CAN_LOG}:{after.first}"
            raise LogError(f"{here}: {shown(after.lines[0])} after {came} frames for tick {logged.tick}, which took {logged.taken}")
        return came == logged.taken

    def _sort_lines(self, group: _Group, logged: LoggedTick) -> None:
        """Sorts the frames of one tick into received and sent ones. Raises LogError."""
        for number, line in enumerate(group.lines, group.first):
            if line.endswith(" T\n"):
                logged.sent.append(line)
                continue
            try:
                logged.received.append(frame_of(line))
            except ValueError:
                what = f"{shown(line)} is no frame as `candump -L -x` writes it"
                raise LogError(f"{self.folder / CAN_LOG}:{number}: {what}") from None


class _Group(NamedTuple):
    """Consecutive lines of can.log with the same stamp."""

    stamp: str
    lines: list[str]
    is_last: bool
    first: int
    """Line number of the first of them in the file, from 1."""


_TICK = Layout("Tick", TICK_SIGNALS)
_REQUEST = TextLayout("Request", ["tick"], "request")


def _stamp(line: str) -> str:
    return line.partition(" ")[0]


def _check_mcap(path: Path) -> None:
    """Raises LogError where a file does not begin with the magic of MCAP, which a torn log has too."""
    with path.open("rb") as file:
        begins = file.read(len(MCAP_MAGIC))
    if begins != MCAP_MAGIC:
        raise LogError(f"{path}: {'is no MCAP log' if begins else 'is empty'}, so nothing can be read of the flight")
