"""The C reference node in place of the plant's own MCU node: its board, in this process or behind a Unix socket."""

from hil.reference_node.board import Answer, Board, Readings, Request
from hil.reference_node.in_process import CNodes, load_library
from hil.reference_node.plant import SocketPlant

__all__ = ["Answer", "Board", "CNodes", "Readings", "Request", "SocketPlant", "load_library"]
