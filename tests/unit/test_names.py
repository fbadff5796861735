"""Texts name a thruster by its module and its number there: nobody with a screwdriver counts thrusters over a whole body."""

import numpy as np
import pytest

from firmware_py.core.body import Body
from firmware_py.core.esc_feedback import STALLED, WHY
from firmware_py.core.faults import FaultDetector
from firmware_py.core.names import Place, list_thrusters, name_thruster, places_of
from firmware_py.core.types import EscFeedback, Event
from firmware_py.description.failsafe_parameters import Faults
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble
from tests.unit.ground_world import World
from tests.unit.robot_in_water import TICK_NS


@pytest.fixture(scope="module")
def pair() -> Body:
    """Modules with indices 5 and 2, which people call 6 and 3; the first has the eight thrusters of a cube, and so has the second."""
    return assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [load_vehicle("modcube")] * 2, [5, 2])


def test_thrusters_count_from_one_in_each_module(pair: Body) -> None:
    places = places_of(pair)
    assert [name_thruster(places[i]) for i in (0, 7, 8, 11)] == [
        "thruster 1 of module 6", "thruster 8 of module 6", "thruster 1 of module 3", "thruster 4 of module 3",
    ]  # fmt: skip
    assert list_thrusters(places[i] for i in (0, 11, 7)) == ["1, 8 of module 6", "4 of module 3"] and list_thrusters([]) == []


def test_fault_names_the_module_and_the_thruster_there(pair: Body) -> None:
    detector = FaultDetector(pair, Faults(), TICK_NS)
    detector._lose(11, WHY[STALLED])
    detector._use_again(11, "the robot is pushed as much without it")
    said = [words.partition(":")[0] for words in detector.words]
    assert said == ["thruster 4 of module 3 stands still", "thruster 4 of module 3 is used again"]
    detector.words.clear()
    turning = EscFeedback(2, (0.0, 2000.0), (0.5, 0.5), (0, 0))
    for _ in range(10):
        detector._judge_at_rest([[], [turning]], np.zeros(16))
    assert detector.words == ["thruster 4 of module 3 turns though it was told to stand still"]


def test_first_chunk_of_a_text_names_the_thruster() -> None:
    """A STATUSTEXT has 50 characters, and some clients show the first chunk of a long text alone."""
    world = World(modules=2)
    client = world.client()
    text = f"{name_thruster(Place(63, 7))} does not push as it says: left out"
    world.robot.events = [Event(4, text, 0)]
    world.run(1)
    first, second = client.all("STATUSTEXT")
    assert first.text.startswith("thruster 8 of module 64 does not push") and first.text + second.text == text
