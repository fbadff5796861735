"""A release with code compiled here for the guest's processor; in the emulated guest, compiling takes many minutes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.jetson.guest import ROOT

sys.path.insert(0, str(ROOT / "tools"))

import flash_files
from flash_device import Device
from flash_payload import make_payload

INTERPRETER = "/usr/bin/python3.11"
"""The guest's interpreter."""


def make_seed(folder: Path, cache: Path) -> Path:
    """The image of a disk with this checkout's release, compiled for the guest. Raises PayloadError and RefusedError."""
    os.environ["NUMBA_CPU_NAME"] = "generic"
    payload = make_payload("x86_64", "3.11", cache, offline=False)
    image = cache.parent / f"jetson-seed-{payload.release}"
    if image.exists():
        return image
    for old in cache.parent.glob("jetson-seed-*"):
        old.unlink()
    device = Device(folder / "root", flash_files.run)
    digests = payload.digests()
    for name in device.missing_wheels(digests):
        (device.wheels / name).symlink_to(next(wheel for wheel in payload.wheels if wheel.name == name))
    device.install(payload.release, digests, {})
    release = device.releases / payload.release
    link = release / "bin" / "python"
    link.unlink()
    link.symlink_to(INTERPRETER)
    (release / "pyvenv.cfg").write_text(f"home = {Path(INTERPRETER).parent}\n")
    made = folder / "seed"
    subprocess.run(
        ["mkfs.ext4", "-q", "-O", "^has_journal", "-d", release, made, "2G"],
        check=True, capture_output=True, env=os.environ | {"PATH": f"{os.environ['PATH']}:/usr/sbin:/sbin"},
    )  # fmt: skip
    shutil.move(made, image)
    return image
