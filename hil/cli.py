"""The commands `modcube hil ...`: run a scenario, run many seeds of it, run the plant alone, list the scenarios.

Whatever needs compiled code is imported by the command that uses it: help and the list come at once, also before the code was compiled.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from firmware_py.description.parameters import CONTROLLERS, Parameters, load_parameters
from firmware_py.description.schema import DescriptionError, Source, read_toml, unknown_name
from firmware_py.runtime.folders import folder_of
from firmware_py.runtime.interrupts import ended_at_once, interrupted_once
from firmware_py.runtime.recorder import CAN_LOG
from hil import DEFAULT_BUS, USUAL_RATE_HZ
from hil.scenario_files import scenario_file, scenario_names

if TYPE_CHECKING:
    from hil.scenario import Scenario

app = typer.Typer(help="The bench: the firmware against a simulated plant on the same CAN bus.", no_args_is_help=True)

FAILED = 1
"""Exit status when a check failed."""

ScenarioName = Annotated[str, typer.Argument(help="scenario name (see `modcube hil list`), or .toml file")]
Controller = Annotated[str, typer.Option(help="modcube, least_power, paper, paper_sequence, or a parameter file")]
Vehicle = Annotated[str, typer.Option(help="vehicle name or file, in place of the vehicles of the scenario")]
Sensors = Annotated[str, typer.Option(help="real, or ideal: without noise and delay")]


def parameters_of(controller: str) -> Parameters:
    """The parameters named `controller`, or those of a .toml file. Raises DescriptionError."""
    if controller.endswith(".toml"):
        return load_parameters(Path(controller))
    if controller not in CONTROLLERS:
        raise unknown_name("controller", controller, tuple(CONTROLLERS))
    return CONTROLLERS[controller]


def scenario_with(name: str, vehicle: str) -> Scenario:
    """The scenario `name`, on another vehicle if `vehicle` is not empty. Raises DescriptionError."""
    from hil.scenario import load_scenario
    from hil.scenario_rules import mistakes

    scenario = load_scenario(name)
    if vehicle:
        scenario = scenario.with_vehicle(vehicle)
        if (mistake := next(mistakes(scenario), None)) is not None:
            keys, what = mistake
            raise _source_of(name).error(keys, f"{what} (--vehicle {vehicle})")
    return scenario


def scenario_of(name: str, vehicle: str, sensors: str) -> Scenario:
    """The scenario `name` with the changes from the command line. Raises DescriptionError."""
    from hil.bench import fleet_of
    from hil.script import mistake_of_flight

    scenario = scenario_with(name, vehicle)
    if sensors not in ("real", "ideal"):
        raise DescriptionError(f"sensors {sensors!r} is unknown; there are real, ideal")
    if sensors == "ideal":
        scenario = scenario.with_ideal_sensors()
    if name.endswith(".toml") and (mistake := mistake_of_flight(scenario, fleet_of(scenario))):
        raise _source_of(name).error(*mistake)
    return scenario


def _source_of(name: str) -> Source:
    return read_toml(Path(name) if name.endswith(".toml") else scenario_file(name))[1]


def check_rate(rate_hz: int) -> None:
    """Raises DescriptionError for a rate whose period is not a whole number of the plant's sub-steps."""
    from hil.plant.world import STEP_NS

    rates_hz = [rate for rate in range(50, 401) if 1_000_000_000 % (rate * STEP_NS) == 0]
    if rate_hz not in rates_hz:
        why = f"a tick is no whole number of the plant's sub-steps of {1e-6 * STEP_NS:g} ms"
        raise DescriptionError(f"--rate {rate_hz}: {why}; it takes {', '.join(map(str, rates_hz))}")


def check_reaches_others(bus: str, who: str, kinds: tuple[str, ...] = ("virtual:",)) -> None:
    """Raises DescriptionError if `bus` is of one of `kinds`, which do not reach other processes, while `who` needs one at the other end."""
    if bus.startswith(kinds):
        raise DescriptionError(f"bus {bus!r} does not reach another process; {who} needs udp:GROUP:PORT or socketcan:IFACE")


