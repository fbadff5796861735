"""The vehicle's systemd service: its state, its units, and whether it runs healthily after a start.

Uses only the standard library of Python 3.11; flash.py ships it beside flash_device.py.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from flash_files import RefusedError, UntouchedError, write_whole
from flash_units import as_root, installed_units

SERVICE = "modcube.service"
UNIT_FOLDER = Path("/etc/systemd/system")
HEALTHY_S = 5.0
"""How long a new release must run healthily."""
HEALTH_LIMIT_S = 60.0
"""Timeout for becoming healthy."""
POLL_S = 0.5
STATUS_FIELDS = ("ActiveState", "SubState", "MainPID", "NRestarts", "StatusText")


class Service:
    """The service on one vehicle; arguments as of flash_device.Device."""

    def __init__(
        self, root: Path, run: Callable[[Sequence[str]], str], sleep: Callable[[float], None], step: Callable[[str], None]
    ) -> None:
        self._root, self._run, self._sleep, self._step = root, run, sleep, step

    def state(self) -> dict[str, str]:
        """State of the service as reported by systemd; empty when systemd does not answer."""
        try:
            text = self._run(["systemctl", "show", SERVICE, *(f"--property={field}" for field in STATUS_FIELDS)])
        except RefusedError:
            return {}
        return dict(line.split("=", 1) for line in text.splitlines() if "=" in line)

    def check_disarmed(self) -> None:
        """Raises UntouchedError where the service controls an armed vehicle, or does not report that it is disarmed."""
        if line := in_flight(self.state()):
            raise UntouchedError(line)

    def installed(self, names: Iterable[str]) -> dict[str, str]:
        """Texts, by name, of those of the units `names` that systemd has."""
        return installed_units(names, UNIT_FOLDER)

    def install_units(self, units: dict[str, str], enabled: str) -> None:
        """Installs `units` (name -> text) in systemd and enables the unit `enabled` at boot. Raises RefusedError."""
        self._step("units")
        there = self.installed(units)
        for name, text in units.items():
            if there.get(name) != text:
                self._install_unit(name, text)
        if units:  # every time: an interrupted flash may have left only the files
            self._run([*as_root(), "systemctl", "daemon-reload"])
            self._run([*as_root(), "systemctl", "enable", "--quiet", enabled])

    def _install_unit(self, name: str, text: str) -> None:
        """Installs one unit atomically: after a power cut systemd's folder has the whole new text or the old one."""
        rendered, fresh = self._root / f"{name}.new", str(UNIT_FOLDER / f"{name}.new")
        write_whole(rendered, text)
        self._run([*as_root(), "install", "-m", "644", str(rendered), fresh])
        self._run([*as_root(), "sync", fresh])
        self._run([*as_root(), "mv", "-T", fresh, str(UNIT_FOLDER / name)])
        self._run([*as_root(), "sync", str(UNIT_FOLDER)])
        rendered.unlink()

    def start_and_wait(self) -> None:
        """Restarts the service and waits until it has run healthily for HEALTHY_S. Raises RefusedError."""
        self._step("restart")
        with contextlib.suppress(RefusedError):  # it may not be loaded yet
            self._run([*as_root(), "systemctl", "reset-failed", SERVICE])
        self._run([*as_root(), "systemctl", "restart", SERVICE])
        first: dict[str, str] = {}
        waited = well = 0.0
        while waited < HEALTH_LIMIT_S:
            self._step("health")
            now = self.state()
            if now.get("ActiveState") == "failed":
                raise RefusedError("the service failed")
            if first and (now.get("NRestarts"), now.get("MainPID")) != (first.get("NRestarts"), first.get("MainPID")):
                raise RefusedError("the service ended and was started again")
            if now.get("ActiveState") == "active" and ticks(now) is not None:
                moves = first and ticks(now) != ticks(first)
                first = first or now
                well = well + POLL_S if moves else well
                if well >= HEALTHY_S:
                    return
            self._sleep(POLL_S)
            waited += POLL_S
        raise RefusedError(f"no health report within {HEALTH_LIMIT_S:.0f} s")

    def start_without_waiting(self) -> None:
        """Has systemd start the service; where it refuses, nothing happens."""
        with contextlib.suppress(RefusedError):
            self._run([*as_root(), "systemctl", "--no-block", "restart", SERVICE])

    def stop(self) -> None:
        """Stops the service; where systemd refuses, nothing happens."""
        with contextlib.suppress(RefusedError):
            self._run([*as_root(), "systemctl", "stop", SERVICE])


def ticks(status: dict[str, str]) -> int | None:
    """The tick that the service last reported; None before its first report."""
    tick = report(status).get("tick", "")
    return int(tick) if tick.isdigit() else None


def report(status: dict[str, str]) -> dict[str, str]:
    """The KEY=VALUE words of the service's own report."""
    return dict(word.split("=", 1) for word in status.get("StatusText", "").split() if "=" in word)


def in_flight(status: dict[str, str]) -> str:
    """Reason why the service may not be stopped now, in one line; empty if it may: not running, not ticking yet, or no module armed."""
    if status.get("ActiveState") in ("inactive", "failed") or ticks(status) is None:
        return ""
    armed = report(status).get("armed", "")
    if armed.startswith("0/"):
        return ""
    what = f"{armed} modules are armed" if armed else "its release does not say whether it is armed"
    return f"{what}, and its service would be stopped: disarm it, or say --armed"
