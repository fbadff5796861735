"""The simulated CAN nodes: what they answer, when their thrusters stop, and how they treat bad frames."""

import collections
import dataclasses

import numpy as np
import pytest

from firmware_py.bus.codec import Frame, Received, Receiver, unpack_quaternion
from firmware_py.core import rotations
from firmware_py.description.schema import DescriptionError
from hil.nodes import Nodes, make_nodes
from hil.scenario import Scenario, load_scenario, make_world
from hil.scenario_files import scenario_names
from tests.unit.mcu_frames import ARMED, CODEC, DISARMED, PUSHES, REST, dock, magnets, sync, thrust

PERIOD_NS = 10_000_000


def calm(name: str = "hover") -> Scenario:
    return load_scenario(name).with_ideal_sensors().with_calm_world()


def nodes_of(scenario: Scenario, seed: int = 0, period_ns: int = PERIOD_NS) -> Nodes:
    world = make_world(scenario, seed, period_ns)
    return make_nodes(world, CODEC, scenario)


def decode(frames: list[Frame], receiver: Receiver | None = None) -> list[Received]:
    receiver = receiver or Receiver(CODEC)
    received = [receiver.accept(frame) for frame in frames]
    assert all(received), "every answer must pass the receiver's checks"
    return [r for r in received if r is not None]


def named(frames: list[Frame], name: str) -> Received:
    return next(r for r in decode(frames) if r.message.name == name)


def forces(nodes: Nodes) -> np.ndarray:
    return nodes.world.truth(0).force_n


def test_every_answer_is_a_valid_frame_at_its_rate() -> None:
    nodes, receiver = nodes_of(load_scenario("hover").with_calm_world()), Receiver(CODEC)
    count: collections.Counter[str] = collections.Counter()
    for tick in range(1, 401):
        count.update(r.message.name for r in decode(nodes.step([sync(tick)]), receiver))
    assert not any(receiver.dropped.values())
    rates = {"GYRO": 100, "ACCEL": 100, "MCU_STATUS": 100, "DEPTH": 50, "DOCK_CURRENT_ABC": 25, "DOCK_CURRENT_DEF": 25}
    rates |= {f"ESC_FEEDBACK_{i}": 10 for i in (1, 2, 3, 4)} | {"POWER": 10, "ENVIRONMENT": 5}
    assert {name: count[name] for name in rates} == {name: 4 * rate for name, rate in rates.items()}
    assert count["TAG_POSITION"] == count["TAG_ATTITUDE"] and 215 < count["TAG_POSITION"] < 242


def test_slow_message_without_a_reading_of_its_own_is_refused() -> None:
    """Regression: it was sent with the values of ENVIRONMENT, temperature and pressure of the cabin, where it had as many."""
    nodes = nodes_of(calm())
    with pytest.raises(KeyError, match="no reading for VELOCITY"):
        nodes.mcus[1]._reading("VELOCITY", nodes.world.truth(0))


def test_status_comes_last_and_repeats_the_tick() -> None:
    nodes = nodes_of(calm())
    for tick in (70_000, 70_001, 5):
        answers = decode(nodes.step([sync(tick)]))
        assert answers[-1].message.name == "MCU_STATUS"
        assert answers[-1].values[0] == tick & 0xFFFF
        assert {r.counter for r in answers if r.message.per_tick} == {tick & 15}


def test_node_that_misses_sync_does_not_sample_and_holds_its_thrusters() -> None:
    nodes = nodes_of(calm())
    nodes.step([*thrust(0.5, ARMED, 1), sync(1)])
    nodes.step([sync(2)])
    before = forces(nodes)
    assert before.all()
    assert nodes.step(thrust(-0.5, ARMED, 2)) == []
    nodes.step([])
    np.testing.assert_allclose(forces(nodes), before)
    nodes.step([sync(9)])
    nodes.step([sync(10)])
    assert (forces(nodes) < 0.0).all(), "the command waits for the next SYNC, whatever its number"


