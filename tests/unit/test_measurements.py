"""Sensors of several modules, each rotated and displaced in the body, become one measurement of the body."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.core.body import Body
from firmware_py.core.drag_lookup import drag_wrench
from firmware_py.core.measurements import SECOND_HAND, SECOND_HAND_WEIGHT, Measurements
from firmware_py.core.rotations import difference, exp, from_euler, multiply, to_matrix
from firmware_py.core.types import BodyPose, Measured, ModuleInputs, TagObservation
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.description.water import WATER_DENSITY
from firmware_py.prepare.assembly import assemble
from firmware_py.prepare.lattice import MATRICES

CELLS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0)])
ROTATIONS = [0, 4, 12]
FLEET_INDEX = [2, 0, 1]
CAPTURE = 123_000_000
Q_WB = from_euler(0.4, -1.2, 2.0)
P_WB = np.array([1.0, -2.0, 0.7])
R_WB = Rotation.from_quat(Q_WB[[1, 2, 3, 0]])
ORIGINS_B = 0.21 * (CELLS - CELLS.mean(axis=0))
"""Origin of each module from the common centre of mass, which is the mean because the modules are equal."""
PERIOD = 10_000_000
GYRO_SIGMA, ACCEL_SIGMA = 0.002, 0.05
SUBSETS = [(0,), (1,), (2,), (0, 2), (0, 1, 2)]


@pytest.fixture(scope="module")
def body() -> Body:
    """An L of three modules, each in another orientation, and in another order than the fleet's."""
    return assemble(CELLS, ROTATIONS, [load_vehicle("modcube")] * 3, FLEET_INDEX)


@pytest.fixture
def measurements(body: Body) -> Measurements:
    return Measurements(body, PERIOD)


def silent() -> list[ModuleInputs]:
    return [ModuleInputs() for _ in range(3)]


def tag_seen(module: int, face: int, capture_ns: int = CAPTURE, turn: np.ndarray | None = None) -> TagObservation:
    """The report of a perfect camera for the tag on `face` of module `module`, from the vehicle file alone."""
    tag = next(t for t in load_vehicle("modcube").tag if t.id == face)
    r_bm = Rotation.from_matrix(np.array(MATRICES[ROTATIONS[module]]))
    p_wt = P_WB + R_WB.apply(ORIGINS_B[module] + r_bm.apply(np.array(tag.position_m)))
    q_wt = (R_WB * r_bm * Rotation.from_quat(np.array(tag.quaternion[[1, 2, 3, 0]]))).as_quat()[[3, 0, 1, 2]]
    if turn is not None:
        q_wt = multiply(np.ascontiguousarray(q_wt), exp(turn))
    return TagObservation(face, 7, capture_ns, p_wt, np.ascontiguousarray(q_wt))


def fuse_tags(measurements: Measurements, *seen: tuple[int, TagObservation]) -> list[BodyPose]:
    modules = silent()
    for module, tag in seen:
        modules[FLEET_INDEX[module]].tags.append(tag)
    return measurements.fuse(modules, Q_WB).tags


def assert_is_the_truth(pose: BodyPose) -> None:
    np.testing.assert_allclose(difference(pose.q_wb, Q_WB), 0.0, atol=1e-9)
    np.testing.assert_allclose(pose.p_wt - R_WB.apply(pose.lever_b), P_WB, atol=1e-12)


@pytest.mark.parametrize("module", [0, 1, 2])
@pytest.mark.parametrize("face", range(6))
def test_any_tag_of_any_module_tells_the_pose_of_the_body(measurements: Measurements, module: int, face: int) -> None:
    (pose,) = fuse_tags(measurements, (module, tag_seen(module, face)))
    assert_is_the_truth(pose)
    assert (pose.tags, pose.capture_ns) == (1, CAPTURE)


def test_all_tags_of_one_picture_are_one_pose(measurements: Measurements) -> None:
    everything = [(m, tag_seen(m, f)) for m in range(3) for f in range(6)]
    (pose,) = fuse_tags(measurements, *everything)
    assert_is_the_truth(pose)
    assert pose.tags == 18


