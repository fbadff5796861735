"""The command line refuses wrong input in one line on stderr, with status 2, and says what would be right."""

import errno
import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

import hil.bench
import hil.campaign
from firmware_py.__main__ import INTERRUPTED
from firmware_py.__main__ import main as main_from_the_start
from firmware_py.cli import main
from firmware_py.description.parameters import Parameters, load_parameters, registry
from firmware_py.description.schema import describe
from firmware_py.description.toml_text import to_toml
from firmware_py.description.vehicle_file import load_vehicle, vehicle_names
from firmware_py.runtime.guarded_file import GuardedFile
from hil.scenario_files import scenario_names
from hil.trial_file import TrialFile
from hil.truth_log import TruthRecorder

SPIRAL = (Path(hil.bench.__file__).parent / "scenarios" / "spiral.toml").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "wrong", "right"),
    [
        (["hil", "run", "waltz"], "scenario 'waltz'", "hover, "),
        (["hil", "campaign", "waltz"], "scenario 'waltz'", "hover, "),
        (["hil", "run", "waltz.toml"], "waltz.toml", "No such file"),
        (["hil", "run", "hover", "--bus", "token:ring"], "'token:ring'", "virtual:NAME, udp:GROUP:PORT"),
        (["hil", "run", "hover", "--bus", "socketcan:nocan7"], "nocan7", "no such interface"),
        (["hil", "run", "hover", "--bus", "udp:10.0.0.1:5000"], "udp:10.0.0.1:5000", "udp:239.74.163.2:43113"),
        (["hil", "run", "hover", "--bus", "virtual:"], "virtual:", "virtual:NAME"),
        (["hil", "run", "hover", "--vehicle", "yacht"], "vehicle 'yacht'", "modcube, modcube_sim"),
        (["hil", "run", "hover", "--vehicle", "yacht.toml"], "yacht.toml", "cannot be read"),
        (["hil", "run", "hover", "--controller", "fuzzy"], "controller 'fuzzy'", "modcube, least_power, paper"),
        (["hil", "run", "hover", "--sensors", "magic"], "sensors 'magic'", "real, ideal"),
    ],
)
def test_what_does_not_exist_is_refused_with_what_there_is(
    arguments: list[str], wrong: str, right: str, tmp_path: Path, refusal: Callable[..., str]
) -> None:
    line = refusal(*arguments, "--out", str(tmp_path))
    assert wrong in line
    assert right in line


