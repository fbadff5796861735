"""Docked partners lost or undocked in flight: what the firmware believes, which body is told, and that one body alone flies each module."""

from dataclasses import replace

import pytest

from firmware_py.core.docking import HOLDS
from firmware_py.core.failsafes import Level
from firmware_py.core.joints import joints_of
from firmware_py.core.transitions import State
from firmware_py.core.types import RELAY_PULL, Action, DockFeedback, DockRequest, Mode, ModuleInputs, Request
from firmware_py.core.undocking import IN_PLACE
from firmware_py.description.parameters import Parameters
from tests.unit.tanks import LOST, RING, TAG_DELAY_TICKS, FaultyTank

pytestmark = pytest.mark.slow


def test_module_that_is_lost_is_parted_half_a_second_later_and_both_hold() -> None:
    tank = FaultyTank(RING[:2])
    tank.fly()
    lost_s = tank.lose(1)
    outputs = tank.run(1.0)
    assert tank.shape == [(0,), (1,)]
    assert [(record.state, record.mode) for record in outputs.records] == [(State.ARMED, Mode.POSHOLD)] * 2
    assert 0.5 < tank.when(LOST) - lost_s < 0.65
    assert tank.when("is undocked") - tank.when(LOST) < 0.05, "an open joint needs no pushing apart"


def test_two_bodies_that_come_apart_in_one_tick_are_both_parted() -> None:
    tank = FaultyTank(RING, each=2)
    tank.run(0.5)
    tank.run(1.0, Request(Action.ARM, 0), Request(Action.ARM, 2))
    lost_s = tank.lose(1, 3)
    tank.run(1.0)
    assert tank.shape == [(0,), (1,), (2,), (3,)]
    assert max(at for at, said in tank.event_log if "is undocked" in said) - lost_s < 0.7
    assert not [said for _, said in tank.event_log if "refused" in said or "ended" in said], "each asks for its own joint"


def test_magnets_of_each_body_are_told_their_own_states() -> None:
    tank = FaultyTank([(0, 0, 0), (1, 0, 0), (0, 0, 0), (0, 1, 0)], each=2)
    tank.run(0.2)
    told = [{outputs.modules[m].relays for outputs in tank.outputs} - {None} for m in range(4)]
    assert told == [{(1, 0, 0, 0, 0, 0)}, {(0, 1, 0, 0, 0, 0)}, {(0, 0, 1, 0, 0, 0)}, {(0, 0, 0, 1, 0, 0)}]


@pytest.mark.slow
def test_only_the_body_that_lost_a_partner_is_told_and_parted() -> None:
    tank = FaultyTank(RING, each=2)
    tank.run(0.5)
    tank.run(1.0, Request(Action.ARM, 0), Request(Action.ARM, 2))
    tank.lose(1)
    tank.run(1.0)
    assert tank.shape == [(0,), (1,), (2, 3)]
    assert {event.body for outputs in tank.outputs for event in outputs.events if LOST in event.text} == {0}
    assert [record.body for record in tank.outputs[-1].records] == [0, 1, 2], "in the order of their numbers"


def test_current_alone_is_reported_and_parts_nothing_that_pictures_show_in_its_place() -> None:
    tank = FaultyTank(RING[:2])
    tank.fly()
    tank.without_current.add(1)
    outputs = tank.run(2.0)
    assert tank.when(LOST)
    assert tank.shape == [(0, 1)]
    assert (outputs.records[0].state, outputs.records[0].mode) == (State.ARMED, Mode.POSHOLD)


