"""One seed is one flight: the logs of two runs are the same bytes."""

from pathlib import Path

import pytest

from tests.closed_loop.flights import Fly, shortened

LOGS = ("can.log", "signals.mcap", "truth.mcap")


def logs(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in LOGS}


@pytest.mark.slow
def test_two_flights_of_one_seed_leave_the_same_bytes_and_another_seed_does_not(fly: Fly, tmp_path: Path) -> None:
    scenario = shortened("spiral", duration_s=5.0, settle_s=5.0)
    for folder, seed in (("first", 3), ("second", 3), ("other", 4)):
        fly(scenario, seed, folder=folder)
    first, second, other = (logs(tmp_path / folder) for folder in ("first", "second", "other"))
    assert all(len(first[name]) > 100_000 for name in LOGS)
    assert [name for name in LOGS if first[name] != second[name]] == []
    assert [name for name in LOGS if first[name] == other[name]] == []
