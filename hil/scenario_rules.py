"""Validation of scenarios beyond the range of each field, so that a mistake in a file is refused before the flight."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from firmware_py.description.schema import did_you_mean, is_file_name, limits_of
from firmware_py.description.vehicle import FACE_NAMES, Vehicle, face_mismatch
from firmware_py.description.vehicle_file import load_vehicle
from hil.checks import UNBOUNDED
from hil.force_metrics import force_names
from hil.metrics import AS_ASKED, DOCKING, SHOWN, shown
from hil.starts import MOVE_IN, docking_edges_of, hulls_in_walls, inscribed_radius_m, remedy, sphere_in_wall

if TYPE_CHECKING:
    from hil.scenario import Check, Scenario

ARM_FROM_S = 1.0
"""Time of the first attempt to arm in every kind of flight; the pose estimate needs a few tags before."""
ARMED_WITHIN_S = 0.1
"""Allowance for the answer, which comes one or two ticks, of at most 20 ms, later."""
YAWS = 37
"""Number of headings checked over the range that a seed may draw: at most 10 deg apart."""
SEVERAL_BODIES = ("dock", "force")
"""Kinds of tasks that steer and judge every body; the others steer that of the first module alone."""
Mistake = tuple[tuple[str | int, ...], str]
"""Path of keys to the wrong entry, and the error message."""


def mistakes(scenario: Scenario) -> Iterator[Mistake]:
    """Yields all mistakes of a scenario as read from its file."""
    for rule in RULES:
        yield from rule(scenario)


def metric_names(scenario: Scenario) -> list[str]:
    """Names of the metrics that a run of the scenario yields."""
    kind = scenario.task.kind
    names = [name for name in SHOWN if kind == "dock" or name not in DOCKING]
    return names + (force_names([len(members) for members in scenario.groups]) if kind == "force" else [])


def module_numbers(scenario: Scenario) -> list[int]:
    """Numbers of the modules that exist in every seed."""
    if scenario.polycube is None:
        return [module.number for module in scenario.module]
    first = scenario.module[0].number
    return list(range(first, first + scenario.polycube.fewest))


def _in_name(scenario: Scenario) -> Iterator[Mistake]:
    if not is_file_name(scenario.name):
        yield ("name",), f"{scenario.name!r} cannot be the name of a folder; give one without separators, as in the file's name"


def _in_numbers(scenario: Scenario) -> Iterator[Mistake]:
    numbers = [module.number for module in scenario.module]
    for i, number in enumerate(numbers):
        if number in numbers[:i]:
            yield ("module", i, "number"), f"{number} is the number of another module too; each needs one of its own"


def _in_pitch(scenario: Scenario) -> Iterator[Mistake]:
    edges = sorted(docking_edges_of(scenario))
    if len(edges) > 1 and len(module_numbers(scenario)) > 1:
        what = f"docking faces are {' and '.join(f'{edge:g}' for edge in edges)} m apart across the hulls; a lattice has one pitch"
        yield ("module", 0, "vehicle"), f"{what}: give modules with equal edges along the axes of their docking faces"


def _in_polycube(scenario: Scenario) -> Iterator[Mistake]:
    if scenario.polycube is None:
        return
    first, most = scenario.module[0], scenario.polycube.most
    highest = int(limits_of(type(first), "number").high)
    if len(scenario.module) > 1:
        yield ("module", 1), "a [polycube] takes the place of all modules; give the first alone"
    if first.number + most - 1 > highest:
        what = f"{first.number} and {most - 1} more go up to {first.number + most - 1}; the bus has numbers to {highest}"
        yield ("module", 0, "number"), f"{what}, so it is {highest - most + 1} at the most"


def _in_steps(scenario: Scenario) -> Iterator[Mistake]:
    kind = scenario.task.kind
    shortest_s = limits_of(type(scenario.task), "duration_s").low
    for i, step in enumerate(scenario.step):
        if step.do in ("move", "moebius_start", "moebius") and step.duration_s < shortest_s:
            yield ("step", i, "duration_s"), f"{step.duration_s:g} s; a {step.do} takes {shortest_s:g} s at least"
    if kind != "dock" and scenario.step:
        yield ("step", 0), f"a task of the kind {kind} runs no steps; only dock does"
    if kind == "dock" and not scenario.step:
        yield ("task", "kind"), "dock runs the [[step]]s, and there are none"


def _in_settling(scenario: Scenario) -> Iterator[Mistake]:
    if scenario.task.settle_s < ARM_FROM_S + ARMED_WITHIN_S:
        what = f"the robot is armed after {ARM_FROM_S:g} s, and the task needs it armed; {ARM_FROM_S + ARMED_WITHIN_S:g} s are the least"
        yield ("task", "settle_s"), f"{scenario.task.settle_s:g} s; {what}"


def _in_file(scenario: Scenario) -> Iterator[Mistake]:
    """Checks only whether a file is given; the script, which plans the path, checks its contents."""
    if scenario.task.kind == "waypoints" and not scenario.task.file:
        yield ("task", "kind"), "waypoints flies a file, and there is none; give file"


def _in_bodies(scenario: Scenario) -> Iterator[Mistake]:
    kind, counts = scenario.task.kind, [len(members) for members in scenario.groups]
    if kind == "dock" and len(module_numbers(scenario)) < 2:
        yield ("task", "kind"), "dock needs two modules at least, and there is one"
    if kind not in SEVERAL_BODIES and len(counts) > 1:
        leaders = ", ".join(str(scenario.module[members[0]].number) for members in scenario.groups)
        what = f"{kind} steers and judges one body, and there are {len(counts)}, led by modules {leaders}"
        yield ("task", "kind"), f"{what}; give the modules one `body` number, or fly {' or '.join(SEVERAL_BODIES)}"
    if kind == "force" and not {1, 2} <= set(counts):
        found = ", ".join(map(str, counts))
        yield ("task", "kind"), f"force compares a module alone with two docked ones; the bodies here have {found} modules"
    for members in scenario.groups if kind == "force" else []:
        leader = scenario.module[members[0]].number
        if counts.count(len(members)) > 1:
            yield ("module", members[0]), f"the body of module {leader} has as many modules as another, and force tells them apart by that"
        if not any(scenario.module[m].clamped for m in members):
            yield ("module", members[0]), f"no load cell holds the body of module {leader}, whose force is measured; clamped = true"


def _in_clamps(scenario: Scenario) -> Iterator[Mistake]:
    kind = scenario.task.kind
    for i, module in enumerate(scenario.module):
        if module.clamped and kind not in SEVERAL_BODIES:
            what = f"{kind} judges how the body of module {module.number} moves, and a load cell would hold it in place"
            yield ("module", i, "clamped"), f"{what}; leave it out, or fly {' or '.join(SEVERAL_BODIES)}"


def _in_docked(scenario: Scenario) -> Iterator[Mistake]:
    """Checks that of docked modules only the first has a pose."""
    for members in scenario.groups:
        for m in members[1:]:
            module, leader = scenario.module[m], scenario.module[members[0]]
            for key in ("position_m", "euler_deg"):
                if getattr(module, key).any():
                    what = f"module {module.number} is docked to module {leader.number}, which places and turns the body"
                    yield ("module", m, key), f"{what}; leave it out, or give the cell"


def _in_cells(scenario: Scenario) -> Iterator[Mistake]:
    """Checks that only modules of a body have a cell: one whose `body` was forgotten would start alone, somewhere else."""
    for m, module in enumerate(scenario.module):
        if module.body < 0 and module.cell.any():
            what = f"module {module.number} starts alone, in no lattice; give body, as its neighbours have, or leave it out"
            yield ("module", m, "cell"), what


def _in_undocks(scenario: Scenario) -> Iterator[Mistake]:
    """Checks that the modules of an undock start docked, or that earlier steps dock their bodies."""
    if scenario.polycube is not None:
        return
    bodies = [{scenario.module[m].number for m in members} for members in scenario.groups]
    for i, step in enumerate(scenario.step):
        if step.do not in ("dock", "undock"):
            continue
        joined = [body for body in bodies if body & set(step.modules)]
        if step.do == "dock":
            bodies = [body for body in bodies if body not in joined] + [set().union(*joined)]
        elif len(joined) > 1:
            what = f"modules {step.module} and {step.target_module} are not docked: neither at the start nor by an earlier step"
            yield ("step", i, "do"), f"{what}; name two that are"


def _in_tank(scenario: Scenario) -> Iterator[Mistake]:
    """Checks the start and target positions of bodies; the script checks whether whole paths stay in the tank."""
    places: list[tuple[str, int]] = [("module", members[0]) for members in scenario.groups]
    places += [("step", i) for i, step in enumerate(scenario.step) if step.do == "move"]
    for table, i in places:
        place = getattr(scenario, table)[i].position_m
        if not scenario.tank.holds(place):
            where = f"{place.tolist()} m is outside the tank, a {scenario.tank}"
            yield (table, i, "position_m"), f"{where} with its surface's centre at [0, 0, 0]"
    for i, where in hulls_in_walls(scenario, np.zeros((1, 3)), np.zeros(1)):
        leader = next(members[0] for members in scenario.groups if i in members)
        module = scenario.module[i]
        advice = remedy(scenario.tank, load_vehicle(module.vehicle), module.start)
        what = f"the hull of module {module.number} is {where}; {advice}{' by that' if advice == MOVE_IN else ''}"
        yield ("module", leader, "position_m"), what


def _in_moves(scenario: Scenario) -> Iterator[Mistake]:
    """Checks the target positions of moves for the largest sphere in the module's hull: nobody knows yet how it will be turned."""
    vehicles = _vehicles(scenario)
    for i, step in enumerate(scenario.step):
        if step.do != "move" or step.module not in vehicles:
            continue
        if where := sphere_in_wall(scenario.tank, step.position_m, inscribed_radius_m(vehicles[step.module])):
            yield ("step", i, "position_m"), f"there the hull of module {step.module} is {where}, however it is turned; {MOVE_IN}"


