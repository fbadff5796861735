"""Complete docks, one seed of each scenario; hundreds of seeds belong to `make accept`."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import near_miss
import numpy as np
import pytest

from firmware_py.app.replay import replay
from firmware_py.core.rotations import difference
from firmware_py.core.transitions import State
from firmware_py.core.types import Mode
from firmware_py.description.parameters import PAPER, Parameters
from firmware_py.description.signals import read_signals
from firmware_py.description.vehicle import FACE_NAMES
from firmware_py.prepare.assembly import PITCH_M
from hil.checks import Result
from hil.flight import fly_and_judge
from hil.plant.fault_spec import Fault
from hil.scenario import load_scenario
from hil.task import Step
from tests.closed_loop.flights import Fly

LARGEST_JUMP_N = 1.0
"""Largest step of a thruster's command in the tick in which two bodies become one."""


class Flown(NamedTuple):
    """A flight that several tests look at: its result and the folder of its logs."""

    result: Result
    folder: Path


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Two modules dock, undock, and dock again."""
    folder = tmp_path_factory.mktemp("twice")
    return Flown(fly_and_judge(load_scenario("dock-undock-dock"), 1, Parameters(), folder, "virtual:twice"), folder)


def assert_docked_gently(result: Result) -> None:
    metrics = result.metrics
    assert metrics["docked"] == 1.0
    assert metrics["tries"] >= 1.0
    assert metrics["false_declarations"] == 0.0
    assert 0.0 < metrics["join_jump_n"] <= LARGEST_JUMP_N


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dock-third", "dock-vertical", "dock-moving"])
def test_modules_dock_and_no_command_jumps(fly: Fly, name: str) -> None:
    assert_docked_gently(fly(load_scenario(name), 3))


@pytest.mark.slow
def test_modules_dock_undock_and_dock_again_and_no_command_jumps(twice: Flown) -> None:
    assert_docked_gently(twice.result)
    assert twice.result.warnings == ()


@pytest.mark.slow
def test_dock_of_two_modules_is_replayed_to_the_byte(twice: Flown) -> None:
    outcome = replay(twice.folder)
    assert outcome.first is None
    assert outcome.ticks > 2000


@pytest.mark.slow
def test_both_pieces_know_where_they_are_from_the_first_pictures_after_an_undock(twice: Flown) -> None:
    """By then the magnets have pushed them apart for half a second, while the firmware still took them for one body."""
    believed = read_signals(twice.folder / "signals.mcap")
    truth = read_signals(twice.folder / "truth.mcap")
    times = believed["/firmware/body1"]["time_ns"]
    parted_ns = times[np.flatnonzero(np.diff(times) > 5e8)[0] + 1]
    for number in range(2):
        body, module = believed[f"/firmware/body{number}"], truth[f"/plant/module{number}"]
        _, i, j = np.intersect1d(body["time_ns"], module["time_ns"], return_indices=True)
        since_s = (body["time_ns"][i] - parted_ns) * 1e-9
        error_m = np.linalg.norm(body["p_wb"][i] - module["p_wm"][j], axis=1)
        assert 0.0005 < np.sqrt(np.mean(error_m[(since_s > 0.1) & (since_s < 1.5)] ** 2)) < 0.006
        refused = body["rejected"][i][(since_s >= 0.0) & (since_s < 1.5)]
        assert refused[-1] - refused[0] < 10


@pytest.mark.slow
def test_module_whose_thruster_is_stuck_is_undocked_without_a_tumble(fly: Fly, tmp_path: Path) -> None:
    """Regression: for a second after their joint had opened, the two were steered as one body. The healthy module held against the stuck
    thruster of the other one, which nothing held any more: they tumbled by 85 degrees and struck each other.
    """
    scenario = load_scenario("mobius-2")
    fault = Fault(kind="thruster_stuck", module=2, index=5, value=0.5, at_s=4.0)
    steps = Step(do="undock", module=2, face="-x", target_module=1, target_face="+x"), Step(do="wait", duration_s=2.0)
    task = dataclasses.replace(scenario.task, kind="dock", settle_s=6.0, duration_s=20.0)
    fly(dataclasses.replace(scenario, task=task, step=steps, fault=(fault,)), 0)
    truth = [read_signals(tmp_path / "run" / "truth.mcap")[f"/plant/module{m}"] for m in range(2)]
    places, attitudes = ([module[name] for module in truth] for name in ("p_wm", "q_wm"))
    assert np.linalg.norm(places[0][-1] - places[1][-1]) > PITCH_M + 0.1
    tilts = [2.0 * np.arcsin(np.hypot(*q_wm[:, 1:3].T)) for q_wm in attitudes]
    assert np.degrees(np.max(tilts)) < 35.0


@pytest.mark.slow
def test_pair_that_docked_twice_is_to_hold_the_attitude_of_before(twice: Flown) -> None:
    """Regression: each dock and undock kept the attitude of its moment. After six of them one module leant over by ten degrees."""
    believed = read_signals(twice.folder / "signals.mcap")
    target, other = believed["/firmware/body0"], believed["/firmware/body1"]
    docked_ns = other["time_ns"][np.flatnonzero(np.diff(other["time_ns"]) > 5e8)[0]]
    before = target["setpoint_q_wb"][np.searchsorted(target["time_ns"], docked_ns)]
    assert np.linalg.norm(difference(target["setpoint_q_wb"][-1].copy(), before.copy())) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("parameters", "both"), [(Parameters(), False), (Parameters(), True), (PAPER, False)])
def test_both_come_to_meet_each_other_where_that_is_asked_for(fly: Fly, tmp_path: Path, parameters: Parameters, both: bool) -> None:
    scenario = load_scenario("dock")
    step = tuple(dataclasses.replace(each, both_approach=both) for each in scenario.step)
    result = fly(dataclasses.replace(scenario, step=step), 1, parameters)
    assert result.metrics["docked"] == 1.0
    truth = read_signals(tmp_path / "run" / "truth.mcap")
    start, end = (truth["/plant/module0"]["p_wm"][k] for k in (990, -300))
    moved = float(np.linalg.norm(end - start))
    assert moved > 0.1 if both or parameters is PAPER else moved < 0.05


@pytest.mark.slow
def test_paper_s_dock_is_not_tried_again(fly: Fly) -> None:
    """Seed 0 jams in the paper's world."""
    scenario = load_scenario("dock")
    metrics = fly(scenario, 0, PAPER).metrics
    assert (metrics["docked"], metrics["tries"], metrics["jams"]) == (0.0, 1.0, 1.0)
    assert metrics["ticks"] < 0.5 * 100 * scenario.task.duration_s, "nobody waits for the end of the time when it was given up"


