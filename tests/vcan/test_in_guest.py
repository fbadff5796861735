"""Runs the folder's tests on a machine without vcan: boots the guest once and runs one pytest in it."""

import os
import shlex
import sys
from pathlib import Path

from tests.vcan.guest import FULL_LENGTH, Guest

FOLDER = str(Path(__file__).parent)
# Plug-ins cost seconds of import in the guest.
WITHOUT = [f"-pno:{name}" for name in ("cacheprovider", "hypothesispytest", "xdist", "xdist.looponfail")]
PYTEST = [sys.executable, "-m", "pytest", FOLDER, *WITHOUT]
TIMEOUT_S = 10_800 if FULL_LENGTH in os.environ else 2400


def test_everything_on_real_socketcan_passes_in_the_guest(guest: Guest) -> None:
    # Collecting imports everything that the tests import, which fills both caches of compiled code that the guest reads.
    warm_up = shlex.join([*PYTEST, "--collect-only", "-qq"]) + " >/dev/null"
    inner = [*PYTEST, "--capture=no", "-m", "vcan", "-rs", "--durations=5"]
    result = guest.run(inner, warm_up=warm_up, timeout_s=TIMEOUT_S, capture=False)
    assert result.returncode == 0, "in the guest (its report is above, or under captured output)"
