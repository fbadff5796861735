"""For tools/bench.py: how late ticks start on this machine, beside a loop that only wakes up at the same rate.

Run as a program, bench_lateness.py RATE SECONDS flies the hover in real time over udp, firmware and plant in a process each, and prints
JSON. The idle loop is a third process of the same priority: its lateness is that of the machine itself.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

from command_line import Parser, run_tool

import numpy as np
from argument_types import positive
from bench_entry import Entry

from firmware_py.app.firmware import BusFrame
from firmware_py.core.types import Inputs, Outputs
from firmware_py.description.parameters import Parameters
from firmware_py.description.signals import read_signals
from firmware_py.runtime.clock import MonotonicClock
from firmware_py.runtime.rate_keeper import LATENESS_EDGES_NS, RateKeeper, absolute_sleeper
from firmware_py.runtime.realtime import TICK_PRIORITY, quiet_garbage, real_time
from firmware_py.runtime.recorder import SIGNAL_LOG
from firmware_py.runtime.tick_messages import TIMES
from hil.realtime import fly_in_real_time
from hil.scenario import load_scenario

RATES_HZ = (100, 200, 400)
FLIGHT_S = 60.0
SETTLE_S = 3.0
LEAST_S = SETTLE_S + 1.0
"""Shortest flight that leaves ticks to compare after settling, s."""
BUS = "udp:239.74.163.11:43711"
NS_PER_S = 1_000_000_000
ENDS = 0.1
"""Share of the flight at either end over which the drift is computed. The drift is how much later the last ticks start, against the grid of
the first deadline, than those right after settling. Medians, from bins a quarter wide.
"""


def idle_loop(rate_hz: int, duration_s: float, begin: Event, result: Connection) -> None:
    """Reports ready; from `begin` on wakes up as the tick does, then sends its lateness: p50, p99 and worst, ns."""
    result.send("ready")
    begin.wait()
    clock = MonotonicClock()
    keeper = RateKeeper(NS_PER_S // rate_hz, clock, absolute_sleeper(clock))
    with real_time(TICK_PRIORITY), quiet_garbage():
        for _ in range(round(duration_s * rate_hz)):
            keeper.wait()
            keeper.finish()
    late = keeper.lateness
    result.send({"p50": late.quantile_ns(0.5), "p99": late.quantile_ns(0.99), "worst": late.worst_ns})


def fly(rate_hz: int, duration_s: float) -> dict[str, Any]:
    """One real-time flight with the idle loop beside it."""
    scenario = load_scenario("hover")
    scenario = replace(scenario, task=replace(scenario.task, settle_s=SETTLE_S, duration_s=duration_s - SETTLE_S))
    deadlines_ns: list[int] = []
    context = multiprocessing.get_context("spawn")
    begin = context.Event()
    ours, theirs = context.Pipe()
    context.Process(target=idle_loop, args=(rate_hz, duration_s, begin, theirs), daemon=True).start()
    ours.recv()

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        deadlines_ns.append(outputs.time_ns)
        if outputs.tick == 1:
            begin.set()

    with tempfile.TemporaryDirectory() as folder:
        flown = fly_in_real_time(scenario, 0, Parameters(), Path(folder), BUS, rate_hz, observers=[observe])
        times = read_signals(Path(folder) / SIGNAL_LOG)[TIMES]
    drift_us = drift_ns(times["lateness_ticks"], deadlines_ns, NS_PER_S // rate_hz) * 1e-3
    return {**flown._asdict(), "idle_ns": ours.recv(), "drift_us": drift_us}


def drift_ns(counts: np.ndarray, deadlines_ns: Sequence[int], period_ns: int) -> float:
    """How much later ticks start at the end of a flight than at its beginning, ns.

    Args:
        counts: (k, bins) lateness histogram of all ticks so far, against their deadlines.
        deadlines_ns: of all ticks.
    """
    moved = (np.array(deadlines_ns) - deadlines_ns[0] + period_ns // 2) % period_ns - period_ns // 2
    grid = float(np.median(moved[-max(1, round(ENDS * len(moved))) :]))
    some = max(1, round(ENDS * len(counts)))
    first, last = (np.cumsum(counts[end] - counts[start]) for start, end in ((some, 2 * some), (-1 - some, -1)))
    edges = (*LATENESS_EDGES_NS, LATENESS_EDGES_NS[-1])
    medians = [edges[int(np.searchsorted(ticks, 0.5 * ticks[-1]))] for ticks in (first, last)]
    return grid + float(medians[1] - medians[0])


def lateness_entries() -> list[Entry]:
    """How late ticks start in real time, a minute at each rate, beside the machine's own latency."""
    entries = []
    for rate_hz in RATES_HZ:
        command = [sys.executable, __file__, str(rate_hz), str(FLIGHT_S)]
        flown = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        name, peer = f"real time at {rate_hz} Hz", "a loop that only wakes up"
        for key in ("p50", "p99", "worst"):
            late, idle = flown["lateness_ns"][key] * 1e-3, flown["idle_ns"][key] * 1e-3
            entries.append(Entry(f"{name}: tick starts late by, {key}", late, "us", peer, idle, idle / late))
        entries.append(Entry(f"{name}: overruns and deadlines passed over in {FLIGHT_S:.0f} s", flown["deadline_misses"], ""))
        entries.append(Entry(f"{name}: drift over {FLIGHT_S:.0f} s", flown["drift_us"], "us"))
    return entries


def main() -> None:
    """Flies once and prints the results."""
    parser = Parser(description=__doc__)
    parser.add_argument("rate", type=int, help="tick rate, Hz, 50 to 400")
    parser.add_argument("seconds", type=positive, help=f"duration of the flight, s, {LEAST_S:g} or more")
    given = parser.parse_args()
    if not 50 <= given.rate <= 400:
        parser.error(f"argument rate: {given.rate} is outside 50 to 400")
    if given.seconds < LEAST_S:
        parser.error(f"argument seconds: {given.seconds:g} is too short; {LEAST_S:g} or more are needed")
    if hasattr(os, "sched_setaffinity"):  # the bench pins itself to one core, a vehicle does not
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
    print(json.dumps(fly(given.rate, given.seconds)))


if __name__ == "__main__":
    run_tool(main)
