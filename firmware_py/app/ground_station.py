"""The ground side: links and GroundStation in their own thread beside the loop. A tick only hands results over.

The thread works after a tick, while the loop waits for the next, because both share one interpreter. The loop does not wake it, which
would cost 40 us per tick; the thread sleeps until the next tick should be over.
Missions are planned in a separate process, so that planning takes no time from the tick.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextvars import ContextVar
from ctypes import Array
from types import TracebackType
from typing import Any

import numpy as np

from firmware_py.app.deadlines import times_of
from firmware_py.app.firmware import BusFrame, Firmware
from firmware_py.core.body import Body
from firmware_py.core.types import Inputs, Outputs, Request
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.files import FileWriter
from firmware_py.ground.link import Links
from firmware_py.ground.link_address import LinkError
from firmware_py.ground.plan_jobs import Plan, PlanJob
from firmware_py.ground.signing import FILE_MODE, Signing, load_signing
from firmware_py.ground.station import GroundStation
from firmware_py.ground.system import STOPPING
from firmware_py.runtime.clock import MonotonicClock, unix_ns
from firmware_py.runtime.interrupts import signals_blocked
from firmware_py.runtime.rate_keeper import RateKeeper
from firmware_py.runtime.realtime import die_with, use_ordinary_priority, use_priority
from firmware_py.runtime.teller import Teller, write_line

_WAKE_MARGIN = 0.1
"""Margin for ticks of different length, as a share of a period, before the thread would wake up too early."""
_MAX_SLEEP_PERIODS = 10.0
"""Longest sleep of the thread while the loop stands still, in periods."""
_SWITCH_S = 50e-6
"""Longest time that a waking tick waits for the interpreter. Python's default of 5 ms would make it late."""
_MOST_TICKS = 200
"""Longest queue of ticks for the thread; the oldest are dropped."""
_MOST_REQUESTS = 256
"""Longest queue of requests for a tick."""
_SAVE_EVERY_NS = 1_000_000_000
"""Interval between saves of the signing time stamp; the saved stamp is ahead by as much. A new key is saved at once."""
_CLOSE_S = 1.0
"""How long the end of a run waits for the store's disk: log and e-stop note are closed after it, within the service's five seconds."""


_WARM_UP_JOB = PlanJob(0, 0, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), (), 0.1, 1.0)
"""A job without legs, which makes the planning process load its code."""

Awaited = Array[Any]
"""By body: serial number of the job whose plan it waits for. Shared by both processes."""
_AWAITED: ContextVar[Awaited | None] = ContextVar("awaited", default=None)
"""Set in the planning process only."""


def _plan_mission(job: PlanJob, body: Body | None) -> Plan:
    """Runs in the planning process only: its solvers take 20 MB that the vehicle's process does not need."""
    from firmware_py.app.mission_plan import plan_mission

    awaited = _AWAITED.get()
    return plan_mission(job, body, lambda: awaited is None or awaited[job.body] == job.serial)


def _planner(awaited: Awaited) -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, mp_context=context, initializer=_serve, initargs=(os.getpid(), awaited))


def _submit(executor: Executor, job: PlanJob, body: Body | None) -> Future[Plan]:
    """Submits a job. A process that this starts inherits the blocked Ctrl-C, which would otherwise end it before `_serve` ignores it."""
    with signals_blocked([signal.SIGINT]):
        return executor.submit(_plan_mission, job, body)


def _serve(parent: int, awaited: Awaited) -> None:
    """Sets up the planning process to end with the vehicle's process, and to ignore the Ctrl-C that asks the vehicle to disarm first."""
    use_ordinary_priority()  # a replacement process is started by a thread of real-time priority
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with(parent)
    _AWAITED.set(awaited)


