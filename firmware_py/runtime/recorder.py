"""The firmware's recorder: every frame to can.log, every internal signal to signals.mcap, after the tick.

Format, enough for a replay:

- `can.log`: one line a frame, as `candump -L -x` writes: `(0000000012.340000) can0 0E1#0011223344556677 R`. The time is
  that of the tick which took or sent it (never a wall clock), `canN` is the fleet's bus N, R is received, T sent. Lines
  stand in the order of the frames. canplayer and python-can read it.
- `signals.mcap`: protobuf messages (`description.signals`); log_time is the tick's time.
  `/firmware/ticks`: per tick its number, its time, how many frames it took (the next so many R lines), drops so far.
  `/firmware/requests`: per request its tick and JSON `{"action", "body", "argument"}`; a trajectory gives its own
  `describe()`. `/firmware/bodyN`: per tick all of one body, `body_signals`. `/events`: severity (syslog) and text.
  The attachment `configuration.json` is what the caller gave.

The same run writes the same bytes. The files are whole up to the last `flush`, whatever happens after.
"""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
from foxglove.mcap import MCAPWriteOptions

from firmware_py.core.types import BodyRecord, Event, Inputs, Outputs, Request
from firmware_py.description.signals import Layout, Row, Signal, TextLayout

CAN_LOG = "can.log"
SIGNAL_LOG = "signals.mcap"
LIVE_ONLY = ("/scene", "/tf")
"""What is drawn from other channels has no place in a log."""
WARNING = 4
"""syslog severity of a log that failed."""

TICK_SIGNALS = (
    Signal("tick", kind="int"),
    Signal("time_ns", unit="ns", kind="int"),
    Signal("received_frames", kind="int"),
    Signal("dropped_frames", kind="int"),
    Signal("estop", kind="bool"),
)


def body_signals(thrusters: int) -> tuple[Signal, ...]:
    """Signals of one body with that many thrusters, in the order in which `_body_values` gives them."""
    return (
        Signal("tick", kind="int"),
        Signal("time_ns", unit="ns", kind="int"),
        Signal("state", kind="int"),
        Signal("mode", kind="int"),
        Signal("p_wb", 3, "m"),
        Signal("q_wb", 4),
        Signal("nu", 6, "m/s, rad/s"),
        Signal("force_w", 3, "N"),
        Signal("moment_b", 3, "N m"),
        Signal("sigma_p", 3, "m"),
        Signal("sigma_q", 3, "rad"),
        Signal("tag_age_ns", unit="ns", kind="int"),
        Signal("nis"),
        Signal("nis_dof", kind="int"),
        Signal("rejected", kind="int"),
        Signal("ready", kind="bool"),
        Signal("setpoint_p_wb", 3, "m"),
        Signal("setpoint_q_wb", 4),
        Signal("setpoint_v_w", 3, "m/s"),
        Signal("setpoint_w_b", 3, "rad/s"),
        Signal("setpoint_a_w", 3, "m/s^2"),
        Signal("setpoint_alpha_b", 3, "rad/s^2"),
        Signal("wrench_wanted", 6, "N, N m"),
        Signal("wrench_achieved", 6, "N, N m"),
        Signal("scale", 2),
        Signal("thrust_n", thrusters, "N"),
        Signal("commanded_n", thrusters, "N"),
    )


def _body_values(tick: int, time_ns: int, record: BodyRecord) -> tuple[Any, ...]:
    thrust = record.thrust
    return (
        tick,
        time_ns,
        record.state,
        record.mode,
        *record.estimate,
        *record.setpoint,
        record.wrench,
        thrust.achieved,
        thrust.scale,
        thrust.force_n,
        record.commanded_n,
    )


_ID_TEXTS = tuple(f"{frame_id:03X}#" for frame_id in range(2048))


def candump_lines(time_ns: int, bus: int, direction: str, frames: Iterable[tuple[int, bytes]]) -> str:
    """One line per frame (11-bit id, data), as `candump -L -x` writes them; direction R or T."""
    seconds, rest = divmod(time_ns, 1_000_000_000)
    start, end = f"({seconds:010d}.{rest // 1000:06d}) can{bus} ", f" {direction}\n"
    return "".join([start + _ID_TEXTS[frame_id] + data.hex().upper() + end for frame_id, data in frames])


def request_text(request: Request) -> str:
    """JSON of a request, for the log."""
    plain = {"action": request.action.name, "body": request.body, "argument": _plain(request.argument)}
    return json.dumps(plain, separators=(",", ":"))


def _plain(value: Any) -> Any:
    if hasattr(value, "describe"):
        return value.describe()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if hasattr(value, "_asdict"):
        return {name: _plain(each) for name, each in value._asdict().items()}
    return value if value is None or isinstance(value, int | float | str | bool) else type(value).__name__


