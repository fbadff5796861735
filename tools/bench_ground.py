"""For tools/bench.py: what telemetry costs a tick, every message at 50 Hz on two links, against no ground side at all.

The firmware runs against the clock on recorded inputs, seconds with and seconds without in turn. Run as a program, it
prints JSON.
"""

from __future__ import annotations

import itertools
import json
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import asdict
from statistics import median
from typing import NamedTuple

import numpy as np
from bench_entry import REPETITIONS, Entry

from firmware_py.app.firmware import Firmware
from firmware_py.app.ground_station import GroundSide
from firmware_py.core.types import Inputs, Outputs, Request
from firmware_py.description.parameters import Parameters
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.system import NS_PER_S
from firmware_py.ground.telemetry import STREAMS
from firmware_py.runtime.clock import MonotonicClock
from firmware_py.runtime.rate_keeper import RateKeeper, absolute_sleeper
from firmware_py.runtime.realtime import TICK_PRIORITY, quiet_garbage, real_time
from hil.bench import open_bench
from hil.scenario import load_scenario

RATE_HZ = 50
LINKS = 2
PERIOD_NS = 10_000_000
RECORDED_TICKS = 300
BLOCK_TICKS = 300
PERMITTED_PERCENT = 5.0
"""Of a tick's time (issue 6)."""


class Block(NamedTuple):
    """Some seconds of ticks."""

    tick_us: float
    """Median."""
    lateness_us: float
    """99th percentile."""
    overruns: int


class Ticks:
    """A firmware that ticks against the clock on the inputs of a hover's first seconds, over and over."""

    def __init__(self) -> None:
        self._inputs: list[Inputs] = []

        class Script:
            ticks = RECORDED_TICKS

            def requests(self, time_ns: int, last: Outputs | None) -> list[Request]:
                return []

            def is_over(self, time_ns: int) -> bool:
                return False

        with ExitStack() as stack:
            bench = open_bench(stack, load_scenario("hover"), 0, Parameters())
            bench.script = Script()  # type: ignore[assignment]
            bench.fly([lambda received, sent, given, outputs: self._inputs.append(given)])
        self.firmware: Firmware = bench.firmware
        self._number = itertools.count(RECORDED_TICKS + 1)

    def run(self, side: GroundSide | None) -> Block:
        """One block, with telemetry or without."""
        clock = MonotonicClock()
        keeper = RateKeeper(PERIOD_NS, clock, absolute_sleeper(clock))
        spent_us = np.empty(BLOCK_TICKS)
        for i in range(BLOCK_TICKS):
            keeper.wait()
            began = time.perf_counter()
            self._tick(side)
            spent_us[i] = 1e6 * (time.perf_counter() - began)
            keeper.finish()
        return Block(float(np.median(spent_us)), keeper.lateness.quantile_ns(0.99) / 1e3, keeper.overruns)

    def _tick(self, side: GroundSide | None) -> None:
        number = next(self._number)
        modules = self._inputs[number % RECORDED_TICKS].modules
        given = Inputs(number, number * PERIOD_NS, modules, side.requests() if side is not None else [])
        outputs = self.firmware.pipeline.step(given)
        if side is not None:
            side.observe([], [], given, outputs)


def stream_everything(side: GroundSide) -> None:
    """Every message at RATE_HZ on every link."""
    for channel in side.links.channels:
        side.station.join(channel, 0)
    for services in side.station.services.values():
        for rates in services.system.channels.values():
            for name in STREAMS:
                rates.set(name, NS_PER_S // RATE_HZ, 0)


def ground_entries() -> list[Entry]:
    """A tick beside telemetry: every message at 50 Hz on two links, and without."""
    ticks = Ticks()
    with ExitStack() as stack:
        clients = [stack.enter_context(closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))) for _ in range(LINKS)]
        for client in clients:
            client.bind(("127.0.0.1", 0))
        config = GroundConfig(links=tuple(f"udpout:127.0.0.1:{client.getsockname()[1]}" for client in clients))
        planner = stack.enter_context(ThreadPoolExecutor(1))  # no mission is flown, and no process starts meanwhile
        side = stack.enter_context(GroundSide(config, ticks.firmware, planner))
        stream_everything(side)
        stack.enter_context(real_time(TICK_PRIORITY))
        stack.enter_context(quiet_garbage())
        pairs = [(ticks.run(None), ticks.run(side)) for _ in range(REPETITIONS + 1)][1:]  # the first ones warm up
        assert side.error is None and not side.links.dropped, (side.error, side.links.dropped)
    without, beside = ([pair[i] for pair in pairs] for i in range(2))
    name = f"tick beside telemetry at {RATE_HZ} Hz on {LINKS} links"
    share = 100.0 * median(b.tick_us / a.tick_us - 1.0 for a, b in pairs)
    return [
        compared(f"{name}, p50", median(b.tick_us for b in beside), median(a.tick_us for a in without)),
        Entry(f"{name}: its part", share, "%", "permitted", PERMITTED_PERCENT),
        compared(f"{name}: lateness, p99", median(b.lateness_us for b in beside), median(a.lateness_us for a in without)),
        Entry(f"{name}: overruns", sum(b.overruns for b in beside), "", "without", sum(a.overruns for a in without)),
    ]


def compared(name: str, beside_us: float, without_us: float) -> Entry:
    """A duration with telemetry, and without."""
    return Entry(name, beside_us, "us", "without", without_us, without_us / beside_us)


if __name__ == "__main__":
    print(json.dumps([asdict(entry) for entry in ground_entries()], indent=2))
