"""Another controller on the bus: a person hears of it, and is not talked to death."""

from firmware_py.app.firmware import compose
from firmware_py.bus.codec import Codec, Frame
from firmware_py.core.types import WARNING, Event
from firmware_py.description.fleet import single
from firmware_py.description.parameters import Parameters

CODEC = Codec.load()
PERIOD_NS = 10_000_000


def test_commands_of_somebody_else_are_told_at_once_and_every_ten_seconds_while_they_go_on() -> None:
    firmware = compose(single(), Parameters())
    told: list[tuple[int, Event]] = []
    for tick in range(1, 2501):
        strange = [(0, command(tick))] if 100 <= tick < 1500 else []
        _, outputs, _ = firmware.step(tick, tick * PERIOD_NS, strange, [])
        told += [(tick, event) for event in outputs.events if "somebody else" in event.text]
    expected = ((100, 1), (1100, 1001), (2100, 1400))
    assert told == [(tick, Event(WARNING, f"somebody else commands modules: {frames} frames")) for tick, frames in expected]


def command(tick: int) -> Frame:
    name, values = ("DOCK_CMD", (0,) * 6) if tick % 2 else ("THRUSTER_CMD_A", (0.0, 0.0, 0.0, 0.0, 1))
    return CODEC.message(name).encode(1, values, tick // 2 & 15)
