"""A thruster's load-cell measurement becomes a curve that a vehicle file accepts."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import constants

from firmware_py.description.builder import build
from firmware_py.description.schema import DescriptionError, read_toml
from firmware_py.description.vehicle import ThrusterCurve
from firmware_py.description.vehicle_file import load_vehicle

tool = importlib.import_module("fit_thruster")
LIKE = load_vehicle("modcube").curve
POWERS = np.arange(1, 6)
DATA = Path(__file__).parents[2] / "tools" / "data"


def measured(noise_n: float = 0.0, voltage_v: float = 12.0, idle_w: float = 0.0) -> dict[str, np.ndarray]:
    """41 points of the vehicle's own curve, as measured at another voltage and with the electronics' power included."""
    u = np.linspace(-1.0, 1.0, 41)
    force = np.where(u > 0.0, np.abs(u)[:, None] ** POWERS @ LIKE.forward, -(np.abs(u)[:, None] ** POWERS @ LIKE.reverse))
    force[np.abs(force) < LIKE.deadband_n] = 0.0
    force += noise_n * np.random.default_rng(0).standard_normal(len(u)) * (force != 0.0)
    side = np.where((force > 0.0)[:, None], LIKE.power_forward, LIKE.power_reverse)
    power = np.sum(np.abs(force)[:, None] ** POWERS * side, axis=1)
    power = power * (voltage_v / 12.0) ** tool.POWER_EXPONENT + idle_w
    force *= (voltage_v / 12.0) ** tool.VOLTAGE_EXPONENT
    return {"command": u, "force_n": force, "voltage_v": np.full(len(u), voltage_v), "power_w": power}


def write_csv(path: Path, points: dict[str, np.ndarray]) -> Path:
    rows = [",".join(points), *(",".join(f"{value:.9g}" for value in row) for row in np.column_stack(list(points.values())))]
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize(("voltage_v", "idle_w"), [(12.0, 0.0), (10.5, 0.0), (16.0, 0.0), (12.0, 5.0), (16.0, 5.0)])
def test_curve_that_was_measured_is_found_whatever_voltage_and_electronics(voltage_v: float, idle_w: float) -> None:
    curve, left_n = tool.fit_curve(measured(voltage_v=voltage_v, idle_w=idle_w), LIKE, 12.0, 0.05)
    assert left_n < 1e-6
    for name in ("forward", "reverse"):
        assert getattr(curve, name) == pytest.approx(getattr(LIKE, name), abs=1e-4)
    assert curve.deadband_n == pytest.approx(LIKE.deadband_n, abs=0.1)  # the points are 0.05 of full command apart
    f = np.linspace(0.5, 7.0, 9)[:, None] ** POWERS
    assert f @ curve.power_forward == pytest.approx(f @ LIKE.power_forward, rel=1e-3)
    assert f @ curve.power_reverse == pytest.approx(f @ LIKE.power_reverse, rel=1e-3)


def test_thruster_measured_at_16_volts_has_the_maker_s_force_and_power_at_12() -> None:
    """T200: forward 3.71 kgf and 203 W, reverse 2.90 kgf and 204 W at 12 V (maker's table)."""
    rows = np.genfromtxt(DATA / "t200_16v.csv", delimiter=",", names=True)
    u, volts = (rows["pwm_us"] - 1500.0) / 400.0, np.full(len(rows), 16.0)
    points = {"command": u, "force_n": constants.kgf * rows["force_kgf"], "voltage_v": volts, "power_w": rows["power_w"]}
    curve, _ = tool.fit_curve(points, LIKE, 12.0, 0.05)
    for name, kgf, watts in (("forward", 3.71, 203.0), ("reverse", 2.90, 204.0)):
        full_n = float(getattr(curve, name).sum())
        assert full_n == pytest.approx(constants.kgf * kgf, rel=0.03)
        assert full_n**POWERS @ getattr(curve, f"power_{name}") == pytest.approx(watts, rel=0.08)


def test_power_without_a_point_at_rest_is_taken_as_it_is() -> None:
    points = measured(idle_w=5.0)
    pushing = {name: column[np.abs(points["force_n"]) > 0.05] for name, column in points.items()}
    assert tool.idle_power(points, 0.05) == pytest.approx(5.0)
    assert tool.idle_power(pushing, 0.05) is None
    assert tool.fit_curve(pushing, LIKE, 12.0, 0.05)[0].power_forward.sum() > LIKE.power_forward.sum() + 1.0


def test_noise_does_not_make_the_curve_fall() -> None:
    """The schema refuses a falling curve, so wild points must not produce one."""
    for seed in range(5):
        points = measured()
        wild = 1.5 * np.random.default_rng(seed).standard_normal(41)
        points["force_n"] = np.sign(points["force_n"]) * np.abs(points["force_n"] + wild * (np.abs(points["force_n"]) > 2.0))
        curve, left_n = tool.fit_curve(points, LIKE, 12.0, 0.05)
        assert 0.3 < left_n < 3.0
        assert np.all(np.diff(np.linspace(0.0, 1.0, 500)[:, None] ** POWERS @ curve.forward) > 0.0)


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])  # a spreadsheet's byte-order mark
def test_file_that_is_written_is_a_vehicle_files_curve(
    mark: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = write_csv(tmp_path / "bench.csv", measured(0.02, idle_w=1.5)), tmp_path / "curve.toml"
    source.write_bytes(mark + source.read_bytes())
    monkeypatch.setattr(sys, "argv", ["fit_thruster", str(source), "--out", str(out)])
    assert tool.main() == 0
    told = capsys.readouterr().out
    assert "1.5 W at zero command taken off" in told
    assert "not measured, those of modcube: lag_s 0.08 s, rpm_at_full 3000 1/min" in told
    table, where = read_toml(out)
    curve = build(ThrusterCurve, table, where)
    assert np.sum(curve.forward) == pytest.approx(np.sum(LIKE.forward), rel=0.01)
    assert curve.lag_s == LIKE.lag_s


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("command,newton\n0,0\n", "no column force_n"),
        ("command,force_n\n0,zero\n", "2: 'zero' is not a number"),
        ("command,force_n\n0,0\n1.5,3\n", "3: command 1.5 is out of range"),
        ("command,force_n\n\n0,zero\n", "3: 'zero' is not a number"),
        ("command,force_n\n0,0\n\n\n1.5,3\n", "5: command 1.5 is out of range"),
        ("command,force_n\n0,0\n\n1,5,02\n", "4: has more columns than the header"),
        ("command,force_n\n1,5\n", "forward: 1 points"),
        ("command,force_n\n0,0\n1,5,02\n", "3: has more columns than the header; decimals need a point"),
        ("", "no column command, force_n"),
        ("command,force_n,voltage\n0,0,16\n", "1: column 'voltage' is unknown; did you mean voltage_v?"),
        ("command,force_n\n", "no measurement follows the header"),
        ("command,force_n\n0,\xff\n", "is no CSV in UTF-8"),
        ("command,force_n\n0,1e7\n", "2: '1e7' is not a number of at most 1e+06"),
        ("command,force_n,voltage_v\n0,0,12\n1,5,0\n", "3: voltage_v 0 is out of range; permitted: 1 to 100 V"),
    ],
)
def test_measurement_that_will_not_do_is_refused_in_one_line(
    text: str, complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bench.csv").write_text(text, encoding="latin-1")
    refused(tmp_path, monkeypatch, capsys, complaint)


@pytest.mark.parametrize(
    ("option", "value", "complaint"),
    [
        ("--voltage", "-12", "--voltage -12 is out of range; permitted: 1 to 100 V"),
        ("--voltage", "0", "--voltage 0 is out of range"),
        ("--voltage", "nan", "--voltage nan is out of range"),
        ("--zero", "-1", "--zero -1: a force of 0 N or more is needed"),
        ("--zero", "nan", "--zero nan: a force of 0 N or more is needed"),
    ],
)
def test_option_that_makes_no_sense_is_refused_in_one_line(
    option: str, value: str, complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_csv(tmp_path / "bench.csv", measured())
    refused(tmp_path, monkeypatch, capsys, complaint, option, value)


@pytest.mark.parametrize(
    ("name", "factor", "complaint"),
    [
        ("force_n", 2e4, "(not written):2: forward: ["),
        ("power_w", 0.0, "forward: power_w 0 with a force"),
        ("power_w", -1.0, "forward: power_w -"),
    ],
)
def test_thruster_that_no_vehicle_file_takes_is_refused_in_one_line(
    name: str, factor: float, complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    points = measured()
    write_csv(tmp_path / "bench.csv", points | {name: factor * points[name]})
    refused(tmp_path, monkeypatch, capsys, complaint)


@pytest.mark.parametrize("name", ["bench.csv", "mine.toml"])
def test_file_that_is_no_curve_is_not_written_over(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.toml").write_text('name = "mine"\n')
    write_csv(tmp_path / "bench.csv", measured())
    before = (tmp_path / name).read_bytes()
    refused(tmp_path, monkeypatch, capsys, f"{name}: there already, and no curve; give another name", "--out", str(tmp_path / name))
    assert (tmp_path / name).read_bytes() == before


def test_curve_of_an_earlier_fit_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, out = write_csv(tmp_path / "bench.csv", measured()), tmp_path / "runs" / "curve.toml"
    for voltage in ("12", "14"):
        monkeypatch.setattr(sys, "argv", ["fit_thruster", str(source), "--voltage", voltage, "--out", str(out)])
        assert tool.main() == 0
    assert out.read_text().startswith("voltage_v = 14.0")


def refused(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], complaint: str, *options: str) -> None:
    """Asserts that bench.csv in `folder` is refused with `complaint`, in one line, and leaves no curve."""
    monkeypatch.setattr(sys, "argv", ["fit_thruster", str(folder / "bench.csv"), "--out", str(folder / "curve.toml"), *options])
    assert tool.main() == 2
    said = capsys.readouterr().err
    assert complaint in said and said.count("\n") == 1
    assert not (folder / "curve.toml").exists()


def test_power_that_electronics_alone_draw_is_refused() -> None:
    points = measured(idle_w=5.0)
    points["power_w"][:] = 5.0
    with pytest.raises(DescriptionError, match="forward: power_w 5 at the most is not above the 5 at zero command"):
        tool.fit_curve(points, LIKE, 12.0, 0.05)


def test_thruster_that_pushes_against_its_command_is_refused() -> None:
    points = measured()
    points["force_n"] = -points["force_n"]
    with pytest.raises(DescriptionError, match="against it"):
        tool.fit_curve(points, LIKE, 12.0, 0.05)


def test_reading_that_was_lost_is_refused_and_makes_no_deadband() -> None:
    points = measured()
    points["force_n"][np.isclose(points["command"], 0.8)] = 0.0
    with pytest.raises(DescriptionError, match=r"forward: no force at command 0\.8, though smaller ones push"):
        tool.fit_curve(points, LIKE, 12.0, 0.05)
