"""The messages of one tick: all its inputs and signals. The recorder logs them, a replay compares them.

Topics, in the order in which a tick writes them:

- `/firmware/ticks`: tick number, time, number of frames and prepared results taken, e-stop flag, frames dropped so far.
- `/firmware/requests`: per request its tick and one line of JSON (`request_text`).
- `/firmware/bodyN`: all signals of one body, `body_signals`.
- `/firmware/docks`: per dock under way its faces, stage and tries, both currents, both conditions and the position errors.
- `/events`: severity (syslog) and text.

In real time two further topics describe the run itself, and no replay compares them: `/firmware/times` has every half second how ticks kept
their deadlines so far, `/firmware/busN` every second the counters of the port of bus N (frames lost, errors, times reopened).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

from firmware_py.core.types import BodyRecord, Inputs, Outputs
from firmware_py.description.signals import Layout, Row, Signal, TextLayout
from firmware_py.runtime.rate_keeper import LATENESS_EDGES_NS, RateKeeper
from firmware_py.runtime.request_text import request_text

TICKS, REQUESTS, DOCKS, EVENTS = "/firmware/ticks", "/firmware/requests", "/firmware/docks", "/events"
TIMES, BUS, BODY = "/firmware/times", "/firmware/bus", "/firmware/body"


def bus_topic(index: int) -> str:
    """Topic of the fleet's bus of that index."""
    return f"{BUS}{index}"


def is_of_the_machine(topic: str) -> bool:
    """Whether a topic describes the run rather than its ticks, so that it differs between runs with the same inputs."""
    return topic == TIMES or topic.startswith(BUS)


def body_topic(index: int) -> str:
    """Topic of the body of that index."""
    return f"{BODY}{index}"


TICK_SIGNALS = (
    Signal("tick", kind="int"),
    Signal("time_ns", unit="ns", kind="int"),
    Signal("received_frames", kind="int"),
    Signal("dropped_frames", kind="int"),
    Signal("estop", kind="bool"),
    Signal("prepared", kind="int"),
)


def body_signals(thrusters: int) -> tuple[Signal, ...]:
    """Signals of one body with that many thrusters, in the order in which `_body_values` gives them."""
    return (
        Signal("tick", kind="int"),
        Signal("time_ns", unit="ns", kind="int"),
        Signal("state", kind="int"),
        Signal("mode", kind="int"),
        Signal("level", kind="int"),
        Signal("p_wb", 3, "m"),
        Signal("q_wb", 4),
        Signal("nu", 6, "m/s, rad/s"),
        Signal("force_w", 3, "N"),
        Signal("moment_b", 3, "N m"),
        Signal("sigma_p", 3, "m"),
        Signal("sigma_q", 3, "rad"),
        Signal("tag_age_ns", unit="ns", kind="int"),
        Signal("nis"),
        Signal("nis_dof", kind="int"),
        Signal("rejected", kind="int"),
        Signal("ready", kind="bool"),
        Signal("starts", kind="int"),
        Signal("setpoint_p_wb", 3, "m"),
        Signal("setpoint_q_wb", 4),
        Signal("setpoint_v_w", 3, "m/s"),
        Signal("setpoint_w_b", 3, "rad/s"),
        Signal("setpoint_a_w", 3, "m/s^2"),
        Signal("setpoint_alpha_b", 3, "rad/s^2"),
        Signal("wrench_wanted", 6, "N, N m"),
        Signal("wrench_achieved", 6, "N, N m"),
        Signal("scale", 2),
        Signal("wrench_margin"),
        Signal("thrust_n", thrusters, "N"),
        Signal("commanded_n", thrusters, "N"),
    )


def _body_values(tick: int, time_ns: int, record: BodyRecord) -> tuple[Any, ...]:
    thrust = record.thrust
    return (
        tick,
        time_ns,
        record.state,
        record.mode,
        record.level,
        *record.estimate,
        *record.setpoint,
        record.wrench,
        thrust.achieved,
        thrust.scale,
        thrust.margin,
        thrust.force_n,
        record.commanded_n,
    )


