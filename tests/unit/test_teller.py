"""A reader of the vehicle's messages may stall or go away: no tick waits for it, and the process ends in order."""

import os
import subprocess
import sys
import threading
import time

import pytest

from firmware_py.runtime import teller
from firmware_py.runtime.teller import MOST_WAITING_LINES, Teller


class Reader:
    """Sets `reached` when the first line has come; takes lines once `let` is set."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.reached, self.let = threading.Event(), threading.Event()

    def __call__(self, line: str) -> None:
        self.reached.set()
        self.let.wait()
        self.lines.append(line)


def test_lines_are_said_in_order_by_another_thread() -> None:
    lines: list[tuple[str, int]] = []
    said = Teller(lambda line: lines.append((line, threading.get_ident())))
    for number in range(100):
        said.say(str(number))
    said.close()
    assert [line for line, _ in lines] == [str(number) for number in range(100)]
    assert threading.get_ident() not in {thread for _, thread in lines}


def test_reader_that_stalls_holds_nobody_up_and_is_told_how_many_lines_it_missed() -> None:
    reader = Reader()
    said = Teller(reader)
    said.say("first")
    assert reader.reached.wait(10)
    for number in range(MOST_WAITING_LINES + 6):
        said.say(str(number))
    reader.let.set()
    said.close()
    kept = [str(number) for number in range(MOST_WAITING_LINES - 1)]
    assert reader.lines == ["first", *kept, "warning: 7 lines dropped here: they were not read in time"]


def test_count_stands_where_the_lines_are_missing() -> None:
    reader = Reader()
    said = Teller(reader)
    said.say("first")
    assert reader.reached.wait(10)
    for number in range(MOST_WAITING_LINES):
        said.say(str(number))
    again = threading.Event()
    reader.let.set()
    said._queue.put("all read")  # a marker of this test
    said._write = lambda line: again.set() if line == "all read" else reader.lines.append(line)
    assert again.wait(10)
    said.say("later")
    said.close()
    assert reader.lines[-2:] == ["warning: 1 lines dropped here: they were not read in time", "later"]


@pytest.mark.parametrize("error", [BrokenPipeError("closed"), ValueError("I/O operation on closed file")])
def test_reader_that_went_away_ends_the_saying_and_nothing_else(error: Exception) -> None:
    tried: list[str] = []

    def write(line: str) -> None:
        tried.append(line)
        raise error

    said = Teller(write)
    for number in range(3 * MOST_WAITING_LINES):
        said.say(str(number))
    said.close()
    assert tried == ["0"]
    assert said._queue.qsize() <= MOST_WAITING_LINES + 2


def test_end_of_a_run_waits_a_second_at_the_most_for_a_reader_that_stalls(monkeypatch: pytest.MonkeyPatch) -> None:
    assert teller.CLOSE_S <= 1.0
    monkeypatch.setattr(teller, "CLOSE_S", 0.01)
    reader = Reader()
    said = Teller(reader)
    said.say("never read")
    began = time.monotonic()
    said.close()
    assert time.monotonic() - began < 10.0
    reader.let.set()
    said._thread.join()


def test_process_whose_pipe_is_full_ends_in_order() -> None:
    """A thread blocked in Python's own output buffer makes the interpreter abort when it ends."""
    code = (
        "from firmware_py.runtime import teller; teller.CLOSE_S = 0.01; t = teller.Teller()\n"
        "for _ in range(900): t.say('x' * 1000)\n"
        "t.close()"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.wait(timeout=60) == 0
    assert process.communicate()[1] == b""


def test_lines_reach_standard_output(capfd: pytest.CaptureFixture[str]) -> None:
    said = Teller()
    said.say("Tiefe 3 m, Kurs 90°")
    said.close()
    assert capfd.readouterr().out == "Tiefe 3 m, Kurs 90°\n"


def test_name_that_is_no_text_ends_nothing_that_is_said_after_it(capfd: pytest.CaptureFixture[str]) -> None:
    """A folder's name as the operating system returns it; such a line was once the last one said."""
    said, folder = Teller(), os.fsdecode(b"tank-\xe4")
    said.say(f"warning: no log: {folder}: No space left on device")
    said.say("armed")
    said.close()
    assert capfd.readouterr().out == "warning: no log: tank-\\udce4: No space left on device\narmed\n"
