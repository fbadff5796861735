"""Payload of a flash: the project's wheel and those of its locked dependencies, for the vehicle's own Python.

Wheels are fetched once into a cache, by the hashes of requirements.lock; the vehicle needs no network and no pip.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name, parse_wheel_filename

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ("firmware_py", "hil", "can_dbc", "pyproject.toml", "LICENSE")
GLIBC_VERSIONS = (28, 27, 26, 24, 17)
"""manylinux_2_N tags to accept, newest first; Ubuntu 22.04 of JetPack 6 has glibc 2.35, Debian 12 2.36."""


class PayloadError(Exception):
    """The payload cannot be made, with a one-line message."""


class Payload(NamedTuple):
    """One release and its wheels."""

    release: str
    wheels: tuple[Path, ...]

    def digests(self) -> dict[str, str]:
        """SHA-256 by file name."""
        return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in self.wheels}

    @property
    def size_bytes(self) -> int:
        """Total size of the wheels."""
        return sum(path.stat().st_size for path in self.wheels)


def make_payload(machine: str, python: str, cache: Path, offline: bool) -> Payload:
    """Makes the release of this checkout for `machine` (aarch64, x86_64) and `python` ("3.11").

    Args:
        cache: folder of wheels fetched earlier.
        offline: take wheels from the cache alone.

    Raises:
        PayloadError: the wheel does not build, or a wheel is missing.
    """
    wheel_dir = cache / f"{machine}-cp{python.replace('.', '')}"
    wheel_dir.mkdir(parents=True, exist_ok=True)
    blocks = locked(ROOT / "requirements.lock")
    text = "\n".join(blocks[name] for name in sorted(runtime_names() & set(blocks)))
    fetch(text, wheel_dir, machine, python, offline)
    own = build_wheel(cache)
    wheels = (own, *sorted(wheels_of(text, wheel_dir)))
    return Payload(release_name(own, text), wheels)


def release_name(own: Path, lock: str) -> str:
    """Version and a hash of the contents: the same sources and lock give the same name."""
    whole = hashlib.sha256(lock.encode())
    with zipfile.ZipFile(own) as archive:
        for name in sorted(archive.namelist()):
            if not name.endswith("/RECORD"):
                whole.update(name.encode() + b"\0" + archive.read(name))
    return f"{parse_wheel_filename(own.name)[1]}-{whole.hexdigest()[:8]}"


def build_wheel(cache: Path) -> Path:
    """Builds the project's own wheel from a clean copy: build/ in a checkout keeps deleted modules."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "source")
        source.mkdir()
        for name in SHIPPED:
            path = ROOT / name
            ignored = shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc")
            shutil.copytree(path, source / name, ignore=ignored) if path.is_dir() else shutil.copy(path, source)
        out = cache / "own"
        shutil.rmtree(out, ignore_errors=True)
        pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(out), str(source))
    return next(out.glob("*.whl"))


def locked(path: Path) -> dict[str, str]:
    """Blocks of a lock file by canonical name: the pin, its marker and its hashes."""
    blocks: dict[str, str] = {}
    for block in re.split(r"\n(?=[A-Za-z0-9])", path.read_text()):
        lines = [line for line in block.splitlines() if not line.lstrip().startswith("#")]
        if lines and "==" in lines[0]:
            name = canonicalize_name(re.split(r"[=\s;\[]", lines[0])[0])
            blocks[name] = blocks.get(name, "") + "\n".join(lines) + "\n"
    return blocks


def runtime_names() -> set[str]:
    """Names of everything that the project needs to run, without its extras, found by walking the packages installed here."""
    found: set[str] = set()
    waiting = ["modcube"]
    while waiting:
        name = canonicalize_name(waiting.pop())
        if name in found:
            continue
        found.add(name)
        waiting += requirements_of(name)
    return found - {"modcube"}


def requirements_of(name: str) -> Iterator[str]:
    """Names that the distribution `name` requires without extras; none where it is not installed."""
    try:
        lines = metadata.requires(name) or []
    except metadata.PackageNotFoundError:
        return
    for line in lines:
        requirement = Requirement(line)
        if requirement.marker is None or "extra" not in str(requirement.marker):
            yield requirement.name


def platforms(machine: str) -> list[str]:
    """Platform tags that a wheel may have."""
    tags = [f"manylinux_2_{n}_{machine}" for n in GLIBC_VERSIONS]
    return [*tags, f"manylinux2014_{machine}", f"linux_{machine}"]  # 2014: alias of 2_17


def fetch(lock: str, wheel_dir: Path, machine: str, python: str, offline: bool) -> None:
    """Downloads the locked wheels that are missing in `wheel_dir`. Raises PayloadError."""
    missing = [line for line in pins(lock) if not wheel_of(*line, wheel_dir)]
    if not missing:
        return
    if offline:
        name, version = missing[0]
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise PayloadError(f"no wheel of {name} {version}{more} in {wheel_dir}: run once without --offline")
    with tempfile.NamedTemporaryFile("w", suffix=".lock") as file:
        file.write(lock)
        file.flush()
        choice = [word for tag in platforms(machine) for word in ("--platform", tag)]
        pip(
            "download", "--no-deps", "--require-hashes", "--only-binary=:all:", "--dest", str(wheel_dir),
            "--implementation", "cp", "--python-version", python, *choice, "--requirement", file.name,
        )  # fmt: skip


def pins(lock: str) -> list[tuple[str, str]]:
    """(name, version) of the lock's lines that apply to a Linux vehicle."""
    found: list[tuple[str, str]] = []
    for line in lock.splitlines():
        if "==" not in line or line.startswith(" "):
            continue
        requirement = Requirement(line.rstrip("\\ "))
        marker = requirement.marker
        if marker is None or marker.evaluate({"sys_platform": "linux", "platform_system": "Linux"}):
            found.append((canonicalize_name(requirement.name), next(iter(requirement.specifier)).version))
    return found


def wheel_of(name: str, version: str, wheel_dir: Path) -> Path | None:
    """Wheel of one pin; None if it is missing."""
    for path in wheel_dir.glob("*.whl"):
        if (canonicalize_name(path.name.split("-")[0]), path.name.split("-")[1]) == (name, version):
            return path
    return None


def wheels_of(lock: str, wheel_dir: Path) -> list[Path]:
    """Wheels of all pins that are present."""
    return [path for pin in pins(lock) if (path := wheel_of(*pin, wheel_dir)) is not None]


def pip(*words: str) -> None:
    """Runs this environment's pip. Raises PayloadError with its last error line."""
    command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *words]
    environment = os.environ | {"SOURCE_DATE_EPOCH": "315532800", "PIP_NO_INPUT": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        said: Sequence[str] = [line for line in done.stderr.splitlines() if line.startswith("ERROR")] or ["failed"]
        raise PayloadError(f"pip {words[0]}: {said[-1].removeprefix('ERROR: ')}")