def test_module_at_rest_reports_gravity_pressure_and_pose() -> None:
    nodes = nodes_of(dataclasses.replace(calm(), sensors=dataclasses.replace(calm().sensors, tag_sigma_deg=0.0)))
    frames: list[Frame] = []
    for tick in range(1, 20):
        frames += nodes.step([sync(tick)])
    np.testing.assert_allclose(named(frames, "ACCEL").values[:3], [0.0, 0.0, -9.81], atol=0.002)
    np.testing.assert_allclose(named(frames, "GYRO").values[:3], 0.0, atol=0.0005)
    assert named(frames, "DEPTH").values[0] == pytest.approx(101325 + 998.2 * 9.81 * 0.38, abs=1)
    np.testing.assert_allclose(named(frames, "TAG_POSITION").values, [0.0, 0.0, 0.38 - 0.105], atol=0.0003)
    attitude = named(frames, "TAG_ATTITUDE").values
    assert np.linalg.norm(rotations.log(unpack_quaternion(*attitude[:4]))) < 0.003
    assert attitude[4] == 5
    assert named(frames, "POWER").values[0] == pytest.approx(12.0)


@pytest.mark.slow
def test_tag_frames_say_when_the_picture_was_taken_and_come_40_ms_late() -> None:
    scenario = load_scenario("spiral")
    nodes, found = nodes_of(scenario), 0
    period_ms = 1000.0 / scenario.sensors.tag_rate_hz
    captures = []
    for tick in range(1, 300):
        for r in decode(nodes.step([sync(tick)])):
            if r.message.name == "TAG_ATTITUDE":
                behind = (tick - r.values[6]) & 0xFF
                age_ms = 10.0 * behind - r.values[7]
                assert 40.0 - 0.06 <= age_ms < 50.1
                captures.append(10.0 * tick - age_ms)
                found += 1
    steps = np.diff(captures) / period_ms
    assert found > 150
    np.testing.assert_allclose(steps, np.round(steps), atol=0.02)


def test_both_halves_of_an_observation_share_their_counter() -> None:
    nodes = nodes_of(calm())
    counters = collections.defaultdict(list)
    for tick in range(1, 100):
        for r in decode(nodes.step([sync(tick)])):
            if r.message.name.startswith("TAG"):
                counters[r.message.name].append(r.counter)
    assert counters["TAG_POSITION"] == counters["TAG_ATTITUDE"]
    assert counters["TAG_POSITION"][:20] == [i & 15 for i in range(20)]


def test_each_half_of_the_command_times_out_by_itself_after_100_ms() -> None:
    nodes = nodes_of(calm())
    nodes.step([*thrust(0.5, ARMED, 0), sync(0)])
    state = 0
    for tick in range(1, 13):
        answers = nodes.step([*thrust(0.5, ARMED, tick, "A"), sync(tick)])
        state = named(answers, "MCU_STATUS").values[3]
        if tick == 10:
            assert forces(nodes).all(), "100 ms old is not yet too old"
    assert forces(nodes)[:4].all() and not forces(nodes)[4:].any()
    assert state == 3, "TIMEOUT"
    assert named(answers, "MCU_STATUS").values[2] & 8


def test_all_frames_lost_ends_all_thrust_within_100_ms_and_one_tick() -> None:
    nodes = nodes_of(calm())
    nodes.step([*thrust(0.5, ARMED, 0), sync(0)])
    for tick in range(1, 11):
        nodes.step([])
        assert forces(nodes).all(), tick
    nodes.step([])
    nodes.step([])  # the command is zero; one tick later so is the force of a thruster without lag
    assert not forces(nodes).any()


def test_repeated_or_damaged_command_does_not_keep_thrusters_alive() -> None:
    nodes = nodes_of(calm())
    stale = thrust(0.5, ARMED, 3)
    damaged = [Frame(f.id, f.data[:-1] + bytes([f.data[-1] ^ 1])) for f in thrust(0.5, ARMED, 4)]
    nodes.step([*stale, sync(0)])
    for tick in range(1, 14):
        answers = nodes.step([*stale, *damaged, sync(tick)])
    assert not forces(nodes).any()
    assert named(answers, "MCU_STATUS").values[2] & 0b1011 == 0b1011, "CRC, counter and time-out are reported"
    assert nodes.receiver.dropped["crc"] == 26 and nodes.receiver.dropped["counter"] == 26


def test_error_is_reported_once() -> None:
    nodes = nodes_of(calm())
    good = thrust(0.1, ARMED, 0)
    damaged = Frame(good[0].id, good[0].data[:-1] + bytes([good[0].data[-1] ^ 1]))
    answers = [nodes.step([*thrust(0.1, ARMED, k), *[damaged][: k == 2], sync(k)]) for k in range(1, 5)]
    assert [named(frames, "MCU_STATUS").values[2] for frames in answers] == [0, 1, 0, 0]


