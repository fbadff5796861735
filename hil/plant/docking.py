"""State machine of the docking faces: coil currents, contacts of probe and funnel, jams, locking and opening of joints. Once per tick.

contact.py computes the forces; the world carries out the decisions made here.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from firmware_py.description.vehicle import FACE_NORMALS, Vehicle
from hil.plant.bodies import Modules
from hil.plant.contact import Faces, mating, near
from hil.plant.dock_spec import DockSpec, JamRule
from hil.plant.draw import stream
from hil.plant.overlap import CORNERS, FACES_OF_TWO

KINDS = {"P": 1.0, "D": -1.0, "-": 0.0}
RELAY = (0.0, 1.0, -1.0, 0.0)
"""Steady current, share of full, of each relay state: off, forward, reverse, fault."""
FORWARD = 1
LEAST_HOLD = 0.05
"""Share of the full pull below which the magnets release a joint."""
OPENING_M_S = 0.001
"""Opening speed above which faces do not lock: they were just pulled open."""
DISK_M = 0.07
"""Radius of a docking disk: a bending moment on a joint is carried as a pull at the rim (synthetic)."""


class Joint(NamedTuple):
    """Two faces locked together."""

    module: int
    face: int
    other: int
    other_face: int


class Facing(NamedTuple):
    """Two faces that face each other, as `contact.mating` returns them."""

    face: float
    other_face: float
    gap_m: float
    lateral_m: float
    tilt: float
    roll: float
    """From the nearest quarter turn, rad."""
    closing_m_s: float
    fits: float
    """1 for a probe and a drogue."""


class Contact(NamedTuple):
    """First contact of a probe with a funnel."""

    time_ns: int
    module: int
    other: int
    lateral_m: float
    speed_m_s: float
    tilt_deg: float
    jammed: bool


class Verdict(NamedTuple):
    """Joints that the world has to close and to open."""

    join: list[Joint]
    part: list[Joint]


class Docks:
    """State of all docking faces of the world."""

    def __init__(self, vehicles: Sequence[Vehicle], spec: DockSpec, jam: JamRule, seed: int) -> None:
        m = len(vehicles)
        self.spec, self.jam_rule = spec, jam
        self.faces = Faces(
            np.array([[KINDS[k] for k in v.faces] for v in vehicles]),
            np.zeros((m, 6)), np.zeros((m, m)), np.zeros((m, m)), np.zeros((2, CORNERS, 3)), np.zeros((FACES_OF_TWO, 4)),
            spec.pull_n, spec.magnet_gap_m, spec.guide_n_m, spec.guide_ns_m, spec.turn_nm, spec.turn_nms,
            spec.stop_n_m, spec.stop_ns_m, spec.contact_n_m3, spec.contact_ns_m3,
        )  # fmt: skip
        self.relays = np.zeros((m, 6), dtype=np.int64)
        self.joints: list[Joint] = []
        self.contacts: list[Contact] = []
        self.gap_m = self.lateral_m = math.nan
        """Gap and lateral error between the pair of faces that is nearest to docking; nan: none is near."""
        self._stuck = np.full((m, 6), -1, dtype=np.int64)
        self._surge = np.zeros((m, 6))
        self._engaged = np.zeros((m, 6))
        self.busy = False
        """Whether any coil is on or its current is still decaying."""
        self._jam = stream(seed, "jam")
        self._magnet_w = np.array([v.supply.magnet_w for v in vehicles])

    def set_relays(self, module: int, relays: Sequence[int]) -> None:
        """Applies the relay states of a DOCK_CMD to one module's six coils; stuck relays keep theirs."""
        wanted = np.where(self._stuck[module] >= 0, self._stuck[module], np.array(relays, dtype=np.int64))
        changed = wanted != self.relays[module]
        if changed.any():
            self._surge[module, changed] = 1.0
            self.relays[module] = wanted
            self.busy = True

    def stick_relay(self, module: int, face: int, relay: int) -> None:
        """Fault: makes a relay stick in the state `relay`; it takes effect at `apply_stuck` or the next command."""
        self._stuck[module, face] = relay

    def unstick_relays(self, module: int) -> None:
        """Ends the stuck-relay faults of a module; the relays obey again from the next command on."""
        self._stuck[module] = -1

    def apply_stuck(self, module: int) -> None:
        """Switches all stuck relays of a module to the states in which they stick."""
        self.set_relays(module, self.relays[module].tolist())

    def energise(self, joints: Sequence[Joint]) -> None:
        """Sets the joints of modules that start docked, with their magnets on and the currents settled."""
        self.joints = list(joints)
        for joint in joints:
            for m, f in ((joint.module, joint.face), (joint.other, joint.other_face)):
                self.relays[m, f] = FORWARD
                self.faces.coil[m, f] = self._engaged[m, f] = 1.0
        self.busy = bool(joints)

    def magnet_power_w(self) -> np.ndarray:
        """(m,) power that the coils of each module draw from its supply."""
        return np.asarray(self._magnet_w * (np.take(RELAY, self.relays) != 0.0).sum(axis=1))

    def current_ma(self) -> np.ndarray:
        """(m, 6) present current of every coil, without measurement noise."""
        s = self.spec
        size = s.idle_ma + s.engaged_ma * self._engaged + s.surge_ma * self._surge
        return np.asarray(self.faces.coil * size)

    def step(
        self,
        time_ns: int,
        elapsed_s: float,
        modules: Modules,
        state: np.ndarray,
        load_n: Callable[[Joint], float],
    ) -> Verdict:
        """Advances the docking faces by one tick; `load_n` gives the pull on a joint."""
        verdict = Verdict([], [])
        if self.busy:
            self._coils(elapsed_s)
        pairs = itertools.combinations(range(len(self.relays)), 2)
        self._engaged[:] = 0.0
        self.gap_m = self.lateral_m = math.nan
        for i, j in pairs:
            if near(modules, state, i, j):
                self._pair(time_ns, i, j, modules, state, verdict)
            elif self.faces.inside[i, j] and modules.body[i] != modules.body[j]:
                self._let_go(i, j)
        for joint in self.joints:
            self._engaged[joint.module, joint.face] = self._engaged[joint.other, joint.other_face] = 1.0
            coil = self.faces.coil
            hold = 0.5 * (coil[joint.module, joint.face] + coil[joint.other, joint.other_face])
            if hold < LEAST_HOLD or load_n(joint) > hold * self.spec.pull_n:
                verdict.part.append(joint)
        return verdict

    def joined(self, joint: Joint) -> None:
        """Records a joint that the world has closed."""
        self.joints.append(joint)

    def parted(self, joint: Joint) -> None:
        """Records that the world has opened a joint; the probe is still in its funnel."""
        self.joints.remove(joint)
        i, j = sorted((joint.module, joint.other))
        self.faces.inside[i, j], self.faces.stop[i, j] = 1.0, 0.0

    def _coils(self, elapsed_s: float) -> None:
        """Lets the coil currents follow their relays and the surges of switching decay."""
        wanted = np.take(RELAY, self.relays)
        self.faces.coil[:] += (wanted - self.faces.coil) * -math.expm1(-elapsed_s / self.spec.coil_lag_s)
        self._surge *= math.exp(-elapsed_s / self.spec.surge_s)
        self.busy = bool(self.relays.any() or np.abs(self.faces.coil).max() > 1e-9)

    def _pair(self, time_ns: int, i: int, j: int, modules: Modules, state: np.ndarray, verdict: Verdict) -> None:
        """Updates two modules of different bodies that are close: engagement, contact, release or lock."""
        pair = Facing(*mating(modules, self.faces, state, i, j))
        if not pair.fits:
            return
        s, gap, lateral, tilt_deg = self.spec, pair.gap_m, pair.lateral_m, math.degrees(pair.tilt)
        if not self.gap_m + self.lateral_m <= gap + lateral:
            self.gap_m, self.lateral_m = gap, lateral
        near_by = math.exp(-max(0.0, gap) / s.engage_m - (lateral / s.engage_side_m) ** 2)
        for m, face in ((i, int(pair.face)), (j, int(pair.other_face))):
            self._engaged[m, face] = max(self._engaged[m, face], near_by)
        if not self.faces.inside[i, j]:
            if gap <= s.probe_m and lateral <= s.mouth_m and tilt_deg <= s.funnel_deg:
                self._meet(Contact(time_ns, i, j, lateral, pair.closing_m_s, tilt_deg, False))
        elif gap > s.rearm_m or lateral > s.mouth_m:
            self._let_go(i, j)
        else:
            joint = Joint(i, int(pair.face), j, int(pair.other_face))
            if pair.closing_m_s > -OPENING_M_S and self._locks(joint, pair):
                verdict.join.append(joint)

    def _meet(self, contact: Contact) -> None:
        i, j, rule = contact.module, contact.other, self.jam_rule
        chance, depth = self._jam.random(2)
        jammed = bool(chance < rule.probability(contact.lateral_m, contact.speed_m_s, contact.tilt_deg))
        self.faces.inside[i, j] = 1.0
        self.faces.stop[i, j] = self.spec.probe_m * (rule.shallowest + (1.0 - rule.shallowest) * depth) if jammed else 0.0
        self.contacts.append(contact._replace(jammed=jammed))

    def _let_go(self, i: int, j: int) -> None:
        self.faces.inside[i, j] = self.faces.stop[i, j] = 0.0

    def _locks(self, joint: Joint, pair: Facing) -> bool:
        """Whether two faces are close enough to lock, with their magnets on and no jam between them."""
        s, coil = self.spec, self.faces.coil
        pull = 0.5 * (coil[joint.module, joint.face] + coil[joint.other, joint.other_face])
        return bool(
            self.faces.stop[joint.module, joint.other] == 0.0
            and pull > 2.0 * LEAST_HOLD
            and abs(pair.gap_m) <= s.lock_m
            and pair.lateral_m <= s.lock_m
            and max(abs(pair.tilt), abs(pair.roll)) <= math.radians(s.lock_deg)
        )


def joints_between(modules: Modules, kinds: np.ndarray) -> list[Joint]:
    """Returns the joints between adjacent modules of one body, where a probe meets a drogue."""
    found = []
    for i, j in itertools.combinations(range(len(modules.body)), 2):
        if modules.body[i] != modules.body[j]:
            continue
        way = modules.position[j] - modules.position[i]
        f_i = int(np.argmax(FACE_NORMALS @ (modules.turn[i].T @ way)))
        f_j = int(np.argmax(FACE_NORMALS @ (modules.turn[j].T @ -way)))
        reach = 0.5 * (modules.size[i, f_i // 2] + modules.size[j, f_j // 2])
        if abs(np.linalg.norm(way) - reach) < 0.01 * reach and kinds[i, f_i] * kinds[j, f_j] < 0.0:
            found.append(Joint(i, f_i, j, f_j))
    return found
