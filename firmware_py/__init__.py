"""modcube: the controller package of a self-reconfigurable underwater robot.

BLAS runs single-threaded: the matrices of a tick are small, and the same inputs must give the same bytes.
"""

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def forget_stale_code(package: Path, *used: Path) -> None:
    """Deletes what numba has cached in `package` before one of its compiled sources, or of those of the packages `used`, was changed.

    numba compares a cache with the source beside it alone; a change of a function that others have taken in would not be seen. Caches
    that NUMBA_CACHE_DIR leads elsewhere are not looked at.
    """
    caches = list(package.rglob("__pycache__/*.nbi"))
    others = [path for folder in used for path in folder.rglob("__pycache__/*.nbi")]
    sources = {path.parents[1] / f"{path.name.split('.')[0]}.py" for path in (*caches, *others)}
    newest = max((path.stat().st_mtime for path in sources if path.exists()), default=0.0)
    for path in caches:
        try:
            if path.stat().st_mtime < newest:
                path.unlink()
        except OSError:  # another process was here first, or nothing may be written here
            pass


forget_stale_code(Path(__file__).parent)
