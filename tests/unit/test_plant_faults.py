"""Faults of the plant and of its wire: each breaks what it names, for the time that it names, and nothing else."""

import dataclasses
import itertools

import numpy as np
import pytest

from firmware_py.bus.codec import Frame, Receiver
from firmware_py.description.schema import DescriptionError
from hil.faults import Faults, Wire
from hil.nodes import Nodes, make_nodes
from hil.plant.draw import stream
from hil.plant.fault_spec import FRAME_KINDS, TAKES, THRUSTER_KINDS, Fault
from hil.scenario import load_scenario, make_world
from tests.unit.mcu_frames import ARMED, CODEC, sync, thrust

PERIOD_NS = 10_000_000
FRAMES = [Frame(0x100 + i, bytes([i] * 6)) for i in range(20)]


def nodes_with(*faults: Fault, scenario: str = "hover") -> Nodes:
    flown = load_scenario(scenario)
    nodes = make_nodes(make_world(flown, 0, PERIOD_NS), CODEC, flown)
    nodes.faults = Faults(nodes, faults)
    return nodes


def fly(nodes: Nodes, ticks: int, u: float = 0.5, first: int = 1) -> list[Frame]:
    out: list[Frame] = []
    for k in range(first, first + ticks):
        out += nodes.step([sync(k), *thrust(u, ARMED, k)])
    return out


def values(frames: list[Frame], name: str) -> list[list[float]]:
    receiver = Receiver(CODEC)
    received = [receiver.accept(frame) for frame in frames]
    return [r.values for r in received if r is not None and r.message.name == name]


@pytest.mark.parametrize(
    ("kind", "value", "expected"), [("dead", 0.0, 0.0), ("reversed", 0.0, -0.81), ("weak", 0.4, 0.4), ("fake_rpm", 0.3, 0.3)]
)
def test_broken_thruster_gives_that_share_of_its_force(kind: str, value: float, expected: float) -> None:
    healthy, broken = nodes_with(), nodes_with(Fault(kind=f"thruster_{kind}", module=1, index=3, value=value))
    for nodes in (healthy, broken):
        fly(nodes, 100)
    good, bad = healthy.world.truth(0).force_n, broken.world.truth(0).force_n
    assert bad[3] / good[3] == pytest.approx(expected, abs=0.06)
    np.testing.assert_allclose(np.delete(bad, 3), np.delete(good, 3), rtol=0.05)


@pytest.mark.parametrize("kind", THRUSTER_KINDS)
def test_every_kind_of_broken_thruster_pushes_otherwise_than_a_healthy_one(kind: str) -> None:
    healthy, broken = nodes_with(), nodes_with(Fault(kind=kind, module=1, index=3))
    for nodes in (healthy, broken):
        fly(nodes, 10)
    assert broken.world.truth(0).force_n[3] != healthy.world.truth(0).force_n[3]


def test_every_kind_of_fault_is_carried_out() -> None:
    """Regression: a kind that only the table TAKES named was accepted in a scenario and live, and did nothing without a word."""
    faults = Faults(nodes_with())
    assert faults.carried_out == set(TAKES)
    assert Wire(0, "both").kinds == set(FRAME_KINDS)


def test_lying_thruster_reports_the_speed_of_a_healthy_one() -> None:
    healthy, lying = nodes_with(), nodes_with(Fault(kind="thruster_fake_rpm", index=0, value=0.0))
    reports = [values(fly(nodes, 100), "ESC_FEEDBACK_1")[-1] for nodes in (healthy, lying)]
    assert lying.world.truth(0).force_n[0] == 0.0
    assert reports[1][0] == pytest.approx(reports[0][0], rel=0.02)
    dead = nodes_with(Fault(kind="thruster_dead", index=0))
    assert values(fly(dead, 100), "ESC_FEEDBACK_1")[-1][0] == 0.0


def test_stuck_thruster_turns_whatever_is_commanded() -> None:
    nodes = nodes_with(Fault(kind="thruster_stuck", index=2, value=-0.6))
    fly(nodes, 100, u=0.0)
    force = nodes.world.truth(0).force_n
    assert force[2] < -2.0 and np.abs(np.delete(force, 2)).max() == 0.0


