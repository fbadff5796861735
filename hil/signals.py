"""The plant's own log, truth.mcap, and a flight read back: firmware's and plant's signals joined by tick.

The plant writes with another library than the firmware (mcap here, foxglove there): neither hides the other's faults.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from scipy.spatial.transform import Rotation

from firmware_py.description.signals import Columns, Layout, Signal, read_signals

if TYPE_CHECKING:
    from hil.plant.world import World

TRUTH_LOG = "truth.mcap"
WRITER = "modcube"
"""Who wrote it, in the header of the truth's log."""
HEADER_BYTES = 64
"""More than magic and header take."""
SIGNAL_LOG = "signals.mcap"
REGULAR_TICKS = 50
"""Ticks at the start of a log that its period is read from."""
NO_TAG_NS = 1 << 60
"""Age of the last tag in the firmware's log before there was any."""
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
    """Truth of all docking faces in one tick, in the order of `TruthRecorder.record_docks`."""
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
    """Whether a TruthRecorder wrote `path`: by its header, so a torn one too."""
    try:
        with path.open("rb") as file:
            begin = file.read(HEADER_BYTES)
    except OSError:
        return False
    return begin.startswith(MCAP0_MAGIC) and WRITER.encode() in begin


class TruthRecorder:
    """Writes /plant/moduleN and /plant/bodyN (N: its leader), a message per tick and module or body. A context
    manager. Raises OSError when the disk is full.
    """

    def __init__(self, folder: Path, thrusters: tuple[int, ...]) -> None:
        """`thrusters` has the number of thrusters of each module of the fleet, in its order."""
        self._file = (folder / TRUTH_LOG).open("wb")
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="", library=WRITER)
        self._file.flush()  # whatever comes, the folder is known as a flight's
        self._sequence = 0
        self._modules = []
        for module, count in enumerate(thrusters):
            layout = Layout("Module", module_signals(count))
            schema = self._writer.register_schema(layout.schema_name, "protobuf", layout.schema)
            channel = self._writer.register_channel(f"/plant/module{module}", "protobuf", schema)
            self._modules.append((channel, layout.row()))
        self._body_layout = Layout("Body", body_signals(len(thrusters)))
        self._body_schema = self._writer.register_schema(
            self._body_layout.schema_name, "protobuf", self._body_layout.schema
        )
        self._bodies: dict[int, Any] = {}
        self._docks: Any = None
        if len(thrusters) > 1:
            layout = Layout("Docks", dock_signals(len(thrusters)))
            schema = self._writer.register_schema(layout.schema_name, "protobuf", layout.schema)
            self._docks = (self._writer.register_channel("/plant/docks", "protobuf", schema), layout.row())

    def record_world(self, tick: int, world: World) -> None:
        """Truth of everything at the moment of SYNC `tick`."""
        for module in range(len(world.vehicles)):
            t = world.truth(module)
            power = t.voltage_v * t.current_a
            self.record(tick, t.time_ns, module, t.p_wm, t.q_wm, t.v_w, t.w_b, t.force_n, t.current_w, power)
        for body in range(len(world.bodies)):
            b = world.body_truth(body)
            self.record_body(tick, b.time_ns, b.modules, b.p_wb, b.q_wb, b.v_w, b.w_b, world.load(body))
        if self._docks is not None:
            docks, (channel, row) = world.docks, self._docks
            jams = sum(contact.jammed for contact in docks.contacts)
            counts = (len(docks.joints), len(docks.contacts), jams)
            values = (tick, world.time_ns, *counts, docks.gap_m, docks.lateral_m, docks.current_ma().ravel())
            self._add(channel, world.time_ns, row.encode(values))

    def record_body(
        self,
        tick: int,
        time_ns: int,
        modules: Sequence[int],
        p_wb: np.ndarray,
        q_wb: np.ndarray,
        v_w: np.ndarray,
        w_b: np.ndarray,
        load: np.ndarray | None = None,
    ) -> None:
        """Truth of the body that `modules` make up, its leader first, at the moment of SYNC `tick`.

        Args:
            p_wb, q_wb: (3,) m nominal centre of mass and (4,) body frame in the world.
            v_w: (3,) velocity of that point, world, m/s. w_b: (3,) angular rate, body frame, rad/s.
            load: (6,) what an ideal load cell reads of a clamped body about its leader's hull centre, body frame.
        """
        leader = modules[0]
        if leader not in self._bodies:
            channel = self._writer.register_channel(f"/plant/body{leader}", "protobuf", self._body_schema)
            self._bodies[leader] = (channel, self._body_layout.row())
        channel, row = self._bodies[leader]
        member = np.zeros(len(self._modules))
        member[list(modules)] = 1.0
        self._add(channel, time_ns, row.encode((tick, time_ns, member, p_wb, q_wb, v_w, w_b, np.zeros(6) if load is None else load)))

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
        power_w: float = 0.0,
    ) -> None:
        """Truth of `module` at the moment of SYNC `tick`.

        Args:
            p_wm, q_wm: (3,) m and (4,) module frame (hull centre) in the world.
            v_w: (3,) velocity of the module's origin, world, m/s. w_b: (3,) angular rate, module frame, rad/s.
            force_n: (n,) force that each thruster gives, N. water_w: (3,) velocity of the undisturbed water there, m/s.
            power_w: that its supply gives, electronics and magnets included, W.
        """
        channel, row = self._modules[module]
        self._add(channel, time_ns, row.encode((tick, time_ns, p_wm, q_wm, v_w, w_b, force_n, water_w, power_w)))

    def _add(self, channel: int, time_ns: int, data: bytes) -> None:
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
    """One body over the ticks that both logs hold, row by row; `lost_ns` are the times of ticks that one of them lacks.

    `truth` has the columns of the body's leading module (its `force_n` and `power_w` those of all its modules), and with them
    `member`, `p_wb`, `q_wb`, `v_wb`, `w_bb` of the body. `modules` has `p_wm`, `q_wm`, `force_n` and
    `power_w` of every module of the fleet, in its order, whichever body it is in.
    """

    firmware: Columns
    truth: Columns
    events: Columns
    ticks: Columns
    lost_ns: np.ndarray
    modules: tuple[Columns, ...] = ()

    @property
    def time_s(self) -> np.ndarray:
        """(k,) firmware time since the first joined tick, s."""
        time_ns = self.firmware["time_ns"]
        return (time_ns - time_ns[0]) / 1e9

    @property
    def p_wb(self) -> np.ndarray:
        """(k, 3) where the point that the firmware steers, the body's nominal centre of mass, really is, world, m."""
        return self.truth["p_wb"]

    @property
    def q_wb(self) -> np.ndarray:
        """(k, 4) true attitude of the body."""
        return self.truth["q_wb"]

    @property
    def placed(self) -> np.ndarray:
        """(k,) whether tags have told heading and place by then: before, what the firmware believes and wants is no pose."""
        told = self.firmware["ready"] & (self.firmware["tag_age_ns"] < NO_TAG_NS)
        return np.logical_or.accumulate(told)

    def between(self, start_ns: int, end_ns: int) -> Flight:
        """The ticks with start <= time <= end."""
        time_ns = self.firmware["time_ns"]
        keep = (time_ns >= start_ns) & (time_ns <= end_ns)
        pick = {name: column[keep] for name, column in self.firmware.items()}
        truth = {name: column[keep] for name, column in self.truth.items()}
        modules = tuple({name: column[keep] for name, column in module.items()} for module in self.modules)
        lost_ns = self.lost_ns[(self.lost_ns >= start_ns) & (self.lost_ns <= end_ns)]
        return Flight(pick, truth, self.events, self.ticks, lost_ns, modules)


