"""The microcontrollers' C and the firmware's Python agree on the wire: every message, both ways, raw."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path
from typing import Any

import generate_mcu_code
import numpy as np
import pytest
from generate_mcu_code import raw_type, snake

from firmware_py.bus.codec import Codec, Frame, MessageCodec, Receiver, crc8
from firmware_py.bus.load import slow_schedule

CODEC = Codec.load()
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
SEED = 20240
TRIALS = 200
KINDS = ("id", "number", "length", "crc", "counter", "range")
MY_NUMBER = 3
pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is missing (make setup-system)")


class Drops(ctypes.Structure):
    """Mirrors struct modcube_receiver."""

    _fields_ = (
        ("number", ctypes.c_uint8),
        ("counters", ctypes.c_uint8 * len(CODEC.messages)),
        ("dropped", ctypes.c_uint32 * len(KINDS)),
    )


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """The generated code, compiled without a warning and loaded."""
    folder = tmp_path_factory.mktemp("mcu")
    assert generate_mcu_code.main([str(folder)]) == 0
    sources = [str(folder / "modcube.c"), str(folder / "modcube_wire.c")]
    target = folder / "modcube.so"
    command = ["gcc", *WARNINGS, "-O1", "-shared", "-fPIC", *sources, "-lm", "-o", str(target)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert not result.stderr
    return ctypes.CDLL(str(target))


def structure(message: MessageCodec) -> type[ctypes.Structure]:
    """The struct of a message: its signals, then counter and CRC."""
    fields = [(field.name, getattr(ctypes, f"c_{raw_type(field)[:-2]}")) for field in message.field_details]
    if message.protected:
        fields += [("Counter", ctypes.c_uint8), ("Crc", ctypes.c_uint8)]
    if not fields:
        fields = [("dummy", ctypes.c_uint8)]
    return type(message.name, (ctypes.Structure,), {"_fields_": tuple(fields)})


def function(library: ctypes.CDLL, message: MessageCodec, what: str) -> Any:
    return getattr(library, f"modcube_{snake(message.name)}_{what}")


def random_raws(message: MessageCodec, rng: np.random.Generator, limited: bool = True) -> list[int]:
    ranges = [(f.raw_low, f.raw_high) if limited else f.raw_range for f in message.field_details]
    edges = [list(pair) for pair in ranges]
    return [
        int(rng.choice(edge)) if rng.random() < 0.2 else int(rng.integers(low, high + 1))
        for (low, high), edge in zip(ranges, edges, strict=True)
    ]


def c_frame(library: ctypes.CDLL, message: MessageCodec, number: int, raws: list[int], counter: int) -> Frame:
    values = structure(message)(*raws)
    data = (ctypes.c_uint8 * 8)()
    size = function(library, message, "pack")(data, ctypes.byref(values), 8)
    assert size == message.length
    index = CODEC.messages.index(message)
    can_id = library.modcube_id(index, number)
    library.modcube_seal(index, can_id, data, counter)
    return Frame(can_id, bytes(data[: message.length]))


@pytest.mark.parametrize("message", CODEC.messages, ids=lambda m: m.name)
def test_frame_packed_in_c_is_the_frame_packed_in_python(library: ctypes.CDLL, message: MessageCodec) -> None:
    rng = np.random.default_rng(SEED)
    for _ in range(TRIALS):
        number, counter = int(rng.choice(sorted(message.numbers))), int(rng.integers(16))
        raws = random_raws(message, rng, limited=False)
        assert c_frame(library, message, number, raws, counter) == message.encode_raw(number, raws, counter)


@pytest.mark.parametrize("message", CODEC.messages, ids=lambda m: m.name)
def test_frame_packed_in_python_is_understood_in_c(library: ctypes.CDLL, message: MessageCodec) -> None:
    rng = np.random.default_rng(SEED + 1)
    values = structure(message)()
    for _ in range(TRIALS):
        number, counter = int(rng.choice(sorted(message.numbers))), int(rng.integers(16))
        raws = random_raws(message, rng, limited=False)
        frame = message.encode_raw(number, raws, counter)
        assert function(library, message, "unpack")(ctypes.byref(values), frame.data, len(frame.data)) == 0
        assert [getattr(values, name) for name in message.fields] == raws
        if message.protected:
            assert (values.Counter, values.Crc) == (counter, crc8(frame.id, frame.data[:-1]))


@pytest.mark.parametrize("message", CODEC.messages, ids=lambda m: m.name)
def test_physical_values_become_the_same_raw_ones_in_c(library: ctypes.CDLL, message: MessageCodec) -> None:
    """cantools' own C truncates or overflows; ours rounds and saturates as the firmware does."""
    rng = np.random.default_rng(SEED + 2)
    for position, field in enumerate(message.field_details):
        if field.is_integer and not field.unit:
            continue
        convert = function(library, message, f"{snake(field.name)}_from")
        convert.argtypes, convert.restype = (ctypes.c_double,), getattr(ctypes, f"c_{raw_type(field)[:-2]}")
        span = (field.raw_high - field.raw_low) * field.factor
        values = [*rng.uniform(-1.2 * span, 1.2 * span, TRIALS).tolist(), -1e30, 1e30, 0.5 * field.factor, 0.0]
        for value in values:
            physical = [0.0] * len(message.fields)
            physical[position] = value
            python = message.decode_raw(message.encode(min(message.numbers), physical).data)[position]
            assert convert(value) == python, (field.name, value)
        assert convert(float("nan")) == 0