def test_fault_lasts_as_long_as_it_says() -> None:
    nodes = nodes_with(Fault(kind="thruster_dead", index=3, at_s=0.5, until_s=1.0))
    fly(nodes, 45)
    before = nodes.world.truth(0).force_n[3]
    fly(nodes, 50, first=46)
    during = nodes.world.truth(0).force_n[3]
    fly(nodes, 60, first=96)
    after = nodes.world.truth(0).force_n[3]
    assert before > 2.0 and during == pytest.approx(0.0, abs=0.05) and after == pytest.approx(before, rel=0.05)


SINGLE = (
    Fault(kind="thruster_dead", index=3), Fault(kind="thruster_weak", index=3, value=0.4), Fault(kind="thruster_fake_rpm", value=0.3),
    Fault(kind="thruster_reversed", module=1), Fault(kind="thruster_stuck", module=2, index=3, value=-0.6),
    Fault(kind="imu_frozen"), Fault(kind="imu_frozen", module=1), Fault(kind="leak", module=2), Fault(kind="leak"),
    Fault(kind="battery_sag", value=1.8), Fault(kind="battery_sag", module=2, value=0.7), Fault(kind="readings_absent", module=1),
    Fault(kind="magnet", index=1, value=1.0), Fault(kind="magnet", value=0.0), Fault(kind="magnet", module=2, index=1, value=-1.0),
    Fault(kind="pressure_jump", value=0.3), Fault(kind="pressure_jump", module=2, value=-5.0), Fault(kind="pressure_drift", value=0.05),
    Fault(kind="pressure_frozen"), Fault(kind="pressure_frozen", module=1), Fault(kind="pressure_absent", module=2),
    Fault(kind="jets", value=0.9), Fault(kind="jets", value=0.0), Fault(kind="push", value=2.0), Fault(kind="push", module=1, value=-0.7),
)  # fmt: skip


def fault_state(nodes: Nodes) -> list[object]:
    """State that the plant's faults can change, after one more tick and with the same commands to every module."""
    fly(nodes, 1)
    world, mcus = nodes.world, nodes.mcus.values()
    for mcu in mcus:
        world.set_relays(mcu.module, [1, 0, 1, 1, 1, 1])
        world.set_command(mcu.module, [0.5] * 8)
    levels = world._thrusters.level[:, 0].tolist(), world._thrusters.constants[:, 0].tolist()
    supply = world._thrusters.supply[:, 1].tolist()
    told = [(m.imu_frozen, m.leaks, m.readings_absent) for m in mcus]
    depths = [(m.depth.frozen, m.depth.absent, round(m.depth.error_m(1.0), 2)) for m in mcus]  # a drift begins at its own time
    return [*levels, supply, world.docks.relays.tolist(), world.push.tolist(), world.jet_strength, told, depths]


def test_every_kind_of_fault_of_the_plant_is_tried_here() -> None:
    """Regression: one that was never repaired lasted for ever after its end, and no test was of its kind."""
    assert {fault.kind for fault in SINGLE} == set(Faults(nodes_with())._breaks)


def lasting(fault: Fault, at_s: float, until_s: float) -> Fault:
    return dataclasses.replace(fault, at_s=at_s, until_s=until_s)


@pytest.mark.slow
@pytest.mark.parametrize("fault", SINGLE, ids=lambda fault: f"{fault.kind}-{fault.module}")
def test_what_broke_is_whole_again_when_the_fault_is_over(fault: Fault) -> None:
    nodes = nodes_with(lasting(fault, 0.02, 0.05), scenario="dock")
    fly(nodes, 3)
    assert fault_state(nodes) != fault_state(nodes_with(scenario="dock"))
    fly(nodes, 3, first=4)
    assert fault_state(nodes) == fault_state(nodes_with(scenario="dock"))


PAIRS = [pair for pair in itertools.permutations(SINGLE, 2) if len({fault.kind.split("_")[0] for fault in pair}) == 1]
"""Ordered pairs of faults of the same parts."""


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_fault_that_begins_or_ends_leaves_another_one_as_it_was(first: Fault, second: Fault) -> None:
    """Whichever begins or ends first, the state is that of the faults that are on."""
    alone = [fault_state(nodes_with(fault, scenario="dock")) for fault in (first, second)]
    both = fault_state(nodes_with(first, second, scenario="dock"))
    times = (((0.0, 0.08), (0.02, 0.05)), ((0.02, 0.05), (0.0, 0.08)), ((0.0, 0.05), (0.02, 0.08)), ((0.02, 0.08), (0.0, 0.05)))
    for mine, other in times:
        nodes = nodes_with(lasting(first, *mine), lasting(second, *other), scenario="dock")
        fly(nodes, 3)
        assert fault_state(nodes) == both
        fly(nodes, 2, first=4)
        assert fault_state(nodes) == alone[0 if mine[1] > other[1] else 1]


