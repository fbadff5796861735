"""The tag camera of the plant: when it sees tags, what it reports, and its errors."""

import dataclasses
import math
from itertools import pairwise

import numpy as np
import pytest

from firmware_py.bus.codec import Codec
from firmware_py.core import rotations
from firmware_py.description.vehicle import Payload
from firmware_py.description.vehicle_file import load_vehicle
from hil.nodes import make_nodes
from hil.plant.camera import Camera, Sighting, placed
from hil.plant.sight import crosses
from hil.plant.spec import CALM, IDEAL, CameraPose, SensorSpec, Tank, WorldSpec
from hil.plant.world import Start, World
from hil.scenario import load_scenario, make_world

PERIOD_NS = 10_000_000
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
VEHICLE = load_vehicle("modcube")
TOP = (np.array(VEHICLE.tag[5].position_m), np.array(VEHICLE.tag[5].quaternion))
"""Place (3,), m, and attitude (4,) of the tag on the upper face, module frame."""
ABOVE = CameraPose()


def world_of(*starts: Start, seed: int = 0) -> World:
    return World(WorldSpec(**CALM), Tank(), [VEHICLE] * len(starts), list(starts), seed, PERIOD_NS)


def at(x: float, y: float, z: float, q: np.ndarray = LEVEL) -> Start:
    return Start(np.array([x, y, z]), q)


def camera(
    modules: int = 1, tags: tuple[int, ...] = (5,), seed: int = 0, pose: CameraPose = ABOVE, **changes: float
) -> Camera:
    return Camera(pose, SensorSpec(**{**IDEAL, **changes}), [VEHICLE] * modules, tags, seed)


def look(world: World, eye: Camera) -> list[Sighting]:
    return eye.watch(world)


def pictures(eye: Camera, seconds: float, start: Start | None = None) -> list[Sighting]:
    """Sightings of one module that is held still while the world's time goes on."""
    world = world_of(start or at(0.0, 0.0, 0.4))
    found = []
    for _ in range(round(seconds * 100)):
        found += eye.watch(world)
        world.time_ns += PERIOD_NS
    return found


def test_camera_sees_the_top_tag_where_it_is() -> None:
    (seen,) = look(world_of(at(0.1, -0.2, 0.4, rotations.from_euler(0.1, -0.2, 2.0))), camera())
    p, q = placed(np.array([0.1, -0.2, 0.4]), rotations.from_euler(0.1, -0.2, 2.0), *TOP)
    assert seen.tag_id == 5 and seen.capture_ns == 0
    np.testing.assert_allclose(seen.p_wt, p, atol=1e-12)
    np.testing.assert_allclose(np.abs(seen.q_wt @ q), 1.0)


