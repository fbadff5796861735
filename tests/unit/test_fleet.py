"""The fleet file: which modules on which buses, and how they start out docked."""

from pathlib import Path

import numpy as np
import pytest

from firmware_py.description.fleet import Fleet, load_fleet, single
from firmware_py.description.schema import DescriptionError

TWO = """\
buses = ["udp:239.1.1.1:1", "socketcan:can0"]
rate_hz = 200

[[module]]
number = 3

[[module]]
number = 3
bus = 1
vehicle = "modcube_sim"
body = 4
cell = [1, 0, -1]
rotation = 23
"""


def load(folder: Path, text: str) -> Fleet:
    path = folder / "fleet.toml"
    path.write_text(text)
    return load_fleet(path)


def test_modules_come_in_the_order_of_the_file(tmp_path: Path) -> None:
    fleet = load(tmp_path, TWO)
    first, second = fleet.module
    assert (first.number, first.bus, first.vehicle, first.body, first.rotation) == (3, 0, "modcube", -1, 0)
    assert (second.number, second.bus, second.vehicle, second.body, second.rotation) == (3, 1, "modcube_sim", 4, 23)
    np.testing.assert_array_equal(second.cell, [1, 0, -1])
    assert fleet.buses == ("udp:239.1.1.1:1", "socketcan:can0")


@pytest.mark.parametrize(("rate_hz", "period_ns"), [(50, 20_000_000), (100, 10_000_000), (400, 2_500_000)])
def test_tick_is_as_long_as_the_rate_says(rate_hz: int, period_ns: int) -> None:
    assert single(rate_hz=rate_hz).period_ns == period_ns


def test_single_module_is_number_one_on_its_bus() -> None:
    fleet = single("modcube_sim", "virtual:x")
    (module,) = fleet.module
    assert (module.number, module.vehicle, fleet.buses) == (1, "modcube_sim", ("virtual:x",))


WRONG = {
    "no module": ("rate_hz = 100\n", r"fleet.toml:1: module: missing key"),
    "empty": ("module = []\n", r"has no \[\[module\]\] table; a fleet needs at least one"),
    "two of a kind": ("[[module]]\nnumber = 2\n[[module]]\nnumber = 2\n", "two modules have the same bus and number"),
    "bus beyond": ("[[module]]\nnumber = 2\nbus = 1\n", "a module names a bus beyond the 1 in `buses`"),
    "firmware's number": ("[[module]]\nnumber = 0\n", r"fleet.toml:2: module\[0\].number: 0 is out of range; .*29"),
    "e-stop's number": ("[[module]]\nnumber = 30\n", r"module\[0\].number: 30 is out of range; .* 1 to 29"),
    "too slow": ("rate_hz = 49\n[[module]]\nnumber = 2\n", r"fleet.toml:1: rate_hz: 49 is out of range; .* to 400 Hz"),
    "too fast": ("rate_hz = 401\n[[module]]\nnumber = 2\n", r"rate_hz: 401 is out of range; permitted: 50 to 400 Hz"),
    "rotation": ("[[module]]\nnumber = 2\nrotation = 24\n", r"fleet.toml:3: module\[0\].rotation: 24 is out of range"),
    "half a rate": ("rate_hz = 99.5\n[[module]]\nnumber = 2\n", r"rate_hz: 99.5 is not a whole number"),
    "cell": ("[[module]]\nnumber = 2\ncell = [1, 2]\n", r"module\[0\].cell: has shape \(2,\); needs \(3,\)"),
}


@pytest.mark.parametrize("case", WRONG)
def test_odd_fleet_is_refused(tmp_path: Path, case: str) -> None:
    text, words = WRONG[case]
    with pytest.raises(DescriptionError, match=words):
        load(tmp_path, text)


def test_same_number_on_two_buses_is_two_modules(tmp_path: Path) -> None:
    assert len(load(tmp_path, TWO).module) == 2
