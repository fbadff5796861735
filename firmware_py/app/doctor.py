"""`modcube doctor`: checks whether this machine and its buses are fit to fly, and advises what to do.

Changes nothing; on a bus without SYNC it sends a few SYNC frames, which move no thruster.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from firmware_py.bus.load import BIT_RATE
from firmware_py.description.schema import DescriptionError
from firmware_py.runtime.realtime import real_time

OK, WARNING, FAILED = "ok", "warn", "FAIL"
SPARE_BYTES, NEEDED_BYTES = 2_000_000_000, 200_000_000
"""Free disk space for logs: an hour takes 600 MB (0.17 MB/s measured at 100 Hz)."""
STEADY_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock")
EARLIEST_YEAR = 2024
"""Earliest plausible date: a Jetson without a clock battery starts in 1970."""
SLOW_IMPORT_S = 8.0
"""Longest time to import the tick's code when all of it is compiled and cached."""
WARM_MODULES = ("firmware_py.app.vehicle_process", "firmware_py.app.firmware")
"""Modules whose import compiles everything that a tick calls, or loads it from the cache."""


class Finding(NamedTuple):
    """Result of one check; `advice` says what to do when it is not ok."""

    name: str
    state: str
    text: str
    advice: str = ""


Look = Callable[[str], str]
"""Returns the text of a file; empty where there is none."""


def read_file(path: str) -> str:
    """Text of a file in /proc or /sys; empty where there is none."""
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def check_machine(folder: Path) -> list[Finding]:
    """Runs every check but those of the buses. `folder` is where logs go."""
    return [
        check_kernel(read_file),
        *check_permissions(),
        check_governor(read_file),
        check_throttle(read_file, os.cpu_count() or 1),
        check_clock(read_file, time.gmtime().tm_year),
        check_logs(folder),
        check_cache(),
    ]


