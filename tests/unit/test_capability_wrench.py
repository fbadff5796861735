"""Reachable wrenches against ERRATA's independently computed figures, and facets against linear programs."""

import dataclasses
import itertools

import characterise_surfaces as surfaces
import numpy as np
import pytest

from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import AXES
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.capability import summary
from firmware_py.prepare.capability.ellipsoid import largest_inscribed
from firmware_py.prepare.capability.layout import FRAMES, Layout, of_modules, of_rows, of_vehicle
from firmware_py.prepare.capability.polycubes import polycubes, poses
from firmware_py.prepare.capability.programs import ProgramSpace, reach_by_programs
from firmware_py.prepare.capability.sphere import fibonacci
from firmware_py.prepare.capability.wrench import Section, WrenchSpace, corners_of, embed
from tests.unit.capability_layouts import SEVEN, one_of_seven, raw, without


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("A_single", [2.0, 1.4142, 1.4142, 0.2335, 0.1715, 0.1187]),
        ("A45_single", [2.0012, 1.4142, 1.4142, 0.1714, 0.14, 0.07]),
    ],
)
def test_paper_module_has_the_known_singular_values(name: str, values: list[float]) -> None:
    # Tolerance: the published rows have directions of length 0.99998, ours have length 1.
    assert np.linalg.svd(raw(name).matrix, compute_uv=False) == pytest.approx(values, abs=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "force", "torque"),
    [("A_single", 67.02, 0.1546), ("B_double_line", 536.2, 2.683), ("C_quad_2x2", 4289.0, 27.88)],
)
def test_authors_robots_have_the_known_inscribed_ellipsoids(name: str, force: float, torque: float) -> None:
    for frame, volume in (("force", force), ("torque", torque)):
        section = WrenchSpace(raw(name).normalised("unit_thrust")).section(frame)
        assert section is not None
        assert largest_inscribed(section.normals, section.offsets).volume == pytest.approx(volume, rel=4e-4)


@pytest.mark.slow
def test_volume_of_the_force_frame_grows_with_the_cube_of_the_modules() -> None:
    volumes = []
    for name in ("A_single", "B_double_line", "C_quad_2x2"):
        section = WrenchSpace(raw(name).normalised("unit_thrust")).section("force")
        assert section is not None
        volumes.append(largest_inscribed(section.normals, section.offsets).volume)
    assert np.array(volumes) / volumes[0] == pytest.approx([1.0, 8.0, 64.0], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", SEVEN)
def test_linear_programs_and_facets_agree_for_each_of_the_seven_robots(name: str) -> None:
    layout = one_of_seven(name)
    for part in (layout, layout.with_passive_declared()):
        space = WrenchSpace(part)
        for frame in FRAMES:
            wrenches = embed(fibonacci(150), FRAMES[frame])
            assert reach_by_programs(part, wrenches) == pytest.approx(space.reach(wrenches), rel=1e-6, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_linear_programs_and_facets_agree_for_random_polycubes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 5))
    shapes = polycubes(count)
    lying = poses(shapes[int(rng.integers(len(shapes)))])
    vehicle = load_vehicle(("modcube", "modcube_sim")[int(rng.integers(2))])
    layout = of_modules(lying[int(rng.integers(len(lying)))], [0] * count, [vehicle] * count)
    wrenches = rng.standard_normal((20, 6)) * [1.0, 1.0, 1.0, 0.1, 0.1, 0.1]
    assert reach_by_programs(layout, wrenches) == pytest.approx(WrenchSpace(layout).reach(wrenches), rel=1e-6)


@pytest.mark.parametrize("name", ["modcube_sim", "double", "chasing_m2", "bluerov2_heavy"])
def test_facets_found_one_by_one_with_programs_are_the_zonotopes(name: str) -> None:
    layout = one_of_seven(name)
    for frame in FRAMES:
        exact, found = WrenchSpace(layout).section(frame), ProgramSpace(layout).section(frame)
        assert exact is not None and found is not None
        assert len(found.offsets) == len(exact.offsets)
        assert found.reach(fibonacci(200)) == pytest.approx(exact.reach(fibonacci(200)), rel=1e-9)


