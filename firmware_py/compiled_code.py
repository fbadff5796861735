"""Where numba caches our compiled code, and from which files. Standard library only: flash.py ships this file beside flash_device.py.

A compiled function contains other functions and constants that numba does not track: it compares a cache only with the source beside it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

CACHE_FOLDER = "NUMBA_CACHE_DIR"
"""Numba's environment variable for its cache folder; inherited by child processes."""
_INDEX, _CODE = ".nbi", ".nbc"
"""Endings of numba's files."""
_PICKLE_BEGIN, _PICKLE_END = b"\x80", b"."
"""First and last byte of a pickle: its opcodes PROTO and STOP."""


def caches(package: Path, endings: tuple[str, ...] = (_INDEX,)) -> list[Path]:
    """numba's files of these `endings` below `package`. Skips folders that vanish meanwhile or cannot be read (Path.rglob would raise)."""
    return [Path(folder, name) for folder, _, names in os.walk(package) for name in names if name.endswith(endings)]


def cached_sources(root: Path, packages: Iterable[str]) -> set[str]:
    """Source files of `packages`, as paths relative to `root`, that have compiled code beside them."""
    found = {path.parents[1] / f"{path.name.split('.')[0]}.py" for package in packages for path in caches(root / package)}
    return {str(path.relative_to(root)) for path in found}


def transitive_sources(root: Path, names: Iterable[str]) -> dict[str, bytes]:
    """Contents, by name, of the files `names` below `root` and of all from which they import modules or constants (in capitals)."""
    found = dict[str, bytes]()
    left = set(names)
    while left:
        texts = {name: (root / name).read_bytes() for name in left if (root / name).is_file()}
        found |= texts
        left = {source for text in texts.values() for source in _sources(text.decode())} - found.keys() - left
    return found


def _sources(text: str) -> set[str]:
    """Paths that may hold the modules and constants that a file imports."""
    found = set[str]()
    for module, names in re.findall(r"^from ([\w.]+) import (\([^)]*\)|[^\n]*)", text, re.MULTILINE):
        folder = module.replace(".", "/")
        found |= {f"{folder}/{name}.py" for name in re.findall(r"\w+", names)}
        if re.search(r"\b[A-Z][A-Z0-9_]+\b", names):
            found |= {f"{folder}.py", f"{folder}/__init__.py"}
    return found


def forget_stale_code(root: Path, package: str, *used: str) -> None:
    """Deletes numba's caches in `package`, a folder of `root`, that are older than the newest source from which its functions, or those
    of the packages `used`, were compiled. Ignores caches that NUMBA_CACHE_DIR puts elsewhere.
    """
    mine = caches(root / package)
    if not mine:
        return
    try:
        sources = transitive_sources(root, cached_sources(root, (package, *used)))
        newest = max((root / name).stat().st_mtime for name in sources) if sources else 0.0
    except OSError:  # a source that cannot be read cannot be imported either
        return
    for path in mine:
        try:
            if path.stat().st_mtime < newest:
                path.unlink()
        except OSError:  # another process was faster, or the folder is read-only
            pass


def forget_torn_code(*folders: Path) -> None:
    """Deletes numba's files below `folders` that were cut short or hold zeros at an end, as a power cut leaves those written just before.

    Numba raises EOFError or UnpicklingError for such a file, at every start. Each of its files begins and ends as a pickle does.
    """
    for path in (path for folder in folders for path in caches(folder, (_INDEX, _CODE))):
        try:
            with path.open("rb") as file:
                begin = file.read(1)
                file.seek(-len(begin), os.SEEK_END)
                end = file.read(1)
            if (begin, end) != (_PICKLE_BEGIN, _PICKLE_END):
                path.unlink()
        except OSError:  # as in forget_stale_code
            pass


def temporary_cache_folder(package: Path, environment: Mapping[str, str]) -> str:
    """Creates a temporary folder for compiled code, removed at exit; "" where numba finds a lasting place, or none can be created.

    Numba itself tries the folder beside each source and the user's cache folder, and raises where neither can be written.
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
    """Whether `folder` is writable or can be created. A path in another user's home counts as absent (Path.exists would raise)."""
    there = next(path for path in (folder, *folder.absolute().parents) if os.path.exists(path))
    return os.path.isdir(there) and os.access(there, os.W_OK | os.X_OK)
