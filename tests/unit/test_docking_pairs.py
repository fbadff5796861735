"""The docking detector: both conditions, debounced and lost when measurements go stale; many pairs at once behave as each alone."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from firmware_py.core.docking_detector import FacePair, ModulePoses, PairBank, PairDetector, PairStatus, TagTable
from firmware_py.core.docking_pairs import APART, CLOSED, LOOSE
from firmware_py.core.joints import joints_of
from firmware_py.core.rotations import conjugate, from_euler, multiply, rotate
from firmware_py.core.types import DockFeedback, ModuleInputs, TagObservation
from firmware_py.description.parameters import Docking
from firmware_py.description.vehicle import FACE_NORMALS
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble

TICK_NS, PITCH_M = 10_000_000, 0.21
P = Docking()
TAG = 5
LEVERS, TURN = [np.array([0.02, -0.01, -0.1]) * way for way in (1.0, -0.5, 0.7, -1.0)], from_euler(0.3, -0.2, 1.0)
"""Of each module's only tag: its position in the module, and the rotation from module frame to tag frame."""
TAGS: TagTable = {(m, TAG): np.r_[LEVERS[m], TURN] for m in range(4)}
ROW = [FacePair(m, 0, m + 1, 1, np.array([PITCH_M, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])) for m in range(3)]
"""Four modules in a row, the +x face of each against the -x face of the next."""


@dataclass
class Row:
    """The four modules, and what they and the camera report in each tick."""

    attitude: np.ndarray = field(default_factory=lambda: from_euler(0.2, -0.1, 2.0))
    gaps_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    currents_ma: list[float] = field(default_factory=lambda: [100.0, -100.0, 100.0])
    """Current of both magnets of each joint."""
    noise_m: float = 0.0
    camera: bool = True
    tick: int = 0
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    poses: ModulePoses = field(default_factory=lambda: ModulePoses(TAGS, 4))

    def hear(self) -> tuple[int, list[ModuleInputs]]:
        """Time and inputs of the next tick: currents at 25 Hz, pictures at 50 Hz."""
        self.tick += 1
        modules = [ModuleInputs() for _ in range(4)]
        if self.tick % 4 == 0:
            for m, module in enumerate(modules):
                after, before = (*self.currents_ma, math.nan)[m], (math.nan, *self.currents_ma)[m]
                module.docks.append(DockFeedback(0, (after, before, math.nan), (1, 1, 0)))
        if self.camera and self.tick % 2 == 0:
            for m, x in enumerate(np.cumsum([0.0, *(PITCH_M + gap for gap in self.gaps_m)])):
                modules[m].tags.append(self._tag(float(x), LEVERS[m]))
        return self.tick * TICK_NS, modules

    def _tag(self, x: float, lever: np.ndarray) -> TagObservation:
        p_wt = np.array([1.0, 2.0, 0.5]) + rotate(self.attitude, np.array([x, 0.0, 0.0]) + lever)
        p_wt = p_wt + self.noise_m * self.rng.standard_normal(3)
        return TagObservation(TAG, 7, self.tick * TICK_NS - 40_000_000, p_wt, multiply(self.attitude, conjugate(TURN)))

    def seen(self, modules: list[ModuleInputs]) -> ModulePoses:
        """The poses of the modules, with those by the inputs of this tick."""
        self.poses.take(modules)
        return self.poses

    def watch(self, bank: PairBank, seconds: float) -> list[PairStatus]:
        """Steps `bank` for `seconds`; returns the status of every pair."""
        for _ in range(round(seconds / 0.01)):
            time_ns, modules = self.hear()
            bank.step(time_ns, modules, self.seen(modules))
        return [bank.status(i) for i in range(len(bank.rows))]


@pytest.fixture
def row() -> Row:
    return Row()


