"""Runs on the vehicle, shipped there by flash.py: installs releases, switches between them, rolls back.

Layout of the root folder (say /opt/modcube):

    wheels/            every wheel ever shipped and still used, checked by SHA-256
    releases/ID/       one release: its own environment, `bin/modcube`, `release.json`; ID.partial while it is being made
    current, previous  links to releases; the service starts `current/bin/modcube`
    trial.json         while a new release is on trial: the links and units to restore, and the identity of the watching process

An interruption is safe at any point: before the switch, `current` is untouched; after the switch, a release on trial whose watcher is gone
is rolled back by `boot`, which a unit of its own (flash_units.py) runs before every start of the service, or by the next flash.
Uses only the standard library.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from command_line import Parser, run_tool

from flash_files import (
    RefusedError,
    UntouchedError,
    carry_compiled,
    compilers,
    file_digest,
    make_environment,
    remove,
    run,
    sync_folder,
    unpack,
    watcher,
    watches,
    write_whole,
)
from flash_service import SERVICE, Service
from flash_units import GUARD, guard_unit, release_units

KEPT_RELEASES = 3
COMMANDS = ("missing", "install", "activate", "rollback", "boot", "status")
LOCK_FREE_COMMANDS = ("boot", "status")
"""Commands that take no input, and never wait for another flash."""
REFUSED_WHILE_ARMED = ("missing", "activate", "rollback")
"""Commands refused while armed: those that stop the service, and the first step of a flash, which ends in that."""


class Device:
    """One vehicle's root folder.

    Args:
        root: the folder.
        run: runs a command, returns its output; raises RefusedError when it fails.
        sleep: waits that many seconds.
        step: called with the name of every step before it is done (tests cut the power there).
    """

    def __init__(
        self,
        root: Path,
        run: Callable[[Sequence[str]], str],
        sleep: Callable[[float], None] = time.sleep,
        step: Callable[[str], None] = lambda name: None,
    ) -> None:
        self.root = root
        self.releases, self.wheels = root / "releases", root / "wheels"
        self.current, self.previous, self.trial = root / "current", root / "previous", root / "trial.json"
        self._run, self._step = run, step
        self.service = Service(root, run, sleep, step)

    def missing_wheels(self, wheels: dict[str, str]) -> list[str]:
        """Those of `wheels` (name -> SHA-256) that have to be shipped. Removes wheels with a wrong digest."""
        self._step("folders")
        for folder in (self.releases, self.wheels):
            folder.mkdir(parents=True, exist_ok=True)
        missing = []
        for name, digest in wheels.items():
            path = self.wheels / name
            if not path.is_file() or file_digest(path) != digest:
                path.unlink(missing_ok=True)
                missing.append(name)
        return missing

    def install(self, release: str, wheels: dict[str, str], facts: dict[str, str]) -> None:
        """Makes releases/`release` from wheels already present; does nothing when it exists. Raises RefusedError."""
        target = self.releases / release
        if (target / "release.json").is_file():
            return
        if wrong := [name for name, digest in wheels.items() if file_digest(self.wheels / name) != digest]:
            raise RefusedError(f"{wrong[0]} did not arrive whole")
        partial = self.releases / f"{release}.partial"
        self._step("clear")
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(target, ignore_errors=True)
        packages = make_environment(partial)
        for name in wheels:
            self._step(f"unpack {name}")
            unpack(self.wheels / name, packages)
        self._step("carry over")
        self._carry_over(wheels, packages)
        self._step("check")
        self._run([str(partial / "bin" / "modcube"), "doctor", "--warm"])
        (partial / "release.json").write_text(json.dumps({"release": release, "wheels": wheels, **facts}, indent=1))
        self._step("sync")
        os.sync()
        self._step("name")
        partial.rename(target)
        sync_folder(self.releases)

    def _carry_over(self, wheels: dict[str, str], packages: Path) -> None:
        """Copies compiled code from the current release if everything it was built from is the same: saves minutes."""
        old = self.linked(self.current)
        if old is None:
            return
        before = json.loads((self.releases / old / "release.json").read_text())["wheels"]
        if compilers(before) == compilers(wheels):
            source = next((self.releases / old / "lib").glob("python*/site-packages"))
            if source.parent.name == packages.parent.name:
                carry_compiled(source, packages)

    def activate(self, release: str) -> None:
        """Switches to `release`, restarts the service, waits until it is healthy, and rolls back otherwise.

        Raises:
            RefusedError: it was not healthy; the old release runs again, or the service is stopped if there was none.
        """
        target = self.releases / release
        if not (target / "release.json").is_file():
            raise RefusedError(f"there is no release {release}; there are {', '.join(self.names()) or 'none'}")
        self._roll_back_unwatched_trial()
        self.service.install_units(guard_unit(self.root), GUARD)
        units = release_units(target, self.root)
        old = None if self.trial.exists() else self.linked(self.current)  # never one that is still on trial
        if old == release:
            self.service.install_units(units, SERVICE)
            self.service.start_and_wait()
            return
        self._step("trial")
        before = {"old": old, "previous": self.linked(self.previous), "units": self.service.installed(units)}
        trial = {"release": release, **before, **watcher()}
        write_whole(self.trial, json.dumps(trial))
        try:
            self._switch(self.current, release)
            self.service.install_units(units, SERVICE)
            self.service.start_and_wait()
            if old is not None:
                self._switch(self.previous, old)
        except (RefusedError, OSError) as error:
            raise RefusedError(f"{release}: {error}; {self._go_back(trial)}") from None
        self._step("confirm")
        remove(self.trial)
        self.prune()

    def roll_back(self) -> str:
        """Activates the previous release; returns its name. Raises RefusedError."""
        tried = self.linked(self.current)
        self._roll_back_unwatched_trial()
        now, earlier = self.linked(self.current), self.linked(self.previous)
        if now is not None and now != tried:  # the current one was still on trial and is rolled back already
            self.service.start_and_wait()
            return now
        if earlier is None:
            raise RefusedError("there is no earlier release to go back to")
        self.activate(earlier)
        return earlier

    def boot(self) -> str:
        """Before the service starts: rolls back a release on trial whose watcher is gone. Returns what it did."""
        trial = self._on_trial()
        if trial is None or watches(trial):
            return ""
        said = self._roll_back_unwatched_trial()
        if said:
            self.service.start_without_waiting()  # needed if systemd refused the unit on trial: then nothing else starts the service
        return said

    def _on_trial(self) -> dict[str, Any] | None:
        """Contents of trial.json: empty if it is torn, None if there is none."""
        if not self.trial.is_file():
            return None
        try:
            trial = json.loads(self.trial.read_text())
        except ValueError:
            return {}
        return trial if isinstance(trial, dict) else {}

    def _roll_back_unwatched_trial(self) -> str:
        """Rolls back a trial without a watcher; returns what it did. Called with the lock held, or once the watcher is known to be gone.

        A vehicle's first release has none to go back to: it keeps running, and stays on trial until the next flash.
        """
        trial = self._on_trial()
        if trial is None or trial.get("old", "") is None:
            return ""
        if "old" not in trial:
            remove(self.trial)  # torn while being written, so the switch had not happened yet
            return "removed a torn trial.json"
        self._take_back(trial)
        return f"release {trial.get('release')} had not proved itself: back to {self.linked(self.current)}"

    def _take_back(self, trial: dict[str, Any]) -> None:
        """Restores links and units from before a trial, then ends the trial. Raises RefusedError."""
        links = {self.current: trial["old"]} | ({self.previous: trial["previous"]} if "previous" in trial else {})
        for link, release in links.items():
            if release is None:
                remove(link)
            elif (self.releases / release / "release.json").is_file():
                self._switch(link, release)
        self.service.install_units(trial.get("units", {}), SERVICE)
        self._step("end trial")
        remove(self.trial)

    def status(self) -> dict[str, object]:
        """What is installed, and the state of the service."""
        return {
            "current": self.linked(self.current),
            "previous": self.linked(self.previous),
            "trial": self.trial.exists(),
            "releases": self.names(),
            "service": self.service.state(),
        }

    def names(self) -> list[str]:
        """Complete releases, oldest first."""
        if not self.releases.is_dir():
            return []
        whole = [path for path in self.releases.iterdir() if (path / "release.json").is_file()]
        return [path.name for path in sorted(whole, key=lambda path: path.stat().st_mtime) if path.suffix != ".partial"]

    def linked(self, link: Path) -> str | None:
        """The release that a link points to; None where there is no link or no such release."""
        if not link.is_symlink():
            return None
        name = Path(os.readlink(link)).name
        return name if (self.releases / name / "release.json").is_file() else None

    def prune(self) -> None:
        """Removes releases beyond KEPT_RELEASES, and wheels that no remaining release needs."""
        self._step("prune")
        kept = {self.linked(self.current), self.linked(self.previous), *self.names()[-KEPT_RELEASES:]}
        for path in self.releases.iterdir():
            if path.name not in kept:
                shutil.rmtree(path, ignore_errors=True)
        needed: set[str] = set()
        for name in self.names():
            needed |= set(json.loads((self.releases / name / "release.json").read_text())["wheels"])
        for wheel in self.wheels.iterdir():
            if wheel.name not in needed:
                wheel.unlink()

    def _switch(self, link: Path, release: str) -> None:
        """Points `link` to `release` atomically."""
        self._step(f"switch {link.name}")
        fresh = link.with_name(f"{link.name}.new")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(Path("releases") / release)
        os.replace(fresh, link)
        sync_folder(self.root)

    def _go_back(self, trial: dict[str, Any]) -> str:
        """Rolls back from an unhealthy release; returns what became of the service."""
        old = trial["old"]
        try:
            self._take_back(trial)
        except (RefusedError, OSError) as error:
            return f"not yet taken back: {error}; the service's next start tries again"
        if old is None:
            self.service.stop()
            return "there was no earlier release; the service is stopped"
        try:
            self.service.start_and_wait()
        except RefusedError as error:
            return f"rolled back to {old}, which is not healthy either: {error}"
        return f"rolled back to {old}, which runs"


def parse(words: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command line."""
    parser = Parser(prog="flash_device", description="Installs and switches releases; flash.py runs it on the vehicle.")
    parser.add_argument("root", type=Path, help="folder of the releases")
    parser.add_argument("command", choices=COMMANDS, help="command to run; all but boot and status read JSON from standard input")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    """flash_device.py ROOT COMMAND, with the command's JSON on standard input where it takes any.

    Prints one line of JSON: {"error": line, "untouched": whether nothing was begun} or the command's result.
    Exit status 0 or 1; 2 for wrong arguments.
    """
    # A lost connection must not interrupt what was begun.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    asked = parse(words)
    device, command = Device(asked.root, run), asked.command
    given = {} if command in LOCK_FREE_COMMANDS else json.loads(sys.stdin.read() or "{}")
    device.root.mkdir(parents=True, exist_ok=True)
    try:
        with flash_lock(device.root, command):
            answer = {"result": perform(device, command, given)}
    except (RefusedError, OSError) as error:
        answer = {"error": str(error), "untouched": isinstance(error, UntouchedError)}
    if command in ("activate", "rollback"):
        write_whole(device.root / "last.json", json.dumps(answer))
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(answer), flush=True)
    return 1 if "error" in answer else 0


def perform(device: Device, command: str, given: dict[str, Any]) -> object:
    """Runs one command. Raises RefusedError."""
    if command in REFUSED_WHILE_ARMED and not given.get("armed"):
        device.service.check_disarmed()
    if command == "missing":
        return device.missing_wheels(given["wheels"])
    if command == "install":
        device.install(given["release"], given["wheels"], given["facts"])
        return None
    if command == "activate":
        device.activate(given["release"])
        return given["release"]
    if command == "rollback":
        return device.roll_back()
    return device.boot() if command == "boot" else device.status()


@contextlib.contextmanager
def flash_lock(root: Path, command: str) -> Iterator[None]:
    """Holds the lock of a flash; a second flash is refused. LOCK_FREE_COMMANDS, such as the one at service start, take no lock."""
    if command in LOCK_FREE_COMMANDS:
        yield
        return
    with (root / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UntouchedError("somebody else is flashing this vehicle") from None
        yield


if __name__ == "__main__":
    run_tool(main)
