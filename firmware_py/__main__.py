"""Entry point of the command `modcube`. Ctrl-C ends it silently, already while it imports."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from firmware_py import TEMPORARY_CACHE
from firmware_py.runtime import disk
from firmware_py.runtime.interrupts import INTERRUPTED, ended_at_once

COMPILING = "modcube: compiles its numeric code, once, in a minute or so"
COMPILED_IN_PASSING = (
    "modcube: nobody may write beside the code nor in the home: "
    "every start compiles the numeric code, in a minute or so (set NUMBA_CACHE_DIR to a folder that stays)"
)
NO_PLACE = "modcube: no folder takes compiled code: set NUMBA_CACHE_DIR to one that can be written"
NO_ROOM = "modcube: compiled code cannot be kept: {}; make room on that disk, or set NUMBA_CACHE_DIR to a folder on another"


def main() -> None:
    """Runs the command line. Imports that take a second or more are made here."""
    if TEMPORARY_CACHE:
        print(COMPILED_IN_PASSING, file=sys.stderr, flush=True)
    try:
        with compiling_told(sys.stderr):
            with ended_at_once():
                from firmware_py.cli import main as run

            run()
    except RuntimeError as error:
        if "no locator available" not in str(error):
            raise
        print(NO_PLACE, file=sys.stderr)
        sys.exit(2)
    except OSError as error:
        if error.errno not in disk.FAILURES:
            raise
        print(NO_ROOM.format(error.strerror), file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        sys.exit(INTERRUPTED)


@contextmanager
def compiling_told(out: TextIO | None) -> Iterator[None]:
    """Inside, prints COMPILING to `out`, if it is a terminal, when numba compiles the first function that is not in its cache."""
    if out is None or not out.isatty():  # None: the stream is closed
        yield
        return
    from numba.core.event import Listener, install_listener

    class FirstCompiled(Listener):
        """Prints COMPILING once."""

        told = False

        def on_start(self, event: object) -> None:
            if not self.told:
                self.told = True
                print(COMPILING, file=out, flush=True)

        def on_end(self, event: object) -> None:
            """Required by Listener; does nothing."""

    with install_listener("numba:compile", FirstCompiled()):
        yield


if __name__ == "__main__":
    main()
