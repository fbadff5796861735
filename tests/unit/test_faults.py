"""Dead and lying thrusters: found in time from ESCs or from the motion alone, and never where all is well."""

import dataclasses
import itertools

import numpy as np
import pytest

from firmware_py.core import propagation
from firmware_py.core.body import Body
from firmware_py.core.faults import CLEAR, FaultDetector
from firmware_py.core.missing_thrust import CORIOLIS, CROSSED, FORCES, MUNK, RECENT, MissingThrust, add_coriolis, add_flow, add_model
from firmware_py.core.pipeline import BodyPipeline
from firmware_py.core.preload import preload
from firmware_py.core.propagation import STATES
from firmware_py.core.rotations import difference, from_euler, to_matrix
from firmware_py.core.thruster import ThrusterLag
from firmware_py.core.types import EscFeedback, Estimate, Measured, ModuleInputs
from firmware_py.description.failsafe_parameters import Faults
from firmware_py.description.parameters import Parameters
from firmware_py.description.vehicle import load_vehicle
from firmware_py.prepare.assembly import assemble_vehicle

BODY = assemble_vehicle(load_vehicle("modcube"))
PUSH = preload(BODY.thrusters, np.ones(8, dtype=bool), 0.6)
"""Thrusters pushed against each other: the least that an armed robot commands, and nothing moves."""
TICK_NS, DT = 10_000_000, 0.01
ZERO = np.zeros(3)
LOST_AXES = {(4, 7): 1, (5, 6): 1, (2, 3): 1}
"""The paper's errata: pairs without which an axis cannot be made."""


class Water:
    """A robot that holds its place by PD, in water that is the model's but for what every real one is off by; feedback at 10 Hz."""

    def __init__(self, seed: int = 0, body: Body = BODY) -> None:
        self.rng = np.random.default_rng(seed)
        self.body, n = body, body.thrusters.f_max.size
        self.detector = FaultDetector(body, Faults(), TICK_NS)
        self.believed, self.acts = ThrusterLag(body.thrusters, DT), ThrusterLag(body.thrusters, DT)
        self.gain = self.rng.uniform(0.95, 1.05, n)
        self.deadband = self.rng.uniform(0.10, 0.25, n)
        self.speed_factor, self.stray_rpm = np.ones(n), np.zeros(n)
        self.status = np.zeros(n, dtype=int)
        self.heard = 1.0
        self.free = True
        self.tag_age_ns = 0
        self.x = np.zeros(STATES)
        self.x[2] = 2.0
        self.x[3:7] = from_euler(0.05, -0.02, 0.3)
        self.x[19:22], self.x[22:25] = [0.1, -0.05, 0.1], [0.003, -0.004, 0.002]
        self.start = self.x.copy()
        self.tick = 0

    def run(self, seconds: float, wanted: np.ndarray = PUSH, armed: bool = True) -> list[tuple[float, str]]:
        """What is found, with the time since the start of this run."""
        found = []
        for n in range(round(seconds / DT)):
            found += [((n + 1) * DT, words) for words in self._step(wanted if armed else np.zeros(8), armed)]
        return found

    def _step(self, wanted: np.ndarray, armed: bool) -> list[str]:
        self.tick += 1
        if armed:
            wanted = wanted + BODY.thrusters.pinv @ self._steer()
        wanted = np.where(self.detector.now.alive, wanted, 0.0)
        believed, acting = self.believed.step(), self.acts.step()
        self.believed.command(wanted)
        self.acts.command(np.where(np.abs(wanted) < self.deadband, 0.0, wanted))
        b, tau = self.body, self.body.thrusters.matrix @ (self.gain * acting)
        plant = (b.mass, b.mass_inv, b.righting, b.drag.nodes, b.drag.rotational, b.drag.linear)
        felt = propagation.inertial_acceleration(self.x, tau, *plant)
        self.x = propagation.step(self.x, tau, DT, *plant)
        estimate = Estimate(
            self.x[:3].copy(), self.x[3:7].copy(), self.x[7:13].copy(), ZERO, ZERO, np.full(3, 0.002), np.full(3, 0.0009),
            self.tag_age_ns, 1.0, 6, 0, True,
        )  # fmt: skip
        gyro = self.x[10:13] + 0.005 + 0.002 * self.rng.normal(size=3)
        weight = to_matrix(self.x[3:7].copy()).T @ np.array([0.0, 0.0, 9.80665])
        accel = felt - weight + 0.05 + 0.03 * self.rng.normal(size=3)
        measured = Measured(gyro, accel, None, [])
        if self.rng.uniform() >= self.heard:
            measured = Measured(None, None, None, [])
        module = ModuleInputs(esc=self._feedback())
        self.detector.step([module], measured, estimate, self.believed.force_n, believed, armed, self.free)
        return self.detector.words

    def _steer(self) -> np.ndarray:
        q = self.x[3:7].copy()
        off = np.r_[to_matrix(q).T @ (self.start[:3] - self.x[:3]), difference(self.start[3:7].copy(), q)]
        return BODY.mass @ (np.repeat([6.0, 9.0], 3) * off - np.repeat([5.0, 6.0], 3) * self.x[7:13])

    def _feedback(self) -> list[EscFeedback]:
        frames = []
        for first in range(0, 8, 2):
            if self.tick % 10 == first and self.rng.uniform() < self.heard:
                rpm = [
                    self.speed_factor[i] * self.detector.believed_rpm(i, float(self.acts.force_n[i]))
                    + self.stray_rpm[i] + 5.0 * self.rng.normal()
                    for i in (first, first + 1)
                ]
                status = (int(self.status[first]), int(self.status[first + 1]))
                frames.append(EscFeedback(first, (rpm[0], rpm[1]), (0.5, 0.5), status))
        return frames

    def fly(self, seconds: float = 3.0) -> None:
        """Disarmed, then armed and healthy; nothing may be found."""
        assert self.run(1.0, armed=False) == []
        assert self.run(seconds) == []


