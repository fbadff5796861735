"""Settings with which a process keeps its deadlines: real-time priority, fine timers, locked memory in small pages, no garbage
collection in flight.

None is required: each setting that the system refuses is reported in one line, and the process runs without it.
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
"""SCHED_FIFO priority of the tick's thread: that of Linux's own interrupt threads, above ordinary threads."""
READER_PRIORITY = 49
"""Priority of the threads that read the buses, below the tick's so that a flood cannot keep the tick from starting."""
GROUND_PRIORITY = 48
"""Priority of the thread that talks to ground stations. An ordinary thread that is preempted while it holds the interpreter delays the
tick too: on a busy machine by 4 ms at the 99th percentile, with 20 overruns in 2,100 ticks; with this priority there are none
(tools/bench_ground.py)."""
PLANT_PRIORITY = 40
"""Priority of a simulated plant on the same machine; its reader is one below it."""

SWITCH_INTERVAL_S = 1e-4
"""Longest time that another Python thread keeps the tick waiting. With Python's default of 5 ms, the 99th percentile of lateness was
5.0 ms while a reader worked through a flood of frames."""

_PR_SET_PDEATHSIG, _PR_SET_TIMERSLACK, _PR_SET_THP_DISABLE = 1, 29, 41  # linux/prctl.h
_LEAST_SLACK_NS = 1
"""Smallest timer slack; 0 would restore the system's default."""
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # sys/mman.h
_MADV_DONTNEED = 4  # sys/mman.h
_MAPS = Path("/proc/self/maps")
_COMPILER = "libllvmlite"


@contextmanager
def real_time(priority: int = READER_PRIORITY) -> Iterator[list[str]]:
    """Runs this process in real time, as far as the system permits. Enter it before threads start, because they inherit the settings.

    Args:
        priority: SCHED_FIFO priority of this thread and of those that it starts, 1..99. The tick's thread takes TICK_PRIORITY
            itself once its readers run.

    Yields:
        One line for each setting that the system refused; empty if none.
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
    """Sets SCHED_FIFO for this thread, and for the threads that it starts from now on; returns "" or why it could not."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return f"no real-time priority ({error.strerror}; needs CAP_SYS_NICE or an rtprio limit of {priority})"
    except AttributeError:
        return "no real-time priority (not Linux)"
    return ""


@contextmanager
def beside_the_tick() -> Iterator[Callable[[], None]]:
    """Keeps the threads of this process, and those started inside, off its last processor, which is reserved for the tick.

    Yields:
        A function that moves the calling thread to that processor. Both do nothing on a single processor.
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
    """Resets this thread to ordinary scheduling: for a process started from a real-time one, which would inherit its priority."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def use_fine_timers() -> str:
    """Makes timers of this thread, and of those that it starts, fire on time instead of up to 50 us late; "" or why it could not.

    Threads of real-time priority have no slack anyway: this is for threads that are refused that priority.
    """
    return _ask_kernel("fine timers", _PR_SET_TIMERSLACK, _LEAST_SLACK_NS)


def use_small_pages() -> str:
    """Stops the kernel from merging pages of this process into huge pages; "" or why it could not.

    The kernel thread that merges them has the lowest priority and locks the process's address space meanwhile. A thread that needs memory
    waits for it, and it waits for a processor: in a flood on one processor up to 3.6 s (measured in hil/guest, every 10 s or so).
    """
    return _ask_kernel("small pages", _PR_SET_THP_DISABLE, 1)


def die_with(parent: int) -> None:
    """Makes the kernel kill this process when the thread of the process `parent` that started it ends, for whatever reason."""
    _ask_kernel("end with its parent", _PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # the parent ended before the call
        os.kill(os.getpid(), signal.SIGKILL)


def _ask_kernel(what: str, option: int, value: int) -> str:
    """Requests `what` by prctl; returns "" or why it could not."""
    prctl = getattr(ctypes.CDLL(None, use_errno=True), "prctl", None)
    if prctl is None:
        return f"no {what} (not Linux)"
    words = [ctypes.c_ulong(word) for word in (value, 0, 0, 0)]
    return "" if prctl(option, *words) == 0 else f"no {what} ({os.strerror(ctypes.get_errno())})"


def release_compiler() -> None:
    """Releases the pages of the compiler's code: 50 MB that no tick needs, because every function is compiled by now.

    The pages are file-backed and never written, so a later compilation reads them again. The compiler's constants stay: some hold
    addresses that were written when it was loaded.
    """
    for begin, end, library in _instructions():
        if _COMPILER in library:
            ctypes.CDLL(None).madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_DONTNEED)


def read_libraries() -> None:
    """Reads the libraries of this process, 190 MB, into the page cache: 0.1 s if they are cached, otherwise as long as the disk takes.

    Otherwise a tick waits for the disk whenever it first needs a page: with a disk that took 0.3 s for one, the fifth tick was 0.23 s
    late, and the robot could not be armed for the next three seconds. Skips the compiler, because nothing is compiled in flight.
    """
    chunk = bytearray(1 << 20)
    for library in {library for _, _, library in _instructions() if _COMPILER not in library}:
        with suppress(OSError), open(library, "rb", buffering=0) as file:
            while file.readinto(chunk):
                pass


def _instructions() -> list[tuple[int, int, str]]:
    """Begin, end and file of each executable mapping of this process; empty where the system does not list them."""
    found = []
    with suppress(OSError):
        for line in _MAPS.read_text(errors="surrogateescape").splitlines():
            span, rights, _, _, inode, *name = line.split(maxsplit=5)
            if rights == "r-xp" and inode != "0" and not name[0].startswith("/dev/"):
                begin, end = (int(word, 16) for word in span.split("-"))
                found.append((begin, end, name[0]))
    return found


def lock_memory() -> str:
    """Locks the pages that this process has touched or will touch in memory; "" or why it could not.

    With a limit on locked memory nothing is locked, because later allocations would fail.
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
    """Undoes `lock_memory`, for a bench that continues after its flight."""
    munlockall = getattr(ctypes.CDLL(None), "munlockall", None)
    if munlockall is not None:
        munlockall()


@contextmanager
def quiet_garbage() -> Iterator[None]:
    """Disables garbage collection inside, after one collection: the ticks create no reference cycles."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
