"""What the command line says and how it ends."""

import pytest

from firmware_py.cli import main


def outcome(arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit status and what came on stderr."""
    monkeypatch.setattr("sys.argv", ["modcube", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0), capsys.readouterr().err


def refusal(arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that refuses."""
    status, error = outcome(arguments, monkeypatch, capsys)
    assert status == 2
    assert error.endswith("\n")
    assert len(error.splitlines()) == 1, error
    return error.strip()
