"""Right of way among docks under way: which bodies wait for a third body or make room, and which targets can come no farther."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

from firmware_py.core.body import Body
from firmware_py.core.docking_decisions import Estimated, Prepared
from firmware_py.core.docking_detector import PairDetector
from firmware_py.core.docking_sequence import DockingSequence, Stage
from firmware_py.core.docking_way import WAY_SLACK, Way, first_blocking_module, way_of_active
from firmware_py.core.names import name_module
from firmware_py.core.setpoint import REST, Wish
from firmware_py.core.types import Estimate
from firmware_py.description.parameters import Docking

AHEAD = {Stage.PRE_APPROACH: (1.0, WAY_SLACK), Stage.APPROACH: (0.0, math.inf)}
"""Stages in which the active body travels: the gap at which its way ends, and its slack (see WAY_SLACK), as shares of the stand-off.
During the approach it waits only for bodies that it would touch, because others may stand beside the target's face."""


class Dock(NamedTuple):
    """A dock under way."""

    sequence: DockingSequence
    detector: PairDetector
    active: int
    target: int
    prepared: Prepared
    start_pose: Wish
    """Pose of the active body at the start of the dock, to which it returns to give way to others."""
    reported: set[str]
    """Reasons for waiting that were reported already."""


class Wait(NamedTuple):
    """What the active body of a dock does while another body blocks its way."""

    wish: Wish
    """What the active body glides by."""
    words: str


class _Course(NamedTuple):
    """The way of a dock's active body, and what blocks it."""

    dock: Dock
    way: Way
    thirds: Sequence[tuple[Body, Estimate]]
    slack: float
    """Share of the stand-off, see WAY_SLACK."""
    blocked_by: int | None
    """A module that blocks the way, or the target module while its body is still moving elsewhere; None: the way is free."""


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
        for k in reversed(range(len(courses))):  # the latest dock makes room first
            if self._yields(courses[k], courses[:k], courses[k + 1 :]):
                self._yielding.add(courses[k].dock.active)

    def is_coming(self, dock: Dock) -> bool:
        """Whether the target of a dock is on its way to meet the active body."""
        return dock.sequence.meets_at_w is not None and dock.target in self._coming

    def blocked(self, dock: Dock) -> str:
        """Reason why a target that comes to meet the active body can come no farther; empty if it can, or does not come."""
        to_w, plan = dock.sequence.meets_at_w, dock.sequence.plan
        if to_w is None or not self.is_coming(dock):
            return ""
        body, at = self._estimates[dock.target]
        way = Way(body, at.p_wb, at.q_wb, to_w, at.q_wb, plan.pitch_m)
        blocker = first_blocking_module(way, thirds_of(self._estimates, dock.active, dock.target), self._p)
        return "" if blocker is None else f"{name_module(blocker)} is where {name_module(plan.request.target_module)} comes to meet it"

    def wait(self, dock: Dock) -> Wait | None:
        """What the active body does about a third body that blocks its way, or others that wait for it; None: there are none."""
        if dock.active in self._yielding:
            return Wait(dock.start_pose, "gives way to another")
        course = self._courses.get(dock.active)
        return None if course is None or course.blocked_by is None else Wait(REST, f"waits: {name_module(course.blocked_by)} is on its way")

    def _course(self, dock: Dock) -> _Course | None:
        """The course of a dock; None if its active body is not travelling, or there is no third body."""
        thirds = thirds_of(self._estimates, dock.active, dock.target)
        sequence = dock.sequence
        if not thirds or sequence.stage not in AHEAD:
            return None
        gap, slack = AHEAD[Stage.APPROACH if self._p.approach == "straight" else sequence.stage]
        body, target_at = self._estimates[dock.target]
        target_at, gap_m = sequence.target_to_meet(target_at), gap * self._p.standoff_m
        way = way_of_active(sequence.plan, *self._estimates[dock.active], body, target_at, gap_m)
        target_approaches = dock.target in self._coming and sequence.meets_at_w is None
        blocker = sequence.plan.request.target_module if target_approaches else first_blocking_module(way, thirds, self._p, slack)
        return _Course(dock, way, thirds, slack, blocker)

    def _yields(self, mine: _Course, before: Sequence[_Course], after: Sequence[_Course]) -> bool:
        """Whether the active body returns to where its dock began. This breaks deadlocks: it does so while it waits itself, or until it
        has made room, for earlier docks that wait for it, and for a later dock where each waits for the other and that one cannot yield.

        It yields only where the way back is free and its old place is out of their ways.
        """
        body, start_pose = mine.way.body, mine.dock.start_pose
        stuck = [other for other in after if mine.blocked_by in other.way.body.modules and other.dock.active not in self._yielding]
        waiting = [other for other in (*before, *stuck) if other.blocked_by in body.modules]
        if not waiting or not (mine.blocked_by is not None or mine.dock.sequence.makes_room):
            return False
        assert start_pose.p_wb is not None and start_pose.q_wb is not None
        there = (body, self._estimates[mine.dock.active][1]._replace(p_wb=start_pose.p_wb, q_wb=start_pose.q_wb))
        is_free = first_blocking_module(mine.way._replace(p_end=start_pose.p_wb, q_end=start_pose.q_wb), mine.thirds, self._p) is None
        return is_free and all(first_blocking_module(other.way, [there], self._p, other.slack) is None for other in waiting)


def thirds_of(estimates: Estimated, *pair: int) -> list[tuple[Body, Estimate]]:
    """All bodies except a pair."""
    return [placed for number, placed in estimates.items() if number not in pair]
