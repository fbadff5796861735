"""The stand-in for the Jetson: a Debian guest with systemd and sshd behind a forwarded loopback port, on an instruction-counted clock."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
BOOT_S = 300.0
"""Longest wait for sshd: it takes 8 s on an idle machine, more under load."""
# The clock counts instructions: lateness inside does not depend on this machine's load (hil/guest/README.md).
COUNTED = ("-icount", "shift=0,sleep=off", "-accel", "tcg,thread=single,tb-size=512")


def missing_packages() -> list[str]:
    """Debian packages that the guest needs and this machine lacks."""
    said = subprocess.run([HERE / "prepare", "--missing"], capture_output=True, text=True, check=False).stdout
    return said.split()


class Guest:
    """One machine with its own disk in `folder`; a power cut loses everything not yet synced.

    `seed` is the image of a second disk, mounted at /opt/modcube/plant: a release with compiled code.
    """

    def __init__(self, folder: Path, seed: Path) -> None:
        self.folder, self.seed = folder, seed
        self.key = folder / "key"
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", self.key], check=True)
        # The image is made for one key, so every run uses the same key from the cache.
        cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "modcube"
        cache.mkdir(parents=True, exist_ok=True)
        kept = cache / "jetson-key"
        if not kept.exists():
            shutil.copy(self.key, kept)
            shutil.copy(f"{self.key}.pub", f"{kept}.pub")
        self.key = kept
        prepared = subprocess.run([HERE / "prepare", f"{kept}.pub"], capture_output=True, text=True, check=False)
        if prepared.returncode:
            raise RuntimeError(prepared.stderr.strip().splitlines()[-1])
        self.home = Path(prepared.stdout.strip())
        subprocess.run(["cp", "--sparse=always", "--reflink=auto", self.home / "disk", folder / "disk"], check=True)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        self._machine: subprocess.Popen[bytes] | None = None

    @property
    def options(self) -> list[str]:
        """Options for ssh."""
        known = f"UserKnownHostsFile={self.folder}/known_hosts"
        return ["-o", known, "-o", "StrictHostKeyChecking=accept-new", "-i", str(self.key)]

    def boot(self) -> None:
        """Powers on and waits until sshd answers. Raises RuntimeError with the end of the console's output."""
        console = self.folder / "console.log"
        machine = [
            "qemu-system-x86_64", "-M", "q35,usb=off", "-cpu", "Nehalem", "-m", "2048", *COUNTED,
            "-nodefaults", "-no-user-config", "-display", "none", "-no-reboot",
            "-kernel", self.home / "vmlinux", "-initrd", self.home / "initrd.cpio",
            "-append", "console=ttyS0 quiet panic=-1 mitigations=off nokaslr random.trust_cpu=on tsc=reliable",
            "-serial", f"file:{console}",
            "-drive", f"file={self.folder}/disk,if=virtio,format=raw,cache=unsafe",
            "-drive", f"file={self.seed},if=virtio,format=raw,cache=unsafe,readonly=on",
            "-netdev", f"user,id=net,restrict=on,hostfwd=tcp:127.0.0.1:{self.port}-:22",
            "-device", "virtio-net-pci,netdev=net,romfile=", "-device", "virtio-rng-pci",
        ]  # fmt: skip
        with (self.folder / "qemu.log").open("a") as log:
            self._machine = subprocess.Popen(machine, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        end = time.monotonic() + BOOT_S
        while time.monotonic() < end and self._machine.poll() is None:
            if self.run("systemctl is-system-running --wait >/dev/null; true", check=False).returncode == 0:
                return
            time.sleep(1.0)
        raise RuntimeError("the guest does not answer; its console:\n" + console.read_text(errors="replace")[-2000:])

    def check_on(self) -> None:
        """Raises RuntimeError with the end of qemu's output if the machine went off by itself."""
        if self._machine is not None and self._machine.poll() is not None:
            said = (self.folder / "qemu.log").read_text() + (self.folder / "console.log").read_text(errors="replace")
            raise RuntimeError(f"the guest went off, qemu's status {self._machine.returncode}: {said[-2000:]}")

    def cut_power(self) -> None:
        """Cuts the power."""
        if self._machine is not None:
            self._machine.kill()
            self._machine.wait()
            self._machine = None

    def run(self, script: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Runs a shell command on the machine."""
        self.check_on()
        words = ["ssh", "-o", "BatchMode=yes", "-o", "ConnectTimeout=60", "-p", str(self.port), *self.options]
        return subprocess.run([*words, "robot@127.0.0.1", script], capture_output=True, text=True, check=check)

    def flash_words(self, python: str, checkout: Path, *more: str) -> Sequence[Any]:
        """The command line of flash.py that flashes this machine."""
        patience = ("ConnectTimeout=120", "ServerAliveInterval=60")
        options = [f"--ssh-option={word}" for word in (*self.options[1:4:2], *patience)]
        return [
            python, checkout / "tools" / "flash.py", "robot@127.0.0.1", "--port", str(self.port),
            "--identity", str(self.key), *options, *more,
        ]  # fmt: skip
