"""Errors of a full or failing disk. The error of a write names no file, so the caller that knows the folder adds its name."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FAILURES = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS})
"""Errors of a disk that accepts no more data."""


@contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Adds the name of `folder` to a disk error (FAILURES) raised inside."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno in FAILURES:
            raise OSError(error.errno, error.strerror, str(folder)) from None
        raise
