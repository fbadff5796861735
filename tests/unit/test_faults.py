"""Dead thrusters are detected in time from what their ESCs report, and never on a healthy robot."""

import numpy as np
import pytest

from firmware_py.core.esc_feedback import CLEAR
from firmware_py.core.faults import FaultDetector
from firmware_py.core.types import EscFeedback, Estimate, Measured, ModuleInputs
from firmware_py.description.failsafe_parameters import Faults
from tests.unit.robot_in_water import BODY, DT, PUSH, Water


@pytest.fixture
def water() -> Water:
    return Water()


@pytest.mark.parametrize("thruster", range(8))
def test_thruster_that_stands_still_is_found_within_half_a_second(water: Water, thruster: int) -> None:
    water.fly(1.0)
    water.gain[thruster] = water.speed_factor[thruster] = 0.0
    found = water.run(1.0)
    assert [words for _, words in found] == [f"thruster {thruster + 1} of module 1 stands still: left out"]
    assert found[0][0] <= 0.5
    assert water.detector.now.dead == (thruster,) and not water.detector.now.alive[thruster]
    assert water.detector.now.lost_axes == 0


@pytest.mark.parametrize("thruster", range(8))
def test_thruster_dead_from_the_start_is_found_within_half_a_second_of_the_first_command(thruster: int) -> None:
    water = Water(seed=thruster)
    water.gain[thruster] = water.speed_factor[thruster] = 0.0
    assert water.run(1.0, armed=False) == []
    pushing, found = 0.0, []
    while not found:
        found = water.run(DT)
        pushing += DT * (abs(water.believed.force_n[thruster]) > 0.3)
    assert [words for _, words in found] == [f"thruster {thruster + 1} of module 1 stands still: left out"]
    assert pushing <= 0.5, "the others steer it through zero at times"


@pytest.mark.parametrize("status", [1, 3])
def test_esc_that_reports_a_failure_is_believed(water: Water, status: int) -> None:
    water.fly(0.5)
    water.status[6] = status
    found = water.run(1.0)
    assert found[0][0] <= 0.41 and found[0][1] == "thruster 7 of module 1 has an ESC that failed: left out"


def test_three_reports_of_a_failed_esc_in_a_row_are_enough_and_two_are_not(water: Water) -> None:
    """Each ESC is heard ten times a second."""
    water.run(1.0)
    for status, seconds in ((1, 0.2), (0, 0.1), (1, 0.2), (0, 0.1)):
        water.status[6] = status
        assert water.run(seconds) == []
    water.status[6] = 1
    assert [words for _, words in water.run(0.3)] == ["thruster 7 of module 1 has an ESC that failed: left out"]


def test_thrusters_of_escs_that_a_sagging_supply_took_along_are_used_again_once_they_are_well(water: Water) -> None:
    """A module alone lost all its thrusters for good by half a second without power."""
    water.run(1.0)
    water.status[:], water.speed_factor[:] = 3, 0.0
    assert len(water.run(0.5)) == 8 and not water.detector.now.alive.any()
    water.status[:], water.speed_factor[:] = 0, 1.0
    assert water.run(0.85) == []
    assert {words for _, words in water.run(0.3)} == {f"thruster {n} of module 1 is used again: its ESC is well again" for n in range(1, 9)}
    assert water.detector.now.alive.all() and water.run(1.0) == []


def test_esc_that_fails_again_and_again_stays_left_out(water: Water) -> None:
    water.run(1.0)
    water.status[6] = 1
    assert len(water.run(0.5)) == 1
    for _ in range(5):
        for status, seconds in ((0, 0.8), (1, 0.2)):
            water.status[6] = status
            assert water.run(seconds) == []


def test_hot_esc_is_no_failure(water: Water) -> None:
    water.status[6] = 2
    water.fly(2.0)


@pytest.mark.parametrize("factor", [-1.0, 4.0])
def test_thruster_that_turns_the_wrong_way_or_races_is_found(water: Water, factor: float) -> None:
    water.fly(0.5)
    water.speed_factor[3] = factor
    found = water.run(1.0, 2.0 * PUSH)
    assert found[0][1] == "thruster 4 of module 1 does not obey: left out" and found[0][0] <= 0.6


