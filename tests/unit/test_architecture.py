"""Rules of the architecture: which packages may import which, and what core must never do.

import-linter checks the contracts of pyproject.toml; this file checks what they cannot express.
"""

import ast
import importlib.util
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CORE_LIBRARIES = {"numpy", "numba", "filterpy", "daqp"}
CORE_FIRMWARE = {"firmware_py.core", "firmware_py.description"}
CORE_BANNED_STDLIB = {"time", "socket", "threading", "asyncio", "random", "logging"}
FILE_ACCESS = {"open", "read_bytes", "read_text", "write_bytes", "write_text"}
SEEDED_RANDOM = {"default_rng", "Generator", "SeedSequence", "PCG64"}
PLANT_MAY_IMPORT = {
    "firmware_py.description",
    "firmware_py.core.rotations",
    "firmware_py.bus.codec",
    "firmware_py.bus.port",
}
BENCH_MAY_IMPORT = PLANT_MAY_IMPORT | {
    "firmware_py.app",
    "firmware_py.prepare",
    "firmware_py.runtime",
    "firmware_py.core.setpoint",
    "firmware_py.core.transitions",
    "firmware_py.core.types",
}
# `(?<!...)` keeps addresses such as example.org/home/page out.
MACHINE_PATH = re.compile(rb"(?<![\w.~})-])/(?:work|root|home)/")


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules(package: str) -> dict[str, Path]:
    """Every module of a package in the checkout, the package itself included."""
    return {module_name(path): path for path in sorted((ROOT / package).rglob("*.py"))}


def is_within(module: str, packages: set[str]) -> bool:
    return any(module == package or module.startswith(package + ".") for package in packages)


def imported_modules(path: Path) -> Iterator[str]:
    package = module_name(path) if path.name == "__init__.py" else module_name(path).rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(), path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            source = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            yield from (f"{source}.{alias.name}" for alias in node.names)


def contract(contract_id: str) -> dict[str, list[str]]:
    linter = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    return next(each for each in linter["contracts"] if each["id"] == contract_id)


@pytest.mark.slow
def test_import_contracts_are_kept() -> None:
    lint_imports = Path(sys.executable).with_name("lint-imports")
    result = subprocess.run([lint_imports, "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


def test_no_contract_has_ignores() -> None:
    assert "ignore_imports" not in (ROOT / "pyproject.toml").read_text()


@pytest.mark.slow
def test_core_imports_only_what_may_run_in_a_tick() -> None:
    stdlib = set(sys.stdlib_module_names) - CORE_BANNED_STDLIB
    refused = [
        f"{name} imports {imported}"
        for name, path in modules("firmware_py/core").items()
        for imported in imported_modules(path)
        if imported.partition(".")[0] not in stdlib | CORE_LIBRARIES and not is_within(imported, CORE_FIRMWARE)
    ]
    assert not refused


def test_core_opens_no_file() -> None:
    refused = [
        f"{path.name}:{node.lineno}"
        for path in modules("firmware_py/core").values()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        and (getattr(node.func, "id", None) == "open" or getattr(node.func, "attr", None) in FILE_ACCESS)
    ]
    assert not refused


@pytest.mark.slow
@pytest.mark.parametrize("package", ["firmware_py", "hil"])
def test_random_numbers_come_from_seeded_generators(package: str) -> None:
    refused = []
    for name, path in modules(package).items():
        used = [each for each in imported_modules(path) if each.startswith("numpy.random")]
        used += [
            ast.unparse(node).replace("np.", "numpy.", 1)
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) in {"np.random", "numpy.random"}
        ]
        refused += [f"{name} uses {each}" for each in used if each.rpartition(".")[2] not in SEEDED_RANDOM]
    assert not refused


def test_every_hil_module_is_named_in_a_contract() -> None:
    named = set(contract("plant-is-independent")["source_modules"] + contract("bench-uses-app")["source_modules"])
    unnamed = [name for name in modules("hil") if name != "hil" and not is_within(name, named)]
    assert not unnamed, f"add to source_modules of a hil contract in pyproject.toml: {', '.join(unnamed)}"


@pytest.mark.parametrize(
    ("contract_id", "allowed"),
    [
        ("plant-is-independent", PLANT_MAY_IMPORT),
        ("bench-uses-app", BENCH_MAY_IMPORT),
    ],
)
def test_hil_contract_forbids_the_whole_rest_of_the_firmware(contract_id: str, allowed: set[str]) -> None:
    forbidden = set(contract(contract_id)["forbidden_modules"])
    parents = {parent for name in allowed for parent in (name.rpartition(".")[0], "firmware_py")}
    rest = [name for name in modules("firmware_py") if name not in parents and not is_within(name, allowed)]
    missing = [name for name in rest if not is_within(name, forbidden)]
    assert not missing, f"add to forbidden_modules of {contract_id} in pyproject.toml: {', '.join(missing)}"
    assert not [name for name in forbidden if is_within(name, allowed) or name in parents]


@pytest.mark.parametrize("package", ["firmware_py/core", "firmware_py/bus"])
def test_package_that_hil_may_enter_re_exports_nothing(package: str) -> None:
    """Otherwise `from firmware_py.core import X` would bypass the contracts."""
    assert list(imported_modules(ROOT / package / "__init__.py")) == []


def test_no_file_names_a_path_of_one_machine() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    files = [ROOT / name.decode() for name in listing.split(b"\0") if name]
    assert not [path for path in files if path.is_file() and MACHINE_PATH.search(path.read_bytes())]
