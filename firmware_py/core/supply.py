"""The smoothed supply voltage of each module. Runs before stage 1 of a tick; the limiter raises commands where the voltage sags."""

from __future__ import annotations

from collections.abc import Sequence

from firmware_py.core.body import Body
from firmware_py.core.limiter import is_believed
from firmware_py.core.types import ModuleInputs

SMOOTHING = 0.5
"""Weight of a new reading (10 Hz): settles in half a second."""


class SupplyMeter:
    """Supply voltages of one body.

    Attributes:
        voltage_v: (m,) of each module; nominal before the first plausible reading.
    """

    def __init__(self, body: Body) -> None:
        self._modules = body.modules
        self._nominal_v = body.nominal_v
        self.voltage_v = self._nominal_v.copy()

    def step(self, modules: Sequence[ModuleInputs]) -> None:
        """Takes the readings of this tick. `modules`: by fleet index."""
        for i, module in enumerate(self._modules):
            voltage = modules[module].voltage_v
            if voltage is not None and is_believed(voltage / self._nominal_v[i]):
                self.voltage_v[i] += SMOOTHING * (voltage - self.voltage_v[i])
