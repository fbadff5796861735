"""For the tools: how a command line ends: what is wrong in one line, and Ctrl-C without a word, in its processes too."""

from __future__ import annotations

import argparse
import errno
import os
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context
from typing import NoReturn

REASONS = {errno.EEXIST: "is a file; a folder is needed"}
"""In place of the system's words, where these do not say what would be right."""
INTERRUPTED = 130
"""Exit status after Ctrl-C: 128 and SIGINT, as a shell has it."""


class Parser(argparse.ArgumentParser):
    """Says what is wrong with the arguments in one line; exit status 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog.removesuffix('.py')}: {message}; see --help\n")


def in_words(error: Exception) -> str:
    """What is wrong, in one line; of a file that the system refuses, its name first."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {REASONS.get(error.errno or 0, error.strerror)}"
    return str(error)


def run_tool(main: Callable[[], int | None]) -> NoReturn:
    """Ends with what the tool's `main` returns; Ctrl-C ends it in silence."""
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


@contextmanager
def worker_pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """So many processes. Ctrl-C, which a terminal sends to them too, they leave to the tool, which ends them with what they do."""
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by all that is started here
        try:
            for _ in range(jobs):
                pool.submit(os.getpid)  # starts a process
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in active_children():
                child.terminate()
            raise
