"""Campaigns on real workers: a cluster loses a worker or its scheduler, a campaign is killed, a seed kills its own process."""

import importlib
import os
import re
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import active_children
from pathlib import Path
from typing import IO

import pytest

import hil.campaign
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from hil.campaign import TRIALS_FILE, run_campaign
from hil.scenario import load_scenario
from hil.workers import processes
from tests.closed_loop.short_hover import SCENARIO
from tests.unit.campaigns import Inline

TRIALS = 8
TABLES = ("campaign.json", "trials.csv")


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("campaign") / "short.toml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture(scope="module")
def whole(scenario: Path) -> list[bytes]:
    """The tables of an undisturbed campaign, flown in this process."""
    return completed(scenario, scenario.parent / "whole")


def completed(scenario: Path, out: Path) -> list[bytes]:
    """The tables of the campaign in `out`, after flying its missing trials in this process."""
    run_campaign(load_scenario(str(scenario)), Parameters(), range(TRIALS), Inline, out)
    return tables(out)


def campaign(scenario: Path, out: Path, *arguments: str, errors: IO[bytes] | None = None) -> subprocess.Popen[bytes]:
    """Starts modcube hil campaign in its own process group."""
    command = [sys.executable, "-c", "from firmware_py.cli import main; main()", "hil", "campaign", str(scenario)]
    words = [*command, "--trials", str(TRIALS), "--draw", "0", "--out", str(out), *arguments]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True)


def flown(out: Path) -> int:
    path = out / "trials.jsonl"
    return path.read_bytes().count(b"\n") - 1 if path.exists() else 0


def wait_for(out: Path, trials: int, process: subprocess.Popen[bytes]) -> None:
    """Waits until this many trials are on the disk."""
    while flown(out) < trials:
        with pytest.raises(subprocess.TimeoutExpired):  # the process is still running
            process.wait(0.05)


def tables(out: Path) -> list[bytes]:
    return [(out / name).read_bytes() for name in TABLES]


@contextmanager
def cluster(folder: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Address of a dask scheduler, and the processes of its two workers and itself, all with this Python."""
    log, dask = folder / "scheduler.log", [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    with log.open("wb") as file:
        scheduler = subprocess.Popen([*dask, "--host", "127.0.0.1", "--port", "0", "--no-dashboard"], stderr=file)
    address = None
    while address is None:
        with pytest.raises(subprocess.TimeoutExpired):
            scheduler.wait(0.05)
        found = re.search(r"Scheduler at:\s+(tcp://\S+:\d+)", log.read_text())
        address = found[1] if found else None
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
    workers = [
        subprocess.Popen([*worker, "--local-directory", str(folder)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) for _ in "12"
    ]
    try:
        yield address, [*workers, scheduler]
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()


@pytest.mark.slow
def test_campaign_killed_with_all_its_processes_goes_on_to_the_same_bytes(whole: list[bytes], scenario: Path, tmp_path: Path) -> None:
    process = campaign(scenario, tmp_path, "--jobs", "1")
    wait_for(tmp_path, 2, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert 2 <= flown(tmp_path) < TRIALS
    assert completed(scenario, tmp_path) == whole


@pytest.mark.slow
def test_dask_cluster_that_loses_a_worker_gives_the_same_table_and_when_its_scheduler_is_lost_the_campaign_goes_on_elsewhere(
    whole: list[bytes], scenario: Path, tmp_path: Path
) -> None:
    """One cluster for both, because starting it takes longer than the flights."""
    first, second, said = tmp_path / "first", tmp_path / "second", tmp_path / "said"
    with cluster(tmp_path) as (address, (worker, _, scheduler)):
        process = campaign(scenario, first, "--dask", address)
        wait_for(first, TRIALS // 2, process)
        worker.kill()
        assert process.wait() == 0
        with said.open("wb") as errors:
            process = campaign(scenario, second, "--dask", address, errors=errors)
            wait_for(second, 2, process)
            scheduler.kill()
            assert process.wait() == 2
    assert f": no dask scheduler at {address}: " in said.read_text()
    assert campaign(scenario, second, "--jobs", "2").wait() == 0
    assert tables(first) == tables(second) == whole


DEADLY = """
import os


def fly(scenario, parameters, seed, bus, code):
    with open(os.environ["STARTED"], "a") as file:
        file.write(f"{seed}\\n")
    if seed == 0:
        os._exit(1)
    return {"seed": seed, "passed": True, "outcome": "passed", "metrics": {"position_rmse_m": 0.001}, "world": {"mass_factor": 1.0}}
"""


@pytest.mark.slow
def test_seed_that_kills_its_process_costs_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "deadly.py").write_text(DEADLY)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("STARTED", str(tmp_path / "started"))
    monkeypatch.setattr(hil.campaign, "fly_trial", importlib.import_module("deadly").fly)
    with pytest.raises(DescriptionError, match="each flown alone: 0; all others are flown"):
        run_campaign(load_scenario("hover"), Parameters(), range(20), processes(2), tmp_path)
    assert len((tmp_path / TRIALS_FILE).read_bytes().splitlines()) == 1 + 19
    started = (tmp_path / "started").read_text().split()
    assert started.count("0") == 4  # with all, with a few, and twice alone
    assert len(started) <= 19 + 4 + 2 * 3  # plus the trials under way in two processes at the two deaths that were not alone


@pytest.mark.slow
def test_workers_end_with_the_process_that_began_them() -> None:
    code = (
        "import os; from hil.workers import processes\n"
        "with processes(1)() as pool: print(pool.submit(os.getpid).result(), flush=True); input()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
        assert select.select([worker], [], [], 20.0)[0], "it goes on alone"
        os.close(worker)


@pytest.mark.slow
def test_no_more_processes_are_started_than_there_is_work_for() -> None:
    before = len(active_children())
    with processes(99)() as pool:
        pool.submit(os.getpid).result()
        assert len(active_children()) == before + 1


PROGRAM = """
import os, signal, tempfile, time
from firmware_py.runtime.interrupts import interrupted_once
from hil.workers import processes


def fly() -> None:
    with tempfile.TemporaryDirectory():
        {in_flight}
        time.sleep(60.0)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell runs in the background ignores it
    try:
        with interrupted_once(), processes(2)() as pool:
            [pool.submit(fly) for _ in range(9)][0].result()
    except KeyboardInterrupt:
        raise SystemExit(130) from None
else:
    {at_import}
"""
PRESS = "os.killpg(0, signal.SIGINT)"


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["at_import", "in_flight"])
def test_workers_that_a_terminal_interrupts_end_at_once_without_a_word_and_leave_no_file(moment: str, tmp_path: Path) -> None:
    """A terminal signals all of them."""
    (tmp_path / "tmp").mkdir()
    (tmp_path / "program.py").write_text(PROGRAM.format(**{"at_import": "pass", "in_flight": "pass", moment: PRESS}), encoding="utf-8")
    places = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(tmp_path / "tmp")}
    command = [sys.executable, str(tmp_path / "program.py")]
    ended = subprocess.run(command, env=places, start_new_session=True, capture_output=True, text=True, timeout=50)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "")
    assert not list((tmp_path / "tmp").iterdir())
