"""One run from scenario to result: fly it, read the logs back, judge it, and write plots and report."""

from __future__ import annotations

import dataclasses
import fcntl
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np

from firmware_py.core.transitions import State
from firmware_py.description.parameters import CONTROLLERS, Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.description.signals import read_signals
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import groups_of, passive_axes
from firmware_py.runtime.recorder import CAN_LOG
from hil import DEFAULT_BUS, USUAL_RATE_HZ
from hil.bench import SCRIPTS, fleet_of, fly_scenario
from hil.checks import RESULT_FILE, Flown, Limit, Result, judge, write_result
from hil.dock_plot import DOCK_PLOT, write_dock_plot
from hil.docking_metrics import docking_metrics
from hil.force_metrics import force_metrics
from hil.metrics import PAPER_SPIRAL_RMSE_MM, Poses, flight_metrics, warning_lines
from hil.plant.fault_spec import FRAME_KINDS
from hil.plant.spec import Tank
from hil.plots import PLOTS, write_plots
from hil.realtime import fly_in_real_time
from hil.replaceable import check_alone, check_replaceable, created_folder, is_json_with
from hil.report import REPORT_FILE, Scene, write_report
from hil.scenario import Scenario
from hil.script import Script
from hil.signals import SIGNAL_LOG, Flight, by_number, period_of, read_flight
from hil.time_plot import Window
from hil.truth_log import TRUTH_LOG, is_truth_log

LEFT_BEHIND = (RESULT_FILE, REPORT_FILE, DOCK_PLOT, *(f"{name}.png" for name in PLOTS))
"""Files that an earlier flight may have left in a folder, besides the logs, which are overwritten."""
LOGS = (CAN_LOG, SIGNAL_LOG, TRUTH_LOG)
LATE_SHARE = 0.01
"""Share of ticks that may be missing from a log in real time, because frames may be lost on a bus shared with others."""
ARMED_AT_ALL = 0.01
"""Least share of armed ticks for a task to count as flown."""
KEEP_TAGS_AWAY = ("tag_absent", *FRAME_KINDS)
"""Kinds of faults by which the firmware may never hear of a tag that a camera read."""
PAPER_RMSE_MM = {"spiral": PAPER_SPIRAL_RMSE_MM}
"""The paper's position RMSE by kind of task, of its vehicle alone."""
PAPER_VEHICLE = "modcube"


def fly_and_judge(
    scenario: Scenario,
    seed: int,
    parameters: Parameters,
    out: Path,
    bus: str = DEFAULT_BUS,
    rate_hz: int = USUAL_RATE_HZ,
    progress: Callable[[float], None] | None = None,
    realtime: bool = False,
    unusual: Sequence[str] = (),
) -> Result:
    """Flies `scenario` and leaves the logs and result.json in `out`, replacing everything of an earlier flight.

    Raises DescriptionError and PortError; existing files are then untouched, and no empty folder is left.
    """
    scenario = scenario.for_seed(seed)
    flight = (scenario, seed, parameters, out, bus, rate_hz, progress)
    with created_folder(out), _alone_in(out):
        check_folder(out)
        if realtime:
            flown = fly_in_real_time(*flight, before_logs=partial(_clear, out))
            result = judge_logs(scenario, seed, out, flown.wall_s, flown.deadline_misses, LATE_SHARE)
        else:
            result = judge_logs(scenario, seed, out, fly_scenario(*flight, before_logs=partial(_clear, out)))
        result = result._replace(unusual=tuple(unusual), flown=flown_of(scenario, parameters))
        write_result(result, out)
    return result


def flown_of(scenario: Scenario, parameters: Parameters) -> Flown:
    """What flies `scenario` with `parameters`."""
    controller = next((name for name, known in CONTROLLERS.items() if known == parameters), "own")
    vehicles = dict.fromkeys(load_vehicle(module.vehicle).name for module in scenario.module)
    return Flown(version("modcube"), controller, tuple(vehicles))


def check_folder(folder: Path) -> None:
    """Raises DescriptionError if a flight into `folder` would overwrite files that no flight left there, or lie among other files."""
    is_flight = is_truth_log(folder / TRUTH_LOG) or is_json_with(folder / RESULT_FILE, "checks")
    check_replaceable(folder, (*LOGS, *LEFT_BEHIND), is_flight, "flight of the bench")
    check_alone(folder, (*LOGS, *LEFT_BEHIND), is_flight, "flight of the bench")


def _clear(folder: Path) -> None:
    """Removes the files of an earlier flight from `folder`, except the logs."""
    for name in LEFT_BEHIND:
        (folder / name).unlink(missing_ok=True)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Locks `folder` while inside. Raises DescriptionError if another flight is being written into it."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DescriptionError(f"{folder} is being written by another flight; wait for it or give another --out") from None
        yield
    finally:
        os.close(handle)


