"""All of `modcube doctor`: the machine, each bus of the fleet, and the exit status."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from firmware_py.app.doctor import FAILED, Finding, check_interface, check_machine, lines_of, show_link
from firmware_py.app.doctor_bus import judge, look_at
from firmware_py.bus.codec import Codec
from firmware_py.bus.port import PortError, check_kind, open_port
from firmware_py.description.fleet import Fleet

UNFIT = 1
"""Exit status when a check failed."""


def examine(fleet: Fleet, folder: Path, say: Callable[[str], None]) -> int:
    """Prints the findings; returns the exit status. Raises PortError for a bus of no known kind."""
    for address in fleet.buses:
        check_kind(address)
    codec = Codec.load()
    findings = check_machine(folder)
    for index, address in enumerate(fleet.buses):
        numbers = [module.number for module in fleet.module if module.bus == index]
        findings += list(check_bus(address, numbers, fleet.rate_hz, codec, time.sleep))
    for line in lines_of(findings):
        say(line)
    return UNFIT if any(finding.state == FAILED for finding in findings) else 0


def check_bus(
    address: str, numbers: list[int], rate_hz: int, codec: Codec, wait: Callable[[float], None]
) -> Iterator[Finding]:
    """Checks one bus: its interface, then its traffic."""
    kind, _, name = address.partition(":")
    title = f"bus {name if kind == 'socketcan' else address}"
    if kind == "socketcan":
        interface = check_interface(name, show_link)
        yield interface
        if interface.state == FAILED:
            return
    try:
        with open_port(address) as port:
            seen = look_at(port, codec, rate_hz, wait)
    except PortError as error:
        yield Finding(title, FAILED, str(error), "see --bus, and the fleet file")
        return
    yield from judge(title, seen, numbers, rate_hz, codec)
