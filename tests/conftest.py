"""Before anything else is imported: BLAS single-threaded, as the firmware has it. xdist's processes inherit it."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