@pytest.mark.slow
def test_slow_frames_count_by_one() -> None:
    nodes, receiver = nodes_of(calm()), Receiver(CODEC)
    counters = collections.defaultdict(list)
    for tick in range(1, 2001):
        for r in decode(nodes.step([sync(tick)]), receiver):
            if not r.message.per_tick:
                counters[r.message.name].append(r.counter)
    assert {"DEPTH", "DOCK_CURRENT_ABC", "ESC_FEEDBACK_1", "POWER", "ENVIRONMENT"} < set(counters)
    for name, seen in counters.items():
        assert seen == [i & 15 for i in range(len(seen))], name


def test_picture_that_was_taken_too_long_after_sync_to_say_so_is_not_sent() -> None:
    """The frame's field for the time since SYNC ends at 25.5 ms."""
    nodes = nodes_of(dataclasses.replace(calm(), sensors=dataclasses.replace(calm().sensors, tag_rate_hz=400.0, tag_phase=0.0)))
    nodes.step([sync(1)])
    for _ in range(6):
        nodes.step([])
    told = [r.values[7] for k in range(2, 12) for r in decode(nodes.step([sync(k)])) if r.message.name == "TAG_ATTITUDE"]
    assert max(told) == pytest.approx(25.0)
    assert sum(told_ms > 10.0 for told_ms in told) == 6


@pytest.mark.parametrize(("x_m", "told"), [(16.3, True), (16.4, False), (-16.4, False)])
def test_tag_that_is_farther_than_its_frame_can_say_is_not_told_to_be_nearer(x_m: float, told: bool) -> None:
    scenario = calm()
    place = np.array([x_m, 0.0, 1.5])
    nodes = nodes_of(
        dataclasses.replace(
            scenario,
            tank=dataclasses.replace(scenario.tank, size_m=np.array([60.0, 4.0, 3.0])),
            module=(dataclasses.replace(scenario.module[0], position_m=place),),
            camera=(dataclasses.replace(scenario.camera[0], position_m=place - [0.0, 0.0, 2.5]),),
        )
    )
    places = [f for tick in range(1, 30) for f in nodes.step([sync(tick)]) if f.id == 0x0C1]
    assert bool(places) == told


def test_disarmed_command_gives_no_thrust_even_in_one_half() -> None:
    nodes = nodes_of(calm())
    nodes.step([*thrust(0.5, ARMED, 0, "A"), *thrust(0.5, DISARMED, 0, "B"), sync(0)])
    nodes.step([sync(1)])
    assert not forces(nodes).any()


@pytest.mark.parametrize("frame", [Frame(0x000, b""), Frame(0x01E, b""), Frame(0x011, b"\x01\x02\x03")])
def test_any_estop_frame_stops_thrust_at_once(frame: Frame) -> None:
    nodes = nodes_of(calm())
    nodes.step([*thrust(0.5, ARMED, 0), sync(0)])
    nodes.step([frame])
    nodes.step([])
    assert not forces(nodes).any()
    answers = nodes.step([*thrust(0.5, ARMED, 1), sync(3)])
    nodes.step([sync(4)])
    assert not forces(nodes).any()
    assert named(answers, "MCU_STATUS").values[3] == 4, "ESTOP"


def test_estop_is_released_by_a_disarmed_command_200_ms_later_and_by_nothing_else() -> None:
    nodes = nodes_of(calm())
    estop = CODEC.message("ESTOP").encode(30)
    tick = 0

    def fly(mode: int, ticks: int, extra: list[Frame] | None = None) -> bool:
        nonlocal tick
        for _ in range(ticks):
            tick += 1
            nodes.step([*(extra or []), *thrust(0.5, mode, tick), sync(tick)])
        return bool(forces(nodes).any())

    assert fly(ARMED, 3)
    assert not fly(ARMED, 3, [estop])
    assert not fly(ARMED, 60), "silence does not release it"
    assert not fly(DISARMED, 5, [estop])
    assert not fly(DISARMED, 15), "150 ms are too early"
    assert not fly(ARMED, 30)
    assert not fly(DISARMED, 1)
    assert fly(ARMED, 3), "disarmed and quiet for 200 ms: it may be armed again"


