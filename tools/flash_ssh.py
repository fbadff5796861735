"""One vehicle over OpenSSH: runs commands there, streams files, reports errors in one line."""

from __future__ import annotations

import hashlib
import json
import subprocess
import tarfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from shlex import quote
from typing import IO, Any, cast

CONNECT_TIMEOUT_S = 10
OPTIONS = (
    "BatchMode=yes", f"ConnectTimeout={CONNECT_TIMEOUT_S}", "ServerAliveInterval=5", "ServerAliveCountMax=4",
)  # fmt: skip
TOOLS = Path(__file__).resolve().parent
PACKAGE = TOOLS.parent / "firmware_py"
DEVICE_FILES = {
    **{name: TOOLS / name for name in ("flash_device.py", "flash_files.py", "flash_service.py", "flash_units.py", "command_line.py")},
    "firmware_py/compiled_code.py": PACKAGE / "compiled_code.py",
    "firmware_py/__init__.py": PACKAGE / "runtime" / "__init__.py",
}
"""Files of flash_device.py by path in its folder. Includes an empty __init__.py because a package without one is found last, after any that
the vehicle's Python may have.
"""
LOST = 255
"""Exit status of ssh for its own errors."""
REASONS = (
    ("Could not resolve hostname", "there is no host of this name"),
    ("Permission denied", "it accepts none of your keys: try `ssh-copy-id {host}`"),
    ("REMOTE HOST IDENTIFICATION HAS CHANGED", "its host key has changed: if you know why, `ssh-keygen -R` it"),
    ("Host key verification failed", "its host key is unknown: connect once with `ssh {host}`"),
    ("Connection refused", "nothing listens for ssh there"),
    ("timed out", "it does not answer"),
    ("No route to host", "it cannot be reached from here"),
    ("Network is unreachable", "it cannot be reached from here"),
)


class VehicleError(Exception):
    """The vehicle cannot be reached, or refused, with a one-line message."""


class UntouchedError(VehicleError):
    """The vehicle refused before it began anything: it runs as before."""


class LostError(VehicleError):
    """The connection was lost while a command ran, which may still go on."""


class Vehicle:
    """A vehicle reached as USER@HOST.

    Args:
        host: as ssh takes it.
        options: further arguments for ssh, such as -p PORT.
        root: the folder for releases there.
    """

    def __init__(self, host: str, options: Sequence[str], root: str) -> None:
        self.host = host
        self.root = root
        self.python = "python3"
        # ssh uses the first value of an option that is given twice.
        self._ssh = ["ssh", *options, *(word for option in OPTIONS for word in ("-o", option)), host]

    def shell(self, script: str, data: bytes = b"") -> str:
        """Output of a shell command run there. Raises VehicleError."""
        try:
            done = subprocess.run([*self._ssh, script], input=data, capture_output=True, check=False)
        except OSError as error:
            raise VehicleError(f"ssh: {error.strerror}") from None
        output = done.stdout.decode(errors="replace")
        if done.returncode:
            raise self._error(done.returncode, done.stderr.decode(errors="replace"), output)
        return output

    def send(self, files: Mapping[str, Path], folder: str, progress: Callable[[int], None]) -> None:
        """Streams files (by their path there) into a folder there as one tar; passes byte counts to `progress`. Raises VehicleError."""
        command = [*self._ssh, f"mkdir -p {quote(folder)} && tar -x -C {quote(folder)}"]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as ssh:
            assert ssh.stdin is not None and ssh.stderr is not None
            pipe = cast(IO[bytes], _Counted(ssh.stdin, progress))
            with suppress(BrokenPipeError), tarfile.open(fileobj=pipe, mode="w|") as archive:
                for place, path in files.items():
                    archive.add(path, place, filter=_anonymous)
            with suppress(BrokenPipeError):  # from data not yet written; the pipe is closed in any case
                ssh.stdin.close()
            text = ssh.stderr.read().decode(errors="replace")
            ssh.stdin = None  # prevents another flush
        if ssh.returncode:
            raise self._error(ssh.returncode, text, "")

    def install_tools(self) -> None:
        """Installs the device's own scripts and switches to them atomically: the service needs them to start. Raises VehicleError."""
        digest = hashlib.sha256(b"".join(path.read_bytes() for path in DEVICE_FILES.values())).hexdigest()[:8]
        folder, link = f"tools/{digest}", quote(f"{self.root}/flash")
        self.send(DEVICE_FILES, f"{self.root}/{folder}", lambda size: None)
        self.shell(f"sync; rm -f {link}.new; ln -s {folder} {link}.new && mv -T {link}.new {link}")

    def device(self, command: str, given: Mapping[str, Any] | None = None) -> Any:
        """Runs a command of flash_device.py there; returns its result. Raises VehicleError."""
        words = [self.python, f"{self.root}/flash/flash_device.py", self.root, command]
        script = " ".join(quote(word) for word in words)
        try:
            text = self.shell(script, json.dumps(given or {}).encode())
        except LostError:
            raise
        except VehicleError as error:
            raise _refusal(str(error)) from None
        try:
            return json.loads(text.splitlines()[-1])["result"]
        except (ValueError, KeyError, IndexError):
            raise VehicleError(f"{self.host}: unexpected answer to {command}") from None

    def _error(self, status: int, stderr: str, stdout: str) -> VehicleError:
        if status == LOST:
            for sign, reason in REASONS:
                if sign in stderr:
                    return VehicleError(f"{self.host}: {reason.format(host=self.host)}")
            last = stderr.strip().splitlines()
            return LostError(f"{self.host}: connection lost{': ' + last[-1] if last else ''}")
        said = (stdout.strip() or stderr.strip()).splitlines()
        return VehicleError(said[-1] if said else f"{self.host}: a command ended with {status}")


def _refusal(text: str) -> VehicleError:
    """Error with the message from flash_device.py's own answer, or with the text as it is."""
    try:
        answer = json.loads(text)
        return (UntouchedError if answer.get("untouched") else VehicleError)(str(answer["error"]))
    except (ValueError, KeyError, TypeError, AttributeError):
        return VehicleError(text)


def _anonymous(entry: tarfile.TarInfo) -> tarfile.TarInfo:
    entry.uid = entry.gid = 0
    entry.uname = entry.gname = ""
    entry.mode = 0o644
    return entry


class _Counted:
    """Sink for tarfile that counts the bytes written through it."""

    def __init__(self, sink: IO[bytes], progress: Callable[[int], None]) -> None:
        self._sink, self._progress = sink, progress

    def write(self, data: bytes) -> int:
        """Writes all of `data`."""
        self._sink.write(data)
        self._progress(len(data))
        return len(data)
