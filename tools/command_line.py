"""For the tools: how a command line ends: errors in one line, Ctrl-C silently.

A tool imports this module before anything that is slow to import: from then on Ctrl-C ends it silently.
"""

from __future__ import annotations

import argparse
import errno
import math
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

REASONS = {errno.EEXIST: "is a file; a folder is needed"}
"""Replacements for system error messages that do not say what is needed."""
NO_VALUES: tuple[object, ...] = (None, argparse.SUPPRESS, "", [], math.inf)
"""Defaults that stand for nothing, or for no limit."""
INTERRUPTED = 130
"""Exit status after Ctrl-C: 128 + SIGINT, as in a shell."""


class _Help(argparse.RawDescriptionHelpFormatter):
    """Shows the description as written, and behind the text of an option the value that it has when it is left out."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text, default = action.help or "", action.default
        if action.nargs == 0 or default in NO_VALUES or "default" in text:
            return text
        values = default if isinstance(default, list) else [default]
        return f"{text} [default: {' '.join(map(str, values)).replace('%', '%%')}]"


class Parser(argparse.ArgumentParser):
    """Reports wrong arguments in one line with exit status 2. Shows its description as written."""

    def __init__(self, **how: Any) -> None:
        super().__init__(formatter_class=_Help, **how)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog.removesuffix('.py')}: {message}; see --help\n")


def refuse(tool: str, error: Exception) -> int:
    """Prints an error in one line, for a system error the file name first. Returns the exit status of a tool that cannot run."""
    words = str(error)
    if isinstance(error, OSError) and error.filename is not None:
        words = f"{error.filename}: {REASONS.get(error.errno or 0, error.strerror)}"
    print(f"{tool}: {words}", file=sys.stderr)
    return 2


def _end_at_once(number: int, frame: FrameType | None) -> NoReturn:
    """Handles SIGINT during a tool's imports: nothing needs cleaning up, and some imported packages would swallow an exception."""
    os._exit(INTERRUPTED)


def _is_tool(program: object) -> bool:
    """Whether the running program is a tool, not a test that imports one or a process that a tool started."""
    return Path(getattr(program, "__file__", None) or "/").resolve().parent == Path(__file__).resolve().parent


if _is_tool(sys.modules["__main__"]) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _end_at_once)


def run_tool(main: Callable[[], int | None]) -> NoReturn:
    """Exits with the status that the tool's `main` returns; Ctrl-C ends it silently."""
    if signal.getsignal(signal.SIGINT) is _end_at_once:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        sys.exit(INTERRUPTED)
