"""Sensors of several modules, each turned and displaced in its body, become one measurement of the body."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.core.body import Body
from firmware_py.core.measurements import Measurements
from firmware_py.core.rotations import difference, exp, from_euler, multiply, to_matrix
from firmware_py.core.types import BodyPose, ModuleInputs, TagObservation
from firmware_py.description.vehicle import load_vehicle
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
"""Equal modules: their common centre of mass is the mean."""


@pytest.fixture(scope="module")
def body() -> Body:
    """An L of three whose modules all sit differently, and are counted differently in the fleet."""
    return assemble(CELLS, ROTATIONS, [load_vehicle("modcube")] * 3, FLEET_INDEX)


@pytest.fixture(scope="module")
def measurements(body: Body) -> Measurements:
    return Measurements(body)


def silent() -> list[ModuleInputs]:
    return [ModuleInputs() for _ in range(3)]


def tag_seen(module: int, face: int, capture_ns: int = CAPTURE, turn: np.ndarray | None = None) -> TagObservation:
    """What a perfect camera says of the tag on `face` of module `module`, from the vehicle file alone."""
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
    """A planar tag's pose has a second solution, tens of degrees off; the other tags of the picture outvote it."""
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


def test_tag_that_the_vehicle_does_not_carry_is_not_believed(measurements: Measurements) -> None:
    stranger = tag_seen(0, 5)._replace(tag_id=14)
    assert fuse_tags(measurements, (0, stranger)) == []


def test_lever_of_the_wrong_module_would_be_noticed(measurements: Measurements) -> None:
    """The same frames under another module's number put the body elsewhere: the tests above do look at the lever."""
    (pose,) = fuse_tags(measurements, (2, tag_seen(1, 5)))
    assert np.linalg.norm(pose.p_wt - R_WB.apply(pose.lever_b) - P_WB) > 0.1


# ---------------------------------------------------------------- inertial sensors and depth


def in_module(module: int, vector_b: np.ndarray) -> np.ndarray:
    return MATRICES[ROTATIONS[module]].T @ vector_b


@pytest.mark.parametrize("heard", [(0,), (1,), (2,), (0, 2), (0, 1, 2)])
def test_rates_are_turned_into_the_body_and_averaged_over_those_heard(
    measurements: Measurements, heard: tuple[int, ...]
) -> None:
    rate, force = np.array([0.1, -0.4, 0.9]), np.array([1.0, 2.0, -9.0])
    modules = silent()
    spread = np.linspace(-0.01, 0.01, len(heard)) if len(heard) > 1 else [0.0]
    for module, offset in zip(heard, spread, strict=True):
        modules[FLEET_INDEX[module]].gyro = in_module(module, rate + offset)
        modules[FLEET_INDEX[module]].accel = in_module(module, force + offset)
    measured = measurements.fuse(modules, Q_WB)
    assert measured.gyro is not None and measured.accel is not None
    np.testing.assert_allclose(measured.gyro, rate, atol=1e-14)
    np.testing.assert_allclose(measured.accel, force, atol=1e-14)


@pytest.mark.parametrize("heard", [(0,), (1,), (2,), (1, 2), (0, 1, 2)])
def test_depth_is_that_of_the_centre_of_mass_in_any_attitude(
    measurements: Measurements, heard: tuple[int, ...]
) -> None:
    modules = silent()
    for module in heard:
        z = (P_WB + R_WB.apply(ORIGINS_B[module]))[2]
        modules[FLEET_INDEX[module]].pressure_pa = 101_325.0 + 1000.0 * 9.80665 * z
    depth = measurements.fuse(modules, Q_WB).depth_m
    assert depth == pytest.approx(P_WB[2], abs=1e-9)


def test_nothing_heard_is_nothing_measured(measurements: Measurements) -> None:
    measured = measurements.fuse(silent(), Q_WB)
    assert measured.gyro is None and measured.accel is None and measured.depth_m is None
    assert measured.tags == []


def test_other_modules_of_the_fleet_are_not_listened_to() -> None:
    lone = Measurements(assemble([(0, 0, 0)], [0], [load_vehicle("modcube")], [1]))
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
