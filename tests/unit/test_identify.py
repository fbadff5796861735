"""Parts of tools/identify.py on synthetic data, without a flight."""

import dataclasses
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import identify as tool
import identify_excitation as excitation
import identify_fit as fit
import identify_model as model
import identify_motion as motion
import identify_quantities as quantities
import numpy as np
import pytest

from firmware_py.core import rigid_body
from firmware_py.core.rotations import exp, rotate, rotate_back
from firmware_py.core.types import BodyPose
from firmware_py.description.builder import build
from firmware_py.description.parameters import Estimation
from firmware_py.description.schema import DescriptionError, frozen_array, read_toml
from firmware_py.description.toml_text import to_toml
from firmware_py.description.vehicle import Payload, Vehicle
from firmware_py.description.vehicle_file import load_vehicle, vehicle_names
from firmware_py.description.water import GRAVITY
from firmware_py.prepare.assembly import assemble_vehicle
from hil.plant.spec import WorldSpec
from hil.scenario import load_scenario


def test_noise_of_a_sensor_is_found_beside_its_motion() -> None:
    t = np.arange(2000)[:, None] * 0.01
    moved = np.sin(2.0 * t + np.arange(3)) + 0.002 * np.random.default_rng(0).standard_normal((2000, 3))
    assert motion.noise_of(moved) == pytest.approx(0.002, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("at_m", [(0.0, 0.0, 0.0), (0.03, -0.02, 0.04)])
def test_motion_is_that_of_the_centre_of_mass_wherever_the_imu_is(at_m: tuple[float, float, float]) -> None:
    """A centre that stands still while the body turns about it; the tags' positions are poor, so the accelerometer counts."""
    rng, count, lever, tag_at = np.random.default_rng(0), 1500, np.array(at_m), np.array([0.0, 0.0, -0.105])
    t = 0.01 * np.arange(count)
    rate, change = np.zeros((2, count, 3))
    rate[:, 0], change[:, 0] = 1.5 * np.cos(3.0 * t), -4.5 * np.sin(3.0 * t)
    turns = [exp(np.array([angle, 0.0, 0.0])) for angle in 0.5 * np.sin(3.0 * t)]
    felt = np.cross(change, lever) + np.cross(rate, np.cross(rate, lever))
    felt += [rotate_back(q, np.array([0.0, 0.0, -GRAVITY])) for q in turns]
    poses = [
        BodyPose(10_000_000 * k, rotate(turns[k], tag_at) + 0.01 * rng.standard_normal(3), tag_at, turns[k], 1)
        for k in range(0, count, 2)
    ]  # fmt: skip
    recording = SimpleNamespace(
        body=SimpleNamespace(r_bi=lever[None]), period_s=0.01, time_ns=10_000_000 * np.arange(count), poses=poses,
        gyro=rate + 0.002 * rng.standard_normal((count, 3)), accel=felt + 0.02 * rng.standard_normal((count, 3)),
        noise=dataclasses.replace(Estimation(), tag_sigma_m=0.01, tag_sigma_axis_m=0.01),
    )  # fmt: skip
    found = motion.smooth(recording)
    assert np.sqrt(np.mean(found.v_w[100:-100] ** 2)) < 0.003
    assert np.sqrt(np.mean(found.p_wb[100:-100] ** 2)) < 0.003


def test_window_sees_a_rate_as_the_slope_of_its_integral() -> None:
    """Both sides of the equations pass the same window, so a jump of the moment appears alike in both."""
    h, dt = model.HALF_WINDOW, 0.01
    jump = (np.arange(60) >= 30).astype(float)
    rate = np.concatenate([[0.0], np.cumsum(0.5 * (jump[1:] + jump[:-1]))])[:, None] * dt
    assert model._slope(rate, dt)[:, 0] == pytest.approx(np.convolve(jump, model._window(h), "valid"), abs=1e-12)


def test_interval_is_as_wide_as_kiefer_and_vogelsang_say() -> None:
    """Their table 1, 97.5 %, Bartlett: 1.96 at b = 0, 4.771 at b = 1."""
    assert fit.critical_value(0.0) == pytest.approx(1.96)
    assert fit.critical_value(1.0) == pytest.approx(4.771, abs=0.06)


def test_reference_within_two_percent_has_the_spread_of_even_odds() -> None:
    assert fit.Reference(0, 0.02).sigma == pytest.approx(0.02 / np.sqrt(3.0))


def test_whole_excitation_is_a_scenario_that_stays_in_its_tank(tmp_path: Path) -> None:
    file = tmp_path / "shake.toml"
    file.write_text(excitation.excitation(list(excitation.MOTIONS), "modcube"))
    scenario = load_scenario(str(file))
    task = scenario.task
    assert task.settle_s + task.duration_s == pytest.approx(180.0)  # the log of three minutes
    assert np.linalg.norm(task.amplitude_m[:2]) < scenario.tank.radius_m - 0.2
    assert task.centre_m[2] + task.amplitude_m[2] < scenario.tank.depth_m - 0.2
    assert task.yaw_turns and task.roll_turns
    assert {check.metric for check in scenario.check} == {"estimate_position_rmse_m", "warnings"}  # a flight ended by a fail-safe fails


@pytest.mark.parametrize(
    ("motions", "axes", "turns"),
    [(["along y"], [1], False), (["turning"], [], True), (["fast edge-on", "turning"], [0, 1], True), (["along z"], [2], False)],
)
def test_excitation_makes_only_the_motion_that_is_missing(motions: list[str], axes: list[int], turns: bool, tmp_path: Path) -> None:
    file = tmp_path / "shake.toml"
    file.write_text(excitation.excitation(motions, "modcube"))
    task = load_scenario(str(file)).task
    assert np.flatnonzero(task.amplitude_m).tolist() == axes
    assert (task.yaw_turns != 0.0) is turns and (task.roll_turns != 0.0) is turns


@pytest.mark.parametrize(
    ("faces", "passive", "why"),
    [
        (range(6), (), ""), ((2, 3, 4, 5), (), ""), ((0, 1, 5), (), "lose its tags"), ((3, 4, 5), (), "lose its tags"),
        (range(6), ("roll",), "left to buoyancy"),
    ],
)  # fmt: skip
def test_vehicle_rolls_only_where_the_camera_keeps_a_tag_in_sight(
    faces: Sequence[int], passive: tuple[str, ...], why: str, tmp_path: Path
) -> None:
    """Face A is +x, F is -z, the top one."""
    whole = load_vehicle("modcube")
    tags = tuple(tag for tag in whole.tag if tag.id in faces)
    no_roll = excitation.why_no_roll(dataclasses.replace(whole, tag=tags, passive_dof=passive))
    assert bool(no_roll) == bool(why) and why in no_roll
    file = tmp_path / "shake.toml"
    file.write_text(excitation.excitation(["turning"], "modcube", no_roll=no_roll))
    task = load_scenario(str(file)).task
    assert task.yaw_turns and bool(task.roll_turns) is not bool(why)


def test_excitation_is_flown_with_thrusters_as_the_vehicle_has_them() -> None:
    """Those of the bench are a module's: a vehicle of 0.05 s and 0.03 N lost a healthy thruster and its way in this flight."""
    bench, quick = load_vehicle("modcube").curve, dataclasses.replace(load_vehicle("modcube").curve, lag_s=0.05, deadband_n=0.034)
    worlds = [tomllib.loads(excitation.excitation(["turning"], "modcube", curve=curve)).get("world") for curve in (None, bench, quick)]
    assert worlds[0] is None
    assert worlds[1] == {name: getattr(WorldSpec(), name) for name in ("thruster_lag_s", "deadband_low_n", "deadband_high_n")}
    assert worlds[2] == {"thruster_lag_s": 0.05, "deadband_low_n": 0.02, "deadband_high_n": 0.05}


@pytest.mark.parametrize(("arm_m", "rolls"), [(0.012, True), (0.015, False)])
def test_vehicle_rolls_only_where_its_thrusters_can_turn_it_over(arm_m: float, rolls: bool) -> None:
    """An ROV whose righting moment was nine tenths of its roll moment was 60 deg off, and its mass 8 % with an interval of 3 %."""
    whole = load_vehicle("modcube")
    stiff = dataclasses.replace(whole, inertial=dataclasses.replace(whole.inertial, righting_arm_m=arm_m))
    assert ("righting moment" not in excitation.why_no_roll(stiff)) is rolls


def test_heavy_vehicle_is_shaken_as_its_thrusters_can() -> None:
    """One of 0.2 m/s^2 saturated for three minutes, and the mass that was identified was twice its own."""
    whole = load_vehicle("modcube")
    heavy = dataclasses.replace(whole, inertial=dataclasses.replace(whole.inertial, dry_kg=130.0))
    paces = [excitation.pace_of(assemble_vehicle(vehicle)) for vehicle in (whole, heavy)]
    assert paces == [1.0, pytest.approx((25.46 / 142.9) ** 0.5, rel=1e-3)]
    assert f"turns = {9.0 * paces[1]:.2f}" in excitation.excitation(["turning"], "modcube", pace=paces[1])


@pytest.mark.parametrize(("face", "said"), [(0, True), (5, False)])
def test_excitation_of_a_vehicle_without_a_tag_on_top_says_whose_camera_is_wanted(
    face: int, said: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was never armed in that flight, for want of a pose."""
    monkeypatch.chdir(tmp_path)
    whole = load_vehicle("modcube")
    Path("one.toml").write_text(to_toml(dataclasses.replace(whole, tag=(whole.tag[face],))), encoding="utf-8")
    monkeypatch.setattr(sys, "argv", ["identify", "--excitation", "shake.toml", "--vehicle", "one.toml"])
    assert tool.main() == 0
    assert ("its camera looks down, and modcube has no tag on top: put yours in its place" in capsys.readouterr().out) is said
    assert load_scenario("shake.toml").world.thruster_lag_s == whole.curve.lag_s


def test_smaller_room_is_kept_and_shaken_faster() -> None:
    text = excitation.excitation(["along x"], "modcube", (0.15, 0.5, 0.3))
    assert "amplitude_m = [0.15, 0.0, 0.0]" in text
    assert "turns = 18.00" in text  # a quarter of the way, twice as often: the same acceleration


@pytest.mark.parametrize(
    ("motions", "space_m", "axes"),
    [
        (["along x"], (0.0, 0.5, 0.3), "x"),
        (["along x", "along z"], (0.6, 0.5, 0.0), "z"),
        (["fast face-on"], (0.0, 0.0, 0.3), "x, y"),
        (["along y"], (0.6, 0.0004, 0.3), "y"),  # written in millimetres
    ],
)
def test_no_room_for_a_wanted_motion_is_refused(motions: list[str], space_m: tuple[float, ...], axes: str) -> None:
    with pytest.raises(DescriptionError, match=f"leaves no room along {axes};"):
        excitation.excitation(motions, "modcube", space_m)


@pytest.mark.parametrize("motion", ["along y", "turning"])
def test_motion_that_needs_no_room_along_x_takes_none(motion: str) -> None:
    assert "amplitude_m = [0.0, " in excitation.excitation([motion], "modcube", (0.0, 0.5, 0.3))


@pytest.mark.parametrize(
    "text",
    [
        "2.0", "2.0:0.2:60", "2:0.2:60:120:1", "a:b:c:d", "0:0.2:60:120", "2:0.2:120:60", "nan:0.2:60:120", "inf:0.2:60:120",
        "2:nan:60:120", "2:inf:60:120", "2:0.2:60:inf", "1e300:0.2:60:120", "-2e5:0.2:60:120", "2:1e300:60:120",
    ],
)  # fmt: skip
def test_weight_that_makes_no_sense_is_refused(text: str) -> None:
    with pytest.raises(DescriptionError, match="--weight"):
        tool.parse_weight(text)


def made_up(
    weight: model.Weight | None = None, com_m: tuple[float, float, float] = (0.0, 0.0, 0.0), depth_m: float = 1.5
) -> model.Equations:
    """Half a minute of tumbling at random commands, without measurements yet."""
    vehicle, count, dt = load_vehicle("modcube"), 3001, 0.01
    vehicle = dataclasses.replace(vehicle, inertial=dataclasses.replace(vehicle.inertial, com_m=frozen_array(com_m)))
    body, t, rng = assemble_vehicle(vehicle), np.arange(count) * dt, np.random.default_rng(0)
    turned = np.array([exp(angle) for angle in np.sin(np.outer(t, [0.7, 0.9, 1.1]))])
    command = np.repeat(rng.uniform(-1.0, 1.0, (count // 50 + 1, len(vehicle.thruster))), 50, axis=0)[:count]
    swum = 0.1 * np.sin(np.outer(t, [1.3, 1.7, 2.1]))
    recording = SimpleNamespace(
        vehicle=vehicle, body=body, name="made-up", period_s=dt, time_ns=np.arange(count) * 10_000_000, armed=np.ones(count),
        accel=np.zeros((count, 3)), command=command, voltage_v=np.full(count, 12.0),
    )  # fmt: skip
    below = np.array([0.0, 0.0, depth_m])
    return model.Equations(recording, motion.Motion(below + swum, swum, turned, 0.5 * swum), vehicle.curve, weight)


@pytest.mark.slow
def test_gusts_are_found_beside_the_drag_and_leave_it_alone() -> None:
    flight, rng = made_up(), np.random.default_rng(1)
    x = model.initial_values(flight.vehicle) | {"current": np.array([0.04, 0.0, -0.03]), "bias": np.zeros(3)}
    covariance = np.linalg.inv(model.gust_precision(flight.knots.shape[1]))
    assert np.diag(covariance) == pytest.approx(1.0)
    gusts = 0.05 * np.linalg.cholesky(covariance) @ rng.standard_normal((len(covariance), 3))
    noise = np.repeat([0.003, 0.006], 3) * rng.standard_normal((len(flight.time_s), 6))
    for _ in range(20):  # the prediction depends on the measurement
        flight.measured = flight.predict(x | {"gust": gusts.ravel()}) + noise
    found = fit.fit([flight], fit.Reference(0, 0.02))
    assert found.gust_m_s == pytest.approx(0.05, rel=0.35)
    assert found.residual == pytest.approx(np.repeat([0.003, 0.006], 3), rel=0.15)
    for i, name in enumerate(("cd_face", "cd_edge")):
        value, half_width = found.interval(lambda u, i=i: float(u[found.slices["drag"]][i]))  # type: ignore[misc]
        assert abs(value - getattr(flight.vehicle.drag, name)) < 1.5 * half_width


def test_rows_at_the_surface_are_left_out_and_a_log_of_nothing_else_is_refused() -> None:
    under, partly = made_up(), made_up(depth_m=0.2)
    assert 0 < len(partly.time_s) < len(under.time_s)
    with pytest.raises(DescriptionError, match=r"made-up: .* wholly under water"):
        made_up(depth_m=-1.0)


def hang(flight: model.Equations, x: dict[str, np.ndarray], lever: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(n, 6) measurements with the weight at `lever` from the centre of mass; in `flight` it hangs at the centre of mass itself."""
    for _ in range(20):  # the prediction depends on the measurement
        pull = flight._loaded[:, None] * (2.0 * flight._down - 0.22 * flight.measured[:, :3])
        turned = np.cross(lever, pull) / np.exp(x["inertia"])
        flight.measured = flight.predict(x) + noise + np.hstack([np.zeros_like(turned), turned])
    return flight.measured


def test_added_mass_of_a_hull_beside_the_centre_of_mass_moves_and_turns_as_in_the_firmware() -> None:
    """With neither thrust, drag nor righting, by the firmware's mass and Coriolis matrices. Without the coupling a vehicle whose weight
    is 3 cm below the middle of its hull was found a tenth too light, with five times its inertia in pitch.
    """
    flight = made_up(com_m=(0.0, 0.0, 0.03))
    body, forces = assemble_vehicle(flight.vehicle), ("gain", "drag", "rotational", "arm")
    x = model.initial_values(flight.vehicle) | {"current": np.zeros(3), "bias": np.zeros(3)}
    x |= {name: 0.0 * x[name] for name in forces}
    for _ in range(40):  # the prediction depends on the measurement
        flight.measured = flight.predict(x)
    v, _ = flight._drag("drag", np.zeros(3))
    for i, (velocity, rate) in enumerate(zip(v, flight._w, strict=True)):
        nu, speeding = np.concatenate([velocity, rate]), flight.measured[i].copy()
        speeding[:3] -= np.cross(rate, velocity)
        coriolis = np.zeros(6)
        rigid_body.take_coriolis(body.mass, nu, coriolis)
        np.testing.assert_allclose(body.mass @ speeding, coriolis, atol=1e-9)


def test_drag_of_a_hull_beside_the_centre_of_mass_turns_it() -> None:
    """It acts in the middle of the hull, in the flow that is there."""
    flight = made_up(com_m=(0.0, 0.0, 0.03))
    x = model.initial_values(flight.vehicle) | {"current": np.zeros(3), "bias": np.zeros(3)}
    with_drag, without = flight.predict(x), flight.predict(x | {"drag": np.zeros(2)})
    force, moment = np.split((with_drag - without) * np.exp(np.concatenate([x["mass"], x["inertia"]])), 2, axis=1)
    np.testing.assert_allclose(moment, np.cross([0.0, 0.0, -0.03], force), atol=1e-9)
    assert np.abs(moment).max() > 1e-3


def test_priors_are_as_wide_as_the_vehicle_is_heavy_and_large() -> None:
    """Those of a module's damping held the turning of a vehicle of half a metre for inertia."""
    small = load_vehicle("modcube")
    large = dataclasses.replace(small, hull=dataclasses.replace(small.hull, size_m=frozen_array(2.0 * small.hull.size_m)))
    module, twice = ({unknown.name: unknown.width for unknown in model.unknowns(vehicle)} for vehicle in (small, large))
    assert module["rotational"] == pytest.approx(0.05) and twice["rotational"] == pytest.approx(0.05 * 2**5)
    assert module["crossflow"] == pytest.approx(0.5) and twice["crossflow"] == pytest.approx(0.5 * 2**4)
    assert module["arm"] == pytest.approx(0.5) and twice["arm"] == pytest.approx(1.0) and twice["gain"] == module["gain"]


@pytest.mark.slow
@pytest.mark.parametrize("at_m", [None, (0.0, 0.0, 0.0), (0.1, -0.05, 0.03)])
def test_weight_that_pulls_at_an_arm_is_not_taken_for_righting(at_m: tuple[float, float, float] | None) -> None:
    com = (0.01, 0.0, 0.02)
    weight = model.Weight(2.0, 0.22, 10.0, 20.0)
    place = at_m or (0.0, 0.0, 0.105)  # half the hull's height below its middle
    flight, centred = made_up(weight._replace(at_m=at_m), com), made_up(weight._replace(at_m=com), com)
    x = model.initial_values(flight.vehicle) | {"current": np.zeros(3), "bias": np.zeros(3)}
    x["mass"], x["gain"] = x["mass"] + 0.1, 1.1 * x["gain"]
    noise = np.random.default_rng(1).standard_normal(flight.measured.shape) * np.repeat([0.001, 0.003], 3)
    flight.measured = hang(centred, x, np.array(place) - com, noise)
    found = fit.fit([flight], has_weight=True)
    assert found.value("arm") == pytest.approx(x["arm"], abs=0.005)
    assert np.exp(found.value("mass") - x["mass"]) == pytest.approx(np.ones(3), abs=0.01)
    assert np.exp(found.value("inertia") - x["inertia"]) == pytest.approx(np.ones(3), abs=0.02)


@pytest.mark.parametrize("at", [("nan", "0", "0"), ("0", "0", "11"), ("0", "inf", "0")])
def test_weight_that_hung_nowhere_near_is_refused(at: tuple[str, ...]) -> None:
    with pytest.raises(DescriptionError, match=r"--hung-at .*: three distances of 10 m at most are needed"):
        tool.parse_weight("2:0.2:60:120", [float(word) for word in at])
    assert tool.parse_weight("2:0.2:60:120", [0.0, 0.1, -0.2]).at_m == (0.0, 0.1, -0.2)


@pytest.mark.parametrize(
    ("from_s", "until_s", "complaint"),
    [(0.0, 20.0, "hung during all"), (2.0, 10.1, "hung during all"), (11.0, 20.0, "did not hang"), (0.0, 2.0, "did not hang")],
)
def test_weight_that_neither_came_nor_went_is_refused(from_s: float, until_s: float, complaint: str) -> None:
    flight = SimpleNamespace(time_s=np.linspace(2.0, 10.0, 81))
    with pytest.raises(DescriptionError, match=complaint):
        tool.check_hung(model.Weight(2.0, 0.2, from_s, until_s), flight)
    tool.check_hung(model.Weight(2.0, 0.2, 0.0, 2.1), flight)
    tool.check_hung(model.Weight(2.0, 0.2, 2.1, 20.0), flight)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "no LOG was given"),
        (["nowhere"], "no can.log"),
        (["a", "b", "--weight", "2:0.2:1:2"], "give one LOG"),
        (["a", "--hung-at", "0", "0", "-0.1"], "--hung-at says where a weight hung; give --weight with it"),
        (["a", "--thruster", "2"], "--thruster and --accuracy tell of a measured curve; give --curve with them"),
        (["a", "--accuracy", "5"], "--thruster and --accuracy tell of a measured curve; give --curve with them"),
        (["--excitation", "shake.toml", "--space", "nan", "nan", "nan"], "--space nan nan nan: three distances of 0 m or more"),
        (["--excitation", "shake.toml", "--space", "0.6", "-0.5", "0.3"], "--space 0.6 -0.5 0.3: three distances of 0 m or more"),
        (["--excitation", "shake.toml", "--space", "0.6", "0.5", "inf"], "--space 0.6 0.5 inf: three distances of 0 m or more"),
        (["--excitation", "shake.toml", "--space", "0.6", "0.5", "0"], "--space 0.6 0.5 0 leaves no room along z"),
        (["--excitation", "shake"], "--excitation shake: a scenario's file is a .toml file; give shake.toml"),
        (["--excitation", "shake.toml", "--vehicle", "bluerov2_heavy"], "give a file without drag.quadratic"),
        (["--excitation", "shake.toml", "--vehicle", "girona500"], "vehicle girona500: it carries no tag"),
        (["nowhere", "--excitation", "shake.txt"], "--excitation shake.txt: a scenario's file is a .toml file"),
        (["nowhere", "--space", "nan", "0.5", "0.3"], "--space nan 0.5 0.3"),
    ],
)
def test_what_cannot_run_says_so_in_one_line(
    arguments: list[str], complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["identify", *arguments])
    assert tool.main() == 2
    said = capsys.readouterr().err
    assert complaint in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_excitation_is_said_how_to_fly_and_writes_over_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["identify", "--excitation", "first shake.toml"])
    assert tool.main() == 0
    assert capsys.readouterr().out == "fly it: .venv/bin/modcube hil run 'first shake.toml'\n"
    (tmp_path / "first shake.toml").write_text("mine", encoding="utf-8")
    assert tool.main() == 2
    assert "first shake.toml: there already, and nothing is written over; give another name or delete it" in capsys.readouterr().err
    assert (tmp_path / "first shake.toml").read_text(encoding="utf-8") == "mine"


