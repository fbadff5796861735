"""Folders that a run writes into. What may be written over: files that an earlier run of the same kind left. Anybody else's of the same
names are refused, not lost.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from firmware_py.description.schema import DescriptionError


def check_replaceable(folder: Path, names: Iterable[str], is_earlier_run: bool, run: str) -> None:
    """Raises DescriptionError where `folder` holds something under these names and no earlier run's.

    Args:
        is_earlier_run: whether `folder` is one that a run of this kind left, by a file that nothing else writes.
        run: what would have left them, for people: "flight".
    """
    held = [name for name in names if (folder / name).exists() and (not (folder / name).is_file() or (folder / name).stat().st_size)]
    if held and not is_earlier_run:
        raise DescriptionError(f"{folder} holds {', '.join(held)}, which no {run} left there; move what is yours or give another --out")


@contextmanager
def made(folder: Path) -> Iterator[None]:
    """Makes `folder` and those that it lies in; what of them was made, and has nothing in it at the end, goes again. Raises OSError."""
    new = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        with suppress(OSError):  # the first that holds something, and all in which that lies
            for each in new:
                each.rmdir()


def is_json_with(path: Path, key: str) -> bool:
    """Whether `path` is JSON whose object, or whose first of a list or of lines, has `key`."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return False
    for part in (text, text.partition("\n")[0]):
        try:
            entry = json.loads(part)
        except ValueError:
            continue
        entry = entry[0] if isinstance(entry, list) and entry else entry
        return isinstance(entry, dict) and key in entry
    return False
