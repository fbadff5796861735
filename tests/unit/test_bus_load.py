"""The load of each bus, computed from the DBC, stays within its limits; and the expanded DBC for other tools."""

from pathlib import Path

import bus_load as tool
import cantools.database
import pytest

from firmware_py.bus.codec import Codec
from firmware_py.bus.load import MEAN_LIMIT, TICK_LIMIT, bus_load, frame_bits, slow_schedule
from hil.mcu import _schedule

CODEC = Codec.load()
FLEET = """
rate_hz = 100
buses = ["socketcan:can0", "socketcan:can1"]
[[module]]
number = 1
[[module]]
number = 2
[[module]]
number = 7
bus = 1
"""


def numbers(modules: int) -> list[int]:
    return list(range(1, modules + 1))


@pytest.mark.parametrize("length", range(9))
def test_frame_takes_what_davis_and_others_give_as_the_worst_case(length: int) -> None:
    """R. Davis et al., Controller Area Network schedulability analysis, 2007, eq. 1: g = 34 stuffed control bits."""
    assert frame_bits(length) == 34 + 8 * length + 13 + (34 + 8 * length - 1) // 4


@pytest.mark.parametrize(("modules", "percent"), [(1, 11), (2, 21), (4, 42)])
def test_modules_at_100_hz_load_the_bus_as_the_design_says(modules: int, percent: int) -> None:
    assert abs(100 * bus_load(CODEC, numbers(modules), 100).mean - percent) < 0.6


@pytest.mark.parametrize(("modules", "rate_hz"), [(1, 50), (1, 100), (2, 100), (4, 100), (2, 200), (1, 400)])
def test_every_fleet_that_the_design_promises_fits_its_bus(modules: int, rate_hz: int) -> None:
    load = bus_load(CODEC, numbers(modules), rate_hz)
    assert load.mean <= MEAN_LIMIT == 0.5
    assert load.fullest_tick <= TICK_LIMIT == 0.8
    assert load.is_allowed


def test_four_modules_fit_whatever_their_numbers() -> None:
    assert all(bus_load(CODEC, [n, n + 1, n + 5, n + 10], 100).is_allowed for n in range(1, 20))


def test_fleets_that_are_too_big_are_told() -> None:
    assert not bus_load(CODEC, numbers(5), 100).is_allowed
    assert not bus_load(CODEC, numbers(4), 200).is_allowed


def test_fullest_tick_is_fuller_than_the_mean_and_counts_every_frame_kind() -> None:
    load = bus_load(CODEC, numbers(4), 100)
    assert load.fullest_tick > load.mean
    assert {message.name for message in load.messages} == {message.name for message in CODEC.messages}


@pytest.mark.parametrize("rate_hz", [50, 100, 200, 333, 400])
def test_simulated_mcus_keep_the_schedule_that_the_load_is_computed_with(rate_hz: int) -> None:
    for number in (1, 2, 3, 29):
        ours = [(m.name, every, phase) for m, every, phase in slow_schedule(CODEC, number, rate_hz)]
        theirs = [(m.name, every, phase) for m, every, phase in _schedule(CODEC, number, round(1e9 / rate_hz))]
        assert ours == theirs


def test_expanded_dbc_decodes_every_id_without_a_mask() -> None:
    database = cantools.database.load_string(tool.expanded_dbc([1, 3]), "dbc")
    frame = CODEC.message("THRUSTER_CMD_A").encode(3, (0.5, -0.25, 0.0, 1.0, 1), 5)
    assert frame.id == 0x083
    values = database.decode_message(frame.id, frame.data, decode_choices=False)
    assert isinstance(values, dict)
    assert (values["Thruster1"], values["Thruster2"], values["Mode"], values["Counter"]) == (0.5, -0.25, 1, 5)
    ids = {message.frame_id for message in database.messages}
    expected = {m.id_of(n) for m in CODEC.messages for n in (1, 3) if n in m.numbers and m.name != "HEARTBEAT"}
    assert expected | {0x000, 0x01E, 0x01F, 0x020, 0x700, 0x71E, 0x71F} == ids


def test_tool_prints_the_load_of_each_bus_of_a_fleet_and_writes_its_dbcs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(FLEET)
    assert tool.main(["--fleet", str(fleet), "--dbc", str(tmp_path / "dbc")]) == 0
    shown = capsys.readouterr().out
    assert "socketcan:can0" in shown and "21.5" in shown and "11.3" in shown
    second = cantools.database.load_file(tmp_path / "dbc" / "modcube_bus1.dbc")
    assert second.get_message_by_name("GYRO_07").frame_id == 0x107


def test_tool_ends_with_one_for_a_bus_that_is_too_full(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(FLEET)
    assert tool.main(["--fleet", str(fleet), "--rate", "400"]) == 1
    assert "TOO FULL" in capsys.readouterr().out


@pytest.mark.parametrize("wrong", [["--fleet", "missing.toml"], ["--rate", "7"], ["--rate", "x"], ["--speed"]])
def test_tool_refuses_wrong_usage_in_one_line(wrong: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    try:
        status = tool.main(wrong)
    except SystemExit as ended:
        status = int(ended.code or 0)
    assert status == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
