"""Ctrl-C: it ends a command in one line, however often it is pressed, and leaves a log that is whole."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130
"""Exit status after Ctrl-C: 128 and SIGINT, as a shell has it."""


@contextmanager
def ended_at_once() -> Iterator[None]:
    """Ctrl-C inside ends the process there and then, without a word: for imports, which leave nothing behind.

    While compiled code is loaded LLVM calls Python back; an exception in there is swallowed, and the process crashes (SIGSEGV).
    """
    if not _is_heard():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: os._exit(INTERRUPTED))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def interrupted_once() -> Iterator[None]:
    """The first Ctrl-C inside raises KeyboardInterrupt, and no other does, nor any after that: who was interrupted is ending.

    What a library has made of it (compiled code that was called back knows only that something failed) leaves as KeyboardInterrupt too,
    and at the end one that was lost on the way.
    """
    pressed = False

    def press(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if not pressed:
            pressed = True
            raise KeyboardInterrupt

    if not _is_heard():
        yield
        return
    before = signal.signal(signal.SIGINT, press)
    try:
        yield
    except Exception:
        if pressed:
            raise KeyboardInterrupt from None
        raise
    else:
        if pressed:
            raise KeyboardInterrupt
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN if pressed else before)


@contextmanager
def held_back() -> Iterator[Callable[[], None]]:
    """Ctrl-C inside waits for the next call of what this gives, or for the end, and comes about there: nothing is left half written."""
    pressed: list[int] = []
    if not _is_heard():
        yield lambda: None
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))

    def check() -> None:
        """Raises KeyboardInterrupt where Ctrl-C was pressed."""
        if pressed and callable(before):
            before(signal.SIGINT, None)

    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
    check()


@contextmanager
def out_of_reach() -> Iterator[None]:
    """A process that is started inside never hears of Ctrl-C; this one hears of it afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _is_heard() -> bool:
    """Whether Ctrl-C comes to this thread's Python: others get no signals, and what a shell runs in the background ignores it."""
    return threading.current_thread() is threading.main_thread() and callable(signal.getsignal(signal.SIGINT))