def test_pair_is_docked_once_both_conditions_were_seen_long_enough(row: Row) -> None:
    bank = PairBank(ROW, P)
    assert not any(status.docked for status in row.watch(bank, 0.14)), "not before the debounce is over"
    for status in row.watch(bank, 0.8):
        assert status.docked
        assert status.position_error_m < 1e-9 and status.spread_m < 1e-9


def test_either_condition_alone_is_no_dock(row: Row) -> None:
    row.gaps_m[0], row.currents_ma[1] = 0.02, 50.0
    apart, loose, docked = row.watch(PairBank(ROW, P), 1.0)
    assert apart.current and not apart.position and not apart.docked and apart.position_error_m == pytest.approx(0.02)
    assert loose.position and not loose.current and not loose.docked
    assert docked.docked


def test_dock_that_holds_is_lost_later_than_it_was_won(row: Row) -> None:
    bank = PairBank(ROW, P)
    row.watch(bank, 1.0)
    row.gaps_m[0], row.currents_ma[1] = P.position_tolerance_m + 0.5 * P.hysteresis_m, -60.0
    assert all(status.docked for status in row.watch(bank, 1.0))
    row.gaps_m[0], row.currents_ma[1] = P.position_tolerance_m + 1.5 * P.hysteresis_m, -50.0
    apart, loose, docked = row.watch(bank, 1.0)
    assert not apart.position and apart.current and not loose.current and loose.position and docked.docked
    row.gaps_m[0], row.currents_ma[1] = P.position_tolerance_m + 0.5 * P.hysteresis_m, -60.0
    assert [status.docked for status in row.watch(bank, 1.0)] == [False, False, True]


@pytest.mark.parametrize(
    ("current_ma", "docked"), [(71.0, True), (-71.0, True), (70.0, False), (-70.0, False), (69.5, False), (0.0, False)]
)
def test_dock_needs_more_than_seventy_milliamperes_of_either_sign(row: Row, current_ma: float, docked: bool) -> None:
    row.currents_ma[0] = current_ma
    assert row.watch(PairBank(ROW[:1], P), 1.0)[0].docked == docked


@pytest.mark.parametrize("debounce_ms", [100.0, 120.0])
def test_current_is_believed_by_the_first_measurement_after_the_debounce(row: Row, debounce_ms: float) -> None:
    """Currents arrive every 40 ms, from 40 ms on, so the condition holds at 160 ms."""
    bank = PairBank(ROW[:1], replace(P, debounce_ms=debounce_ms))
    assert [row.watch(bank, 0.01)[0].current for _ in range(16)] == [False] * 15 + [True]


def test_pair_of_which_nothing_was_heard_neither_holds_nor_is_open(row: Row) -> None:
    bank = PairBank(ROW[:1], P)
    row.camera, row.currents_ma = False, [math.nan] * 3
    for _ in range(5):
        (status,) = row.watch(bank, 0.01)
        assert not (status.current or status.position) and bank.rows["open"][0] == CLOSED
        assert math.isnan(status.position_error_m) and math.isnan(status.spread_m)


@pytest.mark.parametrize("silent", [0, 1])
@pytest.mark.parametrize("heard_s", [0.0, 1.0])
def test_current_of_one_face_alone_does_not_count(row: Row, silent: int, heard_s: float) -> None:
    """Whichever module is silent, and whether or not it was ever heard, its current counts only while it is fresh."""
    detector, seen = PairDetector(ROW[0], P), list[bool]()
    while len(seen) < 200:
        time_ns, modules = row.hear()
        if len(seen) >= 100 * heard_s:
            modules[silent].docks.clear()
        seen.append(detector.step(time_ns, modules, row.seen(modules)).current)
    last_heard = round(100 * heard_s)
    assert seen[last_heard - 1] == (heard_s > 0.0)
    assert not any(seen[last_heard + round(P.current_fresh_ms / 10.0) :])
    assert all(seen[last_heard : last_heard + round(P.current_fresh_ms / 10.0) - 1]) or heard_s == 0.0
    assert math.isnan(detector.currents_ma[silent]) == (heard_s == 0.0) and detector.currents_ma[1 - silent] == 100.0


