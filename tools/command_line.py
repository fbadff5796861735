"""For the tools: how a command line ends: what is wrong in one line, and Ctrl-C without a word.

A tool imports this before all that takes long to import: from here on Ctrl-C ends it without a word.
"""

from __future__ import annotations

import argparse
import errno
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

REASONS = {errno.EEXIST: "is a file; a folder is needed"}
"""In place of the system's words, where these do not say what would be right."""
INTERRUPTED = 130
"""Exit status after Ctrl-C: 128 and SIGINT, as a shell has it."""


class Parser(argparse.ArgumentParser):
    """Says what is wrong with the arguments in one line; exit status 2. Its description is shown as it is written."""

    def __init__(self, **how: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, **how)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog.removesuffix('.py')}: {message}; see --help\n")


def refuse(tool: str, error: Exception) -> int:
    """Says what is wrong, in one line; of a file that the system refuses, its name first. The exit status of a tool that cannot run."""
    words = str(error)
    if isinstance(error, OSError) and error.filename is not None:
        words = f"{error.filename}: {REASONS.get(error.errno or 0, error.strerror)}"
    print(f"{tool}: {words}", file=sys.stderr)
    return 2


def _end_at_once(number: int, frame: FrameType | None) -> NoReturn:
    """Of a tool that is still being imported: it leaves nothing behind, and an exception would be lost in some of what it imports."""
    os._exit(INTERRUPTED)


def _is_tool(program: object) -> bool:
    """Whether the program that runs is a tool: not a test that imports one, and none of the processes that a tool starts."""
    return Path(getattr(program, "__file__", None) or "/").resolve().parent == Path(__file__).resolve().parent


if _is_tool(sys.modules["__main__"]) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _end_at_once)


def run_tool(main: Callable[[], int | None]) -> NoReturn:
    """Ends with what the tool's `main` returns; Ctrl-C ends it in silence."""
    if signal.getsignal(signal.SIGINT) is _end_at_once:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
