"""Joining and parting of bodies: momentum, poses and disturbance are preserved, and parting undoes joining."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.core.body import Body
from firmware_py.core.propagation import ERRORS, STATES
from firmware_py.core.topology import Motion, join, part_of
from firmware_py.core.types import DockRequest
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import PITCH_M, assemble
from firmware_py.prepare.docking import plan_dock, plan_undock

VEHICLES = [load_vehicle("modcube")] * 3


def rotation(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.asarray(q)[[1, 2, 3, 0]])


def momentum(body: Body, x: np.ndarray, about: np.ndarray) -> np.ndarray:
    """(6,) linear and angular momentum in the world, about a point."""
    r = rotation(x[3:7])
    body_momentum = body.mass @ x[7:13]
    linear = r.apply(body_momentum[:3])
    return np.r_[linear, r.apply(body_momentum[3:]) + np.cross(x[:3] - about, linear)]


def module_pose(body: Body, x: np.ndarray, module: int) -> tuple[np.ndarray, Rotation]:
    i = body.modules.index(module)
    return x[:3] + rotation(x[3:7]).apply(body.r_bm[i]), rotation(x[3:7]) * rotation(body.q_bm[i])


@pytest.fixture
def two() -> tuple[Body, Body, Body, np.ndarray, np.ndarray]:
    """A target, an active body against its +x face, the merged body, and the states of target and active body."""
    target, active = (assemble([(0, 0, 0)], [0], [VEHICLES[0]], [m]) for m in (0, 1))
    plan = plan_dock(DockRequest(1, 1, 0, 0, quarter_turns=1), active, target, VEHICLES)
    rng = np.random.default_rng(3)
    x_t, x_a = np.zeros(STATES), np.zeros(STATES)
    q_t = Rotation.from_rotvec(rng.normal(size=3))
    x_t[3:7] = q_t.as_quat()[[3, 0, 1, 2]]
    x_t[:3] = rng.normal(size=3)
    q_a = q_t * rotation(plan.q_ta)
    x_a[3:7] = q_a.as_quat()[[3, 0, 1, 2]]
    x_a[:3] = x_t[:3] + q_t.apply(plan.place_t)
    x_t[7:13], x_a[7:13] = rng.normal(size=6), rng.normal(size=6)
    x_t[19:25], x_a[19:25] = rng.normal(size=6), rng.normal(size=6)
    x_t[26:29], x_a[26:29] = rng.normal(size=3), rng.normal(size=3)
    return target, active, plan.merged, x_t, x_a


def test_bodies_that_dock_keep_their_momentum(two: tuple[Body, Body, Body, np.ndarray, np.ndarray]) -> None:
    target, active, merged, x_t, x_a = two
    covariance = np.eye(ERRORS)
    joined = join([(target, Motion(x_t, covariance, 10, 0)), (active, Motion(x_a, covariance, 10, 0))], merged)
    about = np.array([0.3, -1.0, 2.0])
    before = momentum(target, x_t, about) + momentum(active, x_a, about)
    np.testing.assert_allclose(momentum(merged, joined.x, about), before, atol=1e-9)


def test_docked_modules_are_where_they_were(two: tuple[Body, Body, Body, np.ndarray, np.ndarray]) -> None:
    target, active, merged, x_t, x_a = two
    covariance = np.eye(ERRORS)
    joined = join([(target, Motion(x_t, covariance, 10, 0)), (active, Motion(x_a, covariance, 10, 0))], merged)
    for body, x, module in ((target, x_t, 0), (active, x_a, 1)):
        p, q = module_pose(body, x, module)
        p_new, q_new = module_pose(merged, joined.x, module)
        np.testing.assert_allclose(p_new, p, atol=1e-9)
        assert (q_new * q.inv()).magnitude() < 1e-9


def test_disturbance_of_a_joined_body_is_the_sum(two: tuple[Body, Body, Body, np.ndarray, np.ndarray]) -> None:
    target, active, merged, x_t, x_a = two
    covariance = np.eye(ERRORS)
    joined = join([(target, Motion(x_t, covariance, 10, 0)), (active, Motion(x_a, covariance, 10, 0))], merged)
    np.testing.assert_allclose(joined.x[19:22], x_t[19:22] + x_a[19:22])
    moment_w, up = np.zeros(3), np.array([0.0, 0.0, -1.0])
    for x in (x_t, x_a):
        moment_w += rotation(x[3:7]).apply(x[22:25]) + np.cross(x[:3] - joined.x[:3], x[19:22])
        moment_w += np.cross(rotation(x[3:7]).apply(x[26:29]), up)
    at = rotation(joined.x[3:7])
    np.testing.assert_allclose(at.apply(joined.x[22:25]) + np.cross(at.apply(joined.x[26:29]), up), moment_w, atol=1e-9)


def test_righting_moment_of_a_joined_body_is_the_sum_at_every_attitude(two: tuple[Body, Body, Body, np.ndarray, np.ndarray]) -> None:
    target, active, merged, x_t, x_a = two
    joined = join([(target, Motion(x_t, np.eye(ERRORS), 10, 0)), (active, Motion(x_a, np.eye(ERRORS), 10, 0))], merged)
    vectors_w = [rotation(x[3:7]).apply(body.righting + x[26:29]) for body, x in ((target, x_t), (active, x_a))]
    vectors_w += [-x[21] * (x[:3] - joined.x[:3]) for x in (x_t, x_a)]  # vertical forces off the centre of mass
    np.testing.assert_allclose(rotation(joined.x[3:7]).apply(merged.righting + joined.x[26:29]), sum(vectors_w), atol=1e-9)


def test_moment_that_acts_is_known_after_a_dock_as_well_as_before(two: tuple[Body, Body, Body, np.ndarray, np.ndarray]) -> None:
    """The acting moment alone, scaled by inertia: how it divides into disturbance and righting is unknown after the dock."""
    target, active, merged, x_t, x_a = two
    x_t[3:7], x_a[3:7] = [1.0, 0.0, 0.0, 0.0], merged.q_bm[1]  # level: the righting moment acts about x and y
    acts = np.hstack([np.eye(3), [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    half = np.random.default_rng(1).normal(size=(6, 6))
    half[:3] = half[:3] * 1e-3 - acts[:, 3:] @ half[3:]  # the sum is known a thousand times better than either part
    at, covariance = np.r_[21:24, 25:28], np.eye(ERRORS)
    covariance[np.ix_(at, at)] = half @ half.T
    joined = join([(target, Motion(x_t, covariance, 10, 0)), (active, Motion(x_a, covariance, 10, 0))], merged)
    before, after = (acts @ c[np.ix_(at, at)] @ acts.T for c in (covariance, joined.covariance))
    grown = np.trace(merged.mass[3:, 3:]) / np.trace(target.mass[3:, 3:])
    np.testing.assert_allclose(after.diagonal(), before.diagonal() * grown**2)
    np.testing.assert_allclose(joined.covariance.diagonal()[25:], merged.righting_sigma**2)
    assert np.linalg.eigvalsh(joined.covariance).min() > 0.0


def test_parting_undoes_joining_when_nothing_turns_apart(two: tuple[Body, Body, Body, np.ndarray, np.ndarray]) -> None:
    target, active, merged, x_t, x_a = two
    covariance = np.eye(ERRORS)
    joined = join([(target, Motion(x_t, covariance, 10, 0)), (active, Motion(x_a, covariance, 10, 0))], merged)
    plan = plan_undock(DockRequest(1, 1, 0, 0), merged, VEHICLES)
    stays, leaves = (part_of(merged, joined, b) for b in (plan.stays, plan.leaves))
    about = np.zeros(3)
    after = momentum(plan.stays, stays.x, about) + momentum(plan.leaves, leaves.x, about)
    np.testing.assert_allclose(after, momentum(merged, joined.x, about), atol=1e-9)
    np.testing.assert_allclose(stays.x[:3], x_t[:3], atol=1e-9)
    p, q = module_pose(plan.leaves, leaves.x, 1)
    p_old, q_old = module_pose(active, x_a, 1)
    np.testing.assert_allclose(p, p_old, atol=1e-9)
    assert (q * q_old.inv()).magnitude() < 1e-9


def test_third_module_docks_to_a_pair_in_an_l() -> None:
    pair = assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [VEHICLES[0]] * 2, [0, 1])
    third = assemble([(0, 0, 0)], [0], [VEHICLES[0]], [2])
    plan = plan_dock(DockRequest(2, 3, 0, 2), third, pair, VEHICLES)
    assert plan.merged.modules == (0, 1, 2)
    assert plan.merged.cells.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def test_dock_that_closes_a_ring_closes_every_joint_of_it() -> None:
    pairs = [assemble([(0, 0, 0), (1, 0, 0)], [0, 0], VEHICLES[:1] * 2, modules) for modules in ([0, 1], [2, 3])]
    plan = plan_dock(DockRequest(2, 3, 0, 2), pairs[1], pairs[0], VEHICLES[:1] * 4)
    assert [{(joint.module, joint.face), (joint.target_module, joint.target_face)} for joint in plan.closes] == [
        {(2, 3), (0, 2)}, {(3, 3), (1, 2)}
    ]


def test_two_drogues_are_not_docked_though_others_beside_them_would_be() -> None:
    target, active = (assemble([(0, 0, 0), (0, 1, 0)], [0, turn], VEHICLES[:2], modules) for turn, modules in ((0, [0, 1]), (2, [2, 3])))
    why = r"^module 3 cannot dock to module 1: -x is a drogue and -x a drogue; a probe docks to a drogue$"
    with pytest.raises(DescriptionError, match=why):
        plan_dock(DockRequest(2, 1, 0, 1), active, target, VEHICLES[:1] * 4)


def lattice(cells: list[tuple[int, ...]]) -> Body:
    return assemble(cells, [0] * len(cells), [VEHICLES[0]] * len(cells))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cells", "leaves", "way"),
    [
        ([(x, y) for x in range(2) for y in range(2)], (1, 1), [0.5**0.5, 0.5**0.5, 0]),  # corner: diagonally
        ([(x, y) for x in range(4) for y in range(3) if (x, y) not in ((1, 1), (2, 1))], (1, 0), [0, -1, 0]),  # between two of a ring
        ([(x, y) for x in range(3) for y in range(3)], (1, 1), [0, 0, 1]),  # middle of a plate: out of its plane
        ([(1, 1), (0, 1), (0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (3, 2), (2, 2)], (1, 1), [0, 1, 0]),  # corner, (2, 2) blocks the diagonal
    ],
)
def test_module_leaves_a_lattice_by_a_way_that_no_neighbour_closes(
    cells: list[tuple[int, int]], leaves: tuple[int, int], way: list[float]
) -> None:
    body = lattice([(*cell, 0) for cell in cells])
    module = cells.index(leaves)
    neighbour = next(i for i, cell in enumerate(cells) if abs(cell[0] - leaves[0]) + abs(cell[1] - leaves[1]) == 1)
    found = plan_undock(DockRequest(module, 0, neighbour, 0), body, VEHICLES[:1] * len(cells))
    assert found.leaves.modules == (module,)
    np.testing.assert_allclose(np.abs(found.axis_b) if way[2] else found.axis_b, way, atol=1e-12)


@pytest.mark.slow
def test_module_that_its_neighbours_enclose_is_not_undocked() -> None:
    cells = [(x, y, z) for x in range(3) for y in range(3) for z in range(3)]
    with pytest.raises(DescriptionError, match=r"^module 14 cannot leave, enclosed by module 5, 11, 13, 15, 17, 23: undock one"):
        plan_undock(DockRequest(13, 0, 4, 0), lattice(cells), VEHICLES[:1] * 27)


def test_biases_of_a_joined_body_are_the_mean_of_both_and_stay_with_their_modules_when_they_part(
    two: tuple[Body, Body, Body, np.ndarray, np.ndarray],
) -> None:
    """The active module is turned a quarter against the target, so its axes differ from the body's."""
    target, active, merged, x_t, x_a = two
    rng = np.random.default_rng(4)
    x_t[13:19], x_a[13:19], x_t[25], x_a[25] = rng.normal(size=6), rng.normal(size=6), 0.1, 0.3
    joined = join([(target, Motion(x_t, np.eye(ERRORS), 10, 0)), (active, Motion(x_a, np.eye(ERRORS), 10, 0))], merged)
    for rows in (slice(13, 16), slice(16, 19)):
        turned = [rotation(merged.q_bm[i]).apply(x[rows]) for i, x in enumerate((x_t, x_a))]
        np.testing.assert_allclose(joined.x[rows], np.mean(turned, axis=0), atol=1e-9)
        for i, body in enumerate((target, active)):
            parted = part_of(merged, joined, body)
            np.testing.assert_allclose(parted.x[rows], rotation(merged.q_bm[i]).inv().apply(joined.x[rows]), atol=1e-9)
            grown = (parted.covariance - joined.covariance).diagonal()
            np.testing.assert_allclose(grown[[12, 15, 24]], [0.005**2 / 2, 0.05**2 / 2, 0.02**2 / 2], err_msg="it knew the mean")
    assert joined.x[25] == pytest.approx(0.2)


