"""Lines that the process of a vehicle of three modules writes into its can.log, made of the codec's own frames."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from firmware_py.bus.codec import Codec
from firmware_py.description.fleet import Fleet, Module
from firmware_py.runtime.recorder import candump_lines

CODEC = Codec.load()
FLEET = Fleet(module=(Module(number=1), Module(number=2), Module(number=1, bus=1)), buses=("virtual:a", "virtual:b"))
PERIOD_NS = 10_000_000


def docked(first: int, second: int) -> tuple[Module, ...]:
    """The fleet's modules, of which two start docked."""
    modules = list(FLEET.module)
    for x, index in enumerate((first, second)):
        modules[index] = dataclasses.replace(modules[index], body=0, cell=np.array([x, 0, 0]))
    return tuple(modules)


def lines_of(armed: Sequence[bool], tick: int = 1) -> str:
    """Returns the lines of one tick: for each module SYNC, an answer, its commands."""
    text = ""
    for on, module in zip(armed, FLEET.module, strict=True):
        names = ("THRUSTER_CMD_A", "THRUSTER_CMD_B")
        commands = [CODEC.message(name).encode(module.number, (0.1, 0.2, 0.3, 0.4, int(on)), tick) for name in names]
        answer = CODEC.message("GYRO").encode(module.number, (0.0, 0.0, 0.0, 0), tick)
        sync = CODEC.message("SYNC").encode(0, (tick,))
        text += candump_lines(tick * PERIOD_NS, module.bus, "T", [sync])
        text += candump_lines(tick * PERIOD_NS, module.bus, "R", [answer])
        text += candump_lines(tick * PERIOD_NS, module.bus, "T", commands)
    return text


def dock_line(index: int, relays: Sequence[int], tick: int = 1, direction: str = "T") -> str:
    """Returns the line of the relay command of a module in one tick."""
    module = FLEET.module[index]
    return candump_lines(tick * PERIOD_NS, module.bus, direction, [CODEC.message("DOCK_CMD").encode(module.number, relays, tick)])
