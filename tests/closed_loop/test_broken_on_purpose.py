"""Deliberate faults must fail a check; otherwise the checks would prove nothing."""

import dataclasses
import fcntl
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.app.firmware import Firmware
from firmware_py.bus.codec import Frame
from firmware_py.core.types import Action, Request
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from hil.console import print_result
from hil.flight import judge_logs
from hil.plant.fault_spec import Fault
from hil.plant.spec import CameraPose
from hil.scenario import load_scenario
from hil.task import Step
from tests.closed_loop.broken_vehicles import failed, reversed_thruster, turned_tags
from tests.closed_loop.flights import Corrupt, Fly, Rebuild, shortened

HOVER_S, SETTLE_S = 20.0, 5.0
PROTECTED_FROM = 0x040
"""Lower ids carry no CRC (ESTOP, SYNC); HEARTBEAT is not sent here."""


def crc_off_by_one_bit(frame: Frame) -> Frame:
    if frame.id < PROTECTED_FROM:
        return frame
    return Frame(frame.id, frame.data[:-1] + bytes((frame.data[-1] ^ 0x01,)))


@pytest.mark.slow
@pytest.mark.parametrize("thruster", [0, 4])
def test_one_reversed_thruster_fails_the_flight(fly: Fly, rebuild: Rebuild, thruster: int) -> None:
    rebuild(lambda vehicle: reversed_thruster(vehicle, thruster))
    # the firmware detects the thruster and flies on without it, so only the check on warnings fails
    assert "warnings" in failed(fly(shortened("hover", HOVER_S, SETTLE_S)))


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_tag_glued_on_ten_degrees_askew_fails_the_flight(fly: Fly, rebuild: Rebuild, axis: int) -> None:
    rebuild(lambda vehicle: turned_tags(vehicle, axis))
    assert not fly(shortened("spiral", HOVER_S, SETTLE_S)).passed


@pytest.mark.slow
def test_force_test_of_bodies_without_thrust_fails_though_they_do_not_differ(fly: Fly) -> None:
    lame = dataclasses.replace(shortened("force-tracking", 10.0, settle_s=5.0), fault=(Fault(kind="thruster_fake_rpm"), Fault(kind="jets")))
    assert failed(fly(lame)) == {"force_fit1_one_off"}


@pytest.mark.slow
def test_drag_feed_forward_of_the_wrong_sign_fails_the_flight(fly: Fly) -> None:
    """The spiral's drag is a quarter of a newton; the disturbance estimate compensates it well enough to pass, but the error doubles."""
    wrong = Parameters().replace("control.drag_feedforward", -1.0)
    assert failed(fly(load_scenario("mobius-1"), 0, wrong)) == {"position_rmse_m"}
    spiral = load_scenario("spiral")
    right_m, wrong_m = (fly(spiral, 0, each).metrics["position_rmse_m"] for each in (Parameters(), wrong))
    assert wrong_m > 2.0 * right_m


@pytest.mark.slow
@pytest.mark.parametrize("to_plant", [True, False], ids=["commands", "answers"])
def test_crc_off_by_one_bit_on_one_side_fails_the_flight(
    fly: Fly, corrupt: Corrupt, to_plant: bool
) -> None:
    corrupt(crc_off_by_one_bit, to_plant)
    assert not fly(shortened("hover", HOVER_S, SETTLE_S)).passed


