"""The codec against cantools, for every message in both directions, and the frames that the receiver accepts."""

import math
from importlib import resources
from pathlib import Path

import cantools.database
import numpy as np
import pytest
from crccheck.crc import Crc8SaeJ1850
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.bus.codec import (
    NO_COUNTER,
    Codec,
    Frame,
    Receiver,
    crc8,
    pack_quaternion,
    unpack_quaternion,
)

CODEC = Codec.load()
MESSAGES = {message.name: message for message in CODEC.messages}
PROTECTED = [name for name, message in MESSAGES.items() if message.protected]
EXAMPLES = settings(derandomize=True, deadline=None, max_examples=60)
FEW_EXAMPLES = settings(EXAMPLES, max_examples=10)
MANY_EXAMPLES = settings(EXAMPLES, max_examples=500)


@pytest.fixture(scope="module")
def oracle():
    text = (resources.files("can_dbc") / "modcube.dbc").read_text(encoding="utf-8")
    return cantools.database.load_string(text, "dbc", frame_id_mask=0x7E0)


def a_number(message):
    return min(message.numbers - {0}, default=0)


def raws(message):
    return st.tuples(*(st.integers(field.raw_low, field.raw_high) for field in message.field_details))


def any_raws(message):
    return st.tuples(*(st.integers(*field.raw_range) for field in message.field_details))


def physical(message):
    """Values inside the limits, not only on the wire's grid."""
    return st.tuples(
        *(
            st.integers(field.raw_low, field.raw_high)
            if field.is_integer
            else st.floats(field.raw_low * field.factor, field.raw_high * field.factor)
            for field in message.field_details
        )
    )


def protection(frame, message):
    return {"Counter": frame.data[-2] >> 4, "Crc": frame.data[-1]} if message.protected else {}


@pytest.mark.slow
@pytest.mark.parametrize("name", MESSAGES)
@EXAMPLES
@given(data=st.data())
def test_cantools_reads_what_we_send(name, oracle, data):
    message = MESSAGES[name]
    values, counter = data.draw(any_raws(message)), data.draw(st.integers(0, 15))
    frame = message.encode_raw(a_number(message), values, counter)
    read = oracle.get_message_by_frame_id(frame.id).decode(frame.data, decode_choices=False, scaling=False)
    expected = dict(zip(message.fields, values, strict=True))
    if message.protected:
        expected |= {"Counter": counter, "Crc": crc8(frame.id, frame.data[:-1])}
    assert read == expected