@pytest.fixture
def water() -> Water:
    return Water()


# ---------------------------------------------------------------- what the ESCs say


@pytest.mark.parametrize("thruster", range(8))
def test_thruster_that_stands_still_is_found_within_half_a_second(water: Water, thruster: int) -> None:
    water.fly(1.0)
    water.gain[thruster] = water.speed_factor[thruster] = 0.0
    found = water.run(1.0)
    assert [words for _, words in found] == [f"thruster {thruster + 1} stands still: left out"]
    assert found[0][0] <= 0.5
    assert water.detector.now.dead == (thruster,) and not water.detector.now.alive[thruster]
    assert water.detector.now.lost_axes == 0


@pytest.mark.parametrize("thruster", range(8))
def test_thruster_dead_from_the_start_is_found_within_half_a_second_of_the_first_command(thruster: int) -> None:
    water = Water(seed=thruster)
    water.gain[thruster] = water.speed_factor[thruster] = 0.0
    assert water.run(1.0, armed=False) == []
    pushing, found = 0.0, []
    while not found:
        found = water.run(DT)
        pushing += DT * (abs(water.believed.force_n[thruster]) > 0.3)
    assert [words for _, words in found] == [f"thruster {thruster + 1} stands still: left out"]
    assert pushing <= 0.5, "the others steer it through zero at times"


@pytest.mark.parametrize("status", [1, 3])
def test_esc_that_reports_a_failure_is_believed(water: Water, status: int) -> None:
    water.fly(0.5)
    water.status[6] = status
    found = water.run(1.0)
    assert found[0][0] <= 0.41 and found[0][1] == "thruster 7 has an ESC that failed: left out"


def test_hot_esc_is_no_failure(water: Water) -> None:
    water.status[6] = 2
    water.fly(2.0)


