"""Handling of Ctrl-C, and of SIGTERM alike: it ends a command with one line, however often it is pressed, and leaves a whole log."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130
"""Exit status after Ctrl-C: 128 + SIGINT, as in a shell."""
ENDINGS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a command: from its terminal, and from elsewhere."""


def endings_of_a_run() -> list[signal.Signals]:
    """ENDINGS and SIGHUP (the terminal ended, as when an ssh connection is lost), unless the parent process made SIGHUP ignored."""
    return [*ENDINGS] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [*ENDINGS, signal.SIGHUP]


@contextmanager
def handled(handler: Callable[[int, FrameType | None], object], numbers: Iterable[signal.Signals] = ENDINGS) -> Iterator[None]:
    """Inside, routes these signals to `handler`; restores the previous handlers afterwards."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, handler_before in before.items():
            signal.signal(number, handler_before)


@contextmanager
def ended_at_once() -> Iterator[None]:
    """Ctrl-C inside ends the process at once and silently: for imports, which need no cleanup.

    While compiled code is loaded, LLVM calls back into Python; an exception there is swallowed, and the process crashes (SIGSEGV).
    """
    with handled(lambda number, frame: os._exit(INTERRUPTED), [signal.SIGINT] if _is_heard() else []):
        yield


@contextmanager
def interrupted_once() -> Iterator[None]:
    """The first Ctrl-C or SIGTERM inside raises KeyboardInterrupt; further ones, also afterwards, are ignored: the process is ending.

    If a library turned the KeyboardInterrupt into another exception (compiled code knows only that its callback failed) or swallowed it,
    the block still ends with KeyboardInterrupt.
    """
    pressed = False

    def press(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if not pressed:
            pressed = True
            raise KeyboardInterrupt

    before = {number: signal.signal(number, press) for number in ENDINGS if _is_heard(number) or _would_kill(number)}
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
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if pressed else handler)


@contextmanager
def interrupts_deferred() -> Iterator[Callable[[], None]]:
    """Defers Ctrl-C inside until the next call of the yielded function, or the end of the block, so that nothing is left half written.

    Defers SIGTERM too inside `interrupted_once`; elsewhere SIGTERM kills the process as usual.
    """
    pressed: list[int] = []
    handlers = {number: signal.getsignal(number) for number in ENDINGS if _is_heard(number)}

    def check() -> None:
        """Calls the previous handler, which raises KeyboardInterrupt, if Ctrl-C was pressed."""
        for number in pressed[:1]:
            handler = handlers[signal.Signals(number)]
            assert callable(handler)
            handler(number, None)

    with handled(lambda number, frame: pressed.append(number), handlers):
        yield check
    check()


@contextmanager
def signals_blocked(numbers: Iterable[signal.Signals] = ENDINGS) -> Iterator[None]:
    """Blocks these signals in this thread: a child process started inside never receives them; this process receives them afterwards.

    Start multiprocessing's resource tracker before, as its queues and semaphores do: its start unblocks ENDINGS.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _is_heard(number: signal.Signals = signal.SIGINT) -> bool:
    """Whether this thread's Python handles a signal: only the main thread does, and a shell's background jobs ignore Ctrl-C."""
    return threading.current_thread() is threading.main_thread() and callable(signal.getsignal(number))


def _would_kill(number: signal.Signals) -> bool:
    """Whether a signal has its default action in the main thread, which ends the process without any Python code."""
    return threading.current_thread() is threading.main_thread() and signal.getsignal(number) is signal.SIG_DFL
