"""Short lockstep flights for the tests on SocketCAN: a bench on any bus, with hooks in every tick."""

import dataclasses
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from firmware_py.app.observers import Observer, recording
from firmware_py.bus.codec import Frame
from firmware_py.description.parameters import Parameters
from firmware_py.runtime.recorder import Recorder
from hil.bench import Bench, open_bench
from hil.scenario import Scenario, load_scenario
from tests.vcan.guest import FULL_LENGTH

FULL = FULL_LENGTH in os.environ
"""Whether to use full lengths and counts, as `make accept` does, or reduced ones."""
SETTLE_S = 2.0
"""Time until the task of a short flight begins; attempts to arm begin at 1 s."""
PATIENCE_LOOKS = 100
"""On vcan a frame has arrived when send returns; one that is missing after this many polls is lost."""


def short(name: str, duration_s: float, settle_s: float = SETTLE_S) -> Scenario:
    """The first `duration_s` of scenario `name`; a spiral keeps its slope."""
    scenario = load_scenario(name)
    task, share = scenario.task, duration_s / scenario.task.duration_s
    task = dataclasses.replace(
        task, settle_s=settle_s, duration_s=duration_s, turns=task.turns * share, climb_m=task.climb_m * share
    )
    return dataclasses.replace(scenario, task=task)


@contextmanager
def bench_on(bus: str, scenario: Scenario, seed: int = 0) -> Iterator[Bench]:
    with ExitStack() as stack:
        bench = open_bench(stack, scenario, seed, Parameters(), bus)
        bench.patience_looks = PATIENCE_LOOKS
        yield bench


def record(bench: Bench, folder: Path, observers: Sequence[Observer] = ()) -> list[str]:
    """Flies to the end; returns the lines of can.log."""
    folder.mkdir(parents=True, exist_ok=True)
    recorder = Recorder(folder)
    try:
        bench.fly([recording(recorder, bench.firmware.fleet.rate_hz), *observers])
    finally:
        recorder.close()
    return (folder / "can.log").read_text().splitlines()


def sent(lines: Sequence[str]) -> list[str]:
    """The lines of the frames that the firmware sent."""
    return [line for line in lines if line.endswith(" T")]


def frame_of(line: str) -> Frame:
    """The frame of one line of can.log."""
    identifier, _, data = line.split()[2].partition("#")
    return Frame(int(identifier, 16), bytes.fromhex(data))


def between(bench: Bench, act: Callable[[], None]) -> None:
    """From now on `act` runs in every tick after the plant has received its frames and before it answers."""
    step = bench.nodes.step

    def step_and_act(frames: Sequence[Frame]) -> list[Frame]:
        act()
        return step(frames)

    bench.nodes.step = step_and_act  # type: ignore[method-assign]
