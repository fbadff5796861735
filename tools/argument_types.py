"""For the command lines of the tools: argument types and output folders, each rejected with a one-line message."""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import typer
from typer.exceptions import TyperException

from firmware_py.description.fleet import Module
from firmware_py.description.schema import DescriptionError, limits_of
from hil.replaceable import check_replaceable, created_folder, is_json_with

CELLS = limits_of(Module, "cell")
"""Permitted places of a cell along each axis."""


def whole(least: int) -> Callable[[str], int]:
    """Returns a parser of whole numbers not below `least`."""

    def read(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number {'above zero' if least == 1 else f'from {least} on'}")
        return int(text)

    return read


def positive(text: str) -> float:
    """Parses a finite number above zero."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above zero")
    return value


def cells_in(text: str) -> list[tuple[int, int, int]]:
    """Parses lattice cells such as "0,0,0 1,0,0", at least one, with the places that a fleet file may hold. Raises ValueError."""
    cells = [(int(x), int(y), int(z)) for x, y, z in (word.split(",") for word in text.replace(";", " ").split())]
    if not cells or not all(CELLS.permits(place) for cell in cells for place in cell):
        raise ValueError
    return cells


def run_command(app: typer.Typer, name: str) -> int:
    """Runs the tool called `name`; returns its exit status. Wrong arguments and a DescriptionError give one line on stderr and status 2."""
    try:
        return int(app(prog_name=name, standalone_mode=False) or 0)
    except TyperException as error:
        line = " ".join(error.format_message().split())
    except DescriptionError as error:
        line = str(error)
    print(f"{name}: {line}", file=sys.stderr)
    return 2


@contextmanager
def folder_for_results(out: Path | None) -> Iterator[None]:
    """Creates the folder `out` for a tool's results, if given, and checks that it is writable before the minutes of work start. Folders
    that it created are removed again if they are empty at the end. Raises DescriptionError.
    """
    with ExitStack() as stack:
        if out is not None:
            with suppress(OSError):  # _try_folder reports the cause
                stack.enter_context(created_folder(out))
            _try_folder(out, out)
        yield


def check_results(out: Path, key: str, *results: str) -> None:
    """Raises DescriptionError where `out` holds `results` but no earlier run left them: then the first of them would be JSON with `key`."""
    check_replaceable(out, results, is_json_with(out / results[0], key), "earlier run")


def make_room(out: Path) -> None:
    """Creates the folder of the file `out` and checks that it is writable. Raises DescriptionError."""
    try:
        if out.is_dir():
            raise DescriptionError(f"--out {out}: is a folder; a file is needed")
    except OSError as error:  # the name is too long
        raise DescriptionError(f"--out {out}: cannot be written: {error.strerror}") from None
    _try_folder(out.parent, out)


def check_folder(option: str, folder: Path) -> None:
    """Creates the folder that `option` names and checks that it is writable. Raises DescriptionError."""
    _try_folder(folder, folder, option)


def _try_folder(folder: Path, given: Path, option: str = "--out") -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except FileExistsError:
        raise DescriptionError(f"{option} {given}: {folder} is a file; a folder is needed") from None
    except OSError as error:
        raise DescriptionError(f"{option} {given}: cannot be written: {error.strerror}") from None
