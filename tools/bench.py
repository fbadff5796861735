"""`make bench`: how fast the code is, compared with alternatives that do the same; writes bench.json and prints it.

Runs on one core unless stated, with BLAS single-threaded. Each figure is the median of repetitions that alternate with those of its peer.
`ratio` says how many times better than the peer a figure is; a figure without a peer has none.
"""

from __future__ import annotations

import json
import math
import os
import struct
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from statistics import median

from command_line import Parser, run_tool

import can
import cantools.database
import numpy as np
from bench_batch import batch_entries
from bench_docking import DetectorBench
from bench_drag import drag_entries
from bench_entry import REPETITIONS, Entry, compare, each_us
from bench_fleet import TIMED_TICKS, Hold, cube_of
from bench_flight import FlightTimes, measure_flight, time_additions, time_load
from bench_ground import ground_entries
from bench_lateness import lateness_entries
from rich import box as box_style
from rich.console import Console
from rich.table import Table
from scipy.optimize import lsq_linear

from firmware_py.bus.codec import Codec, crc8
from firmware_py.bus.port import open_port
from firmware_py.core.allocator import Allocator
from firmware_py.description.parameters import Allocation

OUT = Path("bench.json")
FLEET_PROGRAM = Path(__file__).with_name("bench_fleet.py")
FLIGHTS = 3
REQUIRED_SPEED = 25.0
"""Times real time that lockstep must reach."""
PERMITTED_MB = 300.0
"""Memory of a process with 64 modules."""
PERMITTED_TIMES = 5.0
"""Duration of a tick of 64 modules, in those of one."""
PERMITTED_DETECTION_US = 20.0
"""Docking detection of eight modules."""


def flight_entries() -> list[Entry]:
    """Lockstep speed, tick durations, and where the time goes."""
    flights, additions, loads = zip(*((measure_flight(seed), time_additions(), time_load()) for seed in range(FLIGHTS)), strict=True)
    detailed: FlightTimes = measure_flight(0, detailed=True)
    speed = median(f.speed for f in flights)
    entries = [
        Entry(
            "spiral in lockstep: virtual bus, real frames, recorder, one core", speed, "x real time",
            "required", REQUIRED_SPEED, speed / REQUIRED_SPEED,
        )
    ]  # fmt: skip
    entries.append(Entry("the same core at that time: ten million additions in plain Python", median(additions), "s"))
    entries.append(Entry("the same core at that time: one of a chain of dependent loads from 8 MB", median(loads), "ns"))
    for name, ticks_us in (("pipeline.step", flights[0].pipeline_us), ("firmware's whole tick", flights[0].tick_us)):
        for label, q in (("p50", 50.0), ("p99", 99.0), ("p99.9", 99.9)):
            value = float(np.percentile(ticks_us, q))
            entries.append(Entry(f"{name}, {label}", value, "us", "period at 100 Hz", 10_000.0, 10_000.0 / value))
    for stage, share in detailed.shares.items():
        entries.append(Entry(f"share of the run: {stage}", 100.0 * share, "%"))
    return entries


def codec_entries() -> list[Entry]:
    """GYRO: three int16, counter and CRC; cantools and struct use the same CRC function."""
    codec = Codec.load()
    gyro = codec.message("GYRO")
    database = cantools.database.load_file(str(resources.files("can_dbc") / "modcube.dbc"), frame_id_mask=0x7E0)
    theirs = database.get_message_by_name("GYRO")
    values = [0.11, -0.22, 0.33, 0]
    factors = [field.factor for field in gyro.field_details[:3]]
    frame = gyro.encode(1, values, 5)
    names = [*gyro.fields]
    struct_gyro = struct.Struct("<hhhB")

    def cantools_encode() -> bytes:
        head = theirs.encode({**dict(zip(names, values, strict=True)), "Counter": 5, "Crc": 0})[:-1]
        return head + bytes((crc8(frame.id, head),))

    def struct_encode() -> bytes:
        head = struct_gyro.pack(*(round(v / f) for v, f in zip(values[:3], factors, strict=True)), 5 << 4)
        return head + bytes((crc8(frame.id, head),))

    def struct_decode() -> tuple[float, ...]:
        x, y, z, _ = struct_gyro.unpack(frame.data[:-1])
        return x * factors[0], y * factors[1], z * factors[2]

    assert cantools_encode() == frame.data == struct_encode()
    encoders = {"cantools": each_us(cantools_encode, 500), "struct by hand": each_us(struct_encode, 5000)}
    decoders = {
        "cantools": each_us(lambda: theirs.decode(frame.data), 500), "struct by hand": each_us(struct_decode, 5000)
    }  # fmt: skip
    encode = each_us(lambda: gyro.encode(1, values, 5), 5000)
    decode = each_us(lambda: gyro.decode(frame.data), 5000)
    return compare("encode GYRO, CRC included", "us", encode, encoders) + compare("decode GYRO", "us", decode, decoders)


