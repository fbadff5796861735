"""For tools/bench.py: times one flight of the spiral, and the share of each stage of a tick.

Stages are timed by wrapping methods of their classes for the length of one flight; the firmware is unaware of it. The speed comes from
flights in which only the whole ticks are wrapped.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter_ns
from typing import Any

import numpy as np
from numba import njit

from firmware_py.app.firmware import compose
from firmware_py.app.lockstep import Lockstep
from firmware_py.bus.mapping import InputCollector, OutputEncoder
from firmware_py.bus.port import Port
from firmware_py.core.pipeline import BodyPipeline, Pipeline
from firmware_py.description.parameters import Parameters
from firmware_py.runtime.recorder import Recorder
from hil.bench import fleet_of, fly_scenario
from hil.nodes import Nodes
from hil.scenario import Scenario, load_scenario
from hil.truth_log import TruthRecorder

LINE = 8
"""Numbers of 8 bytes in a cache line."""
STAGE_METHODS = ("fuse", "step")
"""Methods in which a stage of the pipeline does its work."""


@dataclass(frozen=True)
class FlightTimes:
    """Timing of one flight."""

    speed: float
    """Ratio of simulated time to wall time."""
    pipeline_us: np.ndarray
    """(k,) each call of pipeline.step."""
    tick_us: np.ndarray
    """(k,) each tick of the firmware: SYNC, frames in, step, frames out, recorder."""
    shares: dict[str, float]
    """Share of the run's wall time by stage, largest first; empty when not detailed."""


@dataclass
class Stopwatch:
    """Wraps methods until it is stopped, and keeps every duration."""

    durations_ns: dict[str, list[int]] = field(default_factory=dict)
    _stack: ExitStack = field(default_factory=ExitStack)

    def watch(self, owner: type, method: str, label: str) -> None:
        """Times `owner.method` under `label` until `stop`."""
        original: Callable[..., Any] = getattr(owner, method)
        kept = self.durations_ns.setdefault(label, [])

        def timed(*args: Any, **kwargs: Any) -> Any:
            began = perf_counter_ns()
            result = original(*args, **kwargs)
            kept.append(perf_counter_ns() - began)
            return result

        setattr(owner, method, timed)
        self._stack.callback(setattr, owner, method, original)

    def stop(self) -> None:
        """Restores every wrapped method."""
        self._stack.close()

    def total_s(self, label: str) -> float:
        """Sum of the durations under `label`, s."""
        return 1e-9 * sum(self.durations_ns[label])


def measure_flight(seed: int, detailed: bool = False) -> FlightTimes:
    """Flies the whole spiral with recorder and real frames over the virtual bus."""
    scenario = load_scenario("spiral")
    watch = Stopwatch()
    watch.watch(Pipeline, "step", "pipeline.step")
    watch.watch(Lockstep, "start_tick", "start")
    watch.watch(Lockstep, "finish_tick", "finish")
    stages = _watch_stages(watch, scenario) if detailed else []
    try:
        with tempfile.TemporaryDirectory() as folder:
            wall_s = fly_scenario(scenario, seed, Parameters(), Path(folder), f"virtual:bench{seed}")
    finally:
        watch.stop()
    tick_us = 1e-3 * (np.array(watch.durations_ns["start"]) + np.array(watch.durations_ns["finish"]))
    pipeline_us = 1e-3 * np.array(watch.durations_ns["pipeline.step"])
    return FlightTimes(scenario.duration_s / wall_s, pipeline_us, tick_us, _shares(watch, stages, wall_s))


def _watch_stages(watch: Stopwatch, scenario: Scenario) -> list[str]:
    """Wraps the stages of the pipeline and everything else that takes time; returns the labels within pipeline.step."""
    firmware = compose(fleet_of(scenario, "virtual:bench", 100), Parameters())
    pipeline = next(each for each in firmware.pipeline.formation.pipelines if isinstance(each, BodyPipeline))
    stages = []
    for name, part in vars(pipeline).items():
        for method in STAGE_METHODS:
            if callable(getattr(type(part), method, None)) and type(part).__module__.startswith("firmware_py.core"):
                watch.watch(type(part), method, f"firmware: {name}")
                stages.append(f"firmware: {name}")
    watch.watch(InputCollector, "take", "firmware: decode frames")
    watch.watch(InputCollector, "collect", "firmware: collect inputs")
    watch.watch(OutputEncoder, "frames", "firmware: encode frames")
    watch.watch(Nodes, "step", "plant and its nodes")
    watch.watch(Recorder, "record", "recorder: signals")
    watch.watch(Recorder, "flush", "recorder: files")
    watch.watch(TruthRecorder, "record", "truth recorder")
    watch.watch(Port, "send", "virtual bus: send")
    watch.watch(Port, "receive", "virtual bus: receive")
    return stages


def _shares(watch: Stopwatch, stages: list[str], wall_s: float) -> dict[str, float]:
    if not stages:
        return {}
    outer = {"pipeline.step", "start", "finish"}
    shares = {label: watch.total_s(label) / wall_s for label in watch.durations_ns if label not in outer}
    inside = sum(shares[label] for label in stages)
    shares["firmware: rest of pipeline.step"] = watch.total_s("pipeline.step") / wall_s - inside
    shares["rest of the bench"] = 1.0 - sum(shares.values())
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def time_additions(count: int = 10_000_000) -> float:
    """Time of `count` additions in plain Python, s: tells a slow processor from slow code."""
    began, total = perf_counter_ns(), 0
    for i in range(count):
        total += i
    return (perf_counter_ns() - began) * 1e-9


def time_load(size: int = 1 << 20, count: int = 1_000_000) -> float:
    """Time of one load out of `size` numbers (8 MB), each depending on the one before, ns: tells a slow cache from slow code.

    The code and data of a tick exceed a core's own cache and fit into the shared one.
    """
    lines = np.random.default_rng(0).permutation(size // LINE) * LINE
    following = np.zeros(size, np.int64)
    following[lines] = np.roll(lines, -1)
    _follow(following, 1)
    began = perf_counter_ns()
    _follow(following, count)
    return (perf_counter_ns() - began) / count


@njit("int64(int64[::1], int64)", cache=True)
def _follow(following, count):
    """Index after following a chain of indices for `count` steps."""
    at = 0
    for _ in range(count):
        at = following[at]
    return at