def test_result_of_an_earlier_log_does_not_stay_beside_that_of_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tool.write_results(tmp_path, {"identified.json": "{}", "vehicle.toml": "of the first"})
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    tool.write_results(tmp_path, {"identified.json": "{}", "excite.toml": "of the second"})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["excite.toml", "identified.json", "notes.txt"]
    assert capsys.readouterr().out == f"deleted: {tmp_path / 'vehicle.toml'}, of an earlier run\n"


@pytest.mark.parametrize("name", vehicle_names())
def test_vehicle_that_is_written_is_the_vehicle(name: str, tmp_path: Path) -> None:
    vehicle, file = load_vehicle(name), tmp_path / "again.toml"
    file.write_text(to_toml(vehicle))
    table, source = read_toml(file)
    again: Vehicle = build(Vehicle, table, source)
    assert to_toml(again) == to_toml(vehicle)


def test_linear_damping_is_counted_once() -> None:
    """The coefficients are fitted to all of the drag, so what is linear in the file before is in them."""
    described = load_vehicle("modcube")
    vehicle = dataclasses.replace(described, drag=dataclasses.replace(described.drag, linear=np.full(6, 3.0)))
    found = quantities.fitted_vehicle(SimpleNamespace(value=model.initial_values(vehicle).get), vehicle, vehicle.curve, "none")
    np.testing.assert_array_equal(found.drag.linear, np.zeros(6))


