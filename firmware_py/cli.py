"""The command `modcube`. Other packages add their own commands through the entry point group `modcube.commands`."""

from __future__ import annotations

import errno
import os
import sys
from contextlib import ExitStack
from dataclasses import fields, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

from firmware_py.bus.port import PortError
from firmware_py.description.fleet import Fleet, single
from firmware_py.description.parameters import Parameters, load_parameters
from firmware_py.description.schema import DescriptionError, did_you_mean
from firmware_py.description.toml_text import explained, to_toml
from firmware_py.description.vehicle_file import load_vehicle, vehicle_names
from firmware_py.ground.config import GroundConfig, check_store, load_ground
from firmware_py.ground.identity import IDENTITIES
from firmware_py.runtime import disk
from firmware_py.runtime.folders import folder_of
from firmware_py.runtime.interrupts import ended_at_once

CANNOT_RUN = 2
"""Exit status when nothing could be started: wrong usage, no such bus, an invalid file."""
REASONS = {errno.EEXIST: "is a file; a folder is needed"}
"""Replacements for system error texts that do not say what would be right."""
BUS, VEHICLE, RATE_HZ = "socketcan:can0", "modcube", 100
"""Defaults of the command line, for a fleet of one module."""
NO_NUMBER = {"int_parsing": "a whole number", "float_parsing": "a number"}
"""What a value should be, by the parser's kind of error."""
_STDERR = 2
LIVE_HOST, LIVE_PORT = "127.0.0.1", 8765
"""Default address of the live view."""
Log = Annotated[Path, typer.Argument(parser=folder_of, help="folder of a run, with can.log and signals.mcap")]

app = typer.Typer(
    help="Controller of a self-reconfigurable underwater robot.", no_args_is_help=True, pretty_exceptions_enable=False
)


log_app = typer.Typer(help="Work with the logs of earlier runs.", no_args_is_help=True)
app.add_typer(log_app, name="log")


@app.command()
def run(
    bus: Annotated[
        str | None, typer.Option(help="CAN bus: virtual:NAME, udp:GROUP:PORT, socketcan:IFACE, slcan:DEVICE", show_default=BUS)
    ] = None,
    fleet: Annotated[
        Path | None, typer.Option(help="fleet file: buses, rate, modules; not with --bus, --rate, --vehicle; without it: module 1")
    ] = None,
    vehicle: Annotated[str | None, typer.Option(help="vehicle name or file of the single module", show_default=VEHICLE)] = None,
    parameters: Annotated[Path | None, typer.Option(help="parameter file")] = None,
    rate_hz: Annotated[int | None, typer.Option("--rate", min=50, max=400, help="tick rate, Hz", show_default=f"{RATE_HZ}")] = None,
    hold: Annotated[bool, typer.Option("--hold", help="arm as soon as permitted, and hold position")] = False,
    out: Annotated[
        Path | None,
        typer.Option(parser=folder_of, metavar="DIR", help="folder for the logs; if it holds one already, subfolder 0002, 0003, ..."),
    ] = None,
    ground: Annotated[
        list[str] | None,
        typer.Option(
            help="link to ground stations: udpout:, udpin:, tcpin:HOST:PORT, /dev/NAME,BAUD; +trusted behind it: may set the signing key"
        ),
    ] = None,
    identity: Annotated[
        str | None, typer.Option(help="modes shown to ground stations: generic (PX4's) or ardusub", show_default="generic")
    ] = None,
    store: Annotated[str | None, typer.Option(help="folder for parameters and signing key of ground stations")] = None,
    ground_file: Annotated[
        Path | None,
        typer.Option(
            help="ground station file: links, identity, store, watched station, dock buttons; --ground, --identity, --store override it"
        ),
    ] = None,
    stats: Annotated[bool, typer.Option("--stats", help="print statistics of tick deadlines")] = False,
    live: Annotated[bool, typer.Option("--live", help="serve a live view for Foxglove")] = False,
    live_host: Annotated[str | None, typer.Option(help="address of the live view", show_default=LIVE_HOST)] = None,
    live_port: Annotated[int | None, typer.Option(min=1, max=65535, help="port of the live view", show_default=f"{LIVE_PORT}")] = None,
) -> None:
    """Run the vehicle until SIGINT, SIGTERM or SIGHUP."""
    from firmware_py.app.deadlines import stats_lines
    from firmware_py.app.live_view import LiveView
    from firmware_py.app.vehicle_process import run_vehicle
    from firmware_py.runtime.notify import Notifier

    if not live and (live_host is not None or live_port is not None):
        raise DescriptionError("--live-host and --live-port tell where the live view listens; give --live with them")
    described = fleet_of(fleet, bus, vehicle, rate_hz)
    chosen = load_parameters(parameters) if parameters is not None else Parameters()
    links = ground_config(ground_file, ground or [], identity, store, out, len(described.module))
    notifier = Notifier.of(os.environ)
    with ExitStack() as stack:
        # The view's threads start before this process takes its real-time priority, which they would inherit.
        view = stack.enter_context(LiveView(live_host or LIVE_HOST, live_port or LIVE_PORT)) if live else None
        summary = run_vehicle(described, chosen, hold, out, notifier=notifier, ground=links, live=view)
    for line in stats_lines(summary) if stats else ():
        typer.echo(line)


