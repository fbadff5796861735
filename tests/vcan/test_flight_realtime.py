"""Real time on vcan0, plant and firmware as two processes: lateness, a flood at full speed, link events.

The guest's clock counts instructions here, so that lateness is the program's own and not that of a busy machine.
Reduced lengths; with MODCUBE_FULL=1 ten seconds of hover each and a thousand link events.
"""

import json
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

from hil.flight import judge_logs
from tests.vcan.flight_bench import FULL
from tests.vcan.guest import Guest
from tests.vcan.realtime_program import Plan, hover

P99_LATENESS_NS = 100_000
RMSE_M = 0.008
RESUMED_S = 0.5
SETTLE_S = 5.0 if FULL else 2.0
HOVER_S = 10.0 if FULL else 2.0
EVENTS = 1000 if FULL else 20
EVENT_S = 0.4
"""Time from one link event to the next: 0.11 to 0.45 s on average, by how the link is."""
PLANS = {
    "alone": Plan(SETTLE_S, HOVER_S),
    "beside four busy loops": Plan(SETTLE_S, HOVER_S, busy_loops=4),
    "in a flood": Plan(SETTLE_S, HOVER_S, flood=True),
    "with link events": Plan(SETTLE_S, EVENTS * EVENT_S + 1.0, link_events=EVENTS),
}
TIMEOUT_S = 7200 if FULL else 1800


@pytest.fixture(scope="module")
def flights(guest: Guest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """All flights in one boot: their figures by name."""
    out = tmp_path_factory.mktemp("guest")
    plans = json.dumps([plan.__dict__ for plan in PLANS.values()])
    module = "tests.vcan.realtime_program"
    warm_up = shlex.join([sys.executable, "-c", f"import {module}"])
    run = guest.run([sys.executable, "-m", module, plans], counted=True, warm_up=warm_up, out=out, timeout_s=TIMEOUT_S)
    assert run.returncode == 0, run.stdout + run.stderr
    figures = json.loads((out / "flights.json").read_text())
    for number, (each, plan) in enumerate(zip(figures, PLANS.values(), strict=True)):
        result = judge_logs(hover(plan), plan.seed, Path(out, str(number)))
        each["position_rmse_m"] = result.metrics["position_rmse_m"]
    print(json.dumps(dict(zip(PLANS, figures, strict=True)), indent=1))
    return dict(zip(PLANS, figures, strict=True))


@pytest.mark.parametrize("company", ["alone", "beside four busy loops"])
def test_ticks_start_within_a_tenth_of_a_millisecond(flights: dict[str, dict[str, Any]], company: str) -> None:
    flight = flights[company]
    assert flight["refused"] == []
    assert flight["ticks"] == 100 * (SETTLE_S + HOVER_S)
    assert flight["lateness_ns"]["p99"] <= P99_LATENESS_NS
    assert flight["flying_at_the_end"]
    assert flight["position_rmse_m"] <= RMSE_M


def test_flood_at_full_speed_leaves_the_robot_in_its_place(flights: dict[str, dict[str, Any]]) -> None:
    flight = flights["in a flood"]
    assert flight["flying_at_the_end"]
    assert flight["position_rmse_m"] <= RMSE_M


def test_flight_resumes_within_half_a_second_of_any_link_event(flights: dict[str, dict[str, Any]]) -> None:
    flight = flights["with link events"]
    assert flight["events"] >= EVENTS
    assert flight["readers"] == 1
    assert flight["flying_at_the_end"]
    assert max(flight["resumed_s"]) <= RESUMED_S
