"""The tools' command lines: --help describes the tool and starts nothing, and wrong arguments end with status 2 and no traceback."""

import importlib
import json
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools"
Run = Callable[..., int]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Run]:
    """run(tool, *arguments): runs a tool in an empty folder and returns its exit status; raises where long work would begin."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    before = set(sys.modules)

    def begins(*_: object) -> None:
        raise AssertionError("it began")

    def run_it(tool: str, *arguments: str) -> int:
        monkeypatch.setattr("sys.argv", [tool, *arguments])
        module = importlib.import_module(tool)
        for name in ("batch_entries", "processes"):
            monkeypatch.setattr(module, name, begins, raising=False)
        try:
            return int(module.main() or 0)
        except SystemExit as ended:
            return int(ended.code or 0)

    yield run_it
    for name in set(sys.modules) - before:
        if (TOOLS / f"{name}.py").exists():
            del sys.modules[name]


@pytest.mark.parametrize("tool", ["bench", "bench_fleet", "bench_ground", "bench_lateness", "identify_plants", "readme_tables"])
def test_help_says_what_a_tool_does_and_does_nothing(run: Run, tool: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tool, "--help") == 0
    assert "usage: " in capsys.readouterr().out


def test_help_tells_the_value_of_every_option_that_is_left_out(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    """Not of one whose text tells it already, nor of one without a value to tell."""
    assert run("identify", "--help") == 0
    found = " ".join(capsys.readouterr().out.split())
    assert "free space to either side, world x y z [default: 0.6 0.5 0.3]" in found
    assert "folder for the results [default: runs/identify]" in found
    assert "first one is 1 (default) --accuracy PERCENT" in found and "[default: ]" not in found and "[default: None]" not in found
    assert run("tune_gains", "--help") == 0
    found = " ".join(capsys.readouterr().out.split())
    assert "number of parallel processes [default: 2]" in found
    assert "after which no new trial starts --jobs" in found and "do not draw plots --live" in found, "for ever, and a switch"


@pytest.mark.parametrize(
    ("tool", "arguments", "refusal"),
    [
        ("bench", ["--quick"], "unrecognized arguments: --quick"),
        ("readme_tables", ["README.md"], "unrecognized arguments: README.md"),
        ("identify_plants", ["--plants", "0"], "--plants: '0' is not a whole number above zero"),
        ("margins", ["--jobs", "0"], "--jobs: '0' is not a whole number above zero"),
        ("identify_plants", ["--jobs", "0"], "--jobs: '0' is not a whole number above zero"),
        ("identify_plants", ["--seed", "-1"], "--seed: '-1' is not a whole number from 0 on"),
        ("identify_plants", ["--seconds", "nan"], "--seconds: 'nan' is not a number above zero"),
        ("identify", ["--thruster", "first"], "identify: argument --thruster: invalid int value: 'first'; see --help"),
        ("tune_gains", [], "tune_gains: the following arguments are required: objective; see --help"),
        ("fit_thruster", ["nosuch.csv"], "fit_thruster: nosuch.csv: No such file or directory"),
        ("fit_thruster", [], "fit_thruster: the following arguments are required: csv; see --help"),
        ("characterise", [], "characterise: give one of: vehicles, --assembly SHAPE, --table1, --choose N --task FILE; see --help"),
        ("tune_gains", ["hover.toml", "--seconds", "20"], "tune_gains: --seconds tells how long each step on a vehicle is looked at"),
        ("characterise", ["modcube", "--module", "modcube_sim"], "characterise: --module tells of what an --assembly of AxBxC or of cells"),
        ("characterise", ["--assembly", "fleet.toml", "--module", "modcube"], "characterise: --module tells of what an --assembly of"),
        (
            "margins", ["--vehicle", "bluerov2"],
            "margins: 2 of the vehicle bluerov2 cannot be docked: no docked face joins module 2 to module 1; give --modules 1",
        ),
        ("margins", ["--controller", "papr"], "margins: controller 'papr' is unknown; did you mean paper? there are modcube, "),
        ("bench_fleet", ["0"], "bench_fleet: argument side: invalid choice: 0 (choose from 1, 2, 3, 4); see --help"),
        ("bench_lateness", ["30", "60"], "bench_lateness: argument rate: 30 is outside 50 to 400; see --help"),
        ("bench_lateness", ["100", "-1"], "bench_lateness: argument seconds: '-1' is not a number above zero; see --help"),
        ("bench_lateness", ["100", "3"], "bench_lateness: argument seconds: 3 is too short; 4 or more are needed; see --help"),
        ("mutants", ["nosuch"], "mutants: nosuch: unknown; there are transitions, "),
        ("characterise", ["nosuch"], "characterise: vehicle 'nosuch' is unknown; there are "),
        ("characterise", ["modcube", "--force", "1e300"], "characterise: --force 1e+300: permitted: 1e-06 to 1e+06; see --help"),
        ("characterise", ["modcube", "--torque", "1e-300"], "characterise: --torque 1e-300: permitted: 1e-06 to 1e+06; see --help"),
        ("characterise", ["--choose", "2", "--task", "t.toml", "--force", "2"], "characterise: --choose takes no --force; leave out"),
        ("characterise", ["x" * 300], "characterise: vehicle 'xxx"),
        ("characterise", ["--assembly", "0,0,0 0,0,65"], "characterise: --assembly '0,0,0 0,0,65': needs AxBxC, cells such as "),
        ("bus_load", ["--dbc", str(TOOLS / "bus_load.py")], f"bus_load: {TOOLS / 'bus_load.py'}: is a file; a folder is needed"),
        ("generate_mcu_code", [__file__], f"generate_mcu_code: {__file__}: is a file; a folder is needed"),
        ("run_tests", ["hover"], "run_tests: 'hover' is none of SYSTEM_PACKAGES in the Makefile; for single tests: "),
        ("mutants", ["--jobs", "0"], "mutants: argument --jobs: '0' is not a whole number above zero"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_refused(
    run: Run, tool: str, arguments: list[str], refusal: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tool, *arguments) == 2
    line = capsys.readouterr().err
    assert refusal in line
    assert line.count("\n") == 1


IMPORTED = """
import os, runpy, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell runs in the background ignores it


