"""Workers that die, lose a trial or are kept: every seed is flown, and the campaign's bytes are the same."""

import logging
from collections.abc import Callable
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest

import hil.campaign
import hil.workers
from firmware_py.description.schema import DescriptionError
from hil.workers import Pool, dask_cluster, reused
from tests.unit.campaigns import Inline, PlugError, content, fly, flying


def dying(after: int) -> Pool:
    """Executors whose worker dies after `after` trials."""

    class Dying(Inline):
        left = after

        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            if self.left > 0:
                self.left -= 1
                return super().submit(fn, *args, **kwargs)
            future: Future[Any] = Future()
            future.set_exception(BrokenProcessPool("a worker died"))
            return future

    return Dying


def test_worker_that_dies_costs_the_trials_under_way_and_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = flying(monkeypatch)
    fly(tmp_path / "whole", range(5))
    flown.clear()
    fly(tmp_path / "dying", range(5), dying(after=2))
    assert content(tmp_path / "dying") == content(tmp_path / "whole")
    assert len(flown) <= 2 * 5


def test_workers_that_die_at_once_are_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flying(monkeypatch)
    with pytest.raises(DescriptionError, match="workers die before they finish a trial; 5 seeds are left, 0 the first"):
        fly(tmp_path, range(5), dying(after=0))


def deadly(*seeds: int) -> Pool:
    """Executors that break, as a pool of processes does, when one of these seeds is flown."""

    class Deadly(Inline):
        broken = False

        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            if self.broken:
                raise BrokenProcessPool("a worker died")
            if args[2] not in seeds:
                return super().submit(fn, *args, **kwargs)
            self.broken = True
            future: Future[Any] = Future()
            future.set_exception(BrokenProcessPool("a worker died"))
            return future

    return Deadly


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seeds", "words"),
    [
        ((0,), "workers die of these seeds, each flown alone: 0; all others are flown"),
        ((3, 4, 19), "each flown alone: 3, 4, 19; all others are flown"),
        (tuple(range(10)), "10 seeds are left, 0 the first"),
    ],
)
def test_seeds_that_kill_their_workers_are_named_when_all_others_are_flown(
    seeds: tuple[int, ...], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown = flying(monkeypatch)
    fly(tmp_path / "whole", range(20))
    with pytest.raises(DescriptionError, match=words):
        fly(tmp_path / "deadly", range(20), deadly(*seeds))
    flown.clear()
    fly(tmp_path / "deadly", range(20))
    assert [seed for seed, _ in flown] == list(seeds)
    assert content(tmp_path / "deadly") == content(tmp_path / "whole")


def test_few_trials_are_under_way_after_a_death(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown, under_way = flying(monkeypatch), []
    executors = iter([dying(after=0)(), Inline()])
    monkeypatch.setattr(hil.campaign, "TRIALS_AFTER_A_DEATH", 4)
    fly(tmp_path, range(20), lambda: next(executors), progress=lambda done, total: under_way.append(len(flown) - done + 1))
    assert max(under_way) == 4


def ending(end: Callable[[Future[Any]], object]) -> Pool:
    """First an executor in which seed 2 ends by `end`, then executors that complete every trial."""

    class Ending(Inline):
        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            if args[2] != 2:
                return super().submit(fn, *args, **kwargs)
            future: Future[Any] = Future()
            end(future)
            return future

    left = [Ending]
    return lambda: left.pop()() if left else Inline()


def killed_on_dask(future: Future[Any]) -> None:
    distributed = pytest.importorskip("distributed")
    future.set_exception(distributed.KilledWorker("fly_trial", None, 3))


def cancelled_on_dask(future: Future[Any]) -> None:
    """As every future is when the scheduler is gone."""
    future.cancel()
    future.set_running_or_notify_cancel()


@pytest.mark.slow
@pytest.mark.parametrize("end", [killed_on_dask, cancelled_on_dask])
def test_trial_that_a_cluster_loses_is_flown_again(
    end: Callable[[Future[Any]], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown = flying(monkeypatch)
    fly(tmp_path, range(5), ending(end))
    assert [seed for seed, _ in flown] == [0, 1, 3, 4, 2]


def test_trial_that_raises_takes_no_finished_one_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = flying(monkeypatch)
    with pytest.raises(PlugError):
        fly(tmp_path, range(20), ending(lambda future: future.set_exception(PlugError())))
    fly(tmp_path, range(20))
    assert [seed for seed, _ in flown] == [0, 1, *range(3, 20), 2]


def test_workers_that_are_kept_serve_every_campaign_until_one_dies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def pool() -> Executor:
        made.append(len(made))
        return dying(after=3)() if len(made) == 1 else Inline()

    flying(monkeypatch)
    with reused(pool) as workers:
        fly(tmp_path / "first", range(2), workers)
        assert made == [0]
        fly(tmp_path / "second", range(2), workers)
        fly(tmp_path / "third", range(2), workers)
    assert made == [0, 1]
    assert content(tmp_path / "first") == content(tmp_path / "second") == content(tmp_path / "third")


@pytest.mark.parametrize(
    ("address", "words"), [
        ("nonsense", "is not an address; it needs tcp://HOST:PORT"),
        ("tcp://127.0.0.1:1", "no dask scheduler at tcp"),
        (f"tcp://{64 * 'a'}:1", "no dask scheduler at tcp"),
    ],
)
def test_cluster_that_is_not_there_is_said_in_one_line(address: str, words: str) -> None:
    with pytest.raises(DescriptionError, match=words):
        dask_cluster(address)


@pytest.mark.slow
def test_scheduler_that_dies_prints_no_traceback_of_dask() -> None:
    """Regression: one killed while thousands of trials were submitted left 20 lines beside the one that says so."""
    pytest.importorskip("distributed")
    hil.workers._quiet_dask()
    for name in ("distributed.batched", "distributed.client", "distributed.comm.tcp"):
        assert not logging.getLogger(name).isEnabledFor(logging.ERROR)
