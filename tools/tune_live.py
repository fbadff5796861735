"""tune_gains --live: tunes a hovering vehicle through MAVLink parameters, one confirmed step at a time.

A step changes one parameter, up or down by a factor; a change that lowers the objective is kept, any other is reverted at once. A person
confirms every step. On a fail-safe, an e-stop, a disarmed vehicle, another mode, silence, an interrupt or an error of this program, every
parameter is restored to its initial value; also when the program is started again after it was killed.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Protocol, cast

import numpy as np
from tune_objective import Objective
from tune_vehicle import SEEN, TroubleError, Vehicle, connect

from firmware_py.description.parameters import registry
from firmware_py.description.schema import DescriptionError
from firmware_py.ground.files import write_atomically

FACTOR, SMALLEST_FACTOR = 1.25, 1.03
"""Factor of a step, whose square root is used after a round in which nothing helped, and the factor at which the search ends."""
BETTER = 0.97
"""Share of the best cost that counts as better: two observations of one hover differ by a per cent or two."""
BEFORE_FILE = "live-before.json"
ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end the tuning; SIGHUP comes when the terminal is closed or the connection is lost."""


class Person(Protocol):
    """The person who confirms the steps."""

    def answer(self, question: str) -> str:
        """Returns y, n or q. Raises TroubleError when the vehicle gets into trouble meanwhile."""
        ...


class Typist:
    """A person at the terminal. The vehicle is monitored while waiting for an answer."""

    def __init__(self, vehicle: Vehicle, stream: BinaryIO) -> None:
        """`stream` is unbuffered, so that select sees all of its data."""
        self._vehicle, self._stream = vehicle, stream

    def answer(self, question: str) -> str:
        """First letter of the typed answer; n for an empty line, q at the end of the input. Raises TroubleError."""
        print(question, end=" ", flush=True)
        while not select.select([self._stream], [], [], 0.0)[0]:
            self._vehicle.listen(0.1)
        line = self._stream.readline()
        return (line.decode(errors="replace").strip().lower() or "n")[0] if line else "q"


def proposals(now: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]) -> Iterator[tuple[str, float]]:
    """Steps, as name and value, one parameter after the other, until the factor is too small. `now` is read again for each.

    A step that did not change `now` is not proposed again.
    """
    factor = FACTOR
    refused: set[tuple[str, float]] = set()
    while factor > SMALLEST_FACTOR:
        helped = False
        for name in bounds:
            for way in (factor, 1.0 / factor):
                before = now[name]
                value = float(str(np.float32(_stepped(before, way, bounds[name]))))
                if np.float32(value) == np.float32(before) or (name, value) in refused:
                    continue
                yield name, value
                if now[name] != before:
                    helped = True
                    break
                refused.add((name, value))
        factor = factor if helped else factor**0.5


def _stepped(before: float, way: float, bounds: tuple[float, float]) -> float:
    """`before` times `way`, clamped to the bounds; a value outside them moves towards them by that factor at most, and never away."""
    least, most = sorted((before, before * way))
    return min(max(min(max(before * way, bounds[0]), bounds[1]), least), most)


def tune_live(objective: Objective, live: str, steps: int, seconds: float, out: Path) -> int:
    """Tunes the vehicle at mavlink:ADDRESS, with typed answers; returns the exit status as `tune` does. Raises DescriptionError."""
    scheme, _, address = live.partition(":")
    if scheme != "mavlink" or not address:
        raise DescriptionError(f"--live {live!r} is not an address; it needs mavlink:ADDRESS, such as mavlink:udpin:127.0.0.1:14550")
    for number in ENDINGS:
        signal.signal(number, _end)
    with closing(connect(address)) as link, open(0, "rb", buffering=0, closefd=False) as stdin:
        vehicle = Vehicle(link)
        return tune(objective, vehicle, Typist(vehicle, cast(BinaryIO, stdin)), steps, seconds, out)


def _end(number: int, frame: object) -> None:
    """Interrupts on the first of ENDINGS. Ignores those that follow, as when a terminal is closed, while the old values are restored."""
    for each in ENDINGS:
        signal.signal(each, signal.SIG_IGN)
    raise KeyboardInterrupt