def test_two_faults_of_the_same_words_are_two() -> None:
    """Each begins once and ends once."""
    push, sag = (Fault(kind=kind, value=1.0, at_s=0.1, until_s=0.3) for kind in ("push", "battery_sag"))
    nodes = nodes_with(push, push, sag, sag)
    fly(nodes, 20)
    assert np.linalg.norm(nodes.world.push[0, :3]) == pytest.approx(2.0) and nodes.world._thrusters.supply[0, 1] == 10.0
    fly(nodes, 20, first=21)
    assert not nodes.world.push.any() and nodes.world._thrusters.supply[0, 1] == 12.0


def test_magnet_that_hangs_is_not_moved_by_another_fault() -> None:
    """A relay that is switched off and on again would cause a current surge."""
    nodes = nodes_with(
        Fault(kind="magnet", index=1, value=1.0), Fault(kind="magnet", index=1, value=0.0, at_s=0.1), Fault(kind="leak", at_s=0.5)
    )
    moved = []
    nodes.world.docks.set_relays = lambda module, relays, move=nodes.world.docks.set_relays: moved.append(  # type: ignore[method-assign]
        (nodes.world.docks.relays[0, 1], move(module, relays), nodes.world.docks.relays[0, 1])
    )
    fly(nodes, 60)
    assert [(before, after) for before, _, after in moved if before != after] == [(0, 1), (1, 0)]


def test_fault_of_one_module_leaves_the_other_whole() -> None:
    nodes = nodes_with(Fault(kind="imu_frozen", module=2), Fault(kind="thruster_dead", module=1), scenario="dock")
    for tick in range(1, 50):
        nodes.step([sync(tick), *thrust(0.5, ARMED, tick), *thrust(0.5, ARMED, tick, number=2)])
    assert [mcu.imu_frozen for mcu in nodes.mcus.values()] == [False, True]
    assert not nodes.world.truth(0).force_n.any() and nodes.world.truth(1).force_n.all()


def test_hand_pushes_with_its_force_for_its_time_from_a_side_of_the_seed_s_own() -> None:
    """From rest in still water, the hull gains a speed of F t over its mass, water included, and a turn; another seed pushes elsewhere."""
    calm = load_scenario("hover").with_calm_world()
    gained = []
    for seed in (0, 1):
        nodes = make_nodes(make_world(calm, seed, PERIOD_NS), CODEC, calm)
        nodes.faults = Faults(nodes, [Fault(kind="push", value=2.0, at_s=0.1, until_s=0.2)])
        fly(nodes, 9, u=0.0)
        assert np.abs(nodes.world.truth(0).v_w).max() == 0.0
        fly(nodes, 14, u=0.0, first=10)
        gained.append(nodes.world.truth(0).v_w)
        assert np.linalg.norm(gained[-1]) == pytest.approx(2.0 * 0.1 / 15.5, rel=0.05)
        assert np.linalg.norm(nodes.world.truth(0).w_b) > 0.005
        assert not nodes.world.push.any()
    assert np.linalg.norm(gained[0] - gained[1]) > 0.1 * np.linalg.norm(gained[0])


def test_frozen_imu_repeats_itself() -> None:
    rates = values(fly(nodes_with(Fault(kind="imu_frozen")), 20), "GYRO")
    assert len(rates) == 20 and all(r[:3] == rates[0][:3] for r in rates)
    assert len({tuple(r[:3]) for r in values(fly(nodes_with(), 20), "GYRO")}) > 5


def test_leak_and_sag_are_reported() -> None:
    frames = fly(nodes_with(Fault(kind="leak", at_s=0.3), Fault(kind="battery_sag", value=2.0, at_s=0.3)), 100, u=0.0)
    wet, power = values(frames, "ENVIRONMENT"), values(frames, "POWER")
    assert wet[0][2] == 0 and wet[-1][2] == 1
    assert power[0][0] - power[-1][0] == pytest.approx(2.0, abs=0.1)


