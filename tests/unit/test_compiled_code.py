"""Compiled code is never older than its sources, and there is always a folder for it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from firmware_py.compiled_code import CACHE_FOLDER, caches, forget_stale_code, forget_torn_code, temporary_cache_folder, transitive_sources

ROOT = Path(__file__).resolve().parents[2]


def written(path: Path, changed: float, text: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    os.utime(path, (changed, changed))
    return path


def cache_of(package: Path, changed: float) -> Path:
    return written(package / "__pycache__" / "sums.run-3.py311.nbi", changed)


@pytest.mark.slow
def test_compiled_code_older_than_any_source_that_it_may_have_taken_in_is_forgotten(tmp_path: Path) -> None:
    for package, changed in (("used", 300), ("mine", 200)):
        written(tmp_path / package / "sums.py", changed)
    mine, used = (cache_of(tmp_path / package, 250) for package in ("mine", "used"))
    forget_stale_code(tmp_path, "mine")
    assert mine.exists() and used.exists()
    forget_stale_code(tmp_path, "mine", "used")
    assert not mine.exists() and used.exists()


@pytest.mark.parametrize(("changed", "stays"), [(200, True), (300, False)])
def test_compiled_code_older_than_a_constant_that_it_holds_is_forgotten(tmp_path: Path, changed: float, stays: bool) -> None:
    """The file that defines the constant has no compiled code of its own."""
    written(tmp_path / "mine" / "sums.py", 200, "from mine.sizes import LENGTH\nfrom mine.words import hello\n")
    written(tmp_path / "mine" / "sizes.py", changed, "LENGTH = 8\n")
    written(tmp_path / "mine" / "words.py", 300)
    cache = cache_of(tmp_path / "mine", 250)
    forget_stale_code(tmp_path, "mine")
    assert cache.exists() == stays


@pytest.mark.slow
def test_start_after_a_power_cut_compiles_again_what_that_spoilt(tmp_path: Path) -> None:
    text = "from numba import njit\n\n\n@njit('f8(f8)', cache=True)\ndef twice(x):\n    return 2.0 * x\n"
    written(tmp_path / "mine" / "sums.py", 200, text)
    start = [sys.executable, "-c", "import firmware_py, mine.sums"]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{tmp_path}", CACHE_FOLDER: str(tmp_path / "cache")}
    subprocess.run(start, env=environment, check=True)
    (index,) = caches(tmp_path / "cache")
    index.write_bytes(b"")
    subprocess.run(start, env=environment, check=True)


@pytest.mark.parametrize(("content", "stays"), [(b"", False), (b"\x80\x04N", False), (bytes(4), False), (b"\x80\x04N.", True)])
@pytest.mark.parametrize("name", ["sums.run-3.py311.nbi", "sums.run-3.py311.1.nbc"])
def test_compiled_code_that_is_cut_short_or_zeros_is_forgotten(tmp_path: Path, name: str, content: bytes, stays: bool) -> None:
    path = tmp_path / "__pycache__" / name
    path.parent.mkdir()
    path.write_bytes(content)
    source = written(tmp_path / "sums.py", 200)
    forget_torn_code(tmp_path, tmp_path / "absent")
    assert path.exists() == stays
    assert source.exists()


def test_the_constants_of_the_wire_are_among_what_is_compiled() -> None:
    sources = transitive_sources(ROOT, ["firmware_py/bus/codec/receiver.py"])
    assert {"firmware_py/bus/codec/crc.py", "firmware_py/bus/codec/message.py"} < sources.keys()


def test_folder_that_cannot_be_read_does_not_stop_the_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(tmp_path / "mine" / "sums.py", 200)
    cache_of(tmp_path / "mine", 250)
    scandir = os.scandir

    def listed_but_gone(path: Path) -> object:
        if Path(path).name == "__pycache__":
            raise FileNotFoundError(path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", listed_but_gone)
    forget_stale_code(tmp_path, "mine")
    assert caches(tmp_path / "mine") == []


def test_compiled_code_that_can_be_kept_nowhere_goes_to_a_folder_for_this_run(tmp_path: Path) -> None:
    nowhere = written(tmp_path / "file", 100) / "folder"
    open_folder = tmp_path / "home"
    place = Path(temporary_cache_folder(nowhere, {"XDG_CACHE_HOME": str(nowhere)}))
    assert place.is_dir() and list(place.iterdir()) == []
    place.rmdir()
    assert temporary_cache_folder(nowhere, {"XDG_CACHE_HOME": str(open_folder)}) == ""
    assert temporary_cache_folder(tmp_path / "package", {"XDG_CACHE_HOME": str(nowhere)}) == ""
    assert temporary_cache_folder(nowhere, {"XDG_CACHE_HOME": str(nowhere), CACHE_FOLDER: str(open_folder)}) == ""


def test_home_of_somebody_else_is_no_place_for_compiled_code_and_does_not_stop_the_import(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after sudo -E, or in a service with another user's HOME: even stat fails for everything in there."""
    home = tmp_path / "home"
    home.mkdir()
    stat, access = os.stat, os.access

    def refused(path: str | Path, **how: object) -> os.stat_result:
        if home in Path(path).parents:
            raise PermissionError(13, "Permission denied", str(path))
        return stat(path, **how)  # type: ignore[call-overload]

    monkeypatch.setattr(os, "stat", refused)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != home and access(path, mode))
    assert temporary_cache_folder(tmp_path / "package", {"XDG_CACHE_HOME": str(home / ".cache")}) == ""
    place = Path(temporary_cache_folder(home / "package", {"XDG_CACHE_HOME": str(home / ".cache")}))
    assert place.is_dir()
    place.rmdir()
