"""The bench's command line: an option that does not apply is refused in one line, and nothing flies."""

import json
import signal
from importlib import resources
from pathlib import Path

import pytest

import hil.campaign
import hil.fault_campaign
import hil.plant_process
import hil.workers
from firmware_py.__main__ import INTERRUPTED
from firmware_py.cli import main
from firmware_py.description.schema import DescriptionError
from hil.fault_campaign import Cell
from hil.flight import LEFT_BEHIND, check_folder
from hil.scenario import load_scenario
from hil.truth_log import TruthRecorder

OFF = [["--trials", "20"], ["--controller", "modcube"], ["--vehicle", "modcube_sim"], ["--sensors", "real"], ["--dask", "tcp://a:1"]]


def status_of(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr("sys.argv", ["modcube", "hil", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """Arguments with which the fault matrix was asked to fly; it flies nothing."""
    asked: list[tuple[object, ...]] = []

    def fly(pool: object, out: Path, seed: int, progress: object) -> list[Cell]:
        asked.append((pool, out, seed))
        return []

    monkeypatch.setattr(hil.workers, "processes", lambda jobs: jobs)
    monkeypatch.setattr(hil.fault_campaign, "run_fault_campaign", fly)
    return asked


@pytest.mark.slow
@pytest.mark.parametrize("option", [*OFF, ["--draw", "1"]], ids=lambda option: str(option[0]))
def test_matrix_of_faults_refuses_what_it_does_not_take(
    option: list[str], flown: list[object], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Even with its default value: whoever gives the option expects it to count."""
    assert status_of(["campaign", "faults", *option], monkeypatch) == 2
    line = capsys.readouterr().err
    assert f"campaign faults: {option[0]} does not apply" in line
    assert "it takes --jobs, --seed, --out" in line
    assert line.count("\n") == 1
    assert flown == []


def test_matrix_of_faults_takes_the_others(flown: list[object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert status_of(["campaign", "faults", "--jobs", "3", "--seed", "5", "--out", str(tmp_path)], monkeypatch) == 0
    assert flown == [(3, tmp_path, 5)]


@pytest.mark.slow
def test_interrupted_campaign_says_that_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(hil.campaign, "run_campaign", interrupt)
    assert status_of(["campaign", "hover", "--out", str(tmp_path)], monkeypatch) == INTERRUPTED
    assert capsys.readouterr().err == "modcube: interrupted; the same command goes on where it was\n"


@pytest.mark.slow
def test_campaign_that_is_terminated_from_elsewhere_says_that_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(hil.campaign, "run_campaign", lambda *_, **__: signal.raise_signal(signal.SIGTERM))
    try:
        assert status_of(["campaign", "hover", "--out", str(tmp_path)], monkeypatch) == INTERRUPTED
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert capsys.readouterr().err == "modcube: interrupted; the same command goes on where it was\n"


@pytest.mark.slow
@pytest.mark.parametrize(("bus", "why"), [
    ("socketcan:can9", "there is no such interface"), ("slcan:/dev/ttyNO", "does not reach another process"),
    ("virtual:x", "does not reach another process"),
])  # fmt: skip
def test_flight_in_two_processes_refuses_a_bus_that_is_none_in_one_line(
    bus: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status_of(["run", "hover", "--realtime", "--bus", bus, "--out", str(tmp_path)], monkeypatch) == 2
    line = capsys.readouterr().err
    assert bus in line and why in line
    assert line.count("\n") == 1


@pytest.mark.slow
def test_help_names_every_bus_that_a_flight_takes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(["run", "--help"], monkeypatch) == 0
    shown = capsys.readouterr().out
    assert [kind for kind in ("virtual:", "udp:", "socketcan:", "slcan:") if kind not in shown] == []


@pytest.mark.slow
@pytest.mark.parametrize(("name", "old", "new", "why"), [
    ("mobius-2", '"modcube"', '"bluerov2"', ":11: module[0]: no docked face joins module 2 to module 1"),
    ("hover", "centre_m = [0.0", "centre_m = [9.0", ":18: task: the path leaves the tank, a box of 1.3 x 1.2 x 0.76 m, after 0 s"),
])  # fmt: skip
def test_scenario_that_no_flight_can_follow_is_refused_with_file_and_line(
    name: str, old: str, new: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (Path(hil.plant_process.__file__).parent / "scenarios" / f"{name}.toml").read_text(encoding="utf-8")
    (tmp_path / "own.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    assert status_of(["run", str(tmp_path / "own.toml"), "--out", str(tmp_path / "run")], monkeypatch) == 2
    assert f"{tmp_path / 'own.toml'}{why}" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("command", [["run", "hover"], ["campaign", "hover"], ["plant", "hover", "--bus", "udp:239.74.163.9:43119"]])
def test_folder_without_a_name_is_refused(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An unset shell variable gives an empty name, which does not mean the working directory."""
    monkeypatch.chdir(tmp_path)
    assert status_of([*command, "--out", ""], monkeypatch) == 2
    line = capsys.readouterr().err
    assert "'' is no folder; give one, or . for this one" in line and line.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_plant_alone_refuses_a_bus_that_nobody_else_reaches(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    served: list[object] = []
    monkeypatch.setattr(hil.plant_process, "serve_until_signal", lambda *arguments: served.append(arguments))
    assert status_of(["plant", "hover", "--bus", "virtual:x"], monkeypatch) == 2
    line = capsys.readouterr().err
    assert "bus 'virtual:x' does not reach another process" in line
    assert "udp:GROUP:PORT or socketcan:IFACE" in line
    assert line.count("\n") == 1
    assert served == []


@pytest.mark.slow
def test_plant_alone_serves_the_modules_of_its_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[int] = []
    monkeypatch.setattr(hil.plant_process, "serve_until_signal", lambda scenario, *_: served.append(len(scenario.module)))
    for seed in range(3):
        assert status_of(["plant", "polycube", "--bus", "udp:239.74.163.9:43119", "--seed", str(seed)], monkeypatch) == 0
    assert served == [len(load_scenario("polycube").for_seed(seed).module) for seed in range(3)]
    assert min(served) > 1


@pytest.mark.slow
def test_plant_alone_takes_another_vehicle_and_holds_it_against_the_scenario(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    served: list[str] = []
    monkeypatch.setattr(hil.plant_process, "serve_until_signal", lambda scenario, *_: served.append(scenario.module[0].vehicle))
    bus = ["--bus", "udp:239.74.163.9:43119", "--vehicle"]
    assert status_of(["plant", "hover", *bus, "bluerov2"], monkeypatch) == 0 and served == ["bluerov2"]
    assert status_of(["plant", "hover", *bus, "bluerov9"], monkeypatch) == 2
    assert status_of(["plant", "dock", *bus, "bluerov2"], monkeypatch) == 2
    unknown, too_large = capsys.readouterr().err.splitlines()
    assert "vehicle 'bluerov9' is unknown" in unknown
    assert "into the wall" in too_large and too_large.endswith("(--vehicle bluerov2)") and served == ["bluerov2"]


@pytest.mark.slow
def test_rate_that_the_plant_cannot_follow_is_refused_with_those_that_it_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status_of(["run", "hover", "--out", str(tmp_path / "run"), "--rate", "120"], monkeypatch) == 2
    line = capsys.readouterr().err
    assert "--rate 120: a tick is no whole number of the plant's sub-steps of 2.5 ms; it takes 50, 80, 100, 200, 400" in line
    assert line.count("\n") == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_what_only_lockstep_can_break_is_refused_in_real_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "hover.toml"
    text = (Path(hil.plant_process.__file__).parent / "scenarios" / "hover.toml").read_text(encoding="utf-8")
    path.write_text(f'{text}\n[[fault]]\nkind = "leak"\n[[fault]]\nkind = "process_killed"\nat_s = 5.0\n', encoding="utf-8")
    bus = ["--bus", "udp:239.74.163.9:43119"]
    monkeypatch.setattr(hil.plant_process.PlantProcess, "serve", lambda *_: None)
    for command in (["run", str(path), "--realtime", "--out", str(tmp_path / "run"), *bus], ["plant", str(path), *bus]):
        assert status_of(command, monkeypatch) == 2
        line = capsys.readouterr().err
        assert "scenario 'hover': fault[1].kind: only a flight in lockstep kills the firmware; fly without --realtime" in line
        assert line.count("\n") == 1


TIMES = "settle_s = 15.0\nduration_s = 60.0"
HOVER = f'[task]\nkind = "hover"\n{TIMES}\ncentre_m = [0.0, 0.0, 0.38]'
NEAR = f'[[module]]\nnumber = 2\nposition_m = [0.0, 0.1, 0.38]\n[[step]]\ndo = "wait"\n[task]\nkind = "dock"\n{TIMES}'
POINTS = f'[task]\nkind = "waypoints"\n{TIMES}\nfile = "points.csv"'
NORTH = "x_m,y_m,z_m,duration_s\n0,0,0.38,\n0.1,north,0.38,5\n"


REALTIME = pytest.param(["--realtime", "--bus", "udp:239.74.163.9:43127"], marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize("realtime", [[], REALTIME], ids=["lockstep", "realtime"])
@pytest.mark.parametrize(
    ("old", "new", "options", "why"),
    [
        ("", "", ["--vehicle", "nautilus"], "vehicle 'nautilus' is unknown"),
        ("", "", ["--vehicle", "girona500"], "girona500, 1.5 x 1 x 1 m as it starts, does not fit that tank: take a larger tank or a sm"),
        ("", "", ["--vehicle", "no_mesh.toml"], "none.stl: there is no such mesh"),
        ("", "", ["--rate", "120"], "--rate 120"),
        ("", "", ["--bus", "socketcan:can9"], "there is no such interface"),
        (HOVER, NEAR, [], "modules 1 and 2 start 0.1 m apart, one inside the other"),
        (HOVER, POINTS, [], "points.csv:3: y_m: 'north' is not a number"),
    ],
    ids=["vehicle", "large", "mesh", "rate", "bus", "overlap", "waypoints"],
)
def test_refused_flight_leaves_the_one_before_as_it_was(
    realtime: list[str], old: str, new: str, options: list[str], why: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    text = (Path(hil.plant_process.__file__).parent / "scenarios" / "hover.toml").read_text(encoding="utf-8")
    Path("own.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    Path("points.csv").write_text(NORTH, encoding="utf-8")
    Path("no_mesh.toml").write_text(with_mesh("none.stl"), encoding="utf-8")
    files = [Path("run") / name for name in (*LEFT_BEHIND, "can.log", "signals.mcap", "truth.mcap")]
    Path("run").mkdir()
    before = json.dumps({"checks": [], "of": "the flight before"})
    for file in files:
        file.write_text(before)
    assert status_of(["run", "own.toml", "--out", "run", *realtime, *options], monkeypatch) == 2
    line = capsys.readouterr().err
    assert why in line and line.count("\n") == 1
    assert {file.read_text() for file in files} == {before}


def with_mesh(mesh: str) -> str:
    """Returns the text of a vehicle file whose hull is the file `mesh`."""
    vehicle = Path(str(resources.files("firmware_py"))) / "vehicles" / "modcube.toml"
    return vehicle.read_text(encoding="utf-8").replace("[hull]", f'[hull]\nmesh = "{mesh}"')


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["nautilus", "none.toml", "no_mesh.toml"])
@pytest.mark.parametrize("command", [["run"], ["campaign", "--jobs", "1"]], ids=["run", "campaign"])
def test_refused_vehicle_leaves_no_folder(
    command: list[str], vehicle: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("no_mesh.toml").write_text(with_mesh("none.stl"), encoding="utf-8")
    Path("there").mkdir()
    for out in ([], ["--out", "new/run"], ["--out", "there"]):
        assert status_of([command[0], "hover", *command[1:], "--vehicle", vehicle, *out], monkeypatch) == 2
        assert capsys.readouterr().err.count("\n") == 1
        assert sorted(path.name for path in tmp_path.rglob("*")) == ["no_mesh.toml", "there"]


@pytest.mark.slow
def test_plant_whose_bus_is_refused_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("signal.signal", lambda *_: None)
    assert status_of(["plant", "hover", "--bus", "socketcan:can9", "--out", str(tmp_path / "new" / "run")], monkeypatch) == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "name", "run"),
    [
        (["run", "hover"], "can.log", "flight of the bench"),
        (["run", "hover"], "overview.png", "flight of the bench"),
        (["run", "hover"], "result.json", "flight of the bench"),
        (["run", "hover"], "truth.mcap", "flight of the bench"),
        (["campaign", "hover"], "trials.csv", "campaign"),
        (["campaign", "hover"], "can.log", "campaign"),
        (["campaign", "faults"], "faults.json", "campaign of faults"),
        (["campaign", "faults"], "truth.mcap", "campaign of faults"),
        (["plant", "hover", "--bus", "udp:239.74.163.9:43119"], "truth.mcap", "plant"),
    ],
)
def test_files_that_no_run_left_are_not_written_over(
    command: list[str], name: str, run: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text('{"mine": true}')
    assert status_of([*command, "--out", str(tmp_path)], monkeypatch) == 2
    line = capsys.readouterr().err
    assert f"{tmp_path} holds {name}, which no {run} left there; move what is yours or give another --out" in line
    assert line.count("\n") == 1
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, '{"mine": true}')]


@pytest.mark.slow
@pytest.mark.parametrize("others", [["README.md"], ["campaign.json", "trials.csv", "trials.jsonl"]], ids=["documents", "campaign"])
def test_flight_is_not_scattered_among_other_files(
    others: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in others:
        (tmp_path / name).write_text("mine")
    monkeypatch.chdir(tmp_path)
    for out in (str(tmp_path), "."):
        assert status_of(["run", "hover", "--out", out], monkeypatch) == 2
        line = capsys.readouterr().err
        assert f"{out} holds {others[0]}" in line and "give an --out that is empty, new, or an earlier flight's" in line
        assert line.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == others


@pytest.mark.slow
def test_trials_that_are_none_are_not_written_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "trials.jsonl").write_text("mine\n")
    assert status_of(["campaign", "hover", "--out", str(tmp_path)], monkeypatch) == 2
    assert f"{tmp_path / 'trials.jsonl'} holds no trials; move what is yours or give another --out" in capsys.readouterr().err
    assert (tmp_path / "trials.jsonl").read_text() == "mine\n"


def test_flight_replaces_an_earlier_one_even_if_that_was_killed(tmp_path: Path) -> None:
    killed, judged = tmp_path / "killed", tmp_path / "judged"
    for folder in (killed, judged):
        folder.mkdir()
        (folder / "can.log").write_text("the flight before")
    with pytest.raises(DescriptionError):
        check_folder(killed)
    (judged / "result.json").write_text('{"checks": []}')
    check_folder(judged)
    with TruthRecorder(killed, (8,)):  # no tick is recorded
        check_folder(killed)
