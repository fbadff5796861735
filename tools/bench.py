"""`make bench`: how fast the code is, beside what else would do the same; writes bench.json and prints it.

One core, BLAS single-threaded. Each figure is the median of repetitions that alternate with its peer's. `ratio` says
how many times better than the peer; what has no peer has none.
"""

from __future__ import annotations

import importlib.util
import json
import os
import struct
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import can
import cantools.database
import numpy as np
from bench_flight import FlightTimes, measure_flight
from numba import njit
from rich import box as box_style
from rich.console import Console
from rich.table import Table
from scipy.optimize import lsq_linear

from can_dbc import __path__ as dbc_path
from firmware_py.bus.codec import Codec, crc8
from firmware_py.bus.port import open_port
from firmware_py.core.allocator import Allocator
from firmware_py.core.drag_lookup import add_drag
from firmware_py.description.parameters import Allocation
from firmware_py.description.vehicle import load_vehicle
from firmware_py.prepare import alpha, drag_table
from firmware_py.prepare.assembly import assemble_vehicle
from firmware_py.prepare.joints import Placement
from firmware_py.prepare.projected_area import Solid, areas_and_centroids, box, plane_basis

OUT = Path("bench.json")
REPETITIONS = 7
FLIGHTS = 3
DIRECTIONS = 1000
"""Directions of the paper's drag table, and look-ups in one repetition."""
REQUIRED_SPEED = 25.0
"""Times real time that lockstep must reach (issue 2)."""


@dataclass(frozen=True)
class Entry:
    """One line of bench.json."""

    name: str
    value: float
    unit: str
    peer: str | None = None
    peer_value: float | None = None
    ratio: float | None = None


def compare(name: str, unit: str, ours: Callable[[], float], peers: dict[str, Callable[[], float]]) -> list[Entry]:
    """Medians of alternating repetitions of functions that return a duration in `unit`; one entry per peer."""
    everyone = {"": ours, **peers}
    times: dict[str, list[float]] = {key: [] for key in everyone}
    for _ in range(REPETITIONS):
        for key, function in everyone.items():
            times[key].append(function())
    value = median(times.pop(""))
    if not peers:
        return [Entry(name, value, unit)]
    return [Entry(name, value, unit, peer, median(each), median(each) / value) for peer, each in times.items()]


def each_us(function: Callable[[], object], times: int) -> Callable[[], float]:
    """Runs `function` so many times; the duration of one, us."""

    def run() -> float:
        began = time.perf_counter()
        for _ in range(times):
            function()
        return 1e6 * (time.perf_counter() - began) / times

    return run


def flight_entries() -> list[Entry]:
    """Lockstep speed, durations of a tick, and where the time goes."""
    flights = [measure_flight(seed) for seed in range(FLIGHTS)]
    detailed: FlightTimes = measure_flight(0, detailed=True)
    speed = median(f.speed for f in flights)
    entries = [
        Entry(
            "spiral in lockstep: virtual bus, real frames, recorder, one core", speed, "x real time",
            "required", REQUIRED_SPEED, speed / REQUIRED_SPEED,
        )
    ]  # fmt: skip
    for name, ticks_us in (("pipeline.step", flights[0].pipeline_us), ("firmware's whole tick", flights[0].tick_us)):
        for label, q in (("p50", 50.0), ("p99", 99.0), ("p99.9", 99.9)):
            value = float(np.percentile(ticks_us, q))
            entries.append(Entry(f"{name}, {label}", value, "us", "period at 100 Hz", 10_000.0, 10_000.0 / value))
    for stage, share in detailed.shares.items():
        entries.append(Entry(f"share of the run: {stage}", 100.0 * share, "%"))
    return entries


def codec_entries() -> list[Entry]:
    """GYRO: three int16, counter and CRC; cantools and struct get the CRC from the same function."""
    codec = Codec.load()
    gyro = codec.message("GYRO")
    database = cantools.database.load_file(str(Path(next(iter(dbc_path))) / "modcube.dbc"), frame_id_mask=0x7E0)
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


@njit(cache=False)
def _look_up_all(nodes, rotational, linear, velocities, out):  # type: ignore[no-untyped-def]
    for i in range(velocities.shape[0]):
        out[i] = 0.0
        add_drag(nodes, rotational, linear, velocities[i], out[i])


@njit(cache=False)
def _nearest_all(directions, coefficients, velocities, out):  # type: ignore[no-untyped-def]
    for i in range(velocities.shape[0]):
        v = velocities[i]
        best, where = -2.0, 0
        for k in range(directions.shape[0]):
            cosine = directions[k, 0] * v[0] + directions[k, 1] * v[1] + directions[k, 2] * v[2]
            if cosine > best:
                best, where = cosine, k
        out[i, :3] = -coefficients[where] * np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2) * v[:3]


def fibonacci(n: int) -> np.ndarray:
    """(n, 3) unit vectors: the paper's Algorithm 1 with the errata's phi."""
    i = np.arange(n)
    z, phi = 1.0 - (2.0 * i + 1.0) / n, np.pi * (1.0 + np.sqrt(5.0)) * i
    return np.column_stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z])


