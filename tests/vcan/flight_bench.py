"""Short lockstep flights for the tests on SocketCAN: a bench on any bus, each tick open to a test."""

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
"""Whole lengths and counts, for `make accept`; otherwise reduced ones."""
SETTLE_S = 2.0
"""Until the task begins in a short flight; arming is asked for from 1 s on."""
PATIENCE_LOOKS = 100
"""On vcan a frame is there when send returns; what is not by now is lost."""


def short(name: str, duration_s: float, settle_s: float = SETTLE_S) -> Scenario:
    """Scenario `name` as far as `duration_s`; a spiral as steep as the whole one."""
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
    """Flies to the end; the lines of can.log."""
    folder.mkdir(parents=True, exist_ok=True)
    recorder = Recorder(folder)
    try:
        bench.fly([recording(recorder, bench.firmware.fleet.rate_hz), *observers])
    finally:
        recorder.close()
    return (folder / "can.log").read_text().splitlines()


def sent(lines: Sequence[str]) -> list[str]:
    """The lines of what the firmware sent."""
    return [line for line in lines if line.endswith(" T")]


def frame_of(line: str) -> Frame:
    """The frame of one line of can.log."""
    identifier, _, data = line.split()[2].partition("#")
    return Frame(int(identifier, 16), bytes.fromhex(data))


def between(bench: Bench, act: Callable[[], None]) -> None:
    """From now on `act` runs in every tick between the plant's hearing and its answering."""
    step = bench.nodes.step

    def step_and_act(frames: Sequence[Frame]) -> list[Frame]:
        act()
        return step(frames)

    bench.nodes.step = step_and_act  # type: ignore[method-assign]
