"""Where numba keeps our compiled code, and which files it was made of. Standard library alone: flash.py ships it beside flash_device.py.

One compiled function contains others, and constants, of which numba knows nothing: it compares a cache with the source beside it alone.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

CACHE_FOLDER = "NUMBA_CACHE_DIR"
"""Numba's own word in the environment; inherited by the processes that this one starts."""


def caches(package: Path) -> list[Path]:
    """numba's index files below `package`; a folder that vanishes or cannot be read meanwhile holds none (Path.rglob would raise)."""
    return [Path(folder, name) for folder, _, names in os.walk(package) for name in names if name.endswith(".nbi")]


def cached_sources(root: Path, packages: Iterable[str]) -> set[str]:
    """Files of `packages`, as they are called from their folder `root` on, beside which compiled code lies."""
    found = {path.parents[1] / f"{path.name.split('.')[0]}.py" for package in packages for path in caches(root / package)}
    return {str(path.relative_to(root)) for path in found}


def taken_in(root: Path, names: Iterable[str]) -> dict[str, bytes]:
    """What the files `names` below `root` hold, and those that they import modules or constants (in capitals) from, by name."""
    found = dict[str, bytes]()
    left = set(names)
    while left:
        texts = {name: (root / name).read_bytes() for name in left if (root / name).is_file()}
        found |= texts
        left = {source for text in texts.values() for source in _sources(text.decode())} - found.keys() - left
    return found


def _sources(text: str) -> set[str]:
    """Where the modules and constants may be that a file imports."""
    found = set[str]()
    for module, names in re.findall(r"^from ([\w.]+) import (\([^)]*\)|[^\n]*)", text, re.MULTILINE):
        folder = module.replace(".", "/")
        found |= {f"{folder}/{name}.py" for name in re.findall(r"\w+", names)}
        if re.search(r"\b[A-Z][A-Z0-9_]+\b", names):
            found |= {f"{folder}.py", f"{folder}/__init__.py"}
    return found


def forget_stale_code(root: Path, package: str, *used: str) -> None:
    """Deletes what numba has cached in `package`, a folder of `root`, before a file was changed from which its functions, or those of the
    packages `used`, were compiled. Caches that NUMBA_CACHE_DIR leads elsewhere are not looked at.
    """
    mine = caches(root / package)
    if not mine:
        return
    try:
        sources = taken_in(root, cached_sources(root, (package, *used)))
        newest = max((root / name).stat().st_mtime for name in sources) if sources else 0.0
    except OSError:  # a source that cannot be read is imported by nobody
        return
    for path in mine:
        try:
            if path.stat().st_mtime < newest:
                path.unlink()
        except OSError:  # another process was here first, or nothing may be written here
            pass


def passing_place(package: Path, environment: Mapping[str, str]) -> str:
    """A new folder for compiled code, for as long as this process lives; empty where numba finds a place that lasts, or there is none.

    Numba itself looks beside each source and in the user's folder for caches, and raises where neither can be written.
    """
    home = environment.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache"))
    if environment.get(CACHE_FOLDER) or _takes_files(Path(home, "numba")) or all(map(_takes_files, _beside_sources(package))):
        return ""
    import atexit
    import shutil
    import tempfile

    try:
        folder = tempfile.mkdtemp(prefix="modcube-compiled-")
    except OSError:
        return ""
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _beside_sources(package: Path) -> list[Path]:
    folders = [Path(folder) for folder, _, names in os.walk(package) if any(name.endswith(".py") for name in names)]
    return [folder / "__pycache__" for folder in folders or [package]]


def _takes_files(folder: Path) -> bool:
    """Whether files can be made in `folder`, or it can itself. What is in somebody else's home is not there (Path.exists would raise)."""
    there = next(path for path in (folder, *folder.absolute().parents) if os.path.exists(path))
    return os.path.isdir(there) and os.access(there, os.W_OK | os.X_OK)
