"""The robot in its tank behind a ground link, paced by the clock: a process for real clients to connect to.

`python tests/clients/flying_bench.py ADDRESS... [--identity ardusub] [--store DIR] [--pace X]`. Says `ready` once it swims, ends
when its input closes, and then prints one line of JSON: how far truth was from the set-point in each mode.
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
from firmware_py.app.lockstep import Lockstep, drain
from firmware_py.core.transitions import ARMED
from firmware_py.core.types import Mode, Outputs
from firmware_py.description.parameters import Parameters
from firmware_py.ground.config import GroundConfig
from hil.bench import open_bench
from hil.scenario import load_scenario

READY_S = 2.0
"""Until the estimator is sure of its place."""


class Errors:
    """Distance of truth from the set-point, by mode, and how far the set-point went."""

    def __init__(self) -> None:
        self._square: dict[str, list[float]] = defaultdict(list)
        self._place: dict[str, list[list[float]]] = defaultdict(list)

    def add(self, outputs: Outputs, truth_m: np.ndarray) -> None:
        record = outputs.records[0]
        if record.state in ARMED:
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
        lockstep = Lockstep(bench.firmware, [bench.firmware_port], [side.observe])
        com_m = np.array(bench.nodes.world.vehicles[0].inertial.com_m)
        assert not com_m.any(), "truth is of the hull's centre"
        errors, sent, tick, period_ns = Errors(), 0, 0, bench.fleet.period_ns
        deadline = time.perf_counter()
        while not (select.select([sys.stdin], [], [], 0)[0] and not sys.stdin.read(1)):
            tick += 1
            time_ns = tick * period_ns
            sent += lockstep.start_tick(tick, time_ns)
            answers = bench.nodes.step([frame for _, frame in drain([bench.plant_port], sent)])
            for frame in answers:
                bench.plant_port.send(frame)
            outputs, sent = lockstep.finish_tick(tick, time_ns, side.requests(), len(answers))
            errors.add(outputs, bench.nodes.world.truth(0).p_wm)
            if side.error is not None:
                raise side.error
            if time_ns == round(READY_S * 1e9):
                print("ready", flush=True)
            deadline = max(deadline + period_ns * 1e-9 / arguments.pace, time.perf_counter() - 0.1)
            time.sleep(max(0.0, deadline - time.perf_counter()))
        print(json.dumps(errors.summary()), flush=True)


if __name__ == "__main__":
    main()
