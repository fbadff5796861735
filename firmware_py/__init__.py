"""modcube: the controller package of a self-reconfigurable underwater robot.

BLAS runs single-threaded: the matrices of a tick are small, and the same inputs must give the same bytes.
"""

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _caches(package: Path) -> list[Path]:
    """numba's index files below `package`; a folder that vanishes or cannot be read meanwhile holds none (Path.rglob would raise)."""
    return [Path(folder, name) for folder, _, names in os.walk(package) for name in names if name.endswith(".nbi")]


def forget_stale_code(package: Path, *used: Path) -> None:
    """Deletes what numba has cached in `package` before one of its compiled sources, or of those of the packages `used`, was changed.

    numba compares a cache with the source beside it alone; a change of a function that others have taken in would not be seen. Caches
    that NUMBA_CACHE_DIR leads elsewhere are not looked at.
    """
    caches = _caches(package)
    others = [path for folder in used for path in _caches(folder)]
    sources = {path.parents[1] / f"{path.name.split('.')[0]}.py" for path in (*caches, *others)}
    newest = max((path.stat().st_mtime for path in sources if path.exists()), default=0.0)
    for path in caches:
        try:
            if path.stat().st_mtime < newest:
                path.unlink()
        except OSError:  # another process was here first, or nothing may be written here
            pass


forget_stale_code(Path(__file__).parent)