def drag_entries() -> list[Entry]:
    """Looking drag up, its error, and building its table."""
    vehicle = load_vehicle("modcube")
    placements = [Placement(vehicle, (0, 0, 0), 0)]
    solids = [box(np.array(vehicle.hull.size_m))]
    pitch_m = float(vehicle.hull.size_m[0])

    def exact(directions: np.ndarray) -> np.ndarray:
        """Drag per squared speed along (n, 3) directions, N s^2/m^2."""
        area = areas_and_centroids(solids, directions)[0]
        return np.asarray(0.5 * drag_table.WATER_DENSITY * drag_table.coefficient(placements, directions) * area)

    def build(method: drag_table.Outlines) -> Callable[[], float]:
        return lambda: each_us(lambda: drag_table.build(placements, np.zeros(3), pitch_m, method=method), 1)() * 1e-6

    table = drag_table.build(placements, np.zeros(3), pitch_m)
    drawn = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    velocities = np.hstack([drawn / np.linalg.norm(drawn, axis=1, keepdims=True), np.zeros((DIRECTIONS, 3))])
    grid = fibonacci(DIRECTIONS)
    ours, theirs = np.zeros((DIRECTIONS, 6)), np.zeros((DIRECTIONS, 6))
    look_up = (table.nodes, table.rotational, np.zeros(6), velocities, ours)
    nearest = (grid, exact(grid), velocities, theirs)
    _look_up_all(*look_up)
    _nearest_all(*nearest)
    truth = exact(velocities[:, :3])
    errors = [100.0 * _rms(np.linalg.norm(each[:, :3], axis=1) / truth - 1.0) for each in (ours, theirs)]
    peer = "nearest of 1000 directions"
    builders: dict[str, Callable[[], float]] = {"alpha shapes of 1000 points": build(alpha.lattice_method())}
    if importlib.util.find_spec("alphashape") is not None:
        builders["the alphashape package"] = build(_alphashape_package)
    return [
        *compare(
            "drag look-up, compiled", "us", _per_direction(lambda: _look_up_all(*look_up)),
            {peer: _per_direction(lambda: _nearest_all(*nearest))},
        ),
        Entry("drag look-up, error", errors[0], "% rms", peer, errors[1], errors[1] / errors[0]),
        *compare("drag table of one module", "s", build(areas_and_centroids), builders),
    ]  # fmt: skip


def _per_direction(function: Callable[[], object]) -> Callable[[], float]:
    run = each_us(function, 5)
    return lambda: run() / DIRECTIONS


def _alphashape_package(solids: Sequence[Solid], directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a user of the alphashape package would write; seconds per direction, so it is not in the lock."""
    import alphashape

    cloud = alpha.lattice_points(solids)
    shapes = [
        (alphashape.alphashape(cloud.points @ basis.T, 1.0 / cloud.radius), basis) for basis in plane_basis(directions)
    ]
    centroids = [np.array([shape.centroid.x, shape.centroid.y]) @ basis for shape, basis in shapes]
    return np.array([shape.area for shape, _ in shapes]), np.array(centroids)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def allocator_entries() -> list[Entry]:
    """Thruster forces for a wrench that saturates, and one that does not."""
    vehicle = load_vehicle("modcube")
    body = assemble_vehicle(vehicle)
    allocator = Allocator(body, Allocation())
    t = body.thrusters
    entries = []
    for name, force_n in (("within limits", 5.0), ("saturated", 60.0)):
        wrench = np.array([force_n, 0.3 * force_n, -0.2 * force_n, 0.2, -0.1, 0.1])
        peer = each_us(lambda w=wrench: lsq_linear(t.matrix, w, (t.f_min, t.f_max)), 20)  # type: ignore[misc]
        ours = each_us(lambda w=wrench: allocator.step(w), 500)  # type: ignore[misc]
        entries += compare(f"allocation, {name}", "us", ours, {"scipy lsq_linear": peer})
    return entries


def print_entries(entries: Sequence[Entry]) -> None:
    """The table."""
    table = Table(title="one core, medians of alternating repetitions", title_justify="left", box=box_style.SIMPLE_HEAD)
    for column in ("what", "value", "peer", "its value", "times better"):
        table.add_column(column, justify="left" if column in ("what", "peer") else "right")
    for e in entries:
        peer_value = "" if e.peer_value is None else f"{e.peer_value:.4g} {e.unit}"
        ratio = "" if e.ratio is None else f"{e.ratio:.3g}"
        table.add_row(e.name, f"{e.value:.4g} {e.unit}", e.peer or "", peer_value, ratio)
    Console(width=None if sys.stdout.isatty() else 140).print(table)


def main() -> None:
    """Measures everything."""
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":  # read when numpy is imported: start again with it
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    entries: list[Entry] = []
    for measure in (flight_entries, codec_entries, port_entries, drag_entries, allocator_entries):
        print(f"bench: {(measure.__doc__ or '').splitlines()[0]}", file=sys.stderr, flush=True)
        entries += measure()
    OUT.write_text(json.dumps([asdict(e) for e in entries], indent=2) + "\n", encoding="utf-8")
    print_entries(entries)


if __name__ == "__main__":
    main()