def test_partner_that_may_be_lost_is_undocked_when_somebody_asks_for_that() -> None:
    """Its magnets carry no current but pictures show it in place, so the fail-safe does not part them: only a request does."""
    tank = FaultyTank(RING[:2])
    tank.fly()
    tank.without_current.add(1)
    tank.run(2.0)
    assert tank.when(LOST) and tank.shape == [(0, 1)]
    outputs = tank.run(3.0, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert tank.shape == [(0,), (1,)] and not [said for _, said in tank.event_log if "refused" in said]
    assert [(record.state, record.mode) for record in outputs.records] == [(State.ARMED, Mode.POSHOLD)] * 2


def test_joint_that_holds_is_not_undocked_while_a_partner_is_lost() -> None:
    """Module 0 may be lost, but 1 and 2 hold together. A request for a missing joint does not end the fail-safe's mode."""
    tank = FaultyTank([(0, 0, 0), (1, 0, 0), (2, 0, 0)], Parameters().replace("failsafes.partner_lost_action", int(Level.SURFACE)))
    tank.fly()
    tank.without_current.add(0)
    tank.run(2.0)
    for request in DockRequest(2, 1, 1, 0), DockRequest(2, 1, 0, 0):
        outputs = tank.run(1.0, Request(Action.UNDOCK, 0, request))
        assert outputs.records[0].mode == Mode.SURFACE and tank.shape == [(0, 1, 2)]
    assert tank.when("UNDOCK refused: a docked partner is lost")
    tank.run(3.0, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert tank.shape == [(0,), (1, 2)]


def test_neighbours_that_turn_two_probes_to_each_other_are_no_joint_that_could_be_lost() -> None:
    """Random shapes have such neighbours; taking them for a joint once kept the robot from arming."""
    ring = FaultyTank(RING).pipeline.bodies[0]
    assert len(joints_of(ring)) == 4
    assert len(joints_of(replace(ring, faces=(*ring.faces[:3], "PPPPPP")))) == 2


def test_silent_magnets_lose_nobody() -> None:
    tank = FaultyTank(RING[:2])
    tank.fly()
    tank.hidden.add(1)
    tank.run(2.0)
    assert tank.shape == [(0, 1)] and not any(LOST in text for _, text in tank.event_log)


@pytest.mark.parametrize("changes", [{"docking.debounce_ms": 1000.0}, {"failsafes.partner_lost_delay_s": 0.0}])
def test_healthy_pair_is_never_taken_for_an_open_one_however_soon_one_asks(changes: dict[str, float]) -> None:
    parameters = Parameters()
    for name, value in changes.items():
        parameters = parameters.replace(name, value)
    tank = FaultyTank(RING[:2], parameters)
    tank.fly()
    assert tank.shape == [(0, 1)] and not any(LOST in text for _, text in tank.event_log)


def test_disarmed_pair_stays_one_body_and_may_not_arm() -> None:
    tank = FaultyTank(RING[:2])
    tank.lose(1)
    tank.run(1.0)
    outputs = tank.run(0.2, Request(Action.ARM))
    assert tank.shape == [(0, 1)] and outputs.records[0].state == State.DISARMED
    assert any("ARM refused" in text and "do not hold together" in text for _, text in tank.event_log)


def test_body_that_has_come_apart_while_disarmed_is_undocked_and_flies_on_as_two() -> None:
    tank = FaultyTank(RING[:2])
    undock = Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0))
    tank.run(0.5)
    tank.run(0.5, undock)
    assert tank.when("UNDOCK refused: the body is disarmed, and the joint is not open") and tank.shape == [(0, 1)]
    tank.lose(1)
    tank.run(2.0)
    outputs = tank.run(0.2, undock)
    assert tank.shape == [(0,), (1,)] and [record.state for record in outputs.records] == [State.DISARMED] * 2
    assert not [states for states in tank.pipeline.formation.docking.relays.states if any(states)]
    tank.run(2.5)
    assert tank.run(0.2, Request(Action.ARM, 0)).records[0].state == State.ARMED


