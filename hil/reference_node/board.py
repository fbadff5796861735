"""The hardware under the C node: thrusters, relays and sensors of one simulated module, without the bus protocol."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from firmware_py.description.schema import DescriptionError
from hil.mcu import SLOW, Mcu
from hil.nodes import Nodes
from hil.scenario import Scenario

NS_PER_S = 1_000_000_000
THRUSTERS, FACES = 8, 6


class Outputs(ctypes.Structure):
    """struct node_outputs."""

    _fields_ = (
        ("tick", ctypes.c_double),
        ("thruster", ctypes.c_double * THRUSTERS),
        ("relay", ctypes.c_double * FACES),
    )


class Readings(ctypes.Structure):
    """struct node_readings."""

    _fields_ = (
        ("gyro", ctypes.c_double * 4),
        ("accel", ctypes.c_double * 4),
        ("depth", ctypes.c_double * 3),
        ("dock", ctypes.c_double * 6 * 2),
        ("esc", ctypes.c_double * 6 * 4),
        ("power", ctypes.c_double * 3),
        ("environment", ctypes.c_double * 3),
    )


class Request(ctypes.Structure):
    """struct request of main.c."""

    _fields_ = (("due", ctypes.c_double), ("outputs", Outputs))


class Answer(ctypes.Structure):
    """struct answer of main.c."""

    _fields_ = (("tick", ctypes.c_double), ("readings", Readings))


class Board(Mcu):
    """The plant's MCU, reduced to its thrusters, relays and sensors."""

    def drive(self, outputs: Outputs) -> None:
        """Applies the node's outputs to relays and thrusters."""
        self._switch([int(relay) for relay in outputs.relay])
        self._apply(list(outputs.thruster))

    def sample(self, due: int, readings: Readings) -> None:
        """Fills `readings` with the fast sensors and with the slow messages whose bit is set in `due`."""
        truth = self._world.truth(self.module)
        readings.gyro[:] = [*self._sensors.gyro(truth).tolist(), 0.0]
        readings.accel[:] = [*self._sensors.accel(truth).tolist(), 0.0]
        for position, name in enumerate(SLOW):
            if due >> position & 1:
                place(readings, name, self._reading(name, truth))


def place(readings: Readings, name: str, values: Sequence[float]) -> None:
    """Writes the values of slow message `name`, in the order of its fields, into the C node's readings."""
    if name.startswith("DOCK_CURRENT"):
        readings.dock[0 if name.endswith("ABC") else 1][:] = [float(v) for v in values]
    elif name.startswith("ESC_FEEDBACK"):
        readings.esc[int(name[-1]) - 1][:] = [float(v) for v in values]
    else:
        getattr(readings, name.lower())[:] = [float(v) for v in values]


def take_boards(nodes: Nodes, scenario: Scenario, rate_hz: int) -> dict[int, Board]:
    """Returns boards for the modules of `nodes`, by number, and removes the plant's own MCUs from `nodes`.

    Raises DescriptionError for a scenario with faults: they are injected in the plant's own MCUs and on their wire, and would do nothing.
    """
    if scenario.fault:
        kinds = ", ".join(dict.fromkeys(fault.kind for fault in scenario.fault))
        raise DescriptionError(f"scenario {scenario.name}: C nodes have no faults ({kinds}); leave them out, or fly the plant's own nodes")
    tick_ns = NS_PER_S // rate_hz
    boards = {
        number: Board(nodes.codec, number, mcu.module, nodes.world, scenario.sensors, tick_ns)
        for number, mcu in nodes.mcus.items()
    }
    nodes.mcus = {}
    return boards
