"""The vehicle's systemd units: those of a release, those installed, and the guard unit that is the same for all releases.

Uses only the standard library of Python 3.11; flash.py ships it beside flash_device.py.
"""

from __future__ import annotations

import os
import pwd
import sys
from collections.abc import Iterable
from pathlib import Path

GUARD = "modcube-boot.service"
GUARD_TEXT = """\
# Before every start of the service: takes back a release whose trial nobody watches any more. Installed by tools/flash.py, and no
# part of a release: what puts units back must not be started by one of them (a daemon-reload amid ExecStartPre= loses its place).
[Unit]
Description=modcube: takes back a release that has not proved itself
Before=modcube.service
RequiresMountsFor=@ROOT@
StartLimitIntervalSec=0

[Service]
Type=oneshot
User=@USER@
ExecStart=@PYTHON@ @ROOT@/flash/flash_device.py @ROOT@ boot
TimeoutStartSec=60

[Install]
# By the target as well: the service's unit on trial may be one that systemd refuses.
WantedBy=modcube.service multi-user.target
"""


def guard_unit(root: Path) -> dict[str, str]:
    """Text, by name, of the unit that runs `boot`."""
    return {GUARD: filled_in(GUARD_TEXT, root)}


def release_units(release: Path, root: Path) -> dict[str, str]:
    """Texts, by name, of the units that a release brings."""
    found = sorted(release.glob("lib/python*/site-packages/firmware_py/deploy/*.service"))
    return {unit.name: filled_in(unit.read_text(), root) for unit in found}


def installed_units(names: Iterable[str], folder: Path) -> dict[str, str]:
    """Texts, by name, of the units in systemd's folder; leaves out missing ones, and empty ones as a power cut may have left them."""
    texts = {name: (folder / name).read_text(errors="replace") for name in names if (folder / name).is_file()}
    return {name: text for name, text in texts.items() if text}


def filled_in(text: str, root: Path) -> str:
    """Text of a unit with the vehicle's own values filled in."""
    for word, value in unit_words(root).items():
        text = text.replace(word, value)
    return text


def unit_words(root: Path) -> dict[str, str]:
    """Values of the @WORDS@ in the units: folder of the releases, their owner, the interpreter, and the processors that may run them."""
    count = os.cpu_count() or 1
    return {
        "@ROOT@": str(root),
        "@USER@": pwd.getpwuid(os.getuid()).pw_name,
        "@PYTHON@": sys.executable,
        "@CPUS@": f"1-{count - 1}" if count > 2 else f"0-{count - 1}",  # the first handles the interrupts
    }


def as_root() -> list[str]:
    """Prefix of a command that only root may run."""
    return [] if os.geteuid() == 0 else ["sudo", "-n"]
