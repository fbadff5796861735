"""Places: geodetic and local coordinates about the tank's origin, and paths to a place that a client requests."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from firmware_py.core.types import Mode
from firmware_py.ground.config import GroundConfig
from firmware_py.ground.geodesy import Origin
from firmware_py.ground.plan_jobs import PlanJob
from tests.unit.ground_missions import PLACES, fly, item, plan_of, upload
from tests.unit.ground_requests import NAN, ask
from tests.unit.ground_world import Client, World


def test_places_are_about_the_tanks_origin() -> None:
    """Checked against the series for metres per degree of WGS 84 (Defense Mapping Agency; valid to 0.01 m)."""
    f = math.radians(30.2084)
    north = 111132.92 - 559.82 * math.cos(2 * f) + 1.175 * math.cos(4 * f) - 0.0023 * math.cos(6 * f)
    east = 111412.84 * math.cos(f) - 93.5 * math.cos(3 * f) + 0.118 * math.cos(5 * f)
    origin = Origin(30.2084, 120.1614, 4.0)
    assert origin.local(30.2094, 120.1614, 3.0) == pytest.approx([north * 1e-3, 0.0, 1.0], abs=1e-3)
    assert origin.local(30.2084, 120.1624, 4.0) == pytest.approx([0.0, east * 1e-3, 0.0], abs=1e-3)
    for p in ([0.1, -0.2, 0.5], [50.0, 80.0, -3.0]):
        assert origin.local(*origin.geodetic(np.array(p))) == pytest.approx(p, abs=1e-6)
    date_line = Origin(0.0, 179.9999, 0.0)
    assert date_line.local(0.0, -179.9999, 0.0)[1] == pytest.approx(22.26, abs=0.01)
    assert date_line.geodetic(np.array([0.0, 22.264, 0.0]))[1] == pytest.approx(-179.9999, abs=1e-7), "no client takes more than 180"


def test_reposition_plans_one_leg(world: World, client: Client) -> None:
    client.command(400, 1)
    world.run(3)
    client.clear()
    client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, -1, 1, 0, 1.0, 302084010, 1201614000, -0.4)
    world.run(10)
    (job,) = world.station.jobs()
    assert job.legs[0].p_wb == pytest.approx([0.111, 0, 0.4], abs=2e-3)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_ACCEPTED


@pytest.mark.parametrize(("asked", "flown"), [(0.05, 0.05), (-1.0, 0.15), (0.0, 0.15), (NAN, 0.15)])
def test_reposition_is_as_fast_as_it_asks_for(world: World, client: Client, asked: float, flown: float) -> None:
    client.command(400, 1)
    world.run(3)
    client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, asked, 1, 0, NAN, 302084010, 1201614000, -0.4)
    world.run(10)
    (job,) = world.station.jobs()
    assert job.legs[0].speed_m_s == pytest.approx(flown)


@pytest.mark.parametrize(("identity", "yaw"), [("generic", 0.0), ("ardusub", None)])
def test_heading_of_a_reposition_turns_the_robot_but_for_clients_of_an_ardusub(identity: str, yaw: float | None) -> None:
    """MAVProxy's `guided` writes 0 there, for a way to circle that is meant for planes: the robot turned north."""
    world = World(config=GroundConfig(identity=identity))
    client = world.client()
    client.command(400, 1)
    world.run(3)
    client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, -1, 1, 0, 0.0, 302084010, 1201614000, -0.4)
    world.run(10)
    (job,) = world.station.jobs()
    assert job.legs[0].yaw == yaw


def test_reposition_that_comes_again_because_its_answer_was_lost_flies_on(world: World, client: Client) -> None:
    """Regression: the robot stopped and was replanned at each repetition."""

    def go(yaw: float = NAN, x: int = 302084010) -> list[PlanJob]:
        client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, -1, 1, 0, yaw, x, 1201614000, -0.4)
        world.run(10)
        return world.station.jobs()

    ask(world, client, 400, 1)
    (job,) = go()
    assert go() == [], "its plan is waited for once"
    world.station.planned(0, plan_of(job))
    world.run(300)
    assert go() == [] and world.robot.mode[0] == Mode.AUTO
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_ACCEPTED
    ask(world, client, 178, 1, 0.3)
    for another in ({}, {"x": 302084020}, {"yaw": 1.0}):
        assert len(go(**another)) == 1, "another speed, place or heading"
    for name in (b"MIS_ACCEL", b"MIS_CORRIDOR"):
        client.send("PARAM_SET", 1, 1, name, 0.2, 9)
        assert len(go(yaw=1.0)) == 1, name
    client.command(176, 1, 1)
    assert len(go(yaw=1.0)) == 1, "another mode was asked for just before"
    ask(world, client, 193, 0)
    assert len(go(yaw=1.0)) == 1, "it was paused"


@pytest.mark.parametrize("speed", [1e-6, 50.0])
def test_reposition_at_a_speed_that_no_mission_may_have_is_refused(world: World, client: Client, speed: float) -> None:
    client.command(400, 1)
    world.run(3)
    client.clear()
    client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, speed, 1, 0, NAN, 302084010, 1201614000, -0.4)
    world.run(10)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED and not world.station.jobs()
    assert "reposition refused: a speed of" in client.texts


@pytest.mark.parametrize(("frame", "above", "z"), [(0, 0.0, 0.4), (5, 0.0, 0.4), (3, 400.0, 0.4), (6, 400.0, 0.4)])
def test_reposition_reads_the_altitude_by_its_frame(frame: int, above: float, z: float) -> None:
    world = World(altitude_m=400.0)
    client = world.client()
    client.command(400, 1)
    world.run(3)
    client.send("COMMAND_INT", 1, 1, frame, 192, 0, 0, -1, 1, 0, NAN, 302084000, 1201614000, 400.0 - above - z)
    world.run(10)
    (job,) = world.station.jobs()
    assert job.legs[0].p_wb[2] == pytest.approx(z, abs=1e-3)


@pytest.mark.parametrize(("frame", "x", "y"), [(1, 0, 0), (10, 302084000, 1201614000), (6, 2**31 - 1, 2**31 - 1)])
def test_reposition_to_no_place_is_denied(world: World, client: Client, frame: int, x: int, y: int) -> None:
    client.command(400, 1)
    world.run(3)
    client.clear()
    client.send("COMMAND_INT", 1, 1, frame, 192, 0, 0, -1, 1, 0, NAN, x, y, -0.4)
    world.run(3)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_DENIED
    assert not world.station.jobs()


def test_reposition_in_floats_is_answered_with_command_int_only(world: World, client: Client) -> None:
    client.command(400, 1)
    world.run(3)
    client.clear()
    client.command(192, -1, 0, 0, NAN, 30.2084, 120.1614, -0.4)
    world.run(3)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_COMMAND_INT_ONLY
    assert not world.station.jobs()


def test_reposition_beyond_the_fence_is_refused_and_what_flew_goes_on(world: World, client: Client) -> None:
    upload(world, client, [item(i, place) for i, place in enumerate(PLACES)])
    fly(world, client)
    client.clear()
    client.send("COMMAND_INT", 1, 1, 6, 192, 0, 0, -1, 1, 0, NAN, 302084000, 1201614000, -51.0)
    world.run(10)
    assert client.last("COMMAND_ACK").result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert "reposition refused: 1.00 m beyond FENCE_BOTTOM, 50 m" in client.texts
    assert not world.station.jobs()
    world.run(120)
    assert client.last("MISSION_CURRENT").mission_state == mavlink.MISSION_STATE_ACTIVE
