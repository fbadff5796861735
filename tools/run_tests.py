"""Run every test that this machine can run; name what was left out, and why, in the last lines.

Arguments: the Debian packages that the tests marked `vcan` need. Those tests run in a virtual machine, in parallel with all others. Before
that, in parallel with the setup of the clients, `make lint` checks the code, and numba compiles what is not compiled yet, so that no two
processes of pytest do. The exit status is the worst of pytest's two and lint's.
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from command_line import run_tool

MAKEFILE = Path(__file__).resolve().parents[1] / "Makefile"
CLIENTS = Path(".venv-clients/.stamp")
"""Exists once every client is installed."""
PYTEST = [sys.executable, "-m", "pytest"]
ALL = [*PYTEST, "-n", "2", "--dist", "loadfile", "--no-loadscope-reorder"]
"""The fixtures of a file are set up in one process; the files with the long flights come first."""
COMPILE = [sys.executable, "-c", "import hil.batch, hil.bench"]
"""Nearly all numba functions are compiled on import."""
VCAN = [*PYTEST, "--capture=no", "-rs", "-m", "vcan", "tests/vcan"]


def is_installed(package: str) -> bool:
    """Whether dpkg has the package installed; False where there is no dpkg."""
    try:
        query = ["dpkg-query", "--show", "--showformat=${Status}", package]
        return subprocess.run(query, capture_output=True, text=True).stdout == "install ok installed"
    except FileNotFoundError:
        return False


def packages_of(makefile: str) -> list[str]:
    """Debian packages that the Makefile passes to this tool."""
    return "".join(re.findall(r"^SYSTEM_PACKAGES := (.*)$", makefile, re.MULTILINE)).split()


def main() -> int:
    if options := [word for word in sys.argv[1:] if word.startswith("-")]:
        print(f"run_tests: {options[0]}: no option is taken, only names of Debian packages", file=sys.stderr)
        return 2
    if strangers := sorted(set(sys.argv[1:]) - set(packages_of(MAKEFILE.read_text()))):
        what = f"{strangers[0]!r} is none of SYSTEM_PACKAGES in the Makefile"
        print(f"run_tests: {what}; for single tests: .venv/bin/python -m pytest ...", file=sys.stderr)
        return 2
    left_out = {"jetson": "they take half an hour (make test-flash)"}
    if missing := [package for package in sys.argv[1:] if not is_installed(package)]:
        left_out["vcan"] = f"missing Debian packages: {' '.join(missing)} (make setup-system)"
    make = [os.environ.get("MAKE", "make"), "--no-print-directory"]
    with tempfile.TemporaryFile("w+") as report:
        with subprocess.Popen(COMPILE, stdout=subprocess.DEVNULL), subprocess.Popen([*make, "lint"]) as lint:
            subprocess.run([*make, "setup-clients"])
        beside = None if missing else subprocess.Popen(VCAN, stdout=report, stderr=subprocess.STDOUT)
        if not CLIENTS.exists():
            left_out["clients"] = f"{CLIENTS.parent} is not complete (make setup-clients)"
        markers = " and ".join(f"not {marker}" for marker in sorted({"vcan", *left_out}))
        status = max(lint.returncode, subprocess.run([*ALL, "-m", markers]).returncode)
        if beside is not None:
            print("tests marked vcan, in the virtual machine:", flush=True)
            status = max(status, beside.wait())
            report.seek(0)
            print(report.read())
    if lint.returncode:
        print("the code is not clean: make lint")
    for marker, reason in left_out.items():
        print(f"left out: tests marked {marker}; {reason}")
    return status


if __name__ == "__main__":
    run_tool(main)
