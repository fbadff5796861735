"""The recorder's files: readable by third-party tools, identical for identical runs, and intact up to a tear."""

import errno
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import can
import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from firmware_py.core.setpoint import rest_at
from firmware_py.core.types import (
    Action,
    BodyRecord,
    Estimate,
    Event,
    Inputs,
    ModuleInputs,
    Outputs,
    Request,
    Setpoint,
    Thrust,
)
from firmware_py.description.signals import MCAP_MAGIC, Layout, Signal, is_closed, read_messages, read_signals
from firmware_py.runtime.log_damage import damaged_at
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG, GuardedFile, Recorder
from hil.plant.world import BodyTruth, Truth
from hil.signals import read_flight
from hil.truth_log import TruthRecorder

PERIOD_NS = 10_000_000
FRAMES = [(0x0C1, bytes.fromhex("0011223344556677")), (0x021, b"\x05\x00\x00\x00"), (0x000, b"")]


@dataclass(frozen=True)
class Spiral:
    """A trajectory."""

    radius_m: float = 0.3
    duration_s: float = 40.0

    def sample(self, t_s: float) -> Setpoint:
        return rest_at(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


def body_record(rng: np.random.Generator, thrusters: int = 8) -> BodyRecord:
    q = np.array([1.0, 0.0, 0.0, 0.0])
    estimate = Estimate(
        rng.normal(size=3), q, rng.normal(size=6), rng.normal(size=3), rng.normal(size=3), np.full(3, 0.01),
        np.full(3, 0.02), 40_000_000, 5.5, 6, 3, True,
    )  # fmt: skip
    setpoint = Setpoint(rng.normal(size=3), q, *rng.normal(size=(4, 3)))
    thrust = Thrust(rng.normal(size=thrusters), rng.normal(size=6), (1.0, 0.75), 0.4)
    return BodyRecord(0, 1, 3, estimate, setpoint, rng.normal(size=6), thrust, rng.normal(size=thrusters), False, 4)


def record_ticks(folder: Path, ticks: int = 120, seed: int = 1, killed: bool = False) -> list[BodyRecord]:
    """A run with a flush every 50 ticks. `killed` leaves the files as they stand after the last tick, unfinished."""
    rng = np.random.default_rng(seed)
    recorder = Recorder(folder, {"vehicle": "modcube", "rate_hz": 100})
    records = []
    for tick in range(ticks):
        time_ns = tick * PERIOD_NS
        recorder.sent(time_ns, 0, FRAMES[1:2])
        recorder.received(time_ns, 0, FRAMES)
        requests = [Request(Action.TRACK, 0, Spiral())] if tick == 10 else []
        events = [Event(6, "tracking")] if tick == 10 else []
        records.append(body_record(rng))
        inputs = Inputs(tick, time_ns, [ModuleInputs()], requests, dropped_frames=2)
        recorder.record(inputs, Outputs(tick, time_ns, [], False, events, records[-1:]))
        if tick % 50 == 49:
            assert recorder.flush() == []
    left = {name: (folder / name).read_bytes() for name in (CAN_LOG, SIGNAL_LOG)}
    recorder.close()
    if killed:
        for name, content in left.items():
            (folder / name).write_bytes(content)
    return records


def test_frames_are_read_back_by_python_can_in_order_with_time_and_direction(tmp_path: Path) -> None:
    record_ticks(tmp_path, ticks=3)
    with can.CanutilsLogReader(tmp_path / CAN_LOG) as reader:
        messages = list(reader)
    assert [(m.arbitration_id, bytes(m.data)) for m in messages[4:8]] == [FRAMES[1], *FRAMES]
    assert [m.is_rx for m in messages[4:8]] == [False, True, True, True]
    assert {m.channel for m in messages} == {"can0"}
    assert [m.timestamp for m in messages[::4]] == [0.0, 0.01, 0.02]


def test_can_log_lines_look_as_candump_writes_them(tmp_path: Path) -> None:
    record_ticks(tmp_path, ticks=2)
    lines = (tmp_path / CAN_LOG).read_text().splitlines()
    assert lines[4] == "(0000000000.010000) can0 021#05000000 T"
    assert lines[5] == "(0000000000.010000) can0 0C1#0011223344556677 R"


def test_body_signals_decode_to_what_the_tick_thought(tmp_path: Path) -> None:
    """The oracle is Google's protobuf library behind the MCAP project's own reader."""
    records = record_ticks(tmp_path, ticks=20)
    with (tmp_path / SIGNAL_LOG).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = [(m.log_time, d) for _, _, m, d in reader.iter_decoded_messages(topics=["/firmware/body0"])]
    assert [time for time, _ in decoded] == [k * PERIOD_NS for k in range(20)]
    for record, (_, message) in zip(records, decoded, strict=True):
        np.testing.assert_array_equal(message.p_wb, record.estimate.p_wb)
        np.testing.assert_array_equal(message.nu, record.estimate.nu)
        np.testing.assert_array_equal(message.setpoint_alpha_b, record.setpoint.alpha_b)
        np.testing.assert_array_equal(message.wrench_achieved, record.thrust.achieved)
        np.testing.assert_array_equal(message.commanded_n, record.commanded_n)
        assert (message.state, message.mode, message.nis_dof, message.rejected, message.ready) == (1, 3, 6, 3, True)
        assert list(message.scale) == [1.0, 0.75] and message.wrench_margin == 0.4


def test_signals_come_back_as_columns(tmp_path: Path) -> None:
    records = record_ticks(tmp_path)
    signals = read_signals(tmp_path / SIGNAL_LOG)
    body = signals["/firmware/body0"]
    np.testing.assert_array_equal(body["p_wb"], [r.estimate.p_wb for r in records])
    np.testing.assert_array_equal(body["log_time"], np.arange(120) * PERIOD_NS)
    np.testing.assert_array_equal(signals["/firmware/ticks"]["received_frames"], np.full(120, 3))
    assert signals["/events"]["text"].tolist() == ["tracking"]
    assert signals["/firmware/requests"]["request"].tolist() == [
        '{"action":"TRACK","body":0,"argument":{"Spiral":{"radius_m":0.3,"duration_s":40.0}}}'
    ]


def test_two_runs_of_one_seed_write_the_same_bytes_and_another_seed_does_not(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("first", "again", "other")]
    for folder, seed in zip(folders, (1, 1, 2), strict=True):
        folder.mkdir()
        record_ticks(folder, seed=seed)
    first, again, other = ([(f / name).read_bytes() for name in (CAN_LOG, SIGNAL_LOG)] for f in folders)
    assert first == again
    assert first[1] != other[1]


@pytest.mark.parametrize("cut", [1, 9, 40, 700, 5000])
def test_log_of_a_killed_robot_is_read_up_to_the_tear(tmp_path: Path, cut: int) -> None:
    record_ticks(tmp_path, ticks=120, killed=True)
    path = tmp_path / SIGNAL_LOG
    path.write_bytes(path.read_bytes()[:-cut])
    ticks = read_signals(path)["/firmware/body0"]["tick"]
    assert ticks.tolist() == list(range(len(ticks)))
    assert len(ticks) in (50, 100)


def test_flushed_log_loses_nothing_when_the_process_is_killed(tmp_path: Path) -> None:
    record_ticks(tmp_path, ticks=100, killed=True)
    assert len(read_signals(tmp_path / SIGNAL_LOG)["/firmware/body0"]["tick"]) == 100
    assert len((tmp_path / CAN_LOG).read_text().splitlines()) == 400


@pytest.mark.slow
@pytest.mark.parametrize("read", [is_closed, damaged_at, lambda path: sum(1 for _ in read_messages(path))])
def test_long_signal_log_is_read_without_being_held_in_memory(read: Callable[[Path], object], tmp_path: Path) -> None:
    """A day of one module is 8 GB."""
    record_ticks(tmp_path, 2000, killed=True)
    read(tmp_path / SIGNAL_LOG)  # imports of the first call
    tracemalloc.start()
    read(tmp_path / SIGNAL_LOG)
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert held < (tmp_path / SIGNAL_LOG).stat().st_size / 4


def test_record_longer_than_its_log_takes_no_memory(tmp_path: Path) -> None:
    record_ticks(tmp_path)
    whole = (tmp_path / SIGNAL_LOG).read_bytes()
    (tmp_path / SIGNAL_LOG).write_bytes(MCAP_MAGIC + bytes([Opcode.CHUNK]) + (1 << 31).to_bytes(8, "little") + whole)
    tracemalloc.start()
    assert list(read_messages(tmp_path / SIGNAL_LOG)) == []
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert held < 1 << 20


def test_full_disk_ends_the_log_with_one_warning_and_no_exception(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(tmp_path)
    rng = np.random.default_rng(0)
    monkeypatch.setattr(GuardedFile, "_append", refuse)
    warnings = []
    for tick in range(200):
        recorder.received(tick * PERIOD_NS, 0, FRAMES)
        outputs = Outputs(tick, tick * PERIOD_NS, [], False, [], [body_record(rng)])
        recorder.record(Inputs(tick, tick * PERIOD_NS, []), outputs)
        warnings += recorder.flush()
    recorder.close()
    assert warnings == [Event(4, "no more log: can.log: No space left on device")]


def refuse(self: GuardedFile, data: bytes) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_folder_that_is_missing_gives_a_warning_and_no_exception(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "missing")
    assert [event.text for event in recorder.close()] == ["no more log: can.log: No such file or directory"]


@pytest.mark.parametrize("folder", ["missing", None])
def test_signals_that_no_file_takes_leave_nothing_behind(
    folder: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The writer of signals.mcap keeps an index, 40 MB a day: after a failed disk, or for viewers alone, it grew without end."""
    recorder, taken = Recorder(folder and tmp_path / folder), list[GuardedFile]()
    recorder.flush()
    monkeypatch.setattr(GuardedFile, "write", lambda file, data: taken.append(file))
    for tick in range(20):
        recorder.record(Inputs(tick, tick * PERIOD_NS, []), Outputs(tick, tick * PERIOD_NS, [], False, [], []))
        recorder.flush()
    recorder.close()
    assert recorder._mcap not in taken


def test_body_that_grew_keeps_its_channel(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    recorder = Recorder(tmp_path)
    for tick, thrusters in enumerate((8, 8, 16)):
        outputs = Outputs(tick, tick * PERIOD_NS, [], False, [], [body_record(rng, thrusters)])
        recorder.record(Inputs(tick, tick * PERIOD_NS, []), outputs)
    recorder.close()
    commanded = read_signals(tmp_path / SIGNAL_LOG)["/firmware/body0"]["commanded_n"]
    assert commanded.shape == (3, 16)
    assert np.isnan(commanded).sum(axis=1).tolist() == [8, 8, 0]


def test_row_of_many_signals_survives_tags_of_two_bytes() -> None:
    layout = Layout("Wide", [Signal(f"s{i}", 20 if i == 17 else 0) for i in range(20)])
    message = layout.row().encode([np.arange(20.0) if i == 17 else float(i) for i in range(20)])
    assert np.frombuffer(message, layout.dtype)["s17"].tolist() == [list(range(20))]


def test_flight_joins_firmware_and_plant_by_tick(tmp_path: Path) -> None:
    record_ticks(tmp_path, ticks=100)
    zero = np.zeros(3)
    with TruthRecorder(tmp_path, (8,)) as truth:
        for tick in range(3, 90):
            time_ns, place, q = tick * PERIOD_NS, np.full(3, float(tick)), np.array([1.0, 0.0, 0.0, 0.0])
            truth.record(tick, 0, Truth(time_ns, place, q, zero, zero, zero, np.zeros(8), zero, 0.0, 0.0))
            truth.record_body(tick, BodyTruth(time_ns, (0,), place, q, zero, zero), np.zeros(6))
    flight = read_flight(tmp_path)
    assert flight.firmware["tick"].tolist() == flight.truth["tick"].tolist() == list(range(3, 90))
    np.testing.assert_array_equal(np.sort(flight.lost_ns), PERIOD_NS * np.r_[0:3, 90:100])
    np.testing.assert_array_equal(flight.truth["p_wm"][:, 0], np.arange(3.0, 90.0))
    assert flight.between(10 * PERIOD_NS, 12 * PERIOD_NS).truth["tick"].tolist() == [10, 11, 12]
