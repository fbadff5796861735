"""A scenario in real time: the firmware here, the plant in a process of its own, each on its own clock."""

from __future__ import annotations

import multiprocessing
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing.context import ForkContext, SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Event as ProcessEvent
from pathlib import Path
from typing import Any, Literal, NamedTuple

from firmware_py.app.configuration import configuration_of
from firmware_py.app.deadlines import recording_times
from firmware_py.app.firmware import Firmware, compose
from firmware_py.app.observers import Observer, recording, recording_buses
from firmware_py.app.realtime import RealTimeLoop, open_loop
from firmware_py.bus.port import open_port
from firmware_py.core.types import Outputs, Request
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.runtime.clock import MonotonicClock
from firmware_py.runtime.interrupts import interrupts_deferred, signals_blocked
from firmware_py.runtime.realtime import PLANT_PRIORITY, TICK_PRIORITY, quiet_garbage, read_libraries, real_time, use_priority
from firmware_py.runtime.recorder import Recorder
from hil import USUAL_RATE_HZ
from hil.bench import fleet_of, script_of
from hil.orders import Orders
from hil.plant_process import CHUNK_NS, PlantProcess, check_served
from hil.scenario import Scenario, make_world
from hil.workers import end_with_parent


class RealTimeFlight(NamedTuple):
    """Timing of a flight in real time."""

    wall_s: float
    deadline_misses: int
    unanswered: int
    lateness_ns: dict[str, int]
    """p50, p99, worst."""
    refused: list[str]
    """Real-time settings that the system refused, a line each."""


class Handshake(NamedTuple):
    """Events between a flight and its plant's process."""

    ready: ProcessEvent
    """Set by the plant when its world is built."""
    begin: ProcessEvent
    """Set when the world's clock may start: not before the firmware's clock, because an unarmed robot drifts."""
    stop: ProcessEvent
    """Set by the flight when it is over."""


def serve_plant(scenario: Scenario, seed: int, bus: str, rate_hz: int, out: Path | None, handshake: Handshake) -> None:
    """Main function of the plant's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    plant = PlantProcess(scenario, seed, rate_hz, out)
    try:
        with real_time(PLANT_PRIORITY - 1):
            serve_between(handshake, plant, bus, threading.Event())
    except DescriptionError as error:
        sys.exit(f"modcube: {error}")


def serve_between(handshake: Handshake, plant: PlantProcess, bus: str, arrival: threading.Event) -> None:
    """Serves `bus` from `begin` until `stop`, on a clock that starts at `begin`. `arrival` is the event of its port."""
    handshake.ready.set()
    handshake.begin.wait()
    if handshake.stop.is_set():  # the flight failed before it began
        return
    clock = MonotonicClock.started_now()
    with open_port(bus, reader=True, now_ns=clock.now_ns, arrival=arrival) as port:
        use_priority(PLANT_PRIORITY)
        plant.serve(port, clock.now_ns, handshake.stop.is_set)


def fly_in_real_time(
    scenario: Scenario,
    seed: int,
    parameters: Parameters,
    out: Path,
    bus: str,
    rate_hz: int = USUAL_RATE_HZ,
    progress: Callable[[float], None] | None = None,
    start_method: Literal["spawn", "fork"] = "spawn",
    observers: Sequence[Observer] = (),
    serve: Callable[..., None] = serve_plant,
    before_logs: Callable[[], None] | None = None,
) -> RealTimeFlight:
    """Flies `scenario` in real time and leaves the logs in `out`. Raises DescriptionError and PortError.

    Args:
        start_method: of the plant's process. `fork` saves its imports; only for a process without threads.
        observers: called after each tick, in addition to the recorder.
        serve: function that the plant's process runs, with the arguments of `serve_plant`.
        before_logs: called once nothing can be refused any more; until then the logs of an earlier flight are untouched.
    """
    check_served(scenario)
    make_world(scenario, seed, CHUNK_NS)  # raises here, while there is only one process to report it: an impossible world,
    open_port(bus).close()  # a bus that cannot be opened,
    fleet = fleet_of(scenario, bus, rate_hz)
    orders = _Started(script_of(scenario, fleet))  # a path that cannot be flown
    read_libraries()
    with ExitStack() as stack:
        plant, handshake = stack.enter_context(_plant(start_method, serve, scenario, seed, bus, rate_hz, out))
        firmware = compose(fleet, parameters)
        _wait_until_ready(plant, handshake)
        check = stack.enter_context(interrupts_deferred())
        if before_logs is not None:
            before_logs()
        recorder = _recorder(stack, out, firmware, scenario.name, seed, rate_hz)
        refused = stack.enter_context(real_time())
        loop = open_loop(stack, firmware, orders.requests)
        loop.observers = [*_recording_observers(recorder, loop, rate_hz), lambda *_: check(), *observers]
        use_priority(TICK_PRIORITY)
        stack.enter_context(quiet_garbage())
        handshake.begin.set()
        loop.listen()
        orders.start_ns = loop.clock.now_ns()
        loop.rate_keeper.start(orders.start_ns + fleet.period_ns)
        loop.run(_stop_at_end(orders, plant, rate_hz, progress))
    return _flown(loop, rate_hz, refused)


@dataclass(slots=True)
class _Started:
    """The orders of a run that begins at `start_ns` of the firmware's clock."""

    script: Orders
    start_ns: int = 0

    def requests(self, time_ns: int, last: Outputs | None) -> Sequence[Request]:
        """As `Orders.requests`, with the time of the firmware's clock."""
        return self.script.requests(time_ns - self.start_ns, last)

    def are_over(self, tick: int, time_ns: int) -> bool:
        """Whether the run ends with this tick; `time_ns` is the firmware's clock."""
        return tick >= self.script.ticks or self.script.is_over(time_ns - self.start_ns)


