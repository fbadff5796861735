"""One undock under way: its magnets push until its joints are seen open, or else pictures and currents are asked whether one holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from firmware_py.core.docking_decisions import Estimated, Part
from firmware_py.core.docking_pairs import APART
from firmware_py.core.docking_plan import UndockPlan
from firmware_py.core.docking_traffic import thirds_of
from firmware_py.core.docking_way import first_blocking_module, way_of_piece
from firmware_py.core.joint_watch import JointWatch
from firmware_py.core.rotations import rotate
from firmware_py.core.types import DockRequest
from firmware_py.description.parameters import Docking

IN_PLACE = "pictures show that it is still in its place"
PULLED = "its magnets go on pulling"


class Undock(NamedTuple):
    """State of an undock: magnets push until the body parts, which happens at once if every joint is open already."""

    plan: UndockPlan
    pipelines: tuple[Any, ...]
    since_ns: int
    until_ns: int
    seen_ns: int
    """Deadline by which pictures and currents from the latter half of the push have arrived, if any still come."""
    last_ns: int
    """End of the extended push: while a joint still holds, magnets push for as long again, because a short push shows late."""
    before_ma: Mapping[DockRequest, np.ndarray | None]
    """Currents (2,) of the joints before the push, where both of their magnets were on."""

    @staticmethod
    def begun(plan: UndockPlan, pipelines: tuple[Any, ...], time_ns: int, holds: bool, p: Docking, joints: JointWatch) -> Undock:
        """Creates an undock that begins now; `holds`: not every joint is open."""
        push_ns, seen_ns = (round(ns) if holds else 0 for ns in (p.release_s * 1e9, 2e6 * p.pose_fresh_ms))
        last_ns = time_ns + max(2 * push_ns, seen_ns)
        before_ma = {joint: joints.strong_ma(joint) for joint in plan.opens}
        return Undock(plan, pipelines, time_ns, time_ns + push_ns, time_ns + seen_ns, last_ns, before_ma)

    def pushes(self, time_ns: int, joints: JointWatch) -> bool:
        """Whether it is too early to call `held_by`: a single joint waits for a picture, several joints for their currents. Joints that
        are all APART have been pushed enough: until their body parts, its pieces are steered as one, each against what the other does.
        """
        if len(joints.existing(self.plan.opens, APART)) == len(self.plan.opens):
            return False
        has_evidence = self._has_picture if len(self.plan.opens) == 1 else self._has_currents
        return time_ns < self.until_ns or (time_ns < self.seen_ns and not has_evidence(time_ns, joints))

    def held_by(self, time_ns: int, joints: JointWatch) -> str:
        """Evidence, in words, that a joint still holds, as with a stuck relay: parted, the two bodies would fly against each other. Empty
        if there is none.

        Where several joints part at once, their funnels hold back a piece that leaves sideways until thrusters pull it out, so pictures
        prove nothing: only currents count.
        """
        half_ns, joint = self._half_ns(time_ns), self.plan.opens[0]
        if len(self.plan.opens) == 1 and self._has_picture(time_ns, joints):
            return IN_PLACE if joints.newest_ns(joint, "near_ns") > half_ns else ""
        pulled = ((before, joints.strong_ma(joint, half_ns)) for joint, before in self.before_ma.items())
        return PULLED if any(a is not None and b is not None and np.all(a * b > 0.0) for a, b in pulled) else ""

    def part(self, whole: int, estimates: Estimated, p: Docking) -> Part:
        """How the body parts: the leaving piece glides away; if a third body is in its way, the staying one does; else neither moves."""
        (body, at), plan, (stays, leaves) = estimates[whole], self.plan, self.pipelines
        thirds = thirds_of(estimates, whole) if at.placed else []
        away_w = rotate(at.q_wb, plan.axis_b) * p.standoff_m
        for piece, rest, goes, by_w in ((plan.leaves, stays, leaves, away_w), (plan.stays, leaves, stays, -away_w)):
            if first_blocking_module(way_of_piece(plan, piece, body, at, by_w), thirds, p) is None:
                return Part(whole, rest, goes, by_w)
        return Part(whole, stays, leaves, np.zeros(3))

    def _has_picture(self, time_ns: int, joints: JointWatch) -> bool:
        """Whether a picture shows the first joint in the latter half of the push."""
        return joints.newest_ns(self.plan.opens[0], "picture_ns") > self._half_ns(time_ns)

    def _has_currents(self, time_ns: int, joints: JointWatch) -> bool:
        """Whether every joint with currents before the push has newer ones from its latter half."""
        felt = [joint for joint, before in self.before_ma.items() if before is not None]
        return all(joints.newest_ns(joint, "current_ns") > self._half_ns(time_ns) for joint in felt)

    def _half_ns(self, time_ns: int) -> int:
        return (self.since_ns + time_ns) // 2
