"""The picture of a dock names the stages as the sequence does."""

from firmware_py.core.docking_sequence import Stage
from hil.dock_plot import STAGES


def test_stages_are_named_by_their_numbers() -> None:
    assert [name.upper().replace(" ", "_").replace("-", "_") for name in STAGES] == [stage.name for stage in Stage]
