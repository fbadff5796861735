"""Runs slow work beside the loop; what it gives comes back as an input of a later tick. In lockstep it runs at once,
on the spot.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any, Protocol

Job = Callable[[], Any]


class Worker(Protocol):
    """Takes jobs, gives results in the order in which they were finished."""

    def submit(self, job: Job) -> None:
        """Starts `job` now or later; never blocks for long in a real-time worker. A job must not raise."""
        ...

    def results(self) -> list[Any]:
        """What has been finished since the last call."""
        ...


class InlineWorker:
    """Does the job within `submit`: the same results in the same tick, every time."""

    def __init__(self) -> None:
        self._results: list[Any] = []

    def submit(self, job: Job) -> None:
        """Runs the job."""
        self._results.append(job())

    def results(self) -> list[Any]:
        """What has been finished since the last call."""
        results, self._results = self._results, []
        return results


class ThreadWorker:
    """One thread beside the loop. The jobs are numpy and compiled code, which let the loop run meanwhile."""

    def __init__(self) -> None:
        self._jobs: SimpleQueue[Job | None] = SimpleQueue()
        self._results: SimpleQueue[Any] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    def submit(self, job: Job) -> None:
        """Queues the job."""
        self._jobs.put(job)

    def results(self) -> list[Any]:
        """What has been finished since the last call."""
        found = []
        while True:
            try:
                found.append(self._results.get_nowait())
            except Empty:
                return found

    def close(self) -> None:
        """Lets the running job end, and the thread with it."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._results.put(job())
