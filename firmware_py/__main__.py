"""The command `modcube` from its first moment on: Ctrl-C ends it without a word while it still imports, as it does later."""

from __future__ import annotations

import sys

INTERRUPTED = 130
"""Exit status after Ctrl-C: 128 and SIGINT, as a shell has it."""


def main() -> None:
    """Runs the command line; what takes a second or more to import is imported here."""
    try:
        from firmware_py.cli import main as run

        run()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