def port_entries() -> list[Entry]:
    """One frame sent and received on a virtual bus."""
    frame = Codec.load().message("GYRO").encode(1, [0.1, 0.2, 0.3, 0], 1)
    message = can.Message(arbitration_id=frame.id, is_extended_id=False, data=frame.data)
    with ExitStack() as stack:
        sender, listener = (stack.enter_context(open_port("virtual:bench")) for _ in range(2))
        theirs = [stack.enter_context(can.Bus(interface="virtual", channel="bench-peer")) for _ in range(2)]

        def ours() -> None:
            for _ in range(10):
                sender.send(frame)
            assert len(listener.receive()) == 10

        def peer() -> None:
            for _ in range(10):
                theirs[0].send(message)
            for _ in range(10):
                assert theirs[1].recv(0.0)

        return compare(
            "ten frames through a virtual port", "us", each_us(ours, 500), {"python-can virtual": each_us(peer, 100)}
        )


def allocator_entries() -> list[Entry]:
    """Thruster forces of one module for a wrench within limits and one that saturates, and of 64 modules for one that saturates."""
    entries = []
    for name, edge, force_n in (("within limits", 1, 5.0), ("saturated", 1, 60.0), ("saturated, 64 modules", 4, 4000.0)):
        body = cube_of(edge)
        allocator, t = Allocator(body, Allocation()), body.thrusters
        wrench = np.r_[force_n * np.array([1.0, 0.3, -0.2]), len(body.modules) * np.array([0.2, -0.1, 0.1])]
        peer = each_us(lambda w=wrench, t=t: lsq_linear(t.matrix, w, (t.f_min, t.f_max)), 20 // edge)  # type: ignore[misc]
        ours = each_us(lambda w=wrench, a=allocator: a.step(w), 500 // edge)  # type: ignore[misc]
        entries += compare(f"allocation, {name}", "us", ours, {"scipy lsq_linear": peer})
    return entries


def fleet_entries() -> list[Entry]:
    """A tick of 64 docked modules beside that of one, and the memory of the process."""
    one, many = Hold(cube_of(1)), Hold(cube_of(4))
    entries = compare(
        "pipeline.step, 64 modules docked", "us", lambda: many.run(TIMED_TICKS), {"one module": lambda: one.run(TIMED_TICKS)}
    )
    times = entries[0].value / float(entries[0].peer_value or math.nan)
    entries.append(
        Entry("pipeline.step, 64 modules docked: multiple", times, "x one module", "permitted", PERMITTED_TIMES, PERMITTED_TIMES / times)
    )
    alone = subprocess.run([sys.executable, str(FLEET_PROGRAM), "4"], check=True, capture_output=True, text=True)
    memory_mb = float(json.loads(alone.stdout)["memory_mb"])
    entries.append(Entry("memory, 64 modules docked", memory_mb, "MB", "permitted", PERMITTED_MB, PERMITTED_MB / memory_mb))
    return entries


def docking_entries() -> list[Entry]:
    """What the docking detector adds to a tick of eight modules: decoding its current frames, and the detection itself."""
    docking, tags_alone = DetectorBench(), DetectorBench(detects=False)
    rounds = [(docking.tick_us(), tags_alone.tick_us()) for _ in range(5 * REPETITIONS)]
    added_us = median(whole - without for whole, without in rounds)
    name = "docking detection from raw frames, 8 modules"
    return [
        Entry(f"{name}: added to a tick", added_us, "us", "permitted", PERMITTED_DETECTION_US, PERMITTED_DETECTION_US / added_us),
        Entry(f"{name}: decoding all {docking.frames:.1f} frames of a tick, and detection", median(whole for whole, _ in rounds), "us"),
    ]


MEASURES = (
    flight_entries,
    fleet_entries,
    docking_entries,
    codec_entries,
    port_entries,
    drag_entries,
    allocator_entries,
    ground_entries,
    lateness_entries,
)
"""The groups of entries, in table order."""


def print_entries(entries: Sequence[Entry]) -> None:
    """Prints the entries as a table."""
    table = Table(title="one core unless said, medians of alternating repetitions", title_justify="left", box=box_style.SIMPLE_HEAD)
    for column in ("what", "value", "peer", "its value", "times better"):
        table.add_column(column, justify="left" if column in ("what", "peer") else "right")
    for e in entries:
        peer_value = "" if e.peer_value is None else f"{e.peer_value:.4g} {e.unit}"
        ratio = "" if e.ratio is None else f"{e.ratio:.3g}"
        table.add_row(e.name, f"{e.value:.4g} {e.unit}", e.peer or "", peer_value, ratio)
    Console(width=None if sys.stdout.isatty() else 140).print(table)


def main() -> None:
    """Measures everything; takes no arguments."""
    Parser(description=__doc__).parse_args()
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":  # read when numpy is imported, so restart with it set
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    print(f"bench: {(batch_entries.__doc__ or '').splitlines()[0]}", file=sys.stderr, flush=True)
    on_two_cores = batch_entries()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    entries: list[Entry] = []
    for measure in MEASURES:
        print(f"bench: {(measure.__doc__ or '').splitlines()[0]}", file=sys.stderr, flush=True)
        entries += measure()
    entries += on_two_cores
    OUT.write_text(json.dumps([asdict(e) for e in entries], indent=2) + "\n", encoding="utf-8")
    print_entries(entries)


if __name__ == "__main__":
    run_tool(main)
