"""Run inside the guest: hovers in real time, plant and firmware as two processes, in the company that the plan asks for.

Argument: JSON, a list of plans (fields of Plan). Leaves `flights.json` in $VG_OUT: how late ticks were, how exactly the
robot kept its place, and with link events how soon ticks were answered again.
"""

import dataclasses
import json
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from firmware_py.app.firmware import BusFrame
from firmware_py.core.types import Inputs, Outputs
from firmware_py.description.parameters import Parameters
from hil.flight import judge_logs
from hil.realtime import RealTimeFlight, fly_in_real_time
from hil.scenario import Scenario, load_scenario
from tests.vcan.can_utils import cangen_flood
from tests.vcan.link_events import break_link
from tests.vcan.links import Interface

BUS = "vcan0"
FLOOD_ID = 0x7FE
"""HEARTBEAT of number 30: stops nobody and commands nothing."""


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
    """When ticks were answered, on the machine's clock."""

    on_first: Callable[[], None]
    origin_ns: int = 0
    times_ns: list[int] = field(default_factory=list)
    answered: list[bool] = field(default_factory=list)

    def observe(self, received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        if not self.times_ns:
            self.on_first()
        self.times_ns.append(outputs.time_ns)
        self.answered.append(all(module.answered for module in inputs.modules))


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


def fly(plan: Plan, folder: Path) -> dict[str, Any]:
    """One flight and its figures."""
    scenario = hover(plan)
    folder.mkdir(parents=True)
    with ExitStack() as stack:
        # An idle machine's counted clock jumps while files are waited for: it is kept busy until the first tick.
        spinner = stack.enter_context(process(spin, True))
        for _ in range(plan.busy_loops):
            stack.enter_context(process(spin, False))
        if plan.flood:
            stack.enter_context(cangen_flood(BUS, FLOOD_ID))
        events = multiprocessing.get_context("fork").SimpleQueue()
        begin = multiprocessing.get_context("fork").Event()
        breaker = None
        if plan.link_events:
            breaker = stack.enter_context(process(break_link, Interface(BUS), plan.seed, plan.link_events, begin, events))

        def on_first() -> None:
            spinner.kill()

        log = TickLog(on_first)
        flown = fly_in_real_time(
            scenario, plan.seed, Parameters(), folder, f"socketcan:{BUS}", start_method="fork", observers=[log.observe]
        )
    return figures(plan, scenario, flown, folder, log)


def figures(plan: Plan, scenario: Scenario, flown: RealTimeFlight, folder: Path, log: TickLog) -> dict[str, Any]:
    result = judge_logs(scenario, plan.seed, folder, flown.wall_s, flown.deadline_misses)
    return {
        "plan": dataclasses.asdict(plan),
        "lateness_ns": flown.lateness_ns,
        "deadline_misses": flown.deadline_misses,
        "unanswered": flown.unanswered,
        "refused": flown.refused,
        "ticks": len(log.times_ns),
        "position_rmse_m": result.metrics["position_rmse_m"],
        "position_max_m": result.metrics["position_max_m"],
    }


def main() -> None:
    plans = [Plan(**plan) for plan in json.loads(sys.argv[1])]
    out = Path(os.environ["VG_OUT"])
    flights = [fly(plan, Path("/tmp/flights", str(number))) for number, plan in enumerate(plans)]
    (out / "flights.json").write_text(json.dumps(flights, indent=2))


if __name__ == "__main__":
    main()
