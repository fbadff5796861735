"""Keys of a scenario file that not every kind of tank, task or step has: one without effect is refused."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from hil.scenario_rules import Mistake

if TYPE_CHECKING:
    from hil.scenario import Scenario

OWN_KEYS = {
    "tank": {"box": ("size_m",), "cylinder": ("radius_m", "depth_m")},
    "task": {
        "hover": ("centre_m",),
        "spiral": ("centre_m", "radius_m", "climb_m", "turns"),
        "moebius": ("centre_m", "radius_m", "half_width_m", "turns"),
        "lissajous": ("centre_m", "amplitude_m", "frequency", "turns", "yaw_turns", "roll_turns"),
        "waypoints": ("file",),
        "dock": ("ground_until_s",),
        "force": ("stick",),
        "mode": ("centre_m", "mode", "pilot_until_s", "ground_until_s"),
    },
}
"""Keys that not every kind of a table has, by kind; a dock with steps along the strip has those of moebius."""
_PAIR = ("module", "face", "target_module", "target_face", "quarter_turns", "both_approach")
STEP_KEYS = {
    "dock": _PAIR,
    "undock": _PAIR,
    "move": ("module", "position_m", "duration_s"),
    "moebius_start": ("module", "duration_s"),
    "moebius": ("module", "duration_s"),
    "wait": ("duration_s",),
}
"""Keys of a step, by what it does, besides `do` and `also`."""


def idle_keys(scenario: Scenario, given: Mapping[str, Any]) -> Iterator[Mistake]:
    """Yields the keys `given` in its file that have no effect in the scenario, and moves without a target."""
    on_strip = scenario.task.kind == "dock" and any(step.do.startswith("moebius") for step in scenario.step)
    for table, kind, has in (
        ("tank", scenario.tank.kind, scenario.tank.kind), ("task", scenario.task.kind, "moebius" if on_strip else scenario.task.kind)
    ):  # fmt: skip
        idle = set(itertools.chain(*OWN_KEYS[table].values())).difference(OWN_KEYS[table][has])
        for key in given[table]:
            if key in idle:
                yield (table, key), f"a {table} of the kind {kind} has no {key}; leave it out, or give another kind"
    for i, step in enumerate(given.get("step", ())):
        for key in step:
            if key not in ("do", "also", *STEP_KEYS[step["do"]]):
                yield ("step", i, key), f"a {step['do']} has no {key}; leave it out"
        if step["do"] == "move" and "position_m" not in step:
            yield ("step", i, "position_m"), "a move needs it: where the body goes"
