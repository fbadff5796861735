"""What a process asks of the operating system to keep its deadlines, and that it flies without whatever is refused."""

import ctypes
import errno
import gc
import os
import resource
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numba
import pytest

from firmware_py.runtime import realtime


def refuse(*_: object) -> None:
    raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))


def policy() -> int:
    return os.sched_getscheduler(0)


def test_vehicle_that_may_not_be_real_time_flies_on_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (65536, 65536))
    assert realtime.use_priority(realtime.TICK_PRIORITY).startswith("no real-time priority (Operation not permitted")
    assert realtime.lock_memory() == "memory not locked (limit of 64 KiB; needs memlock unlimited)"


def test_vehicle_on_another_system_flies_without(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_setscheduler")
    assert realtime.use_priority(1) == "no real-time priority (not Linux)"
    realtime.use_ordinary_priority()


def test_reader_threads_inherit_the_priority_and_a_bench_is_ordinary_again_afterwards() -> None:
    before = policy()
    seen: list[int] = []
    with realtime.real_time() as refused:
        thread = threading.Thread(target=lambda: seen.append(policy()))
        thread.start()
        thread.join()
        allowed = not any("priority" in line for line in refused)
    assert seen == [os.SCHED_FIFO if allowed else before]
    assert policy() == os.SCHED_OTHER


def test_kernel_joins_no_pages_of_a_process_in_real_time() -> None:
    prctl = ctypes.CDLL(None).prctl
    set_disabled, get_disabled, nothing = 41, 42, ctypes.c_ulong(0)  # PR_SET_THP_DISABLE, PR_GET_THP_DISABLE of linux/prctl.h
    assert prctl(set_disabled, nothing, nothing, nothing, nothing) == 0
    with realtime.real_time():
        assert prctl(get_disabled, nothing, nothing, nothing, nothing) == 1


def test_what_the_kernel_does_not_know_is_refused_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(realtime, "_PR_SET_THP_DISABLE", 1 << 30)
    assert realtime.use_small_pages() == "no small pages (Invalid argument)"


def test_tick_has_a_processor_to_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    places: dict[int, list[int]] = {}
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3, 1, 2})
    monkeypatch.setattr(os, "sched_setaffinity", lambda thread, processors: places.update({thread: list(processors)}))
    with realtime.beside_the_tick() as move:
        assert places[threading.get_native_id()] == [1, 2]
        move()
        assert places[0] == [3]  # the calling thread
    assert places[threading.get_native_id()] == [1, 2, 3]


def test_machine_with_one_processor_shares_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    with realtime.beside_the_tick() as move:
        move()


def test_priorities_let_the_tick_start_before_anybody_reads() -> None:
    assert realtime.TICK_PRIORITY > realtime.READER_PRIORITY > realtime.GROUND_PRIORITY > realtime.PLANT_PRIORITY


def test_no_garbage_is_collected_in_flight() -> None:
    with realtime.quiet_garbage():
        assert not gc.isenabled()
    assert gc.isenabled()


def test_compiler_whose_pages_were_given_back_still_compiles() -> None:
    realtime.release_compiler()
    twice = numba.njit("i8(i8)")(lambda number: 2 * number)
    realtime.release_compiler()
    assert twice(21) == 42


def test_libraries_are_read_to_their_end_before_the_flight_and_the_compiler_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A reader of a FIFO blocks until somebody writes it; only the library is written here, so reading another would hang.
    library, shared, compiler = (tmp_path / name for name in ("a l\udcefbrary.so", "shared", "libllvmlite.so"))
    for path in (library, shared, compiler):
        os.mkfifo(path)
    rows = [
        f"7f0000000000-7f0000001000 r-xp 00001000 08:01 17         {library}",
        f"7f0000002000-7f0000003000 r-xp 00000000 08:01 18         {tmp_path / 'gone.so (deleted)'}",
        f"7f0000004000-7f0000005000 rw-s 00000000 00:15 19         {shared}",
        f"7f0000006000-7f0000007000 r-xp 00000000 08:01 20         {compiler}",
        "7f0000008000-7f0000009000 r-xp 00000000 00:00 0          [vdso]",
        "7f000000a000-7f000000b000 r-xp 00000000 00:00 0 ",
    ]
    maps = tmp_path / "maps"
    maps.write_text("\n".join(rows), errors="surrogateescape")
    monkeypatch.setattr(realtime, "_MAPS", maps)
    written = threading.Thread(target=lambda: library.write_bytes(bytes(3_000_000)), daemon=True)
    read = threading.Thread(target=realtime.read_libraries, daemon=True)
    for thread in (written, read):
        thread.start()
    for thread in (written, read):
        thread.join(20.0)
        assert not thread.is_alive()
    monkeypatch.setattr(realtime, "_MAPS", tmp_path)
    realtime.read_libraries()  # where the system provides no list of mappings


def test_helper_whose_vehicle_has_ended_already_ends_too() -> None:
    code = "import os; from firmware_py.runtime.realtime import die_with; die_with(os.getpid())"
    assert subprocess.run([sys.executable, "-c", code]).returncode == -signal.SIGKILL
