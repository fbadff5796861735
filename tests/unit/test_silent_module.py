"""Thrusters of a silent module: excluded where the others can replace them, and used again once the module is heard."""

import numpy as np
import pytest

from firmware_py.core.faults import FaultDetector
from firmware_py.core.preload import preload
from firmware_py.core.types import CHANNELS, MCU_TIMED_OUT, MCU_UNFIT, EscFeedback, Estimate, Measured, ModuleInputs
from firmware_py.description.failsafe_parameters import Faults
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble
from tests.unit.robot_in_water import Water

TICK_NS, DT = 10_000_000, 0.01
ZERO = np.zeros(3)
AT_REST = Estimate(ZERO, np.eye(1, 4)[0], np.zeros(6), ZERO, ZERO, ZERO, ZERO, 0, 1.0, 6, 0, True)
ARMED = 2
"""MCU_STATUS state."""


class DetectorRig:
    """Docked modules, two by default, of which a fault detector hears some."""

    def __init__(self, count: int = 2) -> None:
        cube = load_vehicle("modcube")
        self.body = assemble([(n, 0, 0) for n in range(count)], [0] * count, [cube] * count, list(range(count)))
        self.detector = FaultDetector(self.body, Faults(), TICK_NS)

    def run(self, seconds: float, *heard: int, armed: bool = True, deaf: int | None = None, force_n: float = 0.0) -> list[str]:
        """Runs the detector with only the modules `heard` answering, and `deaf` saying that it hears no commands; returns its messages.

        All propellers stand still, although they are to push with `force_n`.
        """
        said, n = [], self.body.thrusters.f_max.size
        modules = [ModuleInputs(heard=m in heard, mcu_state=MCU_TIMED_OUT if m == deaf else None) for m in range(len(self.body.modules))]
        for module in modules:
            module.esc = [EscFeedback(first, (0.0, 0.0), (0.0, 0.0), (0, 0)) for first in range(0, 8, 2)] if force_n else []
        for _ in range(round(seconds / DT)):
            self.detector.step(modules, Measured(None, None, None, []), AT_REST, np.full(n, force_n), np.full(n, force_n), armed, True)
            assert self.detector.changed == any(word in words for words in self.detector.words for word in ("left out", "again", "blindly"))
            said += self.detector.words
        return said

    @property
    def used(self) -> set[int]:
        """Modules whose thrusters are all in use."""
        alive, module = self.detector.now.alive, self.body.thrusters.module
        return {m for m in range(len(self.body.modules)) if alive[module == m].all()}


def test_thrusters_of_a_module_that_falls_silent_are_left_out_until_it_is_heard_again() -> None:
    rig = DetectorRig()
    assert rig.run(1.0, 0, 1) == [] == rig.run(0.49, 0)
    assert rig.run(0.5, 0) == ["thrusters of silent module 2 are left out"]
    assert rig.used == {0} and (rig.detector.now.lost_axes, rig.detector.now.dead) == (0, ()), "nothing was found about them"
    rig.detector._lose(3, "stands still")
    assert rig.run(0.49, 0, 1) == [] and rig.run(0.02, 0, 1) == ["thrusters of every module are used again"]
    assert rig.detector.now.dead == (3,) and rig.used == {1}, "what was found meanwhile stays found"


def test_module_that_is_heard_now_and_then_is_left_out_once() -> None:
    rig = DetectorRig()
    said = [words for _ in range(5) for words in rig.run(0.55, 0) + rig.run(0.05, 0, 1)]
    assert said == ["thrusters of silent module 2 are left out"]
    assert rig.used == {0}


def test_module_that_falls_silent_after_all_others_is_used_blindly_and_that_is_said() -> None:
    """Regression: it was said that the thrusters of every module were used again, as when the silent ones are heard."""
    rig = DetectorRig()
    assert rig.run(1.0, 0) == ["thrusters of silent module 2 are left out"]
    assert rig.run(1.0) == ["thrusters of silent module 1, 2 are used blindly: the others cannot make every wrench"]
    assert rig.used == {0, 1}
    assert rig.run(1.0, 0) == ["thrusters of silent module 2 are left out"] and rig.used == {0}


