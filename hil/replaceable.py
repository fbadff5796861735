"""Folders that a run writes into. Only files left by an earlier run of the same kind are overwritten; a folder with other files of the
same names is refused, so that nothing is lost.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from firmware_py.description.schema import DescriptionError


def check_replaceable(folder: Path, names: Iterable[str], is_earlier_run: bool, run: str) -> None:
    """Raises DescriptionError if `folder` holds anything under these names that is not an earlier run's. Empty files do not count.

    Args:
        is_earlier_run: whether a run of this kind left `folder`, judged by a file that nothing else writes.
        run: the kind of run, for the error message: "flight".
    """
    held = [name for name in names if (folder / name).exists() and (not (folder / name).is_file() or (folder / name).stat().st_size)]
    if held and not is_earlier_run:
        raise DescriptionError(f"{folder} holds {', '.join(held)}, which no {run} left there; move what is yours or give another --out")


def check_alone(folder: Path, names: Iterable[str], is_earlier_run: bool, run: str) -> None:
    """Raises DescriptionError if `folder` holds anything but files of these names, hidden ones aside, and is not an earlier run's."""
    others = sorted(path.name for path in folder.iterdir() if path.name not in set(names) and not path.name.startswith("."))
    if others and not is_earlier_run:
        what = f"{others[0]}{f' and {len(others) - 1} more' if len(others) > 1 else ''}"
        raise DescriptionError(f"{folder} holds {what}, and no {run}; give an --out that is empty, new, or an earlier flight's")


@contextmanager
def created_folder(folder: Path) -> Iterator[None]:
    """Makes `folder` and its parents; at the end removes those of them that it made and that are empty. Raises OSError."""
    new = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        with suppress(OSError):  # the first one that is not empty stays, with its parents
            for each in new:
                each.rmdir()


def is_json_with(path: Path, key: str) -> bool:
    """Whether `path` is JSON or JSON lines, and its object, or the first object of its list or lines, has `key`."""
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
