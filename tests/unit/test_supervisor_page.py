"""The drawing of the supervisor in the docs is the one of the tables that run."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_drawn_supervisor_is_the_one_that_runs() -> None:
    """Else: .venv/bin/python tools/draw_supervisor.py."""
    script = ROOT / "tools" / "draw_supervisor.py"
    assert subprocess.run([sys.executable, script, "--check"], cwd=ROOT, check=False).returncode == 0