class GroundSide:
    """Links, station, and the queues between them and the loop. `pump` does one round of the work.

    Args of the constructor:
        executor: runs the planning of missions; None starts a process for it.
        priority: SCHED_FIFO priority of the thread, for use with a real-time loop; 0: an ordinary thread.
        started: parameters before the stored ones were laid over them; None: the firmware's.
        say: receives one line about each link that is not there yet, another once it is, and one about the first error, in its own thread.
    """

    def __init__(
        self,
        config: GroundConfig,
        firmware: Firmware,
        executor: Executor | None = None,
        priority: int = 0,
        started: Parameters | None = None,
        say: Callable[[str], None] = write_line,
    ) -> None:
        """Opens the links. Raises DescriptionError for an invalid link, key file or parameter file."""
        self._config, self._pipeline = config, firmware.pipeline
        self._period_ns = firmware.fleet.period_ns
        self.station = GroundStation(config, firmware.fleet, started or firmware.parameters, _signing_of(config))
        try:
            self.links = Links(config.links)
        except LinkError as error:
            raise DescriptionError(str(error)) from None
        self._executor = executor
        self._plans: list[tuple[PlanJob, Future[Plan]]] = []
        self._awaited: Awaited = multiprocessing.RawArray("q", len(firmware.fleet.module))
        self._ticks: deque[tuple[Inputs, Outputs]] = deque(maxlen=_MOST_TICKS)
        self._requests: deque[Request] = deque()
        self._thread: threading.Thread | None = None
        self._clock = MonotonicClock()
        self._handed_over_ns = 0
        self._priority = priority
        self._say = say
        self._stopping = False
        self._saved_ns = 0
        self._saved_key = self.station.signing.key
        self._writer = FileWriter(_CLOSE_S)
        self._switch_s = 0.0
        self.keeper: RateKeeper | None = None
        """Rate keeper of a real-time loop, from which telemetry reports how ticks keep their deadlines."""
        self.error: Exception | None = None
        """The first unexpected error. The thread and the vehicle carry on."""

    def observe(self, received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        """Observer of the loop: hands over the tick after its commands are sent."""
        self._ticks.append((inputs, outputs))
        self._handed_over_ns = self._clock.now_ns()

    def requests(self) -> list[Request]:
        """Takes the queued requests of ground stations, for this tick."""
        return [self._requests.popleft() for _ in range(len(self._requests))]

    def pump(self) -> None:
        """One round: take ticks and bytes, answer, stream."""
        for part in self._parts():
            part()

    def _parts(self) -> Sequence[Callable[[], None]]:
        """The steps of a round, in order. None needs another to succeed: a stop needs only `_hear` and `_hand_over`."""
        return self._look, self._hear, self._hand_over, self._plan, self._speak, self._save

    def _look(self) -> None:
        """Take the ticks that were handed over."""
        station = self.station
        station.signing.advance(unix_ns())
        if self.keeper is not None:
            station.picture.times = times_of(self.keeper)
        station.set_busy(self.links.busy())
        while self._ticks:
            inputs, outputs = self._ticks.popleft()
            station.observe(inputs, outputs, self._pipeline.bodies)

    def _hear(self) -> None:
        """Take the bytes received on the links."""
        station, now_ns = self.station, self.station.picture.time_ns
        failed: list[Exception] = []
        for got in self.links.receive():
            try:
                if station.take(got.channel, got.data, now_ns, got.datagram, got.trusted):
                    self.links.believe(got.channel)
            except Exception as error:  # the data that follows may hold a stop
                failed.append(error)
        for number in self.links.channels:
            station.join(number, now_ns)
        for number in self.links.take_gone():
            station.leave(number)
        if failed:
            raise failed[0]

    def _hand_over(self) -> None:
        """Queue requests for the next tick, in order. When the queue is full only stops are still accepted, up to twice its length."""
        for request in self.station.requests():
            room = _MOST_REQUESTS * (2 if request.action in STOPPING else 1)
            if len(self._requests) < room:
                self._requests.append(request)

    def _speak(self) -> None:
        """Answer and stream."""
        for channel, frame in self.station.frames(self.station.picture.time_ns):
            self.links.send(channel, frame)
        self.links.flush()

    @property
    def reboot_asked(self) -> bool:
        """Whether a client asked for a restart of the process."""
        return self.station.reboot_asked

    def __enter__(self) -> GroundSide:
        """Start the thread, which starts the planning process."""
        self._switch_s = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_S)
        self._thread = threading.Thread(target=self._run, args=(Teller(self._say),), name="ground", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the thread and close everything."""
        self._stopping = True
        if self._thread is not None:
            self._thread.join()
            sys.setswitchinterval(self._switch_s)
        self.close()

    def close(self) -> None:
        """Close the links, end the planning process, and store what is left."""
        self.links.close()
        if isinstance(self._executor, ProcessPoolExecutor):
            for process in list(self._executor._processes.values()):  # Python 3.14: kill_workers()
                process.kill()  # no plan is wanted any more, and one that still loads its code would be waited for
            self._executor.shutdown(wait=True, cancel_futures=True)
        self._writer.close()

    def _run(self, teller: Teller) -> None:
        for warning in self.links.warnings:
            teller.say(f"warning: {warning}")
        self._try(self._start_planner, teller)
        if self._priority:
            use_priority(self._priority)  # a refusal was reported by the loop already
        while not self._stopping:
            time.sleep(self._rest_s())
            for part in self._parts():
                self._try(part, teller)
            while self.links.opened:
                teller.say(self.links.opened.pop(0))
        teller.close()

    def _try(self, act: Callable[[], None], teller: Teller) -> None:
        """Calls `act` and survives any error, so that a later stop is still heard. Reports only the first error."""
        try:
            act()
        except Exception as error:
            if self.error is None:
                teller.say(f"warning: the ground side goes on after an error that nobody foresaw: {type(error).__name__}: {error}")
            self.error = self.error or error

    def _rest_s(self) -> float:
        """Sleep until shortly after the next tick, s; when the tick is overdue, half the time already waited, up to
        _MAX_SLEEP_PERIODS.
        """
        since = (self._clock.now_ns() - self._handed_over_ns) / self._period_ns
        return max(1.0 + _WAKE_MARGIN - since, min(since / 2, _MAX_SLEEP_PERIODS)) * self._period_ns * 1e-9

    def _plan(self) -> None:
        """Submit new planning jobs, each replacing an unstarted one of the same body; collect finished plans."""
        self._awaited[:] = self.station.awaited()  # before these jobs start; also stops the planning of plans no longer awaited
        bodies = {body.index: body for body in self._pipeline.bodies}
        for job in self.station.jobs():
            self._plans = [(other, future) for other, future in self._plans if other.body != job.body or not future.cancel()]
            self._plans.append((job, self._begin(job, bodies.get(job.body))))
        for job, future in list(self._plans):
            if not future.done():
                continue
            self._plans.remove((job, future))
            error = future.exception()
            plan = future.result() if error is None else Plan(job.serial, None, (), f"planning failed: {error}")
            self.station.planned(job.body, plan)

    def _start_planner(self) -> None:
        """Starts the planning process, from the thread with which it dies even when busy (`die_with`); it takes seconds to be ready."""
        if self._executor is None:
            self._executor = _planner(self._awaited)
            _submit(self._executor, _WARM_UP_JOB, None)

    def _begin(self, job: PlanJob, body: Body | None) -> Future[Plan]:
        """Submits a job to the planning process, or to a new one if that was killed, as the system does when memory is short."""
        try:
            if self._executor is not None:
                return _submit(self._executor, job, body)
        except BrokenExecutor:
            pass
        self._executor = _planner(self._awaited)
        return _submit(self._executor, job, body)

    def _save(self) -> None:
        """Hand over what is to be stored to the thread that writes files; report what could not be written."""
        store, signing, now_ns = self.station.store, self.station.signing, self.station.picture.time_ns
        if store.changed and self._config.parameter_file is not None:
            self._writer.write(self._config.parameter_file, store.to_toml().encode())
            store.changed = False
        may_wait = signing.key == self._saved_key and now_ns - self._saved_ns < _SAVE_EVERY_NS
        if signing.changed and self._config.key_file is not None and not may_wait:
            self._writer.write(self._config.key_file, signing.to_json().encode(), FILE_MODE)
            self._saved_ns, self._saved_key, signing.changed = now_ns, signing.key, False
        for path, error in self._writer.failures():
            self.station.say(f"the next start will not know what was changed: {path.name} is not stored: {error.strerror}")


def _signing_of(config: GroundConfig) -> Signing:
    try:
        return load_signing(config.key_file) if config.key_file is not None else Signing()
    except (ValueError, OSError) as error:
        raise DescriptionError(str(error)) from None
