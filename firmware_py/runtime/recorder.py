"""The firmware's recorder: every frame to can.log, every internal signal to signals.mcap, after the tick.

Format, enough for a replay:

- `can.log`: one line a frame, as `candump -L -x` writes: `(0000000012.340000) can0 0E1#0011223344556677 R`. The time is
  that of the tick which took or sent it (never a wall clock), `canN` is the fleet's bus N, R is received, T sent. Lines
  stand in the order of the frames. canplayer and python-can read it.
- `signals.mcap`: protobuf messages, those of `tick_messages`; log_time is the tick's time. The attachment
  `configuration.json` is what the caller gave.

The same run writes the same bytes. The files are whole up to the last `flush`, whatever happens after.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import foxglove
from foxglove.mcap import MCAPWriteOptions

from firmware_py.core.types import WARNING, Event, Inputs, Outputs
from firmware_py.description.signals import Layout, TextLayout
from firmware_py.runtime.guarded_file import GuardedFile, QueuedFile
from firmware_py.runtime.rate_keeper import RateKeeper
from firmware_py.runtime.tick_messages import (
    EVENTS,
    REQUESTS,
    TICKS,
    TIMES,
    TIMES_SIGNALS,
    TickMessages,
    body_topic,
    bus_signals,
    bus_topic,
    times_values,
)

CAN_LOG = "can.log"
SIGNAL_LOG = "signals.mcap"
CONFIGURATION = "configuration.json"
TOGETHER = 10
"""Ticks whose lines and messages are made at once where time does not matter: by code that is then at hand and not out of the cache. In
real time each tick makes its own."""
LIVE_ONLY = ("/scene", "/tf")
"""What is drawn from other channels has no place in a log."""

_ID_TEXTS = tuple(f"{frame_id:03X}#" for frame_id in range(2048))


@lru_cache(maxsize=1)  # all frames of a tick have one
def candump_stamp(time_ns: int) -> str:
    """The time of a line."""
    seconds, rest = divmod(time_ns, 1_000_000_000)
    return f"({seconds:010d}.{rest // 1000:06d})"


def candump_lines(time_ns: int, bus: int, direction: str, frames: Iterable[tuple[int, bytes]]) -> str:
    """One line per frame (11-bit id, data), as `candump -L -x` writes them; direction R or T."""
    start, end = f"{candump_stamp(time_ns)} can{bus} ", f" {direction}\n"
    return "".join([start + _ID_TEXTS[frame_id] + data.hex().upper() + end for frame_id, data in frames])


class Recorder:
    """Writes both logs of one run into a folder. No call raises for a full disk: `flush` reports it once, as an Event.

    Call `sent` and `received` as frames go and come, `record` once a tick after the step, `flush` every half second once the tick's
    commands are out, `close` at the end.

    Attributes:
        ticks: recorded so far.
    """

    def __init__(
        self,
        folder: Path | None,
        configuration: Mapping[str, Any] | None = None,
        context: foxglove.Context | None = None,
        queued: bool = False,
    ) -> None:
        """Opens both files.

        Args:
            folder: where they go; None: nowhere, for signals that are only looked at live.
            configuration: attached to the signals.
            context: the channels' own; give one to serve them live too. Topics of LIVE_ONLY stay out of the file.
            queued: threads of their own write the files, so that a disk that stalls holds up no tick.
        """
        kind = QueuedFile if queued else GuardedFile
        self._can = kind(folder / CAN_LOG if folder is not None else Path(os.devnull))
        self._mcap = kind(folder / SIGNAL_LOG if folder is not None else Path(os.devnull))
        self._together = 1 if queued or context is not None else TOGETHER
        self._frames: list[tuple[int, int, str, Collection[tuple[int, bytes]]]] = []
        """What `candump_lines` is still to make lines of."""
        self._ticks: list[tuple[int, Inputs, Outputs]] = []
        """Of which messages are still to be made, each with the count of frames that it took."""
        self._lines: list[str] = []
        self._received = 0
        self.ticks = 0
        self._reported = False
        self._closed = False
        self._context = context if context is not None else foxglove.Context()
        options = MCAPWriteOptions(compression=None, disable_seeking=True, profile="")
        self._writer = foxglove.open_mcap(
            self._mcap,
            context=self._context,
            writer_options=options,
            channel_filter=lambda channel: channel.topic not in LIVE_ONLY,
        )
        if configuration is not None:
            data = json.dumps(configuration, sort_keys=True).encode()
            self._writer.attach(
                log_time=0, create_time=0, name=CONFIGURATION, media_type="application/json", data=data
            )
        self._messages = messages = TickMessages()
        self._times = Layout("Times", TIMES_SIGNALS)
        self._buses: dict[int, Layout] = {}
        self._channels: dict[str, foxglove.Channel] = {}
        for topic, layout in ((TICKS, messages.ticks), (REQUESTS, messages.requests), (EVENTS, messages.events)):
            self._channel(topic, layout)

    def _channel(self, topic: str, layout: Layout | TextLayout) -> foxglove.Channel:
        found = self._channels.get(topic)
        if found is None:
            schema = foxglove.Schema(name=layout.schema_name, encoding="protobuf", data=layout.schema)
            found = foxglove.Channel(topic, message_encoding="protobuf", schema=schema, context=self._context)
            self._channels[topic] = found
        return found

    def expect(self, body: int, thrusters: int) -> None:
        """Opens the channel of a body: 1.8 million instructions that the first tick then is spared."""
        self._channel(body_topic(body), self._messages.body(thrusters)[0])

    def expect_times(self) -> None:
        """Opens the channel of `record_times`."""
        self._channel(TIMES, self._times)

    def expect_bus(self, bus: int, kinds: Iterable[str]) -> None:
        """Opens the channel of `record_bus` for a bus whose port counts these kinds of faults."""
        self._buses[bus] = Layout("Bus", bus_signals(kinds))
        self._channel(bus_topic(bus), self._buses[bus])

    def sent(self, time_ns: int, bus: int, frames: Collection[tuple[int, bytes]]) -> None:
        """Frames (id, data) that the tick at `time_ns` put on bus number `bus`."""
        self._frames.append((time_ns, bus, "T", frames))

    def received(self, time_ns: int, bus: int, frames: Collection[tuple[int, bytes]]) -> None:
        """Frames (id, data) that the tick at `time_ns` took from bus number `bus`."""
        self._received += len(frames)
        self._frames.append((time_ns, bus, "R", frames))

    def record(self, inputs: Inputs, outputs: Outputs) -> None:
        """One tick: what it took and everything that it thought."""
        self._ticks.append((self._received, inputs, outputs))
        self._received = 0
        self.ticks += 1
        if self.ticks % self._together == 0:
            self._make()

    def _make(self) -> None:
        """Lines and messages of all that waits."""
        self._lines += [candump_lines(*each) for each in self._frames]
        self._frames.clear()
        for received, inputs, outputs in self._ticks:
            for topic, layout, data in self._messages.of(received, inputs, outputs):
                self._channel(topic, layout).base.log(data, outputs.time_ns)  # bytes, which `log` would first ask after
        self._ticks.clear()

    def record_times(self, tick: int, time_ns: int, keeper: RateKeeper) -> None:
        """How the ticks that are done kept their deadlines. Real time only: another run is never the same."""
        data = self._times.row().encode(times_values(tick, time_ns, keeper))
        self._channel(TIMES, self._times).log(data, log_time=time_ns)

    def record_bus(self, bus: int, tick: int, time_ns: int, faults: Mapping[str, int]) -> None:
        """What the port of a bus has counted so far, by kind, as `expect_bus` was told them. Real time only, as `record_times`."""
        data = self._buses[bus].row().encode((tick, time_ns, *faults.values()))
        self._channel(bus_topic(bus), self._buses[bus]).log(data, log_time=time_ns)

    def flush(self, to_disk: bool = False) -> list[Event]:
        """Hand everything so far to the operating system; a warning, once, where that fails.

        Args:
            to_disk: and have it write that, for a power cut: 10 ms and more, which in flight only a `queued` recorder may take.
        """
        self._make()
        self._can.write("".join(self._lines).encode())
        self._lines.clear()
        self._writer.flush()
        for file in (self._can, self._mcap) if to_disk else ():
            file.sync()
        return self._failure()

    def check(self) -> None:
        """For whoever needs the log: raises the OSError of a file that has failed."""
        for file in (self._can, self._mcap):
            if file.error is not None:
                raise file.error

    def _failure(self) -> list[Event]:
        """A warning where a file has failed, once."""
        failed = next((file for file in (self._can, self._mcap) if file.error is not None), None)
        if failed is None or self._reported:
            return []
        self._reported = True
        return [Event(WARNING, f"no more log: {failed.path.name}: {failed.error and failed.error.strerror}")]

    def close(self) -> list[Event]:
        """Flush and finish both files; a warning where that fails, or failed unsaid. A second time does nothing."""
        if self._closed:
            return []
        self._closed = True
        events = self.flush()
        self._writer.close()
        self._can.close()
        self._mcap.close()
        return events or self._failure()
