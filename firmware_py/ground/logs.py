"""Download of the last flights' logs by a ground station: LOG_REQUEST_LIST and LOG_REQUEST_DATA over the files of one folder."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from firmware_py.core.types import WARNING
from firmware_py.ground.system import Arrival, Handler, System

_PIECE = 90
_PIECES_AT_ONCE = 20
"""Pieces sent per round. They take 0.4 s on a radio of 57,600 Bd: the longest that an answer waits for them."""
_ENTRIES_AT_ONCE = 10
"""Entries of a list sent per round: half as many frames as pieces, since each requires a look at its file."""
_MOST_LOGS = 100
_MOST_BYTES = 2**32 - 1
"""Most of a log that the protocol can address, the size that it gives for a longer one: 12 hours of one module's
signals.mcap, at 100 Hz and 340 MB an hour (measured)."""
_SUFFIXES = (".mcap", ".log")


@dataclass(slots=True)
class _Transfer:
    arrival: Arrival
    number: int
    path: Path
    at: int
    left: int


@dataclass(slots=True)
class _Listing:
    arrival: Arrival
    last: int
    next: int | None = None
    """Number of the next entry; None before the folder has been read."""


class LogService:
    """The logs of one process, oldest first. They are sent only to channels that are not busy."""

    def __init__(self, system: System, folder: Path | None) -> None:
        self._system, self._folder = system, folder
        self._first = system.subject.identity.first_log
        self._transfers: dict[int, _Transfer] = {}
        """By channel."""
        self._listings: dict[int, _Listing] = {}
        """By channel."""
        self._files: dict[int, list[Path]] = {}
        """By channel, as last listed there: a list for another client changes no number under which this one fetches."""

    def handlers(self) -> dict[str, Handler]:
        """Handlers by message name."""
        return {
            "LOG_REQUEST_LIST": self._list,
            "LOG_REQUEST_DATA": self._data,
            "LOG_REQUEST_END": self._end,
            "LOG_ERASE": self._erase,
        }

    def step(self) -> None:
        """Sends the next entries of requested lists and the next pieces of requested logs."""
        for by_channel in (self._files, self._listings, self._transfers):
            for gone in by_channel.keys() - self._system.channels.keys():
                del by_channel[gone]
        busy = self._system.busy
        for listing in [listing for channel, listing in self._listings.items() if channel not in busy]:
            self._send_entries(listing)
        for transfer in [transfer for channel, transfer in self._transfers.items() if channel not in busy]:
            self._send_pieces(transfer)

    def _send_pieces(self, t: _Transfer) -> None:
        try:
            with t.path.open("rb") as file:
                file.seek(t.at)
                data = file.read(min(t.left, _PIECE * _PIECES_AT_ONCE, _MOST_BYTES - t.at))
        except OSError:
            data = b""
        for start in range(0, len(data), _PIECE):
            self._piece(t, data[start : start + _PIECE])
        if not data or t.left <= 0:
            if t.left > 0:
                self._piece(t, b"")  # an empty piece marks the end of the file
            del self._transfers[t.arrival.channel]

    def _piece(self, t: _Transfer, data: bytes) -> None:
        values = {"id": t.number, "ofs": t.at, "count": len(data), "data": tuple(data)}
        self._system.send(t.arrival.channel, "LOG_DATA", values)
        t.at += len(data)
        t.left -= len(data)

    def _list(self, arrival: Arrival) -> None:
        self._listings[arrival.channel] = _Listing(arrival, arrival.message["end"])

    def _send_entries(self, listing: _Listing) -> None:
        """Sends the next entries of a list. The folder is read once per list, not for each request of a flood."""
        arrival = listing.arrival
        if listing.next is None:
            self._files[arrival.channel] = self._find()
            listing.next = max(arrival.message["start"], self._first)
            if not self._files[arrival.channel]:
                self._system.send(arrival.channel, "LOG_ENTRY", {})
        files = self._files[arrival.channel]
        newest = self._first + len(files) - 1
        last, first, listing.next = min(listing.last, newest), listing.next, listing.next + _ENTRIES_AT_ONCE
        if listing.next > last:
            del self._listings[arrival.channel]
        for number in range(first, min(listing.next - 1, last) + 1):
            try:
                status = files[number - self._first].stat()
            except OSError:
                continue
            values = {
                "id": number, "num_logs": len(files), "last_log_num": newest,
                "time_utc": int(status.st_mtime), "size": status.st_size,
            }  # fmt: skip
            self._system.send(arrival.channel, "LOG_ENTRY", values)

    def _data(self, arrival: Arrival) -> None:
        number = arrival.message["id"]
        if not self._files.get(arrival.channel):
            self._files[arrival.channel] = self._find()
        files = self._files[arrival.channel]
        if number - self._first in range(len(files)):
            path = files[number - self._first]
            self._transfers[arrival.channel] = _Transfer(arrival, number, path, arrival.message["ofs"], arrival.message["count"])

    def _end(self, arrival: Arrival) -> None:
        self._transfers.pop(arrival.channel, None)

    def _erase(self, arrival: Arrival) -> None:
        self._system.say(WARNING, "logs are not erased from a ground station")

    def _find(self) -> list[Path]:
        if self._folder is None:
            return []
        found: list[Path] = []
        with suppress(OSError):  # of the folder itself
            for path in self._folder.rglob("*"):
                with suppress(OSError):  # a file that has just been deleted
                    if path.suffix in _SUFFIXES and path.is_file():
                        found.append(path)
        return sorted(found, key=self._place)[-_MOST_LOGS:]

    def _place(self, path: Path) -> tuple[int, tuple[str, ...]]:
        """Orders logs by run, then by name; not by time: both logs of this run are still written, and those of a failed disk dated back.

        The first run logs into the folder itself, each later one into a folder in it that is named by its number.
        """
        assert self._folder is not None
        parts = path.relative_to(self._folder).parts
        return int(parts[0]) if len(parts) > 1 and parts[0].isdecimal() else 0, parts
