"""A notice that numba compiles appears once on a terminal, and never in a pipe."""

from __future__ import annotations

import errno
import io
import runpy
import sys
from types import SimpleNamespace

import pytest
from numba import njit

from firmware_py.__main__ import COMPILING, NO_PLACE, NO_ROOM, compiling_told, main


class Terminal(io.StringIO):
    """Output that counts as a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("out", "said"), [(Terminal(), f"{COMPILING}\n"), (io.StringIO(), "")])
def test_the_first_function_that_is_compiled_is_announced(out, said):
    with compiling_told(out):
        for once in (lambda x: x + 1, lambda x: x + 2):
            njit("int64(int64)")(once)
    njit("int64(int64)")(lambda x: x + 3)
    assert out.getvalue() == said


def test_a_function_that_an_earlier_process_has_compiled_is_not(tmp_path):
    file = tmp_path / "adding.py"
    file.write_text("from numba import njit\n@njit('int64(int64)', cache=True)\ndef add(x):\n    return x + 1\n", encoding="utf-8")
    for said in (f"{COMPILING}\n", ""):  # the second run finds the cache that the first left beside the file
        with compiling_told(out := Terminal()):
            assert runpy.run_path(str(file))["add"](1) == 2
        assert out.getvalue() == said


def test_compiled_code_without_any_place_is_one_line(monkeypatch, capsys):
    def no_place():
        raise RuntimeError("cannot cache function 'turn': no locator available for file 'rotations.py'")

    monkeypatch.setitem(sys.modules, "firmware_py.cli", SimpleNamespace(main=no_place))
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2 and capsys.readouterr().err == f"{NO_PLACE}\n"


def test_disk_that_is_full_at_the_first_start_is_one_line(monkeypatch, capsys):
    """numba passes on the error that it met when it cached the first function."""

    def full():
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setitem(sys.modules, "firmware_py.cli", SimpleNamespace(main=full))
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2 and capsys.readouterr().err == f"{NO_ROOM.format('No space left on device')}\n"
