"""What a body hands on to its parts when it splits: faults, gains, plans, and the accounts of its magnets."""

import numpy as np
import pytest

from firmware_py.core.transitions import State
from firmware_py.core.types import Action, DockRequest, Mode, Request
from firmware_py.description.parameters import Parameters
from tests.unit.tanks import RING, FaultyTank


@pytest.mark.slow
def test_parts_of_a_broken_body_are_as_broken_as_it_was() -> None:
    """A thruster is dead, a cabin's pressure has risen and the ground station is silent when the joint opens."""
    tank = FaultyTank(RING[:2])
    tank.run(0.5)
    tank.run(1.0, Request(Action.GROUND_ALIVE), Request(Action.ARM))
    whole = tank.pipeline.formation.pipelines[0]
    whole.faults._lose(3, "stands still")
    whole.allocator.set_alive(whole.faults.now.alive)
    tank.cabin_pa[0] = 130e3
    tank.run(2.5)
    tank.lose(1)
    tank.run(1.0)
    assert tank.shape == [(0,), (1,)]
    hurt, sound = tank.pipeline.formation.pipelines
    assert hurt.faults.now.dead == (3,) and sound.faults.now.dead == ()
    assert hurt.health.now.cabin_change_pa == 130e3 - 101_325.0 and sound.health.now.cabin_change_pa == 0.0
    assert all(pipeline.supervisor.is_on("cabin_pressure") and pipeline.supervisor.mode == Mode.SURFACE for pipeline in (hurt, sound))
    assert tank.outputs[-1].modules[0].thrusters[3] == 0.0 and hurt.supervisor.is_on("thruster_lost")
    assert hurt.health.now.ground_age_s == sound.health.now.ground_age_s == pytest.approx(4.49, abs=0.02)
    tank.run(0.1, Request(Action.DISARM, 0))
    assert tank.run(0.1, Request(Action.ARM, 0)).records[0].state == State.DISARMED, "a hull that fails flies no more"


@pytest.mark.slow
def test_body_that_was_prepared_with_other_gains_flies_with_those_of_now() -> None:
    tank = FaultyTank(RING[:2], delay=30)
    tank.fly()
    tank.lose(1)
    while not tank._plans:
        tank.run(0.01)
    tank.run(0.05, Request(Action.SET_PARAMETER, 0, ("control.position_bandwidth", 1.5)))
    tank.run(0.6)
    assert tank.shape == [(0,), (1,)]
    assert all(pipeline.parameters.control.position_bandwidth == 1.5 for pipeline in tank.pipeline.formation.pipelines)


@pytest.mark.slow
def test_magnets_of_a_joint_rest_when_their_account_is_empty_and_take_power_while_they_pull() -> None:
    parameters = Parameters().replace("limiter.relay_on_s", 2.0).replace("limiter.relay_duty", 0.25)
    tank = FaultyTank(RING[:2], parameters)
    tank.run(1.0)
    assert [magnets.power_w for magnets in tank.pipeline.formation.pipelines[0].limiter.magnets] == [6.0, 6.0]
    tank.run(3.0)
    sent = [(tick, outputs.modules[0].relays) for tick, outputs in enumerate(tank.outputs) if outputs.modules[0].relays is not None]
    pulling = {tick for tick, states in sent if any(states)}
    resting = sorted({tick for tick, states in sent if not any(states)})
    assert resting and resting[0] == pytest.approx(2.0 / 0.75 / 0.01, abs=2), "sent at once, not with the next tenth of a second"
    assert not pulling & set(resting) and tank.pipeline.formation.pipelines[0].limiter.magnets[0].power_w == 0.0


@pytest.mark.slow
def test_parted_modules_magnets_keep_their_accounts() -> None:
    tank = FaultyTank(RING[:2], Parameters().replace("limiter.relay_on_s", 60.0).replace("limiter.relay_duty", 0.01))
    tank.fly()
    before = [list(magnets._left_s) for magnets in tank.pipeline.formation.pipelines[0].limiter.magnets]
    tank.lose(1)
    tank.run(1.0)
    after = [list(pipeline.limiter.magnets[0]._left_s) for pipeline in tank.pipeline.formation.pipelines]
    assert min(before[0]) < 59.0 and min(after[0]) < min(before[0]) and min(after[1]) < min(before[1])


@pytest.mark.slow
def test_joint_that_holds_for_a_moment_and_is_lost_again_is_parted_by_another_plan() -> None:
    """The first plan arrives while no joint is open, and is dropped."""
    tank = FaultyTank(RING[:2], delay=60)
    tank.fly()
    tank.lose(1)
    while not tank._plans:
        tank.run(0.01)
    tank.without_current.clear()
    tank.hidden.clear()
    tank.run(3.0)
    assert tank.shape == [(0, 1)]
    tank.lose(1)
    tank.run(2.0)
    assert tank.shape == [(0,), (1,)]


@pytest.mark.slow
def test_disarming_a_body_in_the_tick_in_which_it_parts_reaches_both_pieces() -> None:
    tank = FaultyTank(RING[:2])
    tank.fly()
    tank.run(0.01, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    while tank.shape == [(0, 1)]:
        (undock,) = tank.pipeline.formation.docking._undocks or [None]
        parts = undock is not None and len(tank.outputs) * 10_000_000 >= undock.until_ns
        outputs = tank.run(0.01, *([Request(Action.DISARM, 0)] if parts else []))
    assert tank.shape == [(0,), (1,)]
    assert [record.state for record in outputs.records] == [State.DISARMED] * 2
    assert not np.any([module.thrusters for module in outputs.modules])


@pytest.mark.slow
@pytest.mark.parametrize(("after_s", "reaches"), [(0.01, 2), (4.9, 2), (5.1, 1)])
def test_disarming_a_body_that_has_broken_apart_reaches_all_its_pieces_for_five_seconds(after_s: float, reaches: int) -> None:
    tank = FaultyTank(RING[:2])
    tank.fly()
    tank.lose(1)
    while tank.shape == [(0, 1)]:
        tank.run(0.01)
    tank.hidden = set()
    tank.run(after_s - 0.01)
    states = [record.state for record in tank.run(0.01, Request(Action.DISARM, 0)).records]
    assert states == [State.DISARMED, State.DISARMED if reaches == 2 else State.ARMED]


@pytest.mark.slow
def test_disarming_a_piece_that_was_undocked_on_request_leaves_the_other_one_armed() -> None:
    tank = FaultyTank(RING[:2])
    tank.fly()
    tank.run(0.01, Request(Action.UNDOCK, 0, DockRequest(1, 1, 0, 0)))
    while tank.shape == [(0, 1)]:
        tank.run(0.01)
    tank.run(0.1)
    states = [record.state for record in tank.run(0.01, Request(Action.DISARM, 0)).records]
    assert states == [State.DISARMED, State.ARMED]
