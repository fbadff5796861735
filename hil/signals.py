"""The plant's own log, truth.mcap, and a flight read back: firmware's and plant's signals joined by tick.

The plant writes with another library than the firmware (mcap here, foxglove there): neither hides the other's faults.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
from mcap.writer import CompressionType, Writer

from firmware_py.description.signals import Columns, Layout, Signal, read_signals

TRUTH_LOG = "truth.mcap"
SIGNAL_LOG = "signals.mcap"
CHUNK_BYTES = 65536
"""About two seconds of one module at 100 Hz; a killed bench loses no more."""


def module_signals(thrusters: int) -> tuple[Signal, ...]:
    """Truth of one module in one tick, in the order of `TruthRecorder.record`."""
    return (
        Signal("tick", kind="int"),
        Signal("time_ns", unit="ns", kind="int"),
        Signal("p_wm", 3, "m"),
        Signal("q_wm", 4),
        Signal("v_w", 3, "m/s"),
        Signal("w_b", 3, "rad/s"),
        Signal("force_n", thrusters, "N"),
        Signal("water_w", 3, "m/s"),
    )


class TruthRecorder:
    """Writes /plant/moduleN, a message per tick and module. A context manager. Raises OSError when the disk is full."""

    def __init__(self, folder: Path, thrusters: tuple[int, ...]) -> None:
        """`thrusters` has the number of thrusters of each module of the fleet, in its order."""
        self._file = (folder / TRUTH_LOG).open("wb")
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="", library="modcube")
        self._sequence = 0
        self._modules = []
        for module, count in enumerate(thrusters):
            layout = Layout("Module", module_signals(count))
            schema = self._writer.register_schema(layout.schema_name, "protobuf", layout.schema)
            channel = self._writer.register_channel(f"/plant/module{module}", "protobuf", schema)
            self._modules.append((channel, layout.row()))

    def record(
        self,
        tick: int,
        time_ns: int,
        module: int,
        p_wm: np.ndarray,
        q_wm: np.ndarray,
        v_w: np.ndarray,
        w_b: np.ndarray,
        force_n: np.ndarray,
        water_w: np.ndarray,
    ) -> None:
        """Truth of `module` at the moment of SYNC `tick`.

        Args:
            p_wm, q_wm: (3,) m and (4,) module frame (hull centre) in the world.
            v_w: (3,) velocity of the module's origin, world, m/s. w_b: (3,) angular rate, module frame, rad/s.
            force_n: (n,) force that each thruster gives, N. water_w: (3,) velocity of the undisturbed water there, m/s.
        """
        channel, row = self._modules[module]
        data = row.encode((tick, time_ns, p_wm, q_wm, v_w, w_b, force_n, water_w))
        self._sequence += 1
        self._writer.add_message(channel, log_time=time_ns, data=data, publish_time=time_ns, sequence=self._sequence)

    def close(self) -> None:
        """Finish the file; a second time does nothing."""
        if not self._file.closed:
            self._writer.finish()
            self._file.close()

    def __enter__(self) -> TruthRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class Flight:
    """One body over the ticks that both logs hold, row by row; `unmatched` ticks of the firmware have no truth."""

    firmware: Columns
    truth: Columns
    events: Columns
    ticks: Columns
    unmatched: int

    @property
    def time_s(self) -> np.ndarray:
        """(k,) firmware time since the first joined tick, s."""
        time_ns = self.firmware["time_ns"]
        return (time_ns - time_ns[0]) / 1e9

    def between(self, start_ns: int, end_ns: int) -> Flight:
        """The ticks with start <= time <= end."""
        time_ns = self.firmware["time_ns"]
        keep = (time_ns >= start_ns) & (time_ns <= end_ns)
        pick = {name: column[keep] for name, column in self.firmware.items()}
        truth = {name: column[keep] for name, column in self.truth.items()}
        return Flight(pick, truth, self.events, self.ticks, self.unmatched)


def read_flight(folder: Path, body: int = 0, module: int = 0) -> Flight:
    """The flight whose logs are in `folder`.

    Raises:
        OSError: a log is missing. ValueError: a log holds nothing of this body or module, or they share no tick.
    """
    signals, truths = read_signals(folder / SIGNAL_LOG), read_signals(folder / TRUTH_LOG)
    firmware, truth = signals.get(f"/firmware/body{body}"), truths.get(f"/plant/module{module}")
    if firmware is None or truth is None:
        raise ValueError(f"{folder}: no signals of body {body} or no truth of module {module} in the logs")
    _, mine, theirs = np.intersect1d(firmware["tick"], truth["tick"], return_indices=True)
    if not len(mine):
        raise ValueError(f"{folder}: the two logs share no tick")
    nothing: Columns = {"tick": np.zeros(0, np.int64), "severity": np.zeros(0, np.int64), "text": np.zeros(0, str)}
    return Flight(
        {name: column[mine] for name, column in firmware.items()},
        {name: column[theirs] for name, column in truth.items()},
        signals.get("/events", nothing),
        signals.get("/firmware/ticks", {}),
        len(firmware["tick"]) - len(mine),
    )
