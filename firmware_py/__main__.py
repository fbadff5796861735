"""The command `modcube` from its first moment on: Ctrl-C ends it without a word while it still imports, as it does later."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from firmware_py import PASSING_PLACE
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
    """Runs the command line; what takes a second or more to import is imported here."""
    if PASSING_PLACE:
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
    """Meanwhile who waits at a terminal is told when numba compiles the first function that it does not find compiled."""
    if out is None or not out.isatty():  # None: it is closed
        yield
        return
    from numba.core.event import Listener, install_listener

    class FirstCompiled(Listener):
        """Says it once."""

        told = False

        def on_start(self, event: object) -> None:
            if not self.told:
                self.told = True
                print(COMPILING, file=out, flush=True)

        def on_end(self, event: object) -> None:
            """Nobody waits any more."""

    with install_listener("numba:compile", FirstCompiled()):
        yield


if __name__ == "__main__":
    main()
