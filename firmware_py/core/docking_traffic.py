"""Right of way among the docks under way: who waits for a third body, who makes room, and whose target can come no farther."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

from firmware_py.core.body import Body
from firmware_py.core.docking_decisions import Estimated, Prepared
from firmware_py.core.docking_detector import PairDetector
from firmware_py.core.docking_sequence import DockingSequence, Stage
from firmware_py.core.docking_way import WAY_SLACK, Way, first_met, way_of_active
from firmware_py.core.setpoint import REST, Wish
from firmware_py.core.types import Estimate
from firmware_py.description.parameters import Docking

AHEAD = {Stage.PRE_APPROACH: (1.0, WAY_SLACK), Stage.APPROACH: (0.0, math.inf)}
"""Stages in which the active body is on a way: the gap that it ends at, and the slack that it leaves to others, as shares of the stand-off.
The last piece is waited with only for those that it would touch: beside the target's face there may be others."""


class Dock(NamedTuple):
    """A dock under way."""

    sequence: DockingSequence
    detector: PairDetector
    active: int
    target: int
    prepared: Prepared
    began: Wish
    """Where the active body was: there it gives way to others."""
    said: set[str]
    """What has been said of its waiting."""


class Wait(NamedTuple):
    """What the active body of a dock does while somebody is on its way."""

    wish: Wish
    """What it glides by."""
    words: str


class _Course(NamedTuple):
    """What is on the way of a dock's active body."""

    dock: Dock
    way: Way
    thirds: Sequence[tuple[Body, Estimate]]
    slack: float
    """Share of the stand-off that it leaves to others."""
    met: int | None
    """A module where the way leads, or of a target that has not yet come where it goes."""


class Traffic:
    """The docks under way in one tick, in the order in which they began."""

    def __init__(self, docks: Sequence[Dock], estimates: Estimated, coming: Collection[int], parameters: Docking) -> None:
        """`coming`: bodies that are on their way to meet another."""
        self._estimates = estimates
        self._coming = coming
        self._p = parameters
        courses = [course for dock in docks if (course := self._course(dock)) is not None]
        self._courses = {course.dock.active: course for course in courses}
        self._yielding = set[int]()
        for k in reversed(range(len(courses))):  # the last to come is the first to make room
            if self._yields(courses[k], courses[:k], courses[k + 1 :]):
                self._yielding.add(courses[k].dock.active)

    def blocked(self, dock: Dock) -> str:
        """Why a target that comes to meet the active body can come no farther; empty: it can, or it does not come."""
        to_w, plan = dock.sequence.meets_at_w, dock.sequence.plan
        if to_w is None or dock.target not in self._coming:
            return ""
        body, at = self._estimates[dock.target]
        way = Way(body, at.p_wb, at.q_wb, to_w, at.q_wb, plan.pitch_m)
        met = first_met(way, thirds_of(self._estimates, dock.active, dock.target), self._p)
        return "" if met is None else f"module {met} is where module {plan.request.target_module} comes to meet it"

    def wait(self, dock: Dock) -> Wait | None:
        """What the active body does for a third body on its way, or for others that wait for it; None: there are none."""
        if dock.active in self._yielding:
            return Wait(dock.began, "gives way to another")
        course = self._courses.get(dock.active)
        return None if course is None or course.met is None else Wait(REST, f"waits: module {course.met} is on its way")

    def _course(self, dock: Dock) -> _Course | None:
        """None: it is on no way, or there is nobody else."""
        thirds = thirds_of(self._estimates, dock.active, dock.target)
        sequence = dock.sequence
        if not thirds or sequence.stage not in AHEAD:
            return None
        gap, slack = AHEAD[Stage.APPROACH if self._p.approach == "straight" else sequence.stage]
        body, target_at = self._estimates[dock.target]
        way = way_of_active(sequence.plan, *self._estimates[dock.active], body, sequence.met(target_at), gap * self._p.standoff_m)
        comes = dock.target in self._coming and sequence.meets_at_w is None
        met = sequence.plan.request.target_module if comes else first_met(way, thirds, self._p, slack)
        return _Course(dock, way, thirds, slack, met)

    def _yields(self, mine: _Course, before: Sequence[_Course], after: Sequence[_Course]) -> bool:
        """Whether the active body goes back to where it was when its dock began: while it waits itself, or until it has made room, for
        the docks before its own that wait for it, else all would wait for ever; and for one after it that it waits for, and that cannot.

        Only where it is then out of their ways.
        """
        body, began = mine.way.body, mine.dock.began
        stuck = [other for other in after if mine.met in other.way.body.modules and other.dock.active not in self._yielding]
        waiting = [other for other in (*before, *stuck) if other.met in body.modules]
        if not waiting or not (mine.met is not None or mine.dock.sequence.makes_room):
            return False
        assert began.p_wb is not None and began.q_wb is not None
        there = (body, self._estimates[mine.dock.active][1]._replace(p_wb=began.p_wb, q_wb=began.q_wb))
        is_free = first_met(mine.way._replace(p_end=began.p_wb, q_end=began.q_wb), mine.thirds, self._p) is None
        return is_free and all(first_met(other.way, [there], self._p, other.slack) is None for other in waiting)


def thirds_of(estimates: Estimated, *pair: int) -> list[tuple[Body, Estimate]]:
    """The bodies beside a pair."""
    return [placed for number, placed in estimates.items() if number not in pair]
