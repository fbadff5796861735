"""The judge of the fault matrix, on synthetic flights: each promise that is broken alone is named."""

import math
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from firmware_py.core.transitions import State
from firmware_py.core.types import Mode
from hil import fault_campaign, flight
from hil.fault_campaign import fly_cell, judge
from hil.fault_table import AT_S, NAME, ROWS
from hil.scenario import load_scenario
from hil.signals import Flight

TICKS, PERIOD_NS = 2000, 10_000_000
BY_NAME = {row.name: row for row in ROWS}
AS_BEFORE, HALF_FORCE, STOPS, HOLDS = "node babbles", "thruster at half force", "e-stop on the bus", "IMU frozen"
VEHICLE = SimpleNamespace(force_min_n=np.full(8, -4.0), force_max_n=np.full(8, 5.0))
Change = Callable[[Flight], object]


def held(mode: Mode = Mode.POSHOLD) -> Flight:
    """A flight of twenty seconds in which the robot stays at its set-point."""
    q = np.tile([1.0, 0.0, 0.0, 0.0], (TICKS, 1))
    firmware = {
        "tick": np.arange(1, TICKS + 1), "time_ns": PERIOD_NS * np.arange(1, TICKS + 1), "state": np.full(TICKS, int(State.ARMED)),
        "mode": np.full(TICKS, int(mode)), "setpoint_p_wb": np.zeros((TICKS, 3)), "setpoint_q_wb": q.copy(),
        "tag_age_ns": np.zeros(TICKS, np.int64), "commanded_n": np.ones((TICKS, 8)),
    }  # fmt: skip
    events = {"log_time": np.zeros(0, np.int64), "severity": np.zeros(0, np.int64), "text": np.zeros(0, str)}
    return Flight(firmware, {"p_wb": np.zeros((TICKS, 3)), "q_wb": q}, events, {"tick": firmware["tick"]}, np.zeros(0))


def broken(row: str, change: Change = lambda flight: None, mode: str = "POSHOLD") -> tuple[str, ...]:
    """Returns the promises that the judge finds broken in a changed flight."""
    flight = held(Mode[mode])
    change(flight)
    return judge(BY_NAME[row], mode, flight, VEHICLE).broken


def after(seconds: float, name: str, value: object) -> Change:
    """A change that sets the signal `name` to `value` from `seconds` after the fault on."""

    def change(flight: Flight) -> None:
        columns = flight.truth if name in flight.truth else flight.firmware
        columns[name][max(round(100 * (AT_S + seconds)) - 1, 0) :] = value

    return change


def said(text: str) -> Change:
    def change(flight: Flight) -> None:
        flight.events.update(
            log_time=np.array([round((AT_S + 1.0) * 1e9)]), severity=np.array([4]), text=np.array([text])
        )

    return change


def both(*changes: Change) -> Change:
    def change(flight: Flight) -> None:
        for each in changes:
            each(flight)

    return change


def test_promise_that_is_kept_is_not_broken() -> None:
    assert broken(AS_BEFORE) == () and broken(HALF_FORCE) == ()
    assert broken(STOPS, both(after(0.01, "state", int(State.ESTOP)), after(0.01, "commanded_n", 0.0))) == ()
    assert broken(HOLDS, both(after(0.5, "mode", int(Mode.POSHOLD)), said("no IMU for 0.1 s")), "AUTO") == ()


