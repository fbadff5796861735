"""modcube: the controller package of a self-reconfigurable underwater robot.

BLAS runs single-threaded: the matrices of a tick are small, and the same inputs must give the same bytes.
"""

import os
from pathlib import Path

from firmware_py.compiled_code import CACHE_FOLDER, forget_stale_code, passing_place

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
forget_stale_code(Path(__file__).parents[1], "firmware_py")
if PASSING_PLACE := passing_place(Path(__file__).parent, os.environ):
    os.environ[CACHE_FOLDER] = PASSING_PLACE