@pytest.mark.parametrize("faces", [(0, 1), (2, 3), (4, 5), (5, 0)])
def test_current_of_every_face_is_heard(row: Row, faces: tuple[int, int]) -> None:
    """A frame carries three currents; those of all other faces are zero."""
    bank = PairBank([ROW[0]._replace(face_a=faces[0], face_b=faces[1])], P)
    for _ in range(100):
        time_ns, modules = row.hear()
        for module, face in zip(modules, faces, strict=False):
            currents = [100.0 if face == each else 0.0 for each in range(6)]
            module.docks = [DockFeedback(first, tuple(currents[first : first + 3]), (1, 1, 1)) for first in (0, 3)]
        bank.step(time_ns, modules, row.seen(modules))
    assert bank.status(0).docked


def test_magnet_that_the_limiter_rests_tells_nothing(row: Row) -> None:
    bank = PairBank(ROW[:2], P)
    row.watch(bank, 1.0)
    row.currents_ma = [0.0, 0.0, 0.0]
    for _ in range(100):
        time_ns, modules = row.hear()
        bank.step(time_ns, modules, row.seen(modules), resting=[(0, 0), (1, 1), (7, 0)])
    assert bank.rows["open"].tolist() == [CLOSED, LOOSE]


@pytest.mark.parametrize("missing", range(4))
def test_module_that_is_not_in_the_picture_is_not_placed_by_its_neighbours(row: Row, missing: int) -> None:
    bank = PairBank(ROW, P)
    for _ in range(100):
        time_ns, modules = row.hear()
        modules[missing].tags.clear()
        bank.step(time_ns, modules, row.seen(modules))
    assert [bank.status(i).position for i in range(3)] == [missing not in (i, i + 1) for i in range(3)]


def test_newest_of_several_pictures_counts(row: Row) -> None:
    """Two pictures arrive in one tick; the older one shows the modules still apart."""
    bank = PairBank(ROW, P)
    for _ in range(100):
        row.gaps_m = [0.05, 0.05, 0.05]
        _, older = row.hear()
        row.tick, row.gaps_m = row.tick - 1, [0.0, 0.0, 0.0]
        time_ns, modules = row.hear()
        for module, before in zip(modules, older, strict=True):
            module.tags[:0] = [tag._replace(capture_ns=tag.capture_ns - 16_000_000) for tag in before.tags]
        bank.step(time_ns, modules, row.seen(modules))
    assert all(bank.status(i).docked for i in range(3))


def test_position_is_judged_by_thirty_two_pictures_without_a_gap(row: Row) -> None:
    bank = PairBank(ROW[:1], P)
    for _ in range(2):
        row.camera = True
        errors = [row.watch(bank, 0.02)[0].position_error_m for _ in range(32)]
        assert [math.isnan(error) for error in errors] == [True] * 31 + [False]
        row.camera = False
        row.watch(bank, 1.0)


def test_joint_keeps_the_time_of_the_last_picture_that_showed_it_in_its_place(row: Row) -> None:
    bank = PairBank(ROW[:1], P)
    row.gaps_m[0] = 0.9 * P.open_m
    row.watch(bank, 1.0)
    row.gaps_m[0] = 1.1 * P.open_m
    row.watch(bank, 1.0)
    assert bank.rows["near_ns"][0] == 1_000_000_000 - 40_000_000


