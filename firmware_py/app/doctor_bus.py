"""Bus checks of `modcube doctor`: which nodes are present, their state, and the bus load."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from firmware_py.app.doctor import FAILED, OK, WARNING, Finding
from firmware_py.bus.codec import Codec, Frame, Received, Receiver
from firmware_py.bus.load import BIT_RATE, MEAN_LIMIT, bus_load, frame_bits, is_of_a_module
from firmware_py.bus.mapping import ESTOP_BOX
from firmware_py.bus.port import Port

LISTEN_S = 0.6
"""Listening time, before SYNCs are sent and while they are. A HEARTBEAT (2 Hz) comes once in it, a foreign SYNC (at least 50 Hz) within a
fraction of it, and every slow message of a module at least once in 200 ms, which are counted in ticks of the fleet's rate."""
STATES = ("boot", "disarmed", "armed", "time-out of commands", "e-stop", "fault")
FIT_STATES = (1, 2, 3)
"""Indices into STATES. A module in any other state turns no thruster when it is armed."""
ERRORS = ("bad CRC", "bad counter", "bad length", "command time-out", "sensor fault", "relay fault")
MAX_COMMANDS_PER_SYNC = 1.5
"""Commands to a module per SYNC above which more than one controller must be sending, however many of either were missed."""
COMMAND_TIMEOUT_BIT = 1 << 3
"""Error bit of MCU_STATUS. Not a fault here, because no one commands the module during the check."""
WRONG: Mapping[str, Mapping[int, str]] = {
    "Leak": {1: "water in its cabin"},
    "PowerStatus": {1: "a low supply", 2: "a critical supply", 15: "a dead supply sensor"},
    **{f"{name}Status": {2: f"a stale {name.lower()} sensor", 15: f"a dead {name.lower()} sensor"} for name in ("Gyro", "Accel", "Depth")},
    **{f"EscStatus{number}": {1: f"a fault of ESC {number}", 2: f"an ESC {number} that is too hot"} for number in range(1, 9)},
    "NodeState": {0: "that it starts", 3: "a fault of its own"},
    **{f"RelayEcho{face}": {3: f"a fault of relay {face}"} for face in "ABCDEF"},
}
"""Faults that a node reports, by field and value. A silent ESC is left out: an MCU reports that also of one that the vehicle lacks."""


@dataclass(slots=True)
class Seen:
    """Everything received from one bus."""

    seconds: float = 0.0
    bits: int = 0
    frames: int = 0
    sync: int = 0
    commands: dict[int, int] = field(default_factory=dict)
    """How often each module, by number, was commanded, counted by its THRUSTER_CMD_A."""
    estop: set[int] = field(default_factory=set)
    status: dict[int, tuple[int, int, int]] = field(default_factory=dict)
    """By module: version, errors, state."""
    wrong: dict[int, dict[str, None]] = field(default_factory=dict)
    """By number: faults that its frames reported, each once, in order."""
    messages: dict[int, set[str]] = field(default_factory=dict)
    """By number: names of the messages received."""
    dropped: dict[str, int] = field(default_factory=dict)


def look_at(port: Port, codec: Codec, rate_hz: int, wait: Callable[[float], None]) -> Seen:
    """Listens to the bus; without a foreign SYNC, then sends SYNCs at `rate_hz`. `wait` sleeps for a number of seconds."""
    seen, receiver = Seen(), Receiver(codec)
    tick_s, ticks = 1.0 / rate_hz, round(LISTEN_S * rate_hz)
    port.receive()
    for _ in range(ticks):
        wait(tick_s)
        take(port, receiver, seen, tick_s)
    if not seen.sync:
        seen = Seen()
        sync = codec.message("SYNC")
        for tick in range(ticks):
            frame = sync.encode(0, (tick,))
            port.send(frame)
            count(frame, seen)
            wait(tick_s)
            take(port, receiver, seen, tick_s)
    seen.dropped = {kind: number for kind, number in receiver.dropped.items() if number}
    return seen


def count(frame: Frame, seen: Seen) -> None:
    """Counts a frame into the bus load."""
    seen.bits += frame_bits(len(frame.data))
    seen.frames += 1


def take(port: Port, receiver: Receiver, seen: Seen, tick_s: float) -> None:
    """Takes the frames that arrived in one tick, of `tick_s`."""
    seen.seconds += tick_s
    for frame in port.receive():
        count(frame, seen)
        received = receiver.accept(frame)
        if received is None:
            continue
        name = received.message.name
        seen.sync += name == "SYNC"
        if name == "THRUSTER_CMD_A":
            seen.commands[received.number] = seen.commands.get(received.number, 0) + 1
        if name == "ESTOP":
            seen.estop.add(received.number)
        if name == "MCU_STATUS":
            _, version, errors, state = received.values
            seen.status[received.number] = (version, seen.status.get(received.number, (0, 0, 0))[1] | errors, state)
        seen.messages.setdefault(received.number, set()).add(name)
        seen.wrong.setdefault(received.number, {}).update(dict.fromkeys(complaints(received)))


