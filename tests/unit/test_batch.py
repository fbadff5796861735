"""Many worlds simulated in one call are bit-identical to the same worlds simulated one by one."""

import numpy as np
import pytest

from firmware_py.description.schema import DescriptionError
from hil.batch import fly
from hil.plant.draw import Noise, stream
from hil.plant.world import World
from hil.scenario import load_scenario, make_world

TICKS = 1500
"""More than the 1024 random numbers that are drawn in advance for the gusts."""
PERIOD_NS = 10_000_000


def worlds(count: int, scenario: str = "spiral") -> list[World]:
    return [make_world(load_scenario(scenario), seed, PERIOD_NS) for seed in range(count)]


def pushes(count: int, ticks: int = TICKS) -> np.ndarray:
    """(count, ticks, 8) commands that drive the module around, and into the walls."""
    return np.clip(0.4 * np.cumsum(np.random.default_rng(1).standard_normal((count, ticks, 8)), axis=1) / 10.0, -1.0, 1.0)


def one_by_one(world: World, commands: np.ndarray) -> np.ndarray:
    rows = []
    for u in commands:
        world.set_command(0, u)
        world.advance(PERIOD_NS)
        rows.append(world.seen()[0])
    return np.array(rows)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3, 10])  # alone; eight lanes, some idle; eight and two
def test_batch_is_the_single_plant_to_the_last_bit(count: int) -> None:
    commands = pushes(count)
    together = fly(worlds(count), commands, threads=2)
    for each, world, u in zip(together, worlds(count), commands, strict=True):
        assert np.array_equal(each, one_by_one(world, u))
    assert count == 1 or not np.array_equal(together[0], together[1])


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["spiral", "mobius-1"])
def test_batch_is_the_single_plant_in_a_box_and_in_a_cylinder(scenario: str) -> None:
    commands = pushes(4, 400)
    together = fly(worlds(4, scenario), commands)
    for each, world, u in zip(together, worlds(4, scenario), commands, strict=True):
        assert np.array_equal(each, one_by_one(world, u))


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
def test_world_goes_on_where_the_batch_has_put_it(count: int) -> None:
    commands = pushes(count, 60)
    moved, alone = worlds(count), worlds(count)[0]
    fly(moved, commands[:, :20])
    for world, u in zip(moved, commands, strict=True):
        one_by_one(world, u[20:40])
    last = fly(moved, commands[:, 40:])
    assert np.array_equal(last[0], one_by_one(alone, commands[0])[40:])
    assert moved[0].time_ns == alone.time_ns
    assert np.array_equal(moved[0].truth(0).force_n, alone.truth(0).force_n)


def test_numbers_taken_together_are_those_taken_singly() -> None:
    single, many = (Noise(stream(0, "gusts"), 3) for _ in range(2))
    wanted = np.array([single.take() for _ in range(2500)])
    assert np.array_equal(np.concatenate([many.take_many(n) for n in (1, 700, 1500, 299)]), wanted)


def test_same_commands_for_all_need_be_given_once() -> None:
    commands = pushes(1, 30)[0]
    assert np.array_equal(fly(worlds(2), commands), fly(worlds(2), np.stack([commands, commands])))


@pytest.mark.parametrize("shape", [(30, 7), (3, 30, 8), (8,)])
def test_commands_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(DescriptionError, match=r"batch: commands have the shape"):
        fly(worlds(2), np.zeros(shape))


def test_docked_modules_are_refused() -> None:
    with pytest.raises(DescriptionError, match="lone modules"):
        fly([make_world(load_scenario("mobius-2"), 0, PERIOD_NS)], np.zeros((10, 8)))


def test_worlds_in_unlike_tanks_are_refused() -> None:
    with pytest.raises(DescriptionError, match="differ in tank"):
        fly([*worlds(1), *worlds(1, "mobius-1")], np.zeros((10, 8)))


@pytest.mark.parametrize("other", ["mobius-1", "mobius-2"])  # a cylinder; two modules
def test_worlds_that_are_refused_have_not_moved(other: str) -> None:
    refused, commands = worlds(1), pushes(1, 20)
    with pytest.raises(DescriptionError):
        fly([*refused, make_world(load_scenario(other), 0, PERIOD_NS)], commands[0])
    assert refused[0].time_ns == 0
    assert np.array_equal(fly(refused, commands), fly(worlds(1), commands))


@pytest.mark.parametrize("shape", [(0, 8), (3, 0, 8)])
def test_commands_of_no_ticks_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(DescriptionError, match="batch: commands of no ticks"):
        fly(worlds(3), np.zeros(shape))


def test_no_worlds_are_refused() -> None:
    with pytest.raises(DescriptionError, match="batch: no worlds"):
        fly([], np.zeros((10, 0)))


def test_world_that_is_given_twice_is_refused() -> None:
    one, other = worlds(2)
    with pytest.raises(DescriptionError, match="the same world is given twice"):
        fly([one, other, one], np.zeros((10, 8)))


def test_less_than_no_threads_are_refused() -> None:
    with pytest.raises(DescriptionError, match="batch: -1 threads"):
        fly(worlds(1), np.zeros((10, 8)), threads=-1)


@pytest.mark.parametrize("what", ["a hand is on it", "it is clamped", "a coil is on"])
@pytest.mark.parametrize("count", [1, 3])
def test_what_a_batch_would_leave_out_is_refused(what: str, count: int) -> None:
    refused = worlds(count)
    if what == "a hand is on it":
        refused[-1].push[0, 2] = 5.0
    elif what == "it is clamped":
        refused[-1].clamp(0)
    else:
        refused[-1].set_relays(0, [1, 0, 0, 0, 0, 0])
    with pytest.raises(DescriptionError, match=what):
        fly(refused, np.zeros((10, 8)))
    assert refused[0].time_ns == 0