def test_paper_module_pushes_as_hard_as_known_in_the_worst_direction() -> None:
    """ERRATA: 1.78 / 3.17 / 1.58 N m about the axes, 1.26 in the worst direction."""
    space = WrenchSpace(of_vehicle(load_vehicle("modcube")))
    about = np.minimum(space.reach(np.eye(6)), space.reach(-np.eye(6)))
    assert about[3:] == pytest.approx([1.78, 3.17, 1.58], abs=5e-3)
    assert space.worst("torque") == pytest.approx(1.26, abs=1e-9)
    assert space.worst("force") == pytest.approx(22.77, abs=0.01)


def test_worst_direction_is_attained() -> None:
    layout = of_vehicle(load_vehicle("modcube"))
    section = WrenchSpace(layout).section("force")
    assert section is not None
    direction = section.normals[np.argmin(section.offsets)]
    assert reach_by_programs(layout, embed(direction[None], (0, 1, 2))) == pytest.approx(section.worst())


def test_any_one_dead_thruster_leaves_the_paper_module_six_degrees_of_freedom() -> None:
    layout = of_vehicle(load_vehicle("modcube"))
    assert all(without(layout, [k]).rank == 6 for k in range(8))
    left = WrenchSpace(layout).with_dead(1)
    assert left.worst("torque") == pytest.approx(0.56, abs=1e-9)
    assert left.worst("force") > 10.0


