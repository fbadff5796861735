"""Flights with faults, and their metrics: thrusters that die or lie, missing tags, lost frames, e-stops.

Used by the tests and, over all seeds, by `make accept`. Every metric comes from the logs, or from the frames themselves.
"""

from __future__ import annotations

import dataclasses
import math
import re
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np

from firmware_py.app.firmware import BusFrame
from firmware_py.bus.codec import Codec
from firmware_py.core.setpoint import rest_at
from firmware_py.core.types import Action, Inputs, Mode, Outputs, Request, Sticks
from firmware_py.description.parameters import Parameters
from hil import USUAL_RATE_HZ
from hil.bench import fly_scenario, open_bench
from hil.fault_table import SINGLE_FAULTS
from hil.flight import flight_of, wanted_in
from hil.metrics import Poses, errors, flight_metrics, rms
from hil.orders import Orders
from hil.plant.draw import stream
from hil.plant.fault_spec import Fault
from hil.plant.world import World
from hil.scenario import Scenario, load_scenario
from hil.signals import Flight
from hil.task import MODES

BREAKS_AFTER_S = 10.0
"""Time from the start of the spiral to the fault."""
COMMANDED_N = 0.3
"""The time to detect a broken thruster counts from its first command above this."""
LEFT_OUT = re.compile(r"thruster (\d+) of module 1 .*: left out")


def flown(scenario: Scenario, seed: int, parameters: Parameters | None = None, rate_hz: int = USUAL_RATE_HZ) -> Flight:
    """Flies a scenario and returns the flight; its logs are discarded."""
    with tempfile.TemporaryDirectory() as folder:
        fly_scenario(scenario, seed, parameters or Parameters(), Path(folder), f"virtual:{Path(folder).name}", rate_hz)
        return flight_of(scenario, Path(folder))


def in_task(scenario: Scenario, flight: Flight) -> tuple[Flight, Poses]:
    """The ticks of the task, and the path's reference pose in each, rather than the firmware's own set-point, which may be anything."""
    part = flight.between(scenario.task.begin_ns, scenario.task.end_ns)
    wanted = wanted_in(scenario, part, scenario.task.begin_ns)
    assert wanted is not None, scenario.task.kind
    return part, wanted


def timed(name: str, settle_s: float, duration_s: float, *faults: Fault) -> Scenario:
    """A scenario with other times and these faults."""
    scenario = load_scenario(name)
    task = dataclasses.replace(scenario.task, settle_s=settle_s, duration_s=duration_s)
    return dataclasses.replace(scenario, task=task, fault=faults)


# ---------------------------------------------------------------- thrusters


class ThrusterFlight(NamedTuple):
    """A spiral in which thrusters broke."""

    rmse_m: float
    """Truth against the path, from the spiral's start to its end or to the first change of mode by a fail-safe."""
    peak_m: float
    angle_peak_deg: float
    found_s: tuple[float, ...]
    """For each broken thruster, time from its first command above COMMANDED_N after the fault until it was left out; infinite if never."""
    blamed: tuple[int, ...]
    """Healthy thrusters that were left out."""
    ends_in: str


def spiral_with(broken: Sequence[int], kind: str = "thruster_dead", seed: int = 0) -> ThrusterFlight:
    """Flies the spiral; the `broken` thrusters all fail BREAKS_AFTER_S into it."""
    base = load_scenario("spiral")
    at_s = base.task.settle_s + BREAKS_AFTER_S
    faults = tuple(Fault(kind=kind, at_s=at_s, index=index) for index in broken)
    whole = flown(dataclasses.replace(base, fault=faults), seed)
    flight, wanted = in_task(base, whole)
    off, turn = errors(flight, wanted)
    kept = np.logical_and.accumulate(flight.firmware["mode"] == Mode.AUTO)
    left_out = {
        int(found[1]) - 1: float(at) * 1e-9
        for text, at in zip(whole.events["text"], whole.events["log_time"], strict=True)
        if (found := LEFT_OUT.search(str(text)))
    }
    after = whole.between(round(at_s * 1e9), base.task.end_ns)
    return ThrusterFlight(
        rms(off[kept]), float(off[kept].max()), float(np.degrees(turn[kept].max())),
        tuple(_found_after(after, index, left_out) for index in broken), tuple(sorted(set(left_out) - set(broken))),
        Mode(int(flight.firmware["mode"][-1])).name,
    )  # fmt: skip


