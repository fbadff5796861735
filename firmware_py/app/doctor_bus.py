"""`modcube doctor` on a bus: who is there, in which state, and how full it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from firmware_py.app.doctor import FAILED, OK, WARNING, Finding
from firmware_py.bus.codec import Codec, Frame, Received, Receiver
from firmware_py.bus.load import BIT_RATE, MEAN_LIMIT, bus_load, frame_bits, is_of_a_module
from firmware_py.bus.port import Port

LISTEN_S = 0.3
"""A foreign SYNC shows itself in a fraction of it (50 Hz at least)."""
TICK_S = 0.01
TICKS = 60
"""SYNCs sent: every slow message of a module comes at least once in 200 ms but HEARTBEAT."""
STATES = ("boot", "disarmed", "armed", "time-out of commands", "e-stop", "fault")
FIT_STATES = (1, 2, 3)
"""Of those; a module in another one turns no thruster when it is armed."""
ERRORS = ("bad CRC", "bad counter", "bad length", "command time-out", "sensor fault", "relay fault")
TOO_MANY = 1.5
"""Commands of a module for each SYNC, which are more than one controller sends, however many of either were missed."""
TIME_OUT = 1 << 3
"""Of MCU_STATUS: nobody commands while the doctor looks, so it is no fault."""
WRONG: Mapping[str, Mapping[int, str]] = {
    "Leak": {1: "water in its cabin"},
    "PowerStatus": {1: "a low supply", 2: "a critical supply", 15: "a dead supply sensor"},
    **{f"{name}Status": {2: f"a stale {name.lower()} sensor", 15: f"a dead {name.lower()} sensor"} for name in ("Gyro", "Accel", "Depth")},
    **{f"EscStatus{number}": {1: f"a fault of ESC {number}", 2: f"an ESC {number} that is too hot"} for number in range(1, 9)},
    **{f"RelayEcho{face}": {3: f"a fault of relay {face}"} for face in "ABCDEF"},
}
"""By field and value, what a module's frames say of it. A silent ESC is not there: an MCU says so of one that the vehicle lacks."""


@dataclass(slots=True)
class Seen:
    """What came from one bus."""

    seconds: float = 0.0
    bits: int = 0
    frames: int = 0
    sync: int = 0
    commands: dict[int, int] = field(default_factory=dict)
    """By number of the module: how often it was commanded, by its THRUSTER_CMD_A."""
    estop: set[int] = field(default_factory=set)
    status: dict[int, tuple[int, int, int]] = field(default_factory=dict)
    """By module: version, errors, state."""
    wrong: dict[int, dict[str, None]] = field(default_factory=dict)
    """By module: what its frames said to be wrong, each once, in order."""
    messages: dict[int, set[str]] = field(default_factory=dict)
    """By number: names of what came."""
    dropped: dict[str, int] = field(default_factory=dict)


def look_at(port: Port, codec: Codec, wait: Callable[[float], None]) -> Seen:
    """Listens; where nobody sends SYNC, sends TICKS of them. `wait` lets so many seconds pass."""
    seen, receiver = Seen(), Receiver(codec)
    port.receive()
    for _ in range(round(LISTEN_S / TICK_S)):
        wait(TICK_S)
        take(port, receiver, seen)
    if not seen.sync:
        seen = Seen()
        sync = codec.message("SYNC")
        for tick in range(TICKS):
            frame = sync.encode(0, (tick,))
            port.send(frame)
            count(frame, seen)
            wait(TICK_S)
            take(port, receiver, seen)
    seen.dropped = {kind: number for kind, number in receiver.dropped.items() if number}
    return seen


def count(frame: Frame, seen: Seen) -> None:
    """A frame's share of the bus."""
    seen.bits += frame_bits(len(frame.data))
    seen.frames += 1


def take(port: Port, receiver: Receiver, seen: Seen) -> None:
    """What came in one tick."""
    seen.seconds += TICK_S
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
    """What a frame says to be wrong."""
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
    findings += judge_commands(title, seen)
    if seen.sync:
        findings.append(Finding(title, OK, "a controller runs on it: looked on, sent nothing"))
    if not any("TAG_POSITION" in messages for messages in seen.messages.values()):
        findings.append(Finding(title, WARNING, "no tag is seen", "is the camera on, and a tag in its view?"))
    if seen.dropped:
        text = ", ".join(f"{number} {kind}" for kind, number in seen.dropped.items())
        findings.append(Finding(title, WARNING, f"bad frames: {text}", "wiring, or a node with another DBC"))
    return [*findings, judge_load(title, seen, numbers, rate_hz, codec)]


def judge_commands(title: str, seen: Seen) -> Iterator[Finding]:
    """Modules that are commanded by somebody who is not the one controller of the bus: that one commands once after each SYNC."""
    commanded = sorted(number for number, count in seen.commands.items() if count > TOO_MANY * seen.sync)
    if not commanded:
        return
    numbers = ", ".join(str(number) for number in commanded)
    who = "two controllers command" if seen.sync else "somebody who sends no SYNC commands"
    yield Finding(title, WARNING, f"{who} module {numbers}", "a vehicle, script or canplayer that still runs; one controller a bus")


def judge_module(title: str, number: int, seen: Seen, codec: Codec) -> Finding:
    """One module of the fleet."""
    if number not in seen.status:
        return Finding(title, FAILED, f"module {number} is silent", "is it powered, its number set? candump shows ids")
    version, errors, state = seen.status[number]
    text = f"module {number}: version {version}, {STATES[state] if state < len(STATES) else state}"
    words = [word for bit, word in enumerate(ERRORS) if errors & ~TIME_OUT & 1 << bit] + [*seen.wrong.get(number, ())]
    missing = sorted(expected_of(codec) - seen.messages[number])
    if words:
        return Finding(title, WARNING, f"{text}; reports {', '.join(words)}", "see can_dbc/README.md")
    if state not in FIT_STATES:
        return Finding(title, WARNING, text, "CLEAR_ESTOP ends an e-stop; boot and fault are the module's own: switch it off and on")
    if missing:
        return Finding(title, WARNING, f"{text}; never sent {', '.join(missing)}", "a sensor or ESC of it may be dead")
    return Finding(title, OK, text)


def expected_of(codec: Codec) -> set[str]:
    """What every module sends."""
    return {message.name for message in codec.messages if is_of_a_module(message)}


def judge_load(title: str, seen: Seen, numbers: list[int], rate_hz: int, codec: Codec) -> Finding:
    """How full the bus is, and will be at most."""
    now = seen.bits / BIT_RATE / max(seen.seconds, TICK_S)
    load = bus_load(codec, numbers, rate_hz)
    text = (
        f"{seen.frames / max(seen.seconds, TICK_S):.0f} frames/s, {100 * now:.0f} % of the bus; "
        f"in flight at {rate_hz} Hz {100 * load.mean:.0f} %, fullest tick {100 * load.fullest_tick:.0f} %"
    )
    if now > MEAN_LIMIT or not load.is_allowed:
        return Finding(title, WARNING, text, "fewer ticks, or modules on a second bus (tools/bus_load.py)")
    return Finding(title, OK, text)
