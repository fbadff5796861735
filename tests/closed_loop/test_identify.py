"""A robot that differs from its vehicle file is excited on the bench and identified from its log alone: one plant, a short flight.

tools/identify_plants.py does ten plants of three minutes; `make accept ONLY=identify`.
"""

import copy
import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from firmware_py.description.toml_text import to_toml
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle
from hil.plant.draw import draw_module
from hil.plant.spec import WorldSpec
from hil.scenario import load_scenario
from hil.signals import read_flight
from tests.closed_loop.flights import Fly, shortened

(
    fit_thruster, identify, identify_excitation, identify_fit, identify_log, identify_model, identify_motion, identify_plants,
    identify_quantities,
) = (
    importlib.import_module(name)
    for name in (
        "fit_thruster", "identify", "identify_excitation", "identify_fit", "identify_log", "identify_model", "identify_motion",
        "identify_plants", "identify_quantities",
    )
)  # fmt: skip

pytestmark = pytest.mark.slow
SEED, SECONDS = 5, 20.0


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """The folder of the log, and the identified values with the true ones."""
    folder = tmp_path_factory.mktemp("identify")
    return folder / str(SEED), identify_plants.examine(SEED, folder, SECONDS)


@pytest.fixture(scope="module")
def equations(plant: tuple[Path, dict]) -> object:
    recording = identify_log.read_recording(plant[0])
    weight = identify_model.Weight(2.0, 0.22, 10.0, 20.0)
    return identify_model.Equations(recording, identify_motion.smooth(recording), recording.vehicle.curve, weight)


def test_plant_is_found_from_its_log(plant: tuple[Path, dict]) -> None:
    """Twenty seconds. The vehicle file itself fails each of these limits."""
    found = identify_plants.summary([plant[1]])
    for kind in (identify_plants.MASS, identify_plants.DRAG):
        assert found[kind] < 0.05 < found[f"{kind}_before"]
    assert found[identify_plants.GAIN] < 0.02 < found[f"{identify_plants.GAIN}_before"]
    assert found["covered"] > 0.7


def test_motion_is_found_without_any_model_of_the_vehicle(plant: tuple[Path, dict]) -> None:
    recording, flight = identify_log.read_recording(plant[0]), read_flight(plant[0])
    motion = identify_motion.smooth(recording)
    inner = slice(300, -200)
    assert np.sqrt(np.mean((motion.p_wb - flight.truth["p_wb"])[inner] ** 2)) < 0.001
    assert np.sqrt(np.mean((motion.v_w - flight.truth["v_wb"])[inner] ** 2)) < 0.004


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["identify", *arguments])
    return int(identify.main())


