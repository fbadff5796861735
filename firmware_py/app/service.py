"""The service's reports to systemd, sent from the tick: ready after a second of ticks, watchdog while ticks go on, and a status line.

A tick that hangs sends nothing, so the watchdog of modcube.service kills and restarts the process.
"""

from __future__ import annotations

from collections.abc import Sequence

from firmware_py.app.firmware import BusFrame
from firmware_py.app.observers import Observer
from firmware_py.core.types import Inputs, Outputs
from firmware_py.runtime.notify import Notifier
from firmware_py.runtime.rate_keeper import RateKeeper

READY_S = 1.0
"""Time with ticks before the service reports that it is ready."""
ALIVE_EVERY_S = 0.1
STATUS_EVERY_S = 1.0


def status_text(tick: int, rate_hz: int, answered: int, armed: int, modules: int, keeper: RateKeeper) -> str:
    """The status line, words KEY=VALUE, for flash.py and `systemctl status`. flash.py stops no vehicle with an armed module."""
    late_us = keeper.lateness.quantile_ns(0.99) // 1000
    return (
        f"tick={tick} rate_hz={rate_hz} answered={answered}/{modules} armed={armed}/{modules} late_p99_us={late_us} "
        f"overruns={keeper.overruns} skipped={keeper.skipped}"
    )


def reporting(notifier: Notifier, keeper: RateKeeper, rate_hz: int) -> Observer:
    """An observer that reports to the service manager; does nothing without one. Reports a change in the number armed at once."""
    alive_every = max(1, round(ALIVE_EVERY_S * rate_hz))
    status_every = max(1, round(STATUS_EVERY_S * rate_hz))
    ready_at = round(READY_S * rate_hz)
    said_ready = False
    said_armed = 0

    def observe(received: Sequence[BusFrame], sent: Sequence[BusFrame], inputs: Inputs, outputs: Outputs) -> None:
        nonlocal said_ready, said_armed
        tick, armed = outputs.tick, sum(command.armed for command in outputs.modules)
        status, ready = tick % status_every == 0 or armed != said_armed, tick >= ready_at and not said_ready
        if not (tick % alive_every == 0 or status or ready) or not notifier.is_heard:
            return
        text = "WATCHDOG=1"
        if status:
            answered = sum(module.answered for module in inputs.modules)
            text += f"\nSTATUS={status_text(tick, rate_hz, answered, armed, len(inputs.modules), keeper)}"
            said_armed = armed
        if ready:
            text, said_ready = f"{text}\nREADY=1", True
        notifier.send(text)

    return observe