def test_thrusters_that_no_others_can_stand_in_for_are_used_blindly() -> None:
    """The bus may be broken in one direction only; if it is broken in both, the modules stop by themselves, and a fail-safe disarms."""
    for rig, heard in ((DetectorRig(1), ()), (DetectorRig(2), ())):
        assert rig.run(1.0, *heard) == [] and rig.detector.now.dead == ()


def test_silence_of_a_disarmed_body_leaves_nothing_out_and_what_was_left_out_is_back_when_it_disarms() -> None:
    rig = DetectorRig()
    assert rig.run(1.0, 0, armed=False) == []
    assert rig.run(0.02, 0) == ["thrusters of silent module 2 are left out"]
    rig.detector.reset()
    assert rig.detector.changed and rig.used == {0, 1}


def test_module_that_was_left_out_is_used_again_once_its_body_is_disarmed() -> None:
    rig, other = DetectorRig(), DetectorRig()
    rig.run(1.0, 0)
    other.detector.take_over([rig.detector])
    assert other.used == {0}
    other.run(0.01, 0, armed=False)
    assert other.used == {0, 1}


def test_body_that_is_made_of_others_leaves_out_the_modules_that_were_silent_in_them() -> None:
    three, rig = DetectorRig(3), DetectorRig(2)
    three.run(1.0, 0, 2)
    rig.detector.take_over([three.detector])
    assert rig.used == {0} and rig.run(0.1, 0) == []


def test_thrusters_that_stand_still_because_their_module_hears_no_commands_are_not_found_faulty() -> None:
    rig = DetectorRig(1)
    assert rig.run(1.0, 0, deaf=0, force_n=2.0) == ["module 1 obeys no commands: its thrusters stop"]
    assert rig.run(0.25, 0, force_n=2.0) == [], "its propellers may still be starting"
    assert rig.used == {0}
    assert rig.run(0.2, 0, force_n=2.0)[0] == "thruster 1 of module 1 stands still: left out"


def test_thrusters_of_a_module_that_hears_no_commands_are_left_out_until_it_does() -> None:
    rig = DetectorRig()
    said = rig.run(1.0, 0, 1, deaf=1)
    assert said == ["module 2 obeys no commands: its thrusters stop", "thrusters of silent module 2 are left out"]
    assert rig.used == {0}
    assert rig.run(1.0, 0, 1) == ["thrusters of every module are used again"] and rig.used == {0, 1}


@pytest.mark.parametrize("is_deaf_first", [True, False])
def test_thrusters_of_a_module_that_hears_no_commands_are_not_counted_on_though_the_others_cannot_make_every_wrench(
    is_deaf_first: bool,
) -> None:
    """They stand still: what they were asked for in vain used to be taken for a push, against which they were asked for ever more."""
    rig = DetectorRig()
    for is_deaf in (is_deaf_first, not is_deaf_first):
        if is_deaf:
            assert rig.run(1.0, 0, 1, deaf=1)[-1] == "thrusters of silent module 2 are left out"
        else:
            rig.detector._lose(2, "stands still")
            rig.detector._lose(3, "stands still")
    now, module = rig.detector.now, rig.body.thrusters.module
    assert not now.alive[module == 1].any() and now.alive[module == 0].sum() == 6
    assert (now.dead, now.lost_axes) == ((2, 3), 1)
    assert rig.run(1.0, 0, 1) == ["thrusters of every module are used again"] and rig.detector.now.lost_axes == 0


def test_silent_module_that_is_used_blindly_is_left_out_once_it_says_that_it_hears_no_commands() -> None:
    """As one does whose MCU has restarted. It stays left out when it falls silent again: nothing tells that it hears."""
    rig, other = DetectorRig(), DetectorRig()
    rig.detector._lose(2, "stands still")
    rig.detector._lose(3, "stands still")
    assert rig.run(1.0, 0) == [] and rig.used == {1}
    assert rig.run(0.1, 0, 1, deaf=1) == ["module 2 obeys no commands: its thrusters stop", "thrusters of silent module 2 are left out"]
    assert rig.run(1.0, 0) == [] and rig.used == set()
    other.detector.take_over([rig.detector])
    assert other.used == set(), "a body that is made of it knows as much"
    assert rig.run(1.0, 0, 1) == ["thrusters of every module are used again"] and rig.used == {1}


