"""For tools/accept.py: the figures of the ground station."""

from __future__ import annotations

from accept_figures import Figure, Group, reported_by_test
from accept_measures import printed_by, said_by_tests

PACKETS, CLIENTS = "tests/unit/test_ground_attack.py", "tests/clients"
TELEMETRY = "tick beside telemetry at 50 Hz on 2 links"

GROUND: tuple[Group, ...] = (
    Group(
        "telemetry", 6, "python tools/bench_ground.py", printed_by("bench_ground.py"),
        (
            Figure("every message at 50 Hz on two links: part of a tick's time", f"{TELEMETRY}: its part", high=5.0, unit="%"),
            Figure("the same: ticks that ran beyond the next deadline", f"{TELEMETRY}: overruns", high=0.0),
        ),
    ),
    Group(
        "packets", 6, f"MODCUBE_FULL=1 pytest -s {PACKETS}", said_by_tests(PACKETS),
        (
            reported_by_test("random and mutated packets without exception or a change that no valid sender could cause", low=1_000_000.0),
            reported_by_test("packets forged or replayed on a keyed link, the real station in control after them", low=100_000.0),
            reported_by_test("packets forged or replayed: believed", high=0.0),
            Figure("tests of packets that failed", "failed", high=0.0),
        ),
    ),
    Group(
        "clients", 6, f"pytest -s -m clients {CLIENTS}", said_by_tests("-m", "clients", CLIENTS),
        (
            reported_by_test("mission of 8 waypoints by MAVSDK: position RMSE", high=10.0, unit="mm"),
            Figure("tests with MAVSDK and MAVProxy that failed", "failed", high=0.0),
        ),
    ),
)  # fmt: skip
