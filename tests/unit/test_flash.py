"""Flashing over a fake ssh: the vehicle keeps a release that runs, whatever fails or is interrupted."""

from __future__ import annotations

import os
import shutil
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import flash
import flash_files
import flash_service
import flash_units
import pytest
from flash_payload import Payload

from tests.unit.flash_releases import BETTER, BROKEN, GOOD, current, wheel

# Strips its options, dies where FAKE_DIE says, and runs the remaining words here.
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
        echo "StatusText=tick=$tick rate_hz=100 $(cat "$FAKE/armed" 2>/dev/null || echo armed=0/1)";;
esac
exit 0
"""
# Redirects systemd's folder to one of the fake vehicle.
ELSEWHERE = """#!/bin/sh
for word; do shift; set -- "$@" "$(echo "$word" | sed "s|^/etc/systemd/system|$FAKE/etc|")"; done
exec {real} "$@"
"""


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A fake vehicle with its files in FAKE/root and its commands in FAKE/bin."""
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
    """Provides put(release, *more words), which flashes a release and returns the exit status."""

    def put(release: str, *words: str, die: str = "", host: str = "robot@sub") -> int:
        (fake / "calls").unlink(missing_ok=True)
        monkeypatch.setenv("FAKE_DIE", die)
        payload = Payload(release, (wheel(fake, release),))
        monkeypatch.setattr(flash, "make_payload", lambda *given: payload)
        return flash.main([host, "--root", str(fake / "root"), *words])

    return put


@pytest.mark.slow
def test_release_is_installed_started_and_runs_its_own_code(put: Callable[..., int], fake: Path) -> None:
    assert put(GOOD) == 0
    assert current(fake) == GOOD
    assert flash_files.run([str(fake / "root/current/bin/modcube")]) == f"{GOOD}\n"
    assert (fake / "restarts").read_text().count("restarted") == 1
    packages = next((fake / "root/current/lib").glob("python*/site-packages"))
    assert (packages / "extra.py").exists() and not list(packages.glob("**/left_out"))
    assert sorted(path.name for path in (fake / "etc").iterdir()) == [flash_units.GUARD, flash_service.SERVICE]
    assert f"{fake}/root/flash/flash_device.py {fake}/root boot" in (fake / "etc" / flash_units.GUARD).read_text()


@pytest.mark.slow
def test_second_flash_keeps_the_first_to_go_back_to(put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
    """docs/jetson.md: the path is quoted, so that the vehicle's shell expands it to the home on the vehicle."""
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


@pytest.mark.slow
@pytest.mark.parametrize(("report", "says"), [("armed=1/2", "1/2 modules are armed"), ("", "does not say whether it is armed")])
def test_vehicle_that_is_or_may_be_armed_is_left_alone_unless_told_otherwise(
    put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str], report: str, says: str
) -> None:
    """Flashing would stop the vehicle's service in flight. A release that predates the armed report says nothing."""
    assert put(GOOD) == put(BETTER) == 0
    (fake / "armed").write_text(report)
    restarts = (fake / "restarts").read_text()
    for words in ((), ("--rollback",), ("--dry-run",)):
        capsys.readouterr()
        assert put("2.0-new", *words) == 2
        error = capsys.readouterr().err
        assert len(error.splitlines()) == 1 and says in error and "--armed" in error
    assert current(fake) == BETTER and (fake / "restarts").read_text() == restarts
    assert put("2.0-new", "--armed") == 0 and current(fake) == "2.0-new"
    assert put("2.0-new", "--rollback", "--armed") == 0 and current(fake) == BETTER


@pytest.mark.slow
def test_vehicle_that_is_armed_at_the_last_look_is_left_as_it_was(
    put: Callable[..., int], fake: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert put(GOOD) == 0
    ship, restarts = flash.ship, (fake / "restarts").read_text()

    def ship_and_arm(*given: Any) -> None:
        ship(*given)
        (fake / "armed").write_text("armed=1/1")

    monkeypatch.setattr(flash, "ship", ship_and_arm)
    assert put(BETTER) == 2
    assert capsys.readouterr().err.startswith("flash: 1/1 modules are armed, and its service would be stopped")
    assert current(fake) == GOOD and (fake / "restarts").read_text() == restarts


def test_dry_run_changes_nothing(put: Callable[..., int], fake: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert put(GOOD, "--dry-run") == 0
    assert f"would install {GOOD}" in capsys.readouterr().out
    assert not (fake / "root").exists()


@pytest.mark.slow
def test_flashing_the_same_release_again_ships_nothing(put: Callable[..., int], capsys: pytest.CaptureFixture[str]) -> None:
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
    """Connection lost before the command ran, in the middle of its input, or before its answer arrived."""
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


def test_status_of_a_vehicle_that_was_never_flashed_is_refused(put: Callable[..., int], capsys: pytest.CaptureFixture[str]) -> None:
    assert put(GOOD, "--status") == 2
    assert "nothing was ever flashed" in capsys.readouterr().err


@pytest.mark.parametrize("words", [[], ["a", "b"], ["host", "--speed"], ["host", "--status", "--rollback"]])
def test_wrong_usage_is_refused_in_one_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        flash.main(words)
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
