"""A recorded flight is replayed through the same code with the same result; any difference is named."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from firmware_py.app.replay import replay
from firmware_py.app.replay_report import replay_and_say
from firmware_py.core import kalman_filter
from firmware_py.core.limiter import Limiter
from firmware_py.description.schema import DescriptionError
from firmware_py.description.signals import MCAP_MAGIC, Layout, Signal, read_messages
from firmware_py.runtime import flight_log
from firmware_py.runtime.flight_log import LogError
from firmware_py.runtime.log_recovery import recover
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG, Recorder
from firmware_py.runtime.tick_messages import TICK_SIGNALS
from firmware_py.runtime.tick_messages import TICKS as TICKS_TOPIC
from hil.plant.fault_spec import Fault
from tests.closed_loop.flights import Fly, shortened

TICKS = 500
THRUSTER_CMD_A, GYRO = "081", "101"
"""Ids of the only module."""
NOISE = "\x1b" * 9000
"""Content that no line should hold and no terminal should receive."""


def spoil(path: Path, frame_id: str, tick: int, change: int) -> None:
    """Changes bits of the first data byte of the frame with that id in the given tick."""
    lines = path.read_text().splitlines(True)
    at = [i for i, line in enumerate(lines) if f" {frame_id}#" in line][tick - 1]
    head, _, data = lines[at].partition("#")
    lines[at] = f"{head}#{int(data[:2], 16) ^ change:02X}{data[2:]}"
    path.write_text("".join(lines))


@pytest.mark.slow
def test_flight_comes_out_to_the_byte(flown: Path) -> None:
    outcome = replay(flown)
    assert (outcome.first, outcome.ticks, outcome.torn) == (None, TICKS, "")
    assert outcome.seconds == pytest.approx(4.99)


@pytest.mark.slow
def test_replay_of_a_log_with_one_flipped_bit_fails_and_says_where_and_how_much_was_compared(log: Path) -> None:
    data = bytearray((log / SIGNAL_LOG).read_bytes())
    data[len(data) // 2] ^= 1
    (log / SIGNAL_LOG).write_bytes(data)
    said: list[str] = []
    assert replay_and_say(log, 0.0, said.append) == 1
    at = re.match(r"the log is damaged: signals\.mcap is damaged at byte (\d+); `modcube log recover ", said[0])
    assert at is not None and int(at[1]) <= len(data) // 2
    compared = re.match(rf"compared (\d+) of {TICKS} ticks, ", said[1])
    assert compared is not None and 0 < int(compared[1]) < TICKS
    assert said[-1] == "every byte is the same up to there"


@pytest.mark.slow
def test_replay_of_a_log_that_ends_too_early_passes_and_says_how_much_was_compared(log: Path) -> None:
    data = (log / SIGNAL_LOG).read_bytes()
    (log / SIGNAL_LOG).write_bytes(data[: len(data) // 2])
    said: list[str] = []
    assert replay_and_say(log, 0.0, said.append) == 0
    assert said[0].startswith("the log is torn: signals.mcap was not closed; ")
    assert re.match(rf"compared \d+ of {TICKS} ticks, ", said[1])


@pytest.mark.slow
def test_replay_of_frames_with_a_spoilt_block_fails(log: Path) -> None:
    data = (log / CAN_LOG).read_bytes()
    (log / CAN_LOG).write_bytes(data[:100_000] + 4096 * b"\0" + data[104_096:])
    said: list[str] = []
    assert replay_and_say(log, 0.0, said.append) == 1
    assert said[0].startswith("the log is damaged: can.log is damaged from tick ")
    (log / CAN_LOG).write_bytes(data[:-4096] + 4096 * b"\0")
    assert replay_and_say(log, 0.0, said.append) == 0, "a power loss leaves zeros at the end"


@pytest.mark.slow
def test_killed_process_goes_on_as_another_one(fly: Fly, tmp_path: Path) -> None:
    killed = Fault(kind="process_killed", at_s=3.0, until_s=3.5)
    scenario = dataclasses.replace(shortened("hover", duration_s=2.0, settle_s=4.0), fault=(killed,))
    fly(scenario)
    outcome = replay(tmp_path / "run")
    assert (outcome.first, outcome.ticks) == (None, 550)


def test_limiter_that_was_changed_is_named(flown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = Limiter.step

    def weaker(self: Limiter, wanted_n: np.ndarray, *rest: object) -> object:
        return step(self, wanted_n * 0.999, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(Limiter, "step", weaker)
    first = replay(flown).first
    assert first is not None
    assert first.signal.startswith("/firmware/body0 commanded_n[")
    assert float(first.replayed) == pytest.approx(0.999 * float(first.recorded))
    assert first.tick >= 100  # the body was not armed before


def test_estimator_that_was_changed_is_named(flown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = kalman_filter.process_noise
    monkeypatch.setattr(kalman_filter, "process_noise", lambda p, body: noise(p, body) * 1.001)
    first = replay(flown).first
    assert first is not None
    assert "/firmware/body0" in first.signal


@pytest.mark.slow
def test_command_that_is_not_the_recorded_one_is_named(log: Path) -> None:
    spoil(log / CAN_LOG, THRUSTER_CMD_A, 400, 0x01)
    first = replay(log).first
    assert first is not None
    assert first.tick == 400
    assert first.signal == "can0 THRUSTER_CMD_A Thruster1 of number 1"
    assert abs(int(first.recorded) - int(first.replayed)) == 1


@pytest.mark.slow
def test_frame_that_came_otherwise_is_dropped_and_so_named(log: Path) -> None:
    spoil(log / CAN_LOG, GYRO, 300, 0x10)
    first = replay(log).first
    assert first is not None
    assert first.tick == 300
    assert first.signal == "/firmware/ticks dropped_frames"
    assert (first.recorded, first.replayed) == ("0", "1")


@pytest.mark.slow
def test_tolerance_lets_pass_what_is_within_it(flown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = kalman_filter.process_noise
    monkeypatch.setattr(kalman_filter, "process_noise", lambda p, body: noise(p, body) * (1.0 + 1e-9))
    assert replay(flown).first is not None
    assert replay(flown, 1e-5).first is None
    monkeypatch.setattr(kalman_filter, "process_noise", lambda p, body: noise(p, body) * 1.01)
    assert replay(flown, 1e-5).first is not None


@pytest.mark.slow
def test_replay_says_how_it_went_and_ends_with_that_status(log: Path) -> None:
    said: list[str] = []
    assert replay_and_say(log, 0.0, said.append) == 0
    assert said[0].startswith(f"{TICKS} ticks, 4.99 s, replayed in ")
    assert said[-1] == "every byte is the same"
    spoil(log / CAN_LOG, THRUSTER_CMD_A, 400, 0x01)
    assert replay_and_say(log, 0.0, said.append) == 1
    assert said[-1].startswith("differs first in tick ")


def test_folder_without_a_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"no can\.log there; give the folder that a run left"):
        replay(tmp_path)


def test_log_that_does_not_say_what_flew_is_refused(tmp_path: Path) -> None:
    Recorder(tmp_path, None).close()
    with pytest.raises(DescriptionError, match="does not say what flew"):
        replay(tmp_path)
    Recorder(tmp_path, {"rate_hz": 100}).close()
    with pytest.raises(DescriptionError, match="its configuration has no fleet, parameters, vehicles"):
        replay(tmp_path)


def test_log_of_another_version_is_refused_as_one_and_names_no_line(tmp_path: Path) -> None:
    Recorder(tmp_path, {"fleet": {"buses": ["virtual:x"], "spin": 1}, "parameters": {}, "vehicles": {}}).close()
    with pytest.raises(DescriptionError) as error:
        replay(tmp_path)
    assert str(error.value).startswith(f"{tmp_path}: its configuration is of another version of modcube: fleet.spin: unknown key; ")


def test_logs_of_two_flights_are_not_taken_for_one(log: Path) -> None:
    lines = (log / CAN_LOG).read_text().splitlines(True)
    (log / CAN_LOG).write_text("".join(lines[100:]))
    with pytest.raises(DescriptionError, match=r"can\.log:1: frames of '\(.*\)' where signals\.mcap has tick 1$"):
        replay(log)


def spoil_messages(path: Path) -> None:
    """Turns the signal log into noise from the first message of a tick on, but keeps the end that marks it as complete."""
    data = path.read_bytes()
    first = next(message.data for message in read_messages(path) if message.topic == TICKS_TOPIC)
    begin = data.index(first) - 64
    path.write_bytes(data[:begin] + bytes([255]) * (len(data) - begin - len(MCAP_MAGIC)) + MCAP_MAGIC)


@pytest.mark.parametrize(("spoilt", "why"), [(CAN_LOG, "can.log ends before tick 1"), (SIGNAL_LOG, "signals.mcap is damaged at byte ")])
def test_log_without_a_whole_tick_is_no_replay(log: Path, spoilt: str, why: str) -> None:
    """No claim is made about bytes that were never compared, nor about a repair, since none is possible."""
    if spoilt == CAN_LOG:
        (log / CAN_LOG).write_bytes(b"")
    else:
        spoil_messages(log / SIGNAL_LOG)
    said: list[str] = []
    with pytest.raises(LogError) as refused:
        replay_and_say(log, 0.0, said.append)
    assert str(refused.value).startswith(f"{log}: no tick of the log is whole, so nothing can be replayed: {why}")
    assert said == []


def test_binary_can_log_is_refused_in_a_short_line_of_plain_characters(log: Path) -> None:
    (log / CAN_LOG).write_bytes(np.random.default_rng(0).bytes(40_000).replace(b"\n", b".") + b"\n")
    for read in (replay, recover):
        with pytest.raises(LogError) as refused:
            read(log)
        line = str(refused.value).removeprefix(f"{log}/")
        assert line.startswith("can.log:1: frames of ")
        assert line.endswith("... where signals.mcap has tick 1")
        assert line.isascii()
        assert line.isprintable()
        assert len(line) < 150


def test_line_that_is_no_frame_is_named_in_short(log: Path) -> None:
    head, _, rest = (log / CAN_LOG).read_text().partition("\n")
    stamp = head.partition(" ")[0]
    (log / CAN_LOG).write_bytes(f"{stamp} {NOISE} R\n{rest}".encode())
    with pytest.raises(LogError, match=r"can\.log:1: .*is no frame as `candump -L -x` writes it$") as refused:
        replay(log)
    assert str(refused.value).isprintable()
    assert len(str(refused.value).removeprefix(str(log))) < 150


@pytest.mark.parametrize("frame", ["FFFFFFFF#00", "-101#00", f"101#{'00' * 65}"])
def test_frame_that_no_bus_carries_is_named(log: Path, frame: str) -> None:
    """A corrupt byte on disk can turn a valid frame into such a one."""
    lines = (log / CAN_LOG).read_text().splitlines(True)
    at = next(i for i, line in enumerate(lines) if f" {GYRO}#" in line)
    lines[at] = f"{lines[at].partition(' ')[0]} can0 {frame} R\n"
    (log / CAN_LOG).write_text("".join(lines))
    with pytest.raises(LogError, match=rf"can\.log:{at + 1}: .*is no frame as `candump -L -x` writes it$"):
        replay(log)


def test_line_between_those_of_one_tick_is_named_by_its_number(log: Path) -> None:
    lines = (log / CAN_LOG).read_text().splitlines(True)
    at = next(i for i, line in enumerate(lines[499:], 499) if f" {GYRO}#" in line)
    (log / CAN_LOG).write_text("".join([*lines[:at], "garbage\n", *lines[at:]]))
    outcome = replay(log)
    assert re.search(rf"\(can\.log:{at + 1}: 'garbage' after \d+ frames for tick \d+, which took \d+\)$", outcome.torn)
    assert outcome.first is None and outcome.ticks > 0


@pytest.mark.parametrize(("data", "what"), [(b"", "is empty"), (bytes(range(256)), "is no MCAP log")])
def test_signal_log_that_is_none_is_refused_as_such(log: Path, data: bytes, what: str) -> None:
    (log / SIGNAL_LOG).write_bytes(data)
    with pytest.raises(LogError, match=f"{SIGNAL_LOG}: {what}, so nothing can be read of the flight$"):
        replay(log)


def test_file_of_a_log_is_refused_with_its_folder(log: Path) -> None:
    with pytest.raises(LogError) as refused:
        replay(log / CAN_LOG)
    assert str(refused.value) == f"{log / CAN_LOG}: is a file; give the folder that a run left, here {log}"


def test_file_beside_no_log_is_not_taken_for_one_of_a_run(tmp_path: Path) -> None:
    (tmp_path / "hexa.toml").touch()
    with pytest.raises(LogError) as refused:
        replay(tmp_path / "hexa.toml")
    assert str(refused.value).endswith("is a file; give the folder that a run left, with can.log and signals.mcap")


def test_sent_line_that_is_no_frame_differs_in_short(log: Path) -> None:
    lines = (log / CAN_LOG).read_text().splitlines(True)
    at = next(i for i, line in enumerate(lines) if line.endswith(" T\n"))
    lines[at] = f"{lines[at].partition(' ')[0]} {NOISE} T\n"
    (log / CAN_LOG).write_text("".join(lines))
    first = replay(log).first
    assert first is not None
    assert first.signal == "frame"
    assert str(first).isprintable()
    assert len(str(first)) < 250


def test_spoilt_configuration_is_refused(log: Path) -> None:
    """The attachment has no checksum of its own if it was written while the log was growing."""
    data = (log / SIGNAL_LOG).read_bytes()
    begin = data.index(b'{"') + 1
    (log / SIGNAL_LOG).write_bytes(data[:begin] + b"!" + data[begin + 1 :])
    with pytest.raises(LogError, match=r"in signals\.mcap is no JSON: "):
        replay(log)


def test_message_that_this_version_does_not_write_is_refused(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight_log, "_TICK", Layout("Tick", (*TICK_SIGNALS, Signal("more"))))
    with pytest.raises(LogError, match=r"signals\.mcap has a message of /firmware/ticks that this version does not write"):
        replay(log)
