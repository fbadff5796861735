"""What makes a process keep its deadlines: real-time priority, fine timers, locked memory in small pages, no garbage collection
while it flies.

None of it is required: what the system refuses is said in a line, and the process runs without.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

TICK_PRIORITY = 50
"""SCHED_FIFO priority of the thread that ticks: where Linux puts its own interrupt threads, above ordinary threads."""
READER_PRIORITY = 49
"""Of the threads that read the buses: a flood must not keep the tick from starting."""
GROUND_PRIORITY = 48
"""Of the thread that talks to ground stations. An ordinary one that is put off while it holds the interpreter puts the tick off too: on a
busy machine 4 ms at the 99th percentile, and 20 overruns in 2,100 ticks, where there are none so (tools/bench_ground.py)."""
PLANT_PRIORITY = 40
"""Of a simulated plant on the same machine; its reader is one below it."""

SWITCH_INTERVAL_S = 1e-4
"""Longest time that another Python thread keeps the tick waiting. Python's own 5 ms were the 99th percentile of lateness
(5.0 ms) while a reader worked through a flood of frames."""

_PR_SET_PDEATHSIG, _PR_SET_TIMERSLACK, _PR_SET_THP_DISABLE = 1, 29, 41  # linux/prctl.h
_LEAST_SLACK_NS = 1
"""Of a timer; 0 would set the system's own again."""
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # sys/mman.h
_MADV_DONTNEED = 4  # sys/mman.h
_MAPS = Path("/proc/self/maps")
_COMPILER = "libllvmlite"


@contextmanager
def real_time(priority: int = READER_PRIORITY) -> Iterator[list[str]]:
    """This process in real time, as far as the system lets it. Enter it before threads start: they inherit it.

    Args:
        priority: SCHED_FIFO priority of this thread and of those that it starts, 1..99. The thread that ticks takes
            TICK_PRIORITY for itself when its readers run.

    Yields:
        One line for each thing that the system refused; empty when all is well.
    """
    switch_interval_s = sys.getswitchinterval()
    sys.setswitchinterval(min(switch_interval_s, SWITCH_INTERVAL_S))
    refused = [line for line in (use_fine_timers(), use_small_pages(), lock_memory(), use_priority(priority)) if line]
    try:
        yield [f"{line}: ticks may start later than they could" for line in refused]
    finally:
        sys.setswitchinterval(switch_interval_s)
        use_ordinary_priority()
        unlock_memory()


def use_priority(priority: int) -> str:
    """SCHED_FIFO for this thread, and for the threads that it starts from now on; "" or why not."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return f"no real-time priority ({error.strerror}; needs CAP_SYS_NICE or an rtprio limit of {priority})"
    except AttributeError:
        return "no real-time priority (not Linux)"
    return ""


@contextmanager
def beside_the_tick() -> Iterator[Callable[[], None]]:
    """The threads of this process, and those that are started inside, leave its last processor to the tick.

    Yields:
        A function that moves the calling thread there. Both do nothing where there is but one processor.
    """
    allowed = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if len(allowed) < 2:
        yield lambda: None
        return
    _place_threads(allowed[:-1])
    try:
        yield lambda: os.sched_setaffinity(0, allowed[-1:])
    finally:
        _place_threads(allowed)


def _place_threads(processors: Sequence[int]) -> None:
    for thread in os.listdir("/proc/self/task"):
        with suppress(ProcessLookupError):
            os.sched_setaffinity(int(thread), processors)


def use_ordinary_priority() -> None:
    """Back to an ordinary thread: for a process started from a real-time one, which would inherit its priority."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def use_fine_timers() -> str:
    """Timers of this thread, and of those that it starts, fire on time instead of up to 50 us late; "" or why not.

    Threads of real-time priority have no slack anyway: this is for those that may not have it.
    """
    return _ask_kernel("fine timers", _PR_SET_TIMERSLACK, _LEAST_SLACK_NS)


def use_small_pages() -> str:
    """From here on the kernel joins no pages of this process to huge ones; "" or why it does.

    Its thread that joins them, of the lowest priority, keeps the process's address space to itself meanwhile. Who needs memory
    waits for it, and it for a processor: in a flood on one processor up to 3.6 s (measured in hil/guest, every 10 s or so).
    """
    return _ask_kernel("small pages", _PR_SET_THP_DISABLE, 1)


def die_with(parent: int) -> None:
    """This process is killed when the thread of the process `parent` that started it ends, however that ends."""
    _ask_kernel("end with its parent", _PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before it was asked
        os.kill(os.getpid(), signal.SIGKILL)


def _ask_kernel(what: str, option: int, value: int) -> str:
    """Asks for `what` by prctl; "" or why not."""
    prctl = getattr(ctypes.CDLL(None, use_errno=True), "prctl", None)
    if prctl is None:
        return f"no {what} (not Linux)"
    words = [ctypes.c_ulong(word) for word in (value, 0, 0, 0)]
    return "" if prctl(option, *words) == 0 else f"no {what} ({os.strerror(ctypes.get_errno())})"


def release_compiler() -> None:
    """Gives the pages of the compiler's own instructions back: 50 MB that no tick needs, for every function is compiled by now.

    They are a file's, never written: who compiles again after all reads them again. Its constants stay: some hold addresses
    that were written when it was loaded.
    """
    for begin, end, library in _instructions():
        if _COMPILER in library:
            ctypes.CDLL(None).madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_DONTNEED)


def read_libraries() -> None:
    """Reads the libraries of this process, 190 MB, into the system's cache: 0.1 s when they are there, as long as the disk takes when not.

    Without, a tick waits for the disk whenever it first needs a page: from a disk that took 0.3 s for one, the fifth tick was 0.23 s
    late, and nobody could arm the robot for the next three seconds. The compiler is left out, for nothing is compiled in flight.
    """
    chunk = bytearray(1 << 20)
    for library in {library for _, _, library in _instructions() if _COMPILER not in library}:
        with suppress(OSError), open(library, "rb", buffering=0) as file:
            while file.readinto(chunk):
                pass


def _instructions() -> list[tuple[int, int, str]]:
    """Begin, end and file of what this process has mapped to run; empty where the system does not tell."""
    found = []
    with suppress(OSError):
        for line in _MAPS.read_text(errors="surrogateescape").splitlines():
            span, rights, _, _, inode, *name = line.split(maxsplit=5)
            if rights == "r-xp" and inode != "0" and not name[0].startswith("/dev/"):
                begin, end = (int(word, 16) for word in span.split("-"))
                found.append((begin, end, name[0]))
    return found


def lock_memory() -> str:
    """What this process has touched stays in memory, now and from now on; "" or why not.

    With a limit on locked memory nothing is locked: later allocations would fail.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and os.geteuid() != 0:
        return f"memory not locked (limit of {soft // 1024} KiB; needs memlock unlimited)"
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0:
            return ""
        return f"memory not locked ({os.strerror(ctypes.get_errno())})"
    except AttributeError:
        return "memory not locked (not Linux)"


def unlock_memory() -> None:
    """Ends `lock_memory`: a bench goes on after its flight."""
    munlockall = getattr(ctypes.CDLL(None), "munlockall", None)
    if munlockall is not None:
        munlockall()


@contextmanager
def quiet_garbage() -> Iterator[None]:
    """No garbage collection inside: the ticks leave no cycles behind, and what was left before is collected first."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
