"""Planning beside the ground side: in a process that may die, and only plans that are still awaited."""

import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from queue import Queue

import numpy as np
import pytest

from firmware_py.app.ground_station import _WARM_UP_JOB, GroundSide
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.mission_legs import Leg
from firmware_py.ground.plan_jobs import Plan, PlanJob
from tests.unit.ground_sides import PATIENCE_S, firmware_of, free_port, side_on


def test_planning_process_that_was_killed_is_replaced_and_no_station_is_lost_by_it(monkeypatch: pytest.MonkeyPatch) -> None:
    killed = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
    assert isinstance(killed.submit(os._exit, 9).exception(), BrokenProcessPool)
    monkeypatch.setattr("firmware_py.app.ground_station._planner", lambda awaited: ThreadPoolExecutor(1))
    monkeypatch.setattr("firmware_py.app.ground_station._plan_mission", lambda job, body: Plan(job.serial, None, ()))
    plans: Queue[Plan] = Queue()
    with closing(side_on(f"udpin:127.0.0.1:{free_port()}")) as side:
        monkeypatch.setattr(side.station, "planned", lambda body, plan: plans.put(plan))
        side._executor = killed
        for _ in range(2):  # the second job meets the new executor
            side.station.services[1].flight.jobs.waiting.append(_WARM_UP_JOB)
            side.pump()
        wait([future for _, future in side._plans], PATIENCE_S)
        side.pump()
    assert plans.qsize() == 2


def test_plans_that_nobody_waits_for_any_more_are_not_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a client that moved the robot's goal five times a second waited minutes for the last plan."""
    may_end, planned = threading.Event(), list[tuple[int, int]]()

    def plan(job: PlanJob, body: object) -> Plan:
        may_end.wait(PATIENCE_S)
        planned.append((job.body, job.serial))
        return Plan(job.serial, None, ())

    monkeypatch.setattr("firmware_py.app.ground_station._plan_mission", plan)
    firmware = firmware_of(2)
    config = GroundConfig(links=(f"udpin:127.0.0.1:{free_port()}",))
    with ThreadPoolExecutor(1) as executor, closing(GroundSide(config, firmware, executor)) as side:
        side.station.services[2].flight.jobs.waiting.append(_WARM_UP_JOB._replace(body=1))
        side.pump()
        for serial in range(100):
            side.station.services[1].flight.jobs.waiting.append(_WARM_UP_JOB._replace(serial=serial))
            side.pump()
        may_end.set()
        wait([future for _, future in side._plans], PATIENCE_S)
        side.pump()
        assert side._plans == [] and planned == [(1, 0), (0, 99)]


@pytest.mark.slow
def test_planning_process_ends_a_plan_that_its_body_does_not_wait_for_any_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process then makes the next plan. Regression: that plan waited until the abandoned one was complete."""
    leg = Leg(0, np.ones(3), None, 0.0, 0.3)
    with closing(GroundSide(GroundConfig(links=(f"udpin:127.0.0.1:{free_port()}",)), firmware_of())) as side:
        plans: list[Plan] = []
        monkeypatch.setattr(side.station, "planned", lambda body, plan: plans.append(plan))
        for serial in (1, 2):
            monkeypatch.setattr(side.station, "awaited", lambda serial=serial: [serial])
            side.station.services[1].flight.jobs.waiting.append(_WARM_UP_JOB._replace(serial=serial, legs=(leg,)))
            side.pump()
        wait([future for _, future in side._plans])
        side.pump()
    assert [(plan.serial, plan.reason) for plan in plans] == [(1, "nobody waits for it any more"), (2, "")]


def blocked_here(job: PlanJob, body: object) -> set[signal.Signals]:
    """Stands in for the planning of a mission: the signals that its process does not receive."""
    return {signal.Signals(number) for number in signal.pthread_sigmask(signal.SIG_BLOCK, [])}


@pytest.mark.slow
@pytest.mark.parametrize("at_the_start", [True, False])
def test_planning_process_that_is_still_importing_hears_no_press_of_ctrl_c(at_the_start: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: Ctrl-C in the first seconds of a run printed the traceback of that process."""
    monkeypatch.setattr("firmware_py.app.ground_station._plan_mission", blocked_here)
    with closing(side_on(f"udpin:127.0.0.1:{free_port()}")) as side:
        side._executor = None
        if at_the_start:
            side._start_planner()
        blocked = side._begin(_WARM_UP_JOB, None).result()
    assert blocked == {signal.SIGINT} and signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


@pytest.mark.slow
def test_robot_that_is_stopped_waits_for_no_plan_that_is_being_made() -> None:
    """The service manager allows the robot five seconds, then kills the process, which tears its log."""
    firmware = firmware_of()
    with GroundSide(GroundConfig(links=(f"udpin:127.0.0.1:{free_port()}",)), firmware) as side:
        while not isinstance(side._executor, ProcessPoolExecutor):
            time.sleep(0.01)
        side._executor.submit(os.getpid).result()  # the planning process is up
        side._executor.submit(time.sleep, 60.0)
        start = time.monotonic()
    assert time.monotonic() - start < PATIENCE_S