class Presser:
    def find_spec(self, name, path, target=None):
        if name in ("numpy", "typer", "firmware_py"):
            os.kill(os.getpid(), signal.SIGINT)


sys.meta_path.insert(0, Presser())
sys.path.insert(0, {tools!r})
runpy.run_path({program!r}, run_name="__main__")
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "tool", ["accept", "bench", "build_drag_table", "characterise", "identify", "identify_plants", "margins", "mutants", "tune_gains"]
)
def test_interrupt_ends_a_tool_without_a_word_while_it_imports(tool: str) -> None:
    program = IMPORTED.format(tools=str(TOOLS), program=str(TOOLS / f"{tool}.py"))
    ended = subprocess.run([sys.executable, "-c", program], start_new_session=True, capture_output=True, text=True, timeout=50)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "")


@pytest.mark.parametrize("tool", sorted(path.stem for path in TOOLS.glob("*.py") if "Parser(" in path.read_text(encoding="utf-8")))
def test_every_tool_that_reads_arguments_ends_alike(tool: str) -> None:
    text = (TOOLS / f"{tool}.py").read_text(encoding="utf-8")
    assert tool == "command_line" or ("ArgumentParser(" not in text and text.endswith("    run_tool(main)\n"))


@pytest.mark.parametrize(
    ("tool", "arguments", "refusal"),
    [
        ("build_drag_table", ["--foo"], "build_drag_table: No such option: --foo"),
        ("build_drag_table", ["--directions", "one"], "build_drag_table: Invalid value for '--directions': Input should be"),
        (
            "build_drag_table", ["--vehicle", "bluerov2", "--cache", "/proc/self/none"],
            "build_drag_table: line of two of the vehicle bluerov2 cannot be docked: no docked face joins module 2 to module 1; give --",
        ),
        ("build_drag_table", ["--vehicle", "x" * 300], "build_drag_table: vehicle 'xxx"),
        ("build_drag_table", ["--out", "x" * 300 + ".png"], "build_drag_table: --out xxx"),
        (
            "build_drag_table", ["--cells", "0,0,99999999999999999999"],
            "build_drag_table: cells '0,0,99999999999999999999': write whole numbers x,y,z, each from -64 to 64, with spaces ",
        ),
        ("build_drag_table", ["--out", "x.foo"], "build_drag_table: --out x.foo: no picture ends in .foo; there are "),
        ("accept", ["--out", "/proc/self/accept.json"], "accept: --out /proc/self/accept.json: cannot be written: "),
        ("accept", ["--only", "nosuch"], "accept: Invalid value: nosuch: unknown; there are hover, spiral, "),
    ],
)  # fmt: skip
def test_tool_of_typer_refuses_wrong_arguments_in_one_line_too(
    run: Run, tool: str, arguments: list[str], refusal: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", [tool, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(TOOLS / f"{tool}.py"), run_name="__main__")
    line = capsys.readouterr().err
    assert ended.value.code == 2
    assert line.startswith(refusal)
    assert line.count("\n") == 1


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("margins", []),
        ("identify_plants", []),
        ("characterise", ["modcube"]),
        ("tune_gains", [str(TOOLS / "objectives" / "hover.toml")]),
    ],
)
@pytest.mark.parametrize(("out", "why"), [("/proc/self", "cannot be written: "), ("taken", "taken is a file; a folder is needed")])
def test_folder_that_takes_no_file_is_refused_before_the_work_begins(
    run: Run, tool: str, arguments: list[str], out: str, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "taken").touch()
    assert run(tool, *arguments, "--out", out) == 2
    line = capsys.readouterr().err
    assert f"--out {out}: {why}" in line
    assert line.count("\n") == 1


