"""The fleet file: which modules on which buses, and how they start out docked."""

from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from firmware_py.app.configuration import configuration_of, firmware_of
from firmware_py.app.firmware import compose, read_fleet
from firmware_py.description.fleet import Fleet, Module, load_fleet, single
from firmware_py.description.parameters import Parameters
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
APART = """\
buses = ["virtual:a"]
[[module]]
number = 7
body = 0
[[module]]
number = 9
body = 0
cell = [2, 0, 0]
"""
JETSON = Path(__file__).resolve().parents[2] / "docs" / "jetson.md"


def written(folder: Path, text: str) -> Path:
    path = folder / "fleet.toml"
    path.write_text(text)
    return path


def load(folder: Path, text: str) -> Fleet:
    return load_fleet(written(folder, text))


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


def test_module_is_called_by_its_place_in_the_fleet_and_on_the_bus_where_they_differ() -> None:
    in_order = Fleet(module=(Module(number=1), Module(number=2)), buses=("virtual:a",))
    assert [in_order.label(0), in_order.label(1)] == ["1", "2"]
    shuffled = Fleet(module=(Module(number=2), Module(number=1)), buses=("virtual:a",))
    assert [shuffled.label(0), shuffled.label(1)] == ["1 (number 2)", "2 (number 1)"]
    apart = Fleet(module=(Module(number=1), Module(number=1, bus=1)), buses=("virtual:a", "virtual:b"))
    assert [apart.label(0), apart.label(1)] == ["1 (number 1 on virtual:a)", "2 (number 1 on virtual:b)"]


def test_single_module_is_number_one_on_its_bus() -> None:
    fleet = single("modcube_sim", "virtual:x")
    (module,) = fleet.module
    assert (module.number, module.vehicle, fleet.buses) == (1, "modcube_sim", ("virtual:x",))


WRONG = {
    "no module": ("rate_hz = 100\n", r"fleet.toml:1: module: missing key"),
    "empty": ("module = []\n", r"has no \[\[module\]\] table; a fleet needs at least one"),
    "two of a kind": ("[[module]]\nnumber = 2\n[[module]]\nnumber = 2\n", r"fleet.toml:5: two modules have the number 2 on virtual:a"),
    "bus twice": ('buses = ["udp:a", "udp:b", "udp:a"]\n[[module]]\nnumber = 2\n', "fleet.toml:1: buses has udp:a twice"),
    "no bus": ("buses = []\n[[module]]\nnumber = 2\n", "`buses` has 0"),
    "bus beyond": ("[[module]]\nnumber = 2\nbus = 1\n", "fleet.toml:4: module number 2 is on bus 1; `buses` has 1, from 0 on"),
    "firmware's number": ("[[module]]\nnumber = 0\n", r"fleet.toml:3: module\[0\].number: 0 is out of range; .*29"),
    "e-stop's number": ("[[module]]\nnumber = 30\n", r"module\[0\].number: 30 is out of range; .* 1 to 29"),
    "too slow": ("rate_hz = 49\n[[module]]\nnumber = 2\n", r"fleet.toml:2: rate_hz: 49 is out of range; .* to 400 Hz"),
    "too fast": ("rate_hz = 401\n[[module]]\nnumber = 2\n", r"rate_hz: 401 is out of range; permitted: 50 to 400 Hz"),
    "rotation": ("[[module]]\nnumber = 2\nrotation = 24\n", r"fleet.toml:4: module\[0\].rotation: 24 is out of range"),
    "half a rate": ("rate_hz = 99.5\n[[module]]\nnumber = 2\n", r"rate_hz: 99.5 is not a whole number"),
    "half a cell": ("[[module]]\nnumber = 2\ncell = [0.5, 0, 0]\n", r"cell \[0.5, 0.0, 0.0\] is between places of the lattice"),
    "no body": (
        "[[module]]\nnumber = 2\nbody = 0\n[[module]]\nnumber = 3\ncell = [1, 0, 0]\n",
        "fleet.toml:7: module number 3 starts alone, in no lattice; give body, or leave cell out",
    ),
    "one table": ("[module]\nnumber = 2\n", r"fleet.toml:2: module: must be a list of tables, each \[\[module\]\]"),
    "like another": ("[[module]]\nnummer = 2\n", r"module\[0\].nummer: unknown key; did you mean number\? permitted here: "),
    "cell": ("[[module]]\nnumber = 2\ncell = [1, 2]\n", r"module\[0\].cell: has 2 numbers; needs 3 numbers"),
}