def test_disarmed_body_whose_joint_pictures_show_closed_is_not_undocked() -> None:
    tank = FaultyTank(RING[:2])
    tank.without_current.add(1)
    tank.run(2.0)
    tank.run(0.5, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert tank.when(f"undock refused: {HOLDS.format('modules 1 and 2')}") and tank.shape == [(0, 1)]
    assert {max(states) for states in tank.pipeline.formation.docking.relays.states} == {RELAY_PULL}


@pytest.mark.parametrize(("module", "target"), [(1, 3), (3, 1)])
def test_disarmed_ring_is_parted_where_it_has_come_apart_whichever_side_is_named(module: int, target: int) -> None:
    """Module 1 has come off both its neighbours. The undock once included the joint by which 2 still holds 3, and was refused."""
    tank = FaultyTank(RING)
    tank.run(0.5)
    tank.lose(1)
    tank.run(2.0)
    faces = {1: 2, 3: 3}
    tank.run(0.5, Request(Action.UNDOCK, 0, DockRequest(module, faces[module], target, faces[target])))
    assert tank.shape == [(0, 2, 3), (1,)]


@pytest.mark.parametrize("asked", [DockRequest(1, 1, 0, 0), DockRequest(2, 0, 3, 1)], ids=str)
def test_disarmed_ring_that_has_come_apart_into_halves_is_undocked_into_them(asked: DockRequest) -> None:
    """An undock once parted a single corner by both its joints, of which one holds here, so only forced arming parted the halves."""
    tank = FaultyTank(RING)
    tank.run(0.5)
    hear = tank._hear

    def hear_no_current_between_the_halves(tick: int) -> list[ModuleInputs]:
        modules = hear(tick)
        for module in modules:
            module.docks = [DockFeedback(first, (0.0, 0.0, ma[2]) if first == 0 else ma, relays) for first, ma, relays in module.docks]
        return modules

    tank._hear, tank.hidden = hear_no_current_between_the_halves, {1, 3}  # type: ignore[method-assign]
    tank.run(2.0)
    outputs = tank.run(0.5, Request(Action.UNDOCK, 0, asked))
    assert tank.shape == [(0, 2), (1, 3)] and [record.state for record in outputs.records] == [State.DISARMED] * 2
    assert [sum(states) for states in tank.pipeline.formation.docking.relays.states] == [1] * 4, "the halves hold"


def test_fail_safe_that_is_switched_off_parts_nothing() -> None:
    tank = FaultyTank(RING[:2], Parameters().replace("failsafes.partner_lost_action", 0))
    tank.fly()
    tank.lose(1)
    tank.run(1.0)
    assert tank.shape == [(0, 1)]


def test_middle_of_three_that_is_lost_leaves_three() -> None:
    tank = FaultyTank([(0, 0, 0), (1, 0, 0), (2, 0, 0)])
    tank.fly()
    tank.lose(1)
    tank.run(2.0)
    assert tank.shape == [(0,), (1,), (2,)]


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 5, 30])
def test_joint_that_opens_while_another_is_being_parted_waits_its_turn(delay: int) -> None:
    tank = FaultyTank([(0, 0, 0), (1, 0, 0), (2, 0, 0)], delay=delay)
    tank.fly()
    tank.lose(2)
    tank.run(0.7)
    tank.lose(1)
    tank.run(3.0)
    assert tank.shape == [(0,), (1,), (2,)]


def test_corner_of_a_ring_is_lost_by_both_its_joints() -> None:
    tank = FaultyTank(RING)
    tank.fly()
    tank.lose(3)
    tank.run(1.5)
    assert tank.shape == [(0, 1, 2), (3,)]


def test_ring_with_one_open_joint_is_still_one_body_and_asks_once() -> None:
    tank = FaultyTank(RING)
    tank.fly()
    tank.hidden |= {0, 1}
    tank.pipeline.formation.docking.open_joints = lambda least: [DockRequest(1, 1, 0, 0)]  # type: ignore[method-assign]
    tank.run(1.5)
    assert tank.shape == [(0, 1, 2, 3)]
    assert sum("also held together" in text for _, text in tank.event_log) == 1


