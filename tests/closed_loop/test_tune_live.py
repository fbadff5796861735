"""tune_gains --live against a robot flying in its tank: one confirmed step at a time, and the old values restored whatever happens.

The bench flies while the tuner waits, so both use the bench's clock.
"""

import io
import math
import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from firmware_py.app.ground_station import GroundSide
from firmware_py.app.lockstep import Lockstep, drain, send
from firmware_py.core.types import Action, Mode, Request
from firmware_py.description.parameters import Parameters
from firmware_py.description.schema import DescriptionError
from firmware_py.ground.config import GroundConfig
from hil.bench import open_bench
from hil.scenario import load_scenario
from tests.clients.bench_process import free_port
from tests.unit.campaigns import Inline

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil

SECONDS = 2.0
"""Duration of a look: an event a second after its begin is in the next heartbeat, which is still within the look."""
SHIPPED = Parameters().control
BANDWIDTH = SHIPPED.position_bandwidth
UP, DOWN = (float(str(np.float32(value))) for value in (1.25 * BANDWIDTH, BANDWIDTH / 1.25))  # as MAVLink carries them
OLD = f"POS_BW {BANDWIDTH:g}, POS_DAMP {SHIPPED.position_damping:g}"
OBJECTIVE = """
help = "place alone"
flight = [{ scenario = "hover" }]
seeds = [0]
unseen_seeds = [1]
search = [
    { parameter = "control.position_bandwidth", low = 0.5, high = 8.0 },
    { parameter = "control.position_damping", low = 0.3, high = 3.0 },
]
term = [{ metric = "position_rmse_m", per = 0.001 }, { metric = "thrust_rms_n", per = 1.0 }]
"""


class Robot:
    """A bench with a ground station, and pymavlink's end of its link. The bench flies while a message is awaited."""

    def __init__(self, stack: ExitStack) -> None:
        port = free_port()
        address = f"udpin:127.0.0.1:{port}"
        self._mavlink = stack.enter_context(closing(mavutil.mavlink_connection(address, dialect="all", source_system=255)))
        self._bench = open_bench(stack, load_scenario("hover"), 0, Parameters(), "virtual:live")
        config = GroundConfig(links=(f"udpout:127.0.0.1:{port}",))
        self._side = GroundSide(config, self._bench.firmware, Inline())
        stack.callback(self._side.close)
        self._lockstep = Lockstep(self._bench.firmware, [self._bench.firmware_port], [self._side.observe, lambda *_: self._side.pump()])
        self._sent: list[Any] = []
        self.tick = 0
        self._events: deque[tuple[int, Request | BaseException]] = deque()
        """Requests by others and exceptions in the tuner, each with its tick."""
        self.silent_until_s = 0.0
        """Time until which the link is cut in both directions."""
        self._events += [(200, Request(Action.ARM)), (300, Request(Action.SET_MODE, 0, Mode.POSHOLD))]
        self.wait(5.0)

    @property
    def mav(self) -> Any:
        return Mock() if self.is_silent else self._mavlink.mav

    @property
    def is_silent(self) -> bool:
        return self.clock() < self.silent_until_s

    @property
    def target_system(self) -> int:
        return int(self._mavlink.target_system)

    @property
    def control(self) -> Any:
        """The gains in use."""
        return self._bench.firmware.pipeline.parameters.control

    def clock(self) -> float:
        return 0.01 * self.tick

    def recv_match(self, *, blocking: bool, timeout: float | None = None) -> Any:
        end = self.clock() + (timeout or 0.0)
        while (message := self._mavlink.recv_match(blocking=False)) is None and blocking and self.clock() < end:
            self._fly()
        return None if self.is_silent else message

    def close(self) -> None:
        pass

    def wait(self, seconds: float) -> None:
        """Flies on and discards all messages."""
        for _ in range(round(100 * seconds)):
            self._fly()
            while self._mavlink.recv_match(blocking=False) is not None:
                pass

    def soon(self, event: Request | BaseException) -> None:
        """Schedules an event for a second from now."""
        self._events.append((self.tick + 100, event))

    def _fly(self) -> None:
        self.tick += 1
        bench, time_ns, asked = self._bench, self.tick * self._bench.firmware.fleet.period_ns, self._side.requests()
        self._sent += self._lockstep.start_tick(self.tick, time_ns)
        heard = drain([bench.plant_port], self._sent)
        answers = send([bench.plant_port], [(0, frame) for frame in bench.nodes.step([frame for _, frame in heard])])
        while self._events and self._events[0][0] <= self.tick:
            event = self._events.popleft()[1]
            if isinstance(event, BaseException):
                self._sent = self._lockstep.finish_tick(self.tick, time_ns, asked, answers)[1]
                raise event
            asked.append(event)
        self._sent = self._lockstep.finish_tick(self.tick, time_ns, asked, answers)[1]
        assert self._side.error is None


class Scripted:
    """A person who gives the scripted answers, and calls `then` at the last question."""

    def __init__(self, *answers: str, then: Callable[[], None] = lambda: None) -> None:
        self._answers, self._then = list(answers), then
        self.questions: list[str] = []

    def answer(self, question: str) -> str:
        self.questions.append(question)
        if len(self._answers) == 1:
            self._then()
        return self._answers.pop(0)


