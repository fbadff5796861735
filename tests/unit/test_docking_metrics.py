"""Metrics of docks: wishes obeyed one after the other, with the faces that they name, and joins declared falsely."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from firmware_py.description.signals import Columns
from hil.docking_metrics import DECLARED, FAILED, _docked_rmse_m, _false_declarations, _join_jump_n, docking_metrics, is_as_asked, is_obeyed
from hil.metrics import OUTCOMES
from hil.scenario import Scenario, load_scenario
from hil.signals import SIGNAL_LOG
from hil.task import Step
from hil.truth_log import TRUTH_LOG

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
TICKS = np.arange(1, 101)
APART, PAIR = ((0,), (1,), (2,)), ((0, 1), (2,))


@pytest.mark.parametrize(
    ("wishes", "runs", "obeyed"),
    [
        ([True], "apart joined", True),
        ([True], "apart", False),
        ([True], "apart joined apart", False),
        ([True, False, True], "apart joined apart joined", True),
        ([True, False, True], "apart joined", False),
        ([True, False], "apart joined apart joined", False),
        ([False], "joined apart", True),
        ([False], "joined", False),
        ([True], "apart joined apart joined", True),
    ],
)
def test_wishes_are_obeyed_one_after_the_other(wishes: list[bool], runs: str, obeyed: bool) -> None:
    together = np.repeat([run == "joined" for run in runs.split()], 50)
    assert is_obeyed(wishes, together) == obeyed


def truth_of(bodies: list[tuple[tuple[int, ...], ...]], places: list[list[float]]) -> dict[str, Columns]:
    """Logs of three level modules; each entry of `bodies` says how they are joined during an equal share of the run."""
    share = len(TICKS) // len(bodies)
    truths: dict[str, Columns] = {"/plant/docks": {"tick": TICKS}}
    for m, place in enumerate(places):
        truths[f"/plant/module{m}"] = {"tick": TICKS, "p_wm": np.tile(place, (100, 1)), "q_wm": np.tile(LEVEL, (100, 1))}
    for leader in range(3):
        rows = [(tick, members) for k, groups in enumerate(bodies) for members in groups if members[0] == leader
                for tick in TICKS[k * share : (k + 1) * share]]  # fmt: skip
        member = np.array([[float(m in members) for m in range(3)] for _, members in rows]).reshape(-1, 3)
        p_wb = np.array([np.mean([places[m] for m in members], axis=0) for _, members in rows]).reshape(-1, 3)
        truths[f"/plant/body{leader}"] = {"tick": np.array([tick for tick, _ in rows], np.int64), "member": member, "p_wb": p_wb}
    return truths


def asked(*steps: Step) -> Scenario:
    """A scenario of three modules with these steps; its modules are numbered from 1."""
    third = load_scenario("dock-third")
    return dataclasses.replace(third, step=steps)


PLACES = [[0.0, 0.0, 0.4], [0.21, 0.0, 0.4], [0.5, 0.0, 0.4]]
DOCK = Step(do="dock", module=2, face="-x", target_module=1, target_face="+x")


@pytest.mark.slow
def test_dock_counts_with_the_faces_that_were_named() -> None:
    joined = truth_of([APART, PAIR], PLACES)
    assert is_as_asked(asked(DOCK), joined)
    assert not is_as_asked(asked(dataclasses.replace(DOCK, face="+x")), joined)
    assert not is_as_asked(asked(dataclasses.replace(DOCK, target_face="+y")), joined)
    assert not is_as_asked(asked(DOCK), truth_of([APART, APART], PLACES))
    assert not is_as_asked(asked(DOCK, Step(do="undock", module=2, target_module=1)), joined)


@pytest.mark.slow
@pytest.mark.parametrize("turns", range(4))
def test_dock_counts_with_the_quarter_turns_that_were_asked_for(turns: int) -> None:
    joined = truth_of([APART, PAIR], PLACES)
    angle = 0.5 * np.pi * turns + 0.02  # about the target face's normal, +x
    joined["/plant/module1"]["q_wm"][:] = np.cos(0.5 * angle), np.sin(0.5 * angle), 0.0, 0.0
    counts = [is_as_asked(asked(dataclasses.replace(DOCK, quarter_turns=wanted)), joined) for wanted in range(4)]
    assert counts == [wanted == turns for wanted in range(4)]


@pytest.mark.slow
def test_module_that_is_undocked_and_docked_to_another_of_the_same_body_is_as_asked() -> None:
    """The module moves from one end of a pair to the other."""
    moved = [((0, 1, 2),), PAIR, PAIR, ((0, 1, 2),)]
    places = [[0.0, 0.0, 0.4], [0.21, 0.0, 0.4], [-0.21, 0.0, 0.4]]
    undock, dock = Step(do="undock", module=3, target_module=2), Step(do="dock", module=3, face="+x", target_module=1, target_face="-x")
    assert is_as_asked(asked(undock, dock), truth_of(moved, places))
    assert not is_as_asked(asked(undock, dock), truth_of([((0, 1, 2),)], places))
    assert not is_as_asked(asked(undock), truth_of(moved, places))
    assert not is_as_asked(asked(dock, undock), truth_of(moved, places))
    others = asked(Step(do="undock", module=2, target_module=1), dock)
    assert not is_as_asked(others, truth_of([PAIR, APART, APART, ((0, 1, 2),)], places)), "module 2 came along unasked"


def test_faces_that_came_nearest_are_told_of_and_none_where_none_came_near(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truths = truth_of([APART], PLACES)
    for module in range(3):
        truths[f"/plant/module{module}"]["force_n"] = np.zeros((100, 8))
    events = {"text": np.zeros(0, str)}
    for gap_m, nearest_m in ((np.r_[np.full(60, np.nan), np.linspace(0.3, 0.02, 40)], 0.02), (np.full(100, np.nan), np.nan)):
        truths["/plant/docks"] |= {"gap_m": gap_m, "contacts": np.zeros(100), "jams": np.zeros(100)}
        logs = {TRUTH_LOG: truths, SIGNAL_LOG: {"/events": events}}
        monkeypatch.setattr("hil.docking_metrics.read_signals", lambda path, logs=logs: logs[path.name])
        assert docking_metrics(asked(Step(do="wait")), tmp_path)["gap_min_m"] == pytest.approx(nearest_m, nan_ok=True)


@pytest.mark.parametrize(("stage", "docked", "outcome"), [(DECLARED, 1.0, "as asked"), (FAILED, 0.0, "gave up")])
def test_dock_that_the_firmware_gave_up_is_none_though_hulls_joined_and_parted(
    stage: int, docked: float, outcome: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: magnets that held, and pushed off after a supposed jam, counted as a dock and an undock."""
    truths = truth_of([APART, PAIR, APART], PLACES)
    for module in range(3):
        truths[f"/plant/module{module}"]["force_n"] = np.zeros((100, 8))
    truths["/plant/docks"] |= {"gap_m": np.zeros(100), "contacts": np.ones(100), "jams": np.zeros(100)}
    docks = {"tick": TICKS[50:51], "module_a": np.array([0]), "module_b": np.array([1]), "stage": np.array([stage])}
    logs = {TRUTH_LOG: truths, SIGNAL_LOG: {"/events": {"text": np.zeros(0, str)}, "/firmware/docks": docks}}
    monkeypatch.setattr("hil.docking_metrics.read_signals", lambda path: logs[path.name])
    found = docking_metrics(asked(DOCK, Step(do="undock", module=2, target_module=1)), tmp_path)
    assert found["docked"] == docked and OUTCOMES[int(found["outcome"])] == outcome


