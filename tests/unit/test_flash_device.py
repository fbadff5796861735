"""The vehicle's side of flashing, in this process: the power fails at any step, the disk fills up, the watcher dies."""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import flash_device
import flash_files
import flash_service
import flash_units
import pytest
from flash_device import Device
from flash_files import RefusedError

from tests.unit.flash_releases import BETTER, BROKEN, GOOD, current, unit_of, wheel


class PowerCut(BaseException):
    """Simulated power cut."""


class Machine:
    """A vehicle in this process, with a service whose health each release decides."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.left: int | None = None
        self.steps: list[str] = []
        self.tick = 0
        self.says, self.active = "armed=0/1", "active"
        self.dies_in = ""
        self.fills_in = ""
        self.sick: set[str] = set()
        self.enabled: set[str] = set()
        self.loaded: dict[str, str] = {}
        """Units as systemd last read them."""

    def step(self, name: str) -> None:
        self.steps.append(name)
        if name == self.dies_in:
            raise PowerCut(name)
        if name == self.fills_in:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if self.left is not None:
            if self.left == 0:
                raise PowerCut(name)
            self.left -= 1

    def run(self, command: Sequence[str]) -> str:
        words = [word for word in command if word not in ("sudo", "-n")]
        if "show" not in words:
            if words[0] == "install":
                Path(words[-1]).write_text("")  # content if the power fails during the install
            self.step(" ".join(words[:2]))
            self.obey(words)
            return ""
        self.tick += 1
        state = "failed" if self.device().linked(self.root / "current") in self.sick else self.active
        return f"ActiveState={state}\nMainPID=1\nNRestarts=0\nStatusText=tick={self.tick} {self.says}\n"

    def obey(self, words: list[str]) -> None:
        """Simulates the effect of a command."""
        if words[0] == "install":
            Path(words[-1]).write_text(Path(words[-2]).read_text())
        elif words[0] == "mv":
            os.replace(words[-2], words[-1])
        elif "daemon-reload" in words:
            self.loaded = self.units()
        elif "enable" in words:
            self.enabled.add(words[-1])
        elif "restart" in words and "broken" in os.readlink(self.root / "current"):
            raise RefusedError("systemctl restart: failed")

    def units(self) -> dict[str, str]:
        """Unit texts by file name in systemd's folder."""
        return {path.name: path.read_text() for path in flash_service.UNIT_FOLDER.glob("*.service")}

    def device(self) -> Device:
        return Device(self.root, self.run, sleep=lambda seconds: None, step=self.step)

    def install_and_activate(self, release: str) -> None:
        path = wheel(self.root, release)
        digests = {path.name: flash_files.file_digest(path)}
        device = self.device()
        for name in device.missing_wheels(digests):
            (device.wheels / name).write_bytes(path.read_bytes())
        device.install(release, digests, {})
        device.activate(release)


@pytest.fixture(autouse=True)
def etc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Systemd's folder of the vehicle in this process."""
    folder = tmp_path / "systemd"
    folder.mkdir()
    monkeypatch.setattr(flash_service, "UNIT_FOLDER", folder)
    return folder


def boot_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    """Returns the vehicle after the power is back: systemd has read its units, and the guard has run before the service."""
    after = f"after {flash_files.boot_id()}"
    monkeypatch.setattr(flash_files, "boot_id", lambda: after)
    machine = Machine(root)
    machine.loaded = machine.units()
    machine.device().boot()
    return machine


@pytest.mark.slow
@pytest.mark.parametrize("release", [BETTER, BROKEN])
def test_power_cut_at_any_step_brings_a_release_up_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, release: str) -> None:
    Machine(tmp_path).install_and_activate(GOOD)
    for cut in range(200):
        machine = Machine(tmp_path)
        machine.left = cut
        name = f"{release}{cut}"
        try:
            machine.install_and_activate(name)
        except PowerCut:
            pass
        except RefusedError:
            break
        else:
            break
        again = boot_again(tmp_path, monkeypatch)
        device = again.device()
        confirmed = device.linked(device.current)
        assert confirmed is not None
        assert "broken" not in confirmed
        assert confirmed == GOOD or machine.steps[-1] == "prune", machine.steps[-1]
        assert device.linked(device.previous) != confirmed, machine.steps[-1]
        assert again.loaded[flash_service.SERVICE] == unit_of(confirmed), machine.steps[-1]
        assert not device.trial.exists()
        if confirmed != GOOD:
            device.activate(GOOD)
    assert cut >= 25  # every step of a whole flash was cut, including every command that the vehicle ran


