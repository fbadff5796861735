"""A vehicle keeps a release that runs: whatever fails or is interrupted while it is flashed, over a pretended ssh."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import stat
import subprocess
import sys
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools"
sys.path.insert(0, str(TOOLS))

import flash  # noqa: E402
import flash_device  # noqa: E402
import flash_files  # noqa: E402
import flash_payload  # noqa: E402
import flash_units  # noqa: E402
from flash_device import Device  # noqa: E402
from flash_files import RefusedError  # noqa: E402
from flash_payload import Payload, PayloadError  # noqa: E402

DATA_SUFFIXES = (".toml", ".xml", ".service")
GOOD, BETTER, BROKEN = "1.0-good", "1.1-better", "1.2-broken"

# Takes its options away, dies where it is told to, and runs the rest here.
SSH = """#!/bin/sh
while [ "${1#-}" != "$1" ]; do case $1 in -o|-p|-i) shift 2;; *) shift;; esac; done
host=$1; shift
case $host in
    nowhere) echo 'ssh: Could not resolve hostname nowhere: Name or service not known' >&2; exit 255;;
    stranger) echo 'stranger: Permission denied (publickey).' >&2; exit 255;;
    impostor) echo 'WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED!' >&2; exit 255;;
    sleeping) echo 'ssh: connect to host sleeping port 22: Connection timed out' >&2; exit 255;;
esac
calls=$(($(cat "$FAKE/calls" 2>/dev/null || echo 0) + 1)); echo $calls > "$FAKE/calls"
if [ "$FAKE_DIE" = "$calls:before" ]; then exit 255; fi
if [ "$FAKE_DIE" = "$calls:half" ]; then head -c 700 | sh -c "$*" >/dev/null 2>&1; exit 255; fi
sh -c "$*"; status=$?
if [ "$FAKE_DIE" = "$calls:after" ]; then exit 255; fi
exit $status
"""
SUDO = '#!/bin/sh\n[ -e "$FAKE/no_sudo" ] && exit 1\nshift; exec "$@"\n'
UNAME = '#!/bin/sh\ncat "$FAKE/machine" 2>/dev/null || echo aarch64\n'
ID = "#!/bin/sh\necho 1000\n"
DF = '#!/bin/sh\necho header\necho disk 0 0 $(cat "$FAKE/free_kb" 2>/dev/null || echo 9000000) 0 /\n'
PYTHON = '#!/bin/sh\n[ -e "$FAKE/old_python" ] && {{ echo 3.10; exit 0; }}\nexec {real} "$@"\n'
SYSTEMCTL = """#!/bin/sh
case $* in
    *restart*) echo restarted >> "$FAKE/restarts"
        ls -d "${FAKE}/root/current"/lib/python*/site-packages/broken && exit 1;;
    *show*) tick=$(($(cat "$FAKE/tick" 2>/dev/null || echo 0) + 1)); echo $tick > "$FAKE/tick"
        echo ActiveState=active; echo SubState=running; echo MainPID=7; echo NRestarts=0
        echo "StatusText=tick=$tick rate_hz=100";;