def complaints(received: Received) -> Iterator[str]:
    """Faults that a frame reports."""
    for name, value in zip(received.message.fields, received.values, strict=True):
        if word := WRONG.get(name, {}).get(int(value)):
            yield word


def judge(title: str, seen: Seen, numbers: list[int], rate_hz: int, codec: Codec) -> list[Finding]:
    """Findings about a bus on which the modules `numbers` should be."""
    findings = [judge_module(title, number, seen, codec) for number in numbers]
    strangers = sorted(set(seen.status) - set(numbers))
    if strangers:
        names = ", ".join(str(number) for number in strangers)
        findings.append(
            Finding(title, WARNING, f"module {names} answers and is not in the fleet", "see the fleet file")
        )
    if seen.estop:
        who = ", ".join(str(number) for number in sorted(seen.estop))
        findings.append(Finding(title, WARNING, f"e-stop raised by number {who}", "release it where it was raised"))
    findings += judge_box(title, seen)
    findings += judge_commands(title, seen)
    if seen.sync:
        findings.append(Finding(title, OK, "a controller runs on it: looked on, sent nothing"))
    if not any("TAG_POSITION" in messages for messages in seen.messages.values()):
        findings.append(Finding(title, WARNING, "no tag is seen", "is the camera on, and a tag in its view?"))
    if seen.dropped:
        text = ", ".join(f"{number} {kind}" for kind, number in seen.dropped.items())
        findings.append(Finding(title, WARNING, f"bad frames: {text}", "wiring, or a node with another DBC"))
    return [*findings, judge_load(title, seen, numbers, rate_hz, codec)]


def judge_box(title: str, seen: Seen) -> Iterator[Finding]:
    """Finding about the e-stop box, if one says that it is there; `judge` tells of one that only stops."""
    if seen.wrong.get(ESTOP_BOX):
        yield Finding(title, WARNING, f"the e-stop box reports {', '.join(seen.wrong[ESTOP_BOX])}", "see docs/mcu.md")
    elif "HEARTBEAT" in seen.messages.get(ESTOP_BOX, ()):
        yield Finding(title, OK, f"the e-stop box, number {ESTOP_BOX}, speaks")


def judge_commands(title: str, seen: Seen) -> Iterator[Finding]:
    """Finds modules commanded by a second controller. The one controller of a bus commands each module once after each SYNC."""
    commanded = sorted(number for number, count in seen.commands.items() if count > MAX_COMMANDS_PER_SYNC * seen.sync)
    if not commanded:
        return
    numbers = ", ".join(str(number) for number in commanded)
    who = "two controllers command" if seen.sync else "somebody who sends no SYNC commands"
    yield Finding(title, WARNING, f"{who} module {numbers}", "a vehicle, script or canplayer that still runs; one controller a bus")


def judge_module(title: str, number: int, seen: Seen, codec: Codec) -> Finding:
    """Finding about one module of the fleet."""
    if number not in seen.status:
        return Finding(title, FAILED, f"module {number} is silent", "is it powered, its number set? candump shows ids")
    version, errors, state = seen.status[number]
    text = f"module {number}: version {version}, {STATES[state] if state < len(STATES) else state}"
    words = [word for bit, word in enumerate(ERRORS) if errors & ~COMMAND_TIMEOUT_BIT & 1 << bit] + [*seen.wrong.get(number, ())]
    missing = sorted(expected_of(codec) - seen.messages[number])
    if words:
        return Finding(title, WARNING, f"{text}; reports {', '.join(words)}", "see can_dbc/README.md")
    if state not in FIT_STATES:
        return Finding(title, WARNING, text, "CLEAR_ESTOP ends an e-stop; boot and fault are the module's own: switch it off and on")
    if missing:
        return Finding(title, WARNING, f"{text}; never sent {', '.join(missing)}", "a sensor or ESC of it may be dead")
    return Finding(title, OK, text)


def expected_of(codec: Codec) -> set[str]:
    """Names of the messages that every module sends."""
    return {message.name for message in codec.messages if is_of_a_module(message)}


def judge_load(title: str, seen: Seen, numbers: list[int], rate_hz: int, codec: Codec) -> Finding:
    """Finding about the bus load now and the highest expected in flight."""
    seconds = max(seen.seconds, 1.0 / rate_hz)
    now = seen.bits / BIT_RATE / seconds
    load = bus_load(codec, numbers, rate_hz)
    text = (
        f"{seen.frames / seconds:.0f} frames/s, {100 * now:.0f} % of the bus; "
        f"in flight at {rate_hz} Hz {100 * load.mean:.0f} %, fullest tick {100 * load.fullest_tick:.0f} %"
    )
    if now > MEAN_LIMIT or not load.is_allowed:
        return Finding(title, WARNING, text, "fewer ticks, or modules on a second bus (tools/bus_load.py)")
    return Finding(title, OK, text)