def test_sensors_of_a_joined_body_are_off_by_the_mean_of_its_modules_and_not_of_its_parts() -> None:
    pair = assemble([(0, 0, 0), (1, 0, 0)], [0, 0], [VEHICLES[0]] * 2, [0, 1])
    third = assemble([(0, 0, 0)], [0], [VEHICLES[0]], [2])
    merged = plan_dock(DockRequest(2, 3, 0, 2), third, pair, VEHICLES).merged
    of_pair, of_third = np.eye(2, STATES, 3)[0], np.eye(2, STATES, 3)[0]
    of_pair[13:19], of_third[13:19], of_pair[25], of_third[25] = 0.3, 0.6, 0.03, 0.06
    joined = join([(pair, Motion(of_pair, np.eye(ERRORS), 10, 0)), (third, Motion(of_third, np.eye(ERRORS), 10, 0))], merged)
    np.testing.assert_allclose([*joined.x[13:19], joined.x[25]], [*[0.4] * 6, 0.04])


def test_righting_of_a_pair_goes_to_its_halves_as_far_as_it_is_theirs(two: tuple[Body, Body, Body, np.ndarray, np.ndarray]) -> None:
    """Along the line between them half of it counts as the lever of their lifts, which neither has alone."""
    target, active, merged, x_t, x_a = two
    joined = join([(target, Motion(x_t, np.eye(ERRORS), 10, 0)), (active, Motion(x_a, np.eye(ERRORS), 10, 0))], merged)
    shares = []
    for i, body in enumerate((target, active)):
        parted = part_of(merged, joined, body)
        at = rotation(merged.q_bm[i])
        shares.append(at.apply(parted.x[26:29]) / joined.x[26:29])
        np.testing.assert_allclose(shares[-1], np.square(at.apply(body.righting_sigma) / merged.righting_sigma))
        for x in (joined.x, parted.x):
            np.testing.assert_allclose(x[29:], rotation(x[3:7]).inv().apply([0.0, 0.0, 1.0]), atol=1e-12)
    np.testing.assert_allclose(sum(shares), [0.5, 1.0, 1.0], atol=0.02)


