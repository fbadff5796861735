"""The firmware's recorder: writes every frame to can.log and every internal signal to signals.mcap, after the tick.

Format, sufficient for a replay:

- `can.log`: one line per frame, as `candump -L -x` writes: `(0000000012.340000) can0 0E1#0011223344556677 R`. The time is
  that of the tick which took or sent the frame (never a wall clock), `canN` is the fleet's bus N, R is received, T sent. Lines
  are in the order of the frames. canplayer and python-can read it.
- `signals.mcap`: the protobuf messages of `tick_messages`; log_time is the tick's time. The attachment
  `configuration.json` holds the configuration that the caller gave.

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
BATCH_TICKS = 10
"""Number of ticks that are encoded in one batch when not in real time, so that the encoding code stays in the processor's cache. In real
time each tick encodes its own lines and messages."""
LIVE_ONLY = ("/scene", "/tf")
"""Topics left out of the log, because they are drawn from other channels."""

_ID_TEXTS = tuple(f"{frame_id:03X}#" for frame_id in range(2048))


@lru_cache(maxsize=1)  # all frames of a tick share one stamp
def candump_stamp(time_ns: int) -> str:
    """The time stamp of a line of can.log."""
    seconds, rest = divmod(time_ns, 1_000_000_000)
    return f"({seconds:010d}.{rest // 1000:06d})"


def candump_lines(time_ns: int, bus: int, direction: str, frames: Iterable[tuple[int, bytes]]) -> str:
    """One line per frame (11-bit id, data), as `candump -L -x` writes it; direction R or T."""
    start, end = f"{candump_stamp(time_ns)} can{bus} ", f" {direction}\n"
    return "".join([start + _ID_TEXTS[frame_id] + data.hex().upper() + end for frame_id, data in frames])


class Recorder:
    """Writes both logs of one run into a folder. No call raises for a full disk: `flush` reports it once, as an Event.

    Call `sent` and `received` in the order of the frames, `record` once per tick after the step, `flush` every half second after the
    tick's commands are sent, `close` at the end.

    Attributes:
        ticks: number of ticks recorded so far.
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
            folder: for both files; None writes none, for signals that are only viewed live.
            configuration: attached to the signal log.
            context: of the channels; pass one to serve them live too. Topics of LIVE_ONLY stay out of the file.
            queued: each file is written by its own thread, so that a stalled disk blocks no tick.
        """
        kind = QueuedFile if queued else GuardedFile
        self._can = kind(folder / CAN_LOG if folder is not None else Path(os.devnull))
        self._mcap = kind(folder / SIGNAL_LOG if folder is not None else Path(os.devnull))
        self._batch_ticks = 1 if queued or context is not None else BATCH_TICKS
        self._frames: list[tuple[int, int, str, Collection[tuple[int, bytes]]]] = []
        """Arguments of `candump_lines` for frames whose lines are not made yet."""
        self._ticks: list[tuple[int, Inputs, Outputs]] = []
        """Ticks whose messages are not made yet: number of frames taken, inputs and outputs."""
        self._lines: list[str] = []
        self._received = 0
        self.ticks = 0
        self._reported = False
        self._closed = False
        self._context = context if context is not None else foxglove.Context()
        self._writer = self._open_writer(configuration) if folder is not None else None
        """Keeps an index of all that it writes, 40 MB a day and module: closed once nothing reaches the file any more."""
        self._messages = messages = TickMessages()
        self._times = Layout("Times", TIMES_SIGNALS)
        self._buses: dict[int, Layout] = {}
        self._channels: dict[str, foxglove.Channel] = {}
        for topic, layout in ((TICKS, messages.ticks), (REQUESTS, messages.requests), (EVENTS, messages.events)):
            self._channel(topic, layout)

    def _open_writer(self, configuration: Mapping[str, Any] | None) -> foxglove.MCAPWriter:
        writer = foxglove.open_mcap(
            self._mcap,
            context=self._context,
            writer_options=MCAPWriteOptions(compression=None, disable_seeking=True, profile=""),
            channel_filter=lambda channel: channel.topic not in LIVE_ONLY,
        )
        if configuration is not None:
            data = json.dumps(configuration, sort_keys=True).encode()
            writer.attach(log_time=0, create_time=0, name=CONFIGURATION, media_type="application/json", data=data)
        return writer

    def _close_writer(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()

    def _channel(self, topic: str, layout: Layout | TextLayout) -> foxglove.Channel:
        found = self._channels.get(topic)
        if found is None:
            schema = foxglove.Schema(name=layout.schema_name, encoding="protobuf", data=layout.schema)
            found = foxglove.Channel(topic, message_encoding="protobuf", schema=schema, context=self._context)
            self._channels[topic] = found
        return found

    def expect(self, body: int, thrusters: int) -> None:
        """Opens the channel of a body in advance, which saves the first tick 1.8 million instructions."""
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
        """Records one tick: its inputs and all its signals."""
        self._ticks.append((self._received, inputs, outputs))
        self._received = 0
        self.ticks += 1
        if self.ticks % self._batch_ticks == 0:
            self._make()

    def _make(self) -> None:
        """Makes the lines and messages of everything pending."""
        self._lines += [candump_lines(*each) for each in self._frames]
        self._frames.clear()
        for received, inputs, outputs in self._ticks:
            for topic, layout, data in self._messages.of(received, inputs, outputs):
                self._channel(topic, layout).base.log(data, outputs.time_ns)  # skips the type check of `log`: these are bytes
        self._ticks.clear()

    def record_times(self, tick: int, time_ns: int, keeper: RateKeeper) -> None:
        """Records how the ticks so far kept their deadlines. In real time only, because no two runs are the same."""
        data = self._times.row().encode(times_values(tick, time_ns, keeper))
        self._channel(TIMES, self._times).log(data, log_time=time_ns)

    def record_bus(self, bus: int, tick: int, time_ns: int, faults: Mapping[str, int]) -> None:
        """Records the fault counters of a bus's port, of the kinds given to `expect_bus`. In real time only, like `record_times`."""
        data = self._buses[bus].row().encode((tick, time_ns, *faults.values()))
        self._channel(bus_topic(bus), self._buses[bus]).log(data, log_time=time_ns)

    def flush(self, to_disk: bool = False) -> list[Event]:
        """Hands everything so far to the operating system; returns a warning, once, where that fails.

        Args:
            to_disk: also sync to the disk, against a power cut: takes 10 ms and more, so in flight only for a `queued` recorder.
        """
        self._make()
        self._can.write("".join(self._lines).encode())
        self._lines.clear()
        if self._mcap.error is not None:
            self._close_writer()
        elif self._writer is not None:
            self._writer.flush()
        for file in (self._can, self._mcap) if to_disk else ():
            file.sync()
        return self._failure()

    def give_up(self) -> None:
        """Ends both files before their flight, without a further warning, after a call has raised: what follows is missing in them."""
        for pending in (self._frames, self._ticks, self._lines):
            pending.clear()
        self._reported = True
        for file in (self._can, self._mcap):
            file.give_up()

    def check(self) -> None:
        """Raises the OSError of a file that has failed, for callers that need the log."""
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
        """Flushes and closes both files; returns a warning for any failure not reported yet. A second call does nothing."""
        if self._closed:
            return []
        self._closed = True
        events = self.flush()
        self._close_writer()
        self._can.close()
        self._mcap.close()
        return events or self._failure()
