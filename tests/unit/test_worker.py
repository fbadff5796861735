"""Jobs that wait beside the loop: at most one per key, urgent ones first, and the same ones in a replay."""

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from firmware_py.app.firmware import Firmware, compose
from firmware_py.app.preparation import prepare
from firmware_py.app.replay import DueWorker
from firmware_py.core.body import Body
from firmware_py.core.docking_decisions import Prepared
from firmware_py.core.docking_plan import UndockPlan
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.types import DockRequest, Inputs, ModuleInputs, Outputs, PartRequest
from firmware_py.description.fleet import Fleet, Module
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import PITCH_M
from firmware_py.runtime.worker import InlineWorker, Job, ThreadWorker, Worker


class Slow(Worker):
    """A worker whose job is done when the test says so."""

    def __init__(self) -> None:
        super().__init__()
        self.begun: list[Job] = []
        self.is_done = False

    def _begin(self, job: Job) -> None:
        self.begun.append(job)

    def _finished(self) -> list[Any]:
        done, self.is_done = self.is_done, False
        return [self.begun[-1]()] if done else []

    def finish(self) -> list[Any]:
        """Finishes the job that was begun; returns its results."""
        self.is_done = True
        return self.results()


def submit(worker: Worker, *names: str) -> None:
    """Submits jobs whose results are their names. The letters of a name are the key; a final `!` makes the job go first."""
    for name in names:
        worker.submit(lambda name=name: name, name.rstrip("!0123456789"), first=name.endswith("!"))  # type: ignore[misc]


def test_newer_job_for_the_same_wish_takes_the_place_of_one_that_waits_and_none_of_one_that_was_begun() -> None:
    worker = Slow()
    submit(worker, "dock1", "dock2", "other1", "dock3")
    assert [worker.finish() for _ in range(4)] == [["dock1"], ["dock3"], ["other1"], []]


def test_body_that_came_apart_goes_before_docks_that_wait() -> None:
    worker = Slow()
    submit(worker, "dock1", "other1", "part1!", "third1", "part2!")
    assert [worker.finish() for _ in range(5)] == [["dock1"], ["part2!"], ["other1"], ["third1"], []]


def test_jobs_of_one_tick_are_all_done_by_the_next_on_the_bench() -> None:
    worker = InlineWorker()
    submit(worker, "dock1", "other1", "third1")
    assert worker.results() == ["dock1", "other1", "third1"]
    assert worker.results() == []


@pytest.fixture
def thread() -> Iterator[ThreadWorker]:
    worker = ThreadWorker()
    yield worker
    worker.close()


def test_jobs_beside_the_loop_that_pile_up_are_dropped_but_for_the_newest(thread: ThreadWorker) -> None:
    let, results = threading.Event(), list[Any]()
    thread.submit(lambda: let.wait(10), "dock")
    submit(thread, *(f"dock{n}" for n in range(256)))
    assert thread.results() == []
    let.set()
    while len(results) < 2:
        results += thread.results()
    assert results == [True, "dock255"]


def test_replay_does_the_jobs_that_were_done_in_flight() -> None:
    """The log holds the number of results that each tick took, but not which jobs they came from."""
    asked = [["dock1", "dock2"], ["dock3", "other1"], ["other2"], ["part1!", "dock4"], [], [], [], []]
    finished = [False, False, True, False, True, True, True, True]
    flown, again = Slow(), DueWorker()
    for names, flown.is_done in zip(asked, finished, strict=True):
        results = flown.results()
        again.due = len(results)
        assert again.results() == results
        submit(flown, *names)
        submit(again, *names)
    assert [job() for job in flown.begun] == ["dock1", "dock3", "part1!", "other2", "dock4"]


# ------------------------------------------------------------------ the firmware's


@pytest.fixture(scope="module")
def trio() -> Firmware:
    """Three modules, each a body of its own."""
    return compose(Fleet(module=tuple(Module(number=n) for n in (1, 2, 3))), Parameters(), worker=Slow())


def step(firmware: Firmware, *requests: DockRequest | PartRequest) -> None:
    """Runs a tick in which the pipeline asks for these preparations."""
    outputs = Outputs(1, 0, [], False, [], [], preparations=list(requests))
    firmware.pipeline.step = lambda inputs: outputs  # type: ignore[method-assign]
    firmware.tick(Inputs(1, 0, [ModuleInputs()] * 3))


@pytest.mark.slow
def test_docks_asked_for_in_every_tick_hold_up_no_body_that_came_apart(trio: Firmware) -> None:
    worker = trio.worker
    assert isinstance(worker, Slow)
    docks = [DockRequest(1, 3, 0, 2, turns) for turns in range(4)]
    for _ in range(10):
        step(trio, *docks * 64)
    step(trio, DockRequest(2, 3, 0, 2))
    step(trio, PartRequest((docks[0],)))
    done: list[Prepared] = [prepared for _ in range(5) for prepared in worker.finish()]
    assert [prepared.request for prepared in done] == [docks[0], docks[0], docks[3], DockRequest(2, 3, 0, 2)], "the second is of the part"
    assert done[1].refusal == "they are apart already"


def three(pair: int) -> Fleet:
    """Three modules, the first two in one body if `pair` is 0, else (-1) each a body of its own."""
    cells = ([0, 0, 0], [0, 1, 0], [0, 0, 0])
    return Fleet(module=tuple(Module(number=n, body=pair if n < 3 else -1, cell=np.array(cell)) for n, cell in enumerate(cells, 1)))


@pytest.mark.parametrize(("before", "after", "asked"), [(-1, 0, "a dock"), (0, -1, "an undock")])
def test_dock_that_was_asked_for_twice_is_not_planned_as_the_undock_of_what_has_docked_meanwhile(
    before: int, after: int, asked: str
) -> None:
    """Regression: the repetition waited for the worker until the modules had docked, and then parted them. The same for an undock."""
    worker = Slow()
    firmware = compose(three(before), Parameters(), worker=worker)
    step(firmware, DockRequest(2, 3, 0, 3))
    step(firmware, DockRequest(1, 3, 0, 2))
    firmware.pipeline.formation = compose(three(after), Parameters()).pipeline.formation
    _, (repeated,) = worker.finish(), worker.finish()
    assert repeated.plan is None and repeated.refusal.startswith(f"{asked} was asked for, and they have ")


def test_dock_whose_modules_dock_while_its_planning_begins_is_not_planned_as_their_undock() -> None:
    """The worker reads the bodies while the loop runs on, which may join them between two reads."""
    apart, docked = (compose(three(pair), Parameters()).pipeline for pair in (-1, 0))

    class Joining(Pipeline):
        @property
        def bodies(self) -> list[Body]:
            bodies = self.formation.bodies
            self.formation = docked.formation
            return bodies

    apart.__class__ = Joining
    prepared = prepare(DockRequest(1, 3, 0, 2), "dock", apart, [load_vehicle("modcube")] * 3, PITCH_M)
    assert not isinstance(prepared.plan, UndockPlan), prepared
