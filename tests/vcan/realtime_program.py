"""Run inside the guest: hovers in real time, plant and firmware as two processes, in the company that the plan asks
for.

Argument: JSON, a list of plans (fields of Plan). Leaves in $VG_OUT `flights.json`, how late ticks were and how soon the
flight went on after link events, and the logs of flight N in folder N.
"""

import dataclasses
import json
import multiprocessing
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

from firmware_py.app.firmware import BusFrame
from firmware_py.core.types import Inputs, Outputs
from firmware_py.description.parameters import Parameters
from hil.realtime import fly_in_real_time
from hil.scenario import Scenario, load_scenario
from tests.vcan.can_utils import cangen_command
from tests.vcan.link_events import break_link
from tests.vcan.links import Interface

BUS = "vcan0"
FLOOD_ID = 0x71E
"""HEARTBEAT of number 30, with a wrong length: stops nobody and commands nothing."""
MCU_ARMED = 2
"""State in MCU_STATUS."""


@dataclass(frozen=True)
class Plan:
    """One flight."""

    settle_s: float
    duration_s: float
    busy_loops: int = 0
    flood: bool = False
    link_events: int = 0
    seed: int = 0


def hover(plan: Plan) -> Scenario:
    scenario = load_scenario("hover")
    task = dataclasses.replace(scenario.task, settle_s=plan.settle_s, duration_s=plan.duration_s)
    return dataclasses.replace(scenario, task=task)


@dataclass
class TickLog:
    """What became of each tick; `on_first` and `on_armed` are called once."""

    on_first: Callable[[], None]
    on_armed: Callable[[], None]
    ended_ns: list[int] = field(default_factory=list)
    """On the machine's clock."""
    flying: list[bool] = field(default_factory=list)
    """Every module has answered, and armed modules obey."""
    readers: int = 0
    """Threads that read a bus, at the last tick."""

    def observe(self, received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        if not self.ended_ns:
            self.on_first()
        flying = all(module.answered and module.mcu_state == MCU_ARMED for module in inputs.modules)
        if flying and not any(self.flying):
            self.on_armed()
        self.ended_ns.append(time.monotonic_ns())
        self.flying.append(flying)
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
    os.execvp(command[0], command)  # in this process's place, so that it ends when this is killed


def fly(plan: Plan, folder: Path) -> dict[str, Any]:
    """One flight and its figures; its logs are in `folder`."""
    folder.mkdir(parents=True)
    context = multiprocessing.get_context("fork")
    begin, history = context.Event(), context.SimpleQueue()
    with ExitStack() as stack:
        # An idle machine's counted clock jumps while files are waited for: it is kept busy until the first tick.
        spinner = stack.enter_context(process(spin, True))
        for _ in range(plan.busy_loops):
            stack.enter_context(process(spin, False))
        if plan.flood:
            stack.enter_context(process(flood, begin))
        if plan.link_events:
            stack.enter_context(process(break_link, Interface(BUS), plan.seed, plan.link_events, begin, history))
        log = TickLog(spinner.kill, begin.set)
        world = hover(plan), plan.seed, Parameters(), folder, f"socketcan:{BUS}"
        flown = fly_in_real_time(*world, start_method="fork", observers=[log.observe])
        events = history.get() if plan.link_events and begin.is_set() else []
    return {
        "plan": dataclasses.asdict(plan),
        **flown._asdict(),
        "ticks": len(log.flying),
        "flying_at_the_end": log.flying[-1],
        "readers": log.readers,
        "events": len(events),
        "resumed_s": resumed_s(events, log),
    }


def resumed_s(events: Sequence[tuple[int, str]], log: TickLog) -> list[float]:
    """For each time that the link became usable, s until the flight went on, or until the link broke again."""
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
    flights = []
    for plan, folder in zip(plans, folders, strict=True):
        flights.append(fly(plan, folder))
        (out / "flights.json").write_text(json.dumps(flights, indent=2))
        shutil.copytree(folder, out / folder.name)


if __name__ == "__main__":
    main()
