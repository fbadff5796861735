"""Fixtures shared by several files: the world of the ground side (a file may define its own), the body of a single module, and the
error line with which the command line refuses arguments.
"""

from collections.abc import Callable

import pytest

from firmware_py.core.body import Body
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle
from tests.unit.ground_world import Client, World


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
def client(world: World) -> Client:
    return world.client()


@pytest.fixture(scope="session")
def body() -> Body:
    """The body of one module; a file that needs another one defines its own."""
    return assemble_vehicle(load_vehicle("modcube"))


@pytest.fixture
def refusal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """refusal(*arguments): returns the one line with which `modcube` refuses them."""
    from firmware_py.cli import main  # most files do without it

    def run(*arguments: str) -> str:
        monkeypatch.setattr("sys.argv", ["modcube", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 2
        error = capsys.readouterr().err
        assert error.endswith("\n") and len(error.splitlines()) == 1, error
        return error.strip()

    return run