@pytest.mark.parametrize(
    ("row", "change", "words"),
    [
        (AS_BEFORE, both(after(2.0, "mode", int(Mode.MANUAL)), after(4.0, "mode", int(Mode.POSHOLD))), "left POSHOLD for MANUAL"),
        (AS_BEFORE, both(after(2.0, "state", int(State.DISARMED)), after(3.0, "state", int(State.ARMED))), "left POSHOLD for DISARMED"),
        (AS_BEFORE, after(2.0, "mode", int(Mode.MANUAL)), "ended in MANUAL, not POSHOLD"),
        (AS_BEFORE, after(-AT_S, "state", int(State.DISARMED)), "was in DISARMED when it began"),
        (STOPS, after(-AT_S, "state", int(State.DISARMED)), "was in DISARMED when it began"),
        (STOPS, both(after(1.0, "state", int(State.ESTOP)), after(1.0, "commanded_n", 0.0)), "took 1.00 s"),
        (STOPS, after(0.01, "state", int(State.ESTOP)), "a thruster turned while stopped"),
        (STOPS, lambda flight: None, "ended in POSHOLD, not ESTOP"),
        (AS_BEFORE, after(5.0, "p_wb", 0.2), "346 mm off"),
        (AS_BEFORE, after(5.0, "setpoint_p_wb", math.nan), "inf mm off"),
        (HALF_FORCE, after(5.0, "q_wb", [0.5, 0.5, 0.5, 0.5]), "120 deg off"),
        (HALF_FORCE, after(5.0, "q_wb", math.nan), "inf deg off"),
        (HALF_FORCE, said("thruster 6 of module 1 stands still: left out"), "blamed thruster 6 of module 1"),
        (AS_BEFORE, said("thruster 2 of module 1 does not obey: left out"), "blamed thruster 2 of module 1"),
        ("thruster dead", said(f"{NAME} stands still, thruster 3 of module 1 does not obey"), "blamed thruster 3 of module 1"),
        ("thruster dead", lambda flight: None, "did not say 'thruster 6 of module 1 stands still'"),
        (AS_BEFORE, after(5.0, "commanded_n", math.nan), "a command was no number"),
        (AS_BEFORE, after(5.0, "commanded_n", 5.1), "a command was beyond its limits"),
        (AS_BEFORE, after(5.0, "commanded_n", -4.1), "a command was beyond its limits"),
    ],
)
def test_promise_that_was_broken_is_named(row: str, change: Change, words: str) -> None:
    assert words in broken(row, change)


def docked_after(seconds: float) -> Change:
    """A change that ends the body's own signals `seconds` after the fault, because it became one with another."""

    def change(flight: Flight) -> None:
        for columns in (flight.firmware, flight.truth):
            columns.update({name: column[: round(100 * (AT_S + seconds))] for name, column in columns.items()})

    return change


def test_dock_that_succeeds_is_kept_and_one_that_does_not_is_named() -> None:
    assert broken(AS_BEFORE, docked_after(6.0), "DOCK") == () == broken("pilot silent", docked_after(6.0), "DOCK")
    assert broken(AS_BEFORE, mode="DOCK") == ("ended in DOCK, not DOCKED",)
    assert broken("magnet dead", mode="DOCK") == ()
    assert broken("magnet dead", docked_after(6.0), "DOCK") == ("left DOCK for DOCKED", "ended in DOCKED, not DOCK")
    assert broken("e-stop box silent", docked_after(1.0), "DOCK") == ("ended in DOCKED, not POSHOLD", "did not say 'e-stop box silent for'")


@pytest.mark.parametrize(("vehicle", "words"), [("bluerov2", ()), ("modcube", ("60 deg off",))])
def test_rotation_that_the_vehicle_leaves_to_buoyancy_breaks_no_promise(
    monkeypatch: pytest.MonkeyPatch, vehicle: str, words: tuple[str, ...]
) -> None:
    """A BlueROV2 declares its pitch passive."""
    pitched = held()
    pitched.truth["q_wb"][:] = [math.cos(math.radians(30.0)), 0.0, math.sin(math.radians(30.0)), 0.0]
    monkeypatch.setattr(flight, "read_flight", lambda folder: pitched)
    monkeypatch.setattr(fault_campaign, "fly_scenario", lambda *_: None)
    monkeypatch.setattr(fault_campaign, "scenario_of", lambda row, mode: load_scenario("hover").with_vehicle(vehicle))
    assert fly_cell(BY_NAME[HALF_FORCE], "POSHOLD", 0).broken == words