@pytest.mark.slow
def test_docked_pair_flies_the_moebius_strip_as_one_and_parts_again(fly: Fly, tmp_path: Path) -> None:
    result = fly(load_scenario("dock-mobius"), 0)
    assert result.passed
    assert 0.001 <= result.metrics["docked_rmse_m"] <= 0.007
    body = read_signals(tmp_path / "run" / "signals.mcap")["/firmware/body0"]
    docked = np.flatnonzero(body["time_ns"] > 25_000_000_000)[:-1000]
    turned = [np.linalg.norm(difference(*body["setpoint_q_wb"][k - 1 : k + 1].copy())) for k in docked]
    assert max(turned) < np.radians(0.5), "it turns to the start of the strip before it flies it"


@pytest.mark.slow
def test_lower_module_that_nobody_sees_is_refused_and_nothing_moves(fly: Fly) -> None:
    result = fly(load_scenario("dock-vertical-blind"), 0)
    assert result.passed
    assert result.metrics["docked"] == 0.0


@pytest.mark.slow
def test_module_that_passes_close_by_with_magnets_on_is_not_believed_docked(fly: Fly) -> None:
    metrics = fly(load_scenario("dock-near-miss"), 0).metrics
    assert metrics["false_declarations"] == 0.0
    assert metrics["docked"] == 1.0  # they have parted, as wanted


