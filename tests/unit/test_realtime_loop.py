"""Ticks in real time: they go on when an observer fails."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, cast

import pytest

from firmware_py.app.firmware import BusFrame, Firmware, compose
from firmware_py.app.lockstep import Lockstep
from firmware_py.app.observers import UNUSED, Observer, recording, recording_buses, telling, watching_bus, watching_frames
from firmware_py.app.realtime import RealTimeLoop, open_loop
from firmware_py.bus.codec import Frame
from firmware_py.bus.mapping import InputCollector
from firmware_py.bus.port import open_port
from firmware_py.core.types import Inputs, Outputs
from firmware_py.description.fleet import single
from firmware_py.description.parameters import Parameters
from firmware_py.description.signals import read_signals
from firmware_py.runtime.flight_log import FlightLog
from firmware_py.runtime.rate_keeper import RateKeeper
from firmware_py.runtime.recorder import SIGNAL_LOG, Recorder


@pytest.fixture
def firmware(tmp_path: Path) -> Firmware:
    return compose(single(bus=f"virtual:{tmp_path.name}"), Parameters())


@pytest.fixture
def loop(firmware: Firmware) -> Iterator[RealTimeLoop]:
    with ExitStack() as stack:
        yield open_loop(stack, firmware, lambda time_ns, last: [])


class SilentPort:
    """A bus where nobody answers; notes until when the loop waited."""

    def __init__(self) -> None:
        self.waited_ns: list[int] = []

    def send(self, frame: Frame) -> bool:
        return True

    def receive(self) -> list[Frame]:
        return []

    def wait(self, deadline_ns: int, ready: Callable[[], bool]) -> bool:
        self.waited_ns.append(deadline_ns)
        return ready()


class HandClock:
    """A clock that is set by hand, and by who sleeps."""

    now = 0

    def now_ns(self) -> int:
        return self.now

    def sleep_until(self, deadline_ns: int) -> None:
        self.now = deadline_ns


def test_modules_have_their_time_to_answer_also_in_the_first_tick_after_the_process_was_held_up(firmware: Firmware) -> None:
    """Regression: it closed before its SYNC was out in every other case, all sensors counted as lost, and the robot surfaced."""
    clock, port = HandClock(), SilentPort()
    keeper = RateKeeper(firmware.fleet.period_ns, clock, clock.sleep_until)
    loop = RealTimeLoop(firmware, cast(Any, [port]), cast(Any, clock), keeper, lambda time_ns, last: [])
    for tick, (now_ms, closes_ms) in enumerate([(0, 5), (3, 15), (22, 25), (827, 832), (828, 835)], 1):
        clock.now = now_ms * 1_000_000
        loop.tick(tick, keeper.wait())
        assert port.waited_ns[-1] == closes_ms * 1_000_000


def breaking(at_tick: int) -> Observer:
    """An observer that fails from one tick on."""

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        if outputs.tick >= at_tick:
            raise IndexError("no such id")

    return observe


def test_observer_that_fails_is_dropped_with_one_warning_and_the_others_watch_on(loop: RealTimeLoop) -> None:
    said: list[str] = []
    ticks: list[int] = []
    loop.observers = [breaking(2), telling(said.append), lambda received, sent, inputs, outputs: ticks.append(outputs.tick)]
    loop.run(lambda tick, outputs: tick == 4)
    assert ticks == [1, 2, 3, 4]
    (warning,) = [line for line in said if "breaking" in line]
    assert warning.endswith("no more breaking: IndexError: no such id")


def test_observer_that_fails_on_the_bench_ends_the_flight(firmware: Firmware) -> None:
    with open_port(firmware.fleet.buses[0]) as port:
        lockstep = Lockstep(firmware, [port], [breaking(1)])
        lockstep.start_tick(1, 0)
        with pytest.raises(IndexError, match="no such id"):
            lockstep.finish_tick(1, 0, [], [])


def test_what_a_bus_loses_is_told_once_while_it_goes_on(tmp_path: Path) -> None:
    with open_port(f"virtual:{tmp_path.name}") as port:
        observe = watching_bus(port, 100)
        told = {}
        for tick, lost in ((99, 3), (100, 0), (200, 7), (300, 0), (350, 2), (400, 0)):
            port.faults["full"] += lost
            observe([], [], Inputs(tick, 0, []), outputs := Outputs(tick, 0, [], False, [], []))
            told[tick] = [event.text for event in outputs.events]
    assert told == {
        99: [], 100: [f"bus {port.address}: in the last second 3 full"], 200: [], 300: [], 350: [],
        400: [f"bus {port.address}: in the last second 2 full"],
    }  # fmt: skip


def test_frames_that_are_not_used_are_told_by_kind_unless_they_are_few(firmware: Firmware) -> None:
    """A camera with a wrong CaptureTick, or boards that also send frames of their own, would else stop a robot from arming unexplained."""
    collector, stale = InputCollector(firmware.fleet, firmware.codec), Frame(0x7FF, bytes(3))
    observe = watching_frames(collector, 100)
    told = []
    for second, strange in ((1, 4), (2, 5), (3, 6), (4, 0), (5, 7)):
        collector.take(0, [stale] * strange)
        observe([], [], Inputs(100 * second, 0, []), outputs := Outputs(100 * second, 0, [], False, [], []))
        told.append([event.text for event in outputs.events])
    said = "frames not used: in the last second {} of an id that the DBC does not have"
    assert told == [[], [said.format(5)], [], [], [said.format(7)]]
    assert set(UNUSED) == set(collector.unused) - {"foreign_sync", "foreign_command"}  # of which the supervisor tells


def test_what_a_bus_loses_is_in_the_log_second_by_second_and_in_nothing_that_a_replay_compares(tmp_path: Path) -> None:
    with open_port(f"virtual:{tmp_path.name}") as port, closing(Recorder(tmp_path, {})) as recorder:
        observers, sync = (recording(recorder, 2), recording_buses(recorder, [port], 2)), [(0, Frame(0x020, bytes(4)))]
        for tick, lost in ((1, 3), (2, 0), (3, 4), (4, 1)):
            port.faults["full"] += lost
            for observe in observers:
                observe([], sync, Inputs(tick, tick * 500_000_000, []), Outputs(tick, tick * 500_000_000, [], False, [], []))
    counted = read_signals(tmp_path / SIGNAL_LOG)["/firmware/bus0"]
    assert {name: counted[name].tolist() for name in ("tick", "full", "reopened")} == {"tick": [2, 4], "full": [3, 8], "reopened": [0, 0]}
    assert {topic for logged in FlightLog(tmp_path).ticks() for topic, _ in logged.messages} == {"/firmware/ticks"}