DOCK_SIGNALS = (
    Signal("tick", kind="int"),
    Signal("time_ns", unit="ns", kind="int"),
    Signal("module_a", kind="int"),
    Signal("face_a", kind="int"),
    Signal("module_b", kind="int"),
    Signal("face_b", kind="int"),
    Signal("stage", kind="int"),
    Signal("tries", kind="int"),
    Signal("current_ma", 2, "mA"),
    Signal("current_holds", kind="bool"),
    Signal("position_holds", kind="bool"),
    Signal("gap_m", unit="m"),
    Signal("lateral_m", unit="m"),
    Signal("position_error_m", unit="m"),
)
"""Tick, time, then the fields of a DockRecord in their order."""


BINS = len(LATENESS_EDGES_NS) + 1
TIMES_SIGNALS = (
    Signal("tick", kind="int"),
    Signal("time_ns", unit="ns", kind="int"),
    Signal("overruns", kind="int"),
    Signal("skipped", kind="int"),
    Signal("lateness_worst_ns", unit="ns", kind="int"),
    Signal("compute_worst_ns", unit="ns", kind="int"),
    Signal("lateness_ticks", BINS, "ticks by how late they began: up to 1 us, 1.26 us, ... 1 s (ten bins to a decade), longer"),
    Signal("compute_ticks", BINS, "ticks by how long they ran, in the same bins"),
)


def bus_signals(kinds: Iterable[str]) -> tuple[Signal, ...]:
    """Signals of a port that counts these kinds of faults."""
    return Signal("tick", kind="int"), Signal("time_ns", unit="ns", kind="int"), *(Signal(kind, kind="int") for kind in kinds)


def times_values(tick: int, time_ns: int, keeper: RateKeeper) -> tuple[Any, ...]:
    """Values for the ticks so far, in the order of TIMES_SIGNALS."""
    late, ran = keeper.lateness, keeper.compute
    return tick, time_ns, keeper.overruns, keeper.skipped, late.worst_ns, ran.worst_ns, late.counts, ran.counts


class Message(NamedTuple):
    """One message of a tick."""

    topic: str
    layout: Layout | TextLayout
    data: bytes


class TickMessages:
    """Makes the messages of each tick; the same tick gives the same bytes."""

    def __init__(self) -> None:
        self.ticks = Layout("Tick", TICK_SIGNALS)
        self.requests = TextLayout("Request", ["tick"], "request")
        self.events = TextLayout("Event", ["tick", "severity"], "text")
        self.docks = Layout("Dock", DOCK_SIGNALS)
        self._tick_row, self._dock_row = self.ticks.row(), self.docks.row()
        self._bodies: dict[int, tuple[Layout, Row]] = {}

    def of(self, received: int, inputs: Inputs, outputs: Outputs) -> Iterator[Message]:
        """All messages of one tick, which took `received` frames."""
        tick, time_ns = outputs.tick, outputs.time_ns
        values = (tick, time_ns, received, inputs.dropped_frames, inputs.estop, len(inputs.prepared))
        yield Message(TICKS, self.ticks, self._tick_row.encode(values))
        for request in inputs.requests:
            yield Message(REQUESTS, self.requests, self.requests.encode(tick, request_text(request)))
        for record in outputs.records:
            layout, row = self.body(len(record.commanded_n))
            yield Message(body_topic(record.body), layout, row.encode(_body_values(tick, time_ns, record)))
        for dock in outputs.docks:
            yield Message(DOCKS, self.docks, self._dock_row.encode((tick, time_ns, *dock)))
        for event in outputs.events:
            yield Message(EVENTS, self.events, self.events.encode(tick, event.severity, event.text))

    def body(self, thrusters: int) -> tuple[Layout, Row]:
        """Layout of a body with that many thrusters, and a row to fill."""
        if thrusters not in self._bodies:
            layout = Layout("Body", body_signals(thrusters))
            self._bodies[thrusters] = layout, layout.row()
        return self._bodies[thrusters]
