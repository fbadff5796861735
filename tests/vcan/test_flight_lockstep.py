"""The bench in lockstep on real SocketCAN: same bytes as on the virtual bus, also beside foreign frames; and flights with link events.

Reduced lengths by default; with MODCUBE_FULL=1 the whole spiral and a thousand link events.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from firmware_py.app.firmware import BusFrame
from firmware_py.bus.codec import Codec, Frame, Receiver
from firmware_py.bus.port import open_port
from firmware_py.core.transitions import State
from firmware_py.core.types import Inputs, Outputs
from hil.scenario import Scenario, load_scenario
from tests.figures import figure
from tests.vcan.can_utils import LoggedFrame, candump, cangen_flood, canplayer, cansend
from tests.vcan.flight_bench import FULL, bench_on, between, frame_of, record, sent, short
from tests.vcan.link_events import BadDay
from tests.vcan.links import Interface

SHORT = short("spiral", 0.8)
COMPARED = load_scenario("spiral") if FULL else SHORT
HEARD_TICKS = 40
"""Number of ticks during which candump is read."""
FLOOD_ID = 0x71E
"""HEARTBEAT of number 30, with a wrong length: stops no node and commands nothing. 0x000..0x01F would stop every node."""
FLOOD_GAP_MS = 2.0
"""A flood at full speed overruns a reader in Python; that is tested in real time, where frames may be lost."""
ARMED_TICK, SYNC_TICK, ESTOP_TICK = 150, 165, 185
CHUNK_FRAMES = 120
"""Frames played back at once; a socket holds at least 278 unread frames."""
CHUNKS = 3
"""Number of chunks played, spread over a log, in the short form; the full form plays the whole log."""
EVENTS = 250 if FULL else 16
SEEDS = range(4 if FULL else 1)
TICKS_APART = (1, 25)
RESUMED_TICKS = 50
"""Longest time until the flight resumes, 0.5 s."""
MCU_DISARMED, MCU_ARMED, MCU_STOPPED = 1, 2, 4
"""States in MCU_STATUS."""


class Flown(NamedTuple):
    """One flight on vcan0: its log, and the frames of its first ticks from candump."""

    log: Path
    lines: list[str]
    heard: list[LoggedFrame]


@pytest.fixture(scope="module")
def on_virtual(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Scenario], list[str]]:
    """on_virtual(scenario): the lines of can.log from a virtual bus; each scenario is flown once."""

    @cache
    def fly_it(scenario: Scenario) -> list[str]:
        with bench_on("virtual:reference", scenario) as bench:
            return record(bench, tmp_path_factory.mktemp("virtual"))

    return fly_it


@pytest.fixture(scope="module")
def on_vcan(vcan0: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flown]:
    folder = tmp_path_factory.mktemp("vcan")
    frames: list[LoggedFrame] = []
    with bench_on(f"socketcan:{vcan0}", COMPARED) as bench, candump(vcan0) as listener:

        def listen(
            received: Sequence[BusFrame], to_bus: Sequence[BusFrame], inputs: Inputs, outputs: Outputs
        ) -> None:
            if outputs.tick <= HEARD_TICKS:
                frames.extend(listener.take(len(received) + len(to_bus)))
                if outputs.tick == HEARD_TICKS:
                    listener.close()

        yield Flown(folder / "can.log", record(bench, folder, [listen]), frames)


def test_spiral_over_socketcan_is_the_spiral_over_virtual_byte_for_byte(
    on_virtual: Callable[[Scenario], list[str]], on_vcan: Flown
) -> None:
    reference = on_virtual(COMPARED)
    different = sum(a != b for a, b in zip_longest(on_vcan.lines, reference))
    figure("spiral in lockstep over vcan0: frames sent", len(sent(on_vcan.lines)))
    figure("spiral in lockstep over vcan0: lines of can.log that differ from virtual", different)
    assert len(sent(on_vcan.lines)) >= 3 * 100 * COMPARED.task.duration_s
    assert sent(on_vcan.lines) == sent(reference)
    assert different == 0


def test_candump_hears_every_frame_of_the_flight_in_the_order_of_the_log(on_vcan: Flown) -> None:
    logged = [frame_of(line) for line in on_vcan.lines[: len(on_vcan.heard)]]
    assert len(logged) >= 5 * HEARD_TICKS
    assert [Frame(frame.identifier, frame.data) for frame in on_vcan.heard] == logged


def test_log_of_a_flight_played_back_decodes_to_the_same_messages(
    on_vcan: Flown, link: Interface, tmp_path: Path
) -> None:
    codec = Codec.load()
    decoded = 0
    last = len(on_vcan.lines) - CHUNK_FRAMES
    starts = range(0, last, CHUNK_FRAMES if FULL else last // CHUNKS)
    with open_port(f"socketcan:{link.name}") as port:
        for start in starts:
            lines = on_vcan.lines[start : start + CHUNK_FRAMES]
            (tmp_path / "part.log").write_text("\n".join(lines) + "\n")
            canplayer(tmp_path / "part.log", link.name, logged="can0")
            played = port.receive()
            recorded, heard = Receiver(codec), Receiver(codec)
            messages = [recorded.accept(frame_of(line)) for line in lines]
            assert None not in messages
            assert [heard.accept(frame) for frame in played] == messages
            decoded += len(messages)
    figure("log played back by canplayer: frames that decode to the same messages", decoded)


def test_flight_beside_a_stranger_s_frames_sends_what_it_sends_alone(
    on_virtual: Callable[[Scenario], list[str]], link: Interface, tmp_path: Path
) -> None:
    with ExitStack() as stack:
        bench = stack.enter_context(bench_on(f"socketcan:{link.name}", SHORT))

        def flood(received: Sequence[BusFrame], to_bus: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
            if outputs.tick == ARMED_TICK:  # earlier, so many bad frames would prevent arming
                assert outputs.records[0].state == State.ARMED
                stack.enter_context(cangen_flood(link.name, FLOOD_ID, FLOOD_GAP_MS))

        beside = sent(record(bench, tmp_path / "beside", [flood]))
        assert bench.firmware.collector.dropped["length"] >= 20
        assert bench.nodes.receiver.dropped["length"] >= 20
    assert beside == sent(on_virtual(SHORT))


def test_foreign_sync_is_an_alarm_and_an_estop_stops_the_thrusters(link: Interface) -> None:
    events: list[str] = []
    armed: list[bool] = []
    turning: list[bool] = []
    mcu: list[int] = []
    with bench_on(f"socketcan:{link.name}", short("hover", 0.8, settle_s=1.5)) as bench:

        def watch(received: Sequence[BusFrame], to_bus: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
            if outputs.tick == SYNC_TICK:
                cansend(link.name, 0x020, (12345).to_bytes(4, "little"))
            if outputs.tick == ESTOP_TICK:
                cansend(link.name, 0x01E, b"")
            events.extend(event.text for event in outputs.events)
            armed.append(outputs.records[0].state == State.ARMED)
            turning.append(bool(np.any(outputs.modules[0].thrusters)))
            mcu.append(inputs.modules[0].mcu_state)

        bench.fly([watch])
        assert bench.firmware.collector.faults["foreign_sync"] == 1
    assert any("SYNC" in text for text in events), events
    assert all(armed[SYNC_TICK : ESTOP_TICK - 1])
    assert not any(armed[ESTOP_TICK + 2 :])
    assert not any(turning[ESTOP_TICK + 2 :])
    assert set(mcu[ESTOP_TICK + 2 : ESTOP_TICK + 18]) == {MCU_STOPPED}
    assert mcu[-1] == MCU_DISARMED  # 200 ms without ESTOP and with DISARMED commands: the module releases, the robot stays stopped


@pytest.mark.parametrize("seed", SEEDS)
def test_flight_goes_on_through_random_link_events(link: Interface, seed: int) -> None:
    day = BadDay(link, seed)
    scenario = short("hover", duration_s=EVENTS * (sum(TICKS_APART) / 2 + 1) / 100 + 1.0)
    resumed: list[int] = []
    errors: list[float] = []
    with bench_on(f"socketcan:{link.name}", scenario) as bench:
        countdown = 200 + day.random.randint(*TICKS_APART)
        place = day.random.randint(0, 1)
        waiting = 0

        def strike_when_due(here: int) -> None:
            nonlocal countdown, place, waiting
            if here != place or countdown > 0 or (sum(day.counts.values()) >= EVENTS and day.state == "up"):
                return
            was_up = day.state == "up"
            if day.strike() == "up" and not was_up:
                waiting = 0
            countdown, place = day.random.randint(*TICKS_APART), day.random.randint(0, 1)

        def watch(received: Sequence[BusFrame], to_bus: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
            nonlocal countdown, waiting
            module = inputs.modules[0]
            flying = module.answered and module.mcu_state == MCU_ARMED and outputs.records[0].state == State.ARMED
            if outputs.tick > 200:
                waiting = 0 if flying or day.state != "up" else waiting + 1
                resumed.append(waiting)
                errors.append(float(np.linalg.norm(bench.nodes.world.truth(0).p_wm - scenario.task.centre_m)))
            strike_when_due(1)
            countdown -= 1

        between(bench, lambda: strike_when_due(0))
        bench.fly([watch])
        assert sum(day.counts.values()) >= EVENTS
        assert day.state == "up"
    figure("lockstep over vcan, link events", sum(day.counts.values()))
    figure("lockstep over vcan, link events: resumed within", max(resumed) / 100, "s")
    figure("lockstep over vcan, link events: off its place by at most", 1e3 * max(errors), "mm")
    assert max(resumed) <= RESUMED_TICKS
    assert resumed[-1] == 0
