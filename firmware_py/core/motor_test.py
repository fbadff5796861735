"""Motor test: turns one thruster, or all one after the other (MOTOR_DETECT), bypassing controller and allocator; the limiter still
applies.

MOTOR_DETECT turns each thruster forward, twice as long in reverse, and forward again, all with the same force. This shows both
directions, and undoes its own effect on position and attitude of a free robot.
"""

from __future__ import annotations

import numpy as np

from firmware_py.core.body import Body
from firmware_py.description.steering_parameters import Steering

PAUSE_SHARE = 0.5
"""Pause after each thruster, as a share of the time that it turns."""
LONGEST_S = 10.0
"""Longest duration of a test; a longer request is cut to it."""


class MotorTest:
    """Makes the forces of the running test."""

    def __init__(self, body: Body, parameters: Steering) -> None:
        self.parameters = parameters
        self._high, self._low = body.thrusters.f_max, body.thrusters.f_min
        self._plan: list[tuple[int, int, float]] = []
        """Steps in order: end time, ns; thruster; force, N."""

    @property
    def running(self) -> bool:
        """Whether a test is in progress."""
        return bool(self._plan)

    def start(self, argument: tuple[int, float, float], time_ns: int) -> None:
        """Starts a test of one thruster: (index, share of largest force, seconds), as checked by `requests`."""
        index, share, seconds = argument
        share = max(-self.parameters.test_share, min(self.parameters.test_share, share))
        force = max(share, 0.0) * self._high[index] - min(share, 0.0) * self._low[index]
        self._plan = [(time_ns + round(1e9 * max(0.0, min(seconds, LONGEST_S))), index, force)]

    def detect(self, time_ns: int) -> None:
        """Starts a test of all thrusters, one after the other, each with `test_share` of the force of its weaker direction."""
        self.stop()
        turn, pause = round(1e9 * self.parameters.test_s), round(1e9 * self.parameters.test_s * PAUSE_SHARE)
        force = self.parameters.test_share * np.minimum(self._high, -self._low)
        for index in range(self._high.size):
            begin = time_ns + index * (turn + pause)
            self._plan += [
                (begin + turn // 4, index, force[index]),
                (begin + 3 * turn // 4, index, -force[index]),
                (begin + turn, index, force[index]),
                (begin + turn + pause, index, 0.0),
            ]

    def stop(self) -> None:
        """Ends the test at once."""
        self._plan = []

    def step(self, time_ns: int) -> np.ndarray:
        """Returns the (n,) forces of this tick, N."""
        while self._plan and time_ns >= self._plan[0][0]:
            self._plan.pop(0)
        force = np.zeros(self._high.size)
        if self._plan:
            _, index, wanted = self._plan[0]
            force[index] = wanted
        return force