def test_without_a_dock_nothing_may_join_or_part() -> None:
    wait = asked(Step(do="wait"))
    assert is_as_asked(wait, truth_of([APART], PLACES)) and is_as_asked(wait, truth_of([PAIR], PLACES))
    assert not is_as_asked(wait, truth_of([APART, PAIR], PLACES))


@pytest.mark.parametrize(("module_a", "module_b", "false"), [(0, 1, 0), (1, 2, 1)])
def test_join_of_others_than_those_that_hang_together_is_a_false_one(module_a: int, module_b: int, false: int) -> None:
    truths = truth_of([APART, PAIR], PLACES)
    docks = {"tick": np.array([59, 60]), "stage": np.array([4, DECLARED]),
             "module_a": np.array([module_a] * 2), "module_b": np.array([module_b] * 2)}  # fmt: skip
    signals = {"/firmware/docks": docks, "/firmware/body0": {"tick": TICKS}, "/firmware/body1": {"tick": TICKS},
               "/firmware/body2": {"tick": TICKS[:59]}}  # fmt: skip
    assert _false_declarations(truths, signals) == false


def test_join_that_no_dock_declared_is_found_by_the_number_of_bodies() -> None:
    signals = {"/firmware/body0": {"tick": TICKS}, "/firmware/body1": {"tick": TICKS[:30]}, "/firmware/body2": {"tick": TICKS}}
    assert _false_declarations(truth_of([APART], PLACES), signals) == 1
    assert _false_declarations(truth_of([APART, PAIR], PLACES), signals) == 1  # declared after thirty ticks, true after fifty


