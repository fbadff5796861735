"""A vehicle keeps a release that runs: whatever fails or is interrupted while it is flashed, over a pretended ssh."""

from __future__ import annotations

import json
import os
import stat
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


def wheel(folder: Path, release: str) -> Path:
    """A small wheel in the place of the project's own."""
    path = folder / f"modcube-{release.replace('-', '_')}-py3-none-any.whl"
    files = {
        "firmware_py/__init__.py": "",
        "firmware_py/cli.py": f"def main():\n    print({release!r})\n    return 0\n" + "#" * 2000,
        "modcube-1.data/purelib/extra.py": "",
        "modcube-1.data/scripts/left_out": "",
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in {**files, **({"broken": ""} if "broken" in release else {})}.items():
            archive.writestr(zipfile.ZipInfo(name), text)
    return path


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A pretended vehicle: its files in FAKE/root, its commands in FAKE/bin."""
    shims = tmp_path / "bin"
    shims.mkdir()
    (tmp_path / "sitecustomize.py").write_text("import time\ntime.sleep = lambda seconds: None\n")
    python = PYTHON.format(real=sys.executable)
    programs = {"ssh": SSH, "sudo": SUDO, "uname": UNAME, "id": ID, "df": DF, "python3.11": python, "python3": python}
    for name, text in {**programs, "python3.12": python, "systemctl": SYSTEMCTL}.items():
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


def current(fake: Path) -> str | None:
    return Device(fake / "root", flash_files.run).linked(fake / "root" / "current")


def test_release_is_installed_started_and_runs_its_own_code(put: Callable[..., int], fake: Path) -> None:
    assert put(GOOD) == 0
    assert current(fake) == GOOD
    assert flash_files.run([str(fake / "root/current/bin/modcube")]) == f"{GOOD}\n"
    assert (fake / "restarts").read_text().count("restarted") == 1
    packages = next((fake / "root/current/lib").glob("python*/site-packages"))
    assert (packages / "extra.py").exists() and not list(packages.glob("**/left_out"))


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


def test_release_without_health_is_taken_back_and_the_old_one_runs(
    put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert put(GOOD) == 0
    assert put(BROKEN) == 1
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1 and f"rolled back to {GOOD}, which runs" in error
    assert current(fake) == GOOD and not (fake / "root" / "trial.json").exists()


def test_first_release_without_health_leaves_none(put: Callable[..., int], fake: Path) -> None:
    assert put(BROKEN) == 1
    assert current(fake) is None


def test_dry_run_changes_nothing(put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert put(GOOD, "--dry-run") == 0
    assert f"would install {GOOD}" in capsys.readouterr().out
    assert not (fake / "root").exists()


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

    def step(self, name: str) -> None:
        self.steps.append(name)
        if self.left is not None:
            if self.left == 0:
                raise PowerCut(name)
            self.left -= 1

    def run(self, command: Sequence[str]) -> str:
        words = list(command)
        if "show" not in words:
            if "restart" in words and "broken" in os.readlink(self.root / "current"):
                raise RefusedError("systemctl restart: failed")
            return ""
        self.tick += 1
        return f"ActiveState=active\nMainPID=1\nNRestarts=0\nStatusText=tick={self.tick}\n"

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


@pytest.mark.parametrize("release", [BETTER, BROKEN])
def test_power_cut_at_any_step_brings_a_release_up_that_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, release: str
) -> None:
    boots = iter(range(10_000))
    monkeypatch.setattr(flash_device, "UNIT_FOLDER", tmp_path)
    plain = Machine(tmp_path)
    plain.install_and_activate(GOOD)
    counted = Machine(tmp_path)
    counted.left = None
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
        boot = f"boot {next(boots)}"
        monkeypatch.setattr(flash_files, "boot_id", lambda boot=boot: boot)
        again = Machine(tmp_path).device()
        again.boot()
        confirmed = again.linked(again.current)
        assert confirmed is not None
        assert "broken" not in confirmed
        assert confirmed == GOOD or machine.steps[-1] == "prune", machine.steps[-1]
        assert not again.trial.exists()
        if confirmed != GOOD:
            again.activate(GOOD)
    assert cut >= 12  # every step of a whole flash was cut


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


def test_wheel_carries_the_wire_the_vehicles_the_dialect_and_the_units(tmp_path: Path) -> None:
    with zipfile.ZipFile(flash_payload.build_wheel(tmp_path)) as archive:
        names = set(archive.namelist())
    package = flash_payload.ROOT / "firmware_py"
    data = {str(path.relative_to(flash_payload.ROOT)) for path in package.rglob("*.*") if path.suffix in DATA_SUFFIXES}
    assert data | {"can_dbc/modcube.dbc", "firmware_py/deploy/modcube.service"} <= names