def fleet_of(file: Path | None, bus: str | None, vehicle: str | None, rate_hz: int | None) -> Fleet:
    """The fleet in `file`, or a fleet of one module without a file; None selects the default. Raises DescriptionError."""
    from firmware_py.app.firmware import read_fleet

    options = {"--bus": bus, "--vehicle": vehicle, "--rate": rate_hz}
    beside = [name for name, value in options.items() if value is not None]
    if file is None:
        return single(VEHICLE if vehicle is None else vehicle, BUS if bus is None else bus, RATE_HZ if rate_hz is None else rate_hz)
    if beside:
        raise DescriptionError(f"{', '.join(beside)} beside --fleet: buses, vehicles and rate_hz stand in {file}; give one or the other")
    return read_fleet(file)


def ground_config(
    file: Path | None, links: list[str], identity: str | None, store: str | None, logs: Path | None, modules: int
) -> GroundConfig | None:
    """Configuration of the ground side: the command line takes precedence over `file`; None without either. Raises DescriptionError.

    Args:
        identity, store: None where the command line does not give them.
        logs: folder of the logs, unless the file names one.
        modules: number of modules in the fleet.
    """
    if file is None and not links:
        if identity is not None or store is not None:
            raise DescriptionError("--identity and --store go with a link to ground stations; give --ground LINK or --ground-file FILE too")
        return None
    if identity is not None and identity not in IDENTITIES:
        raise DescriptionError(f"identity {identity!r} is unknown; there are {', '.join(IDENTITIES)}")
    config = load_ground(file, modules) if file is not None else GroundConfig()
    config = replace(
        config,
        links=tuple(links) or config.links,
        identity=config.identity if identity is None else identity,
        store=config.store if store is None else store,
        logs=config.logs or str(logs or ""),
    )
    check_store(config.store)
    return config


@app.command()
def doctor(
    bus: Annotated[
        str | None, typer.Option(help="CAN bus: virtual:NAME, udp:GROUP:PORT, socketcan:IFACE, slcan:DEVICE", show_default=BUS)
    ] = None,
    fleet: Annotated[Path | None, typer.Option(help="fleet file; not with --bus, --rate; without it: module 1")] = None,
    rate_hz: Annotated[int | None, typer.Option("--rate", min=50, max=400, help="tick rate, Hz", show_default=f"{RATE_HZ}")] = None,
    out: Annotated[Path, typer.Option(parser=folder_of, metavar="DIR", help="folder for the logs")] = Path(),
    warm: Annotated[bool, typer.Option("--warm", help="only compile the functions that a tick calls into the cache")] = False,
) -> None:
    """Say whether this machine and its buses are fit to fly."""
    from firmware_py.app.doctor import warm_up
    from firmware_py.app.doctor_report import examine

    if warm:
        typer.echo(f"compiled code is there, after {warm_up():.1f} s")
        return
    described = fleet_of(fleet, bus, None, rate_hz)
    raise typer.Exit(examine(described, out, say=lambda line: typer.echo(line)))


@app.command()
def parameters(
    group: Annotated[list[str] | None, typer.Argument(help="groups to print; all if none is given")] = None,
    file: Annotated[Path | None, typer.Option("--parameters", help="parameter file to print in place of the shipped values")] = None,
) -> None:
    """Print the parameters as a file for --parameters: each with its value, what is permitted, what it does, its name on MAVLink."""
    chosen = load_parameters(file) if file is not None else Parameters()
    groups = [field.name for field in fields(chosen)]
    if unknown := [name for name in group or () if name not in groups]:
        raise DescriptionError(f"group {unknown[0]!r} is unknown; {did_you_mean(unknown[0], groups)}there are {', '.join(groups)}")
    texts = [f"[{name}]\n{to_toml(getattr(chosen, name), explained)}" for name in groups if name in (group or groups)]
    typer.echo("\n".join(texts), nl=False)


