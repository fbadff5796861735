"""Whether a module hears its commands, tick by tick."""

import pytest

from firmware_py.core.command_watch import START_NS, CommandWatch
from firmware_py.core.types import COMMAND_TIMEOUT_NS, MCU_TIMED_OUT, MCU_UNFIT, ModuleInputs
from tests.unit.tanks import MODCUBE

PERIOD_NS = 20_000_000
STOPPED_AFTER, START_TICKS = COMMAND_TIMEOUT_NS // PERIOD_NS, START_NS // PERIOD_NS
WELL, TIMED_OUT, SILENT = ModuleInputs(mcu_state=1, heard=True), ModuleInputs(mcu_state=MCU_TIMED_OUT, heard=True), ModuleInputs()


def watched(*modules: ModuleInputs, period_ns: int = PERIOD_NS) -> CommandWatch:
    watch = CommandWatch(period_ns)
    for module in modules:
        watch.step(module)
    return watch


def ticks_until_well(watch: CommandWatch, of_deaf: bool) -> int:
    """In how many further ticks, in which the module is well, it counts as deaf or as stopped."""
    ticks = 0
    while watch.deaf if of_deaf else watch.stopped:
        watch.step(WELL)
        ticks += 1
    return ticks


def test_module_that_hears_its_commands_is_neither_deaf_nor_stopped() -> None:
    new, old = watched(), watched(*[WELL] * 500)
    assert not (new.deaf or new.stopped or old.deaf or old.stopped)
    assert watched(TIMED_OUT).deaf and watched(TIMED_OUT).stopped, "nor does what is past make it well"
    assert watched(*[WELL] * 500, TIMED_OUT).deaf and watched(*[WELL] * 500, TIMED_OUT).stopped


@pytest.mark.parametrize("state", MCU_UNFIT)
def test_module_that_starts_hears_no_commands_or_has_a_fault_stops_its_thrusters(state: int) -> None:
    watch = watched(*[WELL] * 500, ModuleInputs(mcu_state=state, heard=True))
    assert watch.deaf and watch.stopped


@pytest.mark.parametrize("state", [None, 1, 2, 4])
def test_other_states_are_no_want_of_commands(state: int | None) -> None:
    watch = watched(ModuleInputs(mcu_state=state, heard=True))
    assert not watch.deaf and not watch.stopped


@pytest.mark.parametrize("of_deaf", [True, False])
def test_module_that_hears_again_counts_as_before_until_its_propellers_have_started(of_deaf: bool) -> None:
    assert ticks_until_well(watched(TIMED_OUT), of_deaf) == START_TICKS
    assert ticks_until_well(watched(TIMED_OUT, *[WELL] * 4, TIMED_OUT), of_deaf) == START_TICKS, "anew from the last report"


@pytest.mark.parametrize(("silent", "stopped"), [(STOPPED_AFTER - 1, False), (STOPPED_AFTER, True), (STOPPED_AFTER + 1, True)])
def test_module_that_was_silent_for_the_time_out_may_have_stopped_but_is_not_deaf(silent: int, stopped: bool) -> None:
    quiet = watched(WELL, *[SILENT] * silent)
    assert not quiet.deaf and not quiet.stopped, "it is heard no more: who is silent is another's affair"
    back = watched(WELL, *[SILENT] * silent, WELL)
    assert not back.deaf and back.stopped == stopped
    assert ticks_until_well(back, of_deaf=False) == stopped * START_TICKS


def test_silence_counts_without_a_break() -> None:
    assert not watched(*[SILENT] * (STOPPED_AFTER - 1), WELL).stopped, "from the first tick"
    assert not watched(*[*[SILENT] * (STOPPED_AFTER - 1), WELL] * 9).stopped


def test_propellers_have_nearly_four_lags_to_start() -> None:
    assert START_NS == 300_000_000
    assert 3.5 <= START_NS / (MODCUBE.curve.lag_s * 1e9) <= 4.0


def test_ticks_longer_than_its_times_count_once() -> None:
    assert watched(TIMED_OUT, period_ns=2 * START_NS).deaf
    assert watched(SILENT, WELL, period_ns=2 * START_NS).stopped
    assert not watched(WELL, WELL, period_ns=2 * START_NS).stopped
    assert ticks_until_well(watched(TIMED_OUT, period_ns=2 * START_NS), of_deaf=False) == 1
