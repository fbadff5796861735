"""Runs inside the guest: hovers in real time, with plant and firmware as two processes and the disturbances of the plan.

Arguments: JSON, a list of plans (fields of Plan); the C reference node's program. Writes to $VG_OUT `flights.json` (lateness
of ticks, and times until the flight resumed after link events) and the logs of flight N in folder N.
"""

import dataclasses
import json
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from firmware_py.app.firmware import BusFrame
from firmware_py.core.types import Inputs, Outputs
from firmware_py.description.parameters import Parameters
from firmware_py.runtime.realtime import PLANT_PRIORITY, READER_PRIORITY, real_time
from hil.realtime import Handshake, fly_in_real_time, serve_between, serve_plant
from hil.reference_node import SocketPlant
from hil.scenario import Scenario, load_scenario
from tests.vcan.can_utils import cangen_command
from tests.vcan.link_events import break_link
from tests.vcan.links import Interface

BUS = "vcan0"
FLOOD_ID = 0x71E
"""HEARTBEAT of number 30, with a wrong length: stops no node and commands nothing."""
MCU_ARMED = 2
"""State in MCU_STATUS."""
NODE_PRIORITY = READER_PRIORITY - 1
"""Priority of the C node's process: it stands for hardware, which never waits for a plant."""
NODE_ENDS_S = 5.0


@dataclass(frozen=True)
class Plan:
    """One flight."""

    settle_s: float
    duration_s: float
    busy_loops: int = 0
    flood: bool = False
    link_events: int = 0
    node: bool = False
    """The C reference node in place of the plant's own."""
    rate_hz: int = 100
    seed: int = 0


def hover(plan: Plan) -> Scenario:
    scenario = load_scenario("hover")
    task = dataclasses.replace(scenario.task, settle_s=plan.settle_s, duration_s=plan.duration_s)
    return dataclasses.replace(scenario, task=task)


@dataclass
class TickLog:
    """Observations in each tick. `on_first` is called in the first one, `on_armed` in the first one flying."""

    on_first: Callable[[], None]
    on_armed: Callable[[], None]
    ended_ns: list[int] = field(default_factory=list)
    """End of each tick on the machine's clock."""
    flying: list[bool] = field(default_factory=list)
    """Whether every module has answered and is armed, tick by tick."""
    readers: int = 0
    """Number of threads that read a bus, at the last tick."""
    waits: int = 0
    """Page faults that waited for a file, in any thread of this process, after the first tick."""
    _waits_before: int = 0

    def observe(self, received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        waits = resource.getrusage(resource.RUSAGE_SELF).ru_majflt
        if not self.ended_ns:
            self._waits_before = waits
            self.on_first()
        flying = all(module.answered and module.mcu_state == MCU_ARMED for module in inputs.modules)
        if flying and not any(self.flying):
            self.on_armed()
        self.ended_ns.append(time.monotonic_ns())
        self.flying.append(flying)
        self.waits = waits - self._waits_before
        self.readers = sum(thread.name.startswith("reader") for thread in threading.enumerate())


def spin(idle: bool) -> None:
    if idle:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    while True:
        pass


@contextmanager
def process(target: Callable[..., None], *arguments: Any) -> Iterator[Any]:
    child = multiprocessing.get_context("fork").Process(target=target, args=arguments, daemon=True)
    child.start()
    try:
        yield child
    finally:
        child.kill()
        child.join()


def flood(begin: Event) -> None:
    begin.wait()
    command = cangen_command(BUS, 0.0, "-I", f"{FLOOD_ID:X}")
    os.execvp(command[0], command)  # replaces this process, so that killing it ends cangen


def serve_socket_plant(scenario: Scenario, seed: int, bus: str, rate_hz: int, out: Path | None, handshake: Handshake) -> None:
    """Runs the plant's process, with the C node as its child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    path, arrival = Path(mkdtemp(), "board.socket"), threading.Event()
    plant = SocketPlant(scenario, seed, rate_hz, out, path)
    with real_time(PLANT_PRIORITY - 1), plant.open_board(arrival):
        node = subprocess.Popen([sys.argv[2], BUS, "1", str(rate_hz), str(path)])
        os.sched_setscheduler(node.pid, os.SCHED_FIFO, os.sched_param(NODE_PRIORITY))
        serve_between(handshake, plant, bus, arrival)
    assert node.wait(NODE_ENDS_S) == 0, "the node ends when its board does"


def fly(plan: Plan, folder: Path) -> dict[str, Any]:
    """Flies one plan and returns its figures; the logs are in `folder`."""
    folder.mkdir(parents=True)
    context = multiprocessing.get_context("fork")
    begin, history = context.Event(), context.SimpleQueue()
    with ExitStack() as stack:
        # The counted clock of an idle machine jumps while a process waits for a file, so the machine is kept busy until the first tick.
        spinner = stack.enter_context(process(spin, True))
        for _ in range(plan.busy_loops):
            stack.enter_context(process(spin, False))
        if plan.flood:
            stack.enter_context(process(flood, begin))
        if plan.link_events:
            stack.enter_context(process(break_link, Interface(BUS), plan.seed, plan.link_events, begin, history))
        log = TickLog(spinner.kill, begin.set)
        world = hover(plan), plan.seed, Parameters(), folder, f"socketcan:{BUS}", plan.rate_hz
        serve = serve_socket_plant if plan.node else serve_plant
        flown = fly_in_real_time(*world, start_method="fork", observers=[log.observe], serve=serve)
        events = history.get() if plan.link_events and begin.is_set() else []
    return {
        "plan": dataclasses.asdict(plan),
        **flown._asdict(),
        "ticks": len(log.flying),
        "flying_at_the_end": log.flying[-1],
        "readers": log.readers,
        "waits": log.waits,
        "events": len(events),
        "resumed_s": resumed_s(events, log),
    }


def resumed_s(events: Sequence[tuple[int, str]], log: TickLog) -> list[float]:
    """For each time that the link became usable, seconds until the flight resumed or the link broke again."""
    waits = []
    for index, (time_ns, state) in enumerate(events):
        if state == "up":
            broken_ns = events[index + 1][0] if index + 1 < len(events) else log.ended_ns[-1]
            ticks = zip(log.ended_ns, log.flying, strict=True)
            on = min((end_ns for end_ns, flying in ticks if flying and end_ns > time_ns), default=log.ended_ns[-1])
            waits.append((min(on, broken_ns) - time_ns) * 1e-9)
    return waits


def main() -> None:
    plans = [Plan(**plan) for plan in json.loads(sys.argv[1])]
    out = Path(os.environ["VG_OUT"])
    folders = [Path("/tmp/flights", str(number)) for number in range(len(plans))]
    # Both processes, their readers and the flood share one processor; above 95 % of a second the real-time limit would stop them all.
    Path("/proc/sys/kernel/sched_rt_runtime_us").write_text("-1")
    flights = []
    for plan, folder in zip(plans, folders, strict=True):
        flights.append(fly(plan, folder))
        (out / "flights.json").write_text(json.dumps(flights, indent=2))
        shutil.copytree(folder, out / folder.name)


if __name__ == "__main__":
    main()