def test_relays_are_echoed() -> None:
    nodes = nodes_of(calm())
    frames: list[Frame] = []
    nodes.step([dock((1, 0, 2, 0, 0, 1), 5)])
    for tick in range(1, 9):
        frames += nodes.step([sync(tick)])
    assert named(frames, "DOCK_CURRENT_ABC").values[3:] == (1, 0, 2)
    assert named(frames, "DOCK_CURRENT_DEF").values[3:] == (0, 0, 1)


def test_magnet_that_pushes_goes_off_after_2_s_without_dock_cmd_and_one_that_pulls_stays() -> None:
    nodes, answers = nodes_of(calm()), []
    nodes.step([dock(PUSHES, 1)])
    for _ in range(200):
        nodes.step([])
        assert magnets(nodes) == PUSHES
    nodes.step([])
    assert magnets(nodes) == REST
    for tick in range(1, 9):
        answers += nodes.step([sync(tick)])
    assert named(answers, "DOCK_CURRENT_ABC").values[3:] == REST[:3]
    assert named(answers, "DOCK_CURRENT_DEF").values[3:] == REST[3:]


def test_magnet_pushes_on_while_dock_cmd_is_accepted_and_no_other_frame_counts() -> None:
    nodes = nodes_of(calm())
    for counter in range(4):
        nodes.step([dock(PUSHES, counter)])
        for tick in range(199):
            nodes.step([sync(tick)])
        assert magnets(nodes) == PUSHES
    for counter in range(4):
        nodes.step([dock(PUSHES, 3), *thrust(0.1, ARMED, counter), sync(counter)])  # a repeated counter is not accepted
    assert magnets(nodes) == REST


def test_estop_ends_pushing_at_once_and_until_it_is_released() -> None:
    nodes = nodes_of(calm())
    nodes.step([*thrust(0.0, ARMED, 0), dock(PUSHES, 1), sync(0)])
    nodes.step([Frame(0x01E, b"")])
    assert magnets(nodes) == REST
    for tick in range(1, 31):
        nodes.step([*thrust(0.0, ARMED, tick), dock(PUSHES, tick + 1), sync(tick)])
        assert magnets(nodes) == REST
    nodes.step([*thrust(0.0, DISARMED, 31), dock(PUSHES, 32), sync(31)])
    assert magnets(nodes) == PUSHES


def test_frames_for_other_numbers_move_nothing() -> None:
    nodes = nodes_of(calm())
    nodes.step([*thrust(0.5, ARMED, 0, number=2), sync(0)])
    nodes.step([sync(1)])
    assert not forces(nodes).any()


def test_slow_frames_of_two_modules_are_spread_over_the_ticks() -> None:
    scenario = calm()
    second = dataclasses.replace(scenario.module[0], number=2, position_m=np.array([0.4, 0.3, 0.4]))
    nodes = nodes_of(dataclasses.replace(scenario, module=(scenario.module[0], second), camera=()))
    loads = [len(nodes.step([sync(tick)])) for tick in range(1, 101)]
    assert max(loads) <= np.mean(loads) + 3


def test_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    def answers(seed: int) -> list[Frame]:
        nodes = nodes_of(load_scenario("spiral"), seed)
        return [f for t in range(1, 60) for f in nodes.step([*thrust(0.2, ARMED, t), sync(t)])]

    assert answers(1) == answers(1)
    assert answers(1) != answers(2)


def test_spiral_stays_clear_of_the_walls() -> None:
    scenario = load_scenario("spiral")
    task, half = scenario.task, 0.105
    assert task.radius_m + half * 2**0.5 < scenario.tank.size_m[:2].min() / 2
    assert task.centre_m[2] + half < scenario.tank.size_m[2] and task.centre_m[2] - task.climb_m - half > 0.0
    start = scenario.module[0].position_m
    assert np.hypot(*(start - task.centre_m)[:2]) == pytest.approx(task.radius_m) and start[2] == task.centre_m[2]


@pytest.mark.slow
@pytest.mark.parametrize("name", scenario_names())
def test_scenario_carries_its_own_name_and_can_be_built(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.name == name and scenario.help
    make_world(scenario, 0, PERIOD_NS)


def test_unknown_scenario_is_refused_with_what_there_is() -> None:
    with pytest.raises(DescriptionError, match=r"'hoover' is unknown; did you mean hover\? there are .*hover.*spiral") as refusal:
        load_scenario("hoover")
    assert "\n" not in str(refusal.value)
