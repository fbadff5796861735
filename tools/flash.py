"""Installs this checkout's release on a vehicle, over OpenSSH.

Builds the wheel, ships it with its locked dependencies, installs it into a release folder of its own, switches the service to it, waits for
its health report, and rolls back to the previous release when there is none.

    .venv/bin/python tools/flash.py USER@HOST              flash
    .venv/bin/python tools/flash.py USER@HOST --dry-run    check everything, change nothing
    .venv/bin/python tools/flash.py USER@HOST --offline    from the cache of wheels alone, without any registry
    .venv/bin/python tools/flash.py USER@HOST --status     what is installed and how it runs
    .venv/bin/python tools/flash.py USER@HOST --rollback   back to the release before
    .venv/bin/python tools/flash.py USER@HOST --armed      also while it is armed: the service is stopped in flight

Exit status: 0 done, 1 switch failed (the old release runs again) or connection lost meanwhile, 2 cannot run (nothing was changed).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

from command_line import Parser, run_tool

from flash_payload import Payload, PayloadError, make_payload
from flash_service import in_flight
from flash_ssh import LostError, UntouchedError, Vehicle, VehicleError

UNPACKED = 4.0
"""Bytes on the vehicle's disk per byte of wheel, including compiled code (3.3 measured)."""
MACHINES = ("aarch64", "x86_64")
PROBE = """
echo machine=$(uname -m)
for python in {pythons}; do
    path=$(command -v $python) || continue
    version=$($path -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || continue
    case $version in 3.1[1-4]) echo python=$path; echo version=$version; break;; *) echo old=$version;; esac
done
folder={root}
while [ ! -d "$folder" ]; do folder=$(dirname "$folder"); done
[ -w "$folder" ] && echo writable=yes
echo free_kb=$(df -Pk "$folder" | awk 'NR == 2 {{print $4}}')
command -v tar >/dev/null && echo tar=yes
systemctl --version >/dev/null 2>&1 && echo systemd=yes
{{ [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }} && echo root=yes
true
"""


class Target(NamedTuple):
    """Properties of a vehicle, as found by `inspect`."""

    machine: str
    python: str
    version: str
    free_bytes: int


class FlashError(Exception):
    """The vehicle cannot take the release, with a one-line message. Nothing was changed."""


def inspect(vehicle: Vehicle, pythons: str) -> Target:
    """Examines a vehicle without changing it. Raises VehicleError and FlashError."""
    text = vehicle.shell(PROBE.format(pythons=pythons, root=quote(vehicle.root)))
    found = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
    host = vehicle.host
    if found.get("machine") not in MACHINES:
        raise FlashError(f"{host}: is {found.get('machine', 'of unknown architecture')}; needs {' or '.join(MACHINES)}")
    if "python" not in found:
        has = f"it has {found['old']}" if "old" in found else "it has none"
        raise FlashError(f"{host}: needs Python 3.11 or newer, {has} (docs/jetson.md says how to get it)")
    for needed, what in (
        ("tar", "tar is missing there"),
        ("systemd", "it does not run systemd"),
        ("root", "you may not run sudo without a password there (docs/jetson.md)"),
        ("writable", f"you may not write to {vehicle.root} (sudo install -d -o $USER {vehicle.root})"),
    ):
        if needed not in found:
            raise FlashError(f"{host}: {what}")
    vehicle.python = found["python"]
    return Target(found["machine"], found["python"], found["version"], 1024 * int(found["free_kb"] or 0))


def check_room(vehicle: Vehicle, target: Target, payload: Payload) -> None:
    """Raises FlashError when the disk is too small for a whole additional release."""
    needed = round(payload.size_bytes * UNPACKED)
    if target.free_bytes < needed:
        raise FlashError(
            f"{vehicle.host}: {target.free_bytes / 1e6:.0f} MB free for {vehicle.root}, needs {needed / 1e6:.0f} MB"
        )


def ship(vehicle: Vehicle, target: Target, payload: Payload, armed: bool, say: Callable[[str], None]) -> None:
    """Sends the missing wheels and installs the release beside the running one; `armed`: even while armed. Raises VehicleError."""
    vehicle.install_tools()
    digests = payload.digests()
    missing = set(vehicle.device("missing", {"wheels": digests, "armed": armed}))
    wheels = [wheel for wheel in payload.wheels if wheel.name in missing]
    total = sum(wheel.stat().st_size for wheel in wheels)
    say(f"2/4 ship {len(wheels)} of {len(payload.wheels)} wheels, {total / 1e6:.1f} MB")
    if wheels:
        vehicle.send({wheel.name: wheel for wheel in wheels}, f"{vehicle.root}/wheels", progress_of(total, say))
    say(f"3/4 install {payload.release}")
    facts = {"machine": target.machine, "python": target.version}
    vehicle.device("install", {"release": payload.release, "wheels": digests, "facts": facts})


def progress_of(total: int, say: Callable[[str], None]) -> Callable[[int], None]:
    """Returns a callback that reports every fifth of `total` bytes."""
    done = [0]

    def progress(size: int) -> None:
        before = 5 * done[0] // max(total, 1)
        done[0] += size
        if before < 5 * done[0] // max(total, 1) < 5:
            say(f"    {100 * done[0] / total:.0f} %")

    return progress


