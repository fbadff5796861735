"""tune_gains --live: tunes a vehicle that hovers, through MAVLink parameters, one confirmed step at a time.

One parameter moves in a step, up or down by a factor; what makes the objective smaller stays, the rest goes back at once. A person
says yes to every step. On a fail-safe, an e-stop, a disarmed vehicle, another mode, silence or an interrupt every parameter gets the
value that it had in the beginning; so it does when the program was killed and is started again.
"""

from __future__ import annotations

import json
import os
import select
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from tune_objective import Objective

from firmware_py.description.parameters import registry
from firmware_py.description.schema import DescriptionError
from firmware_py.ground.files import write_atomically

FACTOR, SMALLEST_FACTOR = 1.25, 1.03
"""Of a step; where neither way helped, its square root is tried next."""
BETTER = 0.97
"""Share of the best cost that counts as better: two looks at one hover differ by a per cent or two."""
SETTLE_S = 3.0
"""After a change, before it is looked at; by the vehicle's clock."""
SILENT_S, ANSWER_S, ANSWERS = 5.0, 1.0, 5
"""Without a heartbeat the vehicle is lost; a parameter is sent again after so long, so often."""
STATE_ACTIVE, ARMED, ERROR = 4, 0x80, 3
"""MAV_STATE_ACTIVE; MAV_MODE_FLAG_SAFETY_ARMED; worst severity that is only said."""
ONBOARD_CONTROLLER, INVALID_AUTOPILOT = 18, 8
"""MAV_TYPE: not a ground station, whose loss the vehicle would act upon."""
SEEN = ("position_rmse_m", "attitude_rmse_rad")
"""Metrics that telemetry gives; the objective's other terms are left out."""
BEFORE_FILE = "live-before.json"


class TroubleError(Exception):
    """The vehicle is no longer as it was when the tuning began; the message says why."""


