"""For tools/bench.py: many worlds in one call, beside MuJoCo's rollout of the same robot on the same cores.

MuJoCo is not a dependency: `make bench` installs it. Without it the plant is measured alone, and the bench says so.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from bench_entry import Entry, compare

from firmware_py.description.vehicle import Vehicle
from firmware_py.description.vehicle_file import load_vehicle
from hil.batch import fly
from hil.plant.world import STEP_NS
from hil.scenario import load_scenario, make_world

WORLDS, TICKS, PERIOD_NS = 64, 1000, 10_000_000
STEPS = PERIOD_NS // STEP_NS
"""Sub-steps per tick."""
THREADS = 2
DIFFERENCES = (
    "plant against MuJoCo: both integrate one free body with eight lagged thrusters in water at 2.5 ms. The plant has besides: drag that "
    "depends on the direction, full added mass with Coriolis terms, gusts that accelerate, weight and buoyancy apart, deadbands, "
    "fifth-order curves, supply sag, walls, and what an accelerometer feels, every 4th step. MuJoCo has besides: its general joints and "
    "constraints, generic ellipsoid fluid forces, and the state after every step written out. Contacts are off in MuJoCo."
)


def batch_entries() -> list[Entry]:
    """Many worlds in one call, and a single step, beside MuJoCo's. Uses two cores: call it before the process is pinned to one."""
    vehicle = load_vehicle("modcube")
    commands = np.clip(0.3 * np.random.default_rng(0).standard_normal((WORLDS, TICKS, len(vehicle.thruster))), -1.0, 1.0)
    many, single = (_plant_us(commands[:count], threads) for count, threads in ((WORLDS, THREADS), (1, 1)))
    together, alone = "plant step (RK4), 64 worlds on two cores", "plant step (RK4), one world on one core"
    if importlib.util.find_spec("mujoco") is None:
        print("bench: mujoco is not installed: the batch plant has no peer (pip install mujoco)", file=sys.stderr)
        return [*compare(together, "us", many, {}), *compare(alone, "us", single, {})]
    import mujoco

    print(f"bench: {DIFFERENCES}", file=sys.stderr)
    rollout = f"mujoco {mujoco.__version__} rollout"
    peers = {name: _mujoco_us(vehicle, commands[:n], name, threads) for name, n, threads in (("RK4", WORLDS, THREADS), ("Euler", 1, 1))}
    return [
        *compare(together, "us", many, {f"{rollout}, RK4": peers["RK4"]}),
        *compare(alone, "us", single, {f"{rollout}, Euler": peers["Euler"]}),
    ]


def _plant_us(commands: np.ndarray, threads: int) -> Callable[[], float]:
    """Returns a function that measures the duration of one sub-step of one world, us, on a fresh set of worlds."""
    scenario = load_scenario("mobius-1")

    def run() -> float:
        worlds = [make_world(scenario, seed, PERIOD_NS) for seed in range(len(commands))]
        began = time.perf_counter()
        fly(worlds, commands, threads)
        return 1e6 * (time.perf_counter() - began) / (commands.shape[0] * commands.shape[1] * STEPS)

    run()
    return run


def _mujoco_us(vehicle: Vehicle, commands: np.ndarray, integrator: str, threads: int) -> Callable[[], float]:
    """Same as `_plant_us` for MuJoCo's rollout, with its output allocated beforehand."""
    import mujoco
    from mujoco import rollout

    model: Any = mujoco.MjModel.from_xml_string(model_xml(vehicle, integrator))
    controls = np.repeat(commands, STEPS, axis=1)
    data = [mujoco.MjData(model) for _ in range(threads)]
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data[0], state, kind)
    out = np.empty((len(commands), controls.shape[1], state.size))
    pool = rollout.Rollout(nthread=threads if threads > 1 else 0)

    def run() -> float:
        began = time.perf_counter()
        pool.rollout(model, data, np.tile(state, (len(commands), 1)), controls, state=out, skip_checks=False)
        return 1e6 * (time.perf_counter() - began) / (controls.shape[0] * controls.shape[1])

    run()
    return run


def model_xml(vehicle: Vehicle, integrator: str) -> str:
    """MuJoCo model of a lone module: a free box in water with a lagged thruster at each thruster position."""
    inertial, curve = vehicle.inertial, vehicle.curve
    sites = "".join(
        f'<site name="t{i}" pos="{_words(p)}" zaxis="{_words(d)}"/>'
        for i, (p, d) in enumerate(zip(vehicle.positions, vehicle.directions, strict=True))
    )
    thrusters = "".join(
        f'<general site="t{i}" gear="0 0 1 0 0 0" dyntype="filter" dynprm="{curve.lag_s}" gainprm="{np.sum(curve.forward)}"/>'
        for i in range(len(vehicle.thruster))
    )
    return (
        f'<mujoco><option timestep="{1e-9 * STEP_NS}" integrator="{integrator}" density="998.2" viscosity="0.001" gravity="0 0 0">'
        '<flag contact="disable" constraint="disable"/></option><worldbody><body><freejoint/>'
        f'<inertial pos="{_words(inertial.com_m)}" mass="{inertial.dry_kg + inertial.entrained_kg}" '
        f'diaginertia="{_words(np.diag(inertial.inertia))}"/>'
        f'<geom type="box" size="{_words(0.5 * vehicle.hull.size_m)}" fluidshape="ellipsoid"/>{sites}'
        f"</body></worldbody><actuator>{thrusters}</actuator></mujoco>"
    )


def _words(numbers: np.ndarray) -> str:
    return " ".join(f"{x:.9g}" for x in numbers)