def test_readings_of_battery_and_cabin_stay_away() -> None:
    frames, others = fly(nodes_with(Fault(kind="readings_absent")), 100, u=0.0), fly(nodes_with(), 100, u=0.0)
    for name, is_there in (("POWER", False), ("ENVIRONMENT", False), ("DEPTH", True), ("MCU_STATUS", True)):
        assert values(others, name) and bool(values(frames, name)) == is_there


def depths(*faults: Fault, ticks: int = 100) -> np.ndarray:
    """(k,) depths by the pressure of module 1, m, in the order of their frames, 20 ms apart."""
    pa = np.array([reading[0] for reading in values(fly(nodes_with(*faults), ticks, u=0.0), "DEPTH")])
    return (pa - 101_325.0) / 9_790.0


@pytest.mark.slow
def test_pressure_jumps_and_drifts_from_its_time_on_and_both_add_up() -> None:
    whole = depths()
    jumped, drifted = depths(Fault(kind="pressure_jump", value=0.3, at_s=0.5)), depths(Fault(kind="pressure_drift", value=-0.2, at_s=0.5))
    since_s = 0.02 * np.arange(whole.size) - 0.5
    np.testing.assert_allclose(jumped - whole, 0.3 * (since_s > -0.01), atol=5e-4)
    np.testing.assert_allclose(drifted - whole, -0.2 * np.maximum(0.0, since_s), atol=5e-3)
    both = depths(Fault(kind="pressure_jump", value=0.3), Fault(kind="pressure_drift", value=-0.2, at_s=0.5))
    np.testing.assert_allclose(both - drifted, 0.3, atol=5e-4)


def test_pressure_freezes_at_its_last_reading_and_lives_again() -> None:
    frozen, whole = depths(Fault(kind="pressure_frozen", at_s=0.5, until_s=1.0)), depths()
    assert len(set(whole[25:50])) > 5 and len(set(frozen[25:49])) == 1
    np.testing.assert_array_equal(frozen[50:], whole[50:])


def test_pressure_sensor_falls_silent_and_nothing_else_does() -> None:
    frames = fly(nodes_with(Fault(kind="pressure_absent")), 100, u=0.0)
    assert not values(frames, "DEPTH") and values(frames, "POWER") and values(frames, "MCU_STATUS")


def tags(*faults: Fault, ticks: int = 60) -> np.ndarray:
    return np.array(values(fly(nodes_with(*faults), ticks, u=0.0), "TAG_POSITION"))[:, :3]


def test_camera_bias_moves_every_tag_alike() -> None:
    off = tags(Fault(kind="camera_bias", value=0.005)) - tags()
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), 0.005, atol=0.001)
    assert np.ptp(off, axis=0).max() <= 0.001 + 1e-9, "the frames' resolution"


def test_tags_jump_and_vanish() -> None:
    assert np.mean(tags(Fault(kind="tag_jump", value=0.3)) - tags(), axis=0)[0] == pytest.approx(0.3, abs=1e-3)
    assert not values(fly(nodes_with(Fault(kind="tag_absent")), 50), "TAG_POSITION")


def sighted(*faults: Fault, scenario: str) -> dict[int, np.ndarray]:
    """(n, 3) positions of each module as the tag computer reports them, by module number."""
    frames, receiver = fly(nodes_with(*faults, scenario=scenario), 60, u=0.0), Receiver(CODEC)
    received = [r for frame in frames if (r := receiver.accept(frame)) is not None and r.message.name == "TAG_POSITION"]
    return {number: np.array([r.values[:3] for r in received if r.number == number]) for number in (1, 2)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "off_m"),
    [
        (Fault(kind="camera_bias", value=0.01), {1: 0.01, 2: 0.01}), (Fault(kind="tag_jump", value=0.1), {1: 0.1, 2: 0.1}),
        (Fault(kind="tag_jump", module=1, value=0.1), {1: 0.1, 2: 0.0}), (Fault(kind="tag_jump", module=2, value=0.1), {1: 0.1, 2: 0.1}),
        (Fault(kind="camera_bias", module=1, value=0.01), {1: 0.01, 2: 0.0}),
    ],
)  # fmt: skip
def test_module_that_a_carried_camera_sees_is_off_by_a_fault_once(fault: Fault, off_m: dict[int, float]) -> None:
    """Module 2 carries the camera that sees module 1, so an error of module 2's own position shifts module 1 too."""
    bad, good = sighted(fault, scenario="dock-vertical"), sighted(scenario="dock-vertical")
    for number, expected in off_m.items():
        off = bad[number] - good[number]
        np.testing.assert_allclose(np.linalg.norm(off, axis=1), expected, atol=0.0015)