def test_module_whose_thrusters_are_left_out_is_named_apart_from_one_whose_are_used_blindly() -> None:
    """Of two that are both to be left out, what the deaf one is asked for is lost for certain, and the silent one may still hear."""
    rig = DetectorRig()
    assert rig.run(1.0, 1, deaf=1)[-2:] == [
        "thrusters of silent module 2 are left out",
        "thrusters of silent module 1 are used blindly: the others cannot make every wrench",
    ]
    assert rig.used == {0}


def test_liar_in_another_module_is_found_while_a_module_that_hears_no_commands_is_left_out() -> None:
    body = DetectorRig().body
    water = Water(body=body)
    water.run(3.0, preload(body.thrusters, np.ones(16, dtype=bool), 0.6))
    water.deaf, water.gain[8:], water.speed_factor[8:] = 1, 0.0, 0.0
    rest = preload(body.thrusters, body.thrusters.module == 0, 0.6)
    water.run(4.0, rest)
    water.gain[2] = 0.0
    found = water.run(2.0, rest)
    assert [words for _, words in found] == ["thruster 3 of module 1 does not push as it says: left out"]


class PushingRig(DetectorRig):
    """One module whose thrusters push; it reports ten times a second that they turn as they should, or that they stand still."""

    def __init__(self) -> None:
        super().__init__(1)
        self.force_n = np.full(self.body.thrusters.f_max.size, 2.0)
        self.tick = 0

    def hear(self, seconds: float, turns: bool, reports: int = 1, mcu_state: int = ARMED) -> list[str]:
        """Runs the detector, with so many reports of each ESC every tenth of a second; returns its messages."""
        said: list[str] = []
        for _ in range(round(seconds / DT)):
            self.tick += 1
            due = range(0, CHANNELS, 2) if self.tick % 10 == 0 else ()
            esc = [self._report(first, turns) for first in due for _ in range(reports)]
            module = ModuleInputs(heard=True, mcu_state=mcu_state, esc=esc)
            self.detector.step([module], Measured(None, None, None, []), AT_REST, self.force_n, self.force_n, True, True)
            said += self.detector.words
        return said

    def _report(self, first: int, turns: bool) -> EscFeedback:
        a, b = (self.detector.believed_rpm(i, self.force_n[i]) if turns else 0.0 for i in (first, first + 1))
        return EscFeedback(first, (a, b), (0.5, 0.5), (0, 0))


def test_thrusters_that_a_module_stopped_while_its_bus_was_interrupted_are_not_found_dead() -> None:
    """Regression: a bus that was held up for 0.3 s kept commands and answers and delivered them in a burst: all answers of propellers that
    stood still, as a module stops them after 0.1 s without commands. Eight healthy thrusters were left out for the rest of the flight."""
    rig = PushingRig()
    assert rig.hear(1.0, turns=True) == [] == rig.run(0.3)
    assert rig.hear(0.1, turns=False, reports=3) == [] == rig.hear(0.2, turns=False) == rig.hear(1.0, turns=True)
    assert rig.used == {0}


def test_thrusters_that_a_module_stopped_while_this_process_was_held_up_are_not_found_dead() -> None:
    """The module was not silent, as far as this process knows, but it says that it missed commands."""
    rig = PushingRig()
    assert rig.hear(1.0, turns=True) == [] == rig.hear(DT, turns=False, mcu_state=MCU_TIMED_OUT)
    assert rig.hear(0.3, turns=False) == [] == rig.hear(1.0, turns=True)


@pytest.mark.parametrize("state", MCU_UNFIT)
def test_thrusters_of_a_module_that_says_that_it_obeys_no_commands_are_not_found_dead(state: int) -> None:
    """Regression: a microcontroller that restarted in flight, and reported from its start on, lost all its thrusters until disarming."""
    rig = PushingRig()
    assert rig.hear(1.0, turns=True) == []
    assert rig.hear(1.0, turns=False, mcu_state=state) == ["module 1 obeys no commands: its thrusters stop"]
    assert rig.hear(0.2, turns=False) == [] == rig.hear(1.0, turns=True)
    assert rig.used == {0}


def test_thruster_that_stands_still_after_an_interruption_of_the_bus_is_found() -> None:
    rig = PushingRig()
    assert rig.hear(1.0, turns=True) == [] == rig.run(0.3)
    assert "thruster 1 of module 1 stands still: left out" in rig.hear(0.8, turns=False)