def broken(message: MessageCodec, frame: Frame, rng: np.random.Generator) -> Frame:
    """The frame as a faulty bus may deliver it."""
    kind, data = int(rng.integers(6)), bytearray(frame.data)
    if kind == 0 and data:
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        data = data[: int(rng.integers(len(data) + 1))]
    elif kind == 2 and message.name not in ("ESTOP", "SYNC", "HEARTBEAT"):
        data = bytearray(message.encode_raw(MY_NUMBER, random_raws(message, rng, False), int(rng.integers(16))).data)
    elif kind == 3:
        return Frame(0x7E0 | MY_NUMBER, bytes(data))
    elif kind == 4 and message.name == "SYNC":
        return Frame(frame.id | 5, bytes(data))
    return Frame(frame.id, bytes(data))


def test_c_receiver_drops_what_the_python_receiver_drops_and_counts_it_alike(library: ctypes.CDLL) -> None:
    rng = np.random.default_rng(SEED + 3)
    python, c = Receiver(CODEC), Drops(number=MY_NUMBER)
    accepted = 0
    for _ in range(20 * TRIALS):
        message = CODEC.messages[int(rng.integers(len(CODEC.messages)))]
        number = MY_NUMBER if MY_NUMBER in message.numbers else 0
        frame = message.encode_raw(number, random_raws(message, rng), int(rng.integers(16)))
        frame = broken(message, frame, rng)
        theirs = python.accept(frame)
        ours = library.modcube_accept(ctypes.byref(c), frame.id, frame.data, len(frame.data))
        assert (ours >= 0) == (theirs is not None), (message.name, frame)
        if theirs is not None:
            assert CODEC.messages[ours] is theirs.message
            accepted += 1
    assert dict(zip(KINDS, c.dropped, strict=True)) == python.dropped
    assert accepted > 0 and all(count > 0 for count in c.dropped)


def test_c_receiver_leaves_the_frames_of_other_modules_alone(library: ctypes.CDLL) -> None:
    c = Drops(number=MY_NUMBER)
    frame = CODEC.message("THRUSTER_CMD_A").encode(MY_NUMBER + 1, (0.1, 0.1, 0.1, 0.1, 1), 4)
    assert library.modcube_accept(ctypes.byref(c), frame.id, frame.data, len(frame.data)) == -2
    assert not any(c.dropped)


@pytest.mark.parametrize("rate_hz", [50, 100, 137, 200, 333, 400])
def test_c_node_sends_its_slow_frames_in_the_ticks_that_the_bus_load_is_computed_with(
    library: ctypes.CDLL, rate_hz: int
) -> None:
    library.modcube_is_due.restype = ctypes.c_bool
    for message, every, phase in slow_schedule(CODEC, MY_NUMBER, rate_hz):
        index = CODEC.messages.index(message)
        due = [bool(library.modcube_is_due(index, MY_NUMBER, tick, rate_hz)) for tick in range(4 * every)]
        assert due == [tick % every == phase for tick in range(4 * every)]


def test_same_dbc_gives_the_same_c() -> None:
    assert generate_mcu_code.generated_files() == generate_mcu_code.generated_files()
    assert "cantools version" not in "".join(generate_mcu_code.generated_files().values())


def test_generator_refuses_a_folder_that_cannot_be_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert generate_mcu_code.main([str(tmp_path / "file" / "folder")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