def judge_logs(
    scenario: Scenario, seed: int, folder: Path, wall_s: float = 0.0, deadline_misses: int = 0, lost_share: float = 0.0
) -> Result:
    """The result of the flight whose logs are in `folder`: the scenario's checks, that no tick is missing, and that it was flown.

    Args:
        wall_s: wall time of the whole run.
        lost_share: share of the ticks that may be missing from a log.
    """
    whole = flight_of(scenario, folder)
    period_ns, begin_ns = period_of(whole.ticks), begin_of(scenario, whole)
    flight = whole.between(begin_ns, begin_ns + scenario.task.duration_ns)
    share = len(flight.firmware["tick"]) / len(whole.firmware["tick"])
    wanted = wanted_in(scenario, flight, begin_ns)
    metrics = flight_metrics(flight, wanted=wanted, wall_s=wall_s * share, deadline_misses=deadline_misses)
    metrics["armed_share"] = float((flight.firmware["state"] == State.ARMED).mean()) if share else math.nan
    if scenario.task.kind == "dock":  # which may end before its time
        metrics |= docking_metrics(scenario, folder)
    else:
        metrics["unmatched_ticks"] = max(metrics["unmatched_ticks"], float(ticks_of(scenario, period_ns) - len(flight.firmware["tick"])))
    if scenario.task.kind == "force":
        metrics |= force_metrics(scenario, folder, begin_ns)
    always = [Limit("unmatched_ticks", high=math.floor(lost_share * len(flight.firmware["tick"]))), *_armed_at_all(scenario, whole, folder)]
    result = judge(scenario.name, seed, metrics, [*scenario.check, *always], warning_lines(whole.events, start_of(whole)))
    result = result._replace(unmet_faults=unmet_faults(scenario, whole))
    return result if result.passed else result._replace(no_tag_reason=no_tag_reason(scenario, whole))


def unmet_faults(scenario: Scenario, whole: Flight) -> tuple[str, ...]:
    """The faults that begin only after the end of the `whole` flight, in words; a dock's flight ends with its last step."""
    end_ns = int(whole.ticks["time_ns"][-1]) - start_of(whole)
    if scenario.task.kind != "dock" or end_ns >= scenario.task.end_ns:
        return ()
    over = f"never began: the steps were over at {1e-9 * end_ns:.1f} s, and the flight with them"
    late = [fault for fault in scenario.fault if round(fault.at_s * 1e9) > end_ns]
    return tuple(f"fault {f.kind}{f' of module {f.module}' if f.module else ''} at {f.at_s:g} s {over}" for f in late)


def no_tag_reason(scenario: Scenario, whole: Flight) -> str:
    """Why no tag was seen in the `whole` flight, in words; empty if one was seen, or if the robot was armed without."""
    if whole.placed.any() or (whole.firmware["state"] == State.ARMED).any():
        return ""
    without = [module.vehicle for module in scenario.module if not load_vehicle(module.vehicle).tag]
    tags = ", ".join(map(str, scenario.tags))
    if not scenario.camera:
        why = "the scenario has no [[camera]]"
    elif len(without) == len(scenario.module):
        why = f"the vehicle {without[0]} carries none"
    else:
        why = f"no [[camera]] read a tag of tags = [{tags}]; position_m, axis and half_view_deg tell what it sees"
        if kept := [fault.kind for fault in scenario.fault if fault.kind in KEEP_TAGS_AWAY]:
            why += f"; or a [[fault]] kept it away: {', '.join(dict.fromkeys(kept))}"
    return f"no tag was ever seen, and without a pose the robot is not armed: {why}"


def _armed_at_all(scenario: Scenario, whole: Flight, folder: Path) -> list[Limit]:
    """The check that the robot was armed at all, if the scenario has no check on `armed_share`. For a dock it is enough that one of the
    bodies was armed at some time in the `whole` flight.
    """
    if any(check.metric == "armed_share" for check in scenario.check):
        return []
    if scenario.task.kind == "dock":
        if (whole.firmware["state"] == State.ARMED).any():
            return []  # the others' logs need not be read
        bodies = by_number(read_signals(folder / SIGNAL_LOG), "/firmware/body").values()
        if any((columns["state"] == State.ARMED).any() for columns in bodies):
            return []
    return [Limit("armed_share", low=ARMED_AT_ALL)]


def flight_of(scenario: Scenario, folder: Path) -> Flight:
    """The flight of `scenario` whose logs are in `folder`, with the axes that its body leaves to buoyancy."""
    return dataclasses.replace(read_flight(folder), passive=passive_in(scenario))


