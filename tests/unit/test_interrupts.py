"""Ctrl-C, pressed once and again: where it takes effect, and where it waits."""

import signal
import threading
from collections.abc import Iterator
from contextlib import suppress

import pytest

from firmware_py.runtime.interrupts import interrupted_once, interrupts_deferred, signals_blocked


@pytest.fixture(autouse=True)
def handler() -> Iterator[None]:
    """Installs the default handlers, and restores the previous ones after the test."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler), signal.signal(signal.SIGTERM, signal.SIG_DFL)
    yield
    for number, usual in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
        signal.signal(number, usual)


def press(number: signal.Signals = signal.SIGINT) -> None:
    signal.raise_signal(number)


def test_only_the_first_press_interrupts_and_those_while_it_ends_do_nothing() -> None:
    ended = []
    with pytest.raises(KeyboardInterrupt), interrupted_once():
        try:
            press()
        finally:
            press()
            ended.append("orderly")
    press()
    assert ended == ["orderly"] and signal.getsignal(signal.SIGINT) is signal.SIG_IGN  # a Python handler would be removed before exit


@pytest.mark.parametrize("background", [False, True])
def test_termination_from_elsewhere_is_a_press_that_waits_as_any(background: bool) -> None:
    if background:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell starts background processes
    done = []
    with pytest.raises(KeyboardInterrupt), interrupted_once(), interrupts_deferred() as check:
        press(signal.SIGTERM)
        done.append("the tick")
        check()
        done.append("another")
    press(signal.SIGTERM)
    assert done == ["the tick"]


def test_termination_stays_as_it_was_where_nobody_sent_it() -> None:
    with interrupted_once(), interrupts_deferred():
        pass
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_what_a_library_makes_of_an_interrupt_is_one() -> None:
    """Compiled code that calls Python back raises SystemError: returned a result with an exception set."""
    with pytest.raises(KeyboardInterrupt), interrupted_once():
        try:
            press()
        except KeyboardInterrupt:
            raise SystemError("returned a result with an exception set") from None


def test_interrupt_that_somebody_swallowed_comes_about_at_the_end() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), interrupted_once():
        with suppress(KeyboardInterrupt):
            press()
        done.append("all of it")
    assert done == ["all of it"]


def test_errors_that_nobody_pressed_stay_what_they_are() -> None:
    with pytest.raises(SystemError), interrupted_once():
        raise SystemError
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_press_waits_until_it_is_asked_for() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), interrupts_deferred() as check:
        check()
        press()
        press()
        done.append("the tick")
        check()
        done.append("another")
    assert done == ["the tick"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_press_that_nobody_asked_for_comes_about_at_the_end() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt):
        with interrupts_deferred():
            press()
            done.append("all of it")
        done.append("more")
    assert done == ["all of it"]


def test_press_that_waited_counts_as_the_first() -> None:
    with pytest.raises(KeyboardInterrupt), interrupted_once():
        try:
            with interrupts_deferred() as check:
                press()
                check()
        finally:
            press()


def test_other_threads_and_ignored_interrupts_are_left_alone() -> None:
    failed: list[BaseException] = []

    def elsewhere() -> None:
        try:
            with interrupted_once(), interrupts_deferred() as check:
                check()
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell starts background processes
    with interrupted_once(), interrupts_deferred() as check:
        press()
        check()
    assert failed == [] and signal.getsignal(signal.SIGINT) is signal.SIG_IGN


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_process_that_is_begun_out_of_reach_is_spared_and_this_one_hears_of_it_later(number: signal.Signals) -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), interrupted_once():
        with signals_blocked():
            press(number)
            done.append("begun")
        done.append("more")
    assert done == ["begun"]