def test_tags_of_one_picture_are_averaged(measurements: Measurements) -> None:
    turn = np.array([0.02, -0.03, 0.04])
    seen = [(m, tag_seen(m, 5, turn=sign * turn)) for m, sign in ((0, 1.0), (0, -1.0))]
    (pose,) = fuse_tags(measurements, *seen)
    assert_is_the_truth(pose)


def test_two_pictures_are_two_poses_oldest_first(measurements: Measurements) -> None:
    poses = fuse_tags(measurements, (0, tag_seen(0, 5, CAPTURE + 16_000_000)), (1, tag_seen(1, 5, CAPTURE)))
    assert [pose.capture_ns for pose in poses] == [CAPTURE, CAPTURE + 16_000_000]
    for pose in poses:
        assert_is_the_truth(pose)


@pytest.mark.parametrize("flipped", [0, 1, 2, 3])
def test_flipped_tag_among_four_is_left_out(measurements: Measurements, flipped: int) -> None:
    """The pose of a planar tag has a second solution, tens of degrees off; the other tags of the picture outvote it."""
    flip = np.array([0.7, 0.0, 0.0])
    seen = [(0, tag_seen(0, face, turn=flip if k == flipped else None)) for k, face in enumerate((5, 4, 0, 2))]
    (pose,) = fuse_tags(measurements, *seen)
    assert_is_the_truth(pose)
    assert pose.tags == 3


def test_noise_of_a_degree_is_not_a_flip(measurements: Measurements) -> None:
    rng = np.random.default_rng(4)
    seen = [(m, tag_seen(m, f, turn=rng.normal(scale=0.02, size=3))) for m in range(3) for f in (4, 5)]
    (pose,) = fuse_tags(measurements, *seen)
    assert pose.tags == 6
    assert np.linalg.norm(difference(pose.q_wb, Q_WB)) < 0.03


@pytest.mark.parametrize("second_hand", [0, 1])
def test_tag_told_through_another_one_pulls_by_its_weight(measurements: Measurements, second_hand: int) -> None:
    """Place, lever and attitude, whichever tag comes first in the picture."""
    off, turn = np.array([0.03, -0.02, 0.05]), np.array([0.0, 0.1, -0.05])
    far = tag_seen(2, 0, turn=turn)
    far = far._replace(quality=SECOND_HAND, p_wt=far.p_wt + off)
    near = tag_seen(0, 5)
    seen = [(2, far), (0, near)] if second_hand == 0 else [(0, near), (2, far)]
    (pose,) = fuse_tags(measurements, *seen)
    share = SECOND_HAND_WEIGHT / (1.0 + SECOND_HAND_WEIGHT)
    assert pose.tags == pytest.approx(1.0 + SECOND_HAND_WEIGHT)
    np.testing.assert_allclose(pose.p_wt, near.p_wt + share * (far.p_wt - near.p_wt), atol=1e-12)
    np.testing.assert_allclose(pose.p_wt - R_WB.apply(pose.lever_b) - P_WB, share * off, atol=1e-12)
    assert np.linalg.norm(difference(pose.q_wb, Q_WB)) == pytest.approx(share * np.linalg.norm(turn), rel=1e-6)


def test_picture_is_as_exact_as_it_says(measurements: Measurements) -> None:
    """The mean of a full and a second-hand tag scatters by one tag's sigma over the root of the worth that the picture reports."""
    rng, sigma = np.random.default_rng(0), 0.002
    near, far = tag_seen(0, 5), tag_seen(0, 4)._replace(quality=SECOND_HAND)
    off = []
    for _ in range(1500):
        noisy = [t._replace(p_wt=t.p_wt + rng.normal(0, k * sigma, 3)) for t, k in ((near, 1.0), (far, SECOND_HAND_WEIGHT**-0.5))]
        (pose,) = fuse_tags(measurements, *((0, tag) for tag in noisy))
        off.append(pose.p_wt - R_WB.apply(pose.lever_b) - P_WB)
    assert np.std(off) == pytest.approx(sigma / pose.tags**0.5, rel=0.04)