@pytest.mark.slow
def test_power_cut_at_any_step_of_going_back_is_made_good_by_the_next_boot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Machine(tmp_path).install_and_activate(GOOD)
    for cut in range(20):
        abandon(tmp_path, f"{BETTER}{cut}")
        machine = Machine(tmp_path)
        machine.left = cut
        with contextlib.suppress(PowerCut):
            machine.device().boot()
            break
        again = boot_again(tmp_path, monkeypatch)
        assert current(tmp_path, ".") == GOOD and not again.device().trial.exists()
        assert again.loaded[flash_service.SERVICE] == unit_of(GOOD), machine.steps[-1]
    assert cut >= 8


@pytest.mark.slow
def test_first_flash_cut_at_any_step_is_made_whole_by_the_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A unit file left by the cut flash, which systemd has neither read nor enabled, does not stop the second flash from doing both."""
    for cut in range(200):
        root = tmp_path / str(cut)
        monkeypatch.setattr(flash_service, "UNIT_FOLDER", root / "systemd")
        flash_service.UNIT_FOLDER.mkdir(parents=True)
        machine = Machine(root)
        machine.left = cut
        try:
            machine.install_and_activate(GOOD)
            break
        except PowerCut:
            again = boot_again(root, monkeypatch)
        again.enabled = machine.enabled
        again.install_and_activate(GOOD)
        assert again.enabled == {flash_units.GUARD, flash_service.SERVICE}, machine.steps[-1]
        assert again.loaded == again.units() and again.loaded[flash_service.SERVICE] == unit_of(GOOD), machine.steps[-1]
    assert cut >= 25


def test_units_are_back_before_the_service_is_asked_for_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """systemd may have refused the unit on trial without even queueing the service."""
    Machine(tmp_path).install_and_activate(GOOD)
    abandon(tmp_path, BETTER)
    steps = boot_again(tmp_path, monkeypatch).steps
    assert steps.index("systemctl daemon-reload") < steps.index("systemctl --no-block") == len(steps) - 1


def abandon(root: Path, release: str) -> None:
    """Simulates a flash whose process is killed while it waits for the health report."""
    machine = Machine(root)
    machine.dies_in = "health"
    with pytest.raises(PowerCut):
        machine.install_and_activate(release)
    device = machine.device()
    flash_files.write_whole(device.trial, json.dumps({**json.loads(device.trial.read_text()), "started": "1"}))


@pytest.mark.parametrize("release", [BETTER, f"{BETTER}-2"])
def test_release_whose_watcher_died_is_never_what_the_next_flash_goes_back_to(tmp_path: Path, release: str) -> None:
    Machine(tmp_path).install_and_activate(GOOD)
    abandon(tmp_path, BETTER)
    machine = Machine(tmp_path)
    machine.sick = {BETTER, release}
    with pytest.raises(RefusedError, match=f"rolled back to {GOOD}, which runs"):
        machine.install_and_activate(release)
    assert current(tmp_path, ".") == GOOD
    assert machine.loaded[flash_service.SERVICE] == unit_of(GOOD)


def test_first_release_whose_watcher_died_is_not_taken_for_a_proven_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    abandon(tmp_path, GOOD)
    device = boot_again(tmp_path, monkeypatch).device()
    assert device.linked(device.current) == GOOD and device.status()["trial"]  # there is no better release
    with pytest.raises(RefusedError, match="there is no earlier release to go back to"):
        device.roll_back()
    machine = Machine(tmp_path)
    machine.sick = {GOOD}
    with pytest.raises(RefusedError, match="there was no earlier release; the service is stopped"):
        machine.install_and_activate(GOOD)


def test_roll_back_of_a_release_whose_watcher_died_leads_to_the_one_before(tmp_path: Path) -> None:
    Machine(tmp_path).install_and_activate(GOOD)
    abandon(tmp_path, BETTER)
    machine = Machine(tmp_path)
    assert machine.device().roll_back() == GOOD
    assert current(tmp_path, ".") == GOOD and not machine.device().trial.exists()
    assert machine.loaded[flash_service.SERVICE] == unit_of(GOOD) and "restart" in machine.steps


def test_disk_that_fills_up_after_the_switch_takes_the_release_back(tmp_path: Path) -> None:
    Machine(tmp_path).install_and_activate(GOOD)
    machine = Machine(tmp_path)
    machine.fills_in = "switch previous"
    with pytest.raises(RefusedError, match=f"No space left on device; rolled back to {GOOD}, which runs"):
        machine.install_and_activate(BETTER)
    assert current(tmp_path, ".") == GOOD and not machine.device().trial.exists()
    assert machine.units()[flash_service.SERVICE] == unit_of(GOOD)


def test_service_that_starts_while_its_release_is_watched_is_left_alone(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    machine.install_and_activate(GOOD)
    device = machine.device()
    flash_files.write_whole(device.trial, json.dumps({"release": BETTER, "old": GOOD, **flash_files.watcher()}))
    assert device.boot() == ""
    assert device.trial.exists()


def test_release_whose_watcher_died_is_taken_back_at_the_next_start(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    machine.install_and_activate(GOOD)
    device = machine.device()
    gone: dict[str, Any] = {**flash_files.watcher(), "started": "1"}
    flash_files.write_whole(device.trial, json.dumps({"release": BETTER, "old": GOOD, **gone}))
    assert GOOD in device.boot()
    assert not device.trial.exists()


def test_trial_that_says_nothing_of_the_release_before_leaves_it_as_it_is(tmp_path: Path) -> None:
    """An earlier flasher wrote such trial files."""
    machine = Machine(tmp_path)
    machine.install_and_activate(GOOD)
    machine.install_and_activate(BETTER)
    device = machine.device()
    gone: dict[str, Any] = {**flash_files.watcher(), "started": "1"}
    flash_files.write_whole(device.trial, json.dumps({"release": "2.0-x", "old": BETTER, **gone}))
    assert BETTER in device.boot()
    assert device.linked(device.previous) == GOOD


@pytest.mark.slow
def test_old_releases_and_wheels_that_nobody_needs_go(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    for number in range(6):
        machine.install_and_activate(f"1.{number}-x")
    device = machine.device()
    assert len(device.names()) == flash_device.KEPT_RELEASES
    assert len(list(device.wheels.iterdir())) == flash_device.KEPT_RELEASES
    assert device.linked(device.previous) == "1.4-x"


def test_torn_wheel_is_never_installed(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    device = machine.device()
    path = wheel(tmp_path, GOOD)
    digests = {path.name: flash_files.file_digest(path)}
    device.missing_wheels(digests)
    (device.wheels / path.name).write_bytes(path.read_bytes()[:-5])
    with pytest.raises(RefusedError, match="did not arrive whole"):
        device.install(GOOD, digests, {})
    assert device.missing_wheels(digests) == [path.name]


@pytest.mark.parametrize("command", ["missing", "activate", "rollback"])
def test_vehicle_that_was_armed_since_flash_looked_is_left_alone(tmp_path: Path, command: str) -> None:
    Machine(tmp_path).install_and_activate(GOOD)
    machine = Machine(tmp_path)
    machine.says = "armed=1/1"
    with pytest.raises(RefusedError, match="1/1 modules are armed, and its service would be stopped: disarm it, or say --armed"):
        flash_device.perform(machine.device(), command, {"release": GOOD, "wheels": {}})
    assert machine.steps == []


@pytest.mark.parametrize("state", ["inactive", "failed"])
def test_service_that_has_ended_is_not_armed_whatever_it_said_last(tmp_path: Path, state: str) -> None:
    machine = Machine(tmp_path)
    machine.says, machine.active = "armed=1/1", state
    machine.device().service.check_disarmed()


def test_service_that_ticks_not_yet_can_be_replaced(tmp_path: Path) -> None:
    """systemd clears the status report at every start, so a release that never reaches a tick has none."""
    assert flash_service.in_flight({"ActiveState": "activating", "StatusText": ""}) == ""


@pytest.mark.parametrize(("words", "status"), [(["--help"], 0), ([], 2), (["root"], 2), (["root", "fly"], 2)])
def test_wrong_words_and_a_call_for_help_are_answered(words: list[str], status: int, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        flash_device.main(words)
    assert ended.value.code == status
    said = capsys.readouterr()
    assert "folder of the releases" in said.out if status == 0 else len(said.err.splitlines()) == 1
