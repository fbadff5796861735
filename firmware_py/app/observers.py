"""Observers called after each tick, in lockstep and in real time: logging, event output and bus monitoring."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from firmware_py.app.firmware import BusFrame
from firmware_py.bus.port import Port
from firmware_py.core.types import WARNING, Event, Inputs, Outputs
from firmware_py.runtime.recorder import Recorder

Observer = Callable[[Sequence[BusFrame], Sequence[BusFrame], Inputs, Outputs], None]
"""Called after each tick with the frames received and sent, the inputs and the outputs."""
FLUSH_EVERY_S = 0.5


def telling(say: Callable[[str], None]) -> Observer:
    """An observer that passes every event to `say`."""

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        for event in outputs.events:
            say(event_line(outputs.time_ns, event))

    return observe


def event_line(time_ns: int, event: Event) -> str:
    """One event as a line."""
    return f"{time_ns * 1e-9:9.3f} s  {event.text}"


def recording(recorder: Recorder, rate_hz: int) -> Observer:
    """An observer that writes every tick to `recorder`, in the order in which frames went over the bus.

    Flushes at once when a module arms or disarms, so that a restart after a kill knows which modules were armed. If `recorder` raises, the
    log ends: the loop goes on without this observer, and the next process must not take the last tick in the log for the end of the flight.
    """
    flush_every = max(1, round(FLUSH_EVERY_S * rate_hz))
    was_armed: list[bool] = []

    def record(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        buses = sorted({bus for bus, _ in sent})
        syncs = len(buses)
        for bus in buses:
            recorder.sent(outputs.time_ns, bus, [f for b, f in sent[:syncs] if b == bus])
            recorder.received(outputs.time_ns, bus, [f for b, f in received if b == bus])
            recorder.sent(outputs.time_ns, bus, [f for b, f in sent[syncs:] if b == bus])
        recorder.record(inputs, outputs)
        armed = [command.armed for command in outputs.modules]
        if armed != was_armed or outputs.tick % flush_every == 0:
            was_armed[:] = armed
            outputs.events += recorder.flush()

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        try:
            record(received, sent, inputs, outputs)
        except Exception:
            recorder.give_up()
            raise

    return observe


def recording_buses(recorder: Recorder, ports: Sequence[Port], rate_hz: int) -> Observer:
    """An observer that writes the fault counters of the ports to `recorder` once a second."""
    for bus, port in enumerate(ports):
        recorder.expect_bus(bus, port.faults)

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        if outputs.tick % rate_hz == 0:
            for bus, port in enumerate(ports):
                recorder.record_bus(bus, outputs.tick, outputs.time_ns, port.faults)

    return observe


def watching_buses(ports: Sequence[Port], rate_hz: int) -> Observer:
    """An observer that checks the fault counters of the ports once a second and warns of every kind that starts to grow."""
    counted = [dict(port.faults) for port in ports]
    growing: list[set[str]] = [set() for _ in ports]

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        if outputs.tick % rate_hz:
            return
        for place, port in enumerate(ports):
            now, before = dict(port.faults), counted[place]
            grown = {kind for kind, count in now.items() if count > before[kind]}
            if fresh := sorted(grown - growing[place]):
                words = ", ".join(f"{now[kind] - before[kind]} {kind}" for kind in fresh)
                outputs.events.append(Event(WARNING, f"bus {port.address}: in the last second {words}"))
            counted[place], growing[place] = now, grown

    return observe