def test_step_of_the_thrusters_counts_in_every_join_of_modules_that_part_and_dock_again() -> None:
    """The step is 0.2 N in the first join and 0.7 N in the second, a tick after the faces have locked."""
    truths = truth_of([APART, PAIR, APART, PAIR], PLACES)
    for module, thrusters in enumerate((8, 8, 6)):  # the third is of another kind, and stays away
        truths[f"/plant/module{module}"]["force_n"] = np.zeros((100, thrusters))
    joined = ((TICKS > 26) & (TICKS <= 50)) | (TICKS > 76)
    force_n = np.where(np.arange(16) < 8, 1.0, 2.0) + np.select([(TICKS > 26) & (TICKS <= 50), TICKS > 76], [0.2, -0.7])[:, None]
    both = np.where(joined[:, None] | (np.arange(16) < 8), force_n, np.nan)
    docks = {"tick": np.array([26, 27, 77]), "stage": np.array([4, DECLARED, DECLARED]),
             "module_a": np.zeros(3, int), "module_b": np.ones(3, int)}  # fmt: skip
    signals = {"/firmware/body0": {"tick": TICKS, "commanded_n": both}, "/firmware/docks": docks,
               "/firmware/body1": {"tick": TICKS[~joined], "commanded_n": force_n[~joined, 8:]}}  # fmt: skip
    assert _join_jump_n(truths, signals) == pytest.approx(0.7)
    one = {name: column[:2] for name, column in docks.items()}
    assert _join_jump_n(truths, signals | {"/firmware/docks": one}) == pytest.approx(0.2)
    assert np.isnan(_join_jump_n(truths, {}))


def test_place_of_a_joined_body_counts_from_when_the_firmware_knows_it() -> None:
    """A pair docked from the start waits for its first tags with its set-point at the origin; those ticks do not count."""
    ready = TICKS > 30
    true = {"tick": TICKS, "member": np.ones((100, 2)), "p_wb": np.tile([0.3, 0.0, 0.4], (100, 1))}
    setpoint = np.where(ready[:, None], [0.3, 0.002, 0.4], 0.0)
    believed = {"tick": TICKS, "commanded_n": np.zeros((100, 16)), "setpoint_p_wb": setpoint, "ready": ready.astype(np.uint8)}
    truths = {"/plant/body0": true, **{f"/plant/module{m}": {"force_n": np.zeros((100, 8))} for m in range(2)}}
    assert _docked_rmse_m(truths, {"/firmware/body0": believed}) == pytest.approx(0.002)


def test_place_of_a_joined_body_counts_beside_a_robot_with_fewer_thrusters() -> None:
    truths = truth_of([((0,), (1, 2))], PLACES)
    for module, thrusters in enumerate((6, 8, 8)):
        truths[f"/plant/module{module}"]["force_n"] = np.zeros((100, thrusters))
    setpoint = truths["/plant/body1"]["p_wb"] + [0.0, 0.003, 0.0]
    believed = {"tick": TICKS, "commanded_n": np.zeros((100, 16)), "setpoint_p_wb": setpoint, "ready": np.ones(100, np.uint8)}
    assert _docked_rmse_m(truths, {"/firmware/body1": believed}) == pytest.approx(0.003)


def test_body_of_which_the_target_has_the_higher_number_is_judged_as_any_other() -> None:
    """The plant names the body by its lowest module, 0; the firmware by its first module, which is the target's, 1."""
    truths = truth_of([APART, PAIR, APART, PAIR], PLACES)
    for module in range(3):
        truths[f"/plant/module{module}"]["force_n"] = np.zeros((100, 8))
    joined = ((TICKS > 26) & (TICKS <= 50)) | (TICKS > 76)
    force_n = np.select([(TICKS > 26) & (TICKS <= 50), TICKS > 76], [0.2, -0.7])[:, None] + np.ones(16)
    both = np.where(joined[:, None] | (np.arange(16) < 8), force_n, np.nan)
    docks = {"tick": np.array([27, 77]), "stage": np.array([DECLARED] * 2), "module_a": np.ones(2, int), "module_b": np.zeros(2, int)}
    setpoint = np.mean(PLACES[:2], axis=0) + np.array([0.0, 0.004, 0.0])
    target = {"tick": TICKS, "commanded_n": both, "setpoint_p_wb": np.tile(setpoint, (100, 1)), "ready": np.ones(100, np.uint8)}
    active = {name: column[~joined] for name, column in target.items()} | {"commanded_n": force_n[~joined, 8:]}
    signals = {"/firmware/body1": target, "/firmware/docks": docks, "/firmware/body0": active}
    assert _join_jump_n(truths, signals) == pytest.approx(0.7)
    assert _docked_rmse_m(truths, signals) == pytest.approx(0.004)