@pytest.mark.parametrize("factor", [-1.0, 4.0])
def test_two_feedbacks_of_a_disobedient_thruster_are_enough_and_one_is_not(water: Water, factor: float) -> None:
    """Each ESC is heard ten times a second."""
    water.run(1.0, 2.0 * PUSH)
    water.speed_factor[3] = factor
    assert water.run(0.1, 2.0 * PUSH) == []
    water.speed_factor[3] = 1.0
    assert water.run(1.0, 2.0 * PUSH) == []
    water.speed_factor[3] = factor
    assert [words for _, words in water.run(0.2, 2.0 * PUSH)] == ["thruster 4 of module 1 does not obey: left out"]


def test_thruster_that_turns_faster_than_asked_but_does_not_race_is_found_within_half_a_second(water: Water) -> None:
    """Its speed is below twice the believed one plus a quarter of full speed, so that no single report tells of it."""
    water.fly(1.0)
    water.speed_factor[3] = 2.0
    found = water.run(1.0)
    assert [words for _, words in found] == ["thruster 4 of module 1 does not obey: left out"] and found[0][0] <= 0.5


def test_three_feedbacks_of_a_thruster_that_runs_on_are_borne(water: Water) -> None:
    """Of 2.9 times the believed force, as when frames were lost and a command came late: their running mean is below the limit."""
    water.fly(1.0)
    water.speed_factor[3] = 1.7
    assert water.run(0.3) == []
    water.speed_factor[3] = 1.0
    assert water.run(1.0) == []


def test_two_feedbacks_of_a_clear_standstill_are_enough_and_one_is_not(water: Water) -> None:
    water.run(1.0, 2.0 * PUSH)
    busy = int(np.argmax(np.abs(water.believed.force_n)))
    assert abs(water.believed.force_n[busy]) > CLEAR * Faults().force_n
    water.speed_factor[busy] = 0.0
    assert water.run(0.1, 2.0 * PUSH) == []
    water.speed_factor[busy] = 1.0
    assert water.run(1.0, 2.0 * PUSH) == []
    water.speed_factor[busy] = 0.0
    assert [words for _, words in water.run(0.2, 2.0 * PUSH)] == [f"thruster {busy + 1} of module 1 stands still: left out"]


@pytest.mark.parametrize("thruster", range(8))
def test_thruster_whose_esc_claims_twice_its_force_is_believed_to_push_as_it_was_told(water: Water, thruster: int) -> None:
    """Otherwise the motion would miss the force that the ESC only claimed, and the thruster would be blamed."""
    water.fly(1.0)
    water.speed_factor[thruster] = 1.4
    assert water.run(4.0, 2.0 * PUSH) == []


def test_slow_thruster_below_its_deadband_is_healthy(water: Water) -> None:
    """No propeller turns at 0.09 N."""
    assert water.run(2.0, 0.15 * PUSH) == []


def test_disarmed_robot_is_not_judged(water: Water) -> None:
    water.speed_factor[:], water.status[:] = 0.0, 1
    assert water.run(2.0, armed=False) == []


def test_propeller_that_turns_on_a_disarmed_robot_is_told_of_once_and_anew_when_it_does_so_again(water: Water) -> None:
    water.fly(1.0)
    assert water.run(1.0, armed=False) == [], "they only run down"
    water.stray_rpm[2] = -0.4 * BODY.thrusters.rpm_at_full[2]
    assert [words for _, words in water.run(1.0, armed=False)] == ["thruster 3 of module 1 turns though it was told to stand still"]
    assert water.detector.now.alive.all(), "it is trusted again when it is armed, and judged then"
    water.stray_rpm[2] = 0.0
    assert water.run(1.0, armed=False) == []
    water.stray_rpm[2] = 0.4 * BODY.thrusters.rpm_at_full[2]
    assert len(water.run(1.0, armed=False)) == 1


def test_dead_thruster_is_found_although_frames_are_lost(water: Water) -> None:
    water.heard = 0.7
    water.fly(2.0)
    water.gain[2] = water.speed_factor[2] = 0.0
    assert water.run(1.5)[0][1].startswith("thruster 3 of module 1 ")