@pytest.mark.slow
def test_detector_needs_both_conditions() -> None:
    """Through real frames: each condition alone would have declared false docks; both together declare none."""
    found = near_miss.count(range(90))
    assert found["misses"] > 40
    assert found["current"] >= 3
    assert found["position"] >= 3
    assert found["declared"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("magnet", [0.0, -1.0])
def test_module_whose_magnet_fails_in_flight_is_missed(fly: Fly, tmp_path: Path, magnet: float) -> None:
    """One dead coil leaves half of the pull, which holds: the pair stops and stays one body. A repelling coil tears the joint open, and the
    two then fly separately.
    """
    scenario = load_scenario("mobius-2")
    fault = Fault(kind="magnet", module=2, index=FACE_NAMES.index("-x"), value=magnet, at_s=16.0)
    task = dataclasses.replace(scenario.task, duration_s=20.0, turns=0.6)
    fly(dataclasses.replace(scenario, task=task, fault=(fault,)), 1)
    signals, truth = read_signals(tmp_path / "run" / "signals.mcap"), read_signals(tmp_path / "run" / "truth.mcap")
    said = dict(zip(signals["/events"]["text"].tolist(), (signals["/events"]["log_time"] * 1e-9).tolist(), strict=True))
    assert 16.0 < said["fail-safe on: a docked partner is lost (modules 1 and 2 do not hold together)"] < (17.0 if magnet == 0.0 else 19.0)
    is_torn = magnet < 0.0
    assert ("module 2 is undocked from module 1" in said) == is_torn
    for m in (0, 1) if is_torn else (0,):
        body = signals[f"/firmware/body{m}"]
        assert (body["state"][-1], body["mode"][-1]) == (State.ARMED, Mode.POSHOLD)
        np.testing.assert_allclose(truth[f"/plant/body{m}"]["p_wb"][-1], body["p_wb"][-1], atol=0.02)
        np.testing.assert_allclose(body["p_wb"][-1], body["setpoint_p_wb"][-1], atol=0.03)
    apart = float(np.linalg.norm(truth["/plant/module0"]["p_wm"][-1] - truth["/plant/module1"]["p_wm"][-1]))
    assert (apart > PITCH_M + 0.005) == is_torn


@pytest.mark.slow
@pytest.mark.parametrize("action", [0, 2], ids=["without", "with"])
def test_body_whose_path_leads_through_another_stops_with_room_to_spare(fly: Fly, tmp_path: Path, action: int) -> None:
    """With late noisy tags, in a current. Without the fail-safe it pushes the other one aside."""
    scenario = load_scenario("dock")
    places = dict(zip((1, 2), ([-0.1, 0.0, 0.38], [0.5, 0.0, 0.38]), strict=True))
    modules = tuple(dataclasses.replace(each, position_m=np.array(places[each.number])) for each in scenario.module)
    through = Step(do="move", module=2, position_m=np.array([-0.5, 0.0, 0.38]), duration_s=6.0)
    start = dataclasses.replace(scenario.start, position_m=np.array([0.0, 0.02, 0.0]))
    scenario = dataclasses.replace(scenario, module=modules, step=(through,), start=start)
    fly(scenario, 4, Parameters().replace("failsafes.collision_action", action))
    truth = read_signals(tmp_path / "run" / "truth.mcap")
    (first, second), at = (truth[f"/plant/module{n}"]["p_wm"] for n in range(2)), 10 * 100
    edge_m = PITCH_M - 0.02
    nearest_m = np.linalg.norm(second[at:] - first[at:], axis=1).min()
    moved_m = np.linalg.norm(first[at:] - first[at], axis=1).max()
    if action:
        assert edge_m + 0.05 < nearest_m < 0.45 and moved_m < 0.02
    else:
        assert nearest_m < edge_m + 0.03 and moved_m > 0.05
    records = read_signals(tmp_path / "run" / "signals.mcap")["/firmware/body1"]
    assert (records["mode"][-1] == Mode.POSHOLD) == bool(action)
