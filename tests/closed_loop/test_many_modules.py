"""Sixty-four docked modules fly like one, in a separate process, in water that follows the controller's own model."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parents[2] / "tools" / "bench_fleet.py"


@pytest.mark.slow
@pytest.mark.parametrize("edge", [1, 2, 4])
def test_cube_of_modules_holds_its_place_in_the_current_within_300_megabytes(edge: int) -> None:
    """The program exits with an error if a body does not arm, disarms, or leaves out a healthy thruster."""
    done = subprocess.run([sys.executable, str(PROGRAM), str(edge)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert 1e-5 < found["strayed_m"] < 0.005
    assert 50.0 < found["memory_mb"] < 300.0
