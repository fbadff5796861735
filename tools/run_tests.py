"""Run every test that this machine can run; name what was left out, and why, in the last lines.

Arguments: the Debian packages that the tests marked `vcan` need. The exit status is pytest's.
"""

import subprocess
import sys
from pathlib import Path

CLIENTS = Path(".venv-clients/bin/python")


def is_installed(package: str) -> bool:
    """Whether dpkg has the package; False where there is no dpkg."""
    try:
        query = ["dpkg-query", "--show", "--showformat=${Status}", package]
        return subprocess.run(query, capture_output=True, text=True).stdout == "install ok installed"
    except FileNotFoundError:
        return False


def main() -> int:
    left_out = {"jetson": "they take half an hour (make test-flash)"}
    left_out["vcan"] = "whole flights in an emulated machine take long (make test-vcan)"
    if missing := [package for package in sys.argv[1:] if not is_installed(package)]:
        left_out["vcan"] = f"missing Debian packages: {' '.join(missing)} (make setup-system, then make test-vcan)"
    if not CLIENTS.exists():
        left_out["clients"] = f"missing {CLIENTS.parts[0]} (make setup-clients)"
    markers = " and ".join(f"not {marker}" for marker in left_out)
    status = subprocess.run([sys.executable, "-m", "pytest", "-n", "2", "-m", markers]).returncode
    for marker, reason in left_out.items():
        print(f"left out: tests marked {marker}; {reason}")
    return status


if __name__ == "__main__":
    sys.exit(main())