@pytest.mark.parametrize("factor", [-1.0, 4.0])
def test_thruster_that_turns_the_wrong_way_or_races_is_found(water: Water, factor: float) -> None:
    water.fly(0.5)
    water.speed_factor[3] = factor
    found = water.run(1.0, 2.0 * PUSH)
    assert found[0][1] == "thruster 4 does not obey: left out" and found[0][0] <= 0.6


@pytest.mark.parametrize("factor", [-1.0, 4.0])
def test_two_feedbacks_of_a_disobedient_thruster_are_enough_and_one_is_not(water: Water, factor: float) -> None:
    """Each ESC is heard ten times a second."""
    water.run(1.0, 2.0 * PUSH)
    water.speed_factor[3] = factor
    assert water.run(0.1, 2.0 * PUSH) == []
    water.speed_factor[3] = 1.0
    assert water.run(1.0, 2.0 * PUSH) == []
    water.speed_factor[3] = factor
    assert [words for _, words in water.run(0.2, 2.0 * PUSH)] == ["thruster 4 does not obey: left out"]


def test_two_feedbacks_of_a_clear_standstill_are_enough_and_one_is_not(water: Water) -> None:
    water.run(1.0, 2.0 * PUSH)
    busy = int(np.argmax(np.abs(water.believed.force_n)))
    assert abs(water.believed.force_n[busy]) > CLEAR * Faults().force_n
    water.speed_factor[busy] = 0.0
    assert water.run(0.1, 2.0 * PUSH) == []
    water.speed_factor[busy] = 1.0
    assert water.run(1.0, 2.0 * PUSH) == []
    water.speed_factor[busy] = 0.0
    assert [words for _, words in water.run(0.2, 2.0 * PUSH)] == [f"thruster {busy + 1} stands still: left out"]


def test_slow_thruster_below_its_deadband_is_healthy(water: Water) -> None:
    """At 0.09 N no propeller turns."""
    assert water.run(2.0, 0.15 * PUSH) == []


def test_disarmed_robot_is_not_judged(water: Water) -> None:
    water.speed_factor[:], water.status[:] = 0.0, 1
    assert water.run(2.0, armed=False) == []


def test_propeller_that_turns_on_a_disarmed_robot_is_told_of_once_and_anew_when_it_does_so_again(water: Water) -> None:
    water.fly(1.0)
    assert water.run(1.0, armed=False) == [], "they only run down"
    water.stray_rpm[2] = -0.4 * BODY.thrusters.rpm_at_full[2]
    assert [words for _, words in water.run(1.0, armed=False)] == ["thruster 3 turns though it was told to stand still"]
    assert water.detector.now.alive.all(), "it is trusted again when it is armed, and judged then"
    water.stray_rpm[2] = 0.0
    assert water.run(1.0, armed=False) == []
    water.stray_rpm[2] = 0.4 * BODY.thrusters.rpm_at_full[2]
    assert len(water.run(1.0, armed=False)) == 1


def test_dead_thruster_is_found_although_frames_are_lost(water: Water) -> None:
    water.heard = 0.7
    water.fly(2.0)
    water.gain[2] = water.speed_factor[2] = 0.0
    assert water.run(1.5)[0][1].startswith("thruster 3 ")


# ---------------------------------------------------------------- what only the motion shows


@pytest.mark.parametrize("thruster", range(8))
@pytest.mark.parametrize("gain", [0.0, -1.0], ids=["fakes its speed", "reversed"])
def test_lying_thruster_is_found_within_two_seconds(thruster: int, gain: float) -> None:
    water = Water(seed=thruster)
    water.fly()
    water.gain[thruster] *= gain
    found = water.run(2.0)
    assert [words for _, words in found] == [f"thruster {thruster + 1} does not push as it says: left out"]


def test_thruster_is_not_judged_by_the_motion_of_a_robot_that_sees_no_tag_and_is_when_it_sees_one_again() -> None:
    """Blind it knows its tilt and speed too badly."""
    water = Water(seed=2)
    water.fly()
    water.tag_age_ns = 600_000_000
    water.gain[2] = 0.0
    assert water.run(2.0) == []
    water.gain[2], water.tag_age_ns = 1.0, 0
    assert water.run(6.0) == []
    water.gain[2] = 0.0
    assert [words for _, words in water.run(2.0)] == ["thruster 3 does not push as it says: left out"]


