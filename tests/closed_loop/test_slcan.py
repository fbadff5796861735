"""A module behind serial CAN adapters flies as on any bus, and continues after an adapter is unplugged and plugged in again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from firmware_py.app.firmware import BusFrame
from firmware_py.bus.port import open_port
from firmware_py.core.transitions import State
from firmware_py.core.types import Inputs, Outputs
from firmware_py.description.parameters import Parameters
from hil.bench import Bench, open_bench
from tests.closed_loop.flights import shortened
from tests.unit.ports import Cable

HOVER_S = 1.0
PULLED_TICKS = 5
pytestmark = pytest.mark.slow


def fly(folder: Path | None, observe: Callable[[Bench, int, Outputs], None] | None = None) -> list[tuple[BusFrame, ...]]:
    """The frames that the firmware sent in each tick of a hover, over slcan adapters in `folder` or over the virtual bus."""
    log: list[tuple[BusFrame, ...]] = []

    def note(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        log.append(tuple(sent))
        if observe is not None:
            observe(bench, outputs.tick, outputs)

    with ExitStack() as stack:
        bench = open_bench(stack, shortened("hover", HOVER_S), 0, Parameters())
        if folder is not None:
            cable = Cable(folder)
            stack.callback(lambda: cable.files and cable.unplug())
            ports = [stack.enter_context(open_port(address)) for address in cable.addresses]
            bench.firmware_port, bench.plant_port = ports
        bench.fly([note])
    return log


def test_hover_over_serial_adapters_is_the_hover_over_the_virtual_bus_frame_for_frame(tmp_path: Path) -> None:
    assert fly(tmp_path) == fly(None)


def test_adapters_pulled_out_for_50_ms_in_flight_are_taken_up_again_and_the_module_stays_armed(tmp_path: Path) -> None:
    plugs = ExitStack()
    armed: dict[int, bool] = {}
    begun: list[int] = []

    def pull(bench: Bench, tick: int, outputs: Outputs) -> None:
        armed[tick] = outputs.records[0].state == State.ARMED
        if not begun and armed[tick] and all(armed.get(tick - ago, False) for ago in range(50)):
            begun.append(tick)
            for link in tmp_path.iterdir():
                link.unlink()
        if begun and tick == begun[0] + PULLED_TICKS:
            again = Cable(tmp_path)
            plugs.callback(again.unplug)

    with plugs:
        log = fly(tmp_path, pull)
    assert begun, "it armed"
    after = [on for tick, on in armed.items() if tick > begun[0]]
    assert all(after)
    thrusts = {frame.data[:6] for sent in log[begun[0] + 50 :] for _, frame in sent if frame.id == 0x081}
    assert len(thrusts) > 20
