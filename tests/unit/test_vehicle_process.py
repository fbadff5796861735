"""The vehicle's process on a bus where no module answers: what it says, how it starts and ends."""

import errno
import os
import re
import signal
import socket
import threading
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.app import vehicle_process
from firmware_py.app.observers import recording
from firmware_py.app.vehicle_process import run_vehicle
from firmware_py.bus.codec import Frame
from firmware_py.bus.port.links import VirtualLink
from firmware_py.core.types import Event, Inputs, ModuleCommand, Outputs
from firmware_py.description.fleet import Fleet, Module, single
from firmware_py.description.parameters import Parameters
from firmware_py.runtime import teller
from firmware_py.runtime.flight_log import FlightLog
from firmware_py.runtime.interrupts import endings_of_a_run, handled
from firmware_py.runtime.notify import Notifier
from firmware_py.runtime.recorder import Recorder
from tests.unit.vehicle_runs import bus_of, fly


@pytest.mark.slow
def test_second_signal_does_not_end_the_process_before_its_log_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fatal: list[int] = []
    close = Recorder.close

    def close_disturbed(recorder: Recorder) -> list[Event]:
        os.kill(os.getpid(), signal.SIGTERM)
        return close(recorder)

    monkeypatch.setattr(Recorder, "close", close_disturbed)
    with handled(lambda number, frame: fatal.append(number)):
        fly(tmp_path, tmp_path / "log")
    assert not fatal


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_vehicle_that_is_stopped_while_it_starts_ends_without_a_tick_or_a_log(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: SIGTERM left the folder of a log in which nothing was."""

    def die(number: int, frame: object) -> None:
        raise AssertionError(f"signal {number} ends the process here")

    said: list[str] = []
    monkeypatch.setattr(vehicle_process, "read_libraries", lambda: os.kill(os.getpid(), number))
    with handled(die):
        summary = run_vehicle(single(bus=bus_of(tmp_path)), Parameters(), out=tmp_path / "log", say=said.append)
    assert summary.ticks == 0 and not any(line.startswith("running at") for line in said)
    assert list((tmp_path / "log").iterdir()) == []


@pytest.mark.slow
def test_vehicle_whose_terminal_is_gone_ends_as_it_does_by_a_signal(tmp_path: Path) -> None:
    fatal: list[int] = []

    def die(number: int, frame: object) -> None:
        fatal.append(number)
        os.kill(os.getpid(), signal.SIGTERM)

    with handled(die, [signal.SIGHUP]):
        fly(tmp_path, ending=signal.SIGHUP)
    assert not fatal


def test_vehicle_that_is_told_to_ignore_the_end_of_its_terminal_does() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert signal.SIGHUP not in endings_of_a_run()
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "told"), [("girona500", 1), ("modcube", 0)])
def test_robot_that_carries_no_tag_is_told_so_at_its_start(name: str, told: int, tmp_path: Path) -> None:
    """No camera can see it, so it would wait for its pose forever."""
    said = fly(tmp_path, fleet=single(name, bus_of(tmp_path)), hold=True)
    assert sum(line.startswith("warning: module 1 carries no [[tag]]: ") for line in said) == told


@pytest.mark.slow
@pytest.mark.parametrize(("modules", "pitch_m", "told"), [(2, 0.2, 1), (2, 0.21, 0), (1, 0.2, 0)])
def test_fleet_whose_pitch_is_not_its_hulls_is_told_so_at_its_start(modules: int, pitch_m: float, told: int, tmp_path: Path) -> None:
    """Its modules would touch and be given up as jams."""
    cubes = tuple(Module(number=n + 1) for n in range(modules))
    said = fly(tmp_path, fleet=Fleet(module=cubes, buses=(bus_of(tmp_path),), pitch_m=pitch_m))
    assert sum(line.startswith("warning: pitch_m of the fleet is 0.2 m, but hulls measure 0.21 m") for line in said) == told


@pytest.mark.slow
def test_vehicle_says_that_a_bus_takes_no_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(link: VirtualLink, bus: Any, frame: Frame) -> None:
        raise OSError(errno.ENOBUFS, "No buffer space available")

    def say(line: str) -> None:
        said.append(line)
        if "full" in line or "bus silent" in line:
            os.kill(os.getpid(), signal.SIGTERM)

    said: list[str] = []
    monkeypatch.setattr(VirtualLink, "send", refuse)
    run_vehicle(single(bus=bus_of(tmp_path)), Parameters(), say=say)
    assert any(re.search(f"bus {bus_of(tmp_path)}: in the last second [0-9]+ full$", line) for line in said)


@pytest.mark.slow
def test_service_manager_hears_that_the_process_ends_before_the_rest_of_it_does(tmp_path: Path) -> None:
    """A process that ends by itself, asked by a ground station, would else be killed by the watchdog while it closes its log."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        with closing(Notifier.of({"NOTIFY_SOCKET": str(tmp_path / "notify")})) as notifier:
            fly(tmp_path, tmp_path / "log", notifier=notifier)
        heard = []
        with suppress(BlockingIOError):
            while True:
                heard.append(manager.recv(4096).decode())
    assert heard[-1] == "STOPPING=1" and heard.count("STOPPING=1") == 1


@pytest.mark.slow
def test_tick_is_not_held_up_by_who_reads_its_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(teller, "CLOSE_S", 0.01)
    let, over = threading.Event(), threading.Event()

    def stall() -> None:
        assert threading.current_thread() is not threading.main_thread()
        let.wait()
        over.set()

    fly(tmp_path, then=stall)
    let.set()
    assert over.wait(10)


@pytest.mark.slow
def test_flight_goes_on_when_nobody_reads_its_lines_any_more(tmp_path: Path) -> None:
    def hang_up() -> None:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    assert fly(tmp_path, tmp_path / "log", hang_up)[-1].startswith("running at")
    assert len(list(FlightLog(tmp_path / "log").ticks())) >= 10  # FAREWELL_TICKS


@pytest.mark.slow
def test_lines_are_said_by_an_ordinary_thread(tmp_path: Path) -> None:
    policies: list[int] = []
    fly(tmp_path, then=lambda: policies.append(os.sched_getscheduler(0)))
    assert policies == [os.SCHED_OTHER]


@pytest.mark.slow
def test_libraries_are_read_when_all_is_composed_and_before_the_first_tick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[str] = []

    def listed(name: str) -> None:
        step = getattr(vehicle_process, name)
        monkeypatch.setattr(vehicle_process, name, lambda *a, **k: (steps.append(name), step(*a, **k))[1])

    for name in ("compose", "read_libraries", "open_loop"):
        listed(name)
    fly(tmp_path)
    assert steps == ["compose", "read_libraries", "open_loop"]


class Tape(Recorder):
    """A recorder that only notes the ticks in which it is flushed."""

    def __init__(self) -> None:
        self.flushed: list[int] = []

    def sent(self, *_: object) -> None: ...

    def received(self, *_: object) -> None: ...

    def record(self, inputs: Inputs, outputs: Outputs) -> None:
        self.tick = outputs.tick

    def flush(self) -> list[Event]:
        self.flushed.append(self.tick)
        return []


def test_log_says_at_once_who_is_armed() -> None:
    """The log of a process that is killed just after a DISARM must not count as one of a flight."""
    tape = Tape()
    observe = recording(tape, 100)
    armed: Sequence[bool] = [20 < tick <= 33 for tick in range(120)]
    for tick in range(1, 120):
        commands = [ModuleCommand(armed[tick], np.zeros(8), None)]
        observe([], [], Inputs(tick, 0, []), Outputs(tick, 0, commands, False, [], []))
    assert tape.flushed == [1, 21, 34, 50, 100]