class ClosedOutput(io.TextIOBase):
    """An output whose reader is gone."""

    def write(self, text: str) -> int:
        raise BrokenPipeError


class PlugError(Exception):
    """The tuner's computer lost power."""


@pytest.fixture
def live(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module tune_live, with a shorter settling time."""
    import tune_live
    import tune_vehicle

    monkeypatch.setattr(tune_vehicle, "SETTLE_S", 0.5)
    return tune_live


@pytest.fixture(scope="module")
def hovering() -> Iterator[Robot]:
    with ExitStack() as stack:
        yield Robot(stack)


@pytest.fixture
def robot(hovering: Robot) -> Iterator[Robot]:
    """The hovering robot. Asserts that it has the shipped gains before and after the test."""
    assert hovering.control == SHIPPED
    yield hovering
    hovering.wait(0.1)  # new values apply from the next tick on
    assert hovering.control == SHIPPED


@pytest.fixture
def tuned(live: Any, robot: Robot, tmp_path: Path) -> Callable[..., int]:
    """tuned(person, text): runs a session with this person and objective; returns its exit status."""
    import tune_objective

    def run(person: Scripted, text: str = OBJECTIVE) -> int:
        path = tmp_path / "objective.toml"
        path.write_text(text)
        objective = tune_objective.load_objective(path)
        return int(live.tune(objective, live.Vehicle(robot, robot.clock, robot.wait), person, 10, SECONDS, tmp_path))

    return run


@pytest.mark.slow
def test_step_is_taken_when_it_is_confirmed_and_goes_when_nothing_is_kept(tuned: Callable[..., int]) -> None:
    person = Scripted("n", "y", "q", "n")
    assert tuned(person) == 0
    assert person.questions[:2] == [f"step {k}: POS_BW {BANDWIDTH:g} -> {v:g}? [y/n/q]" for k, v in ((1, UP), (2, DOWN))]
    assert person.questions[-1].startswith("keep POS_BW ")


@pytest.mark.slow
def test_what_makes_the_hover_stiller_stays_and_the_rest_goes_back_at_once(
    live: Any, robot: Robot, tuned: Callable[..., int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pretends that softer gains give a stiller hover."""

    def look(vehicle: Any, seconds: float) -> dict[str, float]:
        robot.wait(0.1)
        return {"position_rmse_m": 0.001 * robot.control.position_bandwidth}

    monkeypatch.setattr(live.Vehicle, "measure_hover", look)
    flown: list[float] = []

    class Watching(Scripted):
        def answer(self, question: str) -> str:
            robot.wait(0.1)
            flown.append(robot.control.position_bandwidth)
            return super().answer(question)

    assert tuned(Watching("y", "y", "q", "y")) == 0
    assert flown == [BANDWIDTH, BANDWIDTH, DOWN, DOWN] and robot.control.position_bandwidth == DOWN
    live.Vehicle(robot, robot.clock).set("POS_BW", BANDWIDTH)


TROUBLES: dict[str, tuple[Request | BaseException, str, list[Request]]] = {
    "interrupt": (KeyboardInterrupt(), "interrupted", []),
    "link that broke": (OSError("no such device"), "no such device", []),
    "another mode": (Request(Action.SET_MODE, 0, Mode.ALT_HOLD), "mode changed", [Request(Action.SET_MODE, 0, Mode.POSHOLD)]),
    "disarmed": (
        Request(Action.DISARM, 0, True), "is stopped, or disarmed", [Request(Action.ARM), Request(Action.SET_MODE, 0, Mode.POSHOLD)],
    ),
}  # fmt: skip
"""An event in the middle of a step, the words printed about it, and the requests that make the robot hover again."""


@pytest.mark.slow
@pytest.mark.parametrize("name", TROUBLES)
def test_old_values_are_back_after(name: str, live: Any, robot: Robot, tuned: Callable[..., int], tmp_path: Path, capsys: Any) -> None:
    event, words, cure = TROUBLES[name]
    assert tuned(Scripted("y", then=lambda: robot.soon(event))) == 1
    said = capsys.readouterr().out
    assert words in said and f"old values are back: {OLD}" in said
    assert not (tmp_path / live.BEFORE_FILE).exists()
    for request in cure:
        robot.soon(request)
        robot.wait(2.0)


@pytest.mark.slow
def test_link_that_breaks_again_while_the_old_values_go_back_is_tried_again(robot: Robot, tuned: Callable[..., int], capsys: Any) -> None:
    def cut() -> None:
        for _ in range(2):
            robot.soon(OSError("no such device"))

    assert tuned(Scripted("y", then=cut)) == 1
    assert f"old values are back: {OLD}" in capsys.readouterr().out


@pytest.mark.slow
def test_error_that_nobody_foresaw_puts_the_old_values_back_before_it_is_seen(robot: Robot, tuned: Callable[..., int], capsys: Any) -> None:
    with pytest.raises(ZeroDivisionError):
        tuned(Scripted("y", then=lambda: robot.soon(ZeroDivisionError())))
    assert f"old values are back: {OLD}" in capsys.readouterr().out


@pytest.mark.slow
def test_output_that_nobody_reads_any_more_puts_the_old_values_back(
    tuned: Callable[..., int], capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert tuned(Scripted("y", then=lambda: monkeypatch.setattr(sys, "stdout", ClosedOutput()))) == 1
    assert f"old values are back: {OLD}" in capsys.readouterr().err


@pytest.fixture
def signals(live: Any) -> Iterator[tuple[signal.Signals, ...]]:
    """The signals that end the tuning; they raise KeyboardInterrupt, and their handlers are restored afterwards."""
    wanted = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, signal.default_int_handler) for number in wanted}
    yield wanted
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("first", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_terminal_that_is_closed_interrupts_once(
    first: str, live: Any, signals: tuple[signal.Signals, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shell passes the signal on to its children once more."""

    def tune(*_: object) -> None:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.Signals[first])
        assert {signal.getsignal(number) for number in signals} == {signal.SIG_IGN}

    for name, stand_in in (("connect", Mock()), ("Vehicle", Mock()), ("tune", tune)):
        monkeypatch.setattr(live, name, stand_in)
    live.tune_live(None, "mavlink:udpin:nowhere", 1, SECONDS, tmp_path)


@pytest.mark.slow
def test_signals_do_not_come_between_the_vehicle_and_its_old_values(
    live: Any, robot: Robot, tuned: Callable[..., int], signals: tuple[signal.Signals, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    put_back, meanwhile = live.put_back, set[Any]()

    def watched(*arguments: Any) -> None:
        meanwhile.update(map(signal.getsignal, signals))
        put_back(*arguments)

    monkeypatch.setattr(live, "put_back", watched)
    assert tuned(Scripted("y", then=lambda: robot.soon(KeyboardInterrupt()))) == 1
    assert meanwhile == {signal.SIG_IGN}
    assert {signal.getsignal(number) for number in signals} == {signal.default_int_handler}


def test_byte_that_is_no_letter_is_no_yes(live: Any) -> None:
    mine, end = os.pipe()
    os.write(end, b"\xff\n")
    os.close(end)
    with open(mine, "rb", buffering=0) as stream:
        assert live.Typist(None, stream).answer("?") not in ("y", "q")


@pytest.mark.slow
def test_tuner_that_was_killed_puts_the_old_values_back_when_it_is_started_again(
    live: Any, robot: Robot, tuned: Callable[..., int], capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as killed, pytest.raises(PlugError):
        killed.setattr(live, "put_back", Mock(side_effect=PlugError))
        tuned(Scripted("y", then=lambda: robot.soon(PlugError())))
    assert robot.control.position_bandwidth == UP
    assert tuned(Scripted("q", "n")) == 0
    assert "is of a run that did not end: its values go back first" in capsys.readouterr().out


@pytest.mark.slow
def test_vehicle_that_fell_silent_is_to_be_set_by_hand_or_by_the_next_start(robot: Robot, tuned: Callable[..., int]) -> None:
    """The tuner keeps trying for a minute."""

    def cut() -> None:
        robot.silent_until_s = math.inf

    began_s = robot.clock()
    with pytest.raises(DescriptionError, match=f"did not take {OLD}; set them by hand, or start again"):
        tuned(Scripted("y", then=cut))
    assert 60.0 < robot.clock() - began_s < 90.0
    robot.silent_until_s = 0.0
    assert tuned(Scripted("q", "n")) == 0


@pytest.mark.slow
def test_vehicle_that_is_heard_again_within_a_minute_gets_its_old_values(
    live: Any, robot: Robot, tuned: Callable[..., int], tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The link is cut during the look, which ends after 5 s of silence."""
    look = live.Vehicle.measure_hover

    def cut(vehicle: Any, seconds: float) -> Any:
        robot.wait(0.1)
        if robot.control != SHIPPED:
            robot.silent_until_s = robot.clock() + 40.0
        return look(vehicle, seconds)

    monkeypatch.setattr(live.Vehicle, "measure_hover", cut)
    assert tuned(Scripted("y")) == 1
    said = capsys.readouterr().out
    assert "has been silent for 5 s" in said and f"old values are back: {OLD}" in said
    assert not (tmp_path / live.BEFORE_FILE).exists()


def test_objective_that_telemetry_does_not_show_is_refused(tuned: Callable[..., int]) -> None:
    with pytest.raises(DescriptionError, match="has no term that can be seen from outside"):
        tuned(Scripted(), OBJECTIVE.replace("position_rmse_m", "supply_power_w"))


@pytest.mark.slow
def test_e_stop_puts_the_old_values_back(robot: Robot, tuned: Callable[..., int], capsys: Any) -> None:
    """Must be the last test, because it leaves the robot stopped."""
    assert tuned(Scripted("y", then=lambda: robot.soon(Request(Action.ESTOP)))) == 1
    assert "the vehicle" in capsys.readouterr().out
    with pytest.raises(DescriptionError, match="let it hover, armed, before it is tuned"):
        tuned(Scripted())