def test_thruster_is_not_judged_by_the_motion_of_a_robot_that_touches_the_surface() -> None:
    """There water pushes that no model here knows. Half the diagonal of the module's box is 0.17 m."""
    found = {}
    for depth_m in (0.1, 0.3):
        water = Water(seed=2)
        water.x[2] = water.start[2] = depth_m
        water.fly()
        water.gain[2] = 0.0
        found[depth_m] = [words for _, words in water.run(2.0)]
    assert found == {0.1: [], 0.3: ["thruster 3 does not push as it says: left out"]}


@pytest.mark.parametrize("every", [1, 10])
def test_thruster_is_not_judged_by_the_motion_of_a_robot_from_which_magnets_push_another(every: int) -> None:
    """A second of that looked like a thruster that does not push, in one undock of seven. One tick of it spoils a block."""
    water = Water(seed=2)
    water.fly()
    water.gain[2] = 0.0
    said: list[tuple[float, str]] = []
    for tick in range(200):
        water.free = tick % every != 0
        said += water.run(0.01)
    assert said == []
    water.free = True
    assert [words for _, words in water.run(2.0)] == ["thruster 3 does not push as it says: left out"]


def test_lying_thruster_is_found_from_the_moment_of_arming() -> None:
    water = Water(seed=3)
    water.gain[5] = 0.0
    assert water.run(2.0, armed=False) == []
    water.detector.reset()
    found = water.run(2.0)
    assert [words for _, words in found] == ["thruster 6 does not push as it says: left out"]


def test_lying_thruster_is_found_although_frames_are_lost() -> None:
    water = Water(seed=1)
    water.heard = 0.7
    water.fly()
    water.gain[0] = 0.0
    assert [words for _, words in water.run(2.0)] == ["thruster 1 does not push as it says: left out"]


@pytest.mark.parametrize("seed", range(6))
def test_healthy_robot_that_is_pushed_about_has_no_liar(seed: int) -> None:
    """Forces that change twice a second, gains and deadbands off as real ones, a disturbance that turns with the body."""
    water = Water(seed)
    assert water.run(1.0, armed=False) == []
    rng = np.random.default_rng(100 + seed)
    for _ in range(20):
        wrench = rng.normal(size=6) * np.repeat([1.5, 0.05], 3)
        assert water.run(0.5, PUSH + BODY.thrusters.pinv @ wrench) == []


@pytest.mark.parametrize("thruster", range(8))
def test_weak_thruster_whose_speed_says_so_does_not_lie_and_one_that_says_too_little_does(thruster: int) -> None:
    """Half the force comes with 71 % of the speed."""
    found = {}
    for gain, speed in ((0.5, 0.5**0.5), (0.0, 0.9)):
        water = Water(seed=thruster)
        water.fly()
        water.gain[thruster] *= gain
        water.speed_factor[thruster] = speed
        found[gain] = [words for _, words in water.run(5.0, PUSH * np.where(np.arange(8) == thruster, 1.4, 1.0))]
    assert found == {0.5: [], 0.0: [f"thruster {thruster + 1} does not push as it says: left out"]}


# ---------------------------------------------------------------- what follows


