"""Runs slow work beside the loop; a result returns as an input of a later tick. In lockstep the work runs inline.

Jobs run one at a time and start only inside `submit` or `results`. The results that the ticks took therefore determine which jobs ran,
and a replay runs the same ones. At most one job per key waits.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from queue import Empty, SimpleQueue
from typing import Any

Job = Callable[[], Any]


class Worker(ABC):
    """Takes jobs and returns their results in the order in which the jobs were started."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, Job] = {}
        self._is_busy = False

    def submit(self, job: Job, key: Hashable, first: bool = False) -> None:
        """Starts `job` now or later; never blocks for long in a real-time worker. A job must not raise.

        Args:
            key: what the job is for. A waiting job with the same key is replaced; a job that has started is finished.
            first: the job goes before all waiting ones.
        """
        self._waiting = {key: job, **self._waiting} if first else self._waiting
        self._waiting[key] = job
        self._begin_next()

    def results(self) -> list[Any]:
        """Results finished since the last call."""
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
        """Runs the job, now or later."""

    @abstractmethod
    def _finished(self) -> list[Any]:
        """The result of the started job, as a list; empty while there is none."""


class InlineWorker(Worker):
    """Runs each job inline: the same results in the same tick, every time."""

    def __init__(self) -> None:
        super().__init__()
        self._done: list[Any] = []

    def _begin(self, job: Job) -> None:
        self._done.append(job())

    def _finished(self) -> list[Any]:
        done, self._done = self._done, []
        return done


class ThreadWorker(Worker):
    """Runs jobs in one thread beside the loop. The jobs are numpy and compiled code, which let the loop run meanwhile."""

    def __init__(self) -> None:
        super().__init__()
        self._jobs: SimpleQueue[Job | None] = SimpleQueue()
        self._done: SimpleQueue[Any] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Waits for the started job to finish, and ends the thread."""
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
