"""Whether a module obeys its commands. If it starts, hears none or has a fault, it stops its thrusters: a standstill is then no fault of
theirs."""

from __future__ import annotations

from firmware_py.core.types import COMMAND_TIMEOUT_NS, MCU_UNFIT, ModuleInputs

START_NS = 300_000_000
"""How long propellers that were stopped may stand still: nearly four lags. A bus that was interrupted may first deliver in a burst the
commands and the answers that it kept, all of propellers that stood still."""


class CommandWatch:
    """Watches one module."""

    def __init__(self, period_ns: int) -> None:
        self._stopped_after, self._start_ticks = max(1, COMMAND_TIMEOUT_NS // period_ns), max(1, START_NS // period_ns)
        self._unheard = 0
        """Ticks in a row in which the module was not heard. After COMMAND_TIMEOUT_NS it may have stopped: it may hear nothing either."""
        self._deaf = self._starting = 0
        """Ticks for which it goes on counting as deaf, and as stopped."""

    @property
    def deaf(self) -> bool:
        """Whether it reports that it starts, hears no commands or has a fault, or did until just now."""
        return self._deaf > 0

    @property
    def stopped(self) -> bool:
        """Whether its propellers may stand still for want of commands, or just start again: it is deaf, or was silent until just now."""
        return self._starting > 0

    def step(self, module: ModuleInputs) -> None:
        """Takes what came from the module since the previous tick."""
        unfit = module.mcu_state in MCU_UNFIT
        returns = module.heard and self._unheard >= self._stopped_after
        self._deaf = self._start_ticks if unfit else max(0, self._deaf - 1)
        self._starting = self._start_ticks if unfit or returns else max(0, self._starting - 1)
        self._unheard = 0 if module.heard else self._unheard + 1