@pytest.mark.parametrize("name", ["modcube", "bluerov2_heavy", "girona500"])
def test_motion_of_a_body_whose_water_is_heavier_along_one_axis_than_along_another_misses_no_thrust(name: str) -> None:
    """What the model leaves out of a healthy body's motion, a Munk moment say, would be blamed on a thruster."""
    b = assemble_vehicle(load_vehicle(name))
    plant = (b.mass, b.mass_inv, b.righting, b.drag.nodes, b.drag.rotational, b.drag.linear)
    rng = np.random.default_rng(5)
    x, tau, modelled = np.zeros(STATES), rng.normal(size=6), np.zeros(6)
    x[3:7], x[7:13] = from_euler(0.3, -0.2, 0.9), [0.5, 0.2, -0.3, 0.2, -0.1, 0.3]
    felt = propagation.inertial_acceleration(x, tau, *plant)
    turning = propagation.acceleration(x[7:13].copy(), x[3:7].copy(), tau, *plant)[3:]
    add_model(*plant[2:], x[7:13].copy(), x[3:7].copy(), modelled)
    add_coriolis(b.mass, x[7:13].copy(), modelled)
    np.testing.assert_allclose(b.mass @ np.r_[felt, turning], tau + modelled, atol=1e-9)


@pytest.mark.parametrize("coriolis", [0.0, 1.0, 10.0])
def test_a_thruster_is_not_blamed_for_a_change_that_is_small_beside_the_coriolis_wrench(coriolis: float) -> None:
    """Masses are known to a tenth, the speed through water that drifts to less: so is what both do on a fast curve."""
    watch = MissingThrust(BODY, Faults(), TICK_NS)
    watch._blocks[:], watch._blocks[:, -1] = 0.0, 0.3
    lost = -3.0 * BODY.thrusters.matrix[:, 2]
    watch._blocks[-RECENT:, :6], watch._blocks[-RECENT:, FORCES + 2] = lost, 3.0
    watch._blocks[-RECENT:, CORIOLIS:CROSSED] = coriolis * lost
    assert watch._explain(np.ones(8, bool)) == (-1 if coriolis == 10.0 else 2)


@pytest.mark.parametrize(("column", "most"), [(CROSSED, 0.5), (MUNK, 0.2)])
@pytest.mark.parametrize("sign", [-1.0, 0.0, 1.0])
def test_a_thruster_is_not_blamed_for_what_the_water_does_to_a_body_that_turns_under_way(column: int, most: float, sign: float) -> None:
    """Flow across the turn brakes it, and masses that differ from axis to axis turn it: neither is in the model of a cube."""
    watch = MissingThrust(BODY, Faults(), TICK_NS)
    watch._blocks[:], watch._blocks[:, -1] = 0.0, 0.3
    watch._blocks[-RECENT:, :6] = -2.0 * BODY.thrusters.matrix[:, 2]
    watch._blocks[-RECENT:, FORCES + 2] = 2.0
    watch._blocks[-RECENT:, column : column + 3] = sign * most
    assert watch._explain(np.ones(8, bool)) == (2 if sign == 0.0 else -1)


def test_flow_is_what_a_turn_under_way_meets() -> None:
    out = np.zeros(6)
    add_flow(np.array([0.3, -0.2, 0.1, 0.5, -0.4, 0.2]), out)
    np.testing.assert_allclose(out, [0.3 * 0.5, -0.4 * 0.4, 0.5 * 0.2, -0.02, 0.03, -0.06])


@pytest.mark.parametrize("pair", list(itertools.combinations(range(8), 2)), ids=str)
def test_axes_that_are_lost_with_a_pair_are_those_of_the_errata(pair: tuple[int, int]) -> None:
    water = Water()
    for thruster in pair:
        water.gain[thruster] = water.speed_factor[thruster] = 0.0
    water.run(0.6)
    now = water.detector.now
    assert now.dead == pair and now.lost_axes == LOST_AXES.get(pair, 0)
    matrix = BODY.thrusters.matrix * now.alive
    wrench = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    kept = now.keep @ wrench
    np.testing.assert_allclose(matrix @ np.linalg.pinv(matrix) @ kept, kept, atol=1e-9)
    np.testing.assert_allclose(kept[:3], wrench[:3], atol=1e-9, err_msg="the force, and so the place, is kept")
    assert np.linalg.matrix_rank(now.keep, tol=1e-6) == 6 - now.lost_axes


