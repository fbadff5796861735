"""Ctrl-C, and SIGTERM as it: it ends a command in one line, however often it is pressed, and leaves a log that is whole."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130
"""Exit status after Ctrl-C: 128 and SIGINT, as a shell has it."""
ENDINGS = (signal.SIGINT, signal.SIGTERM)
"""What somebody ends a command with: at its terminal, and from elsewhere."""


def endings_of_a_run() -> list[signal.Signals]:
    """Besides ENDINGS its terminal's end, as of an ssh connection that is lost, unless whoever started the process has it ignore that."""
    return [*ENDINGS] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [*ENDINGS, signal.SIGHUP]


@contextmanager
def handled(handler: Callable[[int, FrameType | None], object], numbers: Iterable[signal.Signals] = ENDINGS) -> Iterator[None]:
    """These signals go to `handler` inside, and afterwards to whoever had them."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, handler_before in before.items():
            signal.signal(number, handler_before)


@contextmanager
def ended_at_once() -> Iterator[None]:
    """Ctrl-C inside ends the process there and then, without a word: for imports, which leave nothing behind.

    While compiled code is loaded LLVM calls Python back; an exception in there is swallowed, and the process crashes (SIGSEGV).
    """
    with handled(lambda number, frame: os._exit(INTERRUPTED), [signal.SIGINT] if _is_heard() else []):
        yield


@contextmanager
def interrupted_once() -> Iterator[None]:
    """The first Ctrl-C or SIGTERM inside raises KeyboardInterrupt, and no other does, nor any after that: who was interrupted is ending.

    What a library has made of it (compiled code that was called back knows only that something failed) leaves as KeyboardInterrupt too,
    and at the end one that was lost on the way.
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
def held_back() -> Iterator[Callable[[], None]]:
    """Ctrl-C inside waits for the next call of what this gives, or for the end, and comes about there: nothing is left half written.

    So does SIGTERM inside `interrupted_once`; elsewhere it kills, as ever.
    """
    pressed: list[int] = []
    handlers = {number: signal.getsignal(number) for number in ENDINGS if _is_heard(number)}

    def check() -> None:
        """Raises KeyboardInterrupt where Ctrl-C was pressed."""
        for number in pressed[:1]:
            handler = handlers[signal.Signals(number)]
            assert callable(handler)
            handler(number, None)

    with handled(lambda number, frame: pressed.append(number), handlers):
        yield check
    check()


@contextmanager
def out_of_reach() -> Iterator[None]:
    """A process that is started inside never hears of Ctrl-C and SIGTERM; this one hears of them afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDINGS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _is_heard(number: signal.Signals = signal.SIGINT) -> bool:
    """Whether a signal comes to this thread's Python: others get none, and what a shell runs in the background ignores Ctrl-C."""
    return threading.current_thread() is threading.main_thread() and callable(signal.getsignal(number))


def _would_kill(number: signal.Signals) -> bool:
    """Whether a signal would end this process before this thread's Python hears of it."""
    return threading.current_thread() is threading.main_thread() and signal.getsignal(number) is signal.SIG_DFL
