"""Pressure that cannot be, or that contradicts the tags, is not believed: a false one would take the robot to the surface."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from firmware_py.core.depth_gate import DOUBT, LEAST_GATE_M, MOST_SPEED_M_S, MOST_STEP_M, SETTLED, DepthGate
from firmware_py.core.rotations import from_euler, to_matrix
from firmware_py.core.types import BodyPose, ExpectedDepth, Mode, ModuleInputs
from firmware_py.description.vehicle_file import load_vehicle
from firmware_py.description.water import ATMOSPHERE_PA, PA_PER_M
from firmware_py.prepare.assembly import assemble
from tests.unit.estimated_robot import P_WB, PERIOD, Robot, sensors
from tests.unit.tanks import DT, Tank, flies_with_noise, single

PAIR = assemble([(0, 0, 0), (0, 0, 1)], [0, 0], [load_vehicle("modcube")] * 2)
"""Two modules, one above the other."""
LEVEL = (0.0, 0.0, 1.0)
DEPTH_HZ = 50.0
"""Rate of the DEPTH frames."""
CLOCK = itertools.count(0, round(1e9 / DEPTH_HZ))
"""Time of each reading, ns."""
AT_3_M = ExpectedDepth(3.0, 0.003, LEVEL)


def pressure_at(depth_m: float) -> float:
    return ATMOSPHERE_PA + PA_PER_M * depth_m


def told(gate: DepthGate, depths_m: Sequence[float], expected: ExpectedDepth | None = AT_3_M, armed: bool = True) -> list[float | None]:
    """The depths that are left of readings of a single module."""
    left = []
    for depth_m in depths_m:
        (module,) = gate.step(next(CLOCK), [ModuleInputs(pressure_pa=pressure_at(depth_m))], expected, armed)
        left.append(None if module.pressure_pa is None else round((module.pressure_pa - ATMOSPHERE_PA) / PA_PER_M, 4))
    return left


def trusted_at(depth_m: float) -> DepthGate:
    gate = DepthGate(single())
    assert told(gate, [depth_m] * 5, AT_3_M._replace(depth_m=depth_m)) == [depth_m] * 5
    return gate


def trusted() -> DepthGate:
    return trusted_at(3.01)


@pytest.mark.parametrize("pressure_pa", [0.0, 41e3, 1.0e6, 1.3e6])
def test_pressure_far_below_the_atmosphere_or_far_deeper_than_the_hull_stands_is_not_believed_even_without_tags(pressure_pa: float) -> None:
    """The module is made for 50 m."""
    gate = DepthGate(single())
    (module,) = gate.step(next(CLOCK), [ModuleInputs(pressure_pa=pressure_pa, heard=True)], None, armed=False)
    assert module.pressure_pa is None and module.heard


@pytest.mark.parametrize("pressure_pa", [63e3, 101e3, 600e3])
def test_pressure_in_a_lake_high_above_the_sea_and_at_the_greatest_permitted_depth_is_believed(pressure_pa: float) -> None:
    gate = DepthGate(single())
    assert gate.step(next(CLOCK), [ModuleInputs(pressure_pa=pressure_pa)], None, armed=False)[0].pressure_pa == pressure_pa


def test_offset_of_some_decimetres_is_learnt_in_half_a_second_and_never_reaches_the_estimate() -> None:
    gate = trusted()
    assert told(gate, [3.3] * (DOUBT + 2)) == [None] * DOUBT + [3.0] * 2
    assert told(gate, [3.31, 3.30 + 1.1 * LEAST_GATE_M], AT_3_M) == [3.01, None]
    assert told(gate, [3.34, 3.37], None) == [3.04, 3.07], "without tags it is still known"


def test_sensor_that_is_heard_in_every_tick_at_400_hz_is_judged_as_one_at_50_hz() -> None:
    """Regression: its offset counted as steady within 62 ms, and a picture that came 100 ms late was compared with none of its readings, so
    that a robot followed a drift of 50 mm/s by 74 mm."""
    gate, left_pa = DepthGate(single()), list[float | None]()
    for tick in range(800):
        now_ns, depth_m = tick * 2_500_000, 3.0 + 0.05 * max(0.0, tick / 400 - 1.0)
        (left,) = gate.step(now_ns, [ModuleInputs(pressure_pa=pressure_at(depth_m))], AT_3_M._replace(depth_m=depth_m), armed=True)
        left_pa.append(left.pressure_pa)
        if tick % 7 == 0 and tick >= 40:
            gate.compare([BodyPose(now_ns - 100_000_000, np.array([0.0, 0.0, 3.0]), np.zeros(3), from_euler(0.0, 0.0, 0.0), 1.0)])
    assert sum(pa is not None for pa in left_pa[300:380]) == 10, "50 a second"
    assert not any(left_pa[700:]), "the tags tell that it drifts"
    jumped = trusted()
    later_ns = next(CLOCK)
    left_m = [jumped.step(later_ns + n * 2_500_000, [ModuleInputs(pressure_pa=pressure_at(3.3))], AT_3_M, True)[0] for n in range(160)]
    assert all(module.pressure_pa is None for module in left_m), "0.4 s are too short to learn an offset"


@pytest.mark.parametrize("gaps_ms", [(20,), (10, 30), (20, 10, 30), (30, 10, 20, 20), (40,)])
def test_readings_that_come_a_tick_early_or_late_are_all_used(gaps_ms: tuple[int, ...]) -> None:
    """A sensor of 50 Hz by its own clock, or one whose frames the bus holds up."""
    gate, now_ns = DepthGate(single()), 0
    for n in range(200):
        (left,) = gate.step(now_ns, [ModuleInputs(pressure_pa=pressure_at(3.0))], AT_3_M, armed=True)
        assert left.pressure_pa is not None
        now_ns += gaps_ms[n % len(gaps_ms)] * 1_000_000


def test_sensor_at_the_edge_of_the_gate_is_not_used_every_other_reading_for_ever() -> None:
    """In a body of four modules it cost 0.8 mm, because only the readings on one side of its noise were used."""
    gate, rng = trusted(), np.random.default_rng(0)
    depths = 3.0 + LEAST_GATE_M + rng.normal(0.0, 0.003, 6 * DOUBT)
    left = told(gate, depths)
    assert None in left[: 2 * DOUBT] and None not in left[3 * DOUBT :]
    np.testing.assert_allclose(np.mean(left[3 * DOUBT :]), 3.0, atol=0.006)


def test_offset_of_a_few_centimetres_is_left_to_the_filter() -> None:
    assert told(trusted(), [3.03] * (2 * DOUBT)) == [3.03] * (2 * DOUBT)


def test_gate_is_as_wide_as_the_filter_is_unsure() -> None:
    unsure = AT_3_M._replace(sigma_m=0.1)
    assert told(trusted(), [3.49, 3.51], unsure) == [3.49, None]


def test_sensor_of_several_may_differ_from_their_mean_as_biases_do() -> None:
    """The estimate knows their mean bias alone: one of four that was 37 mm off it was half refused, and the depth 5 mm wrong."""
    four = DepthGate(assemble([(i, 0, 0) for i in range(4)], [0] * 4, [load_vehicle("modcube")] * 4))
    for off_m, is_used in ((0.08, True), (0.09, False)):
        readings = [ModuleInputs(pressure_pa=pressure_at(3.0 + off)) for off in (off_m, 0.0, 0.0, 0.0)]
        left = [module.pressure_pa is not None for module in four.step(next(CLOCK), readings, AT_3_M, True)]
        assert left == [is_used, True, True, True]


def test_sensor_that_errs_by_metres_is_not_believed_with_tags_nor_without_until_it_agrees_with_them_again() -> None:
    gate = trusted()
    assert told(gate, [8.0] * (3 * DOUBT)) == [None] * (3 * DOUBT)
    assert told(gate, [8.0, 3.0, 3.0], None) == [None] * 3, "no tag bears it out"
    assert told(gate, [3.0] * (DOUBT + 1)) == [None] * (DOUBT - 1) + [3.0] * 2
    assert told(gate, [2.97], None) == [2.97]


def test_sensor_that_jumps_without_tags_is_not_used_until_it_is_back() -> None:
    gate = trusted()
    assert told(gate, [3.0, 8.0, 8.05, 3.05, 3.05], None) == [3.0, None, None, 3.05, 3.05]
    assert told(gate, [2.85, 2.85, 3.05], None) == [None, None, 3.05], "of two decimetres too"


def test_sensor_that_jumped_without_tags_for_half_a_second_is_distrusted_until_tags_agree() -> None:
    gate = trusted()
    assert told(gate, [8.0] * DOUBT + [3.0] * 100, None) == [None] * (DOUBT + 100)
    assert told(gate, [3.0] * DOUBT)[-1] == 3.0
    assert told(gate, [3.0], None) == [3.0]


@pytest.mark.parametrize("jumped", [1, 2 * DOUBT])
def test_body_that_rests_believes_a_sensor_that_jumped_once_it_has_settled(jumped: int) -> None:
    """After a silence nothing but tags gave the depth back, and a false first reading made every right one a jump."""
    gate = trusted()
    told(gate, [8.0] * jumped, None)
    assert told(gate, [8.0] * 2 * SETTLED, None)[-1] is None, "an armed one does not"
    assert told(gate, [8.0], None, armed=False) == [8.0]
    told(gate, [8.0] * 2 * SETTLED, None)
    assert told(gate, [5.0] * 2 * SETTLED, None, armed=False)[: SETTLED + 1] == [None] * SETTLED + [5.0]
    gate = DepthGate(single())
    assert told(gate, [3.15] + [3.0] * 2 * SETTLED, None, armed=False)[-1] == 3.0


def test_rest_does_not_clear_a_sensor_that_contradicted_tags() -> None:
    gate = trusted()
    told(gate, [8.0] * DOUBT)
    told(gate, [12.0] * DOUBT, None)
    assert told(gate, [12.0] * 2 * SETTLED, None, armed=False)[-1] is None


def test_sensor_that_jumped_just_before_the_tags_went_is_not_used_without_them() -> None:
    gate = trusted()
    told(gate, [8.0] * (DOUBT // 2))
    assert told(gate, [8.0] * 3, None) == [None] * 3


def test_sensor_is_followed_as_fast_as_a_body_can_go_without_tags() -> None:
    """A disarmed body may fall into the water, and a reading may come late, as after lost frames; after long silence not any counts."""
    dives = [3.0 + MOST_SPEED_M_S / DEPTH_HZ * n for n in range(100)]
    gate = trusted()
    assert None not in told(gate, dives, None)
    drops = [0.0, 0.12, 0.22, 0.26]
    assert told(trusted_at(0.0), drops, None, armed=False) == drops
    assert told(trusted_at(0.0), drops, None) == [0.0, None, None, None]
    for silence_s, moved_m, is_believed in ((0.2, 0.42, True), (0.2, 0.48, False), (60.0, MOST_STEP_M - 0.01, True), (60.0, 5.0, False)):
        gate = trusted_at(3.0)
        for _ in range(round(silence_s * DEPTH_HZ) - 1):
            next(CLOCK)
        assert (told(gate, [3.0 + moved_m], None) != [None]) == is_believed, (silence_s, moved_m)


def test_tags_alone_convict_a_sensor_not_the_memory_of_them() -> None:
    """Regression: a robot that was pushed hard when the tags went distrusted its good depth sensor, and surfaced."""
    robot = Robot(single())
    robot.rest(101)
    expected = robot.estimator.expected_depth(robot.time_ns)
    assert expected is not None and expected.depth_m == pytest.approx(P_WB[2], abs=2e-3) and expected.sigma_m < 0.1
    remembered = 0
    while robot.estimator.expected_depth(robot.time_ns) is not None:
        robot.step(sensors())
        remembered += 1
    assert 0.1 < remembered * PERIOD * 1e-9 <= 0.5 * DOUBT / DEPTH_HZ + 0.04, "and the age of the last picture"


def test_few_false_readings_do_not_make_a_sensor_distrusted() -> None:
    assert told(trusted(), [8.0, 3.0] * 50) == [None, 3.0] * 50
    gate = trusted()
    told(gate, [8.0] * (DOUBT - 1))
    assert told(gate, [3.0], None) == [3.0]


def test_sensor_with_noise_of_decimetres_is_distrusted() -> None:
    gate = trusted()
    told(gate, 3.0 + 0.15 * np.random.default_rng(0).standard_normal(200))
    assert told(gate, [3.0], None) == [None]


def test_robot_at_rest_learns_whatever_datum_the_tags_have_and_a_flying_one_that_never_knew_it_too() -> None:
    steady = [1.5] * (DOUBT + 1)
    assert told(DepthGate(single()), steady)[-1] == 3.0
    gate = trusted()
    assert told(gate, steady)[-1] is None
    assert told(gate, steady, armed=False)[-1] == 3.0


def test_each_module_is_judged_by_itself_where_it_is() -> None:
    """The second module hangs 0.21 m below the first; the one of them that errs stays known to a body that takes over."""
    gate, above, below = DepthGate(PAIR), pressure_at(3.0 - 0.105), pressure_at(3.0 + 0.105)
    for _ in range(2):
        left = gate.step(next(CLOCK), [ModuleInputs(pressure_pa=above), ModuleInputs(pressure_pa=below)], AT_3_M, armed=True)
        assert [module.pressure_pa for module in left] == [above, below]
    for _ in range(DOUBT):
        left = gate.step(next(CLOCK), [ModuleInputs(pressure_pa=above), ModuleInputs(pressure_pa=below + 5e4)], AT_3_M, armed=True)
        assert [module.pressure_pa for module in left] == [above, None]
    part = DepthGate(single(1))
    part.take_over([gate])
    _, left_of_it = part.step(next(CLOCK), [ModuleInputs(), ModuleInputs(pressure_pa=below)], None, armed=True)
    assert left_of_it.pressure_pa is None


def test_pictures_of_a_body_that_rolls_convict_none_of_its_sensors() -> None:
    """The picture shows a tag, the sensors are elsewhere: each is compared with where the attitude of the picture puts it."""
    gate, lever_b, on_the_way = DepthGate(PAIR), np.array([0.05, 0.1, -0.2]), []
    for n in range(300):
        now_ns, q_wb = next(CLOCK), from_euler(0.5 * math.sin(0.08 * n), 0.3 * math.sin(0.05 * n), 0.0)
        turned = to_matrix(q_wb)
        readings = [ModuleInputs(pressure_pa=pressure_at(3.0 + below_m)) for below_m in PAIR.r_bi @ turned[2]]
        left = gate.step(now_ns, readings, ExpectedDepth(3.0, 0.003, tuple(turned[2])), armed=True)
        assert [module.pressure_pa for module in left] == [module.pressure_pa for module in readings]
        on_the_way.append(BodyPose(now_ns, turned @ lever_b + [1.0, 2.0, 3.0], lever_b, q_wb, 1.0))
        gate.compare(on_the_way[-3:-2])


# ---------------------------------------------------------------- the robot


def with_pressure(change: Callable[[float, int], float], mode: Mode, seconds: float = 6.0) -> tuple[Tank, float]:
    """Flies in `mode` with a false pressure; returns the tank, and the farthest that it went up or down, m."""
    tank, since, farthest = Tank([single()]), -1, 0.0

    def tamper(module: ModuleInputs) -> None:
        if since >= 0 and module.pressure_pa is not None:
            module.pressure_pa = change(module.pressure_pa, len(tank.outputs) - since)

    flies_with_noise(tank, tamper, mode)
    tank.run(1.0)
    since, z = len(tank.outputs), tank.states[0][2]
    for _ in range(round(seconds / 0.01)):
        tank.run(0.01)
        farthest = max(farthest, abs(tank.states[0][2] - z))
    return tank, farthest


def tamper_with(tank: Tank, change: Callable[[ModuleInputs, int], None]) -> None:
    """Lets `change` alter what the single module hears, tick by tick, from now on."""
    hear = tank._hear

    def heard(tick: int) -> list[ModuleInputs]:
        (module,) = hear(tick)
        change(module, tick)
        return [module]

    tank._hear = heard  # type: ignore[method-assign]


def lose_tags(module: ModuleInputs, _: int) -> None:
    module.tags = []


WRONG: dict[str, Callable[[float, int], float]] = {
    "reads nothing": lambda _, tick: float(tick % 7),
    "reads its limit": lambda _, tick: 1.04e6 + tick % 7,
    "5 m too deep": lambda pa, _: pa + 5e4,
    "2 m too high": lambda pa, _: pa - 2e4,
    "a gain of 1.5": lambda pa, _: 1.5 * pa,
    "drifts by 5 cm/s": lambda pa, tick: pa + 5e2 * tick * DT,
    "drifts by 20 cm/s": lambda pa, tick: pa - 2e3 * tick * DT,
}


@pytest.mark.slow
@pytest.mark.parametrize("mode", [Mode.POSHOLD, Mode.ALT_HOLD])
@pytest.mark.parametrize("wrong", WRONG)
def test_robot_that_sees_tags_keeps_mode_and_depth_when_its_pressure_sensor_fails_and_says_so(wrong: str, mode: Mode) -> None:
    """It let go of its place or depth, and swam up by as much as 2.9 m; a drift of 5 cm/s cost a third of the tags."""
    tank, farthest = with_pressure(WRONG[wrong], mode)
    assert farthest < 0.02
    assert tank.outputs[-1].records[0].estimate.rejected == 0
    assert tank.outputs[-1].records[0].mode == mode
    assert any(event.text == "fail-safe on: no pressure for 1.0 s" for outputs in tank.outputs for event in outputs.events)


@pytest.mark.slow
@pytest.mark.parametrize("offset_pa", [700.0, 3000.0, -3000.0])
def test_robot_keeps_its_depth_when_the_weather_changes_at_once(offset_pa: float) -> None:
    """Three decimetres moved it by 0.2 m."""
    tank, farthest = with_pressure(lambda pa, _: pa + offset_pa, Mode.ALT_HOLD, 2.0)
    assert farthest < 0.01
    assert not any("fail-safe" in event.text for outputs in tank.outputs for event in outputs.events)


@pytest.mark.slow
def test_robot_that_loses_the_tags_with_a_false_pressure_comes_up_as_one_that_knows_no_depth() -> None:
    tank, _ = with_pressure(WRONG["5 m too deep"], Mode.ALT_HOLD, 2.0)
    tamper_with(tank, lose_tags)
    assert tank.run(7.0).records[0].mode == Mode.SURFACE


@pytest.mark.slow
@pytest.mark.parametrize("offset_m", [-3.5, 5.0, 19.5])
@pytest.mark.parametrize("blind_s", [0.0, 5.0])
def test_first_tags_give_a_pose_whatever_the_pressure_sensor_tells(offset_m: float, blind_s: float) -> None:
    """A broken one, or a lake at 3800 m: readings from before the first tags pulled the filter off, and it refused the tags for ever."""
    tank = Tank([single()])

    def change(module: ModuleInputs, tick: int) -> None:
        if module.pressure_pa is not None:
            module.pressure_pa += offset_m * PA_PER_M
        if tick * DT < blind_s:
            lose_tags(module, tick)

    tamper_with(tank, change)
    estimate = tank.run(blind_s + 1.0).records[0].estimate
    assert estimate.ready and estimate.rejected <= 1
    assert abs(estimate.p_wb[2] - tank.states[0][2]) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("height_m", "period_s"), [(0.03, 4.0), (0.05, 2.0), (0.05, 4.0)])
def test_robot_in_small_waves_keeps_holding_its_depth_when_the_tags_go(height_m: float, period_s: float) -> None:
    """The sensor erred by less than the gate, and was distrusted for it; without tags the robot surfaced."""

    def waves(pressure_pa: float, tick: int) -> float:
        return pressure_pa + height_m * PA_PER_M * math.sin(2.0 * math.pi * tick * DT / period_s)

    tank, farthest = with_pressure(waves, Mode.ALT_HOLD, 10.0)
    assert farthest < 0.03
    tamper_with(tank, lose_tags)
    assert tank.run(7.0).records[0].mode == Mode.ALT_HOLD