@pytest.mark.parametrize(
    ("gap_m", "current_ma", "camera", "state"),
    [
        (0.0, 100.0, True, CLOSED), (0.0, 50.0, True, LOOSE), (0.0, 50.0, False, APART), (0.9 * P.open_m, 100.0, True, CLOSED),
        (1.1 * P.open_m, 100.0, True, LOOSE), (1.1 * P.open_m, math.nan, True, APART), (1.1 * P.open_m, 50.0, True, APART),
        (1.1 * P.open_m, 100.0, False, CLOSED), (0.0, math.nan, True, CLOSED), (0.0, math.nan, False, CLOSED),
    ],
)  # fmt: skip
def test_joint_is_open_by_what_is_measured_and_never_by_silence(
    row: Row, gap_m: float, current_ma: float, camera: bool, state: int
) -> None:
    """Apart if all fresh measurements say so, loose if one of them contradicts; and CLOSED again once the joint is closed."""
    assert CLOSED < LOOSE < APART
    bank = PairBank(ROW[:1], P)
    row.watch(bank, 1.0)
    assert not bank.rows["open"].any()
    row.gaps_m[0], row.currents_ma[0], row.camera = gap_m, current_ma, camera
    row.watch(bank, 2.0)
    assert bank.rows["open"][0] == state
    row.gaps_m[0], row.currents_ma[0], row.camera = 0.0, 100.0, True
    row.watch(bank, 1.0)
    assert bank.rows["open"][0] == CLOSED


def test_what_is_not_seen_any_more_is_not_believed(row: Row) -> None:
    """A coasted pose never counts, and neither does a stale current."""
    bank = PairBank(ROW, P)
    row.watch(bank, 1.0)
    row.camera = False
    assert all(status.position for status in row.watch(bank, 0.2))
    for status in row.watch(bank, 0.2):
        assert status.current and not status.position and math.isnan(status.position_error_m)
    row.camera, row.currents_ma = True, [math.nan] * 3
    assert all(status.current for status in row.watch(bank, 0.2))
    assert not any(status.current for status in row.watch(bank, 0.1))


def test_pair_that_still_moves_is_not_settled(row: Row) -> None:
    bank = PairBank(ROW[:1], P)
    for _ in range(300):
        row.gaps_m[0] = 0.008 * math.sin(2.0 * math.pi * 3.0 * row.tick * 0.01)
        row.watch(bank, 0.01)
        assert not bank.status(0).position


def test_drift_of_a_pair_is_between_the_means_of_its_newest_pictures_and_those_before(row: Row) -> None:
    """Eight pictures each, out of the thirty-two whose mean is the error."""
    bank, rng, gaps_m = PairBank(ROW[:1], P), np.random.default_rng(2), list[float]()
    while len(gaps_m) < 100:
        row.gaps_m[0] = rng.uniform(0.0, 0.004)
        row.watch(bank, 0.01)
        if row.tick % 2 == 0:
            gaps_m.append(row.gaps_m[0])
        if len(gaps_m) >= 32:
            status = bank.status(0)
            assert status.position_error_m == pytest.approx(np.mean(gaps_m[-32:]), abs=1e-9)
            assert status.spread_m == pytest.approx(abs(np.mean(gaps_m[-8:]) - np.mean(gaps_m[-16:-8])), abs=1e-9)


@pytest.mark.slow
def test_pair_that_jammed_four_millimetres_short_is_not_docked_in_a_minute_of_noise(row: Row) -> None:
    row.noise_m, row.gaps_m[0] = 0.002, 0.0045
    bank = PairBank(ROW[:1], P)
    assert not any(row.watch(bank, 0.01)[0].position for _ in range(6000))


def test_locked_pair_is_found_in_noise_and_through_flipped_tags(row: Row) -> None:
    """Two pictures in five show a flipped tag, whose module would be fifteen millimetres off."""
    row.noise_m = 0.002
    bank = PairBank(ROW[:1], P)
    for n in range(400):
        time_ns, modules = row.hear()
        if n % 10 in (1, 3):
            assert modules[1].tags
            modules[1].tags = [t._replace(q_wt=multiply(t.q_wt, from_euler(0.3, 0.0, 0.0))) for t in modules[1].tags]
        bank.step(time_ns, modules, row.seen(modules))
        assert n < 150 or bank.status(0).docked


