"""The plant in real time, in a process of its own and on its own clock: `modcube hil plant`, and the other half of
`--realtime`.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from firmware_py.bus.codec import Codec, Frame
from firmware_py.bus.port import Port, open_port
from firmware_py.description.schema import DescriptionError
from hil.faults import Faults
from hil.nodes import Nodes, make_nodes
from hil.replaceable import check_replaceable, created_folder
from hil.scenario import Scenario, make_world
from hil.truth_log import TRUTH_LOG, TruthRecorder, is_truth_log

CHUNK_NS = 2_500_000
"""Time step of the world, and so the maximum age of the state that an MCU samples."""


def started_clock() -> Callable[[], int]:
    """A clock of the plant's own: nanoseconds since this call."""
    start_ns = time.monotonic_ns()
    return lambda: time.monotonic_ns() - start_ns


def check_served(scenario: Scenario) -> None:
    """Raises DescriptionError for a fault that the plant alone cannot produce."""
    for i, fault in enumerate(scenario.fault):
        if fault.kind == "process_killed":
            where = f"scenario {scenario.name!r}: fault[{i}].kind"
            raise DescriptionError(f"{where}: only a flight in lockstep kills the firmware; fly without --realtime, or leave it out")


def serve_until_signal(scenario: Scenario, seed: int, bus: str, rate_hz: int, out: Path | None) -> None:
    """Serves `bus` until SIGINT or SIGTERM. Raises PortError and DescriptionError."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with ExitStack() as stack:
        if out is not None:
            stack.enter_context(created_folder(out))
            check_replaceable(out, (TRUTH_LOG,), is_truth_log(out / TRUTH_LOG), "plant")
        plant = PlantProcess(scenario, seed, rate_hz, out)
        now_ns = started_clock()
        port = stack.enter_context(open_port(bus, reader=True, now_ns=now_ns, arrival=threading.Event()))
        print(f"plant of {scenario.name} on {bus}", flush=True)
        plant.serve(port, now_ns, stop.is_set)


class PlantProcess:
    """The world and its nodes, advanced by a clock. `serve` returns once `stop()` is true.

    The constructor and `serve` raise DescriptionError. `serve` does so if another node answers as one of its modules within the first
    second of ticks; after that this plant was there first, and the other one has to leave.
    """

    def __init__(self, scenario: Scenario, seed: int, rate_hz: int, out: Path | None) -> None:
        check_served(scenario)
        self._world = make_world(scenario, seed, CHUNK_NS)
        codec = Codec.load()
        self._sync = codec.message("SYNC")
        self._guarded_ticks = rate_hz
        self._nodes: Nodes = make_nodes(self._world, codec, scenario, tick_ns=1_000_000_000 // rate_hz)
        self._nodes.faults = Faults(self._nodes, scenario.fault)
        self._out = out
        self._truth: TruthRecorder | None = None

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Records the truth into the folder while inside. An earlier log there stays intact until then."""
        if self._out is None:
            yield
            return
        thrusters = tuple(len(v.thruster) for v in self._world.vehicles)
        with TruthRecorder(self._out, thrusters) as self._truth:
            yield

    def serve(self, port: Port, now_ns: Callable[[], int], stop: Callable[[], bool]) -> None:
        """Answers the frames that arrive at `port`; `now_ns` starts near zero."""
        with self.recording():
            while not stop():
                port.wait(self._world.time_ns + CHUNK_NS)
                self._advance(now_ns())
                for frame in port.receive():
                    self._answer(port, frame)

    def _advance(self, now_ns: int) -> None:
        while self._world.time_ns + CHUNK_NS <= now_ns:
            self._world.advance(CHUNK_NS)
            self._nodes.watch()

    def _answer(self, port: Port, frame: Frame) -> None:
        """Answers one frame. A SYNC begins a tick even if a simulated wire fault drops it."""
        is_tick = frame.id == self._sync.id_of(0) and len(frame.data) == self._sync.length
        if self._guarded_ticks > 0:
            self._guarded_ticks -= is_tick
            self._nodes.refuse_others([frame], port.address)
        answers = self._nodes.answer([frame], self._world.time_ns)
        for answer in answers + self._nodes.speak(self._world.time_ns) if is_tick else answers:
            port.send(answer)
        if self._truth is not None and is_tick:
            self._truth.record_world(int(self._sync.decode(frame.data)[0]), self._world)