def test_righting_does_not_grow_with_docks_and_undocks() -> None:
    """Of two level modules one lifts and one sinks, by half a newton each. Regression: every dock added a tenth of its lever to both."""
    active, target = (assemble([(0, 0, 0)], [0], VEHICLES[:1], [module]) for module in (1, 0))
    merged = plan_dock(DockRequest(1, 1, 0, 0), active, target, VEHICLES[:1] * 2).merged
    parted = plan_undock(DockRequest(1, 1, 0, 0), merged, VEHICLES[:1] * 2)
    states = [np.zeros(STATES), np.zeros(STATES)]
    for _ in range(50):
        for i, x in enumerate(states):
            x[3:7], x[21] = [1.0, 0.0, 0.0, 0.0], (0.5, -0.5)[i]  # which each has learnt before the next dock
        bodies = (parted.stays, parted.leaves)
        joined = join([(body, Motion(x, np.eye(ERRORS), 10, 0)) for body, x in zip(bodies, states, strict=True)], merged)
        states = [part_of(merged, joined, body).x for body in bodies]
    assert np.linalg.norm(joined.x[26:29]) < 2.0 * 0.5 * PITCH_M  # twice the lever of their lifts


def test_joined_body_is_known_no_better_than_the_worse_of_both(two: tuple[Body, Body, Body, np.ndarray, np.ndarray]) -> None:
    target, active, merged, x_t, x_a = two
    sure, unsure = Motion(x_t, np.eye(ERRORS), 500, 9_000), Motion(x_a, np.eye(ERRORS), 3, 1_000)
    joined = join([(target, sure), (active, unsure)], merged)
    assert (joined.accepted, joined.tag_ns) == (3, 1_000)
    assert np.all(joined.covariance.diagonal()[:12] > 1.0)


