"""Parameters over MAVLink: all REAL32, ranges enforced, saved whole or not at all."""

import math
import struct
from pathlib import Path

import numpy as np
import pytest

from firmware_py.core.transitions import State
from firmware_py.core.types import Action
from firmware_py.description.parameters import Parameters, load_parameters, registry
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.files import write_atomically
from firmware_py.ground.parameters import ParameterStore, wire_value
from tests.unit.ground_world import Client, World

SHIPPED = float(np.float32(Parameters().control.position_bandwidth))
"""The shipped value in MAVLink's precision."""
EXPOSED = [limits.mavlink for _, limits in registry() if limits.mavlink]


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(config=GroundConfig(store=str(tmp_path)))


def put(world: World, client: Client, name: str, value: float, kind: int = 9) -> float:
    """Sets one parameter and returns the echoed value."""
    client.clear()
    client.send("PARAM_SET", 1, 1, name.encode(), value, kind)
    world.run(2)
    return float(client.last("PARAM_VALUE").param_value)


def test_every_parameter_is_listed_once_as_real32_with_a_short_name(world: World, client: Client) -> None:
    client.send("PARAM_REQUEST_LIST", 1, 0)
    world.run(100)
    values = client.all("PARAM_VALUE")
    assert [v.param_id for v in values] == EXPOSED
    assert {v.param_type for v in values} == {9} and {v.param_count for v in values} == {len(EXPOSED)}
    assert [v.param_index for v in values] == list(range(len(EXPOSED)))
    assert max(map(len, EXPOSED)) <= 16 and len(set(EXPOSED)) == len(EXPOSED)


def test_one_parameter_is_read_by_name_and_by_number(world: World, client: Client) -> None:
    client.send("PARAM_REQUEST_READ", 1, 1, b"ATT_BW", -1)
    client.send("PARAM_REQUEST_READ", 1, 1, b"", 0)
    world.run(1)
    assert [v.param_id for v in client.all("PARAM_VALUE")] == ["ATT_BW", EXPOSED[0]]


def test_a_set_parameter_reaches_the_next_tick_and_the_next_process(world: World, client: Client, tmp_path: Path) -> None:
    assert put(world, client, "POS_BW", 2.75) == 2.75
    assert world.robot.asked[-1].action == Action.SET_PARAMETER
    assert world.robot.asked[-1].argument == ("control.position_bandwidth", 2.75)
    (tmp_path / "parameters.toml").write_text(world.station.store.to_toml())
    assert load_parameters(tmp_path / "parameters.toml").control.position_bandwidth == 2.75
    again = World(config=world.config)
    assert again.station.store.get("POS_BW") == 2.75


def test_parameter_that_is_set_on_one_body_is_told_by_all_for_it_is_theirs_too() -> None:
    world = World(modules=2)
    client = world.client()
    put(world, client, "POS_BW", 2.75)
    assert [(v.get_srcSystem(), v.param_value) for v in client.all("PARAM_VALUE")] == [(1, 2.75), (2, 2.75)]


def test_value_that_a_parameter_has_already_is_echoed_and_not_stored_again(world: World, client: Client) -> None:
    """A value is sent again where its echo was lost."""
    assert put(world, client, "POS_BW", 2.75) == 2.75 and world.station.store.changed
    world.station.store.changed = False
    assert put(world, client, "POS_BW", 2.75) == 2.75 and not world.station.store.changed


def test_out_of_range_is_refused_in_words_and_the_old_value_echoed(world: World, client: Client) -> None:
    assert put(world, client, "POS_BW", 1000.0) == SHIPPED
    assert "parameter POS_BW: 1000.0 is out of range; permitted: 0.1 to 10 rad/s" in client.texts
    for nonsense in (math.nan, math.inf, -math.inf):
        assert put(world, client, "POS_BW", nonsense) == SHIPPED
    assert not world.robot.asked


def test_parameter_that_would_contradict_another_in_flight_is_refused_and_not_stored(world: World, client: Client) -> None:
    world.robot.state[0] = State.ARMED
    world.run(1)
    assert put(world, client, "FENCE_TOP", 60.0) == -1.0
    words = "FENCE_TOP is 60, FENCE_BOTTOM 50: the top must be at less depth"
    assert f"parameter FENCE_TOP stays while a vehicle is armed: {words}" in client.texts
    assert not world.robot.asked and not world.station.store.changed
    assert put(world, client, "FENCE_BOTTOM", 100.0) == 100.0
    assert put(world, client, "FENCE_TOP", 60.0) == 60.0


def test_file_of_parameters_is_loaded_one_by_one_while_disarmed(world: World, client: Client) -> None:
    assert put(world, client, "FENCE_TOP", 60.0) == 60.0
    assert put(world, client, "FENCE_BOTTOM", 100.0) == 100.0


def test_unknown_parameter_is_told_of(world: World, client: Client) -> None:
    client.send("PARAM_SET", 1, 1, b"NO_SUCH", 1.0, 9)
    world.run(2)
    assert "parameter NO_SUCH is unknown" in client.texts and not client.all("PARAM_VALUE")


def test_integer_types_are_taken_cast_and_bytewise(world: World, client: Client) -> None:
    bytewise = struct.unpack("<f", struct.pack("<i", 7))[0]
    assert put(world, client, "DOCK_TRIES", 5.0, 6) == 5.0
    assert put(world, client, "DOCK_TRIES", bytewise, 6) == 7.0
    assert world.station.store.values.docking.tries == 7
    assert wire_value(struct.unpack("<f", struct.pack("<i", -3))[0], 6) == -3.0


def test_the_ends_of_a_range_survive_single_precision(tmp_path: Path) -> None:
    store = ParameterStore(Parameters())
    for name, (_, limits) in store.names.items():
        for end in (limits.low, limits.high):
            store.set(name, wire_value(float(np.float32(end)), 9))


def test_a_save_that_breaks_off_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "parameters.toml"
    store = ParameterStore(Parameters(), path)
    store.set("POS_BW", 3.0)
    write_atomically(path, store.to_toml().encode())
    (tmp_path / "parameters.toml.new").write_text("[control]\nposition_band")  # what a crash would leave
    assert ParameterStore(Parameters(), path).get("POS_BW") == 3.0
    store.set("POS_BW", 3.5)
    write_atomically(path, store.to_toml().encode())
    assert ParameterStore(Parameters(), path).get("POS_BW") == 3.5
