"""The current that a body feels: what push its mean of a second tells."""

import dataclasses
import math

import numpy as np
import pytest

from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.prepare.assembly import assemble
from tests.unit.monitor_bench import BODY, SINGLE, MonitorBench


def test_push_is_told_as_the_current_that_would_push_so_sideways_on_the_mean_of_a_second() -> None:
    """A vertical push comes from a payload, and its effect shows in the depth."""
    bench, current_m_s = MonitorBench(), 0.7
    push_n = BODY.drag.mean * current_m_s**2
    force = push_n * np.array([0.6, -0.8, 0.0]) + np.array([0.0, 0.0, 50.0])
    bench.step()
    assert bench.step(force_w=force).push_m_s == pytest.approx(current_m_s * math.sqrt(1.0 - math.exp(-0.01)))
    assert bench.wait(0.99, force_w=force).push_m_s == pytest.approx(current_m_s * math.sqrt(1.0 - math.exp(-1.0)))
    assert bench.wait(9.0, force_w=force).push_m_s == pytest.approx(current_m_s, rel=1e-3)
    assert bench.step(force_w=-force).push_m_s == pytest.approx(current_m_s, rel=1e-3)


@pytest.mark.parametrize("speed_m_s", [0.0, 0.3, -0.3])
def test_push_upon_a_body_whose_drag_is_linear_too_is_no_more_current_than_there_is(speed_m_s: float) -> None:
    body, current_m_s = assemble([(0, 0, 0)], [0], [load_vehicle("bluerov2")], [1]), 0.4

    def drag_n(v_m_s: float) -> float:
        return body.drag.mean * v_m_s * abs(v_m_s) + float(body.drag.linear[:3].mean()) * v_m_s

    bench, push_n = MonitorBench(body), drag_n(speed_m_s) - drag_n(speed_m_s - current_m_s)
    bench.step()
    moves = np.array([speed_m_s, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert bench.wait(9.0, force_w=np.array([push_n, 0.0, 0.0]), nu=moves).push_m_s == pytest.approx(current_m_s, rel=1e-3)


@pytest.mark.parametrize("speed_m_s", [-0.2, 0.3, 0.9])
def test_push_upon_a_body_under_way_is_no_more_current_than_there_is(speed_m_s: float) -> None:
    """Against 0.4 m/s, a body that moves at 0.2 m/s feels twice the push of one at rest."""
    bench, current_m_s = MonitorBench(), 0.4
    through_m_s = speed_m_s - current_m_s
    push_n = BODY.drag.mean * (speed_m_s * abs(speed_m_s) - through_m_s * abs(through_m_s))
    bench.step()
    heard = bench.wait(9.0, force_w=np.array([0.0, -push_n, 0.0]), nu=np.array([0.1, -speed_m_s, 0.0, 0.0, 0.0, 0.0]))
    assert heard.push_m_s == pytest.approx(current_m_s, rel=1e-3)


@pytest.mark.parametrize("force_n", [math.nan, math.inf, 1e160, 1e6])
@pytest.mark.parametrize("speed_m_s", [1e160, math.nan, 0.0])
def test_push_that_nobody_could_believe_leaves_no_trace_in_the_mean(force_n: float, speed_m_s: float) -> None:
    """One NaN stayed in the mean for the rest of the flight, and `pushed` acted never again."""
    bench, current_m_s = MonitorBench(), 0.7
    push_n = BODY.drag.mean * current_m_s**2
    bench.step()
    bench.step(force_w=np.array([force_n, 0.0, 0.0]), nu=np.array([speed_m_s, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert bench.wait(9.0, force_w=np.array([push_n, 0.0, 0.0])).push_m_s == pytest.approx(current_m_s, rel=1e-3)


def test_push_upon_a_body_without_drag_is_no_current() -> None:
    bench = MonitorBench(dataclasses.replace(BODY, drag=dataclasses.replace(BODY.drag, nodes=0.0 * BODY.drag.nodes)))
    assert bench.wait(9.0, force_w=np.array([5.0, 0.0, 0.0])).push_m_s == 0.0


def test_module_that_leaves_a_large_body_feels_the_current_that_this_one_felt() -> None:
    """Regression: the module took over the force on the whole body; one that parted without tags in 0.4 m/s gave up its place."""
    row = assemble([(0, k, 0) for k in range(4)], [0] * 4, [load_vehicle("modcube")] * 4, [1, 3, 0, 2])
    whole, part, current_m_s = MonitorBench(row), MonitorBench(SINGLE), 0.4
    whole.step()
    whole.wait(9.0, force_w=np.array([row.drag.mean * current_m_s**2, 0.0, 0.0]))
    part.monitor.take_over([whole.monitor])
    part.time_ns = whole.time_ns
    assert part.step(force_w=np.array([SINGLE.drag.mean * current_m_s**2, 0.0, 0.0])).push_m_s == pytest.approx(current_m_s, rel=1e-3)


def test_push_is_known_to_a_body_that_two_have_become() -> None:
    bench, other = MonitorBench(), MonitorBench()
    for each, push_n in ((bench, 3.0), (other, 8.0)):
        each.step()
        each.wait(9.0, force_w=np.array([push_n, 0.0, 0.0]))
    joined = MonitorBench()
    joined.time_ns = bench.time_ns
    joined.monitor.take_over([bench.monitor, other.monitor])
    assert joined.step(force_w=np.array([8.0, 0.0, 0.0])).push_m_s == pytest.approx(math.sqrt(8.0 / BODY.drag.mean), rel=1e-3)
