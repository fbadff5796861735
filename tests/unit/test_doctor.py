"""The doctor reports what is wrong with a machine or a bus, and what to do about it; the service reports its status."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import socket
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from firmware_py.app import doctor
from firmware_py.app.doctor import (
    FAILED,
    OK,
    WARNING,
    check_cache,
    check_clock,
    check_disk,
    check_governor,
    check_interface,
    check_kernel,
    check_logs,
    check_throttle,
    lines_of,
)
from firmware_py.app.doctor_bus import WRONG, Seen, expected_of, judge, look_at
from firmware_py.app.doctor_report import check_bus
from firmware_py.app.service import reporting
from firmware_py.bus.codec import Codec, Frame, load_database
from firmware_py.bus.load import bus_load, is_of_a_module
from firmware_py.bus.port import Port, open_port
from firmware_py.core.types import Inputs, ModuleInputs, Outputs
from firmware_py.runtime.clock import MonotonicClock
from firmware_py.runtime.notify import Notifier
from firmware_py.runtime.rate_keeper import RateKeeper
from hil.nodes import Nodes, make_nodes
from hil.scenario import load_scenario, make_world

CODEC = Codec.load()
PERIOD_NS = 10_000_000
UNITS = Path(__file__).resolve().parents[2] / "firmware_py" / "deploy"
FIT = {"linkinfo": {"info_kind": "can"}, "flags": ["NOARP", "UP"], "txqlen": 1000}
DATA = {"bittiming": {"bitrate": 1_000_000}, "state": "ERROR-ACTIVE", "restart_ms": 100}


def shown(**changes: object) -> str:
    data = {**DATA, **changes}
    return json.dumps([{**FIT, "linkinfo": {"info_kind": "can", "info_data": data}}])


@pytest.mark.parametrize(
    ("text", "state", "says"),
    [
        (shown(), OK, "1000 kbit/s, ERROR-ACTIVE"),
        (shown(bittiming={"bitrate": 500_000}), FAILED, "bit rate must be 1000"),
        (shown(state="BUS-OFF"), FAILED, "termination"),
        (shown(state="ERROR-PASSIVE"), WARNING, "termination"),
        (shown(restart_ms=0), WARNING, "bus-off"),
        (json.dumps([{**FIT, "txqlen": 10, "linkinfo": {"info_kind": "can", "info_data": DATA}}]), WARNING, "queue"),
        (json.dumps([{**FIT, "flags": []}]), FAILED, "is down"),
        (json.dumps([{**FIT, "linkinfo": {"info_kind": "vcan"}}]), OK, "virtual"),
        (json.dumps([{"flags": ["UP"]}]), FAILED, "not CAN"),
        ("", FAILED, "no such interface"),
    ],
)
def test_interface_is_judged_by_what_ip_says_of_it(text: str, state: str, says: str) -> None:
    finding = check_interface("can0", lambda name: text)
    assert finding.state == state
    assert says in f"{finding.text} {finding.advice}"
    assert finding.advice or state == OK


def test_kernel_without_preempt_rt_is_warned_of_and_one_with_it_is_not() -> None:
    assert check_kernel(lambda path: "1").state == OK
    assert check_kernel(lambda path: "").state in (OK, WARNING)


@pytest.mark.parametrize(("limit", "says"), [(0, "(by privilege, not by rtprio)"), (60, "(rtprio 60)")])
def test_priority_that_is_granted_is_not_said_to_be_zero(limit: int, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "real_time", lambda: nullcontext([]))
    monkeypatch.setattr("resource.getrlimit", lambda which: (limit, limit))
    (finding,) = doctor.check_permissions()
    assert finding.state == OK and finding.text.endswith(says)


@pytest.mark.parametrize(
    ("runtime", "processors", "state", "says"),
    [
        ("950000", 1, WARNING, "stopped when they had 95% of 1 s, and there is one processor"),
        ("950000", 6, OK, "95% of 1 s on a processor"),
        ("-1", 1, OK, "all the time"), ("1000000", 1, OK, "all the time"), ("", 1, OK, "all the time"),
    ],
)  # fmt: skip
def test_real_time_that_the_kernel_stops_is_warned_of_where_a_flood_could_stop_the_tick(
    runtime: str, processors: int, state: str, says: str
) -> None:
    files = {"/proc/sys/kernel/sched_rt_runtime_us": runtime, "/proc/sys/kernel/sched_rt_period_us": "1000000" if runtime else ""}
    finding = check_throttle(lambda path: files[path], processors)
    assert finding.state == state and says in finding.text
    assert ("sysctl" in finding.advice) == (state == WARNING)


@pytest.mark.parametrize(("governor", "state"), [("performance", OK), ("", OK), ("schedutil", WARNING)])
def test_processors_that_slow_down_are_warned_of(governor: str, state: str) -> None:
    assert check_governor(lambda path: governor).state == state


@pytest.mark.parametrize(
    ("source", "year", "state"),
    [("tsc", 2026, OK), ("arch_sys_counter", 2026, OK), ("jiffies", 2026, WARNING), ("tsc", 1970, WARNING)],
)
def test_clock_that_is_slow_or_stands_in_1970_is_warned_of(source: str, year: int, state: str) -> None:
    assert check_clock(lambda path: source, year).state == state


@pytest.mark.parametrize(("free", "state"), [(10**10, OK), (10**9, WARNING), (10**7, FAILED)])
def test_full_disk_is_told(free: int, state: str) -> None:
    assert check_disk(Path(), free).state == state


def test_folder_that_is_not_there_yet_is_judged_by_the_one_it_would_lie_in(tmp_path: Path) -> None:
    folder = tmp_path / "logs" / "today"
    assert f"GB free for logs in {folder}" in check_logs(folder).text
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("place", "says"), [(__file__, "is a file"), (f"{__file__}/logs", "is a file"), ("/proc", "no log can be")])
def test_place_that_takes_no_logs_is_told_and_not_taken_for_full(place: str, says: str) -> None:
    finding = check_logs(Path(place))
    assert finding.state == FAILED and says in finding.text and "remove old logs" not in finding.advice and "--out" in finding.advice


def test_compiled_code_that_cannot_be_loaded_is_a_finding_and_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "WARM_MODULES", ("no_such_module",))
    finding = check_cache()
    assert finding.state == FAILED
    assert finding.text == "what a tick calls cannot be loaded: ModuleNotFoundError: No module named 'no_such_module'"


def test_every_complaint_comes_with_advice_beneath_it() -> None:
    lines = lines_of([check_disk(Path(), 0), check_interface("can0", lambda name: shown())])
    assert lines[1].strip().startswith("-> ")
    assert lines[-1] == "1 failed, 0 warnings"
    assert lines_of([check_disk(Path(), 10**9)])[-1] == "0 failed, 1 warning"
    assert lines_of([check_interface("can0", lambda name: shown())])[-1] == "all is well"


@pytest.fixture
def nodes() -> Nodes:
    scenario = load_scenario("hover")
    return make_nodes(make_world(scenario, 0, PERIOD_NS), CODEC, scenario)


@pytest.fixture
def far_end(request: pytest.FixtureRequest) -> Iterator[Port]:
    with open_port(f"virtual:{request.node.name}") as port:
        yield port


def answer(nodes: Nodes, port: Port, extra: list[Frame] | None = None) -> None:
    for frame in nodes.step(port.receive()):
        port.send(frame)
    for frame in extra or []:
        port.send(frame)


def test_module_that_answers_is_found_with_its_version_and_state(nodes: Nodes, far_end: Port) -> None:
    findings = list(check_bus(far_end.address, [1], 100, CODEC, lambda seconds: answer(nodes, far_end)))
    assert all(finding.state == OK for finding in findings), findings
    assert "module 1: version 1" in findings[0].text
    assert "in flight at 100 Hz 11 %" in findings[-1].text
    assert not np.any(nodes.world.truth(0).force_n)  # nothing moved


@pytest.mark.parametrize("rate_hz", [50, 100, 200, 400])
@pytest.mark.parametrize("number", [1, 18])
def test_doctor_sends_sync_at_the_rate_of_the_fleet_by_which_modules_count_their_slow_messages(
    number: int, rate_hz: int, far_end: Port
) -> None:
    """Regression: 60 SYNCs, of which module 18 sends its ENVIRONMENT with the 63rd at 400 Hz, and it was said to have a dead sensor."""
    scenario = load_scenario("hover")
    world = make_world(scenario, 0, 1_000_000_000 // rate_hz)
    nodes = Nodes(world, CODEC, {number: 0}, scenario.sensors)
    sent = [m for m in bus_load(CODEC, [number], rate_hz).messages if m.name == "SYNC" or is_of_a_module(CODEC.message(m.name))]
    findings = list(check_bus(far_end.address, [number], rate_hz, CODEC, lambda seconds: answer(nodes, far_end)))
    assert findings[0].state == OK, findings[0]
    told = float(findings[-1].text.partition(" % of the bus")[0].rpartition(" ")[2])
    assert told == pytest.approx(100 * sum(message.share for message in sent), abs=1)


def test_module_that_is_silent_and_one_that_is_a_stranger_are_told(nodes: Nodes, far_end: Port) -> None:
    findings = list(check_bus(far_end.address, [2], 100, CODEC, lambda seconds: answer(nodes, far_end)))
    assert findings[0].state == FAILED and "module 2 is silent" in findings[0].text
    assert "module 1 answers and is not in the fleet" in findings[1].text


def test_doctor_sends_nothing_where_a_controller_runs(far_end: Port) -> None:
    sync = CODEC.message("SYNC")
    with open_port(far_end.address) as port:
        seen = look_at(port, CODEC, 100, lambda seconds: far_end.send(sync.encode(0, (1,))))
    assert far_end.receive() == []
    assert seen.sync > 0
    assert any("a controller runs on it" in finding.text for finding in judge("bus", seen, [], 100, CODEC))


@pytest.mark.parametrize(("state", "judged", "says"), [
    (0, WARNING, "the e-stop box reports that it starts"), (1, OK, "the e-stop box, number 30, speaks"),
    (3, WARNING, "the e-stop box reports a fault of its own"),
])  # fmt: skip
def test_e_stop_box_is_told_of(state: int, judged: str, says: str, nodes: Nodes, far_end: Port) -> None:
    beat = [CODEC.message("HEARTBEAT").encode(30, (state, 1))]
    findings = list(check_bus(far_end.address, [1], 100, CODEC, lambda seconds: answer(nodes, far_end, beat)))
    assert [finding.text for finding in findings if finding.state == judged and "e-stop" in finding.text] == [says]


def test_fault_of_an_e_stop_box_is_told_of_where_a_controller_runs(far_end: Port) -> None:
    """Regression: the doctor looked on for 0.3 s there, and a HEARTBEAT comes every half second."""
    sync, beat, waits = CODEC.message("SYNC").encode(0, (1,)), CODEC.message("HEARTBEAT").encode(30, (3, 1)), itertools.count()

    def speak(seconds: float) -> None:
        far_end.send(sync)
        if next(waits) % 50 == 49:
            far_end.send(beat)

    with open_port(far_end.address) as port:
        seen = look_at(port, CODEC, 100, speak)
    assert any("the e-stop box reports a fault of its own" in finding.text for finding in judge("bus", seen, [], 100, CODEC))


@pytest.mark.parametrize("spoken", [[], [Frame(0x01E, b"")]])
def test_e_stop_box_without_heartbeat_is_not_told_to_be_there(spoken: list[Frame], nodes: Nodes, far_end: Port) -> None:
    """Regression: a box that only stops was said to be fine, while the firmware that should have a box would not be armed."""
    findings = check_bus(far_end.address, [1], 100, CODEC, lambda seconds: answer(nodes, far_end, spoken))
    assert not any("the e-stop box" in finding.text for finding in findings)


def test_raised_estop_and_bad_frames_are_told(nodes: Nodes, far_end: Port) -> None:
    bad = [Frame(0x01E, b""), Frame(0x101, bytes(8))]
    findings = list(check_bus(far_end.address, [1], 100, CODEC, lambda seconds: answer(nodes, far_end, bad)))
    text = "\n".join(finding.text for finding in findings)
    assert "e-stop raised by number 30" in text and "bad frames" in text


@pytest.mark.parametrize(("state", "fit"), [(0, False), (1, True), (2, True), (3, True), (4, False), (5, False)])
def test_module_that_an_e_stop_or_a_fault_of_its_own_holds_is_not_called_ok(state: int, fit: bool) -> None:
    seen = Seen(1.0, status={1: (1, 0, state)}, messages={1: expected_of(CODEC)})
    assert (judge("bus", seen, [1], 100, CODEC)[0].state == OK) == fit


@pytest.mark.parametrize(("message", "values", "says"), [
    ("ENVIRONMENT", (30.0, 101325.0, 1), "water in its cabin"), ("POWER", (12.0, 1.0, 15), "a dead supply sensor"),
    ("DEPTH", (101325.0, 20.0, 2), "stale depth sensor"), ("ESC_FEEDBACK_2", (0, 0.0, 1, 0, 0.0, 3), "a fault of ESC 3"),
    ("DOCK_CURRENT_DEF", (0, 0, 0, 0, 0, 3), "a fault of relay F"),
])  # fmt: skip
def test_what_a_module_says_to_be_wrong_with_it_is_told(
    message: str, values: tuple[float, ...], says: str, nodes: Nodes, far_end: Port
) -> None:
    bad = [CODEC.message(message).encode(1, values, counter) for counter in (5, 11)]
    finding = next(iter(check_bus(far_end.address, [1], 100, CODEC, lambda seconds: answer(nodes, far_end, bad))))
    assert finding.state == WARNING and finding.text.count(says) == 1 and "ESC 4" not in finding.text


@pytest.mark.parametrize(("syncs", "controllers", "says"), [
    (0, 1, "somebody who sends no SYNC commands module 1"), (1, 1, ""), (1, 2, "two controllers command module 1"), (1, 0, ""),
])  # fmt: skip
def test_modules_that_somebody_else_commands_are_told(syncs: int, controllers: int, says: str, nodes: Nodes, far_end: Port) -> None:
    ticks = iter(range(1_000))

    def wait(seconds: float) -> None:
        tick = next(ticks)
        sync = [CODEC.message("SYNC").encode(0, (tick,))] * syncs
        counters = [tick & 15, tick + 5 & 15][:controllers]
        answer(nodes, far_end, sync + [CODEC.message("THRUSTER_CMD_A").encode(1, (0.0, 0.0, 0.0, 0.0, 0), c) for c in counters])

    texts = [finding.text for finding in check_bus(far_end.address, [1], 100, CODEC, wait) if finding.state == WARNING]
    assert [text for text in texts if "command" in text] == ([says] if says else [])


def test_bus_that_will_be_too_full_is_told() -> None:
    finding = judge("bus", Seen(seconds=1.0), [1, 2, 3, 4], 400, CODEC)[-1]
    assert finding.state == WARNING


def test_service_tells_that_it_is_ready_alive_and_how_it_fares(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        notifier = Notifier.of({"NOTIFY_SOCKET": str(tmp_path / "notify")})
        keeper = RateKeeper(PERIOD_NS, MonotonicClock(), lambda deadline_ns: None)
        observe = reporting(notifier, keeper, 100)
        heard: list[tuple[int, str]] = []
        for tick in range(1, 301):
            module = ModuleInputs()
            module.answered = True
            observe([], [], Inputs(tick, 0, [module], [], False, 0, False), outputs(tick))
            while True:
                try:
                    heard.append((tick, manager.recv(4096).decode()))
                except BlockingIOError:
                    break
        notifier.close()
    assert [tick for tick, text in heard if "READY=1" in text] == [100]
    alive = [tick for tick, text in heard if "WATCHDOG=1" in text]
    assert alive == list(range(10, 301, 10))
    reports = [text for _, text in heard if "STATUS=" in text]
    assert "tick=300" in reports[-1] and "answered=1/1" in reports[-1]


@pytest.mark.slow
def test_service_is_ready_once_after_a_second_at_every_rate() -> None:
    """systemd kills a service that never reports ready after 90 s, in flight."""
    keeper = RateKeeper(PERIOD_NS, MonotonicClock(), lambda deadline_ns: None)
    for rate_hz in range(50, 401):
        said: list[str] = []
        notifier: Any = SimpleNamespace(is_heard=True, send=said.append)
        observe = reporting(notifier, keeper, rate_hz)
        for tick in range(1, 3 * rate_hz):
            observe([], [], Inputs(tick, 0, [], [], False, 0, False), outputs(tick))
        ready = [text for text in said if "READY=1" in text]
        assert len(ready) == 1 and f"tick={rate_hz} " in ready[0], rate_hz
        assert len([text for text in said if "STATUS=" in text]) == 2, rate_hz


def test_service_says_at_once_that_a_module_is_armed_and_that_it_is_not() -> None:
    """flash.py checks this before it stops the service; a report once a second would be too slow."""
    said: list[str] = []
    notifier: Any = SimpleNamespace(is_heard=True, send=said.append)
    observe = reporting(notifier, RateKeeper(PERIOD_NS, MonotonicClock(), lambda deadline_ns: None), 100)
    for tick, armed in enumerate((False, True, True, False, False), 1):
        observe([], [], Inputs(tick, 0, [ModuleInputs()], [], False, 0, False), outputs(tick, [SimpleNamespace(armed=armed)]))
    assert [re.findall(r"tick=\d|armed=\S+", text) for text in said] == [["tick=2", "armed=1/1"], ["tick=4", "armed=0/1"]]


def outputs(tick: int, modules: Sequence[Any] = ()) -> Outputs:
    return Outputs(tick=tick, time_ns=tick * PERIOD_NS, modules=list(modules), events=[], records=[], estop=False)


def test_without_a_service_manager_nothing_is_sent(tmp_path: Path) -> None:
    assert not Notifier.of({}).is_heard
    Notifier.of({"NOTIFY_SOCKET": str(tmp_path / "nobody")}).send("READY=1")


def test_units_are_what_systemd_understands(tmp_path: Path) -> None:
    words = {"@ROOT@": str(tmp_path), "@USER@": "root", "@PYTHON@": shutil.which("python3") or "", "@CPUS@": "0-1"}
    command = tmp_path / "current" / "bin" / "modcube"
    command.parent.mkdir(parents=True)
    command.write_text("#!/bin/sh\n")
    command.chmod(0o755)
    for unit in UNITS.glob("*.service"):
        text = unit.read_text()
        for word, value in words.items():
            text = text.replace(word, value)
        assert "@" not in text.replace("modcube-can@", "")
        (tmp_path / unit.name).write_text(text)
    assert len(list(tmp_path.glob("*.service"))) == 2
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is missing")
    said = subprocess.run(
        ["systemd-analyze", "verify", str(tmp_path / "modcube.service")], capture_output=True, text=True, check=False
    )
    assert "Unknown" not in said.stderr and "modcube.service:" not in said.stderr, said.stderr


def test_every_fault_that_a_module_can_report_of_a_part_has_words():
    """Regression: the status of a sensor that is added to the DBC was never told of."""
    reported = {
        (signal.name, value)
        for message in load_database().messages
        for signal in message.signals
        for value, choice in (signal.choices or {}).items()
        if "MODULE" in message.senders and message.name != "MCU_STATUS" and str(choice) == "FAULT"
    }
    assert len(reported) == 18
    assert not [(name, value) for name, value in reported if value not in WRONG.get(name, {})]
