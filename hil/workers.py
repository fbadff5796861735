"""The workers of a campaign: processes of this machine or a dask cluster, as executors of concurrent.futures."""

from __future__ import annotations

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

Pool = Callable[[], AbstractContextManager[Executor]]
"""What begins and ends the workers."""


class Processes(ProcessPoolExecutor):
    """Starts each process with Ctrl-C blocked, which it inherits: it would print a traceback."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Begins one call, for which a process is started where none is idle."""
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return super().submit(fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def processes(jobs: int) -> Pool:
    """So many processes of this machine, which end with this one, however it ends, and whose temporary files go with them.

    Ctrl-C, which a terminal sends to them too, they leave to this one, which ends them with what they do.
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
                pool.shutdown(wait=False, cancel_futures=True)
                for child in active_children():
                    if child not in others:
                        child.terminate()
                        child.join()
                raise

    return use


def begin(scratch: str) -> None:
    """In a child, before its first call: its temporary files go to the folder `scratch`."""
    end_with_parent()
    tempfile.tempdir = scratch


def end_with_parent() -> None:
    """In a child: a parent that is killed tells nobody, and its children would go on for ever."""

    def wait() -> None:
        if parent := parent_process():
            parent.join()
            os._exit(1)

    Thread(target=wait, daemon=True).start()


@contextmanager
def kept(pool: Pool) -> Iterator[Pool]:
    """The pool, whose workers stay from one use to the next: to start them takes longer than a flight. A broken one is made anew."""
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
    """The workers of a dask client. Dask's own executor never answers for what was under way when the scheduler was lost."""

    def __init__(self, client: Any) -> None:
        """Executor of this client, which stays the caller's to close."""
        self._client = client

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Begins one call. Raises BrokenExecutor where the scheduler is gone."""
        task = self._client.submit(fn, *args, pure=False, **kwargs)
        if self._client.status != "running":
            raise BrokenExecutor("the dask scheduler is gone")
        future: Future[Any] = Future()
        task.add_done_callback(partial(_pass_on, future))
        return future


def _pass_on(future: Future[Any], task: Any) -> None:
    """Tells `future` what has come of dask's `task`; its result may be lost with the scheduler that holds it."""
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
    """The workers of the dask scheduler at `address`, such as tcp://host:8786. Raises DescriptionError when none answers, now or later."""

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


def _dask_client(address: str) -> Any:
    found = re.fullmatch(r"t(?:cp|ls)://(.+):(\d+)", address)
    if not found:
        raise DescriptionError(f"--dask {address!r} is no address; it needs tcp://HOST:PORT, as `dask scheduler` prints it")
    try:
        socket.create_connection((found[1], int(found[2])), timeout=10).close()
        from distributed import Client

        return Client(address, timeout=10, set_as_default=False)
    except (OSError, OverflowError, UnicodeError) as error:  # the last: a name that no host can have
        raise DescriptionError(f"no dask scheduler at {address}: {error}; start one with `dask scheduler`") from None


def deaths() -> tuple[type[BaseException], ...]:
    """What a future raises whose worker has died; dask has words of its own for it, and cancels all when its scheduler is gone."""
    dask = sys.modules.get("distributed")
    return (BrokenExecutor, CancelledError, *((dask.KilledWorker,) if dask else ()))