class Vehicle:
    """A vehicle behind a MAVLink address."""

    def __init__(self, address: str) -> None:
        """Waits for its heartbeat. Raises DescriptionError when none comes."""
        os.environ["MAVLINK20"] = "1"
        from pymavlink import mavutil

        try:
            self.link = mavutil.mavlink_connection(address, dialect="all", source_system=255, source_component=191)
        except (OSError, ValueError) as error:
            raise DescriptionError(f"--live {address}: {error}; it needs an address such as mavlink:udpin:0.0.0.0:14550") from None
        self._said_s = 0.0
        self._heard_s = time.monotonic()
        self._mode: int | None = None
        self._watched = False
        self.seen: list[Any] = []
        """Messages since `seen` was emptied."""
        with suppress(TroubleError):
            self.hear()
        if self._mode is None:
            self.link.close()
            raise DescriptionError(f"--live {address}: no heartbeat in {SILENT_S:g} s; is the vehicle's link set to this address?")

    def close(self) -> None:
        """Ends the link."""
        self.link.close()

    def listen(self, timeout_s: float) -> None:
        """Takes what comes for at most so long. Raises TroubleError once `watch` was called."""
        now = time.monotonic()
        if now - self._said_s > 1.0:
            self._said_s = now
            self.link.mav.heartbeat_send(ONBOARD_CONTROLLER, INVALID_AUTOPILOT, 0, 0, 4)
        message = self.link.recv_match(blocking=True, timeout=timeout_s)
        while message is not None:
            self._take(message)
            message = self.link.recv_match(blocking=False)
        if time.monotonic() - self._heard_s > SILENT_S:
            raise TroubleError(f"the vehicle has been silent for {SILENT_S:g} s")

    def hear(self) -> None:
        """Until the next heartbeat. Raises TroubleError."""
        self.seen.clear()
        while not any(m.get_type() == "HEARTBEAT" for m in self.seen):
            self.listen(0.1)

    def watch(self, on: bool) -> None:
        """From now on trouble is trouble, or no longer."""
        self._watched = on

    def _take(self, message: Any) -> None:
        if self.link.target_system not in (0, message.get_srcSystem()):
            return
        self.seen.append(message)
        kind = message.get_type()
        if kind == "STATUSTEXT" and self._watched and (message.severity <= ERROR or message.text.startswith("fail-safe on")):
            raise TroubleError(f"the vehicle says: {message.text}")
        if kind != "HEARTBEAT" or message.get_srcComponent() != 1:
            return
        self._heard_s = time.monotonic()
        before, self._mode = self._mode, int(message.custom_mode)
        if not self._watched:
            return
        if message.system_status != STATE_ACTIVE:
            raise TroubleError("the vehicle is stopped, or in an emergency")
        if not message.base_mode & ARMED:
            raise TroubleError("the vehicle is disarmed")
        if before != self._mode:
            raise TroubleError(f"the vehicle's mode changed from {before:#x} to {self._mode:#x}")

    def get(self, name: str) -> float:
        """The value of a parameter. Raises TroubleError when it does not answer."""
        return self._ask(name, lambda: self.link.mav.param_request_read_send(self.link.target_system, 1, name.encode(), -1))

    def set(self, name: str, value: float) -> None:
        """Sets a parameter. Raises TroubleError when the vehicle keeps another value."""
        kept = self._ask(name, lambda: self.link.mav.param_set_send(self.link.target_system, 1, name.encode(), value, 9))
        if abs(kept - value) > 1e-5 * abs(value):
            raise TroubleError(f"parameter {name} was set to {value:g}, but the vehicle keeps {kept:g}")

    def _ask(self, name: str, send: Callable[[], None]) -> float:
        for _ in range(ANSWERS):
            self.seen.clear()
            send()
            end = time.monotonic() + ANSWER_S
            while time.monotonic() < end:
                self.listen(0.05)
                for message in self.seen:
                    if message.get_type() == "PARAM_VALUE" and message.param_id == name:
                        return float(str(np.float32(message.param_value)))
        raise TroubleError(f"parameter {name}: no answer in {ANSWERS * ANSWER_S:g} s")

    def look(self, seconds: float) -> dict[str, float]:
        """Metrics of so long a hover, after it has settled: RMS about the mean pose, by the vehicle's own clock and estimate."""
        self.seen.clear()
        began_ms: int | None = None
        poses: dict[str, list[list[float]]] = {"LOCAL_POSITION_NED": [], "ATTITUDE": []}
        while True:
            self.listen(0.1)
            for m in self.seen:
                kind = m.get_type()
                if kind not in poses:
                    continue
                began_ms = m.time_boot_ms if began_ms is None else began_ms
                since_s = 1e-3 * (m.time_boot_ms - began_ms)
                if since_s >= SETTLE_S:
                    poses[kind].append([m.x, m.y, m.z] if kind == "LOCAL_POSITION_NED" else [m.roll, m.pitch, m.yaw])
                if since_s >= SETTLE_S + seconds and all(poses.values()):
                    return dict(zip(SEEN, map(_spread, poses.values()), strict=True))
            self.seen.clear()


def _spread(values: list[list[float]]) -> float:
    """RMS distance from the mean; angles are unwrapped."""
    array = np.unwrap(np.array(values), axis=0)
    return float(np.sqrt(np.mean(np.sum((array - array.mean(axis=0)) ** 2, axis=1))))


class Person:
    """Who confirms. While an answer is waited for the vehicle is listened to."""

    def __init__(self, vehicle: Vehicle, stream: BinaryIO) -> None:
        """`stream` is unbuffered: what select says of it is all that is there."""
        self._vehicle, self._stream = vehicle, stream

    def answer(self, question: str) -> str:
        """First letter of what is typed; q at the end of the input. Raises TroubleError."""
        print(question, end=" ", flush=True)
        while not select.select([self._stream], [], [], 0.0)[0]:
            self._vehicle.listen(0.1)
        line = self._stream.readline()
        return (line.decode().strip().lower() or "n")[0] if line else "q"


def proposals(now: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]) -> Iterator[tuple[str, float]]:
    """Steps without end, until all are too small: name and value, one parameter after the other. `now` is read anew for each."""
    factor = FACTOR
    while factor > SMALLEST_FACTOR:
        helped = False
        for name in bounds:
            for way in (factor, 1.0 / factor):
                before = now[name]
                value = min(max(before * way, bounds[name][0]), bounds[name][1])
                if value != before:
                    yield name, float(str(np.float32(value)))
                if now[name] != before:
                    helped = True
                    break
        factor = factor if helped else factor**0.5


