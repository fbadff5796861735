"""trials.jsonl: every trial of a campaign or a search on the disk the moment it is over, and found again after a kill."""

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
"""Key of the first line, which says whose trials these are."""
_HEAD = json.dumps({OWNER: ""}).encode()[:-2]
"""How the first line begins, as far as it was written."""


class TrialFile:
    """trials.jsonl: who it belongs to, then a line for each trial, with the disk before the next one is waited for."""

    def __init__(
        self, path: Path, owner: str, key: str = "seed", anew: bool = False, who: str = "scenario, controller or code"
    ) -> None:
        """Goes on in `path` if it is `owner`'s; a line that was torn is flown again.

        Args:
            key: tells trials apart.
            anew: throws another owner's trials away.
            who: in what another owner may differ, for people.

        Raises:
            DescriptionError: `path` is being written, holds trials of another owner, or none at all but something else.
            OSError: it cannot be written.
        """
        self.trials: dict[int, Trial] = {}
        self._key = key
        with ExitStack() as refused:
            self._file = refused.enter_context(path.open("a+b"))
            self._claim(path)
            stands = self._read(path, {OWNER: owner}, "" if anew else who)
            self._file.truncate(stands)
            if not stands:
                self._write({OWNER: owner})
            refused.pop_all()

    def _claim(self, path: Path) -> None:
        """The file is this one's until it is closed."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DescriptionError(f"{path} is being written by another campaign; wait for it or give another --out") from None

    def _read(self, path: Path, head: Trial, who: str) -> int:
        """Bytes that stand; without `who` those of another head do not."""
        self._file.seek(0)
        lines = self._file.readlines()
        if not lines or _entry(lines[0]) != head:
            if lines[1:] and who:
                raise DescriptionError(f"{path} holds trials of another {who}; give another --out or delete it")
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
        """One more trial, on the disk when this returns."""
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
    """What a line holds; None where it was torn."""
    try:
        entry = json.loads(line) if line.endswith(b"\n") else None
    except ValueError:
        entry = None
    return entry if isinstance(entry, dict) else None
