"""The plot of a dock names the stages as the sequence does, and says where the true gap is known."""

import itertools

import numpy as np
from matplotlib import pyplot

from firmware_py.core.docking_sequence import Stage
from firmware_py.description.signals import Columns
from hil.dock_plot import STAGES, docking


def test_stages_are_named_by_their_numbers() -> None:
    assert [name.upper().replace(" ", "_").replace("-", "_") for name in STAGES] == [stage.name for stage in Stage]


def flown(stages: dict[str, int]) -> tuple[Columns, Columns]:
    """Returns the signals and the truth of a dock that goes through these stages, each for the given number of ticks."""
    stage = np.repeat([STAGES.index(name) for name in stages], list(stages.values()))
    time_ns, none, one = 10_000_000 * np.arange(1, len(stage) + 1), np.zeros(len(stage), int), np.ones(len(stage))
    docks = {name: none for name in ("module_a", "current_holds", "position_holds")} | {"stage": stage, "time_ns": time_ns}
    docks |= {"module_b": none + 1, "tries": none + 1, "current_ma": np.zeros((len(stage), 2)), "gap_m": one, "lateral_m": one}
    return docks, {"time_ns": time_ns, "gap_m": one}


def test_last_stage_is_named_though_it_lasts_one_tick_and_others_where_there_is_room() -> None:
    figure = docking(*flown({"pre-approach": 100, "align": 50, "approach": 100, "push": 5, "docked": 1}), 0)
    texts = figure.axes[2].texts
    assert [text.get_text() for text in texts] == ["pre-approach", "align", "approach", "docked"]
    figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in texts]
    assert not any(a.overlaps(b) for a, b in itertools.pairwise(boxes))
    assert boxes[-1].x1 <= figure.axes[2].get_window_extent().x1
    pyplot.close(figure)


def test_first_stage_is_named_within_the_axes_however_short_it_is() -> None:
    """Regression: after four tries "pre-approach" lay on the word "stage" beside the axis."""
    figure = docking(*flown({"pre-approach": 50, "align": 20, "approach": 1000, "docked": 1}), 0)
    figure.draw_without_rendering()
    first, second = (text.get_window_extent() for text in figure.axes[2].texts[:2])
    assert first.x0 >= figure.axes[2].get_window_extent().x0 and not first.overlaps(second)
    pyplot.close(figure)


def test_stages_tell_their_try_where_there_are_several() -> None:
    docks, truth = flown({"approach": 60, "back off": 60, "docked": 1})
    figure = docking(docks | {"tries": np.repeat([1, 2], [60, 61])}, truth, 0)
    assert [text.get_text() for text in figure.axes[2].texts] == ["approach\ntry 1", "back off\ntry 2", "docked\ntry 2"]
    pyplot.close(figure)


def test_legend_says_from_when_to_when_the_true_gap_is_known() -> None:
    """The plant gives no gap for modules that are far apart or locked."""
    docks, truth = flown({"approach": 30})
    known = np.where((np.arange(30) > 9) & (np.arange(30) < 20), 0.1, np.nan)
    figure = docking(docks, truth | {"gap_m": known}, 0)
    assert "true gap (near by, until locked)" in [text.get_text() for text in figure.axes[1].get_legend().get_texts()]
    pyplot.close(figure)
