"""Files that survive a power cut, unmistakable process identities, wheels without pip. Runs on the vehicle too.

Uses only the standard library of Python 3.11 and a module of ours that does the same; flash.py ships both beside flash_device.py.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Collection, Sequence
from pathlib import Path

from firmware_py.compiled_code import cached_sources, transitive_sources

FILE_TIME_S = 315532800
"""1980-01-01, the time of every file of a release: caches of compiled code identify their source by time and size."""


OWN_PACKAGES = ("firmware_py", "hil")
COMPILERS = ("numba", "llvmlite", "numpy")
"""Distributions on which compiled code depends besides its sources."""


class RefusedError(Exception):
    """An operation failed or is not possible, with a one-line message."""


class UntouchedError(RefusedError):
    """Refused before anything was begun: everything runs as before."""


def make_environment(folder: Path) -> Path:
    """Makes a virtual environment without pip, and the command; returns the folder for packages."""
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    packages = folder / "lib" / f"python{version}" / "site-packages"
    packages.mkdir(parents=True)
    (folder / "bin").mkdir()
    interpreter = Path(sys.executable).resolve()
    (folder / "bin" / "python").symlink_to(interpreter)
    (folder / "pyvenv.cfg").write_text(f"home = {interpreter.parent}\nversion = {sys.version.split()[0]}\n")
    command = folder / "bin" / "modcube"
    # The release is renamed when it is complete, so nothing in it may contain its own path.
    command.write_text(
        '#!/bin/sh\nhere=$(dirname "$(readlink -f "$0")")\n'
        'exec "$here/python" -I -c "from firmware_py.__main__ import main; main()" "$@"\n'
    )
    command.chmod(0o755)
    return packages


def unpack(wheel: Path, packages: Path) -> None:
    """Unpacks a wheel into a site-packages folder (PEP 427), without scripts and headers."""
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            parts = name.split("/")
            place = name
            if parts[0].endswith(".data"):
                if len(parts) < 3 or parts[1] not in ("purelib", "platlib"):
                    continue
                place = "/".join(parts[2:])
            if name.endswith("/") or ".." in parts:
                continue
            target = packages / place
            target.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(name) as source, target.open("wb") as sink:
                shutil.copyfileobj(source, sink)
            os.utime(target, (FILE_TIME_S, FILE_TIME_S))


def compilers(wheels: Collection[str]) -> list[str]:
    """Wheels, by file name, of the COMPILERS among `wheels`; empty text where there is none."""
    return [next((wheel for wheel in wheels if wheel.startswith(f"{name}-")), "") for name in COMPILERS]


def carry_compiled(old: Path, new: Path) -> bool:
    """Copies numba's caches between site-packages folders if everything they were compiled from is the same; returns whether it was.

    A compiled function contains others, and constants, so all of them must be the same or no cache is copied.
    """
    cached = cached_sources(old, OWN_PACKAGES)
    if compiled_from(old, cached) != compiled_from(new, cached):
        return False
    for package in OWN_PACKAGES:
        for path in (old / package).rglob("__pycache__/*.nb[ic]"):
            target = new / path.relative_to(old)
            target.parent.mkdir(exist_ok=True)
            shutil.copyfile(path, target)
    return True


def compiled_from(packages: Path, cached: set[str]) -> dict[str, bytes]:
    """Contents, by path, of the files `cached`, our others that use numba, and those that either imports modules or constants from."""
    files = [path for package in OWN_PACKAGES for path in (packages / package).rglob("*.py") if b"numba" in path.read_bytes()]
    return transitive_sources(packages, cached | {str(path.relative_to(packages)) for path in files})


def file_digest(path: Path) -> str:
    """SHA-256 of a file; empty where there is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_whole(path: Path, text: str) -> None:
    """Writes a file atomically: after a power cut it has all of its text or none."""
    fresh = path.with_name(f"{path.name}.part")
    with fresh.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(fresh, path)
    sync_folder(path.parent)


def remove(path: Path) -> None:
    """Removes a file or link durably."""
    path.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Flushes renames and removals in `folder` to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def watcher() -> dict[str, object]:
    """Identity of this process, which no later process can share."""
    return {"pid": os.getpid(), "started": start_time(os.getpid()), "boot": boot_id()}


def watches(trial: dict[str, object]) -> bool:
    """Whether the process that began the trial still runs."""
    pid = trial.get("pid")
    return isinstance(pid, int) and trial.get("boot") == boot_id() and trial.get("started") == start_time(pid) != ""


def boot_id() -> str:
    """ID of the current boot of the machine."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def start_time(pid: int) -> str:
    """Start time of a process, in clock ticks since boot (proc(5), field 22); empty when there is no such process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""


def run(command: Sequence[str]) -> str:
    """Output of a command. Raises RefusedError with the last line of output when it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    except OSError as error:
        raise RefusedError(f"{command[0]}: {error.strerror}") from None
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()
        raise RefusedError(f"{Path(command[0]).name} {' '.join(command[1:3])}: {said[-1] if said else done.returncode}")
    return done.stdout