def check_kernel(look: Look) -> Finding:
    """Checks the kernel for PREEMPT_RT."""
    release = f"Linux {platform.release()} {platform.machine()}"
    if look("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in platform.version():
        return Finding("kernel", OK, f"{release}, PREEMPT_RT")
    advice = "ticks may be late by milliseconds under load; on a Jetson: apt-get install nvidia-l4t-rt-kernel"
    return Finding("kernel", WARNING, f"{release}, without PREEMPT_RT", advice)


def check_permissions() -> Iterator[Finding]:
    """Checks real-time priority, fine timers, small pages and locked memory by trying them."""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    with real_time() as refused:
        pass
    if not refused:
        by = f"rtprio {limit}" if limit > 0 else "by privilege, not by rtprio"
        yield Finding("real time", OK, f"priority, timers, small pages and locked memory are granted ({by})")
    for line in refused:
        yield Finding(
            "real time", WARNING, line, "run it as modcube.service, or raise rtprio and memlock in limits.conf"
        )


def check_governor(look: Look) -> Finding:
    """Checks the frequency scaling of the processors."""
    governor = look("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    text = f"{os.cpu_count()} processors, governor {governor or 'none'}"
    if governor in ("", "performance"):
        return Finding("processors", OK, text)
    return Finding("processors", WARNING, text, "clocks rise too late: sudo jetson_clocks, or governor performance")


def check_throttle(look: Look, processors: int) -> Finding:
    """Checks the share of time that the kernel allows real-time threads. A reader that works through a flood takes a whole processor;
    on a processor shared with it, the tick was held up for 15 to 20 ms (measured in a flood of cangen).
    """
    runtime, period = (int(look(f"/proc/sys/kernel/sched_rt_{name}_us") or -1) for name in ("runtime", "period"))
    if runtime < 0 or period <= runtime:
        return Finding("throttling", OK, "real-time threads may run all the time")
    text = f"real-time threads are stopped when they had {runtime / period:.0%} of {period / 1e6:g} s"
    if processors > 1:
        return Finding("throttling", OK, f"{text} on a processor; the tick has one of its own")
    return Finding("throttling", WARNING, f"{text}, and there is one processor", "sudo sysctl kernel.sched_rt_runtime_us=-1")


def check_clock(look: Look, year: int) -> Finding:
    """Checks the clock source, and whether the date is plausible."""
    source = look("/sys/devices/system/clocksource/clocksource0/current_clocksource") or "unknown"
    if source not in STEADY_CLOCKS:
        return Finding("clock", WARNING, f"source {source}", f"slow to read; right are {', '.join(STEADY_CLOCKS)}")
    if year < EARLIEST_YEAR:
        return Finding("clock", WARNING, f"the year is {year}", "set the date; a battery or chrony keeps it")
    return Finding("clock", OK, f"source {source}")


def check_logs(folder: Path) -> Finding:
    """Checks whether logs can go to `folder`. A run creates a missing folder, so the nearest existing parent is checked instead."""
    place = next(each for each in (folder.absolute(), *folder.absolute().parents) if os.path.lexists(each))
    if not place.is_dir():
        return Finding("disk", FAILED, f"{place} is a file; logs need a folder", "give another with --out")
    try:
        tempfile.TemporaryFile(dir=place).close()  # leaves nothing
    except OSError as error:
        advice = "let the user that runs modcube write there, or log elsewhere with --out"
        return Finding("disk", FAILED, f"no log can be written in {place}: {error.strerror}", advice)
    return check_disk(folder, shutil.disk_usage(place).free)


def check_disk(folder: Path, free_bytes: int) -> Finding:
    """Checks the free disk space for logs."""
    text = f"{free_bytes / 1e9:.1f} GB free for logs in {folder}"
    if free_bytes >= SPARE_BYTES:
        return Finding("disk", OK, text)
    state = WARNING if free_bytes >= NEEDED_BYTES else FAILED
    return Finding("disk", state, text, "remove old logs, or log elsewhere with --out")


def check_cache() -> Finding:
    """Checks whether compiled code is cached, by the time a fresh process takes to load it."""
    try:
        took_s = warm_up()
    except DescriptionError as error:
        return Finding("compiled code", FAILED, str(error), "is there room where it is kept (NUMBA_CACHE_DIR), and memory?")
    if took_s <= SLOW_IMPORT_S:
        return Finding("compiled code", OK, f"loads in {took_s:.1f} s")
    advice = "it is compiled and cached now; if this comes again the cache cannot be written (NUMBA_CACHE_DIR)"
    return Finding("compiled code", WARNING, f"took {took_s:.0f} s to load", advice)


def warm_up() -> float:
    """Loads what a tick calls in a separate process, which compiles what is not cached; returns the seconds that took.

    Raises DescriptionError where that process fails.
    """
    began = time.perf_counter()
    words = "; ".join(f"import {name}" for name in WARM_MODULES)
    done = subprocess.run([sys.executable, "-P", "-c", words], stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"the process ended with status {done.returncode}"]
        raise DescriptionError(f"what a tick calls cannot be loaded: {said[-1]}")
    return time.perf_counter() - began


def check_interface(name: str, show: Callable[[str], str]) -> Finding:
    """Checks a SocketCAN interface, from the output of `ip` for its name (`show_link`)."""
    title = f"bus {name}"
    text = show(name)
    try:
        link: dict[str, Any] = json.loads(text)[0]
    except (ValueError, IndexError):
        return Finding(title, FAILED, "there is no such interface", "is its driver loaded? ip link shows all")
    info = link.get("linkinfo", {})
    kind, data = info.get("info_kind", ""), info.get("info_data", {})
    if kind not in ("can", "vcan"):
        return Finding(title, FAILED, f"is of kind {kind or 'none'}, not CAN", "choose another with --bus")
    if "UP" not in link.get("flags", []):
        return Finding(title, FAILED, "is down", f"sudo systemctl start modcube-can@{name}")
    if kind == "vcan":
        return Finding(title, OK, "virtual, up")
    return judge_controller(title, name, data, int(link.get("txqlen", 0)))


def judge_controller(title: str, name: str, data: dict[str, Any], queue: int) -> Finding:
    """Judges a real controller that is up: bit rate, restart-ms, state and queue."""
    rate, state = int(data.get("bittiming", {}).get("bitrate", 0)), str(data.get("state", "?"))
    restart = int(data.get("restart_ms", 0))
    text = f"{rate // 1000} kbit/s, {state}, restart-ms {restart}, queue {queue}"
    set_up = f"sudo systemctl restart modcube-can@{name}"
    if rate != BIT_RATE:
        return Finding(title, FAILED, text, f"the bit rate must be {BIT_RATE // 1000} kbit/s: {set_up}")
    if state in ("BUS-OFF", "STOPPED"):
        return Finding(title, FAILED, text, "look at wiring, termination (60 ohm across), power of the nodes")
    if state != "ERROR-ACTIVE":
        return Finding(title, WARNING, text, "frames are damaged: look at wiring and termination")
    if restart == 0:
        return Finding(title, WARNING, text, f"it would not come back after bus-off: {set_up}")
    if queue < 100:
        return Finding(title, WARNING, text, f"frames of a busy tick may not fit the queue: {set_up}")
    return Finding(title, OK, text)


def show_link(name: str) -> str:
    """JSON output of `ip` for an interface; empty where there is none."""
    try:
        done = subprocess.run(
            ["ip", "-json", "-details", "link", "show", name], capture_output=True, text=True, check=False
        )
    except OSError:
        return ""
    return done.stdout


def lines_of(findings: Sequence[Finding]) -> list[str]:
    """Lines to print: one per finding with its advice below, then a summary."""
    lines = []
    for finding in findings:
        lines.append(f"{finding.state:4s}  {finding.name:14s} {finding.text}")
        if finding.advice and finding.state != OK:
            lines.append(f"      {'':14s} -> {finding.advice}")
    failed = sum(finding.state == FAILED for finding in findings)
    warned = sum(finding.state == WARNING for finding in findings)
    return [*lines, f"{failed} failed, {warned} warning{'s' * (warned != 1)}" if failed or warned else "all is well"]
