"""Where the vehicle's process logs: beside the logs of earlier processes, and nowhere if the disk takes no folder."""

import errno
import os
from pathlib import Path

import pytest

from firmware_py.app import vehicle_process
from firmware_py.app.estop_note import NOTE, EstopNote
from firmware_py.app.vehicle_process import run_vehicle
from firmware_py.bus.port import PortError
from firmware_py.description.fleet import single
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.runtime.flight_log import FlightLog
from firmware_py.runtime.log_folder import make_log_folder
from firmware_py.runtime.recorder import CAN_LOG, SIGNAL_LOG, Recorder
from tests.unit.vehicle_runs import LOGS, content, fly


def test_process_that_is_refused_a_folder_leaves_the_log_of_who_has_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processes start at once, both before either has a log there."""
    monkeypatch.setattr(vehicle_process, "make_log_folder", lambda out: out)
    note = EstopNote(tmp_path)
    log = Recorder(tmp_path, {})
    log.flush()
    before = content(tmp_path)
    with pytest.raises(DescriptionError, match="another vehicle that runs logs into"):
        fly(tmp_path, tmp_path)
    assert content(tmp_path) == before
    log.close()
    note.close()


@pytest.mark.slow
def test_log_of_the_process_before_is_kept(tmp_path: Path) -> None:
    out = tmp_path / "log"
    fly(tmp_path, out)
    first = content(out)
    assert sorted(first) == sorted([*LOGS, NOTE])
    fly(tmp_path, out)
    fly(tmp_path, out)
    kept = content(out)
    assert sorted(kept) == sorted([*first, *(f"{n}/{name}" for n in ("0002", "0003") for name in LOGS)])
    assert {name: kept[name] for name in first} == first
    assert all(list(FlightLog(out / number).ticks()) for number in ("0002", "0003"))


@pytest.mark.parametrize("left", [CAN_LOG, SIGNAL_LOG, "0007"])
def test_new_log_is_newer_than_all_that_are_there(tmp_path: Path, left: str) -> None:
    (tmp_path / left).touch()
    (tmp_path / "notes.txt").touch()
    (tmp_path / "calibration-2026").mkdir()
    assert make_log_folder(tmp_path) == tmp_path / ("0008" if left == "0007" else "0002")


def test_folder_without_a_log_takes_the_first(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    assert make_log_folder(tmp_path) == tmp_path
    assert make_log_folder(tmp_path / "made" / "anew").is_dir()


@pytest.mark.slow
def test_start_that_failed_leaves_no_log_behind(tmp_path: Path) -> None:
    """A service that is restarted until its bus exists would fill the disk, and the log of the crash would not be the newest."""
    fly(tmp_path, tmp_path / "log")
    before = content(tmp_path / "log")
    for out in (tmp_path / "log", tmp_path):
        with pytest.raises(PortError):
            run_vehicle(single(bus="socketcan:nocan7"), Parameters(), out=out, say=lambda line: None)
    assert content(tmp_path / "log") == before
    assert [path.name for path in tmp_path.iterdir()] == ["log"]
    assert not (tmp_path / "log" / "0002").exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_vehicle_flies_without_log_where_the_disk_takes_no_folder(
    tmp_path: Path, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(Path, "mkdir", refuse)
    said = fly(tmp_path, tmp_path / "log")
    assert f"warning: no log: {tmp_path / 'log'}: {os.strerror(number)}" in said
    assert any(line.startswith("running at") for line in said)


def test_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "taken").touch()
    for out in (tmp_path / "taken", tmp_path / "taken" / "log"):
        with pytest.raises(OSError, match="taken") as refused:
            fly(tmp_path, out)
        assert refused.value.filename is not None  # the command line turns it into one line and status 2