@pytest.mark.parametrize("again", [DockRequest(1, 1, 0, 0), DockRequest(0, 0, 1, 1)], ids=["alike", "from the other side"])
def test_undock_that_is_asked_for_twice_parts_once(again: DockRequest) -> None:
    """A client that missed the answer asks again. It was once told that its undock had restarted and, once done, that it had ended."""
    tank = FaultyTank(RING[:2])
    tank.fly()
    for request in (DockRequest(1, 1, 0, 0), again):
        tank.run(0.1, Request(Action.UNDOCK, 0, request))
    tank.run(2.5)
    assert tank.shape == [(0,), (1,)]
    said = [text for _, text in tank.event_log if "undock" in text]
    assert said == ["undocking module 2 from module 1", "module 2 is undocked from module 1"]


@pytest.mark.slow
@pytest.mark.parametrize("asked", [DockRequest(2, 1, 1, 0), DockRequest(2, 1, 1, 0, 1, True), DockRequest(2, 4, 1, 5)])
def test_joint_that_a_hanging_relay_holds_is_not_taken_for_undocked(asked: DockRequest) -> None:
    tank = FaultyTank([(0, 0, 0), (1, 0, 0), (2, 0, 0)])
    tank.fly()
    tank.stuck = True
    outputs = tank.run(3.0, Request(Action.UNDOCK, 0, asked))
    assert tank.shape == [(0, 1, 2)] and outputs.records[0].mode == Mode.POSHOLD
    assert tank.when(f"undock of module 3 ended: {IN_PLACE}")
    assert tank.pipeline.formation.docking.relays.states[2] == [0, 1, 0, 0, 0, 0], "and pulls again"
    tank.stuck = False
    tank.run(3.0, Request(Action.UNDOCK, 0, DockRequest(2, 1, 1, 0)))
    assert tank.shape == [(0, 1), (2,)]


