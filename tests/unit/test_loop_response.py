"""The measured open loop against the closed loop that it predicts, and margins of loops with known ones."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_response import LINES, Loop, Response, Scale, body_of, controlled, corners, lines, margins, measure
from matplotlib import pyplot

from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.description.toml_text import to_toml
from firmware_py.description.vehicle import AXES
from firmware_py.description.vehicle_file import load_vehicle

SURGE = 0


def ideal(gain: float, delay_s: float) -> Response:
    """gain exp(-j w delay) / (j w): phase margin 90 deg - gain delay, gain margin pi / (2 gain delay)."""
    w = np.geomspace(0.1, 100.0, 400)
    return Response(w, gain * np.exp(-1j * w * delay_s) / (1j * w))


def test_margins_of_an_integrator_with_delay_are_the_known_ones() -> None:
    found = margins(ideal(2.0, 0.2))
    assert found.crossover_rad_s == pytest.approx(2.0, rel=1e-3)
    assert found.phase_deg == pytest.approx(90.0 - np.degrees(0.4), abs=0.05)
    assert found.gain_db == pytest.approx(20.0 * np.log10(np.pi / 0.8), abs=0.02)


def test_loop_that_may_also_lose_gain_shows_the_nearer_margin() -> None:
    """PID on a double integrator, which also becomes unstable when the gain falls."""
    w = np.geomspace(0.1, 100.0, 400)
    s = 1j * w
    loop = 4.0 * (s + 1.0) ** 2 / s**3
    found = margins(Response(w, loop))
    assert found.gain_db == pytest.approx(20.0 * np.log10(8.0), abs=0.05)  # Routh: stable above a gain of 1/2


@pytest.mark.parametrize("gain", [1e-3, 1e3])
def test_loop_that_crosses_nowhere_has_no_margins_to_state(gain: float) -> None:
    never = ideal(gain, 0.01)
    assert margins(never) == pytest.approx((0.0, 0.0, np.nan), nan_ok=True)
    assert margins(never._replace(controlled=False))[:2] == (np.inf, np.inf)


def test_axis_that_no_thruster_pushes_is_not_controlled() -> None:
    assert [name for name, pushed in zip(AXES, controlled(body_of(1, "bluerov2")), strict=True) if not pushed] == ["pitch"]
    assert controlled(body_of(1, "bluerov2_heavy")).all() and controlled(body_of(2, "modcube")).all()


def test_axis_that_a_vehicle_leaves_to_buoyancy_is_not_controlled(tmp_path: Path) -> None:
    """Its thrusters could push it, but are never asked to."""
    own = tmp_path / "own.toml"
    own.write_text(to_toml(load_vehicle("bluerov2_heavy")).replace("passive_dof = []", 'passive_dof = ["roll"]'), encoding="utf-8")
    assert [name for name, pushed in zip(AXES, controlled(body_of(1, str(own))), strict=True) if not pushed] == ["roll"]


def judged(pitch: Response) -> list[dict[str, Any]]:
    """Rows of tools/margins.py, which are also printed, for good loops with `pitch` as the pitch loop, nominal and worst."""
    tool = importlib.import_module("margins")
    loops = [pitch if name == "pitch" else ideal(2.0, 0.2) for name in AXES]
    rows: list[dict[str, Any]] = tool.rows({1: {tool.NOMINAL: loops}})
    tool.print_table(rows)
    return rows


def test_axis_that_is_not_controlled_is_named_and_left_out_of_the_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    silent = Response(np.geomspace(0.3, 30.0, 20), np.zeros(20, complex), controlled=False)
    assert all(row["passed"] for row in judged(silent))
    line = next(line for line in capsys.readouterr().out.splitlines() if "pitch" in line)
    assert "not controlled" in line and "inf" not in line


def test_controlled_axis_that_never_reaches_0_db_fails(capsys: pytest.CaptureFixture[str]) -> None:
    rows = judged(ideal(1e-3, 0.01))
    assert [row["axis"] for row in rows if not row["passed"]] == ["pitch", "pitch"]
    said = capsys.readouterr().out
    assert "FAILED: no crossover" in said and "limits: " in said


def test_picture_marks_crossover_and_margins_where_they_are_read_off() -> None:
    mark = importlib.import_module("margins").mark
    figure, (gain, phase) = pyplot.subplots(2, 1)
    mark(gain, phase, ideal(2.0, 0.2), "surge", "black")
    crossover, gain_bar = (line.get_xydata() for line in gain.lines)
    (phase_bar,) = (line.get_xydata() for line in phase.lines)
    assert crossover == pytest.approx(np.array([[2.0, 0.0]]), abs=0.01)
    assert gain_bar == pytest.approx(np.array([[2.5 * np.pi, 20.0 * np.log10(0.8 / np.pi)], [2.5 * np.pi, 0.0]]), abs=0.02)
    assert phase_bar == pytest.approx(np.array([[2.0, -90.0 - np.degrees(0.4)], [2.0, -180.0]]), abs=0.05)
    labels = [label for axes in (gain, phase) for label in axes.get_legend_handles_labels()[1]]
    assert labels == ["surge, 11.9 dB at 7.9 rad/s", "surge, 67 deg at 2.0 rad/s"]
    mark(gain, phase, ideal(1e-3, 0.01), "pitch", "red")
    assert gain.lines[-1].get_label() == "pitch, no margins" and len(phase.lines) == 1
    pyplot.close(figure)


def test_every_sine_is_one_of_its_own() -> None:
    chosen = lines()
    assert chosen.shape == (len(AXES), LINES)
    assert len(set(chosen.ravel().tolist())) == chosen.size


def test_corners_are_all_eight() -> None:
    assert len(set(corners(0.15))) == 8
    assert Scale(0.85, 1.15, 0.85) in corners(0.15)


def swing(gain: float) -> float:
    """Growth of the surge force over ten seconds after a push, with `gain` times the loop's gain."""
    loop, given = Loop(1, Parameters()), np.zeros(6)
    swings = []
    for tick in range(3600):
        shake = np.zeros(6)
        shake[SURGE] = (gain - 1.0) * given[SURGE] + (0.5 if 2000 <= tick < 2010 else 0.0)
        given = loop.step(shake)
        swings.append(abs(float(given[SURGE])))
    return max(swings[3200:]) / max(swings[2200:2600])


@pytest.mark.slow
def test_loop_that_one_decibel_more_makes_swing_shows_less_than_that_and_one_that_swings_shows_none() -> None:
    """The first loop crosses -180 degrees above the highest measured frequency."""
    hard = Parameters().replace("control.position_bandwidth", 8.0).replace("control.position_damping", 3.5)
    assert margins(measure(1, hard)[SURGE]).gain_db < 1.0
    swinging = [margins(response) for response in measure(1, hard, Scale(0.85, 0.85, 1.15))]
    assert swinging[SURGE][:2] == (0.0, 0.0)


@pytest.mark.slow
def test_vehicle_that_never_finds_its_pose_has_no_margins() -> None:
    with pytest.raises(DescriptionError, match="girona500: its loops are open"):
        measure(1, Parameters(), vehicle="girona500")


@pytest.mark.slow
def test_loop_swings_up_just_beyond_its_measured_gain_margin_and_dies_out_just_below() -> None:
    gain = 10.0 ** (margins(measure(1, Parameters())[SURGE]).gain_db / 20.0)
    assert swing(0.93 * gain) < 0.7
    assert swing(1.07 * gain) > 1.3
