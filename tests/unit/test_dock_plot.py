"""The picture of a dock names the stages as the sequence does, and says where it knows no true gap."""

import numpy as np
from matplotlib import pyplot

from firmware_py.core.docking_sequence import Stage
from hil.dock_plot import STAGES, docking


def test_stages_are_named_by_their_numbers() -> None:
    assert [name.upper().replace(" ", "_").replace("-", "_") for name in STAGES] == [stage.name for stage in Stage]


def test_legend_says_from_when_to_when_the_true_gap_is_known() -> None:
    """The plant has none of modules that are far from each other or locked."""
    time_ns, one, none = 10_000_000 * np.arange(1, 31), np.ones(30), np.zeros(30, int)
    docks = {name: none for name in ("module_a", "stage", "current_holds", "position_holds")}
    docks |= {"module_b": none + 1, "tries": none + 1, "time_ns": time_ns, "current_ma": np.zeros((30, 2)), "gap_m": one, "lateral_m": one}
    known = np.where((np.arange(30) > 9) & (np.arange(30) < 20), 0.1, np.nan)
    figure = docking(docks, {"time_ns": time_ns, "gap_m": known}, 0)
    assert "true gap (near by, until locked)" in [text.get_text() for text in figure.axes[1].get_legend().get_texts()]
    pyplot.close(figure)
