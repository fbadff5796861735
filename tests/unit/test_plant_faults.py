"""Faults of the plant and of its wire: each breaks what it says, from when to when it says, and the rest stays as it was."""

import numpy as np
import pytest

from firmware_py.bus.codec import Codec, Frame, Receiver
from hil.faults import Faults, Wire
from hil.nodes import Nodes, make_nodes
from hil.plant.fault_spec import Fault
from hil.scenario import load_scenario, make_world

PERIOD_NS = 10_000_000
CODEC = Codec.load()
FRAMES = [Frame(0x100 + i, bytes([i] * 6)) for i in range(20)]


def nodes_with(*faults: Fault) -> Nodes:
    scenario = load_scenario("hover")
    nodes = make_nodes(make_world(scenario, 0, PERIOD_NS), CODEC, {1: 0}, scenario)
    nodes.faults = Faults(nodes, faults)
    return nodes


def fly(nodes: Nodes, ticks: int, u: float = 0.5, first: int = 1) -> list[Frame]:
    out: list[Frame] = []
    for k in range(first, first + ticks):
        commands = [CODEC.message(f"THRUSTER_CMD_{half}").encode(1, [u, u, u, u, 1], k) for half in "AB"]
        out += nodes.step([CODEC.message("SYNC").encode(0, [k]), *commands])
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


def test_hand_pushes_with_its_force_for_its_time_from_a_side_of_the_seed_s_own() -> None:
    """From rest in still water: the hull gains F t over its mass, water included, and a turn; another seed's hand pushes elsewhere."""
    calm = load_scenario("hover").with_calm_world()
    gained = []
    for seed in (0, 1):
        nodes = make_nodes(make_world(calm, seed, PERIOD_NS), CODEC, {1: 0}, calm)
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


def tags(*faults: Fault, ticks: int = 60) -> np.ndarray:
    return np.array(values(fly(nodes_with(*faults), ticks, u=0.0), "TAG_POSITION"))[:, :3]


def test_camera_bias_moves_every_tag_alike() -> None:
    off = tags(Fault(kind="camera_bias", value=0.005)) - tags()
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), 0.005, atol=0.001)
    assert np.ptp(off, axis=0).max() <= 0.001 + 1e-9, "the frames' resolution"


def test_tags_jump_and_vanish() -> None:
    assert np.mean(tags(Fault(kind="tag_jump", value=0.3)) - tags(), axis=0)[0] == pytest.approx(0.3, abs=1e-3)
    assert not values(fly(nodes_with(Fault(kind="tag_absent")), 50), "TAG_POSITION")


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


def test_magnet_that_hangs_does_not_obey() -> None:
    nodes = nodes_with(Fault(kind="magnet", module=1, index=1, value=1.0))
    fly(nodes, 2)
    nodes.world.set_relays(0, [0] * 6)
    fly(nodes, 30, first=3)
    assert nodes.world.docks.current_ma()[0, 1] > 30.0
    assert not nodes.world.docks.current_ma()[0, [0, 2, 3, 4, 5]].any()


def test_live_fault_can_be_cleared() -> None:
    nodes = nodes_with()
    faults = nodes.faults
    assert isinstance(faults, Faults)
    faults.add(Fault(kind="tag_absent"))
    assert not values(fly(nodes, 50), "TAG_POSITION")
    faults.clear("tag_absent")
    assert values(fly(nodes, 50, first=51), "TAG_POSITION")


def test_process_is_dead_between_its_times() -> None:
    faults = Faults(nodes_with(), [Fault(kind="process_killed", at_s=1.0, until_s=2.0)])
    assert [faults.process_killed(round(t * 1e9)) for t in (0.99, 1.0, 1.99, 2.0)] == [False, True, True, False]