def _found_after(flight: Flight, index: int, left_out: dict[int, float]) -> float:
    used = np.flatnonzero(np.abs(flight.firmware["commanded_n"][:, index]) > COMMANDED_N)
    if not used.size or index not in left_out:
        return float("inf")
    return left_out[index] - float(flight.firmware["time_ns"][used[0]]) * 1e-9


# ---------------------------------------------------------------- tags


class BlindFlight(NamedTuple):
    """A hover with a period without tags."""

    error_m: float
    """Largest horizontal distance of the truth from the set place."""
    rmse_m: float
    """Root mean square of that distance over the time without tags."""
    normalised: tuple[float, float]
    """North and east error of the estimate at the end, over its own sigma."""


class Imu(NamedTuple):
    """Noise per sample of an IMU at 100 Hz."""

    gyro_sigma: float
    """rad/s."""
    accel_sigma: float
    """m/s^2."""


ICM_20602 = Imu(math.radians(0.004) * math.sqrt(50.0), 100e-6 * 9.81 * math.sqrt(50.0))
"""IMU of many autopilots: 0.004 deg/s and 100 ug per root of Hz (TDK InvenSense DS-000176), over the 50 Hz of 100 samples a second."""


def hover_blind(seed: int, imu: Imu | None = None, rate_hz: int = USUAL_RATE_HZ) -> BlindFlight:
    """Flies a hover that loses the tags for a while. With another IMU the filter's noise parameters keep their ratio to the sensor's."""
    scenario, parameters = load_scenario("hover-blind"), Parameters()
    for name, sigma in imu._asdict().items() if imu is not None else ():
        told = getattr(parameters.estimation, name) / getattr(scenario.sensors, name)
        parameters = parameters.replace(f"estimation.{name}", told * sigma)
        scenario = dataclasses.replace(scenario, sensors=dataclasses.replace(scenario.sensors, **{name: sigma}))
    flight, wanted = in_task(scenario, flown(scenario, seed, parameters, rate_hz))
    off = np.linalg.norm((flight.p_wb - wanted.p_wb)[:, :2], axis=1)
    wrong = (flight.firmware["p_wb"] - flight.p_wb)[-1, :2] / flight.firmware["sigma_p"][-1, :2]
    return BlindFlight(float(off.max()), rms(off), (float(wrong[0]), float(wrong[1])))


# ---------------------------------------------------------------- frames


def spiral_through_loss(seed: int, share: float = 0.3) -> float:
    """Position RMSE of a spiral with a share of the frames lost in both directions, m."""
    base = load_scenario("spiral")
    flight, wanted = in_task(base, flown(dataclasses.replace(base, fault=(Fault(kind="frame_loss", value=share),)), seed))
    return float(flight_metrics(flight, wanted=wanted)["position_rmse_m"])


def command_outlives_frames_ms() -> float:
    """Longest time that an MCU keeps a command after the last frame that it accepted, when all frames are lost in flight, ms.

    Infinite if it still applies one at the end.
    """
    scenario = timed("hover", 4.0, 2.0, Fault(kind="frame_loss", at_s=5.0, value=1.0))
    longest = 0.0
    with ExitStack() as stack:
        bench = open_bench(stack, scenario, 0, Parameters(), "virtual:lost")
        mcu = next(iter(bench.nodes.mcus.values()))

        def watch(tick: int, world: World) -> None:
            nonlocal longest
            accepted = [at_ns for at_ns in mcu.accepted_ns if at_ns is not None]
            if accepted and any(mcu.applied):
                longest = max(longest, (world.time_ns - max(accepted)) * 1e-6)

        bench.fly(watch=watch)
        return float("inf") if any(mcu.applied) else longest


# ---------------------------------------------------------------- e-stop


