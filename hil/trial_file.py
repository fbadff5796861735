"""trials.jsonl: stores every trial of a campaign or a search on disk as soon as it is over, and restores them after a kill."""

from __future__ import annotations

import fcntl
import json
import os
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from firmware_py.description.schema import DescriptionError
from hil.campaign_summary import Trial

OWNER = "campaign"
"""Key of the first line, which identifies the owner of the trials."""
_HEAD = json.dumps({OWNER: ""}).encode()[:-2]
"""Beginning of every first line; a torn first line may be only part of it."""


class TrialFile:
    """trials.jsonl: a line for the owner, then a line per trial, each synced to disk before the next trial is awaited."""

    def __init__(
        self, path: Path, owner: str, key: str = "seed", anew: bool = False, owner_kinds: str = "scenario, controller or code"
    ) -> None:
        """Continues `path` if it belongs to `owner`; drops a torn line and everything after it, to be flown again.

        Args:
            key: identifies a trial.
            anew: discards the trials of another owner.
            owner_kinds: what may distinguish another owner, for the error message.

        Raises:
            DescriptionError: `path` is being written, holds trials of another owner, or is not a file of trials.
            OSError: it cannot be written.
        """
        self.trials: dict[int, Trial] = {}
        self._key = key
        with ExitStack() as refused:
            self._file = refused.enter_context(path.open("a+b"))
            self._claim(path)
            stands = self._read(path, {OWNER: owner}, "" if anew else owner_kinds)
            self._file.truncate(stands)
            if not stands:
                self._write({OWNER: owner})
            refused.pop_all()

    def _claim(self, path: Path) -> None:
        """Locks the file until it is closed."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DescriptionError(f"{path} is being written by another campaign; wait for it or give another --out") from None

    def _read(self, path: Path, head: Trial, owner_kinds: str) -> int:
        """Reads the trials; returns the number of valid bytes, 0 if the head is another's.

        Raises DescriptionError for trials of another owner, unless `owner_kinds` is empty, and for a file that holds no trials.
        """
        self._file.seek(0)
        lines = self._file.readlines()
        if not lines or _entry(lines[0]) != head:
            if lines[1:] and owner_kinds:
                raise DescriptionError(f"{path} holds trials of another {owner_kinds}; give another --out or delete it")
            if lines and not (lines[0].startswith(_HEAD) or _HEAD.startswith(lines[0])):
                raise DescriptionError(f"{path} holds no trials; move what is yours or give another --out")
            return 0
        stands = len(lines[0])
        for line in lines[1:]:
            entry = _entry(line)
            if entry is None:
                break
            self.trials[int(entry[self._key])] = entry
            stands += len(line)
        return stands

    def add(self, trial: Trial) -> None:
        """Adds a trial, which is on the disk when this returns."""
        self.trials[int(trial[self._key])] = trial
        self._write(trial)

    def _write(self, entry: Trial) -> None:
        self._file.write(json.dumps(entry).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def __enter__(self) -> TrialFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._file.close()


def _entry(line: bytes) -> Trial | None:
    """The entry in a line; None if the line is torn."""
    try:
        entry = json.loads(line) if line.endswith(b"\n") else None
    except ValueError:
        entry = None
    return entry if isinstance(entry, dict) else None