def _in_start(scenario: Scenario) -> Iterator[Mistake]:
    """Checks the extremes of the random start offsets."""
    for corner in itertools.product((-1.0, 1.0), repeat=3):
        for members in scenario.groups:
            place = scenario.module[members[0]].position_m + scenario.start.position_m * corner
            if not scenario.tank.holds(place):
                where = f"a seed may start module {scenario.module[members[0]].number} at {place.round(3).tolist()} m"
                yield ("start", "position_m"), f"{where}, outside the tank, a {scenario.tank}"
                return
    shifts_m = scenario.start.position_m * list(itertools.product((-1.0, 1.0), repeat=3))
    for i, where in hulls_in_walls(scenario, shifts_m, math.radians(scenario.start.yaw_deg) * np.linspace(-1.0, 1.0, YAWS)):
        yield ("start",), f"a seed may start the hull of module {scenario.module[i].number} {where}; let it draw less, or move it in"


def _in_mentions(scenario: Scenario) -> Iterator[Mistake]:
    """Checks that steps, faults and cameras refer to existing modules."""
    numbers = module_numbers(scenario)
    mentions: list[tuple[tuple[str | int, ...], int]] = []
    for i, step in enumerate(scenario.step):
        mentions += [(("step", i, key), number) for key, number in zip(("module", "target_module"), step.modules, strict=False)]
    for table in ("fault", "camera"):
        mentions += [((table, i, "module"), each.module) for i, each in enumerate(getattr(scenario, table)) if each.module]
    every = "in every seed there are" if scenario.polycube else "there are"
    for keys, number in mentions:
        if number not in numbers:
            yield keys, f"no module has the number {number}; {every} {', '.join(map(str, numbers))}"