esac
exit 0
"""
# systemd's folder is one of the pretended vehicle.
ELSEWHERE = """#!/bin/sh
for word; do shift; set -- "$@" "$(echo "$word" | sed "s|^/etc/systemd/system|$FAKE/etc|")"; done
exec {real} "$@"
"""


def wheel(folder: Path, release: str) -> Path:
    """A small wheel in the place of the project's own."""
    path = folder / f"modcube-{release.replace('-', '_')}-py3-none-any.whl"
    files = {
        "firmware_py/__init__.py": "",
        "firmware_py/cli.py": f"def main():\n    print({release!r})\n    return 0\n" + "#" * 2000,
        "firmware_py/deploy/modcube.service": unit_of(release),
        "modcube-1.data/purelib/extra.py": "",
        "modcube-1.data/scripts/left_out": "",
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in {**files, **({"broken": ""} if "broken" in release else {})}.items():
            archive.writestr(zipfile.ZipInfo(name), text)
    return path


def unit_of(release: str) -> str:
    """The service's unit, another one in every release."""
    return f"[Service]\nExecStart=modcube run --of {release}\n"


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A pretended vehicle: its files in FAKE/root, its commands in FAKE/bin."""
    shims = tmp_path / "bin"
    shims.mkdir()
    (tmp_path / "sitecustomize.py").write_text("import time\ntime.sleep = lambda seconds: None\n")
    python = PYTHON.format(real=sys.executable)
    programs = {"ssh": SSH, "sudo": SUDO, "uname": UNAME, "id": ID, "df": DF, "python3.11": python, "python3": python}
    (tmp_path / "etc").mkdir()
    elsewhere = {name: ELSEWHERE.format(real=shutil.which(name)) for name in ("install", "mv", "sync")}
    for name, text in {**programs, **elsewhere, "python3.12": python, "systemctl": SYSTEMCTL}.items():
        (shims / name).write_text(text)
        (shims / name).chmod(stat.S_IRWXU)
    monkeypatch.setenv("FAKE", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("PATH", str(shims), prepend=os.pathsep)
    return tmp_path


@pytest.fixture
def put(fake: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """put(release, *more words): flashes a release; returns the exit status."""

    def put(release: str, *words: str, die: str = "", host: str = "robot@sub") -> int:
        (fake / "calls").unlink(missing_ok=True)
        monkeypatch.setenv("FAKE_DIE", die)
        payload = Payload(release, (wheel(fake, release),))
        monkeypatch.setattr(flash, "make_payload", lambda *given: payload)
        return flash.main([host, "--root", str(fake / "root"), *words])

    return put


def current(fake: Path, root: str = "root") -> str | None:
    return Device(fake / root, flash_files.run).linked(fake / root / "current")


@pytest.mark.slow
def test_release_is_installed_started_and_runs_its_own_code(put: Callable[..., int], fake: Path) -> None:
    assert put(GOOD) == 0
    assert current(fake) == GOOD
    assert flash_files.run([str(fake / "root/current/bin/modcube")]) == f"{GOOD}\n"
    assert (fake / "restarts").read_text().count("restarted") == 1
    packages = next((fake / "root/current/lib").glob("python*/site-packages"))
    assert (packages / "extra.py").exists() and not list(packages.glob("**/left_out"))
    assert sorted(path.name for path in (fake / "etc").iterdir()) == [flash_units.GUARD, flash_device.SERVICE]
    assert f"{fake}/root/flash/flash_device.py {fake}/root boot" in (fake / "etc" / flash_units.GUARD).read_text()


@pytest.mark.slow
def test_second_flash_keeps_the_first_to_go_back_to(
    put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert put(GOOD) == put(BETTER) == 0
    assert current(fake) == BETTER
    assert put(BETTER, "--status") == 0
    shown = capsys.readouterr().out
    assert f"previous  {GOOD}" in shown and "active running" in shown and "tick=" in shown
    assert put(BETTER, "--rollback") == 0
    assert current(fake) == GOOD
    assert f"robot@sub runs {GOOD}" in capsys.readouterr().out


@pytest.mark.slow
def test_rollback_without_an_earlier_release_changes_nothing(
    put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert put(GOOD) == 0
    assert put(GOOD, "--rollback") == 2
    assert "there is no earlier release to go back to" in capsys.readouterr().err
    assert current(fake) == GOOD


@pytest.mark.slow
def test_rollback_to_a_release_without_health_is_told_as_what_it_is(
    put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert put(GOOD) == put(BETTER) == 0
    next((fake / "root/previous/lib").glob("python*/site-packages")).joinpath("broken").touch()
    assert put(BETTER, "--rollback") == 1
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and f"rolled back to {BETTER}, which runs" in error
    assert current(fake) == BETTER


@pytest.mark.slow
def test_connection_lost_in_a_rollback_says_that_the_vehicle_goes_on(
    put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert put(GOOD) == put(BETTER) == 0
    assert put(BETTER, "--rollback", die="4:after") == 1
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and "goes on by itself: see --status" in error
    assert current(fake) == GOOD


@pytest.mark.slow
def test_python_in_the_home_of_the_vehicle_is_found(put: Callable[..., int], fake: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """docs/jetson.md: quoted, so that it is the vehicle's shell that knows whose home it is."""
    monkeypatch.setenv("HOME", str(fake))
    (fake / "old_python").touch()
    (fake / "python3.12").symlink_to(sys.executable)
    assert put(GOOD) == 2
    assert put(GOOD, "--python", "~/python3.12") == 0


@pytest.mark.slow
def test_release_without_health_is_taken_back_and_the_old_one_runs(
    put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert put(GOOD) == 0
    assert put(BROKEN) == 1
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and f"rolled back to {GOOD}, which runs" in error
    assert current(fake) == GOOD and not (fake / "root" / "trial.json").exists()


@pytest.mark.slow
def test_first_release_without_health_leaves_none(put: Callable[..., int], fake: Path) -> None:
    assert put(BROKEN) == 1
    assert current(fake) is None


def test_dry_run_changes_nothing(put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert put(GOOD, "--dry-run") == 0
    assert f"would install {GOOD}" in capsys.readouterr().out
    assert not (fake / "root").exists()


@pytest.mark.slow
def test_flashing_the_same_release_again_ships_nothing(
    put: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    put(GOOD)
    capsys.readouterr()
    assert put(GOOD) == 0
    assert "ship 0 of 1 wheels" in capsys.readouterr().out


def calls_of_a_flash(put: Callable[..., int], fake: Path) -> int:
    assert put(GOOD) == 0
    return int((fake / "calls").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("how", ["before", "half", "after"])
def test_connection_lost_at_any_call_leaves_a_release_that_runs(
    put: Callable[..., int], fake: Path, how: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Lost before the command ran, in the midst of what it was sent, or before its answer came."""
    calls = calls_of_a_flash(put, fake)
    assert calls == 7
    for call in range(1, calls + 1):
        release = f"2.{call}-{how}"
        capsys.readouterr()
        status = put(release, die=f"{call}:{how}")
        error = capsys.readouterr().err
        assert status in (1, 2), call
        assert len(error.splitlines()) == 1, error
        done = how != "before" and call == calls  # the vehicle finished; only the answer was lost
        assert current(fake) == (release if done else GOOD), call
        assert flash_files.run([str(fake / "root/current/bin/modcube")]).strip() == current(fake)
        assert put(release) == 0 and current(fake) == release  # and the next flash goes through
        assert put(GOOD) == 0


@pytest.mark.parametrize(
    ("host", "says"),
    [
        ("nowhere", "no host of this name"),
        ("stranger", "accepts none of your keys"),
        ("impostor", "host key has changed"),
        ("sleeping", "does not answer"),
    ],
)
def test_vehicle_that_cannot_be_reached_is_told_in_one_line(
    put: Callable[..., int], capsys: pytest.CaptureFixture[str], host: str, says: str
) -> None:
    assert put(GOOD, host=host) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and says in error and host in error


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("machine", "armv7l", "is armv7l; needs aarch64 or x86_64"),
        ("old_python", "", "needs Python 3.11 or newer, it has 3.10"),
        ("free_kb", "0", "0 MB free"),
        ("no_sudo", "", "sudo without a password"),
    ],
)
def test_vehicle_that_cannot_take_the_release_is_left_as_it_is(
    put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str], name: str, content: str, says: str
) -> None:
    (fake / name).write_text(content)
    assert put(GOOD) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and says in error
    assert not (fake / "root").exists()


def test_status_of_a_vehicle_that_was_never_flashed_is_refused(
    put: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert put(GOOD, "--status") == 2
    assert "nothing was ever flashed" in capsys.readouterr().err


@pytest.mark.parametrize("words", [[], ["a", "b"], ["host", "--speed"], ["host", "--status", "--rollback"]])
def test_wrong_usage_is_refused_in_one_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        flash.main(words)
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


class PowerCut(BaseException):
    """The plug is pulled."""


class Machine:
    """A vehicle in this process, with a service whose health each release decides."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.left: int | None = None
        self.steps: list[str] = []
        self.tick = 0
        self.dies_in = ""
        self.fills_in = ""
        self.sick: set[str] = set()
        self.enabled: set[str] = set()
        self.loaded: dict[str, str] = {}
        """Units as systemd read them last."""

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
                Path(words[-1]).write_text("")  # as it stands when the power goes amid it
            self.step(" ".join(words[:2]))
            self.obey(words)
            return ""
        self.tick += 1
        state = "failed" if self.device().linked(self.root / "current") in self.sick else "active"
        return f"ActiveState={state}\nMainPID=1\nNRestarts=0\nStatusText=tick={self.tick}\n"

    def obey(self, words: list[str]) -> None:
        """What a command does here."""
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
        """Texts by name in systemd's folder."""
        return {path.name: path.read_text() for path in flash_device.UNIT_FOLDER.glob("*.service")}

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
    monkeypatch.setattr(flash_device, "UNIT_FOLDER", folder)
    return folder


def boot_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    """The power is back: systemd reads its units, and the guard runs before the service."""
    after = f"after {flash_files.boot_id()}"
    monkeypatch.setattr(flash_files, "boot_id", lambda: after)
    machine = Machine(root)
    machine.loaded = machine.units()
    machine.device().boot()
    return machine


@pytest.mark.slow
@pytest.mark.parametrize("release", [BETTER, BROKEN])
def test_power_cut_at_any_step_brings_a_release_up_that_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, release: str
) -> None:
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
        assert again.loaded[flash_device.SERVICE] == unit_of(confirmed), machine.steps[-1]
        assert not device.trial.exists()
        if confirmed != GOOD:
            device.activate(GOOD)
    assert cut >= 25  # every step of a whole flash was cut, and every command that the vehicle ran


def test_power_cut_at_any_step_of_going_back_is_made_good_by_the_next_boot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
        assert again.loaded[flash_device.SERVICE] == unit_of(GOOD), machine.steps[-1]
    assert cut >= 8


@pytest.mark.slow
def test_first_flash_cut_at_any_step_is_made_whole_by_the_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A unit that is there already, and neither read by systemd nor enabled, is no reason to do less."""
    for cut in range(200):
        root = tmp_path / str(cut)
        monkeypatch.setattr(flash_device, "UNIT_FOLDER", root / "systemd")
        flash_device.UNIT_FOLDER.mkdir(parents=True)
        machine = Machine(root)
        machine.left = cut
        try:
            machine.install_and_activate(GOOD)
            break
        except PowerCut:
            again = boot_again(root, monkeypatch)
        again.enabled = machine.enabled
        again.install_and_activate(GOOD)
        assert again.enabled == {flash_units.GUARD, flash_device.SERVICE}, machine.steps[-1]
        assert again.loaded == again.units() and again.loaded[flash_device.SERVICE] == unit_of(GOOD), machine.steps[-1]
    assert cut >= 25


def test_units_are_back_before_the_service_is_asked_for_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may be that systemd refused the unit on trial and has not so much as queued the service."""
    Machine(tmp_path).install_and_activate(GOOD)
    abandon(tmp_path, BETTER)
    steps = boot_again(tmp_path, monkeypatch).steps
    assert steps.index("systemctl daemon-reload") < steps.index("systemctl --no-block") == len(steps) - 1


def abandon(root: Path, release: str) -> None:
    """A flash whose process was killed while it waited for the health report."""
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
    assert machine.loaded[flash_device.SERVICE] == unit_of(GOOD)


def test_first_release_whose_watcher_died_is_not_taken_for_a_proven_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    abandon(tmp_path, GOOD)
    device = boot_again(tmp_path, monkeypatch).device()
    assert device.linked(device.current) == GOOD and device.status()["trial"]  # there is nothing better
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
    assert machine.loaded[flash_device.SERVICE] == unit_of(GOOD) and "restart" in machine.steps


def test_disk_that_fills_up_after_the_switch_takes_the_release_back(tmp_path: Path) -> None:
    Machine(tmp_path).install_and_activate(GOOD)
    machine = Machine(tmp_path)
    machine.fills_in = "switch previous"
    with pytest.raises(RefusedError, match=f"No space left on device; rolled back to {GOOD}, which runs"):
        machine.install_and_activate(BETTER)
    assert current(tmp_path, ".") == GOOD and not machine.device().trial.exists()
    assert machine.units()[flash_device.SERVICE] == unit_of(GOOD)


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
    """As an earlier flasher wrote it."""
    machine = Machine(tmp_path)
    machine.install_and_activate(GOOD)
    machine.install_and_activate(BETTER)
    device = machine.device()
    gone: dict[str, Any] = {**flash_files.watcher(), "started": "1"}
    flash_files.write_whole(device.trial, json.dumps({"release": "2.0-x", "old": BETTER, **gone}))
    assert BETTER in device.boot()
    assert device.linked(device.previous) == GOOD


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


def test_lock_gives_every_package_that_the_vehicle_needs_and_no_bench_or_developer_tool() -> None:
    blocks = flash_payload.locked(flash_payload.ROOT / "requirements.lock")
    names = flash_payload.runtime_names()
    assert names <= set(blocks)
    assert {"numpy", "numba", "llvmlite", "daqp", "python-can", "cantools", "pymavlink", "foxglove-sdk"} <= names
    assert not names & {"pytest", "mypy", "optuna", "plotly", "cvxpy"}
    text = "\n".join(blocks[name] for name in sorted(names))
    pins = flash_payload.pins(text)
    assert "colorama" not in dict(pins)
    assert text.count("--hash=sha256:") >= len(pins)


def test_offline_names_the_first_wheel_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(PayloadError, match=r"no wheel of .* run once without --offline"):
        flash_payload.make_payload("aarch64", "3.11", tmp_path, offline=True)


def test_compiled_code_is_carried_over_only_if_all_its_sources_are_the_same(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    for folder in (old, new):
        (folder / "firmware_py" / "core").mkdir(parents=True)
        (folder / "firmware_py" / "core" / "fast.py").write_text("import numba\n")
    cache = old / "firmware_py" / "core" / "__pycache__"
    cache.mkdir()
    (cache / "fast.run-1.py311.nbi").write_text("index")
    assert flash_files.carry_compiled(old, new)
    assert (new / "firmware_py/core/__pycache__/fast.run-1.py311.nbi").read_text() == "index"
    (new / "firmware_py" / "core" / "fast.py").write_text("import numba  # another\n")
    assert not flash_files.carry_compiled(old, new)


@pytest.mark.slow
def test_wheel_carries_the_wire_the_vehicles_the_dialect_and_the_units(tmp_path: Path) -> None:
    with zipfile.ZipFile(flash_payload.build_wheel(tmp_path)) as archive:
        names = set(archive.namelist())
    package = flash_payload.ROOT / "firmware_py"
    data = {str(path.relative_to(flash_payload.ROOT)) for path in package.rglob("*.*") if path.suffix in DATA_SUFFIXES}
    assert data | {"can_dbc/modcube.dbc", "firmware_py/deploy/modcube.service"} <= names


def test_guard_is_a_unit_that_systemd_understands(tmp_path: Path) -> None:
    (guard,) = flash_units.guard_unit(tmp_path).items()
    assert "@" not in guard[1]
    (tmp_path / guard[0]).write_text(guard[1])
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is missing")
    words = ["systemd-analyze", "verify", str(tmp_path / guard[0])]
    said = subprocess.run(words, capture_output=True, text=True, check=False).stderr
    assert "Unknown" not in said and f"{guard[0]}:" not in said, said


def test_enabled_interface_is_set_up_at_boot_and_whenever_it_is_plugged_in(tmp_path: Path) -> None:
    if shutil.which("systemctl") is None:
        pytest.skip("systemctl is missing")
    folder = tmp_path / "etc" / "systemd" / "system"
    shutil.copytree(flash_payload.ROOT / "firmware_py" / "deploy", folder)
    for unit in ("modcube-can@can1", "modcube"):  # as docs/jetson.md has it, and as a flash does
        subprocess.run(["systemctl", f"--root={tmp_path}", "enable", "--quiet", unit], check=True)
    for name in ("can0", "can1"):
        for wanting in ("multi-user.target", f"sys-subsystem-net-devices-{name}.device"):
            assert (folder / f"{wanting}.wants" / f"modcube-can@{name}.service").is_symlink(), wanting
