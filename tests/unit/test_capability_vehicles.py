"""Vehicle files of the paper's robots: axes, sources, measured curves; and files that are refused."""

import csv
import dataclasses
import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from firmware_py.description.schema import DescriptionError, frozen_array
from firmware_py.description.vehicle import Payload
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble, assemble_vehicle
from firmware_py.prepare.capability.layout import of_modules, of_vehicle
from firmware_py.prepare.lattice import MATRICES
from tests.unit.capability_layouts import DATA, FLU_TO_FRD, LINE, ROOT, SQUARE, published

rising_polynomial = importlib.import_module("fit_thruster").rising_polynomial
KILOGRAM_FORCE = 9.80665
"""N."""
POWERS = np.arange(1, 6)


def rows_in_frd(name: str) -> np.ndarray:
    """(n, 6) published rows in FRD; the file whose axes are not stated is taken as FLU, as its vehicle file says."""
    rows = np.array(published(name)["thrusters"])
    if published(name)["axes"] == "FRD":
        return rows
    return np.hstack([rows[:, :3] @ FLU_TO_FRD, rows[:, 3:] @ FLU_TO_FRD])


@pytest.mark.parametrize(
    ("vehicle", "source", "axes"),
    [
        ("modcube", "A45_single", "FLU"),
        ("modcube_sim", "A_single", "not stated"),
        ("bluerov2", "G_bluerov2", "FLU"),
        ("bluerov2_heavy", "F_bluerov2_heavy", "FLU"),
        ("girona500", "E_girona500", "FRD"),
        ("chasing_m2", "D_chasing_m2", "FLU"),
    ],
)
def test_vehicle_file_is_its_published_layout_in_frd(vehicle: str, source: str, axes: str) -> None:
    found, rows = load_vehicle(vehicle), rows_in_frd(source)
    assert published(source)["axes"] == axes
    assert found.positions == pytest.approx(rows[:, :3])
    assert found.directions == pytest.approx(rows[:, 3:], abs=1e-4)
    assert (found.force_max_n, found.force_min_n) == (published(source)["f_max"], published(source)["f_min"])


def test_positive_thrust_of_a_vertical_thruster_lifts_a_bluerov2() -> None:
    """Up is minus z in FRD."""
    assert load_vehicle("bluerov2").directions[4] == pytest.approx([0.0, 0.0, -1.0])


def test_vehicles_state_their_sources_and_assumptions() -> None:
    for name in ("bluerov2", "bluerov2_heavy", "girona500", "chasing_m2"):
        assert load_vehicle(name).source
    assert "layout" in load_vehicle("chasing_m2").assumption
    assert "layout" in of_vehicle(load_vehicle("chasing_m2")).assumption
    assert "von Benzon" in load_vehicle("bluerov2_heavy").source


def test_heavy_has_its_published_dynamics() -> None:
    """von Benzon et al. (2022): 13.5 + 6.36 kg in surge; 13.7 + 141 |u| N s/m."""
    body = assemble_vehicle(load_vehicle("bluerov2_heavy"))
    assert np.diag(body.mass) == pytest.approx([19.86, 20.62, 32.18, 0.449, 0.365, 0.592])
    assert body.drag.linear == pytest.approx([13.7, 0.0, 33.0, 0.0, 0.8, 0.0])
    assert body.drag.rotational == pytest.approx([1.192, 0.47, 1.5])
    ahead, right, down = body.drag.nodes[0, 6, 6, 0], body.drag.nodes[2, 6, 6, 0], body.drag.nodes[4, 6, 6, 0]
    assert (ahead, right, down) == pytest.approx((141.0, 217.0, 190.0))


def t200() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Command, force (N) and power (W) of the measured table."""
    with (DATA / "t200_16v.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    pulse, force, power = (np.array([float(r[k]) for r in rows]) for k in ("pwm_us", "force_kgf", "power_w"))
    return (pulse - 1500.0) / 400.0, force * KILOGRAM_FORCE, power


def t200_side(sign: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Magnitude of the commands on one side of zero, with the force in that direction and the power."""
    command, force, power = t200()
    side = sign * command >= 0.0
    return sign * command[side], sign * force[side], power[side]


@pytest.mark.parametrize("name", ["bluerov2", "bluerov2_heavy"])
def test_vehicle_file_carries_the_fit_of_the_measured_thruster(name: str) -> None:
    curve = load_vehicle(name).curve
    for side, sign in (("forward", 1.0), ("reverse", -1.0)):
        command, force, power = t200_side(sign)
        assert getattr(curve, side) == pytest.approx(rising_polynomial(command, force, 1.0, 0.5), rel=1e-6)
        assert getattr(curve, f"power_{side}") == pytest.approx(rising_polynomial(force, power, force.max(), 0.0), rel=1e-6)
    force = np.abs(t200()[1])
    assert curve.deadband_n == pytest.approx(force[force > 0.0].min(), abs=1e-3)


