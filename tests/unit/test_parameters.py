"""The registry of tunables: each is named, bounded and explained; a change is checked and leaves the old set alone."""

import math
import re
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

from firmware_py.description.parameters import CONTROLLERS, Parameters, load_parameters, registry
from firmware_py.description.schema import DescriptionError, Limits
from firmware_py.description.toml_text import to_toml

REGISTRY = dict(registry())


@pytest.mark.parametrize(("name", "limits"), REGISTRY.items(), ids=REGISTRY.keys())
def test_every_tunable_is_bounded_and_explained(name: str, limits: Limits) -> None:
    assert limits.help
    if limits.choices:
        assert attrgetter(name)(Parameters()) in limits.choices
    else:
        assert math.isfinite(limits.low) and limits.low < limits.high < math.inf
        assert limits.low <= attrgetter(name)(Parameters()) <= limits.high


@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_shipped_set_is_within_its_bounds(name: str) -> None:
    for key, limits in REGISTRY.items():
        value = attrgetter(key)(CONTROLLERS[name])
        assert value in limits.choices if limits.choices else limits.low <= value <= limits.high


@pytest.mark.parametrize(("name", "value"), [
    ("control.attitude_bandwidth", 15.0), ("estimation.tag_sigma_m", 1e-5), ("estimation.tag_sigma_axis_m", 1e-5),
    ("estimation.tag_sigma_rad", 1e-5), ("estimation.depth_sigma_m", 3e-5), ("limiter.slew_n_per_s", 3.0), ("limiter.relay_w", 130.0),
])  # fmt: skip
def test_value_with_which_a_flown_hover_was_lost_is_out_of_range(name: str, value: float) -> None:
    """Flown with each alone: thrusters swing between their limits, the estimator refuses tags, or magnets leave no power."""
    with pytest.raises(DescriptionError, match="out of range"):
        Parameters().replace(name, value)


def test_numbers_have_a_mavlink_name_each_of_their_own() -> None:
    """MAVLink names have at most 16 characters; words cannot be sent as a float and have none."""
    names = [limits.mavlink for limits in REGISTRY.values() if not limits.choices]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[A-Z][A-Z0-9_]{0,15}", name) for name in names)
    assert not [name for name, limits in REGISTRY.items() if limits.choices and limits.mavlink]


def test_tuned_set_is_a_new_one() -> None:
    before = Parameters()
    after = before.replace("control.attitude_bandwidth", 2.25)
    assert after.control.attitude_bandwidth == 2.25
    assert before.control.attitude_bandwidth == Parameters().control.attitude_bandwidth != 2.25
    assert after.estimation == before.estimation


def test_word_is_replaced_by_a_permitted_word() -> None:
    assert Parameters().replace("control.law", "paper").control.law == "paper"


@pytest.mark.parametrize("name", [name for name, limits in REGISTRY.items() if not limits.choices])
def test_bound_of_every_tunable_is_permitted_and_beyond_is_not(name: str) -> None:
    limits = REGISTRY[name]
    for bound, beyond in ((limits.low, -math.inf), (limits.high, math.inf)):
        assert attrgetter(name)(Parameters().replace(name, bound)) == bound
        for wrong in (math.nextafter(bound, beyond), beyond, math.nan):
            with pytest.raises(DescriptionError, match=rf"parameter {name}: .* is out of range; permitted: "):
                Parameters().replace(name, wrong)


def test_whole_number_becomes_what_the_tunable_is() -> None:
    """An int in place of a float makes the tick's compiled functions refuse their arguments in flight."""
    for name in ("control.attitude_bandwidth", "docking.current_threshold_ma", "failsafes.leak_action"):
        kind = type(attrgetter(name)(Parameters()))
        for value in (2, 2.0):
            assert type(attrgetter(name)(Parameters().replace(name, value))) is kind


@pytest.mark.parametrize("wrong", ["fast", 3, ""])
def test_unknown_word_is_refused(wrong: Any) -> None:
    with pytest.raises(DescriptionError, match=r"parameter control.law: .* permitted: one of model, paper"):
        Parameters().replace("control.law", wrong)


def test_word_for_a_number_is_refused() -> None:
    with pytest.raises(DescriptionError, match=r"control\.lead_s: 'soon' is out of range; permitted: 0 to 0\.5 s"):
        Parameters().replace("control.lead_s", "soon")


@pytest.mark.parametrize("name", ["control.nothing", "nothing.law", "law", "", ".", "control.", "control"])
def test_unknown_tunable_is_answered_with_how_to_see_the_known_ones(name: str) -> None:
    with pytest.raises(DescriptionError, match=r"is unknown; .*`modcube parameters` prints them all$"):
        Parameters().replace(name, 1.0)


def test_unknown_tunable_is_answered_with_the_one_that_is_like_it() -> None:
    with pytest.raises(DescriptionError, match=r"'control\.position_bandwith' is unknown; did you mean control\.position_bandwidth\? "):
        Parameters().replace("control.position_bandwith", 1.0)


def test_file_may_leave_everything_out(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_text("")
    assert load_parameters(path) == Parameters()


def test_file_changes_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_text("[control]\nlead_s = 0.2\n[limiter]\nforce_share = 0.5\n")
    parameters = load_parameters(path)
    assert (parameters.control.lead_s, parameters.limiter.force_share) == (0.2, 0.5)
    assert parameters.estimation == Parameters().estimation


@pytest.mark.parametrize("name", CONTROLLERS)
def test_written_set_is_read_back_the_same(tmp_path: Path, name: str) -> None:
    path = tmp_path / "p.toml"
    path.write_text(to_toml(CONTROLLERS[name]))
    assert load_parameters(path) == CONTROLLERS[name]


def test_wrong_file_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_text("[control]\n\nlead_s = 0.6\n")
    with pytest.raises(DescriptionError, match=r"p\.toml:3: control\.lead_s: 0\.6 is out of range; .* 0 to 0\.5 s"):
        load_parameters(path)