@pytest.mark.parametrize("flip", [(math.pi / 2, 0.0, 0.0), (0.0, math.pi / 2, 0.0), (0.0, 0.0, -math.pi / 2)])
def test_flipped_tag_that_is_off_by_a_quarter_turn_opens_no_joint(row: Row, flip: tuple[float, float, float]) -> None:
    """One picture in five shows such a tag, seen from 45 degrees; its module would be seventy millimetres off."""
    bank = PairBank(ROW[:1], P)
    for n in range(400):
        time_ns, modules = row.hear()
        if n % 10 == 1:
            assert modules[1].tags
            modules[1].tags = [t._replace(q_wt=multiply(t.q_wt, from_euler(*flip))) for t in modules[1].tags]
        bank.step(time_ns, modules, row.seen(modules))
        assert n < 100 or (bank.status(0).docked and bank.rows["open"][0] == CLOSED)


@pytest.mark.parametrize("turn", [from_euler(0.0, 0.0, math.pi / 2), from_euler(math.pi, 0.0, 0.0)])
def test_modules_that_are_docked_turned_are_found_so(row: Row, turn: np.ndarray) -> None:
    """Only with the rotation that the pair specifies."""
    tags: TagTable = {(0, TAG): TAGS[0, TAG], (1, TAG): np.r_[rotate(conjugate(turn), LEVERS[1]), multiply(TURN, turn)]}
    row.poses = ModulePoses(tags, 4)
    for q_ab, found in ((turn, True), (np.array([1.0, 0.0, 0.0, 0.0]), False)):
        bank = PairBank([ROW[0]._replace(q_ab=q_ab)], P)
        for _ in range(100):
            time_ns, modules = row.hear()
            bank.step(time_ns, modules, row.seen(modules))
        assert bank.status(0).position == found


def test_tag_that_the_vehicle_does_not_carry_places_nobody(row: Row) -> None:
    bank = PairBank(ROW[:1], P)
    for _ in range(100):
        time_ns, modules = row.hear()
        modules[0].tags = [tag._replace(tag_id=14) for tag in modules[0].tags]
        bank.step(time_ns, modules, row.seen(modules))
    assert not bank.status(0).position and bank.status(0).current


def test_pictures_of_different_times_place_nobody(row: Row) -> None:
    bank = PairBank(ROW[:1], P)
    for _ in range(100):
        time_ns, modules = row.hear()
        modules[0].tags = [tag._replace(capture_ns=tag.capture_ns - 1) for tag in modules[0].tags]
        bank.step(time_ns, modules, row.seen(modules))
    assert not bank.status(0).position


@pytest.mark.parametrize("late", [0, 1])
@pytest.mark.parametrize(("late_ticks", "found"), [(2, True), (40, False)])
def test_picture_counts_whose_tags_come_in_different_ticks(row: Row, late: int, late_ticks: int, found: bool) -> None:
    """As from two buses, one of them slower by 20 ms. Tags that are 440 ms old are of no use."""
    bank, waiting = PairBank(ROW[:1], P), list[list[TagObservation]]()
    for _ in range(150):
        time_ns, modules = row.hear()
        waiting.append(modules[late].tags)
        modules[late].tags = waiting.pop(0) if len(waiting) > late_ticks else []
        bank.step(time_ns, modules, row.seen(modules))
    assert bank.status(0).position == found


def test_picture_of_many_tags_is_kept_once(row: Row) -> None:
    """Eight tags of the early module in each picture do not push out those that wait 80 ms for the late one."""
    bank, waiting = PairBank(ROW[:1], P), list[list[TagObservation]]()
    for _ in range(150):
        time_ns, modules = row.hear()
        waiting.append(modules[1].tags)
        modules[0].tags, modules[1].tags = 8 * modules[0].tags, waiting.pop(0) if len(waiting) > 8 else []
        bank.step(time_ns, modules, row.seen(modules))
    assert bank.status(0).position


