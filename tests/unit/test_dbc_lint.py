"""The DBC has the messages of the table below, and none of the mistakes that cantools loads without complaint.

Each rule is tried on a DBC that breaks it (the negative controls at the end).
"""

import math
from collections import Counter
from importlib import resources

import cantools.database
import pytest

FRAME_ID_MASK = 0x7E0
THRUSTERS_A = [f"Thruster{i}" for i in range(1, 5)] + ["Mode"]
THRUSTERS_B = [f"Thruster{i}" for i in range(5, 9)] + ["Mode"]
ESC = ["Rpm{}", "EscCurrent{}", "EscStatus{}"]

# id, bytes, protected (E), cycle in ms (None: once a tick), signals without Counter and Crc.
TABLE = {
    "ESTOP": (0x000, 0, False, 50, []),
    "SYNC": (0x020, 4, False, None, ["Tick"]),
    "DOCK_CMD": (0x040, 4, True, 100, [f"Relay{face}" for face in "ABCDEF"]),
    "THRUSTER_CMD_A": (0x080, 8, True, None, THRUSTERS_A),
    "THRUSTER_CMD_B": (0x0A0, 8, True, None, THRUSTERS_B),
    "TAG_POSITION": (0x0C0, 8, True, 17, ["PositionX", "PositionY", "PositionZ"]),
    "TAG_ATTITUDE": (
        0x0E0, 8, True, 17,
        ["Largest", "ComponentA", "ComponentB", "ComponentC", "TagId", "Quality", "CaptureTick", "CaptureOffset"],
    ),
    "GYRO": (0x100, 8, True, None, ["RateX", "RateY", "RateZ", "GyroStatus"]),
    "ACCEL": (0x120, 8, True, None, ["AccelX", "AccelY", "AccelZ", "AccelStatus"]),
    "DEPTH": (0x140, 6, True, 20, ["Pressure", "WaterTemperature", "DepthStatus"]),
    "DOCK_CURRENT_ABC": (
        0x180, 8, True, 40, [f"Current{face}" for face in "ABC"] + [f"RelayEcho{face}" for face in "ABC"]
    ),
    "DOCK_CURRENT_DEF": (
        0x1A0, 8, True, 40, [f"Current{face}" for face in "DEF"] + [f"RelayEcho{face}" for face in "DEF"]
    ),
    **{
        f"ESC_FEEDBACK_{pair}": (
            0x1E0 + 0x20 * pair, 8, True, 100, [name.format(i) for i in (2 * pair - 1, 2 * pair) for name in ESC]
        )
        for pair in range(1, 5)
    },
    "POWER": (0x400, 6, True, 100, ["Voltage", "Current", "PowerStatus"]),
    "ENVIRONMENT": (0x420, 6, True, 200, ["CabinTemperature", "CabinPressure", "Leak"]),
    "MCU_STATUS": (0x440, 6, True, None, ["StatusTick", "Version", "Errors", "State"]),
    "HEARTBEAT": (0x700, 2, False, 500, ["NodeState", "NodeVersion"]),
}


def dbc_text():
    return (resources.files("can_dbc") / "modcube.dbc").read_text(encoding="utf-8")


def load(text):
    return cantools.database.load_string(text, "dbc", frame_id_mask=FRAME_ID_MASK, strict=False)


@pytest.fixture(scope="module")
def database():
    return load(dbc_text())


def duplicate_ids(database):
    seen = Counter(message.frame_id & FRAME_ID_MASK for message in database.messages)
    return [hex(frame_id) for frame_id, count in seen.items() if count > 1]


def bits_of(signal):
    return set(range(signal.start, signal.start + signal.length))


def overlapping_signals(database):
    return [
        f"{message.name}: {one.name}, {other.name}"
        for message in database.messages
        for index, one in enumerate(message.signals)
        for other in message.signals[:index]
        if bits_of(one) & bits_of(other)
    ]


def signals_outside_the_frame(database):
    return [
        f"{message.name}.{signal.name}"
        for message in database.messages
        for signal in message.signals
        if max(bits_of(signal)) >= 8 * message.length
    ]


def is_reachable(signal, limit):
    if limit is None:
        return False
    raw = (limit - signal.offset) / signal.scale
    low = -(2 ** (signal.length - 1)) if signal.is_signed else 0
    high = low + 2**signal.length - 1
    return low <= round(raw) <= high and math.isclose(raw, round(raw), abs_tol=1e-6)


def unreachable_limits(database):
    return [
        f"{message.name}.{signal.name}: {limit}"
        for message in database.messages
        for signal in message.signals
        for limit in (signal.minimum, signal.maximum)
        if not is_reachable(signal, limit)
    ]


