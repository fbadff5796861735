"""The robot in its tank behind a ground link, paced by the clock: a process for real clients to connect to.

`python -m tests.clients.flying_bench ADDRESS... [--identity ardusub] [--store DIR] [--logs DIR] [--scenario NAME] [--pace X]`.
Prints `ready` after READY_S, ends when its input closes, and then prints one line of JSON: the distance of the truth from the
set-point in each mode.
"""

import argparse
import json
import select
import sys
import time
from collections import defaultdict
from contextlib import ExitStack

import numpy as np

from firmware_py.app.ground_station import GroundSide
from firmware_py.core.transitions import State
from firmware_py.core.types import Mode, Outputs, Request
from firmware_py.description.parameters import Parameters
from firmware_py.ground.config import GroundConfig
from hil.bench import open_bench
from hil.scenario import load_scenario

PERIOD_S = 0.01
LONGEST_LAG_S = 0.1
"""A slow machine catches up a lag of at most this; any excess is dropped."""
READY_S = 2.0
"""Time until the estimator is sure of its position."""


class Errors:
    """Distance of the truth from the set-point, and the path length of the set-point, by mode."""

    def __init__(self) -> None:
        self._square: dict[str, list[float]] = defaultdict(list)
        self._place: dict[str, list[list[float]]] = defaultdict(list)

    def add(self, outputs: Outputs, truth_m: np.ndarray) -> None:
        record = outputs.records[0]
        if record.state == State.ARMED:
            name = Mode(record.mode).name
            self._square[name].append(float(np.sum((truth_m - record.setpoint.p_wb) ** 2)))
            self._place[name].append(record.setpoint.p_wb.tolist())

    def summary(self) -> dict[str, dict[str, float]]:
        return {
            name: {
                "rmse_mm": 1e3 * float(np.sqrt(np.mean(square))),
                "max_mm": 1e3 * float(np.sqrt(np.max(square))),
                "seconds": len(square) / 100,
                "path_m": float(np.linalg.norm(np.diff(self._place[name], axis=0), axis=1).sum()),
            }
            for name, square in self._square.items()
        }


class Pilot:
    """Stands in for the bench's script: passes on the clients' requests and keeps pace with the clock."""

    ticks = 2**31

    def __init__(self, side: GroundSide, pace: float) -> None:
        self._side, self._pace = side, pace
        self._deadline = time.perf_counter()

    def is_over(self, time_ns: int) -> bool:
        return bool(select.select([sys.stdin], [], [], 0)[0]) and not sys.stdin.read(1)

    def requests(self, time_ns: int, last: Outputs | None) -> list[Request]:
        if self._side.error is not None:
            raise self._side.error
        if time_ns == round(READY_S * 1e9):
            print("ready", flush=True)
        now = time.perf_counter()
        self._deadline = max(self._deadline + PERIOD_S / self._pace, now - LONGEST_LAG_S)
        time.sleep(max(0.0, self._deadline - now))
        return self._side.requests()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("links", nargs="+")
    parser.add_argument("--identity", default="generic")
    parser.add_argument("--store", default="")
    parser.add_argument("--logs", default="")
    parser.add_argument("--scenario", default="hover")
    parser.add_argument("--pace", type=float, default=1.0)
    arguments = parser.parse_args()
    with ExitStack() as stack:
        bench = open_bench(stack, load_scenario(arguments.scenario), 0, Parameters())
        config = GroundConfig(
            links=tuple(arguments.links), identity=arguments.identity, store=arguments.store, logs=arguments.logs
        )
        side = stack.enter_context(GroundSide(config, bench.firmware))
        bench.script = Pilot(side, arguments.pace)
        assert not np.any(bench.nodes.world.vehicles[0].inertial.com_m), "truth is of the hull's centre"
        errors = Errors()

        def observe(received: object, sent: object, inputs: object, outputs: Outputs) -> None:
            errors.add(outputs, bench.nodes.world.truth(0).p_wm)

        bench.fly([side.observe, observe])
        print(json.dumps(errors.summary()), flush=True)


if __name__ == "__main__":
    main()