@pytest.mark.parametrize(("side", "sign", "rms_n"), [("forward", 1.0, 0.236), ("reverse", -1.0, 0.201)])
def test_measured_thruster_is_fitted_closely_and_rises_everywhere(side: str, sign: float, rms_n: float) -> None:
    command, force, power = t200_side(sign)
    curve = load_vehicle("bluerov2").curve
    of_command, of_force = getattr(curve, side), getattr(curve, f"power_{side}")
    off_n, off_w = command[:, None] ** POWERS @ of_command - force, force[:, None] ** POWERS @ of_force - power
    assert np.sqrt(np.mean(off_n**2)) == pytest.approx(rms_n, abs=1e-3)
    assert np.abs(off_n).max() < 0.8
    assert np.sqrt(np.mean(off_w**2)) < 1.6
    for part, full in ((of_command, 1.0), (of_force, force.max())):
        assert np.all(np.diff(np.linspace(0.0, full, 2001)[:, None] ** POWERS @ part) > 0.0)


def test_plain_least_squares_would_not_rise_near_zero_command() -> None:
    command, force, _ = t200_side(1.0)
    powers = command[:, None] ** POWERS
    plain = np.linalg.lstsq(powers, force, rcond=None)[0]
    assert plain[0] < 0.0
    bounded = rising_polynomial(command, force, 1.0, 0.5)
    plain_n, bounded_n = (float(np.sqrt(np.mean((powers @ c - force) ** 2))) for c in (plain, bounded))
    assert bounded_n == pytest.approx(plain_n, abs=0.07)


def test_layout_of_docked_modules_is_that_of_the_assembled_body() -> None:
    vehicle = load_vehicle("modcube")
    for cells in (LINE, SQUARE):
        count = len(cells)
        body = assemble(cells, [0] * count, [vehicle] * count)
        assert of_modules(cells, [0] * count, [vehicle] * count).matrix == pytest.approx(body.thrusters.matrix)


def test_thrusters_of_turned_modules_push_about_what_they_and_their_loads_weigh_together() -> None:
    """Expected values by summing point masses: two of the three modules carry a load, and all have an off-centre centre of mass."""
    plain = load_vehicle("modcube")
    off = dataclasses.replace(plain.inertial, com_m=frozen_array([0.012, -0.007, 0.02]))
    load = Payload(
        name="weight", dry_kg=0.8, entrained_kg=0.3, size_m=frozen_array([0.05, 0.04, 0.03]), position_m=frozen_array([0.06, 0.02, -0.05])
    )
    bare = dataclasses.replace(plain, inertial=off)
    vehicles = [dataclasses.replace(bare, payload=(load,)), bare, dataclasses.replace(bare, payload=(load,))]
    cells, turns = [(0, 0, 0), (1, 0, 0), (1, 1, 0)], [0, 4, 12]
    lumps, rows = [], []
    for cell, turn, vehicle in zip(cells, turns, vehicles, strict=True):
        place, matrix = 0.21 * np.array(cell), MATRICES[turn]
        lumps += [(9.3, place + matrix @ off.com_m), *((1.1, place + matrix @ each.position_m) for each in vehicle.payload)]
        rows += [(place + matrix @ p, matrix @ d) for p, d in zip(vehicle.positions, vehicle.directions, strict=True)]
    centre = sum(kg * at for kg, at in lumps) / sum(kg for kg, _ in lumps)
    expected = np.array([np.r_[d, np.cross(p - centre, d)] for p, d in rows]).T
    layout = of_modules(cells, turns, vehicles)
    np.testing.assert_allclose(layout.matrix, expected, atol=1e-12)
    np.testing.assert_allclose(layout.matrix, assemble(cells, turns, vehicles).thrusters.matrix, atol=1e-12)


def altered(tmp_path: Path, change: tuple[str, str]) -> Path:
    text = (ROOT / "firmware_py" / "vehicles" / "girona500.toml").read_text()
    assert change[0] in text
    path = tmp_path / "wrong.toml"
    path.write_text(text.replace(*change, 1))
    return path


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (("direction = [0.0, 1.0, 0.0]", "direction = [0.0, 0.0, 0.0]"), "direction = [0.0, 0.0, 0.0]"),
        (("direction = [0.0, 1.0, 0.0]", "direction = [0.0, nan, 0.0]"), "direction = [0.0, nan, 0.0]"),
        (("force_max_n = 139.97", "force_max_n = nan"), "force_max_n = nan"),
    ],
)
def test_wrong_vehicle_file_is_refused_with_its_line(tmp_path: Path, change: tuple[str, str], where: str) -> None:
    path = altered(tmp_path, change)
    lines = path.read_text().splitlines()
    with pytest.raises(DescriptionError) as refused:
        load_vehicle(str(path))
    match = re.match(rf"{re.escape(str(path))}:(\d+): (.+)", str(refused.value))
    assert match and "\n" not in str(refused.value)
    at = next(k for k, line in enumerate(lines, 1) if where in line)
    assert at - 2 <= int(match[1]) <= at  # the line of the key, or of its table's header
    assert re.search("has length|finite|out of range", match[2])


def test_vehicle_without_thrusters_is_refused(tmp_path: Path) -> None:
    text = (ROOT / "firmware_py" / "vehicles" / "girona500.toml").read_text()
    path = tmp_path / "none.toml"
    path.write_text(text[: text.index("[[thruster]]")])
    with pytest.raises(DescriptionError, match=rf"{re.escape(str(path))}:\d+: thruster: missing key"):
        load_vehicle(str(path))
    path.write_text("thruster = []\n" + path.read_text())
    with pytest.raises(DescriptionError, match=r"none\.toml:\d+: .*at least one"):
        load_vehicle(str(path))
