"""Terminal output of a bench run: progress while it flies, and the table of its result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from hil.campaign_summary import surely_not_zero
from hil.checks import Result
from hil.metrics import metric_order, shown, shown_limit, shown_value

SENSITIVITY_METRICS = ("position_rmse_m", "attitude_rmse_rad")
"""Metrics of a campaign for which correlated parameters of the world are printed."""
WARNING_LINES = 6
"""Number of warnings shown of a run."""


@contextmanager
def flight_progress(title: str, duration_s: float, console: Console | None = None) -> Iterator[Callable[[float], None]]:
    """A progress bar over simulated time; yields a function that takes the time flown so far, s."""
    columns = (TextColumn("{task.completed:5.1f} of {task.total:.1f} s flown"), TimeElapsedColumn())
    with _bar(title, duration_s, columns, console) as update:
        yield lambda done_s: update(completed=done_s)


@contextmanager
def campaign_progress(title: str, trials: int, console: Console | None = None) -> Iterator[Callable[[int, int], None]]:
    """A progress bar over trials, or a line after each tenth if the output is not a terminal.

    Yields a function that takes the number of trials flown and the total.
    """
    console = console or Console()
    if not console.is_terminal:
        yield partial(_print_tenth, console, title)
        return
    columns = (TextColumn("{task.completed:.0f} of {task.total:.0f} flown"), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with _bar(title, trials, columns, console) as update:
        yield lambda done, total: update(completed=done, total=total)


def _print_tenth(console: Console, title: str, done: int, total: int) -> None:
    """Prints how many trials are flown if this one completes another tenth of them."""
    if 10 * done // total > 10 * (done - 1) // total:
        console.print(f"{title}: {done} of {total} flown", highlight=False, soft_wrap=True)


@contextmanager
def _bar(title: str, total: float, columns: Sequence[ProgressColumn], console: Console | None) -> Iterator[Callable[..., None]]:
    """A bar that leaves one line, or nothing if the output is not a terminal. Yields its update function, as rich's `update`."""
    console = console or Console()
    with Progress(TextColumn("{task.description}"), BarColumn(), *columns, console=console, disable=not console.is_terminal) as progress:
        yield partial(progress.update, progress.add_task(title, total=total))


def campaign_table(summary: Mapping[str, Any]) -> Table:
    """Quantiles of every metric over the trials of a campaign.json; the title gives the number that passed."""
    low, high = summary["confidence_interval"]
    passed = f"{summary['succeeded']} of {summary['trials']} passed ({low:.1%} to {high:.1%}, 95 % confidence)"
    title = Text(f"{summary['scenario']}: {passed}", style="bold")
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for column in ("metric", "smallest", "median", "95 %", "largest"):
        table.add_column(column, justify="left" if column == "metric" else "right")
    for name in metric_order(summary["metrics"]):
        quantiles = summary["metrics"][name]
        if quantiles["median"] is not None:
            values = (shown_value(name, quantiles[q]) for q in ("min", "median", "q95", "max"))
            table.add_row(shown(name).label, *values)
    return table


def print_campaign(summary: Mapping[str, Any], console: Console | None = None) -> None:
    """Prints the table, the kinds of failure, the seeds to look at first, and the correlated parameters."""
    console = console or Console()
    console.print(campaign_table(summary))
    failures = {name: count for name, count in summary["outcomes"].items() if name != "passed"}
    if failures:
        causes = ", ".join(f"{shown(name).label}{f' ({count})' if len(failures) > 1 else ''}" for name, count in failures.items())
        failed = f"{sum(failures.values())} of {summary['trials']} failed"
        console.print(f"{failed}: {causes}", style="bold red", highlight=False, soft_wrap=True)
    if len(summary["worst_seeds"]) < summary["trials"] or failures:
        named = ", ".join(str(seed) for seed in summary["worst_seeds"])
        console.print(f"worst seeds: {named}", highlight=False)
    looked_at = {metric: summary["sensitivities"].get(metric, {}) for metric in SENSITIVITY_METRICS}
    pairs = sum(len(correlations) for correlations in looked_at.values())
    for metric, correlations in looked_at.items():
        if words := what_matters(correlations, pairs):
            console.print(f"{shown(metric).label} goes with: {words}", highlight=False)


def what_matters(correlations: Mapping[str, Mapping[str, float]], pairs: int = 0) -> str:
    """The three strongest world parameters with a significant rank correlation, strongest first: `mass_factor 0.61 (0.24 to 0.83)`.

    With 95 % confidence none of the `pairs` examined together is named wrongly; by default `pairs` is the number of correlations
    given. The interval shown is that of the pair by itself.
    """
    sure = {name: c for name, c in correlations.items() if surely_not_zero(c, max(pairs, len(correlations)))}
    ordered = sorted(sure.items(), key=lambda item: -abs(item[1]["rho"]))
    return ", ".join(f"{name} {c['rho']:.2f} ({c['low']:.2f} to {c['high']:.2f})" for name, c in ordered[:3])


def result_table(result: Result) -> Table:
    """Metrics of a run, with limit and verdict beside those that are checked."""
    checks = {check.name: check for check in result.checks}
    title = Text(f"{result.scenario}, {result.seed_and_options}", style="bold")
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("metric")
    table.add_column("value", justify="right")
    table.add_column("limit", justify="right")
    table.add_column("", justify="left")
    for name in metric_order([*result.metrics, *checks]):
        check = checks.get(name)
        value = result.metrics.get(name, float("nan"))
        limit, verdict = "", Text()
        if check is not None:
            limit = shown_limit(name, check.low, check.high)
            verdict = Text("passed", style="green") if check.passed else Text("FAILED", style="bold red")
        table.add_row(shown(name).label, shown_value(name, value), limit, verdict)
    return table


def warning_lines(warnings: Sequence[str]) -> list[str]:
    """The first warnings of the firmware under a heading, and the number of further ones; empty if there are none."""
    more = [f"  and {len(warnings) - WARNING_LINES} more"] if len(warnings) > WARNING_LINES else []
    return ["Warnings of the firmware:", *(f"  {line}" for line in warnings[:WARNING_LINES]), *more] if warnings else []


def print_result(result: Result, report: Path | None = None, console: Console | None = None) -> None:
    """Prints the table, the firmware's warnings, faults that never began, the verdict in one line, and the path of the report."""
    console = console or Console()
    console.print(result_table(result))
    for line in (*warning_lines(result.warnings), *result.unmet_faults):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    failed = [shown(c.name).label for c in result.checks if not c.passed]
    verdict = f"FAILED: {'; '.join(failed)}" if failed else "passed" if result.passed else "FAILED: nothing was checked"
    console.print(verdict, style="green" if result.passed else "bold red", highlight=False, soft_wrap=True)
    if result.no_tag_reason:
        console.print(result.no_tag_reason, highlight=False, markup=False, soft_wrap=True)
    if report is not None:
        console.print(f"report: {report}", highlight=False, soft_wrap=True)