def tune_live(objective: Objective, live: str, steps: int, seconds: float, out: Path) -> int:
    """Tunes; returns the exit status: 0 the person ended it, 1 trouble, old values are back. Raises DescriptionError."""
    scheme, _, address = live.partition(":")
    if scheme != "mavlink" or not address:
        raise DescriptionError(f"--live {live!r} is no address; it needs mavlink:ADDRESS, such as mavlink:udpin:127.0.0.1:14550")
    seen = [term.metric for term in objective.term if term.metric in SEEN]
    if not seen:
        raise DescriptionError(f"--live: the objective has no term that can be seen from outside; it needs {' or '.join(SEEN)}")
    print(f"seen from outside: {', '.join(seen)}", flush=True)
    wire = {dotted: limits.mavlink for dotted, limits in registry()}
    bounds = {wire[s.parameter]: (s.low, s.high) for s in objective.search if wire[s.parameter]}
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with closing(Vehicle(address)) as vehicle:
        memory = out / BEFORE_FILE
        try:
            if memory.exists():
                print(f"{memory} is of a run that did not end: its values go back first", flush=True)
                put_back(vehicle, json.loads(memory.read_text(encoding="utf-8")), memory)
            before = {name: vehicle.get(name) for name in bounds}
            vehicle.watch(True)
            vehicle.hear()
        except TroubleError as error:
            raise DescriptionError(f"{address}: {error}; let it hover, armed, before it is tuned") from None
        write_atomically(memory, json.dumps(before).encode())
        kept, status = False, 0
        try:
            with open(0, "rb", buffering=0, closefd=False) as stdin:
                person = Person(vehicle, cast(BinaryIO, stdin))
                kept = _steps(objective, vehicle, person, dict(before), bounds, steps, seconds)
        except (TroubleError, KeyboardInterrupt) as error:
            status = 1
            print(f"\n{error}".rstrip() or "\ninterrupted", "- old values go back", flush=True)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)  # nothing comes between the vehicle and its old values
        if not kept:
            put_back(vehicle, before, memory)
        memory.unlink(missing_ok=True)
    return status


def put_back(vehicle: Vehicle, values: Mapping[str, float], memory: Path) -> None:
    """Sets every value, as long as the vehicle answers; then forgets them. Raises DescriptionError with what it did not take."""
    vehicle.watch(False)
    left = dict(values)
    for name, value in values.items():
        with suppress(TroubleError):
            vehicle.set(name, value)
            del left[name]
    if left:
        rest = ", ".join(f"{name} {value:g}" for name, value in left.items())
        raise DescriptionError(f"the vehicle did not take {rest}; set them by hand, or start again: {memory} keeps them")
    memory.unlink(missing_ok=True)
    print("old values are back: " + ", ".join(f"{name} {value:g}" for name, value in values.items()), flush=True)


def _steps(
    objective: Objective,
    vehicle: Vehicle,
    person: Person,
    now: dict[str, float],
    bounds: Mapping[str, tuple[float, float]],
    steps: int,
    seconds: float,
) -> bool:
    """The steps; whether the person keeps what was found. `now` follows."""
    best = _cost(objective, vehicle.look(seconds))
    print(f"as it is: {best:.4f}", flush=True)
    for number, (name, value) in zip(range(1, steps + 1), proposals(now, bounds), strict=False):
        answer = person.answer(f"step {number}: {name} {now[name]:g} -> {value:g}? [y/n/q]")
        if answer == "q":
            break
        if answer != "y":
            continue
        vehicle.set(name, value)
        found = _cost(objective, vehicle.look(seconds))
        if found < BETTER * best:
            best, now[name] = found, value
        else:
            vehicle.set(name, now[name])
        print(f"{found:.4f}: {'kept' if now[name] == value else 'put back'}; best {best:.4f}", flush=True)
    said = ", ".join(f"{name} {value:g}" for name, value in now.items())
    return person.answer(f"keep {said}? [y/n]") == "y"


def _cost(objective: Objective, metrics: Mapping[str, float]) -> float:
    """The objective's terms that can be seen from outside."""
    return sum(term.weight * metrics[term.metric] / term.per for term in objective.term if term.metric in metrics)
