"""Campaigns on real workers: a dask cluster that loses one, and a campaign killed with its processes, end in the same bytes."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

TRIALS = 8
SCENARIO = """
name = "short"
help = "a hover that is over soon"
module = [{ number = 1, position_m = [0.0, 0.0, 0.4] }]
camera = [{}]
tank = {}
check = [{ metric = "position_rmse_m", high = 0.1 }]
task = { kind = "hover", settle_s = 3.0, duration_s = 4.0, centre_m = [0.0, 0.0, 0.4] }
"""
TABLES = ("campaign.json", "trials.csv")


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("campaign") / "short.toml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture(scope="module")
def whole(scenario: Path) -> list[bytes]:
    """The tables of a campaign that nothing befell."""
    assert campaign(scenario, scenario.parent / "whole", "--jobs", "2").wait() == 0
    return tables(scenario.parent / "whole")


def campaign(scenario: Path, out: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """modcube hil campaign, in a group of its own."""
    command = [sys.executable, "-c", "from firmware_py.cli import main; main()", "hil", "campaign", str(scenario)]
    return subprocess.Popen(
        [*command, "--trials", str(TRIALS), "--draw", "0", "--out", str(out), *arguments], stdout=subprocess.DEVNULL, start_new_session=True
    )


def flown(out: Path) -> int:
    path = out / "trials.jsonl"
    return path.read_bytes().count(b"\n") - 1 if path.exists() else 0


def wait_for(out: Path, trials: int, process: subprocess.Popen[bytes]) -> None:
    """Until so many trials are on the disk."""
    while flown(out) < trials:
        with pytest.raises(subprocess.TimeoutExpired):  # it has not ended
            process.wait(0.05)


def tables(out: Path) -> list[bytes]:
    return [(out / name).read_bytes() for name in TABLES]


@contextmanager
def cluster(folder: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Address of a dask scheduler, and its two workers, all with this Python."""
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
        yield address, workers
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()


@pytest.mark.slow
@pytest.mark.xdist_group("campaign")
def test_campaign_killed_with_all_its_processes_goes_on_to_the_same_bytes(whole: list[bytes], scenario: Path, tmp_path: Path) -> None:
    process = campaign(scenario, tmp_path, "--jobs", "1")
    wait_for(tmp_path, 2, process)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert 2 <= flown(tmp_path) < TRIALS
    assert campaign(scenario, tmp_path, "--jobs", "1").wait() == 0
    assert tables(tmp_path) == whole


@pytest.mark.slow
@pytest.mark.xdist_group("campaign")
def test_dask_cluster_that_loses_a_worker_gives_the_same_table_as_this_machine(whole: list[bytes], scenario: Path, tmp_path: Path) -> None:
    remote = tmp_path / "remote"
    with cluster(tmp_path) as (address, workers):
        process = campaign(scenario, remote, "--dask", address)
        wait_for(remote, TRIALS // 2, process)
        workers[0].kill()
        assert process.wait() == 0
    assert tables(remote) == whole
