"""`modcube run` refuses each option that it would not use: in one line, with status 2, before anything is started."""

from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from firmware_py.app import doctor_report
from firmware_py.cli import app, fleet_of

FLEET = 'buses = ["virtual:options"]\n[[module]]\nnumber = 7\n'


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    path = tmp_path / "fleet.toml"
    path.write_text(FLEET)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "doctor"])
def test_bus_beside_a_fleet_file_is_refused(command: str, fleet: Path, refusal: Callable[..., str]) -> None:
    line = refusal(command, "--fleet", str(fleet), "--bus", "socketcan:can7")
    assert line == f"modcube: --bus beside --fleet: buses, vehicles and rate_hz stand in {fleet}; give one or the other"


def test_doctor_judges_the_bus_at_the_rate_that_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: without a fleet file it judged the load of 100 Hz, whatever rate the robot was to run at."""
    rates: list[int] = []
    monkeypatch.setattr(doctor_report, "examine", lambda fleet, folder, say: rates.append(fleet.rate_hz) or 0)
    for arguments in ([], ["--rate", "400"]):
        assert CliRunner().invoke(app, ["doctor", "--bus", "virtual:doctor", *arguments]).exit_code == 0
    assert rates == [100, 400]


@pytest.mark.slow
def test_rate_and_vehicle_beside_a_fleet_file_are_refused_even_at_their_defaults(fleet: Path, refusal: Callable[..., str]) -> None:
    line = refusal("run", "--fleet", str(fleet), "--rate", "100", "--vehicle", "modcube")
    assert line.startswith("modcube: --vehicle, --rate beside --fleet: ")


@pytest.mark.slow
def test_fleet_file_without_buses_is_refused(fleet: Path, refusal: Callable[..., str]) -> None:
    fleet.write_text(FLEET.partition("\n")[2])
    assert f"{fleet}:1: buses: missing key" in refusal("run", "--fleet", str(fleet))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--identity", "px4"], "--identity and --store go with a link"),
        (["--store", "kept"], "--ground LINK or --ground-file FILE"),
        (["--ground", "udpin:127.0.0.1:0", "--store", __file__], f"store {__file__}: {__file__}: Not a directory; it needs a folder"),
        (["--ground", "udpin:127.0.0.1:0", "--identity", "px4"], "identity 'px4' is unknown; there are generic, ardusub"),
    ],
)
def test_options_of_the_ground_side_that_cannot_count_are_refused(arguments: list[str], words: str, refusal: Callable[..., str]) -> None:
    assert words in refusal("run", "--bus", "virtual:options", *arguments)


@pytest.mark.slow
def test_dock_button_of_a_module_that_the_fleet_lacks_is_refused(fleet: Path, refusal: Callable[..., str]) -> None:
    file = fleet.with_name("ground.toml")
    file.write_text('links = ["udpin:127.0.0.1:0"]\ndock_button = [1, 0, 60, 1]\n')
    line = refusal("run", "--fleet", str(fleet), "--ground-file", str(file))
    assert line.startswith(f"modcube: {file}:2: dock_button: module 1 to module 60; ")


def test_one_module_keeps_the_defaults_and_what_the_command_line_says(fleet: Path) -> None:
    usual, other = fleet_of(None, None, None, None), fleet_of(None, "virtual:x", "modcube_sim", 200)
    assert (usual.buses, usual.module[0].vehicle, usual.rate_hz) == (("socketcan:can0",), "modcube", 100)
    assert (other.buses, other.module[0].vehicle, other.rate_hz) == (("virtual:x",), "modcube_sim", 200)
    assert fleet_of(fleet, None, None, None).module[0].number == 7


@pytest.mark.slow
def test_help_tells_the_defaults(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("sys.argv", ["modcube", "run", "--help"])
    with pytest.raises(SystemExit):
        from firmware_py.cli import main

        main()
    text = capsys.readouterr().out
    assert all(word in text for word in ("socketcan:can0", "[default: (modcube)]", "[default: (100)]", "not with --bus"))