@pytest.mark.slow
def test_tag_fault_is_of_the_module_that_it_names() -> None:
    jumped = sighted(Fault(kind="tag_jump", module=2, value=0.3), scenario="dock")
    whole = sighted(scenario="dock")
    np.testing.assert_array_equal(jumped[1], whole[1])
    np.testing.assert_allclose((jumped[2] - whole[2])[:, 0], 0.3, atol=1e-3)
    absent = sighted(Fault(kind="tag_absent", module=1), scenario="dock")
    assert len(absent[1]) == 0 and len(absent[2]) > 20


@pytest.mark.slow
def test_that_share_of_the_tags_is_flipped() -> None:
    flipped, straight = (
        values(fly(nodes_with(*f), 400, u=0.0), "TAG_ATTITUDE") for f in ([Fault(kind="tag_flip", value=0.3)], [])
    )
    turned = [a[:4] != b[:4] for a, b in zip(flipped, straight, strict=True)]
    assert np.mean(turned) == pytest.approx(0.3, abs=0.1)


@pytest.mark.slow
def test_flipped_tags_turn_and_stay_in_place() -> None:
    np.testing.assert_array_equal(tags(Fault(kind="tag_flip", value=1.0)), tags())
    flipped, straight = (
        values(fly(nodes_with(*f), 60, u=0.0), "TAG_ATTITUDE") for f in ([Fault(kind="tag_flip", value=1.0)], [])
    )
    assert all(a[:4] != b[:4] for a, b in zip(flipped, straight, strict=True))


@pytest.mark.parametrize("direction", ["to_plant", "from_plant"])
def test_lost_frames_are_that_share_and_repeat_by_seed(direction: str) -> None:
    fault = [Fault(kind="frame_loss", value=0.3, direction=direction)]
    runs = [[len(wire.pass_on(FRAMES, fault, t)) for t in range(500)] for wire in (Wire(7, direction), Wire(7, direction))]
    assert runs[0] == runs[1]
    assert sum(runs[0]) / (500 * len(FRAMES)) == pytest.approx(0.7, abs=0.02)
    assert [len(Wire(8, direction).pass_on(FRAMES, fault, t)) for t in range(20)] != runs[0][:20]


def test_fault_of_one_direction_leaves_the_other_alone() -> None:
    assert Wire(0, "to_plant").pass_on(FRAMES, [Fault(kind="frame_loss", value=1.0, direction="from_plant")], 0) == FRAMES


def test_delayed_frames_come_later_in_order() -> None:
    wire, late = Wire(0, "to_plant"), [Fault(kind="frame_delay", value=25.0)]
    assert wire.pass_on(FRAMES, late, 0) == [] == wire.pass_on([], late, 20_000_000)
    assert wire.pass_on([], [], 30_000_000) == FRAMES


@pytest.mark.parametrize(("kind", "count", "changed"), [("frame_loss", 0, 0), ("frame_duplicate", 40, 0), ("frame_corrupt", 20, 20)])
def test_what_happens_to_a_late_frame_is_the_same_whatever_stands_first(kind: str, count: int, changed: int) -> None:
    faults = [Fault(kind="frame_delay", value=20.0), Fault(kind=kind, value=1.0)]
    for order in (faults, faults[::-1]):
        wire = Wire(0, "to_plant")
        assert wire.pass_on(FRAMES, order, 0) == []
        out = wire.pass_on([], order, 20_000_000)
        assert (len(out), sum(frame not in FRAMES for frame in out)) == (count, changed)


def test_two_delays_add_up() -> None:
    wire, late = Wire(0, "to_plant"), [Fault(kind="frame_delay", value=20.0), Fault(kind="frame_delay", value=5.0)]
    assert wire.pass_on(FRAMES, late, 0) == wire.pass_on([], late, 24_000_000) == []
    assert wire.pass_on([], late, 25_000_000) == FRAMES