def passive_in(scenario: Scenario) -> tuple[int, ...]:
    """Axes, 0 to 5, that the body which module 0 leads leaves to buoyancy."""
    vehicles = {module.vehicle: load_vehicle(module.vehicle) for module in scenario.module}
    if not any(vehicle.passive_dof for vehicle in vehicles.values()):
        return ()
    fleet = fleet_of(scenario)
    return passive_axes(fleet, groups_of(fleet)[0], vehicles)


def wanted_in(scenario: Scenario, flight: Flight, begin_ns: int) -> Poses | None:
    """Reference poses of the task, begun at `begin_ns`, in every tick of `flight`; None if the task is not a path."""
    if scenario.task.kind in SCRIPTS:
        return None
    path = Script(scenario, fleet_of(scenario)).trajectory
    poses = [path.sample(time_ns * 1e-9) for time_ns in (flight.firmware["time_ns"] - begin_ns).tolist()]
    return Poses(np.array([pose.p_wb for pose in poses]).reshape(-1, 3), np.array([pose.q_wb for pose in poses]).reshape(-1, 4))


def as_wanted(scenario: Scenario, flight: Flight) -> Flight:
    """The flight with the firmware's set-points replaced by the task's reference in the judged ticks."""
    begin_ns = begin_of(scenario, flight)
    time_ns = flight.firmware["time_ns"]
    judged = (time_ns >= begin_ns) & (time_ns <= begin_ns + scenario.task.duration_ns)
    if (wanted := wanted_in(scenario, flight, begin_ns)) is None:
        return flight
    points = {"setpoint_p_wb": wanted.p_wb, "setpoint_q_wb": wanted.q_wb}
    changed = {name: np.where(judged[:, None], value, flight.firmware[name]) for name, value in points.items()}
    return dataclasses.replace(flight, firmware=flight.firmware | changed)


def begin_of(scenario: Scenario, flight: Flight) -> int:
    """Time of the first tick at or after the start of the task, ns."""
    period_ns = period_of(flight.ticks)
    return start_of(flight) + _first_tick(scenario, period_ns) * period_ns


def ticks_of(scenario: Scenario, period_ns: int) -> int:
    """Number of ticks of the task, including the one in which it begins and the last of the run."""
    return scenario.task.end_ns // period_ns - _first_tick(scenario, period_ns) + 1


def _first_tick(scenario: Scenario, period_ns: int) -> int:
    """The first tick at or after the start of the task."""
    return -(-scenario.task.begin_ns // period_ns)


def start_of(flight: Flight) -> int:
    """Time of the start of a run, one period before its first tick, ns; correct even if the first ticks are missing from the log."""
    return int(flight.ticks["time_ns"][0] - flight.ticks["tick"][0] * period_of(flight.ticks))


def illustrate(scenario: Scenario, result: Result, folder: Path) -> Path:
    """Writes plots and report.html of the run in `folder`; returns the report's path."""
    scenario = scenario.for_seed(result.seed)
    flight = as_wanted(scenario, flight_of(scenario, folder))
    scene = _scene(scenario, flight)
    numbers = [module.number for module in scenario.module]
    plots = write_plots(flight, folder, scene.window, scene.tank_m, scene.force_limits_n, scene.paper_rmse_mm, numbers, scene.tank)
    plots += write_dock_plot(folder, start_of(flight))
    return write_report(folder, result, flight, scene, plots)


def _scene(scenario: Scenario, flight: Flight) -> Scene:
    vehicles = tuple(load_vehicle(module.vehicle) for module in scenario.module)
    vehicle = vehicles[0]
    begin_s = float(begin_of(scenario, flight) - flight.firmware["time_ns"][0]) * 1e-9
    return Scene(
        title=scenario.name.capitalize(),
        description=scenario.help,
        tank=scenario.tank.kind,
        tank_m=tank_corners(scenario.tank),
        modules=vehicles,
        force_limits_n=np.array([vehicle.force_min_n, vehicle.force_max_n]),
        window=Window(begin_s, begin_s + scenario.task.duration_s),
        paper_rmse_mm=PAPER_RMSE_MM.get(scenario.task.kind) if [each.name for each in vehicles] == [PAPER_VEHICLE] else None,
        notes=(f"{vehicle.name}: {vehicle.assumption}",) if vehicle.assumption else (),
    )


def tank_corners(tank: Tank) -> np.ndarray:
    """(2, 3) lowest and highest corner of the water, world, m; z = 0 is the surface."""
    if tank.kind == "box":
        half = 0.5 * tank.size_m[:2]
        return np.array([[-half[0], -half[1], 0.0], [half[0], half[1], tank.size_m[2]]])
    return np.array([[-tank.radius_m, -tank.radius_m, 0.0], [tank.radius_m, tank.radius_m, tank.depth_m]])