@app.command()
def vehicle(
    name: Annotated[str | None, typer.Argument(help="name of a shipped vehicle, or a vehicle file; default: list the names")] = None,
) -> None:
    """Print what the controller believes about a vehicle as a file for --vehicle: each value with its unit, range and meaning."""
    typer.echo("\n".join(vehicle_names()) if name is None else to_toml(load_vehicle(name), explained).rstrip())


@app.command()
def replay(
    log: Log,
    tolerance: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="largest relative difference of numbers, for logs of another machine; 0: exact bytes")
    ] = 0.0,
) -> None:
    """Feed a recorded flight to the same code again and compare every byte; status 1 when one differs or the log is damaged."""
    from firmware_py.app.replay_report import replay_and_say

    raise typer.Exit(replay_and_say(log, tolerance, say=lambda line: typer.echo(line)))


@app.command("clear-estop")
def clear_estop(
    out: Annotated[Path, typer.Argument(parser=folder_of, help="folder for the logs, as given to `modcube run --out`")],
) -> None:
    """Clear the e-stop in which the last flight ended, where no ground station does: the next start may arm by itself again.

    For a person at the vehicle, who sees that it may move; no script and no service should.
    """
    from firmware_py.app.estop_note import clear

    was_stopped = clear(out)
    typer.echo(f"{out}: the e-stop is cleared; modcube run arms by --hold and REARM from its next start on" if was_stopped else
               f"{out}: no e-stop stands; nothing to do")  # fmt: skip


@log_app.command()
def recover(log: Log) -> None:
    """Repair a log that is torn (kill -9, power loss) or damaged: keeps the whole ticks before that, and the originals as NAME.torn."""
    from firmware_py.runtime.log_recovery import recover as mend

    ticks, torn = mend(log)
    typer.echo(f"{log}: {torn}; mended, {ticks} ticks" if torn else f"{log}: whole, {ticks} ticks; nothing to do")


def fill_standard_streams() -> None:
    """Opens /dev/null for each standard stream that the parent process closed.

    Otherwise the next file that is opened, such as a log, would take that number and receive every line that is printed.
    """
    while (handle := os.open(os.devnull, os.O_RDWR)) <= _STDERR:
        pass
    os.close(handle)


def main() -> None:
    """Runs the command line; wrong input gives one line on stderr and status 2."""
    fill_standard_streams()
    own = {command.name or command.callback.__name__ for command in app.registered_commands if command.callback is not None}
    if own.isdisjoint(sys.argv[1:2]):  # saves the vehicle's process the memory of the bench
        for entry in sorted(entry_points(group="modcube.commands"), key=lambda e: e.name):
            with ended_at_once():
                command = entry.load()
            app.add_typer(command, name=entry.name)
    try:
        status = app(prog_name="modcube", standalone_mode=False)
    except TyperException as error:
        status = _refuse(usage_error(error))
    except (DescriptionError, PortError) as error:
        status = _refuse(f"modcube: {error}")
    except OSError as error:
        if error.filename is None and error.errno not in disk.FAILURES:  # not caused by a file, folder or disk of the user
            raise
        place = f"{error.filename}: " if error.filename else ""
        status = _refuse(f"modcube: {place}{REASONS.get(error.errno or 0, error.strerror)}")
    sys.exit(status or 0)


def usage_error(error: TyperException) -> str:
    """One line: the command, what is wrong with its arguments, and the alternatives."""
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "modcube"
    known = ", ".join(getattr(context.command, "commands", ())) if context is not None else ""
    text = error.format_message()
    for kind, what in NO_NUMBER.items():
        if (detail := _detail_of(error)).get("type") == kind:
            text = text.replace(str(detail["msg"]), f"{detail['input']!r} is not {what}")
    message = " ".join(text.split()).rstrip(".") or "needs a command"
    return f"{command}: {message}; {f'there are {known}' if known else f'see {command} --help'}"


def _detail_of(error: TyperException) -> dict[str, Any]:
    """What the parser of a value says of the first thing that is wrong with it; empty for an error of another kind."""
    tell = getattr(error.__cause__, "errors", None)
    return dict(tell()[0]) if tell is not None else {}


def _refuse(line: str) -> int:
    print(line, file=sys.stderr)
    return CANNOT_RUN
