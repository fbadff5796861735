"""For tools/bench.py: the cost of telemetry per tick, every message at 50 Hz on two links, against no ground side at all.

The firmware runs in real time on recorded inputs, alternating half a second with telemetry and half a second without.
Run as a program, it prints JSON.
"""

from __future__ import annotations

import itertools
import json
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import asdict

from command_line import Parser, run_tool

import numpy as np
from bench_entry import Entry

from firmware_py.app.firmware import Firmware
from firmware_py.app.ground_station import GroundSide
from firmware_py.core.types import Inputs, Outputs, Request
from firmware_py.description.parameters import Parameters
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.system import NS_PER_S
from firmware_py.ground.telemetry import STREAMS
from firmware_py.runtime.clock import MonotonicClock
from firmware_py.runtime.rate_keeper import RateKeeper, absolute_sleeper
from firmware_py.runtime.realtime import GROUND_PRIORITY, TICK_PRIORITY, quiet_garbage, real_time
from hil.bench import open_bench
from hil.orders import Orders
from hil.scenario import load_scenario

RATE_HZ = 50
LINKS = 2
PERIOD_NS = 10_000_000
RECORDED_TICKS = 300
BLOCK_TICKS, PAIRS = 50, 40
PERMITTED_PERCENT = 5.0
"""Permitted share of a tick's time."""


class Ticks:
    """A firmware that ticks in real time on the recorded inputs of a hover's first seconds, in a loop."""

    def __init__(self) -> None:
        self._inputs: list[Inputs] = []

        class Script(Orders):
            ticks = RECORDED_TICKS

            def requests(self, time_ns: int, last: Outputs | None) -> list[Request]:
                return []

        with ExitStack() as stack:
            bench = open_bench(stack, load_scenario("hover"), 0, Parameters())
            bench.script = Script()
            bench.fly([lambda received, sent, given, outputs: self._inputs.append(given)])
        self.firmware: Firmware = bench.firmware
        self._number = itertools.count(RECORDED_TICKS + 1)
        self._clock = MonotonicClock()

    def keeper(self) -> RateKeeper:
        """Returns a new rate keeper, one for the ticks with telemetry and one for those without."""
        return RateKeeper(PERIOD_NS, self._clock, absolute_sleeper(self._clock))

    def run(self, keeper: RateKeeper, side: GroundSide | None) -> float:
        """Runs a block of ticks, with telemetry or without; returns their median duration, us."""
        spent_us = np.empty(BLOCK_TICKS)
        keeper.start(self._clock.now_ns() + PERIOD_NS)
        for i in range(BLOCK_TICKS):
            keeper.wait()
            began = time.perf_counter()
            self._tick(side)
            spent_us[i] = 1e6 * (time.perf_counter() - began)
            keeper.finish()
        return float(np.median(spent_us))

    def _tick(self, side: GroundSide | None) -> None:
        number = next(self._number)
        modules = self._inputs[number % RECORDED_TICKS].modules
        given = Inputs(number, number * PERIOD_NS, modules, side.requests() if side is not None else [])
        outputs = self.firmware.pipeline.step(given)
        if side is not None:
            side.observe([], [], given, outputs)


def stream_everything(side: GroundSide) -> None:
    """Requests every message at RATE_HZ on every link."""
    for channel in side.links.channels:
        side.station.join(channel, 0)
    for services in side.station.services.values():
        for rates in services.system.channels.values():
            for name in STREAMS:
                rates.set(name, NS_PER_S // RATE_HZ, 0)


def ground_entries() -> list[Entry]:
    """A tick with telemetry, every message at 50 Hz on two links, and without."""
    ticks = Ticks()
    with ExitStack() as stack:
        clients = [stack.enter_context(closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))) for _ in range(LINKS)]
        for client in clients:
            client.bind(("127.0.0.1", 0))
        config = GroundConfig(links=tuple(f"udpout:127.0.0.1:{client.getsockname()[1]}" for client in clients))
        planner = stack.enter_context(ThreadPoolExecutor(1))  # no mission is flown, so no process starts meanwhile
        side = stack.enter_context(GroundSide(config, ticks.firmware, planner, priority=GROUND_PRIORITY))
        stream_everything(side)
        stack.enter_context(real_time(TICK_PRIORITY))
        stack.enter_context(quiet_garbage())
        ticks.run(ticks.keeper(), side)  # warms up
        alone, beside = ticks.keeper(), ticks.keeper()
        pairs = np.array([(ticks.run(alone, None), ticks.run(beside, side)) for _ in range(PAIRS)])
        assert side.error is None and not side.links.dropped, (side.error, side.links.dropped)
    name = f"tick beside telemetry at {RATE_HZ} Hz on {LINKS} links"
    without_us, beside_us = np.median(pairs, axis=0)
    late_us = [keeper.lateness.quantile_ns(0.99) * 1e-3 for keeper in (beside, alone)]
    share = 100.0 * float(np.median(pairs[:, 1] / pairs[:, 0] - 1.0))
    return [
        compared(f"{name}, p50", beside_us, without_us),
        Entry(f"{name}: its part", share, "%", "permitted", PERMITTED_PERCENT),
        compared(f"{name}: lateness, p99", *late_us),
        Entry(f"{name}: overruns", beside.overruns, "", "without", alone.overruns),
    ]


def compared(name: str, beside_us: float, without_us: float) -> Entry:
    """Entry of a duration with telemetry against the same without."""
    return Entry(name, beside_us, "us", "without", without_us, without_us / beside_us)


def main() -> None:
    """Prints the entries; takes no arguments."""
    Parser(description=__doc__).parse_args()
    print(json.dumps([asdict(entry) for entry in ground_entries()], indent=2))


if __name__ == "__main__":
    run_tool(main)
