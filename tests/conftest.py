"""Before anything else is imported: BLAS single-threaded, as the firmware has it. xdist's processes inherit it."""

import gc
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

pytest.register_assert_rewrite("tests.unit.ports")  # tests stand in it, which subclasses take over


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--update-golden` flies the golden logs anew."""
    parser.addoption("--update-golden", action="store_true", help="fly the golden logs of tests/golden anew")


def pytest_collection_finish() -> None:
    """What all tests share is looked through for garbage no more: each flight collects before it begins, which took a fifth of a second."""
    gc.collect()
    gc.freeze()
