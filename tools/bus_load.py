"""Load of the CAN buses of a fleet, computed from the DBC; can also write that DBC expanded to every id of the fleet.

    .venv/bin/python tools/bus_load.py                         1, 2 and 4 modules at 100 Hz, 2 at 200 Hz, 1 at 400 Hz
    .venv/bin/python tools/bus_load.py --fleet FILE            the buses of a fleet file
    .venv/bin/python tools/bus_load.py --fleet FILE --dbc DIR  and one DBC per bus, for SavvyCAN and the like: no id mask needed

Exit status: 0 within the limits, 1 beyond one, 2 cannot run.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

from command_line import Parser, refuse, run_tool

import cantools.database

from firmware_py.bus.codec import Codec, load_database
from firmware_py.bus.load import MEAN_LIMIT, TICK_LIMIT, BusLoad, bus_load
from firmware_py.description.fleet import load_fleet
from firmware_py.description.schema import DescriptionError

USUAL = ((1, 100), (2, 100), (4, 100), (2, 200), (1, 400))
"""Modules and ticks per second that one bus must support."""


def expanded_dbc(numbers: Sequence[int]) -> str:
    """DBC with one message, NAME_number, per id that the modules `numbers` and the other nodes on their bus use.

    Raises:
        ValueError: a number is not a module number.
    """
    if wrong := [number for number in numbers if not 1 <= number <= 29]:
        raise ValueError(f"number {wrong[0]} is not a module's; 1 to 29")
    database = load_database()
    assert isinstance(database, cantools.database.can.Database)
    codec = Codec(database)
    messages: list[Any] = []
    for message in database.messages:
        known = codec.message(message.name)
        some = {"SYNC": [0], "ESTOP": [0, *numbers, 30, 31], "HEARTBEAT": [0, 30, 31]}.get(message.name, numbers)
        for number in some:
            each = deepcopy(message)
            each.frame_id = known.id_of(number)
            if number:
                each.name = f"{message.name}_{number:02d}"
            messages.append(each)
    expanded = cantools.database.can.Database(
        messages, database.nodes, version=database.version, dbc_specifics=database.dbc
    )
    return expanded.as_dbc_string()


def line(name: str, modules: int, rate_hz: int, load: BusLoad) -> str:
    """One line of the table."""
    verdict = "" if load.is_allowed else "  TOO FULL"
    return f"{name:28s} {modules:7d} {rate_hz:5d} {100 * load.mean:7.1f} {100 * load.fullest_tick:12.1f}{verdict}"


def details(load: BusLoad) -> str:
    """One line per message: its length, rate and share of the bus."""
    rows = sorted(load.messages, key=lambda m: -m.share)
    return "\n".join(f"  {m.name:20s} {m.bits:4d} bits {m.frames_per_s:7.1f} /s {100 * m.share:6.2f} %" for m in rows)


def cases(fleet_file: Path | None, rate_hz: int | None) -> list[tuple[str, list[int], int]]:
    """(name, module numbers, rate) of each bus to examine. Raises DescriptionError."""
    if fleet_file is None:
        usual = USUAL if rate_hz is None else [(modules, rate_hz) for modules in (1, 2, 4)]
        return [("", list(range(1, n + 1)), rate) for n, rate in usual]
    fleet = load_fleet(fleet_file)
    return [
        (address, [m.number for m in fleet.module if m.bus == index], rate_hz or fleet.rate_hz)
        for index, address in enumerate(fleet.buses)
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the tool; returns its exit status."""
    parser = Parser(prog="bus_load", description="bus load from the DBC")
    parser.add_argument("--fleet", type=Path, help="fleet file")
    parser.add_argument("--rate", type=int, help="tick rate, Hz, 50 to 400, in place of the fleet's")
    parser.add_argument("--dbc", type=Path, help="folder for one expanded DBC per bus")
    parser.add_argument("--details", action="store_true", help="print the bus load of each message")
    given = parser.parse_args(arguments)
    if given.rate is not None and not 50 <= given.rate <= 400:
        parser.error(f"argument --rate: {given.rate} is outside 50 to 400")
    try:
        looked_at = cases(given.fleet, given.rate)
        if given.dbc is not None:
            write_dbcs(given.dbc, looked_at)
    except (DescriptionError, ValueError, OSError) as error:
        return refuse("bus_load", error)
    codec, allowed = Codec.load(), True
    print(f"{'bus':28s} modules    Hz  mean %  fullest tick %")
    for name, numbers, rate in looked_at:
        load = bus_load(codec, numbers, rate)
        allowed &= load.is_allowed
        print(line(name, len(numbers), rate, load))
        if given.details:
            print(details(load))
    print(f"limits: mean {100 * MEAN_LIMIT:.0f} %, fullest tick {100 * TICK_LIMIT:.0f} %")
    return 0 if allowed else 1


def write_dbcs(folder: Path, looked_at: Sequence[tuple[str, list[int], int]]) -> None:
    """Writes one expanded DBC per bus, named by its index."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, (_, numbers, _) in enumerate(looked_at):
        path = folder / f"modcube_bus{index}.dbc"
        path.write_text(expanded_dbc(numbers), encoding="utf-8")
        print(f"wrote {path}")


if __name__ == "__main__":
    run_tool(main)