def test_without_a_reference_no_mass_is_stated(
    plant: tuple[Path, dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, str(plant[0]), "--out", str(tmp_path)) in (0, 1)
    said = " ".join(capsys.readouterr().out.split())
    assert "refused: no absolute reference" in said and "no mass is stated" in said
    units = {each["unit"] for each in json.loads((tmp_path / "identified.json").read_text())["found"]}
    assert not units & {"kg", "N", "kg m^2"}
    assert not (tmp_path / "vehicle.toml").exists()
    assert not plant[1]["states_mass"]


def test_wrong_shape_of_the_measured_curve_moves_no_gain(equations) -> None:  # type: ignore[no-untyped-def]
    """Reverse is 2 % too strong and small commands some per cent off, as by load-cell noise. Thrusters push more one way than the other."""
    free = without_weight(equations)
    x = identify_model.initial_values(free.vehicle)
    x["gain"] = x["gain"] * np.linspace(0.95, 1.05, 8)
    x["shape"] = np.array([0.02, 0.02, -0.03, -0.01, 0.02])
    noise = np.random.default_rng(0).standard_normal(free.measured.shape) * np.repeat([0.001, 0.003], 3)
    free.measured = free.predict(x | {"current": np.zeros(3), "bias": np.zeros(3)}) + noise
    gain = identify_fit.fit([free], identify_fit.Reference(0, 0.02)).value("gain")
    assert gain / gain.mean() == pytest.approx(x["gain"] / x["gain"].mean(), abs=0.004)


@pytest.mark.parametrize(("hung", "complaint"), [("0:1000", "hung during all of the log"), ("500:1000", "did not hang during the log")])
def test_weight_that_neither_came_nor_went_states_no_mass(
    hung: str, complaint: str, plant: tuple[Path, dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, str(plant[0]), "--weight", f"2.0:0.22:{hung}", "--out", str(tmp_path)) == 2
    said = capsys.readouterr().err
    assert complaint in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_with_a_curve_it_leaves_a_vehicle_file_of_the_plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Thirty seconds: after twenty the thrusters' lag is only known to ten percent, which a vehicle file just permits."""
    identify_plants.examine(SEED, tmp_path / "flown", 30.0)
    vehicle = load_vehicle("modcube")
    curve = tmp_path / "curve.toml"
    curve.write_text(to_toml(vehicle.curve))
    assert run(monkeypatch, str(tmp_path / "flown" / str(SEED)), "--curve", str(curve), "--out", str(tmp_path)) in (0, 1)
    found = load_vehicle(str(tmp_path / "vehicle.toml"))
    draw = draw_module(vehicle, WorldSpec(), SEED, 0)
    total = np.diag(assemble_vehicle(found).mass)[:3]
    true = (draw.dry_kg + draw.entrained_kg + draw.added[:3]) / draw.gain[0]
    assert total == pytest.approx(true, rel=0.1)
    assert found.curve.lag_s == pytest.approx(WorldSpec().thruster_lag_s, rel=0.15)


def test_one_factor_of_everything_changes_no_motion(equations) -> None:  # type: ignore[no-untyped-def]
    """The homogeneity of the errata: no log alone determines a mass."""
    x = identify_model.initial_values(equations.vehicle) | {"current": np.array([0.05, -0.02, 0.0]), "bias": np.full(3, 0.03)}
    x["offset"], x["crossflow"], x["weight"] = np.full(3, 0.01), np.full(3, 0.2), np.array([0.3])
    factor, logarithms, rest = 1.3, ("mass", "inertia"), ("lag", "deadband", "shape", "current", "bias")
    scaled = {k: v + np.log(factor) if k in logarithms else v * (1.0 if k in rest else factor) for k, v in x.items()}
    free = without_weight(equations)
    assert free.predict(scaled) == pytest.approx(free.predict(x), rel=1e-9, abs=1e-12)
    assert np.abs(equations.predict(scaled) - equations.predict(x)).max() > 0.01  # a known weight makes the difference


def without_weight(equations):  # type: ignore[no-untyped-def]
    """The same flight without the weight."""
    free = copy.copy(equations)
    free._kept, free._load = {}, identify_model.Weight(0.0, 0.0, 0.0, 0.0)
    return free


def test_known_weight_takes_the_place_of_the_load_cell(equations) -> None:  # type: ignore[no-untyped-def]
    """Uses a flight simulated by the equations with 2 N attached for half of it, plus white noise."""
    x = identify_model.initial_values(equations.vehicle)
    x["mass"] = x["mass"] + 0.2
    x["gain"] = x["gain"] * np.linspace(1.1, 1.3, 8)
    carried = copy.copy(equations)
    carried._kept = {}
    noise = np.random.default_rng(0).standard_normal(equations.measured.shape) * np.repeat([0.01, 0.03], 3)
    carried.measured = equations.predict(x | {"current": np.zeros(3), "bias": np.zeros(3)}) + noise
    result = identify_fit.fit([carried], has_weight=True)
    assert result.has_scale
    for name in ("mass", "gain"):
        for i, true in enumerate(x[name]):
            value, half_width = result.interval(lambda found, at=result.slices[name].start + i: float(found[at]))
            assert value == pytest.approx(true, abs=max(2.0 * half_width, 1e-3))
            assert half_width < 0.1


def test_flight_that_only_holds_its_place_is_told_what_to_fly(
    tmp_path: Path, fly: Fly, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fly(shortened("hover", duration_s=4.0, settle_s=6.0).with_calm_world(), folder="held")
    capsys.readouterr()
    assert run(monkeypatch, str(tmp_path / "held"), "--out", str(tmp_path)) == 1
    said = capsys.readouterr().out
    assert "missing excitation: fast edge-on, for drag coefficient, edge-on" in said
    assert "missing excitation: turning" in said
    assert "fly it: .venv/bin/modcube hil run" in said
    wanted = load_scenario(str(tmp_path / "excite.toml"))
    assert wanted.task.yaw_turns and wanted.task.amplitude_m.any()


def test_log_of_five_seconds_is_refused_and_leaves_no_empty_folder(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, str(flown), "--out", str(tmp_path / "a" / "b")) == 2
    assert "at least 10 s are needed" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("seed", [0, 4])
def test_healthy_robot_that_turns_while_it_swims_keeps_all_its_thrusters(fly: Fly, seed: int, tmp_path: Path) -> None:
    """The masses differ by a tenth between axes, and the flow damps the turns; neither motion is a thruster's fault."""
    file = tmp_path / "shake.toml"
    file.write_text(identify_excitation.excitation(identify_excitation.MOTIONS, "modcube", duration_s=90.0), encoding="utf-8")
    result = fly(load_scenario(str(file)), seed)
    assert result.metrics["warnings"] == 0.0
    assert 0.001 <= result.metrics["position_rmse_m"] <= 0.015