@pytest.mark.parametrize("kind", ["frame_loss", "frame_delay", "frame_duplicate", "frame_corrupt"])
def test_frame_fault_of_one_module_is_of_the_frames_with_its_number(kind: str) -> None:
    """SYNC and all frames with another number pass unchanged."""
    frames = [CODEC.message("SYNC").encode(0, [7]), *FRAMES, Frame(0x01E, b"")]
    out = Wire(0, "to_plant").pass_on(frames, [Fault(kind=kind, value=1.0, module=3)], 0)
    assert [f for f in out if f.id & 31 != 3] == [f for f in frames if f.id & 31 != 3]
    assert out.count(FRAMES[3]) == (2 if kind == "frame_duplicate" else 0)


def test_source_without_a_stream_is_refused_by_its_name() -> None:
    """Regression: the words were "tuple.index(x): x not in tuple"."""
    with pytest.raises(ValueError, match="no stream is called 'sonar'; append the name to SOURCES"):
        stream(0, "sonar")


def test_every_direction_draws_from_a_stream_of_its_own() -> None:
    lost = [Fault(kind="frame_loss", value=0.5)]
    one, other = (Wire(0, way).pass_on(FRAMES, lost, 0) for way in ("to_plant", "from_plant"))
    assert one != other


def test_any_bit_of_the_payload_may_be_the_wrong_one() -> None:
    wire, zeros = Wire(0, "to_plant"), Frame(0x101, bytes(8))
    wrong = [int.from_bytes(wire.pass_on([zeros], [Fault(kind="frame_corrupt", value=1.0)], 0)[0].data, "little") for _ in range(2000)]
    assert set(wrong) == {1 << bit for bit in range(64)}


def test_frame_without_a_payload_cannot_be_corrupt() -> None:
    assert Wire(0, "to_plant").pass_on([Frame(0x01E, b"")], [Fault(kind="frame_corrupt", value=1.0)], 0) == [Frame(0x01E, b"")]


def test_duplicated_frames_come_twice() -> None:
    assert len(Wire(0, "to_plant").pass_on(FRAMES, [Fault(kind="frame_duplicate", value=1.0)], 0)) == 2 * len(FRAMES)


def test_corrupted_frames_have_one_wrong_bit_and_are_refused() -> None:
    nodes = nodes_with(Fault(kind="frame_corrupt", value=1.0, direction="from_plant"))
    frames = fly(nodes, 20)
    receiver = Receiver(CODEC)
    taken = [receiver.accept(f) for f in frames]
    assert not any(taken) and receiver.dropped["crc"] == len(frames)


def test_babbling_node_floods_the_bus_but_raises_no_estop() -> None:
    heard = Wire(0, "from_plant").pass_on([], [Fault(kind="babble", value=50)], 0)
    assert len(heard) == 50 and min(f.id for f in heard) >= 0x40


def test_estop_box_sends_at_20_hz_while_it_is_raised() -> None:
    nodes = nodes_with(Fault(kind="estop", at_s=0.1, until_s=1.1))
    ticks = [tick for tick in range(1, 201) if any(frame.id == 0x01E for frame in fly(nodes, 1, first=tick))]
    assert ticks == list(range(10, 110, 5))
    assert nodes.mcus[1].stopped


def test_estop_box_says_twice_a_second_that_it_is_there_until_it_falls_silent() -> None:
    nodes = nodes_with(Fault(kind="estop_box_silent", at_s=1.2, until_s=1.9), scenario="faults")
    works = CODEC.message("HEARTBEAT").encode(30, (1, 1))
    ticks = [tick for tick in range(1, 301) if works in fly(nodes, 1, first=tick)]
    assert ticks == [1, 51, 101, 190, 240, 290]
    assert not any(frame.id == 0x71E for frame in fly(nodes_with(), 100))


def test_frames_of_the_estop_box_wait_for_lower_ids_and_are_lost_as_others_are() -> None:
    faults = Fault(kind="estop"), Fault(kind="foreign_sync")
    ids = [frame.id for frame in fly(nodes_with(*faults, scenario="faults"), 1) if frame.id in (0x01E, 0x020, 0x71E)]
    assert ids == [0x01E, 0x020, 0x71E]
    assert not fly(nodes_with(*faults, Fault(kind="frame_loss", value=1.0), scenario="faults"), 100)


def test_dead_estop_box_stops_nobody() -> None:
    nodes = nodes_with(Fault(kind="estop"), Fault(kind="estop_box_silent"), scenario="faults")
    assert not any(frame.id in (0x01E, 0x71E) for frame in fly(nodes, 100)) and not nodes.mcus[1].stopped


