"""The two frames of a tag become one observation at the capture time of its picture, or none."""

import re
import textwrap
from pathlib import Path

import numpy as np
import pytest

from firmware_py.description.fleet import Fleet, Module
from tests.unit.bus_robot import TICK_NS, Robot


def test_tag_picture_gets_the_time_of_its_sync_and_offset():
    robot = Robot()
    for tick in range(296, 301):
        robot.tick(tick)
    robot.see_tag(tag=4, tick=297, offset_ms=3.3, p=(0.5, -1.0, 2.0))
    (tag,) = robot.tick(301).modules[0].tags
    assert (tag.tag_id, tag.quality) == (4, 7)
    assert tag.capture_ns == 297 * TICK_NS + 3_300_000
    assert tag.p_wt == pytest.approx([0.5, -1.0, 2.0])
    assert tag.q_wt == pytest.approx([1.0, 0.0, 0.0, 0.0])


def test_tag_camera_that_is_written_as_the_page_says_is_heard():
    page = (Path(__file__).resolve().parents[2] / "docs" / "mcu.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"((?:^ {4}.*\n|^\n)*^ {4}.*pack_quaternion\(q_wt\).*\n(?:^ {4}.*\n)+)", page, re.MULTILINE)
    turned = np.array([0.5, -0.5, 0.5, 0.5])
    seen = {"number": 1, "p_wt": (0.5, -0.25, 1.0), "q_wt": turned, "tag_id": 5, "counter": 3, "tick": 300, "since_ms": 3.3}
    exec(textwrap.dedent(code), seen)
    robot = Robot()
    robot.tick(300)
    robot.collector.take(0, seen["frames"])
    (tag,) = robot.tick(301).modules[0].tags
    assert (tag.tag_id, tag.quality, tag.capture_ns) == (5, 7, 300 * TICK_NS + 3_300_000)
    np.testing.assert_allclose(tag.p_wt, seen["p_wt"], atol=1e-9)
    np.testing.assert_allclose(tag.q_wt * tag.q_wt[0] * 2.0, turned, atol=0.01)


@pytest.mark.parametrize(("age_ticks", "passes"), [(1, True), (50, True), (51, False), (255, False)])
def test_tag_older_than_half_a_second_is_dropped(age_ticks, passes):
    robot = Robot()
    for tick in range(1000 - 255, 1000):
        robot.tick(tick)
    robot.see_tag(tick=1000 - age_ticks)
    assert len(robot.tick(1000).modules[0].tags) == passes
    assert robot.faults == ({} if passes else {"tag_stale": 1})


def test_tag_picture_of_a_sync_that_was_never_sent_is_dropped():
    robot = Robot()
    robot.tick(0)
    robot.see_tag(tick=77)
    assert robot.tick(1).modules[0].tags == []
    assert robot.faults == {"tag_stale": 1}


def test_tag_picture_whose_camera_lost_sync_is_dropped():
    robot = Robot()
    robot.tick(0)
    robot.see_tag(tick=0, offset_ms=25.5)
    assert robot.tick(1).modules[0].tags == []
    assert robot.faults == {"tag_stale": 1}


def test_tag_picture_from_the_future_is_dropped():
    robot = Robot()
    robot.tick(0)
    robot.see_tag(tick=0, offset_ms=20.0)
    assert robot.tick(1).modules[0].tags == []
    assert robot.faults == {"tag_future": 1}


@pytest.mark.parametrize("half", ["P", "A"])
def test_half_an_observation_is_dropped(half):
    robot = Robot()
    robot.tick(0)
    robot.see_tag(halves=half)
    assert [robot.tick(tick).modules[0].tags for tick in (1, 2, 3)] == [[], [], []]
    assert robot.faults == {"tag_unpaired": 1}


@pytest.mark.parametrize("order", ["PA", "AP"])
def test_halves_on_either_side_of_a_tick_are_one_observation(order):
    robot = Robot()
    robot.tick(0)
    robot.see_tag(halves=order[0])
    assert robot.tick(1).modules[0].tags == []
    robot.see_tag(halves=order[1])
    assert len(robot.tick(2).modules[0].tags) == 1
    assert robot.faults == {}


def test_half_does_not_pair_with_the_same_counter_of_a_later_picture():
    robot = Robot()
    robot.tick(0)
    robot.see_tag(halves="P", counter=5, p=(9.0, 9.0, 9.0))
    robot.tick(1)
    robot.tick(2)
    robot.see_tag(halves="A", counter=5, tick=2)
    robot.tick(3)
    assert robot.tick(4).modules[0].tags == []
    assert robot.faults == {"tag_unpaired": 2}


def test_lost_half_does_not_spoil_the_next_observation():
    robot = Robot()
    robot.tick(0)
    robot.see_tag(halves="P", counter=1, p=(9.0, 9.0, 9.0))
    robot.see_tag(halves="PA", counter=2, p=(1.0, 1.0, 1.0))
    (tag,) = robot.tick(1).modules[0].tags
    assert tag.p_wt == pytest.approx([1.0, 1.0, 1.0])


def test_half_does_not_pair_with_a_half_of_its_own_kind_when_the_counter_comes_round():
    robot = Robot()
    robot.tick(0)
    for counter in range(16):
        robot.see_tag(halves="P", counter=counter, p=(9.0, 9.0, 9.0))
    robot.see_tag(halves="PA", counter=0, p=(1.0, 1.0, 1.0))
    (tag,) = robot.tick(1).modules[0].tags
    assert tag.tag_id == 4 and tag.p_wt == pytest.approx([1.0, 1.0, 1.0])
    robot.tick(2)
    assert robot.faults == {"tag_unpaired": 16}


@pytest.mark.parametrize("sequence", ["P1 A1 P2 A2", "P1 P2 A1 A2", "P1 P2 A2 A1"])
def test_two_tags_of_one_module_in_one_picture_are_two_observations(sequence):
    robot = Robot()
    robot.tick(0)
    for item in sequence.split():
        counter = int(item[1])
        robot.see_tag(halves=item[0], counter=counter, tag=counter, p=(float(counter), 0.0, 0.0))
    tags = robot.tick(1).modules[0].tags
    assert sorted((tag.tag_id, tag.p_wt[0]) for tag in tags) == [(1, 1.0), (2, 2.0)]
    assert robot.faults == {}


def test_tags_of_two_modules_with_the_same_counter_stay_apart():
    robot = Robot(Fleet(module=(Module(number=1), Module(number=2))))
    robot.tick(0)
    robot.see_tag(halves="P", number=1, p=(1.0, 0.0, 0.0))
    robot.see_tag(halves="P", number=2, p=(2.0, 0.0, 0.0))
    robot.see_tag(halves="A", number=1)
    robot.see_tag(halves="A", number=2)
    first, second = robot.tick(1).modules
    assert (first.tags[0].p_wt[0], second.tags[0].p_wt[0]) == (1.0, 2.0)


def test_tag_is_no_sign_of_life_of_the_module_that_wears_it():
    robot = Robot()
    robot.tick(0)
    robot.see_tag()
    (module,) = robot.tick(1).modules
    assert module.tags
    assert not module.heard
