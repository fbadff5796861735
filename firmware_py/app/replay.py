"""`modcube replay`: feeds the recorded inputs of a flight to the same code; every signal and every frame must come out the same.

With the same machine and the same lock file the bytes are equal. Logs of another machine are compared with a tolerance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_py.app.configuration import firmware_of
from firmware_py.app.firmware import BusFrame
from firmware_py.app.log_comparison import Comparison, Difference
from firmware_py.app.mission_plan import Consecutive
from firmware_py.bus.codec import Codec, Frame
from firmware_py.prepare.paths import Harmonic, Hold
from firmware_py.prepare.piecewise import Piecewise
from firmware_py.runtime.flight_log import FlightLog, LogError, LoggedTick
from firmware_py.runtime.log_damage import ticks_held
from firmware_py.runtime.recorder import candump_lines
from firmware_py.runtime.request_text import CORE_TYPES, read_request
from firmware_py.runtime.tick_messages import TickMessages
from firmware_py.runtime.worker import InlineWorker

TYPES = {**CORE_TYPES, **{cls.__name__: cls for cls in (Consecutive, Harmonic, Hold, Piecewise)}}
"""Types that a recorded request may hold: the trajectories, and core's own types."""


@dataclass(slots=True)
class Outcome:
    """Result of a replay."""

    ticks: int = 0
    seconds: float = 0.0
    """Length of the replayed flight, on the vehicle's clock."""
    first: Difference | None = None
    torn: str = ""
    """Where the log ends too early or is damaged; empty when it is whole."""
    is_damaged: bool = False
    """Whether the log goes on behind that place."""
    held: int = 0
    """Number of ticks of which a torn or damaged log holds anything; as `ticks` for a whole one."""


class DueWorker(InlineWorker):
    """Runs each job inline and hands over its result in the tick in which the recorded flight received it."""

    due = 0
    """Number of results that this tick still takes."""

    def _finished(self) -> list[Any]:
        if self.due == 0:
            return []
        self.due -= 1
        return super()._finished()


class Replay:
    """The firmware of one log, fed with its recorded inputs."""

    def __init__(self, log: FlightLog, tolerance: float = 0.0) -> None:
        """Raises LogError where the log holds no configuration, and DescriptionError where the configuration is invalid."""
        if log.configuration is None:
            raise LogError(f"{log.folder}: its log does not say what flew; this version's logs do")
        self._log, self._configuration = log, log.configuration
        self._comparison = Comparison(Codec.load(), tolerance, bool(log.configuration.get("thinned", False)))
        self._messages = TickMessages()
        self._start()

    def _start(self) -> None:
        """Starts with a new firmware, as a new process does."""
        self._worker = DueWorker()
        self._firmware = firmware_of(self._configuration, str(self._log.folder), self._worker)

    def run(self) -> Outcome:
        """Replays up to the first difference or the end of the log. At a gap in the ticks a process was killed and a new one took over."""
        outcome, before, start_ns = Outcome(), None, 0
        for logged in self._log.ticks():
            if before is None:
                start_ns = logged.time_ns
            elif logged.tick != before + 1:
                self._start()
            before = logged.tick
            outcome.first = self.step(logged)
            outcome.ticks, outcome.seconds = outcome.ticks + 1, (logged.time_ns - start_ns) * 1e-9
            if outcome.first is not None:
                break
        outcome.torn, outcome.is_damaged = self._log.torn, self._log.is_damaged
        outcome.held = max(outcome.ticks, ticks_held(self._log.folder)) if outcome.torn else outcome.ticks
        return outcome

    def step(self, logged: LoggedTick) -> Difference | None:
        """Replays one tick; returns its first difference."""
        tick, time_ns = logged.tick, logged.time_ns
        self._worker.due = logged.prepared
        sync = self._firmware.sync(tick, time_ns)
        received = [(bus, Frame(number, data)) for bus, number, data in logged.received]
        try:
            requests = [read_request(text, TYPES) for text in logged.requests]
        except (ValueError, KeyError, TypeError) as error:
            raise LogError(f"{self._log.folder}: request of tick {tick}: {error}") from None
        inputs, outputs, frames = self._firmware.step(tick, time_ns, received, requests)
        messages = list(self._messages.of(len(received), inputs, outputs))
        return self._comparison.first(logged, messages, sent_lines(time_ns, sync + frames))


def sent_lines(time_ns: int, frames: Sequence[BusFrame]) -> list[str]:
    """The lines of can.log for the frames that one tick sent, bus by bus."""
    buses = sorted({bus for bus, _ in frames})
    return [line for bus in buses for line in candump_lines(time_ns, bus, "T", [f for b, f in frames if b == bus]).splitlines(True)]


def replay(folder: Path, tolerance: float = 0.0) -> Outcome:
    """Replays the log in `folder`. Raises LogError, DescriptionError and OSError."""
    return Replay(FlightLog(folder), tolerance).run()
