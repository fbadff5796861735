"""Limits linear algebra to one thread, before numpy is loaded: the matrices are small, and two processes share two cores."""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
