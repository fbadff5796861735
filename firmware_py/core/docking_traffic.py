"""Right of way among the docks under way: who waits for a third body, who makes room, and whose target can come no farther."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

from firmware_py.core.body import Body
from firmware_py.core.docking_decisions import Estimated
from firmware_py.core.docking_sequence import DockingSequence, Stage
from firmware_py.core.docking_way import WAY_SLACK, Way, first_met, way_of_active
from firmware_py.core.setpoint import REST, Wish
from firmware_py.core.types import Estimate
from firmware_py.description.parameters import Docking

AHEAD = {Stage.PRE_APPROACH: (1.0, WAY_SLACK), Stage.APPROACH: (0.0, math.inf)}
"""Stages in which the active body is on a way: the gap that it ends at, and the slack that it leaves to others, as shares of the stand-off.
The last piece is waited with only for those that it would touch: beside the target's face there may be others."""


class Wait(NamedTuple):
    """What the active body of a dock does while somebody is on its way."""

    wish: Wish
    """What it glides by."""
    words: str


class Traffic:
    """The bodies of one tick. Docks ask in the order in which they began."""

    def __init__(self, estimates: Estimated, coming: Collection[int], parameters: Docking) -> None:
        """`coming`: bodies that are on their way to meet another."""
        self._estimates = estimates
        self._coming = coming
        self._p = parameters
        self._awaited: set[int] = set()
        """Modules that the docks before wait for."""

    def blocked(self, sequence: DockingSequence, active: int, target: int) -> str:
        """Why a target that comes to meet the active body can come no farther; empty: it can, or it does not come."""
        to_w, plan = sequence.meets_at_w, sequence.plan
        if to_w is None or target not in self._coming:
            return ""
        body, at = self._estimates[target]
        way = Way(body, at.p_wb, at.q_wb, to_w, at.q_wb, plan.pitch_m)
        met = first_met(way, thirds_of(self._estimates, active, target), self._p)
        return "" if met is None else f"module {met} is where module {plan.request.target_module} comes to meet it"

    def wait(self, sequence: DockingSequence, active: int, target: int, began: Wish) -> Wait | None:
        """What the active body does for a third body on its way; None: none is.

        Args:
            began: where it was when its dock began. One that others wait for while it waits itself goes back there: else all wait for ever.
        """
        thirds = thirds_of(self._estimates, active, target)
        if not thirds or sequence.stage not in AHEAD:
            return None
        gap, slack = AHEAD[sequence.stage]
        body, target_at = self._estimates[target]
        way = way_of_active(sequence.plan, *self._estimates[active], body, sequence.met(target_at), gap * self._p.standoff_m)
        met = first_met(way, thirds, self._p, slack)
        if met is None:
            return None
        makes_room = not self._awaited.isdisjoint(way.body.modules) and self._is_free(way, began, thirds)
        self._awaited.add(met)
        return Wait(began, "gives way to one that began before it") if makes_room else Wait(REST, f"waits: module {met} is on its way")

    def _is_free(self, way: Way, to: Wish, thirds: Sequence[tuple[Body, Estimate]]) -> bool:
        """Whether the body may go there from where it is."""
        assert to.p_wb is not None and to.q_wb is not None
        return first_met(way._replace(p_end=to.p_wb, q_end=to.q_wb), thirds, self._p) is None


def thirds_of(estimates: Estimated, *pair: int) -> list[tuple[Body, Estimate]]:
    """The bodies beside a pair."""
    return [placed for number, placed in estimates.items() if number not in pair]
