"""A file is replaced whole or stays as it was, a refused write leaves nothing behind, and a thread of its own waits for the disk."""

import errno
import os
import threading
from contextlib import closing
from pathlib import Path

import pytest

from firmware_py.ground import files
from firmware_py.ground.files import FileWriter, write_atomically

NO_ROOM = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_file_is_replaced_in_a_folder_that_is_made_for_it(tmp_path: Path) -> None:
    path = tmp_path / "new" / "kept.txt"
    for data in (b"first, and long", b"second"):
        write_atomically(path, data)
        assert path.read_bytes() == data and os.listdir(path.parent) == ["kept.txt"]


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_refused_write_leaves_the_file_as_it_was_and_nothing_beside_it(call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "kept.txt"
    path.write_bytes(b"before")

    def refuse(*_: object) -> None:
        raise NO_ROOM

    monkeypatch.setattr(os, call, refuse)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"after")
    assert path.read_bytes() == b"before" and os.listdir(tmp_path) == ["kept.txt"]


def test_writer_leaves_out_contents_that_newer_ones_have_replaced(tmp_path: Path) -> None:
    disk, busy, written = threading.Event(), threading.Event(), list[bytes]()

    def write(path: Path, data: bytes, mode: int) -> None:
        busy.set()
        assert disk.wait(60.0)
        written.append(data)
        write_atomically(path, data, mode)

    with closing(FileWriter(60.0, write)) as writer:
        writer.write(tmp_path / "kept.txt", b"0")
        assert busy.wait(60.0)
        for data in (b"1", b"2", b"3"):
            writer.write(tmp_path / "kept.txt", data, 0o600)
        disk.set()
    assert written == [b"0", b"3"] and (tmp_path / "kept.txt").read_bytes() == b"3"
    assert (tmp_path / "kept.txt").stat().st_mode & 0o777 == 0o600


def test_writer_tries_again_until_the_disk_has_room_and_tells_of_it_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tries, done = list[bytes](), threading.Event()

    def write(path: Path, data: bytes, mode: int) -> None:
        tries.append(data)
        if len(tries) <= 3:
            raise NO_ROOM
        write_atomically(path, data, mode)
        done.set()

    monkeypatch.setattr(files, "RETRY_S", 0.0)
    with closing(FileWriter(60.0, write)) as writer:
        writer.write(tmp_path / "kept.txt", b"new")
        assert done.wait(60.0)
    assert writer.failures() == [(tmp_path / "kept.txt", NO_ROOM)] and writer.failures() == []
    assert tries == [b"new"] * 4 and (tmp_path / "kept.txt").read_bytes() == b"new"


def test_writer_writes_what_is_left_at_its_end(tmp_path: Path) -> None:
    writer = FileWriter(60.0)
    for name in "abc":
        writer.write(tmp_path / name, name.encode())
    writer.close()
    writer.close()
    assert [(tmp_path / name).read_text() for name in "abc"] == ["a", "b", "c"]
