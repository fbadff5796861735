"""modcube: the controller package of a self-reconfigurable underwater robot.

BLAS runs single-threaded: the matrices of a tick are small, and the same inputs must give the same bytes.
"""

import os
from pathlib import Path

from firmware_py.compiled_code import CACHE_FOLDER, forget_stale_code, forget_torn_code, temporary_cache_folder

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
forget_stale_code(Path(__file__).parents[1], "firmware_py")
forget_torn_code(*(Path(folder) for folder in (Path(__file__).parent, os.environ.get(CACHE_FOLDER)) if folder))
if TEMPORARY_CACHE := temporary_cache_folder(Path(__file__).parent, os.environ):
    os.environ[CACHE_FOLDER] = TEMPORARY_CACHE
