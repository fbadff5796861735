"""Real time on vcan0, plant and firmware as two processes: lateness, a flood at full speed, link events, the C node.

The guest's clock counts instructions here, so that lateness is the program's own and not that of a busy machine. All
selected flights share one boot. Reduced: three short flights. With MODCUBE_FULL=1 ten seconds of hover each, the
C node and the busy loops in separate flights, 200 Hz too, and a thousand link events.
"""

import dataclasses
import json
import shlex
import shutil
import subprocess
import sys
from typing import Any

import pytest

from hil.flight import judge_logs
from tests.figures import figure
from tests.vcan.flight_bench import FULL
from tests.vcan.guest import ROOT, Guest
from tests.vcan.realtime_program import Plan, hover

P99_LATENESS_NS = 100_000
RMSE_M = 0.008
RESUMED_S = 0.5
UNANSWERED_TICKS = 5
SETTLE_S = 5.0 if FULL else 2.5
HOVER_S = 10.0 if FULL else 1.0
EVENTS = 100 if FULL else 6
EVENT_S = 0.4
"""Time between link events: 0.11 to 0.45 s on average, depending on the state of the link."""
DAYS = [f"link events of seed {seed}" for seed in range(10 if FULL else 1)]
ON_TIME = ["alone", "beside four busy loops", "200 Hz", "200 Hz beside four busy loops"] if FULL else []
NODES = ["C node"] if FULL else ["C node beside four busy loops"]
PLANS = {
    "alone": Plan(SETTLE_S, HOVER_S),
    "beside four busy loops": Plan(SETTLE_S, HOVER_S, busy_loops=4),
    "200 Hz": Plan(SETTLE_S, HOVER_S, rate_hz=200),
    "200 Hz beside four busy loops": Plan(SETTLE_S, HOVER_S, rate_hz=200, busy_loops=4),
    "in a flood": Plan(SETTLE_S, HOVER_S, flood=True),
    "C node": Plan(SETTLE_S, HOVER_S, node=True),
    "C node beside four busy loops": Plan(SETTLE_S, HOVER_S, node=True, busy_loops=4),
    **{day: Plan(SETTLE_S, EVENTS * EVENT_S + 1.0, link_events=EVENTS, seed=seed) for seed, day in enumerate(DAYS)},
}
TIMEOUT_S = 14_400 if FULL else 2400
PROGRAM = "tests.vcan.realtime_program"
Flight = dict[str, Any]


@pytest.fixture(scope="module")
def flights(request: pytest.FixtureRequest, guest: Guest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Flight]:
    """Figures, by name, of all flights of the selected tests, flown in one boot."""
    asked = {item.callspec.params.get("flight") for item in request.session.items if hasattr(item, "callspec")}
    plans = {name: plan for name, plan in PLANS.items() if name in asked}
    out, node = tmp_path_factory.mktemp("realtime"), tmp_path_factory.mktemp("node")
    if any(plan.node for plan in plans.values()):
        if shutil.which("gcc") is None:
            pytest.skip("gcc is missing (make setup-system)")
        make = ["make", "-C", str(ROOT / "hil/reference_node"), f"BUILD={node}", f"PYTHON={sys.executable}"]
        subprocess.run(make, check=True, capture_output=True)
    words = [json.dumps([dataclasses.asdict(plan) for plan in plans.values()]), str(node / "modcube_node")]
    # The warm-up compiles the code that the guest then finds in its cache.
    warm_up = shlex.join([sys.executable, "-c", f"import {PROGRAM}"])
    run = guest.run([sys.executable, "-m", PROGRAM, *words], counted=True, warm_up=warm_up, out=out, timeout_s=TIMEOUT_S)
    assert run.returncode == 0, run.stdout + run.stderr
    assert "Exception" not in run.stderr, run.stderr
    figures = dict(zip(plans, json.loads((out / "flights.json").read_text()), strict=True))
    for number, (name, plan) in enumerate(plans.items()):
        metrics = judge_logs(hover(plan), plan.seed, out / str(number)).metrics
        figures[name]["position_rmse_m"] = metrics["position_rmse_m"]
    return figures


@pytest.fixture
def flight(request: pytest.FixtureRequest, flights: dict[str, Flight]) -> Flight:
    """The flight that the test names. Asserts that it kept its threads and flew to the end."""
    flown = flights[request.param]
    print(json.dumps({"flight": request.param, **flown}))
    assert flown["refused"] == []
    assert flown["waits"] == 0, "for a file; the clock here runs on meanwhile"
    assert flown["flying_at_the_end"], flown
    assert flown["readers"] == 1
    return flown


@pytest.mark.slow
@pytest.mark.parametrize("flight", [*ON_TIME, *([] if FULL else NODES)], indirect=True)
def test_robot_keeps_time_and_place(flight: Flight, request: pytest.FixtureRequest) -> None:
    name, rate_hz = request.node.callspec.params["flight"], flight["plan"]["rate_hz"]
    figure(f"real time on vcan0, {name}: p99 lateness", flight["lateness_ns"]["p99"] * 1e-3, "us")
    figure(f"real time on vcan0, {name}: overruns", flight["deadline_misses"])
    assert flight["ticks"] == rate_hz * (SETTLE_S + HOVER_S)
    assert flight["lateness_ns"]["p99"] <= P99_LATENESS_NS
    assert flight["deadline_misses"] == 0
    assert flight["position_rmse_m"] <= RMSE_M


@pytest.mark.slow
@pytest.mark.parametrize("flight", ["in a flood"], indirect=True)
def test_flood_at_full_speed_leaves_the_robot_in_its_place(flight: Flight) -> None:
    figure("real time on vcan0, in a flood of cangen: position RMSE", flight["position_rmse_m"] * 1e3, "mm")
    figure("real time on vcan0, in a flood of cangen: p99 lateness", flight["lateness_ns"]["p99"] * 1e-3, "us")
    assert flight["lateness_ns"]["p99"] <= P99_LATENESS_NS
    assert flight["deadline_misses"] == 0
    assert flight["position_rmse_m"] <= RMSE_M


@pytest.mark.slow
@pytest.mark.parametrize("flight", DAYS, indirect=True)
def test_flight_goes_on_soon_after_each_link_event(flight: Flight) -> None:
    figure("real time on vcan0, link events", flight["events"])
    figure("real time on vcan0, link events: resumed within", max(flight["resumed_s"]), "s")
    assert flight["events"] >= EVENTS
    assert max(flight["resumed_s"]) <= RESUMED_S


@pytest.mark.slow
@pytest.mark.parametrize("flight", NODES, indirect=True)
def test_c_node_flies_the_hover(flight: Flight) -> None:
    figure("real time on vcan0, C node: position RMSE", flight["position_rmse_m"] * 1e3, "mm")
    assert flight["position_rmse_m"] <= RMSE_M
    assert flight["unanswered"] <= UNANSWERED_TICKS
