"""Right of way among docks under way: one body is in front of its target's face, and another's way leads past there."""

import numpy as np
import pytest

from firmware_py.core.docking_decisions import Prepared
from firmware_py.core.docking_detector import FacePair, PairDetector
from firmware_py.core.docking_sequence import DockingSequence, Stage
from firmware_py.core.docking_traffic import Dock, Traffic
from firmware_py.core.setpoint import REST, Wish
from firmware_py.core.types import DockRequest
from firmware_py.description.parameters import Docking
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble
from firmware_py.prepare.docking import plan_dock
from tests.unit.dock_follower import LEVEL, STAGED, estimate

Place = tuple[float, float]
VEHICLES = [load_vehicle("modcube")] * 4
BODIES = [assemble([(0, 0, 0)], [0], VEHICLES[:1], [m]) for m in range(4)]
PASSER_BLOCKING, PASSER_CLEAR, OTHER_CLEAR, OTHER_BLOCKING = (0.24, 0.05), (0.6, -0.3), (-0.6, 0.5), (0.06, 0.9)
"""Places where docks began. Of the body that passes the other's face: beside the target, and farther off; of the other: clear of that way,
and on it."""


def room(at: Place) -> Wish:
    return REST._replace(p_wb=np.array([*at, 0.0]), q_wb=LEVEL)


def dock(request: DockRequest, began: Place, stage: Stage, makes_room: bool = False) -> Dock:
    active, target = request.module, request.target_module
    plan = plan_dock(request, BODIES[active], BODIES[target], VEHICLES)
    sequence = DockingSequence(plan, BODIES[active], BODIES[target], STAGED, 0, target_approaches=False)
    sequence.stage, sequence.makes_room = stage, makes_room
    pair = FacePair(target, request.target_face, active, request.face, plan.place_t, plan.q_ta)
    return Dock(sequence, PairDetector(pair, STAGED), active, target, Prepared(request, plan, ()), room(began), set())


def waits(
    began: tuple[Place, Place], stage: Stage = Stage.APPROACH, makes_room: bool = False, passer_first: bool = True
) -> tuple[Wish | None, Wish | None]:
    """Wishes, or None, of the passer (module 2, on its way to 3) and of the body before its target's face (module 1, docking to 0)."""
    passer = dock(DockRequest(2, 2, 3, 3), began[0], Stage.PRE_APPROACH)
    before = dock(DockRequest(1, 3, 0, 2), began[1], stage, makes_room)
    places = [(0.0, 0.0), (0.0, 0.33), PASSER_BLOCKING, (0.04, 1.36)]
    estimates = {m: (BODIES[m], estimate(np.array([*places[m], 0.0]))) for m in range(4)}
    docks = [passer, before] if passer_first else [before, passer]
    traffic = Traffic(docks, estimates, [], STAGED)
    found = [traffic.wait(each) for each in (passer, before)]
    return tuple(None if wait is None else wait.wish for wait in found)  # type: ignore[return-value]


def is_at(wish: Wish | None, place: Place) -> bool:
    return wish is not None and wish.p_wb is not None and bool(np.all(wish.p_wb[:2] == place))


@pytest.mark.parametrize("passer_first", [True, False])
def test_later_of_two_that_wait_for_each_other_makes_room(passer_first: bool) -> None:
    passer, before = waits((PASSER_CLEAR, OTHER_CLEAR), passer_first=passer_first)
    if passer_first:
        assert passer is REST and is_at(before, OTHER_CLEAR)
    else:
        assert is_at(passer, PASSER_CLEAR) and before is REST


@pytest.mark.parametrize("passer_first", [True, False])
def test_other_makes_room_where_the_later_would_be_in_the_way_there_too(passer_first: bool) -> None:
    passer, before = waits((PASSER_CLEAR, OTHER_BLOCKING) if passer_first else (PASSER_BLOCKING, OTHER_CLEAR), passer_first=passer_first)
    if passer_first:
        assert is_at(passer, PASSER_CLEAR) and before is REST
    else:
        assert passer is REST and is_at(before, OTHER_CLEAR)


def test_where_neither_can_make_room_both_wait() -> None:
    assert waits((PASSER_BLOCKING, OTHER_BLOCKING)) == (REST, REST)


def test_room_is_made_until_it_is_there_and_not_begun_by_one_that_is_on_no_way_itself() -> None:
    assert waits((PASSER_CLEAR, OTHER_CLEAR), Stage.PRE_APPROACH) == (REST, None)
    passer, before = waits((PASSER_CLEAR, OTHER_CLEAR), Stage.PRE_APPROACH, makes_room=True)
    assert passer is REST and is_at(before, OTHER_CLEAR)


@pytest.mark.parametrize("approach", ["staged", "straight"])
def test_straight_approach_does_not_wait_for_who_is_beside_a_stand_off_that_it_does_not_go_to(approach: str) -> None:
    """It used to wait for that body before it had set off, until it timed out."""
    mine = dock(DockRequest(1, 3, 0, 2), OTHER_CLEAR, Stage.PRE_APPROACH)
    places = [(0.0, 0.0), (-0.8, 0.3), (0.25, 0.5)]
    estimates = {m: (BODIES[m], estimate(np.array([*place, 0.0]))) for m, place in enumerate(places)}
    waits = Traffic([mine], estimates, [], Docking(approach=approach)).wait(mine)
    assert (waits is None) == (approach == "straight")