def _in_faces(scenario: Scenario) -> Iterator[Mistake]:
    """Checks that the faces of each dock are a probe and a drogue."""
    vehicles = _vehicles(scenario)
    for i, step in enumerate(scenario.step):
        if step.do != "dock" or not {step.module, step.target_module} <= vehicles.keys():
            continue
        faces = FACE_NAMES.index(step.face), FACE_NAMES.index(step.target_face)
        if why := face_mismatch(vehicles[step.module].faces, faces[0], vehicles[step.target_module].faces, faces[1]):
            yield ("step", i, "face"), f"module {step.module} cannot dock to module {step.target_module}: {why}"


def _in_tags(scenario: Scenario) -> Iterator[Mistake]:
    """Checks that each tagged vehicle has a tag that cameras read, i.e. one of `tags`. Skipped without cameras or tags."""
    if not scenario.camera or not scenario.tags:
        return
    for i, module in enumerate(scenario.module):
        carried = [tag.id for tag in load_vehicle(module.vehicle).tag]
        if carried and not set(carried) & set(scenario.tags):
            has = ", ".join(map(str, carried))
            yield ("module", i, "vehicle"), f"{module.vehicle} has no tag of tags = {list(scenario.tags)}; it has {has}"


def _vehicles(scenario: Scenario) -> dict[int, Vehicle]:
    """Vehicle of each module, by module number. Raises DescriptionError when a vehicle cannot be loaded."""
    loaded = {name: load_vehicle(name) for name in {module.vehicle for module in scenario.module}}
    vehicles = itertools.cycle(loaded[module.vehicle] for module in scenario.module)  # a polycube's modules are all of one kind
    return dict(zip(module_numbers(scenario), vehicles, strict=False))


