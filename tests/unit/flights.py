"""A synthetic flight, written through the real recorders: the paper's spiral with known errors. For tests and for viewing."""

from pathlib import Path

import numpy as np

from firmware_py.core.rotations import exp, multiply, rotate
from firmware_py.core.types import BodyRecord, Estimate, Event, Inputs, Outputs, Setpoint, Thrust
from firmware_py.runtime.recorder import Recorder
from hil.plant.world import BodyTruth, Truth
from hil.truth_log import TruthRecorder

PERIOD_NS = 10_000_000
START_NS = 4_000_000_000
"""The spiral starts after 4 s of hovering."""
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
POWER_W, MARGIN = 23.0, 0.8
"""Power of the supply and margin of the busiest thruster, both constant."""


def progress(t_s: float, duration_s: float) -> float:
    """Progress from 0 to 1, rest to rest, by the quintic polynomial."""
    s = min(max(t_s / duration_s, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def spiral(t_s: float, duration_s: float) -> np.ndarray:
    """Position of a climb of 0.40 m on a radius of 0.30 m in two turns."""
    s = progress(t_s, duration_s)
    return np.array([0.3 * np.cos(4 * np.pi * s), 0.3 * np.sin(4 * np.pi * s), 0.6 - 0.4 * s])


def smooth(rng: np.random.Generator, ticks: int, sigma: np.ndarray) -> np.ndarray:
    """(ticks, n) noise with a second of memory and standard deviation `sigma`."""
    keep = np.exp(-0.01)
    values = rng.normal(size=(ticks, len(sigma))) * sigma * np.sqrt(1 - keep**2)
    values[0] = rng.normal(size=len(sigma)) * sigma
    for i in range(1, ticks):
        values[i] += keep * values[i - 1]
    return values


def write_flight(
    folder: Path,
    *,
    duration_s: float = 40.0,
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    tilt_rad: tuple[float, float, float] = (0.0, 0.0, 0.0),
    noise: float = 1.0,
    seed: int = 0,
) -> None:
    """Writes the three logs of a flight whose truth is off the reference by `offset_m`, `tilt_rad` and noise."""
    ticks = 1 + round((START_NS / 1e9 + duration_s) * 1e9 / PERIOD_NS)
    rng = np.random.default_rng(seed)
    error = noise * smooth(rng, ticks, np.full(3, 0.0015))
    tilt = noise * smooth(rng, ticks, np.full(3, 0.004))
    doubt = noise * smooth(rng, ticks, np.full(3, 0.0008))
    turn = noise * smooth(rng, ticks, np.full(3, 0.002))
    thrust = 0.8 + noise * smooth(rng, ticks, np.full(8, 0.5))
    recorder = Recorder(folder)
    with TruthRecorder(folder, (8,)) as truth:
        for tick in range(ticks):
            time_ns = tick * PERIOD_NS
            at = (time_ns - START_NS) / 1e9
            wanted = spiral(at, duration_s)
            speed = (spiral(at + 0.005, duration_s) - spiral(at - 0.005, duration_s)) / 0.01
            p_wm = wanted + np.array(offset_m) + error[tick]
            q_wm = exp(np.array(tilt_rad) + tilt[tick])
            zero = np.zeros(3)
            water = np.array([0.04, 0.03, 0.0])
            truth.record(tick, 0, Truth(time_ns, p_wm, q_wm, speed, zero, zero, thrust[tick], water, 1.0, POWER_W))
            truth.record_body(tick, BodyTruth(time_ns, (0,), p_wm, q_wm, speed, zero), np.zeros(6))
            tagged = tick % 2 == 0
            estimate = Estimate(
                p_wm + doubt[tick], multiply(q_wm, exp(turn[tick])), np.r_[speed, zero],
                np.array([0.10, 0.06, 0.4 * (1 - np.exp(-time_ns / 2e9))]), np.array([0.01, -0.02, 0.0]),
                np.full(3, 0.0008), np.full(3, 0.002), 40_000_000,
                float(rng.chisquare(6)) if tagged else float("nan"), 6 if tagged else 0, tick // 400, True,
            )  # fmt: skip
            wrench = np.r_[0.4 * np.sin(at), 0.4 * np.cos(at), -0.4, zero]
            result = Thrust(thrust[tick], wrench, (1.0, 1.0), MARGIN)
            setpoint = Setpoint(wanted, LEVEL, speed, zero, zero, zero)
            record = BodyRecord(0, 1, 3 if at >= 0 else 16, estimate, setpoint, wrench, result, thrust[tick], False, 0)
            events = [Event(6, "tracking the spiral")] if time_ns == START_NS else []
            recorder.record(Inputs(tick, time_ns, []), Outputs(tick, time_ns, [], False, events, [record]))
            if tick % 50 == 49:
                recorder.flush()
    recorder.close()


def write_pair(
    folder: Path, *, ticks: int, joined_from: int, known_from: int, offset_m: tuple[float, float, float],
    parted_from: int = 10**6, parted_known_from: int = 10**6,
) -> None:  # fmt: skip
    """Writes the two logs of a body of two modules that turns on its way and whose truth is `offset_m` off the reference.

    Before tick `joined_from` the leader is alone and the other module approaches at 0.1 mm per tick; before `known_from` the firmware
    steers the leader alone. From `parted_from` the modules are apart again, which the firmware knows from `parted_known_from` on.
    """
    zero, lever = np.zeros(3), np.array([0.105, 0.0, 0.0])
    recorder = Recorder(folder)
    with TruthRecorder(folder, (8, 8)) as truth:
        for tick in range(ticks):
            time_ns, joined, count = tick * PERIOD_NS, joined_from <= tick < parted_from, 8 + 8 * (known_from <= tick < parted_known_from)
            q = exp(np.array([0.0, 0.0, 0.002 * tick]))
            p_wb = spiral(0.01 * tick, 0.01 * ticks)
            away_m = 1e-4 * max(0, joined_from - tick, tick - parted_from)
            leader, other = p_wb - rotate(q, lever), p_wb + rotate(q, (1.0 + away_m / 0.105) * lever)
            for m, p_wm in enumerate((leader, other)):
                truth.record(tick, m, Truth(time_ns, p_wm, q, zero, zero, zero, np.full(8, 2.0 + m), zero, 1.0, POWER_W))
            for members, at in (((0, 1), p_wb),) if joined else (((0,), leader), ((1,), other)):
                truth.record_body(tick, BodyTruth(time_ns, members, at, q, zero, zero), np.zeros(6))
            steered = p_wb if count > 8 else leader
            estimate = Estimate(steered, q, np.zeros(6), zero, zero, np.full(3, 1e-3), np.full(3, 2e-3), 0, np.nan, 0, 0, True)
            setpoint = Setpoint(steered - np.array(offset_m), multiply(q, exp(np.full(3, 0.01))), zero, zero, zero, zero)
            thrust = Thrust(np.full(count, 2.0), np.zeros(6), (1.0, 1.0), MARGIN)
            record = BodyRecord(0, 1, 3, estimate, setpoint, np.zeros(6), thrust, thrust.force_n, False, 0)
            recorder.record(Inputs(tick, time_ns, []), Outputs(tick, time_ns, [], False, [], [record]))
    recorder.close()
