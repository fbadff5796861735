"""The C node in the bench's own process: nodes of a bus whose MCUs are compiled C. For lockstep flights."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from pathlib import Path

from firmware_py.bus.codec import Frame
from hil.nodes import Nodes
from hil.reference_node.board import Board, Outputs, Readings, take_boards
from hil.scenario import Scenario

_APPLY = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.POINTER(Outputs))
_SAMPLE = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_uint32, ctypes.POINTER(Readings))
_SEND = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint16, ctypes.POINTER(ctypes.c_uint8), ctypes.c_uint8)


class _Hardware(ctypes.Structure):
    _fields_ = (("context", ctypes.c_void_p), ("apply", _APPLY), ("sample", _SAMPLE), ("send", _SEND))


def load_library(path: Path) -> ctypes.CDLL:
    """Loads libmodcube_node.so, which hil/reference_node/Makefile builds. Raises OSError."""
    library = ctypes.CDLL(str(path))
    library.node_size.restype = ctypes.c_size_t
    library.node_start.argtypes = (ctypes.c_void_p, ctypes.c_uint8, ctypes.c_uint16, ctypes.POINTER(_Hardware))
    library.node_take.argtypes = (
        ctypes.c_void_p, ctypes.c_uint16, ctypes.c_char_p, ctypes.c_size_t, ctypes.c_int64,
    )  # fmt: skip
    library.node_watch.argtypes = (ctypes.c_void_p, ctypes.c_int64)
    return library


class CNode:
    """One C node and its board."""

    def __init__(self, library: ctypes.CDLL, board: Board, rate_hz: int) -> None:
        self.board = board
        self._library = library
        self._state = ctypes.create_string_buffer(library.node_size())
        self._answers: list[Frame] = []
        # Keeps the callbacks alive: ctypes holds no reference to callbacks stored in C.
        self._hardware = _Hardware(None, _APPLY(self._apply), _SAMPLE(self._sample), _SEND(self._send))
        library.node_start(self._state, board.number, rate_hz, ctypes.byref(self._hardware))

    def take(self, frame: Frame, time_ns: int) -> list[Frame]:
        """Passes one frame from the bus to the node and returns its answers."""
        self._library.node_take(self._state, frame.id, frame.data, len(frame.data), time_ns)
        answers, self._answers = self._answers, []
        return answers

    def watch(self, time_ns: int) -> None:
        """Runs the node's timeouts at `time_ns`."""
        self._library.node_watch(self._state, time_ns)

    def _apply(self, context: object, outputs: ctypes._Pointer[Outputs]) -> None:
        self.board.drive(outputs.contents)

    def _sample(self, context: object, due: int, readings: ctypes._Pointer[Readings]) -> bool:
        self.board.sample(due, readings.contents)
        return True

    def _send(self, context: object, can_id: int, data: ctypes._Pointer[ctypes.c_uint8], length: int) -> None:
        self._answers.append(Frame(can_id, bytes(data[:length])))


class CNodes:
    """Replacement for `nodes` that keeps its cameras and runs its MCUs as C nodes."""

    def __init__(self, nodes: Nodes, scenario: Scenario, library: ctypes.CDLL, rate_hz: int) -> None:
        self.world = nodes.world
        self._nodes = nodes
        boards = take_boards(nodes, scenario, rate_hz)
        self.c_nodes = {number: CNode(library, board, rate_hz) for number, board in boards.items()}

    def step(self, frames: list[Frame]) -> list[Frame]:
        """As `Nodes.step`."""
        self.world.advance(self.world.period_ns)
        self.watch()
        answers: list[Frame] = []
        for frame in frames:
            answers += self.take(frame, self.world.time_ns)
        return answers

    def refuse_others(self, frames: Iterable[Frame], address: str) -> None:
        """As `Nodes.refuse_others`."""
        self._nodes.refuse_others(frames, address, self.c_nodes)

    def watch(self) -> None:
        """As `Nodes.watch`."""
        self._nodes.watch()
        for node in self.c_nodes.values():
            node.watch(self.world.time_ns)

    def take(self, frame: Frame, time_ns: int) -> list[Frame]:
        """As `Nodes.take`."""
        answers = self._nodes.take(frame, time_ns)
        for node in self.c_nodes.values():
            answers += node.take(frame, time_ns)
        return answers
