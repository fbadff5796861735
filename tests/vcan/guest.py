"""The guest from outside: the packages it lacks, and one call that boots it, runs a command and returns the result."""

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FULL_LENGTH = "MODCUBE_FULL"
"""Environment variable. Set: full lengths and counts, for `make accept`; not set: reduced ones."""
RUN = ROOT / "hil" / "guest" / "run"


def missing_packages() -> list[str]:
    """The Debian packages that the guest needs and this machine lacks."""
    prepare = str(RUN.with_name("prepare"))
    return subprocess.run([prepare, "--missing"], capture_output=True, text=True, check=False).stdout.split()


class Guest:
    """Runs commands in a freshly booted guest; nothing persists between two calls except the files in `out`."""

    def run(
        self,
        command: Sequence[str],
        *,
        counted: bool = False,
        processors: int = 1,
        warm_up: str = "",
        out: Path | None = None,
        timeout_s: int = 600,
        capture: bool = True,
    ) -> subprocess.CompletedProcess[str]:
        """Boots, runs `command` in the repository's root, powers off.

        Args:
            counted: the guest's clock counts instructions, so that lateness does not depend on this machine's load.
            processors: number of the guest's processors; 1 when counted.
            warm_up: shell command run outside first, to fill the cache of compiled code that the guest reads.
            out: receives the files that the command leaves in $VG_OUT.
            timeout_s: time after which the guest is terminated.
            capture: whether stdout and stderr are returned; otherwise they go to those of this process.

        Returns:
            returncode: the command's; 124 timeout, 125 the guest did not finish, 126 it could not be prepared.
        """
        switches = {"VG_SMP": str(processors), "VG_TIMEOUT": str(timeout_s), "VG_WARM": warm_up}
        switches["VG_PASS"] = f"{FULL_LENGTH} {os.environ.get('VG_PASS', '')}"
        switches |= {"VG_COUNTED": "1"} if counted else {}
        switches |= {"VG_OUT": str(out)} if out else {}
        return subprocess.run(
            [str(RUN), *command], cwd=ROOT, env=os.environ | switches, capture_output=capture, text=True, check=False
        )