def test_three_pairs_of_dead_thrusters_cost_the_paper_module_a_degree_of_freedom() -> None:
    layout = of_vehicle(load_vehicle("modcube"))
    parts = {pair: without(layout, pair) for pair in itertools.combinations(range(8), 2)}
    lost = {pair: np.abs(np.linalg.svd(part.matrix)[0][:, 5]) for pair, part in parts.items() if part.rank < 6}
    assert set(lost) == {(2, 3), (4, 7), (5, 6)}
    assert lost[2, 3][[3, 5]] == pytest.approx([0.706, 0.706], abs=1e-3)  # roll and yaw combined
    assert min(lost[4, 7][5], lost[5, 6][5]) > 0.99  # yaw
    spaces = [WrenchSpace(part) for pair, part in parts.items() if pair not in lost]
    assert min(space.worst("torque") for space in spaces) == pytest.approx(0.21, abs=5e-3)
    assert min(space.worst("force") for space in spaces) == pytest.approx(3.8, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("dead", [1, 2])
def test_what_any_dead_thrusters_leave_is_the_worst_of_all_cases(dead: int) -> None:
    vehicle = load_vehicle("modcube")
    layout = of_modules([(0, 0, 0), (1, 0, 0)], [0, 0], [vehicle] * 2)
    left = WrenchSpace(layout).with_dead(dead)
    cases = [WrenchSpace(without(layout, c)) for c in itertools.combinations(range(layout.count), dead)]
    task = np.array([[10.0, 3.0, -2.0, 0.4, 0.0, 0.2]])
    for frame in FRAMES:
        assert left.worst(frame) == pytest.approx(min(case.worst(frame) for case in cases), rel=1e-9, abs=1e-9)
    assert left.reach(task)[0] == pytest.approx(min(case.reach(task)[0] for case in cases), rel=1e-9)


@pytest.mark.parametrize(
    ("name", "lost", "free"),
    [("bluerov2", ("surge", "pitch"), (3, 5)), ("girona500", ("sway", "roll"), (4, 5))],
)
def test_vehicle_with_a_passive_degree_of_freedom_is_degenerate_until_it_is_declared(
    name: str, lost: tuple[str, ...], free: tuple[int, ...]
) -> None:
    layout = one_of_seven(name)
    assert (layout.rank, layout.unreachable()) == (5, lost)
    assert [WrenchSpace(layout).section(frame) for frame in FRAMES] == [None, None]
    declared = WrenchSpace(layout.with_passive_declared())
    force, torque = declared.section("force"), declared.section("torque")
    assert force is not None and torque is not None
    assert (force.components, torque.components) == ((0, 1, 2), free)
    assert largest_inscribed(torque.normals, torque.offsets).volume > 0.0


def test_vehicle_whose_thrusters_do_not_touch_its_passive_axis_is_characterised() -> None:
    """Four thrusters level with the centre of mass and two above it. Regression: a traceback, for directions of three axes met two."""
    rov = load_vehicle("bluerov2")
    level = tuple(dataclasses.replace(t, position_m=t.position_m * [1.0, 1.0, 0.0]) for t in rov.thruster)
    layout = of_vehicle(dataclasses.replace(rov, thruster=level))
    found = summary.characterise(layout, count=121)
    assert found.unreachable == ("pitch",) and found.programs_differ < 1e-6
    assert found.power["torque"].residual == pytest.approx(1.0, abs=0.01), "a moment about pitch is missed whole"
    assert found.declared["torque"]["physical"].volume > 0.0


def test_vehicle_with_two_passive_rotations_is_drawn_with_the_line_that_its_moments_fill() -> None:
    """Regression: `characterise.py` ended in a traceback, for the outline of one component has no two axes to go round in."""
    rov = load_vehicle("bluerov2")
    found = summary.characterise(of_vehicle(dataclasses.replace(rov, passive_dof=("roll", "pitch"))), count=121, programs=False)
    picture = surfaces.pictures(found)["wrench", "torque"]
    (line,), reach = picture.polygons, found.declared["torque"][surfaces.NORMALISATION]
    assert line.shape == (2, 3) and not line[:, :2].any() and reach.volume > 0.0
    np.testing.assert_allclose(np.ptp(line[:, 2]), reach.volume)
    np.testing.assert_allclose(np.ptp(np.concatenate(picture.ellipsoid)[:, 2]), reach.volume)


@pytest.mark.parametrize(("name", "axis", "passive"), [("bluerov2", 0, 4), ("girona500", 1, 3)])
def test_axis_that_tilts_a_vehicle_is_pushed_once_the_tilt_is_declared_passive(name: str, axis: int, passive: int) -> None:
    layout = one_of_seven(name)
    declared, without = (summary.characterise(one, count=121, programs=False) for one in (layout, dataclasses.replace(layout, passive=())))
    assert np.all(without.axes[axis] == 0.0) and f"cannot push {AXES[axis]}, {AXES[passive]} alone; passive: none" in without.notes[0]
    assert np.all(declared.axes[axis] > 50.0) and np.all(declared.axes[passive] == 0.0)
    assert declared.notes[0] == f"degenerate: rank 5; passive: {AXES[passive]}"


def test_equal_total_thrust_gives_every_robot_eight_newtons() -> None:
    for name in SEVEN:
        assert one_of_seven(name).normalised("equal_total_thrust").f_max.sum() == pytest.approx(8.0)
    with pytest.raises(DescriptionError, match="permitted: physical"):
        one_of_seven("bluerov2").normalised("fancy")


def test_wrench_out_of_reach_has_the_factor_zero_and_no_sign() -> None:
    layout = of_vehicle(load_vehicle("bluerov2"))
    factors = reach_by_programs(layout, np.vstack([np.eye(6), -np.eye(6)]))
    assert np.any(factors == 0.0) and not np.any(np.signbit(factors))


def test_facets_of_sixty_four_scattered_thrusters_are_not_even_tried() -> None:
    layout = of_rows("many", np.random.default_rng(1).standard_normal((64, 6)), -8.0, 10.0)
    with pytest.raises(DescriptionError, match="64 thrusters are too many"):
        WrenchSpace(layout)


def test_cube_of_eight_modules_is_characterised_by_programs_alone() -> None:
    cells = list(itertools.product(range(2), range(2), range(2)))
    layout = of_modules(cells, [0] * 8, [load_vehicle("modcube_sim")] * 8)
    section = ProgramSpace(layout).section("force")
    assert section is not None
    assert section.worst() == pytest.approx(8 * 18.0)
    assert sum(len(polygon) for polygon in section.polygons()) == 2 * (len(section.offsets) + corners(section) - 2)


def corners(section: Section) -> int:
    return len(corners_of(section.normals, section.offsets))


def test_layout_without_thrusters_or_with_a_zero_or_unfinite_one_is_refused() -> None:
    good = [0.0, 0.1, 0.0, 1.0, 0.0, 0.0]
    for rows, what in (
        (np.zeros((0, 6)), "no thrusters"),
        (np.array([good, [0, 0, 0, 0, 0, 0]]), "thruster 1 has no direction"),
        (np.array([good, [np.nan, 0, 0, 0, 0, 1]]), "thruster 1 is not finite"),
    ):
        with pytest.raises(DescriptionError, match=what):
            of_rows("wrong", rows, -1.0, 1.0)


def test_single_thruster_reaches_only_along_itself() -> None:
    layout: Layout = of_rows("one", np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]]), -8.0, 10.0)
    space = WrenchSpace(layout)
    assert layout.rank == 1
    assert space.reach(np.vstack([np.eye(6)[:2], -np.eye(6)[:1]])) == pytest.approx([10.0, 0.0, 8.0])