def test_tags_of_one_worth_are_averaged_alike_to_the_last_bit(measurements: Measurements) -> None:
    rng = np.random.default_rng(5)
    seen = [(m, tag_seen(m, f, turn=rng.normal(scale=0.02, size=3))) for m in range(3) for f in (4, 5, 0)]
    (full,) = fuse_tags(measurements, *seen)
    (second,) = fuse_tags(measurements, *((m, tag._replace(quality=SECOND_HAND)) for m, tag in seen))
    for one, other in zip(full[1:4], second[1:4], strict=True):
        assert np.array_equal(one, other)
    np.testing.assert_array_equal(full.p_wt, sum(tag.p_wt / 9 for _, tag in seen))


def test_tag_that_the_vehicle_does_not_carry_is_not_believed(measurements: Measurements) -> None:
    stranger = tag_seen(0, 5)._replace(tag_id=14)
    assert fuse_tags(measurements, (0, stranger)) == []


def test_lever_of_the_wrong_module_would_be_noticed(measurements: Measurements) -> None:
    """The same frames under another module's number place the body elsewhere, so the tests above do check the lever."""
    (pose,) = fuse_tags(measurements, (2, tag_seen(1, 5)))
    assert np.linalg.norm(pose.p_wt - R_WB.apply(pose.lever_b) - P_WB) > 0.1


# ---------------------------------------------------------------- inertial sensors and depth


def in_module(module: int, vector_b: np.ndarray) -> np.ndarray:
    return MATRICES[ROTATIONS[module]].T @ vector_b


@pytest.mark.parametrize("heard", SUBSETS)
def test_rates_and_forces_are_turned_into_the_body_and_averaged_over_those_heard_at_its_centre_of_mass(
    measurements: Measurements, heard: tuple[int, ...]
) -> None:
    rate, force = np.array([0.1, -0.4, 0.9]), np.array([1.0, 2.0, -9.0])
    modules = silent()
    spread = np.linspace(-0.01, 0.01, len(heard)) if len(heard) > 1 else [0.0]
    for module, offset in zip(heard, spread, strict=True):
        modules[FLEET_INDEX[module]].gyro = in_module(module, rate + offset)
        felt = force + np.cross(rate, np.cross(rate, ORIGINS_B[module]))
        modules[FLEET_INDEX[module]].accel = in_module(module, felt + offset)
    measured = measurements.fuse(modules, Q_WB)
    assert measured.gyro is not None and measured.accel is not None
    np.testing.assert_allclose(measured.gyro, rate, atol=1e-14)
    np.testing.assert_allclose(measured.accel, force, atol=1e-13)


def turning(
    measurements: Measurements, heard: tuple[int, ...], rate: np.ndarray, alpha: np.ndarray, rng: np.random.Generator | None = None
) -> Measured:
    """Measurements by the modules `heard` of a body that is pushed, and turns at `rate` (3,), which grows by `alpha` (3,)."""
    modules = silent()
    for module in heard:
        noise = np.zeros(6) if rng is None else rng.normal(size=6)
        lever = ORIGINS_B[module]
        force = PUSHED + np.cross(alpha, lever) + np.cross(rate, np.cross(rate, lever))
        modules[FLEET_INDEX[module]].gyro = in_module(module, rate + GYRO_SIGMA * noise[:3])
        modules[FLEET_INDEX[module]].accel = in_module(module, force + ACCEL_SIGMA * noise[3:])
    return measurements.fuse(modules, Q_WB)


PUSHED = np.array([1.0, 2.0, -9.0])
RATE, ALPHA = np.array([0.1, -0.4, 0.9]), np.array([1.0, 0.5, -0.7])