@pytest.mark.slow
@pytest.mark.parametrize("name", MESSAGES)
@EXAMPLES
@given(data=st.data())
def test_we_read_what_cantools_sends(name, oracle, data):
    message = MESSAGES[name]
    values = data.draw(raws(message))
    filled = dict(zip(message.fields, values, strict=True)) | (dict(Counter=9, Crc=0) if message.protected else {})
    their = oracle.get_message_by_name(name)
    sent = their.encode(filled, scaling=False)
    if message.protected:
        sent = sent[:-1] + bytes((crc8(their.frame_id | a_number(message), sent[:-1]),))
    received = Receiver(CODEC).accept(Frame(their.frame_id | a_number(message), sent))
    assert received is not None
    assert received.counter == (9 if message.protected else NO_COUNTER)
    assert message.decode_raw(sent) == values
    scaled = their.decode(sent, decode_choices=False)
    assert received.values == pytest.approx([scaled[field] for field in message.fields], rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", MESSAGES)
@EXAMPLES
@given(data=st.data())
def test_physical_values_become_the_same_bytes_as_with_cantools(name, oracle, data):
    message = MESSAGES[name]
    values = data.draw(physical(message))
    frame = message.encode(a_number(message), values, 5)
    filled = dict(zip(message.fields, values, strict=True)) | protection(frame, message)
    assert oracle.get_message_by_name(name).encode(filled) == frame.data


@pytest.mark.slow
@pytest.mark.parametrize("name", MESSAGES)
@EXAMPLES
@given(data=st.data())
def test_wire_changes_a_value_by_half_a_step_at_most(name, data):
    message = MESSAGES[name]
    values = data.draw(physical(message))
    read = message.decode(message.encode(a_number(message), values).data)
    for field, sent, received in zip(message.field_details, values, read, strict=True):
        assert abs(received - sent) <= field.factor * (0.5 + 1e-9)
        assert isinstance(received, int if field.is_integer else float)


@pytest.mark.parametrize("name", MESSAGES)
@pytest.mark.parametrize("value", [math.inf, -math.inf, 1e30, -1e30, np.float64(1e12), np.int64(-(2**40))])
def test_value_beyond_the_limits_saturates(name, value):
    message = MESSAGES[name]
    frame = message.encode(a_number(message), [value] * len(message.fields))
    expected = tuple(field.raw_high if value > 0 else field.raw_low for field in message.field_details)
    assert message.decode_raw(frame.data) == expected


@pytest.mark.parametrize("name", [name for name, message in MESSAGES.items() if message.fields])
def test_nan_is_refused_and_named(name):
    message = MESSAGES[name]
    values = [0.0] * len(message.fields)
    values[-1] = math.nan
    with pytest.raises(ValueError, match=f"{name}: not a number: {message.fields[-1]}"):
        message.encode(a_number(message), values)


def test_wrong_number_of_values_is_refused_with_the_names():
    with pytest.raises(ValueError, match="GYRO: 3 values; needs 4: RateX, RateY, RateZ, GyroStatus"):
        MESSAGES["GYRO"].encode(1, (0.0, 0.0, 0.0))


def test_raw_value_that_does_not_fit_its_bits_is_refused():
    with pytest.raises(ValueError, match=r"Thruster1: raw 2048 does not fit; -2048 to 2047"):
        MESSAGES["THRUSTER_CMD_A"].encode_raw(1, (2048, 0, 0, 0, 0))


@pytest.mark.parametrize(("name", "number"), [("GYRO", 0), ("GYRO", 30), ("SYNC", 1), ("ESTOP", 32), ("ESTOP", -1)])
def test_number_that_is_not_valid_for_a_message_is_refused(name, number):
    message = MESSAGES[name]
    with pytest.raises(ValueError, match="is not valid"):
        message.encode(number, [0] * len(message.fields))


def test_unknown_message_is_named_with_those_that_there_are():
    with pytest.raises(KeyError, match="GYRO"):
        CODEC.message("GYROSCOPE")


def test_crc_is_sae_j1850():
    assert Crc8SaeJ1850.calc(b"123456789") == 0x4B
    frame = MESSAGES["GYRO"].encode(3, (0.1, -0.2, 0.3, 0), 7)
    assert frame.data[-1] == Crc8SaeJ1850.calc(frame.id.to_bytes(2, "little") + frame.data[:-1])


@EXAMPLES
@given(can_id=st.integers(0, 0x7FF), payload=st.binary(max_size=7))
def test_crc_agrees_with_another_implementation(can_id, payload):
    assert crc8(can_id, payload) == Crc8SaeJ1850.calc(can_id.to_bytes(2, "little") + payload)


@pytest.mark.parametrize(
    ("name", "number", "counter", "values"),
    [
        ("THRUSTER_CMD_A", 3, 5, (0.5, -0.25, 0.0, 1.0, 1)),
        ("DOCK_CMD", 2, 0, (1, 2, 0, 0, 0, 0)),
        ("TAG_ATTITUDE", 1, 9, (*pack_quaternion((0.5, -0.5, 0.5, 0.5)), 4, 7, 0x2A, 3.3)),
    ],
)
def test_example_frames_of_the_readme_are_ours(name, number, counter, values):
    frame = MESSAGES[name].encode(number, values, counter)
    readme = (Path(__file__).parents[2] / "can_dbc" / "README.md").read_text(encoding="utf-8")
    (row,) = [line for line in readme.splitlines() if line.startswith(f"| {name} ")]
    assert row.split("|")[-3:-1] == [f" {frame.id:03X} ", f" {frame.data.hex(' ').upper()} "]


# ------------------------------------------------------------------ receiver


@pytest.mark.parametrize("name", PROTECTED)
@FEW_EXAMPLES
@given(data=st.data())
def test_one_flipped_bit_always_drops_a_protected_frame(name, data):
    message = MESSAGES[name]
    frame = message.encode_raw(data.draw(st.integers(1, 29)), data.draw(raws(message)), data.draw(st.integers(0, 15)))
    receiver = Receiver(CODEC)
    for bit in range(8 * message.length):
        flipped = bytearray(frame.data)
        flipped[bit // 8] ^= 1 << bit % 8
        assert receiver.accept(Frame(frame.id, bytes(flipped))) is None
    assert receiver.dropped["crc"] == 8 * message.length
    assert receiver.accept(frame) is not None


@pytest.mark.slow
@pytest.mark.parametrize("name", PROTECTED)
@FEW_EXAMPLES
@given(data=st.data())
def test_one_flipped_bit_of_an_id_drops_the_frame_or_stops_the_robot(name, data):
    message = MESSAGES[name]
    frame = message.encode_raw(data.draw(st.integers(1, 29)), data.draw(raws(message)))
    for bit in range(11):
        received = Receiver(CODEC).accept(Frame(frame.id ^ 1 << bit, frame.data))
        assert received is None or received.message.name == "ESTOP"


@EXAMPLES
@given(frames=st.lists(st.builds(Frame, st.integers(-5, 0x1000), st.binary(max_size=12)), max_size=40))
def test_receiver_never_raises_and_counts_every_frame(frames):
    receiver = Receiver(CODEC)
    accepted = sum(receiver.accept(frame) is not None for frame in frames)
    assert accepted + sum(receiver.dropped.values()) == len(frames)


@EXAMPLES
@given(payload=st.binary(max_size=8), number=st.integers(0, 31))
def test_any_id_of_estop_stops_whatever_its_length(payload, number):
    received = Receiver(CODEC).accept(Frame(number, payload))
    assert received is not None
    assert (received.message.name, received.number, received.values) == ("ESTOP", number, ())


def drop_kind(*frames):
    receiver = Receiver(CODEC)
    *before, last = frames
    assert all(receiver.accept(frame) is not None for frame in before)
    assert receiver.accept(last) is None
    (kind,) = [kind for kind, count in receiver.dropped.items() if count]
    return kind


def test_each_bad_frame_is_counted_by_its_kind():
    gyro = MESSAGES["GYRO"].encode(1, (0, 0, 0, 0), 3)
    thrusters = MESSAGES["THRUSTER_CMD_A"].encode_raw(1, (-2048, 0, 0, 0, 1))
    assert drop_kind(Frame(0x7E1, b"")) == "id"
    assert drop_kind(Frame(0x100, gyro.data)) == "number"
    assert drop_kind(Frame(gyro.id, gyro.data[:-1])) == "length"
    assert drop_kind(Frame(gyro.id, bytes(8))) == "crc"
    assert drop_kind(gyro, gyro) == "counter"
    assert drop_kind(thrusters) == "range"


def test_dropped_frame_does_not_use_up_its_counter():
    gyro = MESSAGES["GYRO"]
    good = gyro.encode(1, (0, 0, 0, 0), 3)
    receiver = Receiver(CODEC)
    assert receiver.accept(Frame(good.id, good.data[:-1] + bytes((good.data[-1] ^ 1,)))) is None
    assert receiver.accept(good) is not None


def test_node_that_restarts_its_counter_is_heard():
    gyro = MESSAGES["GYRO"]
    receiver = Receiver(CODEC)
    for counter in (7, 8, 9, 0, 1, 15, 14):
        assert receiver.accept(gyro.encode(1, (0, 0, 0, 0), counter)) is not None


def test_counters_of_two_modules_are_apart():
    gyro = MESSAGES["GYRO"]
    receiver = Receiver(CODEC)
    assert receiver.accept(gyro.encode(1, (0, 0, 0, 0), 4)) is not None
    assert receiver.accept(gyro.encode(2, (0, 0, 0, 0), 4)) is not None


# ------------------------------------------------------------------ attitude


def unit_quaternions():
    component = st.floats(-1, 1)
    raw = st.tuples(component, component, component, component).filter(lambda q: np.linalg.norm(q) > 0.1)
    return raw.map(lambda q: np.array(q) / np.linalg.norm(q))


@pytest.mark.slow
@given(q=unit_quaternions())
@MANY_EXAMPLES
def test_tag_attitude_survives_the_wire_to_ten_milliradians(q):
    """The worst case is half a step of sqrt(2)/510 in three components, with all four equal: 0.0096 rad (rms 0.0031)."""
    back = unpack_quaternion(*pack_quaternion(q))
    assert np.linalg.norm(back) == pytest.approx(1.0, abs=1e-12)
    angle = 2 * math.acos(min(1.0, abs(float(back @ q))))
    assert angle < 0.0097


@pytest.mark.parametrize("index", range(4))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_attitude_about_one_axis_is_exact(index, sign):
    q = np.zeros(4)
    q[index] = sign
    assert pack_quaternion(q) == (index, 255, 255, 255)
    assert unpack_quaternion(index, 255, 255, 255) == pytest.approx(np.abs(q))


@EXAMPLES
@given(st.tuples(st.integers(0, 3), *[st.integers(0, 511)] * 3))
def test_any_raw_attitude_unpacks_to_a_unit_quaternion(raw):
    assert np.linalg.norm(unpack_quaternion(*raw)) == pytest.approx(1.0, abs=1e-12)
