"""The plant's own log, truth.mcap: where everything really is, tick by tick.

The plant uses a different library than the firmware (mcap here, foxglove there), so that neither hides the other's faults.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from firmware_py.description.signals import Layout, Row, Signal

if TYPE_CHECKING:
    from hil.plant.world import BodyTruth, Truth, World

TRUTH_LOG = "truth.mcap"
WRITER = "modcube"
"""Name of the writer in the header of the truth log."""
HEADER_BYTES = 64
"""Upper bound on the size of magic and header."""
CHUNK_BYTES = 65536
"""About two seconds of one module at 100 Hz. A killed bench loses at most one chunk and the waiting messages."""
BATCH_MESSAGES = 20
"""Messages that are encoded and written as one batch, ten ticks of one module, so that the code for it stays in the cache."""


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
        Signal("power_w", 1, "W"),
    )


def body_signals(modules: int) -> tuple[Signal, ...]:
    """Truth of one body in one tick, in the order of `TruthRecorder.record_body`."""
    return (
        Signal("tick", kind="int"),
        Signal("time_ns", unit="ns", kind="int"),
        Signal("member", modules),
        Signal("p_wb", 3, "m"),
        Signal("q_wb", 4),
        Signal("v_w", 3, "m/s"),
        Signal("w_b", 3, "rad/s"),
        Signal("load", 6, "N, N m"),
    )


def dock_signals(modules: int) -> tuple[Signal, ...]:
    """Truth of all docking faces in one tick, in the order of `TruthRecorder.record_world`."""
    return (
        Signal("tick", kind="int"),
        Signal("time_ns", unit="ns", kind="int"),
        Signal("joints", kind="int"),
        Signal("contacts", kind="int"),
        Signal("jams", kind="int"),
        Signal("gap_m", unit="m"),
        Signal("lateral_m", unit="m"),
        Signal("current_ma", 6 * modules, "mA"),
    )


def is_truth_log(path: Path) -> bool:
    """Whether a TruthRecorder wrote `path`. Reads only the header, so a torn log counts too."""
    try:
        with path.open("rb") as file:
            begin = file.read(HEADER_BYTES)
    except OSError:
        return False
    return begin.startswith(MCAP0_MAGIC) and WRITER.encode() in begin


class TruthRecorder:
    """Writes /plant/moduleN and /plant/bodyN (N: its leader), a message per tick and module or body, and /plant/docks for a fleet of
    several modules. A context manager. Raises OSError when the disk is full.
    """

    def __init__(self, folder: Path, thrusters: tuple[int, ...]) -> None:
        """`thrusters` is the number of thrusters of each module, in fleet order."""
        self._file = (folder / TRUTH_LOG).open("wb")
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="", library=WRITER)
        self._file.flush()  # marks the folder as a flight's, even if the process is killed
        self._sequence = 0
        self._waiting: list[tuple[int, int, Row, tuple[Any, ...]]] = []
        """Messages not yet encoded: channel, time, row encoder, values."""
        self._modules = []
        for module, count in enumerate(thrusters):
            self._modules.append(self._opened(f"/plant/module{module}", Layout("Module", module_signals(count))))
        self._body_layout = Layout("Body", body_signals(len(thrusters)))
        self._body_schema = self._writer.register_schema(
            self._body_layout.schema_name, "protobuf", self._body_layout.schema
        )
        self._bodies: dict[int, Any] = {}
        self._docks: Any = None
        if len(thrusters) > 1:
            self._docks = self._opened("/plant/docks", Layout("Docks", dock_signals(len(thrusters))))

    def _opened(self, topic: str, layout: Layout) -> tuple[int, Row]:
        """A new channel and the row that encodes its messages."""
        schema = self._writer.register_schema(layout.schema_name, "protobuf", layout.schema)
        return self._writer.register_channel(topic, "protobuf", schema), layout.row()

    def record_world(self, tick: int, world: World) -> None:
        """Records the truth of all modules, bodies and docks at the moment of SYNC `tick`."""
        for module in range(len(world.vehicles)):
            self.record(tick, module, world.truth(module))
        for body in range(len(world.bodies)):
            self.record_body(tick, world.body_truth(body), world.load(body))
        if self._docks is not None:
            docks, (channel, row) = world.docks, self._docks
            jams = sum(contact.jammed for contact in docks.contacts)
            counts = (len(docks.joints), len(docks.contacts), jams)
            values = (tick, world.time_ns, *counts, docks.gap_m, docks.lateral_m, docks.current_ma().ravel())
            self._add(channel, world.time_ns, row, values)

    def record(self, tick: int, module: int, truth: Truth) -> None:
        """Records the truth of `module` at the moment of SYNC `tick`. Power is the supply's total, including electronics and magnets."""
        channel, row = self._modules[module]
        t, power_w = truth, truth.voltage_v * truth.current_a
        self._add(channel, t.time_ns, row, (tick, t.time_ns, t.p_wm, t.q_wm, t.v_w, t.w_b, t.force_n, t.current_w, power_w))

    def record_body(self, tick: int, truth: BodyTruth, load: np.ndarray) -> None:
        """Records the truth of a body at the moment of SYNC `tick`, in the channel with the number of its leader.

        Args:
            load: (6,) reading of an ideal load cell that clamps the body, about its leader's hull centre, body frame, N and N m.
        """
        leader, b = truth.modules[0], truth
        if leader not in self._bodies:
            channel = self._writer.register_channel(f"/plant/body{leader}", "protobuf", self._body_schema)
            self._bodies[leader] = (channel, self._body_layout.row())
        channel, row = self._bodies[leader]
        member = [float(module in b.modules) for module in range(len(self._modules))]
        self._add(channel, b.time_ns, row, (tick, b.time_ns, member, b.p_wb, b.q_wb, b.v_w, b.w_b, load))

    def _add(self, channel: int, time_ns: int, row: Row, values: tuple[Any, ...]) -> None:
        self._waiting.append((channel, time_ns, row, values))
        if len(self._waiting) >= BATCH_MESSAGES:
            self._write()

    def _write(self) -> None:
        for channel, time_ns, row, values in self._waiting:
            self._sequence += 1
            data = row.encode(values)
            self._writer.add_message(channel, log_time=time_ns, data=data, publish_time=time_ns, sequence=self._sequence)
        self._waiting.clear()

    def close(self) -> None:
        """Finishes the file. Calling it again does nothing."""
        if not self._file.closed:
            self._write()
            self._writer.finish()
            self._file.close()

    def __enter__(self) -> TruthRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