def flash(vehicle: Vehicle, given: argparse.Namespace, say: Callable[[str], None]) -> int:
    """Builds, ships, installs and activates a release; returns the exit status. Raises VehicleError, PayloadError and FlashError."""
    target = inspect(vehicle, given.python)
    say(f"1/4 build for {target.machine}, Python {target.version}")
    payload = make_payload(target.machine, target.version, given.cache, given.offline)
    check_room(vehicle, target, payload)
    if given.dry_run:
        if was_flashed(vehicle):
            check_disarmed(vehicle, vehicle.device("status")["service"], given.armed)
        size = payload.size_bytes / 1e6
        say(f"dry run: would install {payload.release} ({len(payload.wheels)} wheels, {size:.0f} MB) in {vehicle.root}")
        return 0
    ship(vehicle, target, payload, given.armed, say)
    say("4/4 switch, restart, wait for the health report")
    return switch(vehicle, say, "activate", {"release": payload.release, "armed": given.armed})


def switch(vehicle: Vehicle, say: Callable[[str], None], command: str, given: Mapping[str, Any]) -> int:
    """Makes the vehicle activate a release or roll back; returns the exit status. Raises UntouchedError where the vehicle refused before it
    began: after any other error it is uncertain whether something was changed.
    """
    try:
        release = vehicle.device(command, given)
    except LostError as error:
        return refuse(f"{error}; the vehicle goes on by itself: see --status", 1)
    except UntouchedError:
        raise
    except VehicleError as error:
        return refuse(str(error), 1)
    say(f"{vehicle.host} runs {release}")
    return 0


def status_lines(vehicle: Vehicle) -> list[str]:
    """Lines that `--status` prints. Raises VehicleError and FlashError."""
    found = vehicle.device("status")
    service = found["service"]
    lines = [f"current   {found['current'] or 'none'}{' (on trial)' if found['trial'] else ''}"]
    lines.append(f"previous  {found['previous'] or 'none'}")
    lines.append(f"releases  {', '.join(found['releases']) or 'none'}")
    state = f"{service.get('ActiveState', 'unknown')} {service.get('SubState', '')}".strip()
    lines.append(f"service   {state}, restarts {service.get('NRestarts', '?')}")
    return [*lines, f"report    {service.get('StatusText') or 'none'}"]


def was_flashed(vehicle: Vehicle) -> bool:
    """Whether the vehicle was ever flashed, so that it can answer commands. Raises VehicleError."""
    return bool(vehicle.shell(f"test -e {quote(vehicle.root)}/flash/flash_device.py && echo yes || true").strip())


def check_disarmed(vehicle: Vehicle, service: dict[str, str], armed: bool) -> None:
    """Raises FlashError where the service may not be stopped, unless `armed` permits that."""
    if not armed and (line := in_flight(service)):
        raise FlashError(f"{vehicle.host}: {line}")


def look_or_go_back(vehicle: Vehicle, given: argparse.Namespace, say: Callable[[str], None]) -> int:
    """Runs --status and --rollback; returns the exit status. Raises VehicleError and FlashError."""
    inspect(vehicle, given.python)
    if not was_flashed(vehicle):
        raise FlashError(f"{vehicle.host}: nothing was ever flashed to {vehicle.root}")
    if given.status:
        for line in status_lines(vehicle):
            say(line)
        return 0
    found = vehicle.device("status")
    if not found["previous"] and not found["trial"]:
        raise FlashError(f"{vehicle.host}: there is no earlier release to go back to")
    check_disarmed(vehicle, found["service"], given.armed)
    return switch(vehicle, say, "rollback", {"armed": given.armed})


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command line."""
    parser = Parser(prog="flash", description="Puts this checkout's release on a vehicle, over OpenSSH.")
    parser.add_argument("host", metavar="USER@HOST", help="vehicle, as given to ssh")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--status", action="store_true", help="print which releases are installed and the state of the service")
    what.add_argument("--rollback", action="store_true", help="switch back to the previous release")
    what.add_argument("--dry-run", action="store_true", help="check everything and change nothing")
    parser.add_argument("--armed", action="store_true", help="permit flashing an armed vehicle: its service is stopped in flight")
    parser.add_argument("--offline", action="store_true", help="use wheels from the cache only")
    parser.add_argument("--root", default="/opt/modcube", help="folder of the releases on the vehicle")
    parser.add_argument("--python", default="python3.12 python3.11 python3", help="Python interpreters to try on the vehicle, in order")
    parser.add_argument("--port", type=int, help="ssh port")
    parser.add_argument("--identity", type=Path, help="ssh private key file")
    parser.add_argument(
        "--ssh-option", action="append", default=[], metavar="KEY=VALUE", help="option passed to ssh -o; may be given more than once"
    )
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "modcube" / "wheels"
    parser.add_argument("--cache", type=Path, default=cache, help="folder for downloaded wheels")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the tool; returns its exit status."""
    given = parse(arguments)
    options = [word for option in given.ssh_option for word in ("-o", option)]
    options += ["-p", str(given.port)] if given.port else []
    options += ["-i", str(given.identity)] if given.identity else []
    vehicle = Vehicle(given.host, options, given.root)

    def say(line: str) -> None:
        print(line, flush=True)

    try:
        if given.status or given.rollback:
            return look_or_go_back(vehicle, given, say)
        return flash(vehicle, given, say)
    except (VehicleError, PayloadError, FlashError) as error:
        return refuse(str(error), 2)
    except OSError as error:
        return refuse(f"{error.filename}: {error.strerror}", 2)


def refuse(line: str, status: int) -> int:
    """Prints one line on stderr; returns `status`."""
    print(f"flash: {line}", file=sys.stderr)
    return status


if __name__ == "__main__":
    run_tool(main)