def test_every_node_answers_a_foreign_sync_too() -> None:
    frames = fly(nodes_with(Fault(kind="foreign_sync")), 20, first=100)
    assert sum(frame.id == 0x020 for frame in frames) == 20
    status = [Receiver(CODEC).accept(frame) for frame in frames if frame.id == 0x441]
    ticks = [r.values[0] for r in status if r is not None]
    assert ticks == [n for tick in range(100, 120) for n in (tick, 0)]


def test_another_controller_switches_the_relays_off() -> None:
    nodes = nodes_with(Fault(kind="foreign_command", at_s=0.1))
    nodes.world.set_relays(0, [1] * 6)
    commands = [frame for frame in fly(nodes, 20) if frame.id >> 5 == CODEC.message("DOCK_CMD").function]
    assert len(commands) == 11
    assert all(not isinstance(received, str) for received in Receiver(CODEC).judge(commands))
    assert nodes.world.docks.relays[0].tolist() == [0] * 6


def test_box_and_second_leader_speak_in_an_order_that_depends_on_nothing() -> None:
    """The lower CAN id wins arbitration."""
    for kinds in (("estop", "foreign_sync"), ("foreign_sync", "estop")):
        nodes = nodes_with(*(Fault(kind=kind) for kind in kinds))
        assert [frame.id for frame in fly(nodes, 1) if frame.id in (0x01E, 0x020)] == [0x01E, 0x020]


@pytest.mark.parametrize(("value", "relay"), [(1.0, 1), (-1.0, 2), (0.0, 0)])
def test_magnet_that_hangs_does_not_obey(value: float, relay: int) -> None:
    """It pulls, pushes or is dead, whatever is commanded."""
    nodes = nodes_with(Fault(kind="magnet", module=1, index=1, value=value))
    fly(nodes, 30)
    currents = nodes.world.docks.current_ma()[0]
    assert np.sign(currents).tolist() == [0.0, value, 0.0, 0.0, 0.0, 0.0]
    assert abs(currents[1]) >= 30.0 * abs(value)
    for relays in ([0] * 6, [1] * 6, [2] * 6):
        nodes.world.set_relays(0, relays)
        assert nodes.world.docks.relays[0].tolist() == [relays[0], relay, *relays[2:]]


def test_live_fault_can_be_cleared() -> None:
    nodes = nodes_with()
    faults = nodes.faults
    assert isinstance(faults, Faults)
    faults.add(Fault(kind="tag_absent"))
    assert not values(fly(nodes, 50), "TAG_POSITION")
    faults.clear("tag_absent")
    assert values(fly(nodes, 50, first=51), "TAG_POSITION")


@pytest.mark.parametrize(("fault", "refusal"), [
    (Fault(kind="frame_loss", value=30.0), "fault.value: 30 is not for frame_loss, which takes 0 to 1, except 0"),
    (Fault(kind="thruster_dead", index=8), "fault.index: 8 is beyond what the module has for thruster_dead; it takes 0 to 7"),
    (Fault(kind="babble", value=float("nan")), "fault.value: nan is not for babble, which takes whole numbers from 1"),
])  # fmt: skip
def test_live_fault_that_would_do_nothing_is_refused(fault: Fault, refusal: str) -> None:
    faults = Faults(nodes_with())
    with pytest.raises(DescriptionError, match=refusal):
        faults.add(fault)


def test_box_that_never_speaks_cannot_fall_silent() -> None:
    silent = Fault(kind="estop_box_silent")
    with pytest.raises(DescriptionError, match=r"fault\.kind: no e-stop box speaks here"):
        Faults(nodes_with()).add(silent)
    Faults(nodes_with(scenario="faults")).add(silent)


def test_thruster_is_one_that_a_module_of_the_fault_has() -> None:
    counts = {1: 8, 2: 6}
    wrong = {module: [key for key, _ in Fault(kind="thruster_dead", module=module, index=7).mistakes(counts)] for module in (0, 1, 2)}
    assert wrong == {0: [], 1: [], 2: ["index"]}


def test_process_is_dead_between_its_times() -> None:
    faults = Faults(nodes_with(), [Fault(kind="process_killed", at_s=1.0, until_s=2.0)])
    assert [faults.process_killed(round(t * 1e9)) for t in (0.99, 1.0, 1.99, 2.0)] == [False, True, True, False]
