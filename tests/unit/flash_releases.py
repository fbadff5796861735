"""Small releases for the tests of flashing."""

from __future__ import annotations

import zipfile
from pathlib import Path

import flash_files
from flash_device import Device

GOOD, BETTER, BROKEN = "1.0-good", "1.1-better", "1.2-broken"


def wheel(folder: Path, release: str) -> Path:
    """Writes a small wheel that stands in for the project's own; returns its path."""
    path = folder / f"modcube-{release.replace('-', '_')}-py3-none-any.whl"
    files = {
        "firmware_py/__init__.py": "",
        "firmware_py/__main__.py": f"def main():\n    print({release!r})\n" + "#" * 2000,
        "firmware_py/deploy/modcube.service": unit_of(release),
        "modcube-1.data/purelib/extra.py": "",
        "modcube-1.data/scripts/left_out": "",
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in {**files, **({"broken": ""} if "broken" in release else {})}.items():
            archive.writestr(zipfile.ZipInfo(name), text)
    return path


def unit_of(release: str) -> str:
    """The unit file of the service, different in every release."""
    return f"[Service]\nExecStart=modcube run --of {release}\n"


def current(fake: Path, root: str = "root") -> str | None:
    """Returns the release that is linked as the current one."""
    return Device(fake / root, flash_files.run).linked(fake / root / "current")
