"""The shipped payload: the lock, wheels for the vehicle's machine, compiled code, units."""

from __future__ import annotations

import shutil
import subprocess
import zipfile
from pathlib import Path

import flash_files
import flash_payload
import flash_units
import pytest
from flash_payload import PayloadError

DATA_SUFFIXES = (".toml", ".xml", ".service")


def test_lock_gives_every_package_that_the_vehicle_needs_and_no_bench_or_developer_tool() -> None:
    blocks = flash_payload.locked(flash_payload.ROOT / "requirements.lock")
    names = flash_payload.runtime_names()
    assert names <= set(blocks)
    assert {"numpy", "numba", "llvmlite", "daqp", "python-can", "cantools", "pymavlink", "foxglove-sdk"} <= names
    assert not names & {"pytest", "mypy", "optuna", "plotly", "cvxpy"}
    text = "\n".join(blocks[name] for name in sorted(names))
    pins = flash_payload.pins(text)
    assert "colorama" not in dict(pins)
    assert text.count("--hash=sha256:") >= len(pins)


def test_offline_names_the_first_wheel_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(PayloadError, match=r"no wheel of .* run once without --offline"):
        flash_payload.make_payload("aarch64", "3.11", tmp_path, offline=True)


FAST = "import numba\n\nfrom firmware_py.core.sizes import (\n    LENGTH,\n)\n"


def test_compiled_code_is_carried_over_only_if_all_its_sources_are_the_same(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    for folder in (old, new):
        (folder / "firmware_py" / "core").mkdir(parents=True)
        (folder / "firmware_py" / "core" / "fast.py").write_text(FAST)
        (folder / "firmware_py" / "core" / "sizes.py").write_text("LENGTH = 8\n")
        (folder / "firmware_py" / "core" / "slow.py").write_text(f"# {folder}\n")
    cache = old / "firmware_py" / "core" / "__pycache__"
    cache.mkdir()
    (cache / "fast.run-1.py311.nbi").write_text("index")
    for folder in (old, new):  # compiled by a decorator from another file, so it does not mention numba
        (folder / "firmware_py" / "core" / "decorated.py").write_text("")
    (cache / "decorated.run-1.py311.nbi").write_text("index")
    assert flash_files.carry_compiled(old, new)
    assert (new / "firmware_py/core/__pycache__/fast.run-1.py311.nbi").read_text() == "index"
    for name, text in (("fast", f"{FAST}  # another"), ("sizes", "LENGTH = 9\n"), ("decorated", "# another")):
        before = (new / f"firmware_py/core/{name}.py").read_text()
        (new / f"firmware_py/core/{name}.py").write_text(text)
        assert not flash_files.carry_compiled(old, new), name
        (new / f"firmware_py/core/{name}.py").write_text(before)


def test_compiled_code_is_made_of_the_files_that_it_takes_constants_from_too() -> None:
    used = flash_files.compiled_from(flash_payload.ROOT, set())
    assert {"firmware_py/bus/codec/crc.py", "firmware_py/bus/codec/message.py", "firmware_py/core/types.py"} < used.keys()
    assert "firmware_py/description/parameters.py" not in used, "every release changes it"


@pytest.mark.slow
def test_wheel_carries_the_wire_the_vehicles_the_dialect_and_the_units(tmp_path: Path) -> None:
    with zipfile.ZipFile(flash_payload.build_wheel(tmp_path)) as archive:
        names = set(archive.namelist())
    package = flash_payload.ROOT / "firmware_py"
    data = {str(path.relative_to(flash_payload.ROOT)) for path in package.rglob("*.*") if path.suffix in DATA_SUFFIXES}
    assert data | {"can_dbc/modcube.dbc", "firmware_py/deploy/modcube.service"} <= names


def test_guard_is_a_unit_that_systemd_understands(tmp_path: Path) -> None:
    (guard,) = flash_units.guard_unit(tmp_path).items()
    assert "@" not in guard[1]
    (tmp_path / guard[0]).write_text(guard[1])
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is missing")
    words = ["systemd-analyze", "verify", str(tmp_path / guard[0])]
    said = subprocess.run(words, capture_output=True, text=True, check=False).stderr
    assert "Unknown" not in said and f"{guard[0]}:" not in said, said


def test_enabled_interface_is_set_up_at_boot_and_whenever_it_is_plugged_in(tmp_path: Path) -> None:
    if shutil.which("systemctl") is None:
        pytest.skip("systemctl is missing")
    folder = tmp_path / "etc" / "systemd" / "system"
    shutil.copytree(flash_payload.ROOT / "firmware_py" / "deploy", folder)
    for unit in ("modcube-can@can1", "modcube"):  # as docs/jetson.md instructs, and as a flash does
        subprocess.run(["systemctl", f"--root={tmp_path}", "enable", "--quiet", unit], check=True)
    for name in ("can0", "can1"):
        for wanting in ("multi-user.target", f"sys-subsystem-net-devices-{name}.device"):
            assert (folder / f"{wanting}.wants" / f"modcube-can@{name}.service").is_symlink(), wanting