def unusual_in(vehicle: str, controller: str, sensors: str, rate_hz: int = USUAL_RATE_HZ, realtime: bool = False) -> list[str]:
    """The options that differ from the scenario or the defaults, as parts of a folder name."""
    given = ((vehicle, ""), (controller, "modcube"), (sensors, "real"))
    timing = ((f"{rate_hz}hz", rate_hz != USUAL_RATE_HZ), ("realtime", realtime))
    return [Path(chosen).stem for chosen, usual in given if chosen != usual] + [name for name, is_so in timing if is_so]


@app.command()
def run(
    scenario: ScenarioName,
    seed: Annotated[int, typer.Option(min=0, help="seed of all random draws of the world")] = 0,
    bus: Annotated[str, typer.Option(help="CAN bus: virtual:NAME, udp:GROUP:PORT, socketcan:IFACE, slcan:DEVICE")] = DEFAULT_BUS,
    out: Annotated[
        Path | None,
        typer.Option(parser=folder_of, metavar="DIR", help="folder for logs, plots and report; replaces only an earlier flight"),
    ] = None,
    controller: Controller = "modcube",
    vehicle: Vehicle = "",
    sensors: Sensors = "real",
    plots: Annotated[bool, typer.Option(help="draw plots and write the report")] = True,
    rate_hz: Annotated[int, typer.Option("--rate", min=50, max=400, help="tick rate, Hz")] = USUAL_RATE_HZ,
    realtime: Annotated[bool, typer.Option("--realtime", help="run firmware and plant as two processes, each on its own clock")] = False,
) -> None:
    """Fly one scenario; prints a table and leaves logs, plots, report.html and result.json."""
    with ended_at_once():
        from hil.console import flight_progress, print_result
        from hil.flight import fly_and_judge, illustrate

    check_rate(rate_hz)
    chosen = scenario_of(scenario, vehicle, sensors)
    parameters = parameters_of(controller)
    unusual = unusual_in(vehicle, controller, sensors, rate_hz, realtime)
    folder = out if out is not None else Path("runs") / "-".join([chosen.name, *unusual, *([f"seed-{seed}"] if seed else [])])
    if realtime:
        check_reaches_others(bus, "--realtime", ("virtual:", "slcan:"))  # an adapter serves one process
    with _report_log_on_interrupt(folder), interrupted_once():
        with flight_progress(f"{chosen.name}, seed {seed}", chosen.duration_s) as progress:
            result = fly_and_judge(chosen, seed, parameters, folder, bus, rate_hz, progress, realtime, unusual)
        report = illustrate(chosen, result, folder) if plots else None
        print_result(result, report)
    raise typer.Exit(0 if result.passed else FAILED)


@contextmanager
def _report_log_on_interrupt(folder: Path) -> Iterator[None]:
    """When the run inside is interrupted, prints where its log is, or that nothing was flown."""
    log, before = folder / CAN_LOG, _written_at(folder / CAN_LOG)
    try:
        yield
    except KeyboardInterrupt:
        left = f"the log up to then is in {folder}" if _written_at(log) != before else "nothing was flown"
        print(f"modcube: interrupted; {left}", file=sys.stderr)
        raise


def _written_at(path: Path) -> int | None:
    """Time of the last write to a file, ns; None if it does not exist."""
    return path.stat().st_mtime_ns if path.exists() else None


