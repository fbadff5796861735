"""The bench: an independent model of the world behind the same CAN messages, and the evaluation of a run."""

from pathlib import Path

from firmware_py.compiled_code import forget_stale_code, forget_torn_code

DEFAULT_BUS = "virtual:modcube"
"""Bus of a flight for which none is named: inside one process."""
USUAL_RATE_HZ = 100
"""Tick rate of a flight for which none is named."""

# Here, because it must precede every module of the package: importing one loads its compiled code.
forget_stale_code(Path(__file__).parents[1], "hil", "firmware_py")
forget_torn_code(Path(__file__).parent)