@pytest.mark.parametrize(
    ("tool", "arguments", "name"),
    [
        ("margins", [], "margins.png"),
        ("identify_plants", [], "plants.json"),
        ("characterise", ["modcube"], "capability.csv"),
        ("tune_gains", [str(TOOLS / "objectives" / "hover.toml")], "parameters.toml"),
    ],
)
def test_files_that_no_earlier_run_left_are_not_written_over(
    run: Run, tool: str, arguments: list[str], name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text("mine")
    assert run(tool, *arguments, "--out", str(tmp_path)) == 2
    line = capsys.readouterr().err
    assert f"{tmp_path} holds {name}, which no earlier run left there; move what is yours or give another --out" in line
    assert line.count("\n") == 1
    assert (tmp_path / name).read_text() == "mine"


@pytest.mark.parametrize("arguments", [["nosuch"], ["--choose", "2", "--task", "nosuch.toml"]])
def test_refusal_leaves_no_empty_folder(run: Run, arguments: list[str], tmp_path: Path) -> None:
    assert run("characterise", *arguments, "--out", str(tmp_path / "a" / "b")) == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [("margins", []), ("identify_plants", []), ("tune_gains", [str(TOOLS / "objectives" / "hover.toml")])],
)
def test_work_that_does_not_begin_leaves_no_empty_folder(run: Run, tool: str, arguments: list[str], tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="it began"):
        run(tool, *arguments, "--out", str(tmp_path / "a" / "b"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("live", ["udp:1", "mavlink:"])
def test_vehicle_without_an_address_leaves_no_empty_folder(run: Run, live: str, tmp_path: Path) -> None:
    assert run("tune_gains", str(TOOLS / "objectives" / "hover.toml"), "--live", live, "--out", str(tmp_path / "a" / "b")) == 2
    assert list(tmp_path.iterdir()) == []


def test_tables_of_the_readme_need_the_project_s_root(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for missing in ("README.md", "docs/figures.md"):
        assert run("readme_tables") == 2
        assert capsys.readouterr().err == f"readme: no {missing} in {tmp_path}; run this in the root of the project\n"
        (tmp_path / "README.md").touch()


def test_one_run_writes_the_readme_and_the_page_of_figures(run: Run, tmp_path: Path) -> None:
    name = "spiral, 20 seeds: position RMSE, worst"
    figure = {"name": name, "value": 2.5, "unit": "mm", "limit": "<= 8", "passed": True, "command": "x", "group": "spiral"}
    (tmp_path / "accept.json").write_text(json.dumps([figure]))
    (tmp_path / "docs").mkdir()
    for page, words in (("README.md", "headlines"), ("docs/figures.md", "spiral")):
        (tmp_path / page).write_text(f"<!-- table: accept {words} -->\n<!-- end -->\n")
    assert run("readme_tables") == 0
    for page in ("README.md", "docs/figures.md"):
        assert f"| {name} | 2.5 mm | <= 8 mm | passed | `x` |" in (tmp_path / page).read_text()


@pytest.mark.parametrize(("text", "refusal"), [("[", "accept.json: no JSON"), ("{}", "accept.json: not a list"), ("[{}]", "'group'")])
def test_spoilt_measurements_leave_the_readme(
    run: Run, tmp_path: Path, text: str, refusal: str, capsys: pytest.CaptureFixture[str]
) -> None:
    readme = "<!-- table: accept spiral -->\nold\n<!-- end -->\n"
    (tmp_path / "README.md").write_text(readme)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "figures.md").touch()
    (tmp_path / "bench.json").write_text("[]")
    (tmp_path / "accept.json").write_text(text)
    assert run("readme_tables") == 2
    line = capsys.readouterr().err
    assert refusal in line
    assert line.count("\n") == 1
    assert (tmp_path / "README.md").read_text() == readme
