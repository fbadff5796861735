"""The C reference node as a replacement for the plant's own MCU node, with its board: in this process or behind a Unix socket."""

from hil.reference_node.board import Answer, Board, Readings, Request
from hil.reference_node.in_process import CNodes, load_library
from hil.reference_node.plant import SocketPlant

__all__ = ["Answer", "Board", "CNodes", "Readings", "Request", "SocketPlant", "load_library"]
