"""The workers of a campaign: processes of this machine or a dask cluster, as executors of concurrent.futures."""

from __future__ import annotations

import logging
import os
import re
import signal
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from multiprocessing import active_children, get_context, parent_process
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any

from firmware_py.description.schema import DescriptionError
from firmware_py.runtime.interrupts import signals_blocked

Pool = Callable[[], AbstractContextManager[Executor]]
"""Makes a context that starts the workers and ends them."""


class Processes(ProcessPoolExecutor):
    """Starts each process with SIGINT blocked, which the process inherits; otherwise it would print a traceback on Ctrl-C."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submits one call; starts a process for it if none is idle."""
        with signals_blocked([signal.SIGINT]):
            return super().submit(fn, *args, **kwargs)


def processes(jobs: int) -> Pool:
    """`jobs` processes of this machine. They end with this process, however it ends, and their temporary files are deleted with them.

    They ignore Ctrl-C, which a terminal sends to them too; this process handles it and terminates them, whatever they are doing.
    """

    @contextmanager
    def use() -> Iterator[Executor]:
        others = active_children()
        with (
            TemporaryDirectory() as scratch,
            Processes(jobs, mp_context=get_context("spawn"), initializer=begin, initargs=(scratch,)) as pool,
        ):
            try:
                yield pool
            except BaseException:
                with signals_blocked([signal.SIGINT]):  # a second Ctrl-C could lose the exit status that the pool's thread waits for
                    for child in active_children():
                        if child not in others:
                            child.terminate()
                    pool.shutdown(cancel_futures=True)
                raise

    return use


def begin(scratch: str) -> None:
    """Prepares a child before its first call: it ends with its parent, and its temporary files go to the folder `scratch`."""
    end_with_parent()
    tempfile.tempdir = scratch


def end_with_parent() -> None:
    """Makes a child exit when its parent does. Without this, the children of a killed parent would run on."""

    def wait() -> None:
        if parent := parent_process():
            parent.join()
            os._exit(1)

    Thread(target=wait, daemon=True).start()


@contextmanager
def reused(pool: Pool) -> Iterator[Pool]:
    """The pool with its workers kept between uses, because starting them takes longer than a flight. A broken pool is replaced."""
    with ExitStack() as stack:
        executors: list[Executor] = []

        @contextmanager
        def use() -> Iterator[Executor]:
            if not executors:
                executors.append(stack.enter_context(pool()))
            try:
                yield executors[0]
            except BrokenExecutor:
                executors.clear()
                raise

        yield use


class DaskExecutor(Executor):
    """The workers of a dask client. Dask's own executor never resolves the calls that were under way when the scheduler was lost."""

    def __init__(self, client: Any) -> None:
        """Uses `client`, which the caller must close."""
        self._client = client

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submits one call. Raises BrokenExecutor if the scheduler is gone."""
        task = self._client.submit(fn, *args, pure=False, **kwargs)
        if self._client.status != "running":
            raise BrokenExecutor("the dask scheduler is gone")
        future: Future[Any] = Future()
        task.add_done_callback(partial(_pass_on, future))
        return future


def _pass_on(future: Future[Any], task: Any) -> None:
    """Copies the outcome of dask's `task` to `future`; a result that was lost with the scheduler becomes BrokenExecutor."""
    if not future.set_running_or_notify_cancel():
        return
    try:
        if task.status == "error":
            future.set_exception(task.exception())
        else:
            future.set_result(task.result())
    except Exception as error:
        future.set_exception(BrokenExecutor(str(error)))


def dask_cluster(address: str) -> Pool:
    """The workers of the dask scheduler at `address`, such as tcp://host:8786.

    Raises DescriptionError if none answers, now or on later use.
    """

    @contextmanager
    def use() -> Iterator[Executor]:
        client = _dask_client(address)
        try:
            yield DaskExecutor(client)
        finally:
            if client.status == "running":
                client.close()

    with use():
        return use


def _quiet_dask() -> Any:
    """The package of dask clusters. Its log says with tracebacks, on stderr, what the campaign says in one line: the scheduler is gone."""
    import distributed

    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    return distributed


def _dask_client(address: str) -> Any:
    found = re.fullmatch(r"t(?:cp|ls)://(.+):(\d+)", address)
    if not found:
        raise DescriptionError(f"--dask {address!r} is not an address; it needs tcp://HOST:PORT, as `dask scheduler` prints it")
    try:
        socket.create_connection((found[1], int(found[2])), timeout=10).close()
        return _quiet_dask().Client(address, timeout=10, set_as_default=False)
    except (OSError, OverflowError, UnicodeError) as error:  # UnicodeError: an invalid host name
        raise DescriptionError(f"no dask scheduler at {address}: {error}; start one with `dask scheduler`") from None


def worker_death_exceptions() -> tuple[type[BaseException], ...]:
    """Exceptions of a future whose worker has died. Dask has one of its own, and cancels all futures when its scheduler is gone."""
    dask = sys.modules.get("distributed")
    return (BrokenExecutor, CancelledError, *((dask.KilledWorker,) if dask else ()))
