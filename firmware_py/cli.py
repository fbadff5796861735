"""The command `modcube`. Other packages add their own commands through the entry point group `modcube.commands`."""

from __future__ import annotations

import sys
from importlib.metadata import entry_points

import typer

from firmware_py.bus.port import PortError
from firmware_py.description.schema import DescriptionError

CANNOT_RUN = 2
"""Exit status when nothing could be started: wrong usage, no such bus, a file that is wrong."""

app = typer.Typer(
    help="Controller of a self-reconfigurable underwater robot.", no_args_is_help=True, pretty_exceptions_enable=False
)


@app.callback()
def modcube() -> None:
    """Controller of a self-reconfigurable underwater robot."""


def main() -> None:
    """Runs the command line; wrong input ends in one line on stderr and status 2."""
    for entry in sorted(entry_points(group="modcube.commands"), key=lambda e: e.name):
        app.add_typer(entry.load(), name=entry.name)
    try:
        app()
    except (DescriptionError, PortError) as error:
        print(f"modcube: {error}", file=sys.stderr)
        sys.exit(CANNOT_RUN)