@pytest.mark.parametrize("column", [3, 6, 9, 12, 15])
def test_what_is_unsure_along_an_axis_stays_so_in_a_body_with_other_axes(
    column: int, two: tuple[Body, Body, Body, np.ndarray, np.ndarray]
) -> None:
    """Attitude, velocity, rate, biases of gyro and accelerometer. A quarter turn about x took the active module's y to the target's z."""
    _, active, merged, x_t, _ = two
    sigma = np.full(ERRORS, 1e-3)
    sigma[column + 2] = 2.0
    parted = part_of(merged, Motion(x_t, np.diag(sigma**2), 10, 0), active)
    unsure = rotation(merged.q_bm[1]).inv().apply([0.0, 0.0, 1.0])
    assert np.argmax(np.abs(unsure)) == 1
    np.testing.assert_allclose(np.sqrt(parted.covariance.diagonal()[column : column + 3]), 2.0 * np.abs(unsure), atol=0.2)


def test_acting_moment_is_unsure_about_the_same_axis_of_a_body_with_other_axes(
    two: tuple[Body, Body, Body, np.ndarray, np.ndarray]
) -> None:
    _, active, merged, x_t, _ = two
    sigma = np.full(ERRORS, 1e-6)
    sigma[23] = 1.0
    parted = part_of(merged, Motion(x_t, np.diag(sigma**2), 10, 0), active)
    down = rotation(parted.x[3:7]).inv().apply([0.0, 0.0, 1.0])
    acts = np.hstack([np.eye(3), np.cross(np.eye(3), down)])
    acting = acts @ parted.covariance[np.ix_(np.r_[21:24, 25:28], np.r_[21:24, 25:28])] @ acts.T
    assert np.argmax(acting.diagonal()) == 1 and acting[2, 2] < 1e-6