@app.command()
def campaign(
    context: typer.Context,
    scenario: ScenarioName,
    trials: Annotated[int, typer.Option(min=1, help="number of seeds")] = 20,
    jobs: Annotated[int, typer.Option(min=1, help="number of parallel processes")] = 2,
    dask: Annotated[
        str, typer.Option(metavar="ADDRESS", help="scheduler of a dask cluster, tcp://HOST:PORT, in place of local processes")
    ] = "",
    seed: Annotated[int, typer.Option(min=0, help="first seed")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(parser=folder_of, metavar="DIR", help="folder for trials.jsonl, trials.csv, campaign.json; resumes a campaign in it"),
    ] = None,
    controller: Controller = "modcube",
    vehicle: Vehicle = "",
    sensors: Sensors = "real",
    draw: Annotated[int, typer.Option(min=0, max=5, help="number of worst seeds that are flown again for logs, plots and report")] = 1,
) -> None:
    """Fly many seeds of a scenario; prints a table and keeps every trial. Started again after an interruption, it resumes.

    `faults`: everything that can break, in every mode; takes --jobs, --seed and --out.
    """
    if scenario == "faults":
        _check_fault_options(context)
        raise typer.Exit(_fly_faults(jobs, seed, out))
    with ended_at_once():
        from hil.campaign import run_campaign
        from hil.console import campaign_progress, print_campaign
        from hil.flight import fly_and_judge, illustrate
        from hil.workers import dask_cluster, processes

    chosen = scenario_of(scenario, vehicle, sensors)
    unusual = unusual_in(vehicle, controller, sensors)
    folder = out if out is not None else Path("runs") / "-".join([chosen.name, *unusual, "campaign"])
    parameters, seeds = parameters_of(controller), range(seed, seed + trials)
    with _report_resume_on_interrupt(), interrupted_once(), campaign_progress(f"{chosen.name}, {trials} seeds", trials) as progress:
        pool = dask_cluster(dask) if dask else processes(jobs)
        summary = run_campaign(chosen, parameters, seeds, pool, folder, progress, unusual=unusual)
    print_campaign(summary)
    for worst in summary["worst_seeds"][:draw]:
        again = folder / f"seed-{worst}"
        print(f"seed {worst}: {illustrate(chosen, fly_and_judge(chosen, worst, parameters, again, DEFAULT_BUS, unusual=unusual), again)}")
    raise typer.Exit(0 if summary["succeeded"] == summary["trials"] else FAILED)


@contextmanager
def _report_resume_on_interrupt() -> Iterator[None]:
    """When the campaign inside is interrupted, prints that the same command resumes it."""
    try:
        yield
    except KeyboardInterrupt:
        print("modcube: interrupted; the same command goes on where it was", file=sys.stderr)
        raise


FAULT_OPTIONS = ("scenario", "jobs", "seed", "out")
"""Options of `campaign` that apply to the fault matrix."""


def _check_fault_options(context: typer.Context) -> None:
    """Raises DescriptionError if the command line has an option that the fault matrix does not take."""
    given = [name for name in context.params if (source := context.get_parameter_source(name)) and source.name == "COMMANDLINE"]
    if idle := [f"--{name}" for name in given if name not in FAULT_OPTIONS]:
        takes = ", ".join(f"--{name}" for name in FAULT_OPTIONS[1:])
        raise DescriptionError(f"campaign faults: {', '.join(idle)} does not apply: it flies every fault in every mode; it takes {takes}")


def _fly_faults(jobs: int, seed: int, out: Path | None) -> int:
    """Flies and prints the fault matrix; returns the exit status."""
    with ended_at_once():
        from hil.console import campaign_progress
        from hil.fault_campaign import run_fault_campaign
        from hil.fault_matrix import print_faults
        from hil.fault_table import ROWS
        from hil.task import MODES
        from hil.workers import processes

    with interrupted_once(), campaign_progress("every fault in every mode", len(ROWS) * len(MODES)) as progress:
        cells = run_fault_campaign(processes(jobs), out if out is not None else Path("runs") / "faults-campaign", seed, progress)
    print_faults(cells)
    return FAILED if any(cell.broken for cell in cells) else 0


@app.command()
def plant(
    scenario: ScenarioName,
    bus: Annotated[str, typer.Option(help="CAN bus: udp:GROUP:PORT or socketcan:IFACE")],
    seed: Annotated[int, typer.Option(min=0, help="seed of all random draws of the world")] = 0,
    rate_hz: Annotated[int, typer.Option("--rate", min=50, max=400, help="tick rate of the firmware, Hz")] = USUAL_RATE_HZ,
    out: Annotated[Path | None, typer.Option(parser=folder_of, metavar="DIR", help="folder for the log of the true motion")] = None,
    vehicle: Vehicle = "",
) -> None:
    """Run the simulated plant alone, in real time, until SIGINT or SIGTERM: the other end of `modcube run`."""
    with ended_at_once():
        from hil.plant_process import serve_until_signal

    check_reaches_others(bus, "the plant alone")
    serve_until_signal(scenario_with(scenario, vehicle).for_seed(seed), seed, bus, rate_hz, out)


@app.command("list")
def list_scenarios() -> None:
    """The scenarios that the package carries."""
    for name in scenario_names():
        typer.echo(f"{name:20s} {read_toml(scenario_file(name))[0]['help']}")
