"""A release is flashed to a Debian machine with systemd, flies there, and the machine survives bad releases and power cuts.

Marked `jetson`; `make test-flash` runs it. The tests run in order, each from the state in which the previous one left the machine.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.figures import figure
from tests.jetson.guest import ROOT, Guest, missing_packages
from tests.jetson.seed import make_seed

pytestmark = pytest.mark.jetson
COPIED = ("firmware_py", "hil", "can_dbc", "tools", "pyproject.toml", "requirements.lock", "LICENSE")
WAIT_S = 600.0
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "modcube" / "wheels"


@pytest.fixture(scope="module")
def guest(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guest]:
    if sys.version_info[:2] != (3, 11):
        pytest.skip("the guest has Python 3.11; compiled code of another is of no use there")
    if missing := missing_packages():
        pytest.skip(f"missing Debian packages: {' '.join(missing)} (make setup-system)")
    folder = tmp_path_factory.mktemp("jetson")
    guest = Guest(folder, make_seed(folder, CACHE))
    try:
        guest.boot()
        guest.run("mkdir -p /opt/modcube/releases && cd /opt/modcube && ln -s ../plant releases/seed")
        guest.run("ln -s releases/seed /opt/modcube/current")
        yield guest
    finally:
        guest.cut_power()
        shutil.rmtree(folder, ignore_errors=True)


def checkout(folder: Path, name: str, old: str = "", new: str = "") -> Path:
    """A copy of the sources, marked with `RELEASE = name` in its cli.py, where `old` is replaced by `new`."""
    target = folder / name
    target.mkdir()
    for each in COPIED:
        if (ROOT / each).is_dir():
            shutil.copytree(ROOT / each, target / each, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / each, target)
    cli = target / "firmware_py" / "cli.py"
    text = cli.read_text()
    assert old in text
    cli.write_text(text.replace(old, new, 1) + f"\nRELEASE = {name!r}\n")
    return target


def flash(guest: Guest, source: Path, *more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(guest.flash_words(sys.executable, source, *more), capture_output=True, text=True, check=False)


def current(guest: Guest) -> str:
    return guest.run("basename $(readlink /opt/modcube/current)").stdout.strip()


def report(guest: Guest) -> str:
    """State and status text of the service."""
    return guest.run("systemctl show modcube -p ActiveState -p StatusText --value", check=False).stdout


def description(guest: Guest) -> str:
    """Description of the service, as systemd has read it from the unit."""
    return guest.run("systemctl show modcube -p Description --value", check=False).stdout.strip()


def wait_for(guest: Guest, words: str) -> str:
    end = time.monotonic() + WAIT_S
    while words not in (text := report(guest)) and time.monotonic() < end:
        time.sleep(2.0)
    return text


def test_release_is_flashed_and_the_service_flies_the_hover_on_vcan0(guest: Guest) -> None:
    done = flash(guest, ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "answered=1/1" in wait_for(guest, "answered=1/1")
    figure("flashed Debian machine: modules that answer its service", 1)
    refused = flash(guest, ROOT)  # refused because the robot is armed
    assert refused.returncode == 2 and "1/1 modules are armed" in refused.stderr, refused.stdout + refused.stderr
    journal = guest.run("sudo journalctl -u modcube --no-pager").stdout
    assert "-> ARMED" in journal, journal[-2000:]
    assert guest.run("ps -o user= -C python | sort -u").stdout.split() == ["robot"]


def test_broken_release_is_rolled_back_by_the_machine_itself(guest: Guest, tmp_path: Path) -> None:
    before = current(guest)
    body = '"""Run the vehicle until SIGINT, SIGTERM or SIGHUP."""'
    done = flash(guest, checkout(tmp_path, "broken", body, f'{body}\n    raise RuntimeError("broken on purpose")'), "--armed")
    assert done.returncode == 1, done.stdout + done.stderr
    assert f"rolled back to {before}, which runs" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert current(guest) == before
    assert "active" in report(guest)
    figure("flashed Debian machine: releases rolled back by itself", 1)


def test_power_cut_half_way_through_a_flash_brings_the_old_release_up(guest: Guest, tmp_path: Path) -> None:
    before = current(guest)
    source = checkout(tmp_path, "interrupted")
    unit = source / "firmware_py" / "deploy" / "modcube.service"
    unit.write_text(unit.read_text().replace("Description=modcube", "Description=interrupted modcube", 1))
    words = guest.flash_words(sys.executable, source, "--armed")
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as flashing:
        assert flashing.stdout is not None
        for line in flashing.stdout:
            if line.startswith("4/4"):
                break
        end = time.monotonic() + WAIT_S
        while "interrupted" not in description(guest) and time.monotonic() < end:  # switched, and the new unit installed and read
            time.sleep(0.2)
        assert current(guest) != before
        guest.cut_power()
        flashing.kill()
    guest.boot()
    assert "tick=" in wait_for(guest, "tick=")
    assert current(guest) == before
    assert description(guest) == "modcube vehicle controller"
    assert "interrupted" not in guest.run("cat /etc/systemd/system/modcube.service").stdout
    assert guest.run("ls /opt/modcube/trial.json", check=False).returncode != 0
    assert "on trial" not in flash(guest, ROOT, "--status").stdout
    figure("flashed Debian machine: power cuts survived", 1)