@pytest.mark.parametrize(
    ("arguments", "wrong", "right"),
    [
        ([], "needs a command", "hil"),
        (["fly"], "No such command 'fly'", "hil"),
        (["hil"], "needs a command", "run, campaign"),
        (["hil", "fly"], "No such command 'fly'", "run, campaign"),
        (["hil", "run"], "Missing argument 'scenario'", "--help"),
        (["hil", "run", "hover", "spiral"], "unexpected extra argument", "--help"),
        (["hil", "run", "hover", "--speed", "9"], "No such option: --speed", "--help"),
        (["hil", "run", "hover", "--seed", "-1"], "--seed", "greater than or equal to 0"),
        (["hil", "run", "hover", "--seed", "one"], "--seed", "'one' is not a whole number"),
        (["replay", "runs", "--tolerance", "much"], "--tolerance", "'much' is not a number"),
        (["doctor", "--bus", "token:ring"], "'token:ring': no such kind of bus", "socketcan:INTERFACE"),
        (["hil", "campaign", "hover", "--trials", "0"], "--trials", "greater than or equal to 1"),
        (["run", "--bus", "virtual:cli", "--live-port", "9000"], "--live-port", "give --live with"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(arguments: list[str], wrong: str, right: str, refusal: Callable[..., str]) -> None:
    line = refusal(*arguments)
    assert line.startswith("modcube")
    assert wrong in line
    assert right in line


@pytest.mark.parametrize(
    "arguments", [["run", "--bus", "token:ring", "--out"], ["doctor", "--out"], ["replay"], ["clear-estop"], ["log", "recover"]]
)
def test_folder_without_a_name_is_refused(arguments: list[str], tmp_path: Path, refusal: Callable[..., str]) -> None:
    """An empty name, as from an unset shell variable, does not mean the working directory."""
    assert "'' is no folder; give one, or . for this one" in refusal(*arguments, "")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "wrong", "right"),
    [
        ("radius_m = 0.30", "radius_m = 0.30\nspeed_m_s = 1.0", "speed_m_s: unknown key", "duration_s, "),
        ("radius_m = 0.30", "radius_m = 3000.0", "radius_m: 3000.0 is out of range", "0.01 to 100 m"),
        ("radius_m = 0.30", "radius_m = nan", "radius_m: nan is out of range", "0.01 to 100 m"),
        ('kind = "spiral"', 'kind = "waltz"', "'waltz' is unknown", "hover, spiral"),
        ("radius_m = 0.30", "radius_m = 'wide'", "radius_m: 'wide' is not a number", "spiral.toml:"),
        ("radius_m = 0.30", "radius_m = 0.30\nradius_m = 0.20", "not valid TOML", "line "),
        ("duration_s = 40.0", "", "duration_s: missing key", "0.1 to 7200 s"),
        ("size_m = [1.3, 1.2, 0.76]", "size_m = [1.3, 1.2]", "size_m: has 2 numbers", "needs 3 numbers"),
        ('vehicle = "modcube"', 'vehicle = "modcub"', "module[0].vehicle: vehicle 'modcub' is unknown", "modcube, "),
    ],
)
def test_wrong_scenario_file_is_refused_with_line_and_permitted_range(
    old: str, new: str, wrong: str, right: str, tmp_path: Path, refusal: Callable[..., str]
) -> None:
    assert old in SPIRAL
    path = tmp_path / "spiral.toml"
    path.write_text(SPIRAL.replace(old, new), encoding="utf-8")
    line = refusal("hil", "run", str(path), "--out", str(tmp_path))
    assert f"{path}:" in line
    assert wrong in line
    assert right in line


@pytest.mark.parametrize(
    ("text", "wrong", "right"),
    [
        ("[control]\nposition_bandwith = 2.0\n", "position_bandwith: unknown key", "position_bandwidth"),
        ("[control]\nposition_bandwidth = 99.0\n", "99.0 is out of range", "0.1 to 10 rad/s"),
        ('[allocation]\nmode = "hope"\n', "'hope' is unknown", "least_squares, least_power, pseudo_inverse"),
    ],
)
def test_wrong_parameter_file_is_refused_with_line_and_permitted_range(
    text: str, wrong: str, right: str, tmp_path: Path, refusal: Callable[..., str]
) -> None:
    path = tmp_path / "gains.toml"
    path.write_text(text, encoding="utf-8")
    line = refusal("hil", "run", "hover", "--controller", str(path), "--out", str(tmp_path))
    assert f"{path}:2: " in line
    assert wrong in line
    assert right in line


@pytest.mark.parametrize("command", [["hil", "run", "."], ["hil", "run", "hover", "--vehicle", "."], ["vehicle", "."]])
def test_folder_in_place_of_a_file_is_refused_as_one(command: list[str], refusal: Callable[..., str]) -> None:
    assert refusal(*command) == "modcube: .: is a folder; give a .toml file"


def test_folder_that_cannot_be_made_is_refused(tmp_path: Path, refusal: Callable[..., str]) -> None:
    file = tmp_path / "taken"
    file.touch()
    assert str(file) in refusal("hil", "run", "hover", "--out", str(file / "run"))


@pytest.mark.slow
@pytest.mark.parametrize("command", [["hil", "run", "hover"], ["run", "--bus", "virtual:out-is-a-file"]], ids=["hil run", "run"])
def test_folder_that_is_a_file_is_refused_with_what_is_needed(command: list[str], tmp_path: Path, refusal: Callable[..., str]) -> None:
    file = tmp_path / "README.md"
    file.touch()
    line = refusal(*command, "--out", str(file))
    assert line == f"modcube: {file}: is a file; a folder is needed"


def find_the_disk_full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "writer", "write"),
    [("run", TruthRecorder, "record_world"), ("run", GuardedFile, "_append"), ("campaign", TrialFile, "_write")],
)
def test_full_disk_ends_the_bench_in_one_line_with_the_folder(
    command: str, writer: type, write: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refusal: Callable[..., str]
) -> None:
    """A full disk does not stop the firmware, because a vehicle flies on without its log; on the bench such a flight is useless."""
    if writer is GuardedFile:
        monkeypatch.setattr(hil.bench.Bench, "fly", lambda *_: 1.0)
    monkeypatch.setattr(writer, write, find_the_disk_full)
    line = refusal("hil", command, "hover", "--out", str(tmp_path))
    assert line == f"modcube: {tmp_path}: No space left on device"


