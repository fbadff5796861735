"""Runs slow work beside the loop; what it gives comes back as an input of a later tick. In lockstep it runs at once,
on the spot.

Jobs are done one by one, and one begins within `submit` or `results` alone: so what the ticks took says which jobs they
were, and a replay does the same ones. Of those that wait there is one for each wish at the most.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from queue import Empty, SimpleQueue
from typing import Any

Job = Callable[[], Any]


class Worker(ABC):
    """Takes jobs, gives results in the order in which they were begun."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, Job] = {}
        self._is_busy = False

    def submit(self, job: Job, wish: Hashable, first: bool = False) -> None:
        """Starts `job` now or later; never blocks for long in a real-time worker. A job must not raise.

        Args:
            wish: what it is for. Another job for the same that waits is no longer wanted; one that was begun is finished.
            first: it goes before all that wait.
        """
        self._waiting = {wish: job, **self._waiting} if first else self._waiting
        self._waiting[wish] = job
        self._begin_next()

    def results(self) -> list[Any]:
        """What has been finished since the last call."""
        results = []
        while self._is_busy and (finished := self._finished()):
            results += finished
            self._is_busy = False
            self._begin_next()
        return results

    def _begin_next(self) -> None:
        if self._waiting and not self._is_busy:
            self._is_busy = True
            self._begin(self._waiting.pop(next(iter(self._waiting))))

    @abstractmethod
    def _begin(self, job: Job) -> None:
        """Does the job, now or later."""

    @abstractmethod
    def _finished(self) -> list[Any]:
        """The result of the job that was begun; nothing while there is none."""


class InlineWorker(Worker):
    """Does the job on the spot: the same results in the same tick, every time."""

    def __init__(self) -> None:
        super().__init__()
        self._done: list[Any] = []

    def _begin(self, job: Job) -> None:
        self._done.append(job())

    def _finished(self) -> list[Any]:
        done, self._done = self._done, []
        return done


class ThreadWorker(Worker):
    """One thread beside the loop. The jobs are numpy and compiled code, which let the loop run meanwhile."""

    def __init__(self) -> None:
        super().__init__()
        self._jobs: SimpleQueue[Job | None] = SimpleQueue()
        self._done: SimpleQueue[Any] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Lets the running job end, and the thread with it."""
        self._jobs.put(None)
        self._thread.join()

    def _begin(self, job: Job) -> None:
        self._jobs.put(job)

    def _finished(self) -> list[Any]:
        try:
            return [self._done.get_nowait()]
        except Empty:
            return []

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._done.put(job())