class GuardedFile:
    """A file whose errors are kept instead of raised: after the first one it takes everything and writes nothing."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.error: OSError | None = None
        self._position = 0
        self._file = None
        try:
            self._file = path.open("wb", buffering=0)  # bytes given are with the system: kill -9 loses none
        except OSError as error:
            self.error = error

    def write(self, data: bytes | bytearray) -> int:
        """Append; always says that all was taken."""
        if self.error is None:
            try:
                self._append(data)
            except OSError as error:
                self.error = error
        self._position += len(data)
        return len(data)

    def _append(self, data: bytes | bytearray) -> None:
        view = memoryview(data)
        while view and self._file is not None:
            view = view[self._file.write(view) :]

    def seek(self, offset: int, whence: int = 0) -> int:
        """The position; the log is written forward only."""
        return self._position

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        """Close; a second time does nothing."""
        if self._file is not None:
            try:
                self._file.close()
            except OSError as error:
                self.error = self.error or error
            self._file = None


class Recorder:
    """Writes both logs of one run into a folder. No call raises for a full disk: `flush` reports it once, as an Event.

    Call `sent` and `received` as frames go and come, `record` once a tick after the step, `flush` every half second off
    the tick (from the same thread or another), `close` at the end.
    """

    def __init__(
        self,
        folder: Path | None,
        configuration: Mapping[str, Any] | None = None,
        context: foxglove.Context | None = None,
    ) -> None:
        """Opens both files.

        Args:
            folder: where they go; None: nowhere, for signals that are only looked at live.
            configuration: attached to the signals.
            context: the channels' own; give one to serve them live too. Topics of LIVE_ONLY stay out of the file.
        """
        self._can = GuardedFile(folder / CAN_LOG if folder is not None else Path(os.devnull))
        self._mcap = GuardedFile(folder / SIGNAL_LOG if folder is not None else Path(os.devnull))
        self._frames: deque[tuple[int, int, str, tuple[tuple[int, bytes], ...]]] = deque()
        self._received = 0
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
                log_time=0, create_time=0, name="configuration.json", media_type="application/json", data=data
            )
        ticks = Layout("Tick", TICK_SIGNALS)
        self._tick_row = ticks.row()
        self._ticks = self._channel("/firmware/ticks", ticks)
        self._request_layout = TextLayout("Request", ["tick"], "request")
        self._requests = self._channel("/firmware/requests", self._request_layout)
        self._event_layout = TextLayout("Event", ["tick", "severity"], "text")
        self._events = self._channel("/events", self._event_layout)
        self._bodies: dict[tuple[int, int], tuple[Row, foxglove.Channel]] = {}

    def _channel(self, topic: str, layout: Layout | TextLayout) -> foxglove.Channel:
        schema = foxglove.Schema(name=layout.schema_name, encoding="protobuf", data=layout.schema)
        return foxglove.Channel(topic, message_encoding="protobuf", schema=schema, context=self._context)

    def sent(self, time_ns: int, bus: int, frames: Iterable[tuple[int, bytes]]) -> None:
        """Frames (id, data) that the tick at `time_ns` put on bus number `bus`."""
        self._frames.append((time_ns, bus, "T", tuple(frames)))

    def received(self, time_ns: int, bus: int, frames: Iterable[tuple[int, bytes]]) -> None:
        """Frames (id, data) that the tick at `time_ns` took from bus number `bus`."""
        taken = tuple(frames)
        self._received += len(taken)
        self._frames.append((time_ns, bus, "R", taken))

    def record(self, inputs: Inputs, outputs: Outputs) -> None:
        """One tick: what it took and everything that it thought."""
        tick, time_ns = outputs.tick, outputs.time_ns
        values = (tick, time_ns, self._received, inputs.dropped_frames, inputs.estop)
        self._ticks.log(self._tick_row.encode(values), log_time=time_ns)
        self._received = 0
        for request in inputs.requests:
            self._requests.log(self._request_layout.encode(tick, request_text(request)), log_time=time_ns)
        for record in outputs.records:
            row, channel = self._body(record.body, len(record.commanded_n))
            channel.log(row.encode(_body_values(tick, time_ns, record)), log_time=time_ns)
        for event in outputs.events:
            self._events.log(self._event_layout.encode(tick, event.severity, event.text), log_time=time_ns)

    def _body(self, body: int, thrusters: int) -> tuple[Row, foxglove.Channel]:
        found = self._bodies.get((body, thrusters))
        if found is None:
            layout = Layout("Body", body_signals(thrusters))
            found = self._bodies[body, thrusters] = layout.row(), self._channel(f"/firmware/body{body}", layout)
        return found

    def flush(self) -> list[Event]:
        """Hand everything so far to the operating system; a warning, once, where that fails."""
        lines = []
        while self._frames:
            lines.append(candump_lines(*self._frames.popleft()))
        self._can.write("".join(lines).encode())
        self._writer.flush()
        failed = next((file for file in (self._can, self._mcap) if file.error is not None), None)
        if failed is None or self._reported:
            return []
        self._reported = True
        return [Event(WARNING, f"no more log: {failed.path.name}: {failed.error and failed.error.strerror}")]

    def close(self) -> list[Event]:
        """Flush and finish both files; a second time does nothing."""
        if self._closed:
            return []
        self._closed = True
        events = self.flush()
        self._writer.close()
        self._can.close()
        self._mcap.close()
        return events
