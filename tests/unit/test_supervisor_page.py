"""The drawing of the supervisor in the docs matches the tables in the code."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_drawn_supervisor_is_the_one_that_runs() -> None:
    """If it fails, run .venv/bin/python tools/draw_supervisor.py."""
    script = ROOT / "tools" / "draw_supervisor.py"
    assert subprocess.run([sys.executable, script, "--check"], cwd=ROOT, check=False).returncode == 0