def read_flight(folder: Path) -> Flight:
    """The flight of the body that module 0 leads, whose logs are in `folder`.

    Raises:
        OSError: a log is missing. ValueError: a log holds nothing of the body, or they share no tick.
    """
    signals, truths = read_signals(folder / SIGNAL_LOG), read_signals(folder / TRUTH_LOG)
    if "/firmware/body0" not in signals or "/plant/body0" not in truths:
        raise ValueError(f"{folder}: no signals or no truth of body 0 in the logs")
    firmware, thrusters = signals["/firmware/body0"], truths["/plant/module0"]["force_n"].shape[1]
    truth = _joined(truths)
    _, mine, theirs = np.intersect1d(firmware["tick"], truth["tick"], return_indices=True)
    if not len(mine):
        raise ValueError(f"{folder}: the two logs share no tick")
    nothing: Columns = {name: np.zeros(0, np.int64) for name in ("tick", "severity", "log_time")} | {"text": np.zeros(0, str)}
    believed = {name: column[mine] for name, column in firmware.items()}
    true = {name: column[theirs] for name, column in truth.items()}
    _tell_of_same_body(believed, true, thrusters)
    ticks = signals["/firmware/ticks"]
    untold = np.concatenate([np.setdiff1d(firmware["tick"], truth["tick"]), np.setdiff1d(truth["tick"], ticks["tick"])])
    lost_ns = ticks["time_ns"][0] + period_of(ticks) * (untold - ticks["tick"][0])
    return Flight(believed, true, signals.get("/events", nothing), ticks, lost_ns, _fleet(truths, true["tick"]))


