"""Run inside the guest: the hover in real time over vcan0 with the C reference node in place of the plant's own.

Arguments: the node's program, seconds to hover. Leaves `flight.json` in $VG_OUT.
"""

import dataclasses
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from multiprocessing.synchronize import Event
from pathlib import Path

from firmware_py.bus.port import open_port
from firmware_py.description.parameters import Parameters
from firmware_py.runtime.clock import MonotonicClock
from firmware_py.runtime.realtime import PLANT_PRIORITY, READER_PRIORITY, real_time, use_priority
from hil.flight import judge_logs
from hil.realtime import fly_in_real_time
from hil.reference_node import SocketPlant
from hil.scenario import Scenario, load_scenario

BUS = "vcan0"
NODE_PRIORITY = READER_PRIORITY - 1
"""Of the node's process: it stands for hardware, which no plant keeps waiting."""
SETTLE_S = 4.0


def serve_socket_plant(
    scenario: Scenario, seed: int, bus: str, rate_hz: int, out: Path | None, ready: Event, stop: Event
) -> None:
    """The plant's process, and the C node as its child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    path, arrival = Path("/tmp/board.socket"), threading.Event()
    plant = SocketPlant(scenario, seed, rate_hz, out, path)
    clock = MonotonicClock.started_now()
    with (
        real_time(PLANT_PRIORITY - 1),
        open_port(bus, reader=True, now_ns=clock.now_ns, arrival=arrival) as port,
        plant.open_board(arrival),
    ):
        use_priority(PLANT_PRIORITY)
        node = subprocess.Popen([sys.argv[1], BUS, "1", str(rate_hz), str(path)])
        os.sched_setscheduler(node.pid, os.SCHED_FIFO, os.sched_param(NODE_PRIORITY))
        ready.set()
        plant.serve(port, clock.now_ns, stop.is_set)
    assert node.wait(5.0) == 0, "the node ends when its board does"


def keep_busy() -> None:
    """An idle machine's counted clock jumps while files are waited for."""
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    while True:
        pass


def main() -> None:
    scenario = load_scenario("hover")
    task = dataclasses.replace(scenario.task, settle_s=SETTLE_S, duration_s=float(sys.argv[2]))
    scenario = dataclasses.replace(scenario, task=task)
    folder = Path("/tmp/flight")
    folder.mkdir()
    spinner = multiprocessing.get_context("fork").Process(target=keep_busy, daemon=True)
    spinner.start()
    try:
        flown = fly_in_real_time(
            scenario, 0, Parameters(), folder, f"socketcan:{BUS}", start_method="fork", serve=serve_socket_plant
        )
    finally:
        spinner.kill()
    result = judge_logs(scenario, 0, folder, flown.wall_s, flown.deadline_misses)
    figures = {**flown._asdict(), "metrics": result.metrics}
    Path(os.environ["VG_OUT"], "flight.json").write_text(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