def on_one_bus(text: str) -> str:
    """Returns `text`, preceded by a line that names a bus unless it names some."""
    return text if "buses" in text else f'buses = ["virtual:a"]\n{text}'


@pytest.mark.parametrize("case", WRONG)
def test_odd_fleet_is_refused(tmp_path: Path, case: str) -> None:
    text, words = WRONG[case]
    with pytest.raises(DescriptionError, match=words):
        load(tmp_path, on_one_bus(text))


def test_fleet_file_that_names_no_bus_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"fleet.toml:1: buses: missing key; .*socketcan:can0"):
        load(tmp_path, "[[module]]\nnumber = 1\nbus = 1\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (APART.replace("virtual:a", "can0"), r"fleet\.toml:\d+: buses\[0\]: 'can0': no such kind of bus; it takes virtual:NAME"),
        (APART, r"fleet\.toml: no docked face joins module 2 \(number 9\) to module 1 \(number 7\)$"),
        (APART.replace("[2,", "[0,"), r"fleet\.toml: modules 1 \(number 7\) and 2 \(number 9\) overlap"),
        (
            APART.replace('["virtual:a"]', '["virtual:a", "virtual:b"]').replace("number = 9", "number = 7\nbus = 1"),
            r"fleet\.toml: no docked face joins module 2 \(number 7 on virtual:b\) to module 1 \(number 7 on virtual:a\)$",
        ),
        (
            'buses = ["virtual:a"]\n[[module]]\nnumber = 7\n[[module]]\nnumber = 8\nvehicle = "yacht"\n',
            r"fleet\.toml:6: module\[1\]\.vehicle: vehicle 'yacht' is unknown; there are .*modcube",
        ),
    ],
)
def test_modules_that_cannot_be_docked_so_are_refused_by_file_and_number(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(DescriptionError, match=words):
        read_fleet(written(tmp_path, text))


def test_fleet_file_of_the_documentation_loads_as_it_stands_there(tmp_path: Path) -> None:
    lines = JETSON.read_text(encoding="utf-8").partition("    # /etc/modcube/fleet.toml\n")[2].splitlines()
    end = next(at for at, line in enumerate(lines) if line and not line.startswith("    "))
    fleet = read_fleet(written(tmp_path, "\n".join(line[4:] for line in lines[:end])))
    assert [(m.number, m.bus, m.body) for m in fleet.module] == [(1, 0, 0), (1, 1, 0)]
    assert fleet.buses == ("socketcan:can0", "socketcan:can1")


@pytest.mark.parametrize(("places", "dry_kg"), [(("beside",), 2.5), (("here",), 2.6), (("beside", "here"), 2.5)])
def test_vehicle_file_is_looked_up_beside_the_fleet_s_before_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, places: tuple[str, ...], dry_kg: float
) -> None:
    text = (resources.files("firmware_py") / "vehicles" / "modcube.toml").read_text(encoding="utf-8")
    for place, mass in (("beside", "2.5"), ("here", "2.6")):
        (tmp_path / place).mkdir()
        if place in places:
            (tmp_path / place / "own.toml").write_text(text.replace("dry_kg = 2.6", f"dry_kg = {mass}"), encoding="utf-8")
    monkeypatch.chdir(tmp_path / "here")
    fleet = read_fleet(written(tmp_path / "beside", 'buses = ["virtual:a"]\n[[module]]\nnumber = 2\nvehicle = "own.toml"\n'))
    firmware = compose(fleet, Parameters())
    assert firmware.vehicles[0].inertial.dry_kg == dry_kg
    again = firmware_of(configuration_of(firmware), "log")
    assert again.vehicles[0].inertial.dry_kg == dry_kg


def test_vehicle_file_that_lies_nowhere_is_looked_for_beside_the_fleet_s(tmp_path: Path) -> None:
    text = 'buses = ["virtual:a"]\n[[module]]\nnumber = 2\nvehicle = "own.toml"\n'
    with pytest.raises(DescriptionError, match=rf"fleet\.toml:4: module\[0\]\.vehicle: {tmp_path}/own\.toml: cannot be read: No such file"):
        read_fleet(written(tmp_path, text))


def test_vehicle_file_with_a_name_too_long_is_refused_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"fleet\.toml:5: module\[0\]\.vehicle: .*x\.toml: cannot be read: File name too long$"):
        load(tmp_path, f'buses = ["virtual:a"]\n\n[[module]]\nnumber = 7\nvehicle = "{"x" * 300}.toml"\n')


def test_same_number_on_two_buses_is_two_modules(tmp_path: Path) -> None:
    assert len(load(tmp_path, TWO).module) == 2
