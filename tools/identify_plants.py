"""How well tools/identify.py finds known plants: each seed's robot is shaken on the bench and identified from its log alone.

    .venv/bin/python tools/identify_plants.py --plants 10 --jobs 2

The load cell: 41 forces of thruster 1 with 0.02 N of noise, and a scale error of up to 2 %, drawn per seed.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from command_line import Parser, refuse, run_tool

import numpy as np
from argument_types import check_results, folder_for_results, positive, whole
from fit_thruster import fit_curve
from identify_excitation import MOTIONS, excitation
from identify_fit import Reference, fit
from identify_log import read_recording
from identify_model import Equations, curve_force
from identify_motion import smooth
from identify_quantities import findings

from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import ThrusterCurve
from firmware_py.description.vehicle_file import load_vehicle
from hil.bench import fly_scenario
from hil.flight import check_folder
from hil.plant.draw import ModuleDraw, draw_module
from hil.scenario import load_scenario
from hil.workers import processes

ACCURACY = 0.02
CELL_POINTS, CELL_NOISE_N = 41, 0.02
MASS, DRAG, GAIN = "mass", "drag", "gain"


def load_cell(draw: ModuleDraw, curve: ThrusterCurve, seed: int) -> dict[str, np.ndarray]:
    """Load-cell measurement of thruster 1 of a plant, as columns of tools/fit_thruster.py, with an error of scale."""
    rng = np.random.default_rng([seed, 9])
    u = np.linspace(-1.0, 1.0, CELL_POINTS)
    force = curve_force(curve, u)
    force[np.abs(force) < draw.deadband_n[0]] = 0.0
    read = draw.gain[0] * force * (1.0 + ACCURACY * rng.uniform(-1.0, 1.0))
    return {"command": u, "force_n": read + CELL_NOISE_N * rng.standard_normal(len(u)) * (force != 0.0)}


def truth_of(draw: ModuleDraw) -> dict[str, float]:
    """True values of a plant, by the names of identify_quantities."""
    total = draw.dry_kg + draw.entrained_kg + draw.added[:3]
    truth = {f"total mass along {axis}": float(kg) for axis, kg in zip("xyz", total, strict=True)}
    truth |= {f"drag coefficient, {side}": float(cd) for side, cd in zip(("face-on", "edge-on"), draw.drag[:2], strict=True)}
    return truth | {f"gain of thruster {k + 1} over the mean": float(g / draw.gain.mean()) for k, g in enumerate(draw.gain)}


def examine(seed: int, folder: Path, duration_s: float = 170.0) -> dict[str, object]:
    """Flies one plant and identifies it.

    Returns:
        seed; error: by name, share of the truth; before: the same for the vehicle file; covers: by name, whether the 95 % interval contains
        the truth; half_width: of that interval, share of the value; states_mass: whether a mass is stated without the reference.
    """
    out = folder / str(seed)
    out.mkdir(parents=True, exist_ok=True)
    check_folder(out)
    file = out / "shake.toml"
    file.write_text(excitation(list(MOTIONS), "modcube", duration_s=duration_s), encoding="utf-8")
    scenario = load_scenario(str(file))
    fly_scenario(scenario, seed, Parameters(), out, f"virtual:identify-{seed}")
    vehicle = load_vehicle("modcube")
    draw = draw_module(vehicle, scenario.world, seed, 0)
    curve, _ = fit_curve(load_cell(draw, vehicle.curve, seed), vehicle.curve, vehicle.curve.voltage_v, 0.05)
    recording = read_recording(out)
    motion = smooth(recording)
    found = {f.name: f for f in findings(fit([Equations(recording, motion, curve)], Reference(0, ACCURACY)), vehicle)}
    blind = findings(fit([Equations(recording, motion, vehicle.curve)]), vehicle)
    truth = truth_of(draw)
    believed = truth_of(draw_module(vehicle, scenario.with_calm_world().world, seed, 0))
    return {
        "seed": seed,
        "error": {name: found[name].value / value - 1.0 for name, value in truth.items()},
        "before": {name: believed[name] / value - 1.0 for name, value in truth.items()},
        "covers": {name: abs(found[name].value - value) <= found[name].half_width for name, value in truth.items()},
        "half_width": {name: found[name].share for name in truth},
        "states_mass": any(f.unit == "kg" for f in blind),
    }


def summary(plants: Sequence[dict]) -> dict[str, float]:  # type: ignore[type-arg]
    """Worst errors of masses, drag and relative gains, identified and before; share of intervals that contain the truth; number of plants
    for which a mass was stated without reference.
    """
    worst = {
        kind + suffix: max(abs(e) for p in plants for name, e in p[when].items() if kind in name)
        for when, suffix in (("error", ""), ("before", "_before"))
        for kind in (MASS, DRAG, GAIN)
    }
    covered = [holds for p in plants for holds in p["covers"].values()]
    return {**worst, "covered": float(np.mean(covered)), "stated": float(sum(p["states_mass"] for p in plants))}


def examine_all(seeds: Sequence[int], jobs: int, folder: Path, duration_s: float = 170.0) -> dict[str, float]:
    """Examines all plants in `jobs` processes; writes plants.json into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    with processes(jobs)() as pool:
        plants = list(pool.map(partial(examine, folder=folder, duration_s=duration_s), seeds))
    (folder / "plants.json").write_text(json.dumps(plants, indent=2) + "\n", encoding="utf-8")
    return summary(plants)


def main() -> int:
    """Runs the tool; returns its exit status."""
    parser = Parser(description=__doc__)
    parser.add_argument("--plants", type=whole(1), default=10, help="number of seeds")
    parser.add_argument("--seed", type=whole(0), default=0, help="first seed")
    parser.add_argument("--jobs", type=whole(1), default=2, help="number of parallel processes")
    parser.add_argument("--seconds", type=positive, default=170.0, help="duration of each flight after settling, s")
    parser.add_argument("--out", type=Path, default=Path("runs/plants"), help="folder for logs and plants.json")
    given = parser.parse_args()
    try:
        with folder_for_results(given.out):
            check_results(given.out, "covers", "plants.json")
            found = examine_all(range(given.seed, given.seed + given.plants), given.jobs, given.out, given.seconds)
    except (DescriptionError, OSError) as error:
        return refuse("identify_plants", error)
    print(json.dumps(found, indent=2))
    return 0 if max(found[kind] for kind in (MASS, DRAG, GAIN)) <= 0.1 and found["covered"] >= 0.85 and not found["stated"] else 1


if __name__ == "__main__":
    run_tool(main)