@pytest.mark.parametrize("loads", [0, 1, 2])
def test_what_a_vehicle_carries_is_written_once(loads: int) -> None:
    """A fit that changed nothing gives the vehicle unchanged."""
    box = Payload(name="box", dry_kg=1.5, entrained_kg=0.2, size_m=np.array([0.1, 0.1, 0.2]), position_m=np.array([0.0, 0.05, 0.15]))
    vehicle = dataclasses.replace(load_vehicle("modcube"), payload=(box,) * loads)
    found = quantities.fitted_vehicle(SimpleNamespace(value=model.initial_values(vehicle).get), vehicle, vehicle.curve, "none")
    np.testing.assert_allclose(np.diag(assemble_vehicle(found).mass), np.diag(assemble_vehicle(vehicle).mass))
    np.testing.assert_allclose(found.inertial.added, vehicle.inertial.added, atol=1e-12)
    assert found.inertial.righting_arm_m == pytest.approx(vehicle.inertial.righting_arm_m)


def test_robot_that_is_found_heavier_than_its_hull_carries_is_written_as_a_vehicle(tmp_path: Path) -> None:
    """Regression: with 15 % more mass than in the file, as in a world of the bench, the file was refused: it "cannot float"."""
    vehicle = load_vehicle("modcube")
    values = model.initial_values(vehicle) | {"mass": np.log(1.15) + model.initial_values(vehicle)["mass"]}
    found = quantities.fitted_vehicle(SimpleNamespace(value=values.get), vehicle, vehicle.curve, "none")
    (tmp_path / "heavy.toml").write_text(to_toml(found), encoding="utf-8")
    assert load_vehicle(str(tmp_path / "heavy.toml")).inertial.wet_kg > vehicle.inertial.wet_kg
    np.testing.assert_allclose(np.diag(assemble_vehicle(found).mass)[:3], 1.15 * np.diag(assemble_vehicle(vehicle).mass)[:3])