def test_picture_is_counted_once(row: Row) -> None:
    """A second tag of a module in a picture that was used, and pictures that stay the newest ones, change nothing."""
    bank = PairBank(ROW[:1], P)
    for _ in range(20):
        time_ns, modules = row.hear()
        bank.step(time_ns, modules, row.seen(modules))
        modules[1].tags = [tag._replace(p_wt=tag.p_wt + 0.1) for tag in modules[1].tags]
        bank.step(time_ns, modules, row.seen(modules))
    assert bank.rows["pictures"][0] == 10


@pytest.mark.slow
def test_many_pairs_are_each_as_one_alone(row: Row) -> None:
    row.noise_m, row.gaps_m = 0.002, [0.0, 0.005, 0.01]
    bank, alone = PairBank(ROW, P), [PairDetector(pair, P) for pair in ROW]
    for n in range(1500):
        row.camera = n // 100 % 3 != 2
        row.currents_ma = [75.0 + 25.0 * math.sin(0.01 * n * k) for k in (3.0, 5.0, 7.0)]
        time_ns, modules = row.hear()
        bank.step(time_ns, modules, row.seen(modules))
        for i, detector in enumerate(alone):
            np.testing.assert_equal(detector.step(time_ns, modules, row.poses), bank.status(i))


def test_joints_go_on_when_other_joints_come_and_go(row: Row) -> None:
    bank = PairBank(ROW[:2], P)
    before = row.watch(bank, 1.0)
    after = PairBank(ROW[1:], P, bank)
    assert after.status(0) == before[1] and not after.status(1).docked
    assert all(status.docked for status in row.watch(after, 0.9))


@pytest.mark.parametrize(("cell", "turns"), [((0, 1, 0), (0, 2)), ((0, 1, 0), (0, 14)), ((0, 0, 1), (0, 3)), ((0, 0, 1), (0, 21))])
@pytest.mark.parametrize("swapped", [False, True])
def test_joint_of_modules_that_sit_turned_is_told_in_their_own_frames(cell: tuple[int, ...], turns: tuple[int, int], swapped: bool) -> None:
    """Whichever module comes first in the body, the other's centre is one pitch in front of the face that is turned to it."""
    vehicles, cells, modules = [load_vehicle("modcube")] * 2, [(0, 0, 0), cell], [5, 6]
    if swapped:
        cells, turns = cells[::-1], turns[::-1]
    body = assemble(cells, list(turns), vehicles, modules)
    ((request, offset, q_ta),) = joints_of(body)
    np.testing.assert_allclose(multiply(body.q_bm[0].copy(), q_ta), body.q_bm[1], atol=1e-12)
    assert (request.target_module, request.module) == (5, 6)
    np.testing.assert_allclose(offset, PITCH_M * FACE_NORMALS[request.target_face], atol=1e-12)
    step_b = body.r_bm[1] - body.r_bm[0]
    for i, face, way_b in ((0, request.target_face, step_b), (1, request.face, -step_b)):
        np.testing.assert_allclose(PITCH_M * rotate(body.q_bm[i].copy(), FACE_NORMALS[face].astype(float)), way_b, atol=1e-12)


@pytest.mark.slow
def test_body_has_a_joint_between_every_two_neighbours() -> None:
    cells = [(x, y, z) for x in range(4) for y in range(4) for z in range(4)]
    joints = joints_of(assemble(cells, [0] * 64, [load_vehicle("modcube")] * 64))
    assert len(joints) == 3 * 4 * 4 * 3
    for request, offset, q_ta in joints:
        np.testing.assert_array_equal(q_ta, [1.0, 0.0, 0.0, 0.0])
        step = np.subtract(cells[request.module], cells[request.target_module])
        np.testing.assert_allclose(offset, PITCH_M * step, atol=1e-12)
        assert {request.target_face, request.face} in ({0, 1}, {2, 3}, {4, 5})