class StoppedFlight(NamedTuple):
    """A flight with an e-stop."""

    ticks: int
    """Number of ticks after the one that took the e-stop."""
    violations: int
    """Number of these ticks in which a thruster was commanded, or was not told that it is disarmed."""
    was_armed: bool


def fly_to_estop(seed: int) -> StoppedFlight:
    """A short flight in a mode and with a fault drawn from the seed, an e-stop at a random time, and random requests after it."""
    rng = stream(seed, "estop")
    faults = [fault for fault in SINGLE_FAULTS if fault.kind not in OWN_FIGURES and not (fault.kind == "frame_loss" and fault.value == 1.0)]
    fault = dataclasses.replace(faults[int(rng.integers(len(faults)))], at_s=float(rng.uniform(1.5, 4.5)), until_s=1e6)
    at_s, by_frame = float(rng.uniform(1.5, 4.5)), bool(rng.random() < 0.5)
    box = (Fault(kind="estop", at_s=at_s, until_s=at_s + float(rng.uniform(0.1, 1.0))),) if by_frame else ()
    base = load_scenario("faults")
    task = dataclasses.replace(base.task, mode=str(rng.choice(MODES)), settle_s=2.0, duration_s=3.0)
    scenario = dataclasses.replace(base, task=task, fault=(fault, *box))
    codec = Codec.load()
    halves = {codec.message(name).id_of(1): codec.message(name) for name in ("THRUSTER_CMD_A", "THRUSTER_CMD_B")}
    stopped, ticks, violations, was_armed = False, 0, 0, False

    def watch(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        nonlocal stopped, ticks, violations, was_armed
        if stopped:
            commands = [halves[frame.id].decode(frame.data) for _, frame in sent if frame.id in halves]
            ticks += 1
            violations += len(commands) != len(halves) or any(any(values) for values in commands)
        elif inputs.estop or any(request.action == Action.ESTOP for request in inputs.requests):
            stopped = True
        else:
            was_armed = outputs.modules[0].armed

    with ExitStack() as stack:
        bench = open_bench(stack, scenario, seed, Parameters(), f"virtual:estop{seed}")
        bench.script = _Nagging(bench.script, rng, at_s, by_frame)
        bench.fly([watch])
    return StoppedFlight(ticks, violations, was_armed)


OWN_FIGURES = ("process_killed", "estop", "estop_box_silent")
"""Faults that cannot be combined with an e-stop: the first ends the firmware, the second is one itself, and the third prevents it."""


class _Nagging:
    """A script with random requests from the e-stop on, but never its release. At `estop_s` it requests the e-stop, unless pressed."""

    def __init__(self, script: Orders, rng: np.random.Generator, estop_s: float, is_pressed: bool) -> None:
        self._script, self._rng, self._estop_s, self._is_asked = script, rng, estop_s, is_pressed
        self.ticks, self.is_over = script.ticks, script.is_over

    def requests(self, time_ns: int, last: Outputs | None) -> list[Request]:
        """The script's requests, and from the e-stop on another one in about every third tick."""
        asked = list(self._script.requests(time_ns, last))
        if time_ns < self._estop_s * 1e9:
            return asked
        if not self._is_asked:
            self._is_asked = True
            return [*asked, Request(Action.ESTOP)]
        return [*asked, ASKED[int(self._rng.integers(len(ASKED)))]] if self._rng.random() < 0.33 else asked


_HERE = rest_at(np.array([0.0, 0.0, 3.0]), np.array([1.0, 0.0, 0.0, 0.0]))
ASKED = (
    Request(Action.ARM), Request(Action.ARM, 0, True), Request(Action.DISARM), Request(Action.HOLD, 0, _HERE),
    Request(Action.SET_POINT, 0, _HERE),
    Request(Action.MOTOR_TEST, 0, (1, 0.3, 2.0)), Request(Action.STICKS, 0, Sticks((0.5, 0.0, 0.0), (0.0, 0.3, 0.0))),
    *(Request(Action.SET_MODE, 0, Mode[mode]) for mode in MODES),
)  # fmt: skip
"""Requests of operators who do not know that the robot is stopped."""