@pytest.mark.parametrize(("name", "offset_m"), [("bluerov2_heavy", 0.0), ("bluerov2_heavy", 0.001), ("modcube_sim", 0), ("chasing_m2", 0)])
def test_force_that_is_lost_whole_costs_no_moment(name: str, offset_m: float) -> None:
    """The diagonal pair of horizontal thrusters: the pseudo-inverse of a rounding error asked for 1e16 N m, and the robot spun."""
    vehicle = load_vehicle(name)
    inertial = dataclasses.replace(vehicle.inertial, com_m=vehicle.inertial.com_m + np.array([0.0, offset_m, 0.0]))
    body = assemble_vehicle(dataclasses.replace(vehicle, inertial=inertial))
    detector = FaultDetector(body, Faults(), TICK_NS)
    failed = [EscFeedback(0, (0.0, 0.0), (0.0, 0.0), (1, 0)), EscFeedback(2, (0.0, 0.0), (0.0, 0.0), (0, 1))]
    nowhere = Estimate(ZERO, from_euler(0.0, 0.0, 0.0), np.zeros(6), ZERO, ZERO, ZERO, ZERO, 0, 1.0, 6, 0, False)
    for _ in range(Faults().dead_count):
        now = detector.step([ModuleInputs(esc=failed)], Measured(None, None, None, []), nowhere, np.zeros(8), np.zeros(8), True, True)
    assert now.dead == (0, 3) and now.lost_axes == 1
    wanted = np.array([2.0, 1.0, 0.5, 0.1, 0.05, -0.1])
    kept = now.keep @ wanted
    np.testing.assert_allclose(kept[2:], wanted[2:], atol=0.01)
    assert 0.0 < np.linalg.norm(kept[:2]) <= np.linalg.norm(wanted[:2])


@pytest.mark.parametrize(("wanted", "made"), [([200.0, 200.0, 0, 0, 0, 0], [64.84, 64.84]), ([60.0, 60.0, 0, 0, 0.5, 0], [60.0, 60.0])])
def test_healthy_robot_that_lacks_an_axis_makes_the_force_that_it_can(wanted: list[float], made: list[float]) -> None:
    """BlueROV2 cannot pitch, and its surge pitches it a little: saturated, nothing was left of it."""
    body = assemble_vehicle(load_vehicle("bluerov2"))
    chain = BodyPipeline(body, Parameters(), TICK_NS)
    assert chain.faults.now.lost_axes == 0 and np.linalg.matrix_rank(body.thrusters.matrix) == 5
    thrust = chain._allocate(np.array(wanted, dtype=np.float64), 0)
    np.testing.assert_allclose(thrust.achieved[:2], np.array(made), rtol=0.02)
    assert np.abs(thrust.achieved[3:]).max() < 0.02 * made[0]


def test_robot_of_five_thrusters_makes_the_force_that_it_can() -> None:
    """Girona 500 cannot roll, and its sway rolls it a little: saturated, nothing was left of it."""
    chain = BodyPipeline(assemble_vehicle(load_vehicle("girona500")), Parameters(), TICK_NS)
    thrust = chain._allocate(np.array([600.0, 100.0, 0.0, 0.0, 0.0, 0.0]), 0)
    np.testing.assert_allclose(thrust.achieved[:3], [269.1, 44.85, 0.0], atol=0.5)
    assert np.abs(thrust.achieved[3:]).max() < 1.0


def test_robot_that_is_armed_anew_trusts_its_thrusters_again(water: Water) -> None:
    water.speed_factor[1] = 0.0
    water.run(0.6)
    assert water.detector.now.dead == (1,)
    water.detector.reset()
    assert water.detector.now.dead == () and water.detector.changed and water.detector.now.alive.all()
    water.detector.reset()
    assert not water.detector.changed


def test_change_is_said_once(water: Water) -> None:
    water.speed_factor[1] = 0.0
    changes = []
    for _ in range(80):
        water.run(DT)
        changes.append(water.detector.changed)
    assert sum(changes) == 1
