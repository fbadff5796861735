"""What makes a process keep its deadlines: no garbage collection while it flies, locked memory, a real-time priority."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet_garbage() -> Iterator[None]:
    """No garbage collection inside: what exists is frozen, and the ticks leave no cycles behind."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
