"""modcube: the controller package of a self-reconfigurable underwater robot.

BLAS runs single-threaded: the matrices of a tick are small, and the same inputs must give the same bytes.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
