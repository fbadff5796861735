"""A disk that is full or fails: the error of a write names no file, so whoever knows the folder names that."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FAILURES = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS})
"""What a disk answers that takes no more."""


@contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Names `folder` in the error of a disk that takes no more."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno in FAILURES:
            raise OSError(error.errno, error.strerror, str(folder)) from None
        raise