def unknown_nodes(database):
    known = {node.name for node in database.nodes}
    used = [(message.name, node) for message in database.messages for node in message.senders]
    used += [
        (f"{message.name}.{signal.name}", node)
        for message in database.messages
        for signal in message.signals
        for node in signal.receivers or ["nobody"]
    ]
    return [f"{where}: {node}" for where, node in used if node not in known]


def missing_units(database):
    """A scaled value has a unit, unless it is a share: a number of magnitude 1 at most."""
    return [
        f"{message.name}.{signal.name}"
        for message in database.messages
        for signal in message.signals
        if signal.scale != 1 and not signal.unit and max(abs(signal.minimum), abs(signal.maximum)) > 1
    ]


def missing_cycle_times(database):
    return [message.name for message in database.messages if not message.cycle_time]


def is_protected(message):
    attribute = message.dbc.attributes.get("Protected")
    return attribute is not None and attribute.value == 1


def misplaced_protection(database):
    """Counter: high nibble of the byte before the last; Crc: last byte; neither in any other message."""
    wrong = []
    for message in database.messages:
        found = {s.name: (s.start, s.length) for s in message.signals if s.name in ("Counter", "Crc")}
        end = 8 * message.length
        if found != ({"Counter": (end - 12, 4), "Crc": (end - 8, 8)} if is_protected(message) else {}):
            wrong.append(message.name)
    return wrong


def big_endian_signals(database):
    return [s.name for message in database.messages for s in message.signals if s.byte_order != "little_endian"]


RULES = [
    duplicate_ids,
    overlapping_signals,
    signals_outside_the_frame,
    unreachable_limits,
    unknown_nodes,
    missing_units,
    missing_cycle_times,
    misplaced_protection,
    big_endian_signals,
]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_dbc_has_no(rule, database):
    assert rule(database) == []


@pytest.mark.parametrize("name", TABLE)
def test_message_is_as_in_the_design_table(name, database):
    frame_id, length, protected, cycle_ms, signals = TABLE[name]
    message = database.get_message_by_name(name)
    assert (message.frame_id, message.length, is_protected(message)) == (frame_id, length, protected)
    per_tick = "PerTick" in message.dbc.attributes and message.dbc.attributes["PerTick"].value == 1
    assert per_tick == (cycle_ms is None)
    assert message.cycle_time == (cycle_ms or 10)
    assert [s.name for s in message.signals if s.name not in ("Counter", "Crc")] == signals


def test_dbc_has_no_message_beside_the_design_table(database):
    assert {message.name for message in database.messages} == set(TABLE)


def test_ids_leave_five_bits_for_the_number(database):
    assert all(message.frame_id & 0x1F == 0 and message.frame_id < 0x800 for message in database.messages)


def test_every_message_has_a_comment(database):
    silent = [message.name for message in database.messages if not message.comment]
    assert silent == []


def test_number_of_every_node_reads_the_message_of_number_zero(database):
    assert all(database.get_message_by_frame_id(m.frame_id | 31).name == m.name for m in database.messages)


# ------------------------------------------------------------------ negative controls


@pytest.mark.parametrize(
    ("rule", "right", "wrong"),
    [
        (duplicate_ids, "BO_ 192 TAG_POSITION:", "BO_ 224 TAG_POSITION:"),
        (overlapping_signals, "RateY : 16|16@1-", "RateY : 15|16@1-"),
        (signals_outside_the_frame, "NodeVersion : 8|8@1+", "NodeVersion : 9|8@1+"),
        (unreachable_limits, '(0.02,0) [-40.96|40.94] "degC"', '(0.02,0) [-40.96|40.96] "degC"'),
        (unreachable_limits, '(0.001,0) [0|65.535] "V"', '(0.001,0) [0|12.0005] "V"'),
        (unknown_nodes, "BO_ 1024 POWER: 6 MODULE", "BO_ 1024 POWER: 6 BATTERY"),
        (unknown_nodes, '"V" FIRMWARE', '"V" FIRMWEAR'),
        (missing_units, '[0|65.535] "V"', '[0|65.535] ""'),
        (missing_cycle_times, 'BA_ "GenMsgCycleTime" BO_ 320 20;', ""),
        (misplaced_protection, 'Counter : 52|4@1+ (1,0) [0|15] "" MODULE', 'Counter : 48|4@1+ (1,0) [0|15] "" MODULE'),
        (misplaced_protection, 'BA_ "Protected" BO_ 1088 1;', ""),
        (big_endian_signals, "Leak : 32|1@1+", "Leak : 32|1@0+"),
    ],
)
def test_lint_finds_a_mistake_that_cantools_loads(rule, right, wrong):
    text = dbc_text()
    assert right in text
    assert rule(load(text.replace(right, wrong, 1))) != []
