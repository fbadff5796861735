"""Files that survive a power cut, processes that cannot be mistaken, wheels without pip. Runs on the vehicle too.

Standard library of Python 3.11 alone, and a module of ours that is so too; flash.py ships both beside flash_device.py.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import zipfile
from collections.abc import Sequence
from pathlib import Path

from firmware_py.compiled_code import cached_sources, taken_in

FILE_TIME_S = 315532800
"""1980-01-01, of every file of a release: caches of compiled code know their source by time and size."""


OWN_PACKAGES = ("firmware_py", "hil")


class RefusedError(Exception):
    """Something cannot be done; one line."""


class UntouchedError(RefusedError):
    """It was not begun: everything runs as before."""


def unpack(wheel: Path, packages: Path) -> None:
    """A wheel's files into a site-packages folder (PEP 427); scripts and headers are left out."""
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


def carry_compiled(old: Path, new: Path) -> bool:
    """Copies numba's caches from one site-packages folder to another, if all that they were compiled from is the same there.

    One compiled function contains others, and constants, so that all of them have to be the same, or none is taken.
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
    """The files of `cached`, our others that use numba, and those that either imports modules or constants from, by place."""
    files = [path for package in OWN_PACKAGES for path in (packages / package).rglob("*.py") if b"numba" in path.read_bytes()]
    return taken_in(packages, cached | {str(path.relative_to(packages)) for path in files})


def file_digest(path: Path) -> str:
    """SHA-256 of a file; empty where there is none."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_whole(path: Path, text: str) -> None:
    """A file that is there with all of its text, or not at all."""
    fresh = path.with_name(f"{path.name}.part")
    with fresh.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(fresh, path)
    sync_folder(path.parent)


def remove(path: Path) -> None:
    """Away with a file or link, for good."""
    path.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """What was renamed or removed in `folder` is on the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def watcher() -> dict[str, object]:
    """This process, in a way that no later one can be mistaken for."""
    return {"pid": os.getpid(), "started": start_time(os.getpid()), "boot": boot_id()}


def watches(trial: dict[str, object]) -> bool:
    """Whether the process that began the trial still runs."""
    pid = trial.get("pid")
    return isinstance(pid, int) and trial.get("boot") == boot_id() and trial.get("started") == start_time(pid) != ""


def boot_id() -> str:
    """Of this boot of the machine."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def start_time(pid: int) -> str:
    """When a process started, in clock ticks since boot (proc(5), field 22); empty when there is none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""


def run(command: Sequence[str]) -> str:
    """A command's output. Raises RefusedError with its last line when it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    except OSError as error:
        raise RefusedError(f"{command[0]}: {error.strerror}") from None
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()
        raise RefusedError(f"{Path(command[0]).name} {' '.join(command[1:3])}: {said[-1] if said else done.returncode}")
    return done.stdout
