"""Two pairs of modules that dock; the active pair is exactly where the sequence wants it."""

import numpy as np

from firmware_py.core.body import Body
from firmware_py.core.docking_detector import PairStatus
from firmware_py.core.docking_sequence import DockingSequence, SequenceOutputs, Stage
from firmware_py.core.rotations import from_euler, multiply, rotate, to_matrix
from firmware_py.core.setpoint import Wish
from firmware_py.core.types import DockRequest, Estimate
from firmware_py.description.parameters import Docking
from firmware_py.description.vehicle import FACE_NORMALS
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import PITCH_M, assemble
from firmware_py.prepare.docking import plan_dock

TICK_NS = 10_000_000
NEITHER = PairStatus(False, False, 0.01, 0.001)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def estimate(p_wb: np.ndarray, sigma_m: float = 0.001) -> Estimate:
    return Estimate(
        p_wb=p_wb, q_wb=LEVEL, nu=np.zeros(6), force_w=np.zeros(3), moment_b=np.zeros(3), sigma_p=np.full(3, sigma_m),
        sigma_q=np.full(3, 0.001), tag_age_ns=0, nis=1.0, nis_dof=6, rejected=0, ready=True,
    )  # fmt: skip


TILTED = from_euler(0.3, -0.4, 1.2)
DRIFT = np.array([0.02, -0.01, 0.03, 0.0, 0.0, 0.0])
STILL = np.zeros(6)
STAGED = Docking()


def face_of(body: Body, module: int, face: int, at: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """Centre and outward normal of a face in the world."""
    i = body.modules.index(module)
    normal = to_matrix(np.ascontiguousarray(body.q_bm[i])) @ FACE_NORMALS[face]
    return at.p_wb + rotate(at.q_wb, body.r_bm[i] + 0.5 * PITCH_M * normal), np.asarray(rotate(at.q_wb, normal))


class Follower:
    """The second module of a pair docks to the second of another, both tilted; the active pair is exactly where it is wanted."""

    def __init__(self, parameters: Docking = STAGED, nu: np.ndarray = STILL, target_approaches: bool = False) -> None:
        vehicles = [load_vehicle("modcube")] * 4
        self.target = assemble([(0, 0, 0), (0, 1, 0)], [0, 12], vehicles[:2], [0, 1])
        self.active = assemble([(0, 0, 0), (0, 0, 1)], [0, 12], vehicles[2:], [2, 3])
        self.plan = plan_dock(DockRequest(3, 3, 1, 0, 1), self.active, self.target, vehicles)
        self.sequence = DockingSequence(self.plan, self.active, self.target, parameters, 0, target_approaches)
        self.there = estimate(np.array([1.0, 2.0, 3.0]))._replace(q_wb=TILTED, nu=nu)
        self.face, self.outward = face_of(self.target, 1, 0, self.there)
        self.at = estimate(self.face + 0.5 * self.outward)._replace(q_wb=TILTED)
        self.tick = 0

    def step(self, status: PairStatus = NEITHER, waits: Wish | None = None) -> SequenceOutputs:
        self.tick += 1
        steering = self.sequence.step(self.tick * TICK_NS, self.at, self.there, status, waits)
        self.at = self.at._replace(p_wb=steering.active.p_wb, q_wb=steering.active.q_wb)
        return steering

    def until(self, stage: Stage, status: PairStatus = NEITHER) -> SequenceOutputs:
        while self.tick < 8000:
            steering = self.step(status)
            if self.sequence.stage == stage:
                return steering
        raise AssertionError(f"still {self.sequence.stage.name}")

    def astray(self, sideways_m: float = 0.0, turned_rad: float = 0.0) -> None:
        """Displaces the active body from where it is wanted."""
        across = np.cross(self.outward, [0.0, 0.0, 1.0])
        q_wb = multiply(self.at.q_wb, from_euler(0.0, 0.0, turned_rad))
        self.at = self.at._replace(p_wb=self.at.p_wb + sideways_m * across / np.linalg.norm(across), q_wb=q_wb)
