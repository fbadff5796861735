"""Observers called after each tick, in lockstep and in real time: logging, event output and bus monitoring."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from firmware_py.app.firmware import BusFrame
from firmware_py.bus.mapping import InputCollector
from firmware_py.bus.port import Port
from firmware_py.core.types import WARNING, Event, Inputs, Outputs
from firmware_py.runtime.recorder import Recorder

Observer = Callable[[Sequence[BusFrame], Sequence[BusFrame], Inputs, Outputs], None]
"""Called after each tick with the frames received and sent, the inputs and the outputs."""
FLUSH_EVERY_S = 0.5
UNUSED = {
    "id": "of an id that the DBC does not have",
    "number": "whose number their message does not have",
    "length": "of the wrong length",
    "crc": "with a wrong CRC",
    "counter": "with the counter of the one before",
    "range": "with a value out of range",
    "module": "of a module that the fleet does not have",
    "tag_unpaired": "with one half of a tag observation",
    "tag_stale": "of tags seen too long ago (CaptureTick, CaptureOffset)",
    "tag_future": "of tags seen after they came (CaptureTick, CaptureOffset)",
    "sensor": "of sensors that report a fault",
}
"""Words for the kinds of `InputCollector.unused`."""
LEAST_UNUSED = 5
"""In a second; a lost frame now and then leaves half a tag observation too."""


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


def watching_bus(port: Port, rate_hz: int) -> Observer:
    """An observer that checks the fault counters of a port once a second and warns of every kind that starts to grow."""
    return _watching(f"bus {port.address}", lambda: port.faults, 1, rate_hz)


def watching_frames(collector: InputCollector, rate_hz: int) -> Observer:
    """An observer that checks once a second how many frames came and were not used, and warns of every kind that starts to do so."""

    def read() -> dict[str, int]:
        return {UNUSED[kind]: count for kind, count in collector.unused.items() if kind in UNUSED}

    return _watching("frames not used", read, LEAST_UNUSED, rate_hz)


def _watching(name: str, read: Callable[[], Mapping[str, int]], least: int, rate_hz: int) -> Observer:
    """An observer that warns of every counter that grows by `least` in a second and did not in the second before."""
    counted, growing = dict(read()), set[str]()

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        nonlocal counted, growing
        if outputs.tick % rate_hz:
            return
        now, before = dict(read()), counted
        grown = {kind for kind, count in now.items() if count - before[kind] >= least}
        if fresh := sorted(grown - growing):
            words = ", ".join(f"{now[kind] - before[kind]} {kind}" for kind in fresh)
            outputs.events.append(Event(WARNING, f"{name}: in the last second {words}"))
        counted, growing = now, grown

    return observe
