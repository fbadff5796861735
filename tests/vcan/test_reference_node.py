"""The C reference node, a process on vcan0, flies the hover in real time."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.vcan.guest import ROOT, Guest

HOVER_S = 6
PROGRAM = str(Path(__file__).with_name("reference_node_program.py"))


@pytest.mark.slow
def test_c_node_flies_the_hover_over_vcan0_in_real_time(guest: Guest, tmp_path: Path) -> None:
    if shutil.which("gcc") is None:
        pytest.skip("gcc is missing (make setup-system)")
    make = ["make", "-C", str(ROOT / "hil/reference_node"), f"BUILD={tmp_path}", f"PYTHON={sys.executable}"]
    subprocess.run(make, check=True, capture_output=True)
    # Composing the firmware compiles what the guest then finds in its cache.
    warm_up = f"{sys.executable} -c 'import tests.vcan.reference_node_program'"
    command = [sys.executable, "-m", "tests.vcan.reference_node_program", str(tmp_path / "modcube_node"), str(HOVER_S)]
    result = guest.run(command, counted=True, warm_up=warm_up, out=tmp_path / "out", timeout_s=1200)
    assert result.returncode == 0, result.stderr[-3000:]
    flight = json.loads((tmp_path / "out" / "flight.json").read_text())
    assert flight["metrics"]["position_rmse_m"] <= 0.008
    assert flight["unanswered"] <= 5