def _in_faults(scenario: Scenario) -> Iterator[Mistake]:
    thrusters = {number: len(vehicle.thruster) for number, vehicle in _vehicles(scenario).items()}
    for i, fault in enumerate(scenario.fault):
        for key, what in fault.mistakes(thrusters, scenario.estop_box):
            yield ("fault", i, key), what
        if fault.at_s > scenario.duration_s:
            yield ("fault", i, "at_s"), f"{fault.at_s:g} s is after the end of the run, which lasts {scenario.duration_s:g} s"
        if fault.kind == "jets" and len(module_numbers(scenario)) < 2:
            yield ("fault", i, "kind"), "jets disturb a neighbour, and there is one module alone"


def _in_checks(scenario: Scenario) -> Iterator[Mistake]:
    names = metric_names(scenario)
    for i, check in enumerate(scenario.check):
        if check.metric not in names:
            known = f"a run of the kind {scenario.task.kind} has {', '.join(names)}"
            yield ("check", i, "metric"), f"{check.metric!r} is unknown; {did_you_mean(check.metric, names)}{known}"
        if check.metric in AS_ASKED and not any(step.do in ("dock", "undock") for step in scenario.step):
            yield ("check", i, "metric"), f"{check.metric} says whether docks and undocks succeeded, and no [[step]] is one; leave it out"
        first = next(k for k, other in enumerate(scenario.check) if other.metric == check.metric)
        if first < i:
            yield ("check", i, "metric"), f"{check.metric} is checked by another [[check]] already; give low and high in one"
        if check.low <= -UNBOUNDED and check.high >= UNBOUNDED:
            yield ("check", i, "metric"), f"{check.metric} has neither low nor high; every value would pass"
        if check.low > check.high:
            yield ("check", i, "low"), f"{check.low:g} is above high, {check.high:g}; no value would pass"
        yield from ((("check", i, key), what) for key, what in _out_of_reach(check))


def _out_of_reach(check: Check) -> Iterator[tuple[str, str]]:
    """Yields the bounds of a check that no flight can satisfy."""
    can = shown(check.metric)
    if check.high < can.low:
        yield "high", f"{check.high:g}, and {check.metric} is {can.low:g} or more; no value would pass"
    if check.low > can.high:
        yield "low", f"{check.low:g}, and {check.metric} is {can.high:g} or less; no value would pass"


RULES = (
    _in_name, _in_numbers, _in_pitch, _in_polycube, _in_steps, _in_settling, _in_file, _in_bodies, _in_clamps, _in_docked, _in_cells,
    _in_tank, _in_moves, _in_start, _in_mentions, _in_faces, _in_undocks, _in_tags, _in_faults, _in_checks,
)  # fmt: skip
"""In order of priority: the first mistake found is the one reported."""
