"""A file is replaced whole or stays as it was, and a write that the disk refuses leaves nothing behind."""

import errno
import os
from pathlib import Path

import pytest

from firmware_py.ground.files import write_atomically


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
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, call, refuse)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"after")
    assert path.read_bytes() == b"before" and os.listdir(tmp_path) == ["kept.txt"]
