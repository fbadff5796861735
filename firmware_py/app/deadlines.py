"""Reports how ticks kept their deadlines: to the log, to ground stations, and at the end of a run (`--stats`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from firmware_py.app.firmware import BusFrame
from firmware_py.app.observers import Observer
from firmware_py.app.realtime import RealTimeLoop
from firmware_py.core.types import Inputs, Outputs
from firmware_py.ground.tick_times import Times
from firmware_py.runtime.rate_keeper import COARSE_EDGES_NS, Histogram, RateKeeper
from firmware_py.runtime.recorder import Recorder

RECORD_EVERY_S = 0.5
BAR = 40
"""Length of the fullest bin's bar, characters."""


class Summary(NamedTuple):
    """Timing figures of a run."""

    ticks: int
    overruns: int
    skipped: int
    unanswered: int
    lateness: Histogram
    """How long after its deadline each tick began."""
    compute: Histogram
    """How long each tick ran, including the wait for the modules' answers."""


def summary_of(loop: RealTimeLoop) -> Summary:
    """The figures of the run so far."""
    keeper = loop.rate_keeper
    return Summary(keeper.lateness.total, keeper.overruns, keeper.skipped, loop.unanswered, keeper.lateness, keeper.compute)


def stats_lines(summary: Summary) -> Iterator[str]:
    """Lines that `modcube run --stats` prints: counts, quantiles, and both histograms."""
    for name in ("ticks", "overruns", "skipped", "unanswered"):
        yield f"{name:20s} {getattr(summary, name)}"
    histograms = {"lateness": summary.lateness, "compute": summary.compute}
    for name, histogram in histograms.items():
        figures = {"p50": histogram.quantile_ns(0.5), "p99": histogram.quantile_ns(0.99), "worst": histogram.worst_ns}
        for label, value in figures.items():
            yield f"{f'{name}_{label}_ns':20s} {value}"
    for name, histogram in histograms.items():
        yield f"{name}, ticks"
        yield from histogram_lines(histogram)


def histogram_lines(histogram: Histogram) -> Iterator[str]:
    """One line per bin, from the first to the last bin that holds a tick."""
    counts = [int(count) for count in histogram.coarse()]
    held = [bin for bin, count in enumerate(counts) if count]
    for bin in range(held[0], held[-1] + 1) if held else ():
        edge = f"to {COARSE_EDGES_NS[bin] * 1e-3:.0f} us" if bin < len(COARSE_EDGES_NS) else "longer"
        yield f"  {edge:>14s} {counts[bin]:9d} {'#' * -(-BAR * counts[bin] // max(counts))}".rstrip()


def recording_times(recorder: Recorder, keeper: RateKeeper, rate_hz: int) -> Observer:
    """An observer that writes both histograms to `recorder` every half second."""
    every = max(1, round(RECORD_EVERY_S * rate_hz))
    recorder.expect_times()

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        if outputs.tick % every == 0:
            recorder.record_times(outputs.tick, outputs.time_ns, keeper)

    return observe


def times_of(keeper: RateKeeper) -> Times:
    """The figures as telemetry sends them; the load is the 99th percentile of the compute time over the period."""
    load = keeper.compute.quantile_ns(0.99) / keeper.period_ns
    return Times(load, tuple(keeper.lateness.coarse().tolist()), tuple(keeper.compute.coarse().tolist()))