def period_of(ticks: Columns) -> int:
    """Of the firmware's ticks, by their numbers and times, ns; 1 of a single one, which tells none."""
    numbers, times = ticks["tick"][:REGULAR_TICKS], ticks["time_ns"][:REGULAR_TICKS]
    return int(np.min(np.diff(times) // np.diff(numbers))) if len(numbers) > 1 else 1


def _fleet(truths: Mapping[str, Columns], ticks: np.ndarray) -> tuple[Columns, ...]:
    """Pose, forces and power of every module at these ticks, in the order of the fleet."""
    count = sum(name.startswith("/plant/module") for name in truths)
    modules = [truths[f"/plant/module{m}"] for m in range(count)]
    return tuple({name: _at(module, ticks, name) for name in ("p_wm", "q_wm", "force_n", "power_w")} for module in modules)


def _joined(truths: Mapping[str, Columns]) -> Columns:
    """The truth of module 0 with that of the body it leads, over the ticks of both."""
    module, body = truths["/plant/module0"], truths["/plant/body0"]
    _, mine, theirs = np.intersect1d(module["tick"], body["tick"], return_indices=True)
    joined = {name: column[mine] for name, column in module.items()}
    joined |= {name: body[name][theirs] for name in ("member", "p_wb", "q_wb")}
    joined |= {"v_wb": body["v_w"][theirs], "w_bb": body["w_b"][theirs]}
    members = np.flatnonzero(joined["member"].any(axis=0))
    if len(members) > 1:
        others = [truths[f"/plant/module{m}"] for m in members]
        for name in ("force_n", "power_w"):
            joined[name] = np.hstack([
                np.where(joined["member"][:, [m]] > 0.0, _at(other, joined["tick"], name), np.nan)
                for m, other in zip(members, others, strict=True)
            ])  # fmt: skip
    return joined


def _at(columns: Columns, ticks: np.ndarray, name: str) -> np.ndarray:
    """Rows of a column at these ticks; every tick of a module's truth has all modules."""
    return columns[name][np.searchsorted(columns["tick"], ticks)]


def _tell_of_same_body(firmware: Columns, truth: Columns, thrusters: int) -> None:
    """While faces have locked or opened and the firmware does not know yet, the truth is told of the body that it steers.

    That is the leading module and what hung rigidly on it: as its body was when it last had that many modules, or next has.
    """
    believed = np.isfinite(firmware["commanded_n"]).sum(axis=1) // thrusters
    actual = (truth["member"] > 0.0).sum(axis=1)
    for count in np.unique(believed[believed != actual]):
        unknown = np.flatnonzero((believed == count) & (actual != count))
        known = np.flatnonzero((believed == count) & (actual == count))
        if not len(known):
            continue
        then = known[np.maximum(np.searchsorted(known, unknown) - 1, 0)]
        attitudes = (truth["q_wm"][then], truth["q_wm"][unknown], truth["q_wb"][then])
        hull_then, hull, body_then = (Rotation.from_quat(q, scalar_first=True) for q in attitudes)
        lever_m = hull_then.inv().apply(truth["p_wb"][then] - truth["p_wm"][then])
        body = hull * hull_then.inv() * body_then
        truth["p_wb"][unknown] = truth["p_wm"][unknown] + hull.apply(lever_m)
        truth["q_wb"][unknown] = body.as_quat(scalar_first=True)
