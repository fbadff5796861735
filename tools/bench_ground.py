"""What telemetry costs a tick: every stream at 50 Hz on two links beside the loop, against no ground side at all.

`python tools/bench_ground.py [SECONDS] [--inline]` prints a list of `{"name", "value", "unit"}`. The firmware runs
against the clock on recorded inputs; nothing else should run on the machine.
"""

import json
import socket
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import numpy as np

from firmware_py.app.firmware import Firmware
from firmware_py.app.ground_station import GroundSide
from firmware_py.core.types import Inputs, Outputs
from firmware_py.description.parameters import Parameters
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.system import NS_PER_S
from firmware_py.ground.telemetry import STREAMS
from firmware_py.runtime.clock import MonotonicClock
from firmware_py.runtime.rate_keeper import RateKeeper, absolute_sleeper
from hil.bench import open_bench
from hil.scenario import load_scenario

RATE_HZ = 50
PERIOD_NS = 10_000_000
RECORD_TICKS = 300


def recorded() -> tuple[Firmware, list[Inputs]]:
    """A firmware, and what it took in the first ticks of a hover."""
    inputs: list[Inputs] = []

    class Script:
        ticks = RECORD_TICKS

        def requests(self, time_ns: int, last: Outputs | None) -> list[Any]:
            return []

        def is_over(self, time_ns: int) -> bool:
            return False

    with ExitStack() as stack:
        bench = open_bench(stack, load_scenario("hover"), 0, Parameters())
        bench.script = Script()
        bench.fly([lambda received, sent, given, outputs: inputs.append(given)])
    return bench.firmware, inputs


def run(
    firmware: Firmware, inputs: list[Inputs], seconds: float, side: GroundSide | None
) -> tuple[np.ndarray, RateKeeper]:
    """(k, 2) wall time of each tick and processor time of its own thread, s; and the lateness."""
    clock = MonotonicClock()
    keeper = RateKeeper(PERIOD_NS, clock, absolute_sleeper(clock))
    spent = np.empty((round(seconds * 1e9) // PERIOD_NS, 2))
    first_ns = inputs[-1].time_ns
    for n in range(len(spent)):
        keeper.wait()
        start, busy = time.perf_counter(), time.thread_time()
        template = inputs[n % len(inputs)]
        given = Inputs(n, first_ns + (n + 1) * PERIOD_NS, template.modules, [] if side is None else side.requests())
        outputs = firmware.pipeline.step(given)
        if side is not None:
            side.observe([], [], given, outputs)
        spent[n] = time.perf_counter() - start, time.thread_time() - busy
        keeper.finish()
    return spent, keeper


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    firmware, inputs = recorded()
    alone, keeper_alone = run(firmware, inputs, seconds, None)
    clients = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for client in clients:
        client.bind(("127.0.0.1", 0))
    links = tuple(f"udpout:127.0.0.1:{client.getsockname()[1]}" for client in clients)
    firmware, inputs = recorded()
    planner = ThreadPoolExecutor(1)  # no mission is flown here, and no process starts beside the measurement
    inline = "--inline" in sys.argv
    with planner, GroundSide(GroundConfig(links=links), firmware, planner, threaded=not inline) as side:
        for channel in side.links.channels:
            side.station.join(channel, 0)
        for services in side.station.services.values():
            for rates in services.system.channels.values():
                for name in STREAMS:
                    rates.set(name, NS_PER_S // RATE_HZ, 0)
        with_ground, keeper = run(firmware, inputs, seconds, side)
        assert side.error is None, side.error
        dropped = side.links.dropped
    for client in clients:
        client.close()
    rows: list[tuple[str, float, str]] = []
    for name, ticks, keeper_of in (("alone", alone, keeper_alone), ("with telemetry", with_ground, keeper)):
        wall, own = ticks.T * 1e6
        rows += [
            (f"tick {name}, median", float(np.median(wall)), "us"),
            (f"tick {name}, p99", float(np.quantile(wall, 0.99)), "us"),
            (f"tick {name}, its own processor time, mean", float(np.mean(own)), "us"),
            (f"lateness {name}, p99", keeper_of.lateness.quantile_ns(0.99) / 1e3, "us"),
            (f"overruns {name}", keeper_of.overruns, ""),
        ]
    share = float(np.median(with_ground[:, 0]) - np.median(alone[:, 0])) * 1e9 / PERIOD_NS
    rows += [("frames dropped", dropped, ""), ("telemetry's share of a tick's period", 100 * share, "%")]
    print(json.dumps([{"name": n, "value": round(v, 2), "unit": u} for n, v, u in rows], indent=1))


if __name__ == "__main__":
    main()