def test_full_disk_is_told_in_one_line_where_nobody_knows_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refusal: Callable[..., str]
) -> None:
    monkeypatch.setattr(hil.campaign, "run_campaign", find_the_disk_full)
    line = refusal("hil", "campaign", "hover", "--out", str(tmp_path))
    assert line == "modcube: No space left on device"


def test_interrupt_during_the_imports_is_silent(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The imports of the command line itself, which `modcube` has not loaded yet when it starts."""

    class Interrupted(ModuleType):
        def __getattr__(self, name: str) -> object:
            raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "firmware_py.cli", Interrupted("firmware_py.cli"))
    with pytest.raises(SystemExit) as ended:
        main_from_the_start()
    assert ended.value.code == INTERRUPTED
    assert capsys.readouterr() == ("", "")


OPENED_AFTER_A_COMMAND = """
import os
from firmware_py.__main__ import main
try:
    main()
except SystemExit as ended:
    os._exit(ended.code or os.open(os.devnull, os.O_RDWR) <= 2)
"""


@pytest.mark.slow
def test_no_file_takes_the_place_of_a_standard_stream_that_is_closed() -> None:
    command = [sys.executable, "-c", OPENED_AFTER_A_COMMAND, "vehicle"]
    assert subprocess.run(["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *command]).returncode == 0


def test_installed_command_is_the_one_that_bears_an_interrupt() -> None:
    project = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["scripts"] == {"modcube": f"{main_from_the_start.__module__}:main"}


def test_list_names_every_scenario_with_one_line_of_help(printed: Callable[..., str]) -> None:
    lines = printed("hil", "list").splitlines()
    assert [line.split()[0] for line in lines] == scenario_names()
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.slow
@pytest.mark.parametrize("arguments", ["--help", "hil --help", "hil run --help", "hil list"])
def test_help_and_list_wait_for_no_code_of_the_bench_to_be_compiled(arguments: str) -> None:
    look = "import atexit, sys; atexit.register(lambda: print('firmware_py.core.rotations' in sys.modules, file=sys.stderr))"
    code = f"{look}; from firmware_py.__main__ import main; main()"
    ran = subprocess.run([sys.executable, "-c", code, *arguments.split()], capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, "False\n")


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """printed(*arguments): returns what `modcube` prints for these arguments."""

    def run(*arguments: str) -> str:
        monkeypatch.setattr("sys.argv", ["modcube", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 0
        return capsys.readouterr().out

    return run


def test_printed_parameters_are_a_file_of_parameters(tmp_path: Path, printed: Callable[..., str]) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text("[control]\nlead_s = 0.1\n")
    whole = tmp_path / "whole.toml"
    whole.write_text(printed("parameters", "--parameters", str(mine)))
    assert load_parameters(whole) == load_parameters(mine) == Parameters().replace("control.lead_s", 0.1)


@pytest.mark.slow
def test_printed_parameters_say_what_each_is_and_may_be(printed: Callable[..., str]) -> None:
    lines = printed("parameters").splitlines()
    for name, limits in registry():
        told = [line for line in lines if line.startswith(f"{name.partition('.')[2]} = ") and limits.help in line]
        assert len(told) == 1 and f"; {describe(limits)}" in told[0] and limits.mavlink in told[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", vehicle_names())
def test_printed_vehicle_is_the_vehicle(name: str, tmp_path: Path, printed: Callable[..., str]) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text(printed("vehicle", name))
    assert printed("vehicle", str(mine)) == mine.read_text()
    assert to_toml(load_vehicle(str(mine))) == to_toml(load_vehicle(name))


def test_printed_vehicle_takes_tables_of_a_kind_that_it_had_none_of(tmp_path: Path, printed: Callable[..., str]) -> None:
    text = printed("vehicle", "modcube")
    assert "# [[payload]]: none; keys: name, dry_kg, entrained_kg, size_m, position_m\n" in text
    mine = tmp_path / "mine.toml"
    arm = '[[payload]]\nname = "arm"\ndry_kg = 0.5\nsize_m = [0.1, 0.02, 0.02]\nposition_m = [0.15, 0, 0]\n'
    mine.write_text(f"{text}\n{arm}")
    assert [payload.name for payload in load_vehicle(str(mine)).payload] == ["arm"]


def test_vehicles_are_printed_by_name(printed: Callable[..., str]) -> None:
    assert printed("vehicle").split() == vehicle_names()


@pytest.mark.slow
def test_groups_of_parameters_are_printed_alone(refusal: Callable[..., str], printed: Callable[..., str]) -> None:
    assert list(tomllib.loads(printed("parameters", "fence", "control"))) == ["control", "fence"]
    line = refusal("parameters", "fences")
    assert "group 'fences'" in line and "did you mean fence? there are control, " in line


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "folder"),
    [
        ([], "hover-campaign"),
        (["--controller", "paper", "--sensors", "ideal"], "hover-paper-ideal-campaign"),
        (["--controller", "mymodcube.toml", "--vehicle", "bluerov2_heavy"], "hover-bluerov2_heavy-mymodcube-campaign"),
    ],
)
def test_campaigns_of_different_robots_have_folders_of_their_own(
    options: list[str], folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that none refuses to begin because of another's trials."""
    taken: list[Path] = []

    def fly(scenario: object, parameters: object, seeds: object, pool: object, out: Path, progress: object, unusual: list[str]) -> None:
        assert out.name == "-".join(["hover", *unusual, "campaign"])
        taken.append(out)
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    (tmp_path / "mymodcube.toml").write_text("")
    monkeypatch.setattr(hil.campaign, "run_campaign", fly)
    monkeypatch.setattr("sys.argv", ["modcube", "hil", "campaign", "hover", *options])
    with pytest.raises((SystemExit, KeyboardInterrupt)):
        main()
    assert taken == [Path("runs") / folder]


@pytest.mark.slow
@pytest.mark.parametrize(("options", "folder"), [
    ([], "hover"), (["--seed", "7"], "hover-seed-7"), (["--rate", "200"], "hover-200hz"),
    (["--sensors", "ideal", "--realtime", "--bus", "udp:239.74.163.9:43131", "--seed", "7"], "hover-ideal-realtime-seed-7"),
])  # fmt: skip
def test_flights_of_different_seeds_and_timing_have_folders_of_their_own(
    options: list[str], folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that neither overwrites the other."""
    taken: list[object] = []

    def fly(*arguments: object) -> None:
        taken.append(arguments[3])
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("hil.flight.fly_and_judge", fly)
    monkeypatch.setattr("sys.argv", ["modcube", "hil", "run", "hover", *options])
    with pytest.raises((SystemExit, KeyboardInterrupt)):
        main()
    assert taken == [Path("runs") / folder]
