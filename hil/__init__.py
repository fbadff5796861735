"""The bench: an independent model of the world behind the same CAN messages, and what judges a run."""

from pathlib import Path

import firmware_py

firmware_py.forget_stale_code(Path(__file__).parent, Path(firmware_py.__file__).parent)