def test_level_module_shows_its_top_tag_face_up() -> None:
    (seen,) = look(world_of(at(0.0, 0.0, 0.4)), camera())
    np.testing.assert_allclose(seen.p_wt, [0.0, 0.0, 0.4 - 0.105])
    np.testing.assert_allclose(rotations.to_matrix(seen.q_wt)[:, 2], [0.0, 0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize(("tilt_deg", "seen"), [(60.0, True), (64.0, True), (67.0, False), (120.0, False)])
def test_tag_is_read_up_to_65_degrees_of_incidence(tilt_deg: float, seen: bool) -> None:
    q = rotations.from_euler(math.radians(tilt_deg), 0.0, 0.0)
    lever = rotations.rotate(q, np.array([0.0, 0.0, -0.105]))
    # the tag itself is right below the camera, so the tilt is the angle of incidence
    world = world_of(Start(np.array([0.0, 0.0, 0.4]) - lever, q))
    assert bool(look(world, camera())) == seen


def test_camera_picks_the_tag_that_faces_it_most() -> None:
    world = world_of(at(0.0, 0.0, 0.4, rotations.from_euler(math.radians(80.0), 0.0, 0.0)))
    (seen,) = look(world, camera(tags=(0, 1, 2, 3, 4, 5)))
    assert VEHICLE.tag[seen.tag_id].id == 3, "rolled to the right, the left face looks up"


def test_tag_outside_the_field_of_view_is_not_seen() -> None:
    narrow = CameraPose(half_view_deg=10.0)
    assert not look(world_of(at(0.4, 0.0, 0.4)), camera(pose=narrow))
    assert look(world_of(at(0.2, 0.0, 0.4)), camera(pose=narrow))


def test_module_above_hides_the_one_below() -> None:
    apart = world_of(at(-0.3, 0.0, 0.2), at(0.3, 0.0, 0.6))
    assert [s.module for s in look(apart, camera(2))] == [0, 1]
    stacked = world_of(at(0.0, 0.0, 0.2), at(0.0, 0.0, 0.6))
    assert [s.module for s in look(stacked, camera(2))] == [0]
    docked = world_of(at(0.0, 0.0, 0.3), at(0.0, 0.0, 0.51))
    assert [s.module for s in look(docked, camera(2))] == [0]


def test_payload_hides_the_tag_behind_it_and_its_own_hull_does_not() -> None:
    lid = Payload(name="lid", dry_kg=0.1, size_m=np.array([0.3, 0.3, 0.02]), position_m=np.array([0.0, 0.0, -0.2]))
    for payload, seen in (((), 1), ((lid,), 0), ((dataclasses.replace(lid, position_m=np.array([0.0, 0.4, -0.2])),), 1)):
        laden = dataclasses.replace(VEHICLE, payload=payload)
        world = World(WorldSpec(**CALM), Tank(), [laden], [at(0.0, 0.0, 0.4)], 0, PERIOD_NS)
        assert len(look(world, Camera(ABOVE, SensorSpec(**IDEAL), [laden], (5,), 0))) == seen


def test_segment_and_box() -> None:
    box = np.array([[0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0]])
    turned = np.concatenate([np.zeros(3), rotations.from_euler(0.0, 0.0, math.pi / 2)])[None, :]
    level = np.concatenate([np.zeros(3), LEVEL])[None, :]
    a, b = (-5.0, 1.5, 0.0), (5.0, 1.5, 0.0)
    assert not crosses(a, b, box, 0, turned), "turned by 90 degrees its y half edge is 1"
    assert crosses(a, b, box, 0, level)
    assert not crosses(a, (-2.0, 1.5, 0.0), box, 0, level)


def test_pictures_come_at_60_hz_with_a_phase_per_seed() -> None:
    seen = pictures(camera(tag_phase=1.0), 10.0)
    assert len(seen) == pytest.approx(600, abs=1)
    assert {b.capture_ns - a.capture_ns for a, b in pairwise(seen)} == {16_666_667}
    assert seen[0].capture_ns != pictures(camera(tag_phase=1.0, seed=1), 1.0)[0].capture_ns


def test_noise_is_larger_along_the_camera_axis() -> None:
    slanted = CameraPose(position_m=np.array([0.0, -0.8, -0.8]), axis=np.array([0.0, math.sqrt(0.5), math.sqrt(0.5)]))
    seen = pictures(camera(pose=slanted, tag_sigma_m=0.002, tag_sigma_axis_m=0.004), 60.0)
    error = np.array([s.p_wt for s in seen]) - [0.0, 0.0, 0.4 - 0.105]
    across = np.array([0.0, math.sqrt(0.5), -math.sqrt(0.5)])
    assert (error @ slanted.axis).std() == pytest.approx(0.004, rel=0.06)
    assert (error @ across).std() == pytest.approx(0.002, rel=0.06)
    assert error[:, 0].std() == pytest.approx(0.002, rel=0.06)


def test_attitude_noise_is_half_a_degree_about_each_axis() -> None:
    seen = pictures(camera(tag_sigma_deg=0.5), 60.0)
    errors = np.array([rotations.log(s.q_wt) for s in seen])
    np.testing.assert_allclose(np.degrees(errors.std(axis=0)), 0.5, rtol=0.06)


def test_two_percent_of_the_pictures_are_lost() -> None:
    assert len(pictures(camera(tag_dropped=0.02), 100.0)) / 6000 == pytest.approx(0.98, abs=0.006)


def test_flipped_pose_looks_the_same_from_the_camera() -> None:
    """The ambiguous second pose of a planar tag: from far away its corners appear in the same places, with mirrored depths."""
    start = at(0.2, 0.1, 0.4, rotations.from_euler(0.4, -0.3, 0.7))
    (true,), (flipped,) = look(world_of(start), camera()), look(world_of(start), camera(tag_flipped=1.0))
    np.testing.assert_allclose(flipped.p_wt, true.p_wt)
    sight = ABOVE.position_m - true.p_wt
    sight /= np.linalg.norm(sight)
    corners = 0.05 * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
    a, b = corners @ rotations.to_matrix(true.q_wt).T, corners @ rotations.to_matrix(flipped.q_wt).T
    np.testing.assert_allclose(b @ sight, -(a @ sight), atol=1e-12)
    np.testing.assert_allclose(b - np.outer(b @ sight, sight), a - np.outer(a @ sight, sight), atol=1e-12)
    assert abs(true.q_wt @ flipped.q_wt) < 0.99


def test_half_a_percent_of_the_poses_are_flipped() -> None:
    start = at(0.0, 0.0, 0.4, rotations.from_euler(0.5, 0.0, 0.0))
    seen = pictures(camera(tag_flipped=0.005), 100.0, start)
    flipped = [s for s in seen if abs(s.q_wt @ seen[0].q_wt) < 0.99]
    assert len(flipped) / len(seen) == pytest.approx(0.005, abs=0.003)


def test_moving_module_is_seen_where_it_was_at_the_picture() -> None:
    world, eye = world_of(at(-0.3, 0.0, 0.4)), camera(tag_phase=1.0)
    fine = world_of(at(-0.3, 0.0, 0.4))
    for each in (world, fine):
        each.set_motion(0, [0.3, 0.1, 0.0], [0.0, 0.0, 0.8])
    eye.watch(world)
    seen = []
    for _ in range(20):
        world.advance(PERIOD_NS)
        seen += eye.watch(world)
    assert len(seen) >= 11
    for sighting in seen:
        while fine.time_ns < sighting.capture_ns - 1_250_000:
            fine.advance(2_500_000)
        truth = fine.truth(0)
        late_s = 1e-9 * (sighting.capture_ns - truth.time_ns)
        q = rotations.multiply(truth.q_wm, rotations.exp(truth.w_b * late_s))
        p, _ = placed(truth.p_wm + truth.v_w * late_s, q, *TOP)
        np.testing.assert_allclose(sighting.p_wt, p, atol=2e-6)
        assert np.linalg.norm(rotations.difference(sighting.q_wt, q)) < 1e-5


def test_losing_pictures_changes_no_other_draw() -> None:
    clean = {s.capture_ns: s.p_wt for s in pictures(camera(tag_sigma_m=0.002), 10.0)}
    lossy = pictures(camera(tag_sigma_m=0.002, tag_dropped=0.3), 10.0)
    assert 0 < len(lossy) < len(clean)
    for sighting in lossy:
        np.testing.assert_array_equal(sighting.p_wt, clean[sighting.capture_ns])


def test_order_in_which_cameras_are_listed_changes_no_picture() -> None:
    scenario = load_scenario("hover")
    carried = dataclasses.replace(scenario.camera[0], module=1)
    due = []
    for cameras in ((scenario.camera[0], carried), (carried, scenario.camera[0])):
        listed = dataclasses.replace(scenario, camera=cameras)
        nodes = make_nodes(make_world(listed, 3, 10_000_000), Codec.load(), listed)
        due.append([(camera.carrier, camera.next_ns) for camera in nodes.cameras[0]._cameras])
    assert due[0] == due[1]
    assert due[0][0][1] == due[0][1][1]