def test_undock_whose_pictures_show_it_leaving_is_done_though_that_is_not_yet_believed() -> None:
    tank = FaultyTank(RING[:2], Parameters().replace("docking.release_s", 0.5).replace("docking.debounce_ms", 1000.0))
    tank.run(2.0)
    tank.fly()
    tank.stuck, hear = True, tank._hear

    def see_it_leave(tick: int) -> list[ModuleInputs]:
        modules, away = hear(tick), 0.001 * (tick - first)
        for tag in modules[1].tags:
            tag.p_wt[0] += away
        return modules

    first, tank._hear = len(tank.outputs), see_it_leave  # type: ignore[method-assign]
    tank.run(1.0, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert tank.shape == [(0,), (1,)] and not any(IN_PLACE in said for _, said in tank.event_log)


@pytest.mark.slow
@pytest.mark.parametrize("stuck", [True, False])
@pytest.mark.parametrize(
    ("every", "release_s"), [(2, 1.0), (32, 1.0), (10, 0.3), (2, 0.05)], ids=["50 Hz", "3 Hz", "short", "shorter than pictures need"]
)
def test_slow_camera_too_tells_a_module_that_leaves_from_one_that_a_hanging_relay_holds(every: int, release_s: float, stuck: bool) -> None:
    tank = FaultyTank(RING[:2], Parameters().replace("docking.release_s", release_s))
    tank.fly()
    tank.stuck, hear = True, tank._hear

    def see_now_and_then(tick: int) -> list[ModuleInputs]:
        modules, since_s = hear(tick), 0.01 * (tick - TAG_DELAY_TICKS - first)
        for m, module in enumerate(modules):
            for tag in module.tags if m == 1 and not stuck else []:
                tag.p_wt[0] += 0.0 if since_s < 0.0 else 0.1 * since_s  # as fast as the bench's magnets push
            if (tick - TAG_DELAY_TICKS) % every:
                module.tags.clear()
        return modules

    first, tank._hear = len(tank.outputs), see_now_and_then  # type: ignore[method-assign]
    tank.run(max(2.2 * release_s, 0.7), Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert tank.shape == ([(0, 1)] if stuck else [(0,), (1,)])
    assert any(IN_PLACE in said for _, said in tank.event_log) == stuck


@pytest.mark.slow
def test_partner_that_is_being_undocked_is_not_lost_and_is_flown_alone_once_it_is_seen_apart() -> None:
    """While the magnets push, currents and pictures show an open joint, as intended: the push is over then, however long it may take."""
    tank = FaultyTank(RING[:2], Parameters().replace("docking.release_s", 2.0))
    tank.fly()
    tank.run(0.1, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert tank.shape == [(0, 1)]
    tank.lose(1)
    tank.run(0.7)
    assert tank.shape == [(0,), (1,)]
    assert not [said for _, said in tank.event_log if LOST in said]


@pytest.mark.slow
def test_undock_that_is_asked_for_while_the_partner_is_being_lost_parts_once() -> None:
    tank = FaultyTank(RING[:2], delay=30)
    tank.fly()
    tank.lose(1)
    tank.run(0.7)
    tank.run(2.5, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    assert tank.shape == [(0,), (1,)]


def test_estimate_of_a_part_is_as_old_as_that_of_the_whole() -> None:
    tank = FaultyTank(RING[:2])
    tank.fly()
    (pipeline,) = tank.pipeline.formation.pipelines
    fresh = tank.pipeline.body_pipeline_of(pipeline.body)
    motion = pipeline.estimator.motion
    old = fresh.estimator.restart(5_000_000_000, motion._replace(tag_ns=2_000_000_000))
    assert old.ready and old.tag_age_ns == 3_000_000_000
    assert not fresh.estimator.restart(5_000_000_000, motion._replace(accepted=0)).ready


@pytest.mark.slow
@pytest.mark.parametrize("cells", [[(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 0, 0), (2, 0, 0), (1, 0, 0)], [(1, 0, 0), (0, 0, 0), (1, 1, 0)]])
def test_three_that_have_all_come_apart_are_three_however_they_are_numbered(cells: list[tuple[int, int, int]]) -> None:
    tank = FaultyTank(cells)
    tank.fly()
    tank.lose(0, 1, 2)
    tank.run(3.0)
    assert tank.shape == [(0,), (1,), (2,)]


@pytest.mark.parametrize("hidden", [set(), {1}], ids=["seen", "out of sight"])
def test_magnets_that_the_limiter_rests_are_no_lost_partner(hidden: set[int]) -> None:
    """Resting magnets carry no current, and if the partner is out of sight, no picture shows the joint closed either."""
    tank = FaultyTank(RING[:2], Parameters().replace("limiter.relay_on_s", 2.0))
    hear, relays = tank._hear, [(1,) * 6] * 2

    def heard(tick: int) -> list[ModuleInputs]:
        modules = hear(tick)
        for m, module in enumerate(modules):
            sent = tank.outputs[-1].modules[m].relays if tank.outputs else None
            relays[m] = relays[m] if sent is None else sent
            module.docks = [replace_current(dock, relays[m]) for dock in module.docks]
        return modules

    def replace_current(dock: DockFeedback, states: tuple[int, ...]) -> DockFeedback:
        at = slice(dock.first, dock.first + 3)
        return DockFeedback(dock.first, tuple(110.0 * state for state in states[at]), states[at])

    tank._hear = heard  # type: ignore[method-assign]
    tank.fly()
    tank.hidden |= hidden
    tank.run(0.1, Request(Action.SET_PARAMETER, 0, ("limiter.relay_duty", 0.5)))
    tank.run(15.0)
    rested = [outputs.modules[0].relays for outputs in tank.outputs if outputs.modules[0].relays == (0,) * 6]
    assert rested and tank.shape == [(0, 1)]
    assert not any(LOST in text for _, text in tank.event_log)