@pytest.mark.parametrize("heard", SUBSETS)
@pytest.mark.parametrize("period_ns", [2_500_000, PERIOD, 20_000_000])
def test_specific_force_of_a_turn_that_quickens_is_that_of_the_centre_of_mass(body: Body, heard: tuple[int, ...], period_ns: int) -> None:
    """At any tick rate, a quarter of a second into the turn."""
    measurements = Measurements(body, period_ns)
    for k in range(round(0.25e9) // period_ns):
        measured = turning(measurements, heard, RATE + ALPHA * k * period_ns * 1e-9, ALPHA)
    assert measured.accel is not None
    np.testing.assert_allclose(measured.accel, PUSHED, atol=1e-3)


def test_imus_around_the_centre_of_mass_are_averaged_and_nothing_else(body: Body) -> None:
    """To the last bit, as if no gyro had reported the turn."""
    measurements, deaf = Measurements(body, PERIOD), Measurements(body, PERIOD)
    for k in range(20):
        modules = silent()
        for i, module in enumerate(modules):
            module.accel = np.array([0.1 * i, 1e-9, -9.0])
        expected = deaf.fuse(modules, Q_WB).accel
        for module in modules:
            module.gyro = np.array([0.3, 0.01 * k, -0.7])
        turned = measurements.fuse(modules, Q_WB).accel
        assert turned is not None and expected is not None
        assert turned.tobytes() == expected.tobytes()


@pytest.mark.slow
def test_noise_of_the_gyro_hardly_reaches_the_specific_force_of_a_body_at_rest(body: Body) -> None:
    measurements, rng = Measurements(body, PERIOD), np.random.default_rng(8)
    accel = [turning(measurements, (1,), np.zeros(3), np.zeros(3), rng).accel for _ in range(2000)]
    assert np.std(np.array(accel) - PUSHED) == pytest.approx(ACCEL_SIGMA, rel=0.04)


def test_angular_acceleration_is_not_carried_over_a_gap(body: Body) -> None:
    measurements = Measurements(body, PERIOD)
    for k in range(20):
        turning(measurements, (1,), ALPHA * k * 0.01, ALPHA)
    turning(measurements, (), RATE, ALPHA)
    for _ in range(3):
        measured = turning(measurements, (1,), RATE, np.zeros(3))
        assert measured.accel is not None
        np.testing.assert_allclose(measured.accel, PUSHED, atol=1e-12)


def test_imu_beside_the_centre_of_mass_of_a_lone_module_is_told_apart() -> None:
    heavy = replace(load_vehicle("modcube"), inertial=replace(load_vehicle("modcube").inertial, com_m=np.array([0.02, 0.0, 0.01])))
    lone = Measurements(assemble([(0, 0, 0)], [0], [heavy], [0]), PERIOD)
    lever = -np.array([0.02, 0.0, 0.01])
    felt = PUSHED + np.cross(RATE, np.cross(RATE, lever))
    measured = lone.fuse([ModuleInputs(gyro=RATE, accel=felt)], Q_WB)
    assert measured.accel is not None
    np.testing.assert_allclose(measured.accel, PUSHED, atol=1e-12)


@pytest.mark.parametrize("heard", [(0,), (1,), (2,), (1, 2), (0, 1, 2)])
def test_depth_is_that_of_the_centre_of_mass_in_any_attitude(measurements: Measurements, heard: tuple[int, ...]) -> None:
    modules = silent()
    for module in heard:
        z = (P_WB + R_WB.apply(ORIGINS_B[module]))[2]
        modules[FLEET_INDEX[module]].pressure_pa = 101_325.0 + WATER_DENSITY * 9.80665 * z
    depth = measurements.fuse(modules, Q_WB).depth_m
    assert depth == pytest.approx(P_WB[2], abs=1e-9)


BIASES = np.array([
    [0.01, -0.02, 0.005, 0.05, -0.06, 0.03, 0.02], [0.0, 0.01, -0.01, -0.02, 0.04, 0.01, -0.03], [-0.02, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0],
])  # fmt: skip
"""Biases of each module's gyro and accelerometer, both in the axes of the body, and depth."""


def biased(measurements: Measurements, heard: tuple[int, ...], rate: np.ndarray, failed: int | None = None) -> np.ndarray:
    """(7,) measured less true values of a body that turns at `rate` with biased sensors; the accelerometer of `failed` reads zeros."""
    modules = silent()
    for module in heard:
        here, (gyro, accel, depth_m) = modules[FLEET_INDEX[module]], np.split(BIASES[module], [3, 6])
        here.gyro = in_module(module, rate + gyro)
        felt = PUSHED + np.cross(rate, np.cross(rate, ORIGINS_B[module])) + accel
        here.accel = in_module(module, felt) if module != failed else np.zeros(3)
        z = (P_WB + R_WB.apply(ORIGINS_B[module]))[2] + depth_m[0]
        here.pressure_pa = 101_325.0 + WATER_DENSITY * 9.80665 * z
    measured = measurements.fuse(modules, Q_WB)
    assert measured.gyro is not None and measured.accel is not None and measured.depth_m is not None
    return np.r_[measured.gyro - rate, measured.accel - PUSHED, measured.depth_m - P_WB[2]]


@pytest.mark.parametrize("heard", SUBSETS)
def test_mean_keeps_its_bias_when_modules_fall_silent(body: Body, heard: tuple[int, ...]) -> None:
    """The estimator has learnt that bias by then, while the body stood still."""
    measurements = Measurements(body, PERIOD)
    for _ in range(100):
        before = biased(measurements, (0, 1, 2), np.zeros(3))
    np.testing.assert_allclose(before, BIASES.mean(axis=0), atol=1e-9)
    after = [biased(measurements, heard, np.zeros(3)) for _ in range(30)]
    np.testing.assert_allclose(after, np.tile(before, (30, 1)), atol=1e-3)


def test_pressure_sensors_that_are_heard_in_turns_are_told_apart(body: Body) -> None:
    """The estimator knows their mean bias: each is corrected to it, also at once when one falls silent."""
    measurements, each = Measurements(body, PERIOD), BIASES[:, 6]

    def hear(module: int) -> float:
        modules = silent()
        z = (P_WB + R_WB.apply(ORIGINS_B[module]))[2] + each[module]
        modules[FLEET_INDEX[module]].pressure_pa = 101_325.0 + WATER_DENSITY * 9.80665 * z
        for m in modules:
            m.gyro = np.zeros(3)
        depth_m = measurements.fuse(modules, Q_WB).depth_m
        assert depth_m is not None
        return depth_m - P_WB[2]

    told = [hear(tick % 3) for tick in range(300)] + [hear(tick % 2) for tick in range(30)]
    assert told[:2] == pytest.approx(each[:2], abs=1e-9), "until each was heard once nothing tells them apart"
    assert told[3:] == pytest.approx([each.mean()] * 327, abs=1e-3)


@pytest.mark.parametrize("after", [0, 200])
def test_imu_that_fails_teaches_nothing_before_it_is_found(body: Body, after: int) -> None:
    """The IMU reads zeros until the sensor watch before this stage removes it: off by gravity, which is no bias."""
    measurements = Measurements(body, PERIOD)
    for _ in range(after):
        biased(measurements, (0, 1, 2), np.zeros(3))
    for _ in range(10):
        biased(measurements, (0, 1, 2), np.zeros(3), failed=0)
    wanted = BIASES[:, 3:6].mean(axis=0) if after else BIASES[[1, 2], 3:6].mean(axis=0)
    np.testing.assert_allclose(biased(measurements, (1, 2), np.zeros(3))[3:6], wanted, atol=1e-3)


def test_body_that_turns_tells_nothing_of_how_its_sensors_differ(body: Body) -> None:
    """The centripetal acceleration at each sensor's place is no bias."""
    measurements = Measurements(body, PERIOD)
    for _ in range(100):
        biased(measurements, (0, 1, 2), RATE)
    measurements.fuse(silent(), Q_WB)  # or the turn's sudden end would be measured
    told = biased(measurements, (1,), np.zeros(3))
    np.testing.assert_allclose(told[:6], BIASES[1][:6], atol=1e-3)
    assert told[6] == pytest.approx(BIASES[:, 6].mean(), abs=1e-3)  # depths do not feel the turn: the first tick at rest tells them apart


@pytest.mark.parametrize("heard", [(0,), (1,), (2,)])
def test_body_that_swings_at_once_takes_no_angular_acceleration_for_a_bias(body: Body, heard: tuple[int, ...]) -> None:
    """For as long as it turns so slowly that its sensors are compared with each other."""
    measurements, alpha = Measurements(body, PERIOD), 0.5 * ALPHA
    for k in range(6):
        turning(measurements, (0, 1, 2), alpha * k * PERIOD * 1e-9, alpha)
    measurements.fuse(silent(), Q_WB)  # or the turn's sudden end would be measured
    measured = turning(measurements, heard, np.zeros(3), np.zeros(3))
    assert measured.accel is not None
    np.testing.assert_allclose(measured.accel, PUSHED, atol=1e-3)


@pytest.mark.parametrize(("period_ns", "imu_every"), [(PERIOD, 1), (PERIOD // 2, 2), (PERIOD // 4, 4)])
def test_imus_that_are_slower_than_the_tick_are_told_apart_and_feel_the_turn(body: Body, period_ns: int, imu_every: int) -> None:
    """Regression: at 200 Hz with IMUs of 100 Hz nothing was learnt of how they differ, so that a pair that lost one swam off by 20 mm."""
    measurements = Measurements(body, period_ns)
    for tick in range(400):
        if tick % imu_every:
            measurements.fuse(silent(), Q_WB)
        else:
            biased(measurements, (0, 1, 2), np.zeros(3))
    told = biased(measurements, (1,), np.zeros(3))
    np.testing.assert_allclose(told[:6], BIASES[:, :6].mean(axis=0), atol=1e-3)
    measurements = Measurements(body, period_ns)
    for tick in range(100 * imu_every + 1):
        heard = () if tick % imu_every else (0,)
        measured = turning(measurements, heard, RATE + ALPHA * tick * period_ns * 1e-9, ALPHA)
    assert measured.accel is not None
    np.testing.assert_allclose(measured.accel, PUSHED, atol=1e-3)


@pytest.mark.parametrize(("period_ns", "gaps"), [(PERIOD // 2, (1, 3)), (PERIOD // 4, (3, 5))])
def test_imu_of_100_hz_that_comes_a_tick_early_and_a_tick_late_feels_the_turn(body: Body, period_ns: int, gaps: tuple[int, int]) -> None:
    """Regression: by its own clock, each reading that came late began the angular acceleration anew."""
    measurements, comes = Measurements(body, period_ns), set(np.cumsum(gaps * 100).tolist())
    for tick in range(max(comes) + 1):
        measured = turning(measurements, (0,) if tick in comes else (), RATE + ALPHA * tick * period_ns * 1e-9, ALPHA)
    assert measured.accel is not None
    np.testing.assert_allclose(measured.accel, PUSHED, atol=1e-3)


def test_depth_is_told_by_the_density_that_drags() -> None:
    cube = load_vehicle("modcube")
    lone = assemble([(0, 0, 0)], [0], [cube], [0])
    depth = Measurements(lone, PERIOD).fuse([ModuleInputs(pressure_pa=111_325.0)], Q_WB).depth_m
    drag = -drag_wrench(lone.drag.nodes, np.zeros(3), np.zeros(6), np.array([1.0, 0, 0, 0, 0, 0]))[0]
    assert depth is not None
    assert 10_000.0 / (9.80665 * depth) == pytest.approx(2.0 * drag / (cube.drag.cd_face * 0.21**2), rel=1e-9)


def test_nothing_heard_is_nothing_measured(measurements: Measurements) -> None:
    measured = measurements.fuse(silent(), Q_WB)
    assert measured.gyro is None and measured.accel is None and measured.depth_m is None
    assert measured.tags == []


def test_other_modules_of_the_fleet_are_not_listened_to() -> None:
    lone = Measurements(assemble([(0, 0, 0)], [0], [load_vehicle("modcube")], [1]), PERIOD)
    modules = silent()
    modules[0].gyro = modules[2].gyro = np.ones(3)
    assert lone.fuse(modules, Q_WB).gyro is None
    modules[1].gyro = np.array([0.1, 0.2, 0.3])
    fused = lone.fuse(modules, Q_WB).gyro
    assert fused is not None
    np.testing.assert_allclose(fused, [0.1, 0.2, 0.3])


def test_body_turns_agree_with_the_matrices_of_the_lattice(body: Body) -> None:
    for q_bm, rotation in zip(body.q_bm, ROTATIONS, strict=True):
        np.testing.assert_allclose(to_matrix(np.array(q_bm)), MATRICES[rotation], atol=1e-15)