def test_robot_that_is_armed_anew_trusts_its_thrusters_again(water: Water) -> None:
    water.speed_factor[1] = 0.0
    water.run(0.6)
    assert water.detector.now.dead == (1,)
    water.detector.reset()
    assert water.detector.now.dead == () and water.detector.changed and water.detector.now.alive.all()
    water.detector.reset()
    assert not water.detector.changed


def test_change_is_said_once(water: Water) -> None:
    water.speed_factor[1] = 0.0
    changes = []
    for _ in range(80):
        water.run(DT)
        changes.append(water.detector.changed)
    assert sum(changes) == 1


def _said_with_late_answers(late_ticks: int, told_ticks: int, standing: int = -1) -> list[str]:
    """Messages about a robot whose thrusters reverse all the time, and whose answers are `late_ticks` old but seem `told_ticks` old."""
    detector, n, zero = FaultDetector(BODY, Faults(), round(DT * 1e9)), BODY.thrusters.f_max.size, np.zeros(3)
    believed = [np.full(n, 2.0 * np.sin(9.0 * DT * tick)) for tick in range(300)]
    estimate, said = Estimate(zero, np.eye(1, 4)[0], np.zeros(6), zero, zero, zero, zero, 0, 1.0, 6, 0, True), []
    for tick, force_n in enumerate(believed):
        module = ModuleInputs(heard=True, mcu_state=2, late_ticks=told_ticks)
        if tick % 10 == 0:
            rpm = [detector.believed_rpm(i, believed[max(0, tick - late_ticks)][i]) * (i != standing) for i in range(n)]
            module.esc = [EscFeedback(i, (rpm[i], rpm[i + 1]), (0.0, 0.0), (0, 0)) for i in range(0, n, 2)]
        detector.step([module], Measured(None, None, None, []), estimate, force_n, force_n, True, True)
        said += detector.words
    return said


def test_feedback_that_comes_late_is_compared_with_the_forces_of_its_own_time() -> None:
    """With frames 30 ms late each way healthy thrusters seemed to disobey; without them the robot tumbled."""
    assert _said_with_late_answers(0, 0) == _said_with_late_answers(16, 16) == []
    assert "does not obey" in _said_with_late_answers(16, 0)[0], "it would matter"
    assert _said_with_late_answers(16, 16, standing=3) == ["thruster 4 of module 1 stands still: left out"]
    assert _said_with_late_answers(0, 60_000) == [], "as an answer of the future seems, after a restart"


@pytest.mark.parametrize(("rate_hz", "every_ticks"), [(100, 10), (100, 5), (100, 1), (400, 1)])
def test_escs_that_are_heard_more_often_are_judged_no_more_often(rate_hz: int, every_ticks: int) -> None:
    """Regression: of ESCs heard in every tick 30 ms of standstill were enough, and healthy thrusters that just started were left out."""
    detector, n, zero = FaultDetector(BODY, Faults(), 1_000_000_000 // rate_hz), BODY.thrusters.f_max.size, np.zeros(3)
    estimate, force_n = Estimate(zero, np.eye(1, 4)[0], np.zeros(6), zero, zero, zero, zero, 0, 1.0, 6, 0, True), np.full(n, 2.0)

    def hear(seconds: float, share: float) -> list[str]:
        said = []
        for tick in range(round(seconds * rate_hz)):
            module = ModuleInputs(heard=True, mcu_state=2)
            if tick % every_ticks == 0:
                rpm = [share * detector.believed_rpm(i, 2.0) for i in range(n)]
                module.esc = [EscFeedback(i, (rpm[i], rpm[i + 1]), (0.0, 0.0), (0, 0)) for i in range(0, n, 2)]
            detector.step([module], Measured(None, None, None, []), estimate, force_n, force_n, True, True)
            said += detector.words
        return said

    for _ in range(5):
        assert hear(0.07, share=0.0) == [] == hear(0.93, share=1.0)
    assert len(hear(0.4, share=0.0)) == n