def _wait_until_ready(plant: BaseProcess, handshake: Handshake) -> None:
    """Waits for the plant. Raises RuntimeError if its process ends instead."""
    while not handshake.ready.wait(timeout=1.0):
        if not plant.is_alive():
            raise RuntimeError("the plant's process ended before it was ready")


def _recorder(stack: ExitStack, out: Path, firmware: Firmware, scenario: str, seed: int, rate_hz: int) -> Recorder:
    """A recorder that is closed with `stack`, writes in its own thread, and opens the bodies' channels before the first tick."""
    recorder = Recorder(out, configuration_of(firmware, scenario=scenario, seed=seed, rate_hz=rate_hz), queued=True)
    stack.callback(recorder.close)
    for body in firmware.pipeline.bodies:
        recorder.expect(body.index, body.thrusters.f_max.size)
    return recorder


def _recording_observers(recorder: Recorder, loop: RealTimeLoop, rate_hz: int) -> list[Observer]:
    """Observers that record the ticks, their timing and the ports' faults."""
    times = recording_times(recorder, loop.rate_keeper, rate_hz)
    buses = recording_buses(recorder, loop.ports, rate_hz)
    return [recording(recorder, rate_hz), times, buses]


def _stop_at_end(
    orders: _Started, plant: BaseProcess, rate_hz: int, progress: Callable[[float], None] | None
) -> Callable[[int, Outputs], bool]:
    """The function that ends a loop with its orders. Once a second it reports progress; it raises DescriptionError if the plant ended."""

    def stop(tick: int, outputs: Outputs) -> bool:
        if tick % rate_hz == 0:
            if not plant.is_alive():
                raise DescriptionError("the plant's process has ended, and the flight with it")
            if progress is not None:
                progress(tick / rate_hz)
        return orders.are_over(tick, outputs.time_ns)

    return stop


def _flown(loop: RealTimeLoop, rate_hz: int, refused: list[str]) -> RealTimeFlight:
    """The timing of a loop that has ended."""
    keeper, late = loop.rate_keeper, loop.rate_keeper.lateness
    ticks = loop.last.tick if loop.last is not None else 0
    lateness_ns = {"p50": late.quantile_ns(0.5), "p99": late.quantile_ns(0.99), "worst": late.worst_ns}
    return RealTimeFlight(ticks / rate_hz, keeper.overruns + keeper.skipped, loop.unanswered, lateness_ns, refused)


@contextmanager
def _plant(start_method: str, serve: Callable[..., None], *arguments: Any) -> Iterator[tuple[BaseProcess, Handshake]]:
    """Runs the plant's process while inside. Raises RuntimeError at the end if it failed."""
    spawn, fork = multiprocessing.get_context("spawn"), multiprocessing.get_context("fork")
    context: SpawnContext | ForkContext = fork if start_method == "fork" else spawn
    handshake = Handshake(context.Event(), context.Event(), context.Event())
    plant = context.Process(target=serve, args=(*arguments, handshake), name="plant", daemon=True)
    with signals_blocked():
        plant.start()
    try:
        yield plant, handshake
    finally:
        handshake.stop.set()
        handshake.begin.set()
        plant.join()
    if plant.exitcode:
        raise RuntimeError(f"the plant's process ended with status {plant.exitcode}")