@pytest.fixture
def deaf(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """deaf(action, ...): the firmware does not receive these requests."""
    step = Firmware.step

    def deafen(*actions: Action) -> None:
        def step_of_the_deaf(self: Firmware, tick: int, time_ns: int, received: Any, requests: Sequence[Request]) -> Any:
            return step(self, tick, time_ns, received, [request for request in requests if request.action not in actions])

        monkeypatch.setattr(Firmware, "step", step_of_the_deaf)

    return deafen


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "duration_s", "action"), [("hover", 10.0, Action.ARM), ("spiral", 10.0, Action.TRACK), ("waypoints", 45.0, Action.TRACK)]
)
def test_robot_that_does_as_it_likes_fails_the_flight_however_well_it_does_it(
    fly: Fly, deaf: Callable[..., None], name: str, duration_s: float, action: Action
) -> None:
    deaf(action)
    assert "position_rmse_m" in failed(fly(shortened(name, duration_s, 3.0)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hover", "dock"])
def test_robot_that_never_armed_fails_where_nothing_else_is_checked(fly: Fly, deaf: Callable[..., None], name: str) -> None:
    deaf(Action.ARM)
    assert failed(fly(dataclasses.replace(shortened(name, 4.0, settle_s=2.0), check=()))) == {"armed_share"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "vehicle", "why"),
    [
        ({"camera": ()}, "modcube", "the scenario has no [[camera]]"),
        ({"camera": (CameraPose(axis=np.array([0.0, 0.0, -1.0])),)}, "modcube", "no [[camera]] read a tag of tags = [0, 1, 2, 3, 4, 5]; p"),
        ({}, "girona500", "the vehicle girona500 carries none"),
        ({"fault": (Fault(kind="frame_loss", value=1.0),)}, "modcube", "; or a [[fault]] kept it away: frame_loss"),
    ],
)
def test_robot_that_no_camera_saw_is_said_to_lack_a_tag(
    fly: Fly, changes: dict[str, Any], vehicle: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    result = fly(dataclasses.replace(shortened("mobius-1", 1.0, settle_s=2.0), **changes).with_vehicle(vehicle))
    print_result(result)
    said = capsys.readouterr().out
    assert "no tag was ever seen, and without a pose the robot is not armed: " in said and why in said


@pytest.mark.slow
def test_flight_without_any_firmware_is_refused_in_one_line(fly: Fly) -> None:
    killed = dataclasses.replace(shortened("hover", 0.5, settle_s=1.1), fault=(Fault(kind="process_killed"),))
    with pytest.raises(DescriptionError, match="no signals or no truth of the first body in the logs; was the"):
        fly(killed)


@pytest.mark.slow
def test_robot_that_is_seen_and_never_armed_lacks_no_tag(fly: Fly, deaf: Callable[..., None]) -> None:
    deaf(Action.ARM)
    assert fly(shortened("hover", 1.0, settle_s=2.0)).no_tag_reason == ""


@pytest.mark.slow
def test_dock_of_which_one_body_is_armed_is_judged_by_its_own_checks(fly: Fly) -> None:
    result = fly(shortened("dock-vertical-blind", 4.0))
    assert result.passed and result.metrics["armed_share"] < 0.1
    assert "armed_share" not in {check.name for check in result.checks}


@pytest.mark.slow
def test_undock_that_is_not_heard_and_a_move_that_is_not_flown_are_no_success(fly: Fly, deaf: Callable[..., None]) -> None:
    deaf(Action.UNDOCK, Action.TRACK)
    assert "docked" in failed(fly(shortened("dock-undock-dock", 30.0), 3))
    assert "gap_min_m" in failed(fly(shortened("dock-near-miss", 10.0)))


@pytest.mark.slow
@pytest.mark.parametrize(("at_s", "until_s", "lost"), [(7.0, 1e6, 101), (0.0, 5.5, 150)])
def test_ticks_without_firmware_are_no_success(fly: Fly, at_s: float, until_s: float, lost: int) -> None:
    """Also if they are the first ticks of the run: the judged part begins when the task does."""
    hover = shortened("hover", 4.0, 4.0)
    gone = dataclasses.replace(hover, fault=(Fault(kind="process_killed", at_s=at_s, until_s=until_s),))
    result = fly(gone)
    assert result.metrics["unmatched_ticks"] == lost and "unmatched_ticks" in failed(result)


@pytest.mark.slow
def test_ticks_that_both_logs_lack_are_missed(fly: Fly, tmp_path: Path) -> None:
    """Like the ticks that a vehicle's process skips in real time."""
    hover = shortened("hover", 4.0, 4.0)
    assert fly(hover).passed
    longer = shortened("hover", 4.5, 4.0)
    assert judge_logs(longer, 0, tmp_path / "run").metrics["unmatched_ticks"] == 50


@pytest.mark.slow
def test_task_begins_in_the_first_tick_that_is_not_before_it(fly: Fly) -> None:
    """With 3.005 s in ticks of 10 ms the task begins 5 ms late, which does not count as an error of the flight."""
    late, early = (fly(shortened("spiral", 20.0, settle_s)).metrics["position_rmse_m"] for settle_s in (3.005, 3.01))
    assert abs(late - early) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("at_s", [0.015, 3.0])
def test_flight_whose_firmware_is_gone_before_the_task_begins_fails_and_ends_no_campaign(fly: Fly, at_s: float) -> None:
    gone = dataclasses.replace(shortened("hover", 2.0, 4.0), fault=(Fault(kind="process_killed", at_s=at_s),))
    assert {"position_rmse_m", "unmatched_ticks"} <= failed(fly(gone))


@pytest.mark.slow
def test_folder_holds_one_flight(fly: Fly, tmp_path: Path) -> None:
    """Nothing of an earlier flight remains, and two flights cannot write into it at once."""
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("report.html", "docking.png", "result.json", "notes.txt"):
        (folder / name).write_text('{"checks": "of an earlier flight"}')
    handle = os.open(folder, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    with pytest.raises(DescriptionError, match="is being written by another flight; wait for it or give another --out"):
        fly(shortened("hover", 1.0, 2.0))
    assert (folder / "report.html").exists()
    os.close(handle)
    fly(shortened("hover", 1.0, 2.0))
    assert {path.name for path in folder.iterdir()} == {"can.log", "notes.txt", "result.json", "signals.mcap", "truth.mcap"}


@pytest.mark.slow
def test_the_same_hover_unbroken_passes(fly: Fly) -> None:
    assert fly(shortened("hover", HOVER_S, SETTLE_S)).passed


@pytest.mark.slow
def test_fault_after_the_early_end_of_the_steps_is_told(fly: Fly, capsys: pytest.CaptureFixture[str]) -> None:
    plan = load_scenario("dock")
    faults = (Fault(kind="thruster_dead", at_s=0.5, module=1, index=0), Fault(kind="leak", at_s=100.0, module=2))
    task = dataclasses.replace(plan.task, settle_s=1.0)
    result = fly(dataclasses.replace(plan, step=(Step(do="wait", duration_s=0.5),), fault=faults, task=task))
    told = "fault leak of module 2 at 100 s never began: the steps were over at 4.5 s, and the flight with them"
    assert result.unmet_faults == (told,)
    print_result(result)
    assert f"{told}\n" in capsys.readouterr().out
