"""One run from scenario to result: fly it, read the logs back, judge it, and leave plots and report."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import load_vehicle
from hil.bench import DEFAULT_BUS, fly_scenario
from hil.checks import Result, judge, write_result
from hil.dock_plot import write_dock_plot
from hil.docking_metrics import docking_metrics
from hil.force_metrics import force_metrics
from hil.metrics import PAPER_SPIRAL_RMSE_MM, flight_metrics
from hil.plant.spec import Tank
from hil.plots import Window, write_plots
from hil.realtime import fly_in_real_time
from hil.report import Scene, write_report
from hil.scenario import Scenario
from hil.signals import Flight, read_flight

REGULAR_TICKS = 50
"""Ticks at the start of a log that its period is read from."""
PAPER_RMSE_MM = {"spiral": PAPER_SPIRAL_RMSE_MM}
"""What the paper measured, by the kind of task."""


def fly_and_judge(
    scenario: Scenario,
    seed: int,
    parameters: Parameters,
    out: Path,
    bus: str = DEFAULT_BUS,
    rate_hz: int = 100,
    progress: Callable[[float], None] | None = None,
    realtime: bool = False,
) -> Result:
    """Flies `scenario`; the logs and result.json are in `out` afterwards. Raises DescriptionError and PortError."""
    out.mkdir(parents=True, exist_ok=True)
    scenario = scenario.for_seed(seed)
    if realtime:
        flown = fly_in_real_time(scenario, seed, parameters, out, bus, rate_hz, progress)
        result = judge_logs(scenario, seed, out, flown.wall_s, flown.deadline_misses)
    else:
        result = judge_logs(scenario, seed, out, fly_scenario(scenario, seed, parameters, out, bus, rate_hz, progress))
    write_result(result, out)
    return result


def judge_logs(scenario: Scenario, seed: int, folder: Path, wall_s: float = 0.0, deadline_misses: int = 0) -> Result:
    """The result of the flight whose logs are in `folder`; `wall_s` is what the whole run took."""
    whole = read_flight(folder)
    begin_ns = start_of(whole) + round(scenario.task.settle_s * 1e9)
    flight = whole.between(begin_ns, begin_ns + round(scenario.task.duration_s * 1e9))
    share = len(flight.time_s) / len(whole.time_s)
    vehicle = load_vehicle(scenario.module[0].vehicle)
    metrics = flight_metrics(flight, com_m=vehicle.inertial.com_m, wall_s=wall_s * share, deadline_misses=deadline_misses)
    if scenario.task.kind == "dock":
        metrics |= docking_metrics(scenario, folder)
    if scenario.task.kind == "force":
        metrics |= force_metrics(scenario, folder, begin_ns)
    return judge(scenario.name, seed, metrics, scenario.checks)


def start_of(flight: Flight) -> int:
    """Time of the start of a run, one tick before its first, ns."""
    time_ns = flight.ticks["time_ns"]
    return int(time_ns[0] - np.min(np.diff(time_ns[:REGULAR_TICKS])))


def illustrate(scenario: Scenario, result: Result, folder: Path) -> Path:
    """Writes plots and report.html of the run in `folder`; returns the report's path."""
    flight = read_flight(folder)
    scenario = scenario.for_seed(result.seed)
    scene = _scene(scenario, flight)
    plots = write_plots(flight, folder, scene.window, scene.tank_m, scene.force_limits_n, scene.paper_rmse_mm)
    plots += write_dock_plot(folder, start_of(flight))
    return write_report(folder, result, flight, scene, plots)


def _scene(scenario: Scenario, flight: Flight) -> Scene:
    vehicles = tuple(load_vehicle(module.vehicle) for module in scenario.module)
    vehicle = vehicles[0]
    first_s = float(flight.firmware["time_ns"][0] - start_of(flight)) * 1e-9
    begin_s = scenario.task.settle_s - first_s
    return Scene(
        title=scenario.name.capitalize(),
        description=scenario.help,
        tank=scenario.tank.kind,
        tank_m=tank_corners(scenario.tank),
        modules=vehicles,
        force_limits_n=np.array([vehicle.force_min_n, vehicle.force_max_n]),
        window=Window(begin_s, begin_s + scenario.task.duration_s),
        paper_rmse_mm=PAPER_RMSE_MM.get(scenario.task.kind),
        notes=(f"{vehicle.name}: {vehicle.assumption}",) if vehicle.assumption else (),
    )


def tank_corners(tank: Tank) -> np.ndarray:
    """(2, 3) lowest and highest corner of the water, world, m; z = 0 is the surface."""
    if tank.kind == "box":
        half = 0.5 * tank.size_m[:2]
        return np.array([[-half[0], -half[1], 0.0], [half[0], half[1], tank.size_m[2]]])
    return np.array([[-tank.radius_m, -tank.radius_m, 0.0], [tank.radius_m, tank.radius_m, tank.depth_m]])