def tune(objective: Objective, vehicle: Vehicle, person: Person, steps: int, seconds: float, out: Path) -> int:
    """Tunes; returns the exit status: 0 ended by the person, 1 trouble, old values restored. Raises DescriptionError."""
    seen = [term.metric for term in objective.term if term.metric in SEEN]
    if not seen:
        raise DescriptionError(f"--live: the objective has no term that can be seen from outside; it needs {' or '.join(SEEN)}")
    print(f"seen from outside: {', '.join(seen)}", flush=True)
    wire = {dotted: limits.mavlink for dotted, limits in registry()}
    bounds = {wire[s.parameter]: (s.low, s.high) for s in objective.search if wire[s.parameter]}
    memory = out / BEFORE_FILE
    try:
        if memory.exists():
            _say(f"{memory} is of a run that did not end: its values go back first")
            put_back(vehicle, json.loads(memory.read_text(encoding="utf-8")), memory)
        before = {name: vehicle.get(name) for name in bounds}
        vehicle.watch(True)
        vehicle.wait_for_heartbeat()
    except TroubleError as error:
        raise DescriptionError(f"--live: {error}; let it hover, armed, before it is tuned") from None
    write_atomically(memory, json.dumps(before).encode())
    kept, status = False, 0
    try:
        kept = _steps(objective, vehicle, person, dict(before), bounds, steps, seconds)
    except (TroubleError, OSError, KeyboardInterrupt) as error:
        status = 1
        _say(f"\n{str(error) or 'interrupted'}: old values go back")
    finally:
        with _undisturbed():
            if not kept:
                put_back(vehicle, before, memory)
            memory.unlink(missing_ok=True)
    return status


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Ignores ENDINGS while the old values are restored."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in ENDINGS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def put_back(vehicle: Vehicle, values: Mapping[str, float], memory: Path) -> None:
    """Restores every value, then deletes their file. Raises DescriptionError with the values not accepted within RESTORE_S."""
    vehicle.watch(False)
    left = vehicle.restore(values)
    if left:
        rest = ", ".join(f"{name} {value:g}" for name, value in left.items())
        raise DescriptionError(f"the vehicle did not take {rest}; set them by hand, or start again: {memory} keeps them")
    memory.unlink(missing_ok=True)
    _say("old values are back: " + ", ".join(f"{name} {value:g}" for name, value in values.items()))


def _say(text: str) -> None:
    """Prints a line on stdout, or on stderr if stdout is gone; never fails, so that what follows is done."""
    with suppress(OSError, ValueError):
        try:
            print(text, flush=True)
        except OSError:
            print(text, file=sys.stderr, flush=True)
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # its unflushed rest must not change the exit status


def _steps(
    objective: Objective,
    vehicle: Vehicle,
    person: Person,
    now: dict[str, float],
    bounds: Mapping[str, tuple[float, float]],
    steps: int,
    seconds: float,
) -> bool:
    """Runs the steps and updates `now`; returns whether the person keeps the result."""
    for name, (low, high) in bounds.items():
        if not np.float32(low) <= np.float32(now[name]) <= np.float32(high):
            leads = f"by a factor of {FACTOR:g} a step at most" if now[name] * (low + high) > 0.0 else "by no factor, so it stays"
            print(f"{name} {now[name]:g} is outside the objective's {low:g} to {high:g}: it moves there {leads}", flush=True)
    best = _cost(objective, vehicle.measure_hover(seconds))
    print(f"as it is: {best:.4f}", flush=True)
    for number, (name, value) in zip(range(1, steps + 1), proposals(now, bounds), strict=False):
        answer = person.answer(f"step {number}: {name} {now[name]:g} -> {value:g}? [y/n/q]")
        if answer == "q":
            break
        if answer != "y":
            continue
        vehicle.set(name, value)
        found = _cost(objective, vehicle.measure_hover(seconds))
        if found < BETTER * best:
            best, now[name] = found, value
        else:
            vehicle.set(name, now[name])
        print(f"{found:.4f}: {'kept' if now[name] == value else 'put back'}; best {best:.4f}", flush=True)
    said = ", ".join(f"{name} {value:g}" for name, value in now.items())
    return person.answer(f"keep {said}? [y/n]") == "y"


def _cost(objective: Objective, metrics: Mapping[str, float]) -> float:
    """Sum of the objective's terms that can be observed from outside."""
    return sum(term.weight * metrics[term.metric] / term.per for term in objective.term if term.metric in metrics)
