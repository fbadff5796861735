"""A robot in water that follows the model except for the errors that every real robot has, and its fault detector."""

import numpy as np

from firmware_py.core import propagation
from firmware_py.core.body import Body
from firmware_py.core.faults import FaultDetector
from firmware_py.core.preload import preload
from firmware_py.core.propagation import STATES
from firmware_py.core.rotations import difference, from_euler, to_matrix
from firmware_py.core.thruster import ThrusterLag
from firmware_py.core.types import MCU_TIMED_OUT, EscFeedback, Estimate, Measured, ModuleInputs
from firmware_py.description.failsafe_parameters import Faults
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle

BODY = assemble_vehicle(load_vehicle("modcube"))
PUSH = preload(BODY.thrusters, np.ones(8, dtype=bool), 0.6)
"""The preload: the least that an armed robot commands, with the thrusters pushing against each other, so that nothing moves."""
TICK_NS, DT = 10_000_000, 0.01
ZERO = np.zeros(3)


class Water:
    """A robot that holds position by PD, in water that follows the model except for usual errors; ESC feedback at 10 Hz."""

    def __init__(self, seed: int = 0, body: Body = BODY, dt_s: float = DT) -> None:
        self.rng = np.random.default_rng(seed)
        self.body, self.dt_s, n = body, dt_s, body.thrusters.f_max.size
        self.detector = FaultDetector(body, Faults(), round(dt_s * 1e9))
        self.believed, self.acts = ThrusterLag(body.thrusters, dt_s), ThrusterLag(body.thrusters, dt_s)
        self.gain = self.rng.uniform(0.95, 1.05, n)
        self.deadband = self.rng.uniform(0.10, 0.25, n)
        self.speed_factor, self.stray_rpm = np.ones(n), np.zeros(n)
        self.status = np.zeros(n, dtype=int)
        self.heard = 1.0
        self.imu_every = 1
        """Ticks from one sample of the IMU to the next."""
        self.deaf: int | None = None
        """Module that says that it hears no commands."""
        self.accel_bias = np.full(3, 0.05)
        self.free = True
        self.pushed = np.zeros(6)
        """Wrench of a wall or a hand, N and N m, body frame."""
        self.tag_age_ns = 0
        self.x = np.zeros(STATES)
        self.x[2] = 2.0
        self.x[3:7] = from_euler(0.05, -0.02, 0.3)
        self.x[19:22], self.x[22:25] = [0.1, -0.05, 0.1], [0.003, -0.004, 0.002]
        self.start = self.x.copy()
        self.tick = 0

    def run(self, seconds: float, wanted: np.ndarray = PUSH, armed: bool = True) -> list[tuple[float, str]]:
        """Returns the faults found, each with the time since the start of this run, s."""
        found = []
        for n in range(round(seconds / self.dt_s)):
            found += [((n + 1) * self.dt_s, words) for words in self._step(wanted if armed else np.zeros(self.gain.size), armed)]
        return found

    def _step(self, wanted: np.ndarray, armed: bool) -> list[str]:
        self.tick += 1
        if armed:
            wanted = wanted + self.body.thrusters.pinv @ self._steer()
        wanted = np.where(self.detector.now.alive, wanted, 0.0)
        believed, acting = self.believed.step(), self.acts.step()
        self.believed.command(wanted)
        self.acts.command(np.where(np.abs(wanted) < self.deadband, 0.0, wanted))
        b, tau = self.body, self.body.thrusters.matrix @ (self.gain * acting) + self.pushed
        felt = propagation.inertial_acceleration(self.x, tau, *b.plant)
        self.x = propagation.step(self.x, tau, self.dt_s, *b.plant)
        estimate = Estimate(
            self.x[:3].copy(), self.x[3:7].copy(), self.x[7:13].copy(), ZERO, ZERO, np.full(3, 0.002), np.full(3, 0.0009),
            self.tag_age_ns, 1.0, 6, 0, True,
        )  # fmt: skip
        gyro = self.x[10:13] + 0.005 + 0.002 * self.rng.normal(size=3)
        weight = to_matrix(self.x[3:7].copy()).T @ np.array([0.0, 0.0, 9.80665])
        accel = felt - weight + self.accel_bias + 0.03 * self.rng.normal(size=3)
        measured = Measured(gyro, accel, None, [])
        if self.rng.uniform() >= self.heard or self.tick % self.imu_every:
            measured = Measured(None, None, None, [])
        fleet = [ModuleInputs() for _ in range(max(b.modules) + 1)]
        for number, module in enumerate(b.modules):
            state = MCU_TIMED_OUT if module == self.deaf else None
            fleet[module] = ModuleInputs(heard=True, mcu_state=state, esc=self._feedback(8 * number))
        self.detector.step(fleet, measured, estimate, self.believed.force_n, believed, armed, self.free)
        return self.detector.words

    def _steer(self) -> np.ndarray:
        q = self.x[3:7].copy()
        off = np.r_[to_matrix(q).T @ (self.start[:3] - self.x[:3]), difference(self.start[3:7].copy(), q)]
        return self.body.mass @ (np.repeat([6.0, 9.0], 3) * off - np.repeat([5.0, 6.0], 3) * self.x[7:13])

    def _feedback(self, at: int) -> list[EscFeedback]:
        """ESC frames of the module whose thrusters are `at` and the seven that follow."""
        frames = []
        for first in range(0, 8, 2):
            if self.tick % round(0.1 / self.dt_s) == first and self.rng.uniform() < self.heard:
                rpm = [
                    self.speed_factor[i] * self.detector.believed_rpm(i, float(self.acts.force_n[i]))
                    + self.stray_rpm[i] + 5.0 * self.rng.normal()
                    for i in (at + first, at + first + 1)
                ]
                status = (int(self.status[at + first]), int(self.status[at + first + 1]))
                frames.append(EscFeedback(first, (rpm[0], rpm[1]), (0.5, 0.5), status))
        return frames

    def fly(self, seconds: float = 3.0) -> None:
        """Runs a second disarmed, then `seconds` armed; asserts that nothing is found."""
        assert self.run(1.0, armed=False) == []
        assert self.run(seconds) == []
